"""The family of residual tests: what each would find, its verdict, and the verdict of all.

Linear and nonlinear correlation tests of one-step residuals ξ with the inputs u and outputs y. The
nonlinear ones find what a linear correlation is blind to: an even term, a product, a bilinear one.

Sources: S. A. Billings, W. S. F. Voon, "Correlation based model validity tests for non-linear
models", Int. J. Control 44(1), 1986 (ξξ, uξ, u²'ξ, u²'ξ², ξ(ξu)); S. A. Billings, Q. M. Zhu,
"Nonlinear model validation using correlation tests", Int. J. Control 60(6), 1994 ((yξ) with ξ² and
u²); the same, "Model validation tests for multivariable nonlinear models including neural
networks", Int. J. Control 62(4), 1995 (products of two inputs). Their bands ±1.96/√n hold for
white series; those of :func:`moment_test`, which is behind all of these tests, for any input.

Under a right model the residual a(t) is unpredictable: ``E[a(t) z(t − k)] = 0`` for every
instrument z of the past (a residual, an input, a square, a product) and every lag k ≥ 1. Then
``v(t) = a(t)·[z(t − k₁), …, z(t − k_m)]`` is a martingale difference whatever the autocorrelation
of z, and

    T = n v̄ᵀ V⁻¹ v̄,   V = (1/n) Σ v vᵀ        is χ² of m degrees of freedom.

No band assumes a white input, and none a constant variance of the residual: the noise of an
encoder depends on how the rig moves. Only the past is looked at, so the tests hold in closed loop,
where the input carries the residuals of before.

Sources: I. N. Lobato, "Testing that a dependent process is uncorrelated", J. Amer. Statist. Assoc.
96, 2001 (V in place of the variances of white noise); J. M. Wooldridge, "A unified approach to
robust, regression-based specification tests", Econometric Theory 6, 1990 (T as n R² of a
regression of ones on v).

Many tests at once have p-values that hold for the whole family: S. Holm, "A simple sequentially
rejective multiple test procedure", Scand. J. Statist. 6, 1979; Y. Benjamini, Y. Hochberg,
"Controlling the false discovery rate", J. R. Statist. Soc. B 57, 1995.

A quantised angle, or an observer that is told the wrong noise, leaves residuals that are correlated
in time although the model of the rig is right. That is one finding, and one test makes it. The
other tests ask for what the *input* explains, and would all repeat it: they look at what an
autoregression leaves.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import FloatArray

#: Directions of the instruments with less than this share of the mean variance are left out: lags
#: of a smooth input are nearly one another's copies, and what little differs says nothing.
_LEAST_SHARE = 1e-3
#: Samples per lag below which the χ² is not to be trusted.
_SAMPLES_PER_LAG = 10


@dataclass(frozen=True)
class MomentTest:
    """A test, with the correlations it looked at."""

    lags: npt.NDArray[np.int64]  #: (m,) int array; samples
    correlations: FloatArray  #: (m,) array; sample correlations at the lags, in [−1, 1]
    standard_errors: FloatArray  #: (m,) array; of them, if the residual is unpredictable
    statistic: float  #: T; NaN if there are too few samples, or nothing varies
    degrees: int  #: Degrees of freedom of its χ²
    p_value: float  #: of the test

    def band(self, level: float = 0.95) -> FloatArray:
        """Half width of a band that all lags together stay in with probability `level` (Šidák)."""
        from scipy.special import ndtri

        each = level ** (1.0 / max(1, len(self.lags)))
        return np.asarray(float(ndtri(0.5 + each / 2)) * self.standard_errors)


def moment_test(
    present: FloatArray, past: FloatArray | Sequence[FloatArray], lags: Sequence[int]
) -> MomentTest:
    """Test that `present` is uncorrelated with earlier values of `past`.

    ``present``: (n,) array; unpredictable if the model is right; NaN where missing. ``past``: (n,)
    array, or several that share one test: instruments. Means are taken off. ``lags``: from 1 on:
    ``present(t)`` meets ``past(t − lag)``.
    """
    series = [past] if isinstance(past, np.ndarray) else list(past)
    steps = np.asarray(lags, dtype=np.int64)
    a = _centred(present)
    z = np.array([_shifted(past, int(k)) for past in map(_centred, series) for k in steps])
    v = a * z
    complete = ~np.isnan(v).any(axis=0)
    if not complete.all():
        v, z, a = v[:, complete], z[:, complete], a[complete]
    m, n = v.shape
    all_lags = np.tile(steps, len(series))
    if n < _SAMPLES_PER_LAG * max(m, 2):
        return _not_made(all_lags)
    mean = v.mean(axis=1)
    second = v @ v.T / n
    spread = np.sqrt(np.diag(second))
    norms = np.sqrt(np.mean(a**2) * np.mean(z**2, axis=1))
    varying = (spread > 0) & (norms > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        correlations, errors = mean / norms, spread / norms / np.sqrt(n)
    if not varying.any():
        return _not_made(all_lags)
    scaled = mean[varying] / spread[varying]
    values, vectors = np.linalg.eigh(
        second[np.ix_(varying, varying)] / np.outer(spread[varying], spread[varying])
    )
    is_large = values > _LEAST_SHARE
    along = vectors[:, is_large].T @ scaled
    statistic = float(n * np.sum(along**2 / values[is_large]))
    degrees = int(np.count_nonzero(is_large))
    return MomentTest(
        all_lags, correlations, errors, statistic, degrees, chi2_tail(statistic, degrees)
    )


def _not_made(lags: npt.NDArray[np.int64]) -> MomentTest:
    """Of too few samples, or where nothing varies."""
    nothing = np.full(len(lags), np.nan)
    return MomentTest(lags, nothing, nothing, np.nan, 0, np.nan)


def mean_test(present: FloatArray) -> MomentTest:
    """Test that an unpredictable residual has mean zero (the same engine, instrument 1)."""
    values = present[~np.isnan(present)]
    lag = np.zeros(1, dtype=np.int64)
    power = float(np.mean(values**2)) if values.size else 0.0
    if values.size < 2 * _SAMPLES_PER_LAG or power == 0.0:
        return _not_made(lag)
    share = float(np.mean(values)) / np.sqrt(power)
    statistic = values.size * share**2
    error = np.array([1.0 / np.sqrt(values.size)])
    return MomentTest(lag, np.array([share]), error, statistic, 1, chi2_tail(statistic, 1))


def ljung_box(residual: FloatArray, lags: int) -> MomentTest:
    """The classical whiteness test, Q = n(n + 2) Σ r²(k)/(n − k), for a constant variance.

    Source: G. M. Ljung, G. E. P. Box, "On a measure of lack of fit in time series models",
    Biometrika 65(2), 1978. With missing samples each r(k) has its own count of pairs.
    """
    steps = np.arange(1, lags + 1)
    a = _centred(residual)
    power = np.nanmean(a**2) if np.any(~np.isnan(a)) else 0.0
    pairs = [a * _shifted(a, int(k)) for k in steps]
    counts = np.array([np.count_nonzero(~np.isnan(p)) for p in pairs])
    n = int(np.count_nonzero(~np.isnan(a)))
    if not power > 0 or counts.min() < _SAMPLES_PER_LAG * max(2, lags):
        return _not_made(steps)
    r = np.array([np.nansum(p) for p in pairs]) / (power * n)
    # Pairs that are missing beyond those at the end lower r's variance in the same proportion.
    variances = counts / n**2
    statistic = float(np.sum((n + 2) / n * r**2 / variances))
    return MomentTest(steps, r, np.sqrt(variances), statistic, lags, chi2_tail(statistic, lags))


def chi2_tail(statistic: float, degrees: float) -> float:
    """Probability that a χ² exceeds the statistic; NaN without degrees of freedom."""
    from scipy.special import chdtrc

    return float(chdtrc(degrees, statistic)) if degrees > 0 and np.isfinite(statistic) else np.nan


def _shifted(values: FloatArray, lag: int) -> FloatArray:
    """``values(t − lag)``, NaN where that lies outside; ``lag`` from 1 on."""
    shifted = np.full(len(values), np.nan)
    shifted[lag:] = values[:-lag]
    return shifted


def holm(p_values: Sequence[float] | FloatArray) -> FloatArray:
    """Adjusted p-values: rejecting those at most α errs once or more with probability at most α.

    ``p_values``: (m,) array; NaN for a test that could not be made; it stays NaN and does not
    count. Returns (m,) array; ``max over j ≤ i of min(1, (m − j + 1) p_(j))`` in the order of
    rising p.
    """
    return _adjusted(p_values, lambda rank, m: m - rank, np.maximum.accumulate)


def benjamini_hochberg(p_values: Sequence[float] | FloatArray) -> FloatArray:
    """Adjusted p-values: among those at most α, a share of at most α is false on average.

    ``p_values``: (m,) array; NaN for a test that could not be made. Returns (m,) array; ``min over
    j ≥ i of (m / j) p_(j)`` in the order of rising p.
    """
    return _adjusted(
        p_values,
        lambda rank, m: m / (rank + 1.0),
        lambda scaled: np.minimum.accumulate(scaled[::-1])[::-1],
    )


def _adjusted(
    p_values: Sequence[float] | FloatArray,
    factor: Callable[[FloatArray, int], FloatArray],
    cumulate: Callable[[FloatArray], FloatArray],
) -> FloatArray:
    p = np.asarray(p_values, dtype=float)
    adjusted = np.full(p.shape, np.nan)
    present = np.flatnonzero(~np.isnan(p))
    if present.size == 0:
        return adjusted
    order = present[np.argsort(p[present], kind="stable")]
    m = len(order)
    adjusted[order] = np.minimum(1.0, cumulate(factor(np.arange(m, dtype=float), m) * p[order]))
    return adjusted


#: Keeps a residual that repeats itself exactly from making the equations singular.
_RIDGE = 1e-13


def whiten_residual(residual: FloatArray, highest_order: int = 20) -> tuple[FloatArray, int]:
    """The innovations of an autoregression fitted to a residual (n,), and its order, by BIC.

    The residual is NaN where missing; its mean stays in the result, scaled by the sum of the
    coefficients. The result is NaN where an earlier sample is missing; of order 0 it is the
    residual as it is.
    """
    n = len(residual)
    highest_order = min(highest_order, n // 20)
    present = ~np.isnan(residual)
    if highest_order < 1 or np.count_nonzero(present) < 40:
        return residual, 0
    centred = residual - residual[present].mean()
    lagged = np.full((n, highest_order + 1), np.nan)
    for k in range(highest_order + 1):
        lagged[k:, k] = centred[: n - k]
    complete = lagged[~np.isnan(lagged).any(axis=1)]
    m = len(complete)
    if m < 10 * highest_order or not np.any(complete[:, 0]):
        return residual, 0
    # One Cholesky factor serves all orders: its k-th row tells what the k-th lag adds. (A QR of the
    # lags themselves costs a hundred times as much on a busy machine.)
    gram = complete.T @ complete
    inner = gram[1:, 1:] + _RIDGE * np.trace(gram) * np.eye(highest_order)
    root = np.linalg.cholesky(inner)
    gains = np.linalg.solve(root, gram[1:, 0])
    errors = gram[0, 0] - np.concatenate([[0.0], np.cumsum(gains**2)])
    errors = np.maximum(errors, 1e-14 * gram[0, 0]) / m
    order = int(np.argmin(m * np.log(errors) + np.arange(highest_order + 1) * np.log(m)))
    if order == 0:
        return residual, 0
    coefficients = np.linalg.solve(root[:order, :order].T, gains[:order])
    raw = np.full((n, order + 1), np.nan)
    for k in range(order + 1):
        raw[k:, k] = residual[: n - k]
    return raw[:, 0] - raw[:, 1:] @ coefficients, order


_COLOURED = "the past error foretells the next: a missing lag or state, or the noise model"
#: What it means when a test of a kind fails.
MEANING: Mapping[str, str] = MappingProxyType(
    {
        "mean": "a constant error: an offset of a sensor, a wrong equilibrium",
        "auto": _COLOURED,
        "ljung_box": _COLOURED,
        "other": "the errors of other channels foretell this one's: a missing coupling, or the "
        "noise model",
        "input": "the input foretells the error: wrong gain, delay or dynamics from it",
        "square": "the input's size foretells the error: a wrong curve (thrust, dead zone, "
        "saturation)",
        "product": "the product of two inputs foretells the error: a missing cross term",
        "square_square": "the error's size follows the input's size: an error or a noise that "
        "grows with the input",
        "bilinear": "past error times past input foretells the error: a parameter that depends on "
        "the operating point",
        "output_error": "the output times the error follows the past error's size: nonlinear "
        "dynamics are missing",
        "output_input": "the output times the error follows the input's size: nonlinear dynamics "
        "are missing",
    }
)


@dataclass(frozen=True)
class ResidualTest:
    """One test of one channel."""

    channel: str  #: Output whose residual is tested
    kind: str  #: Key of :data:`MEANING`
    inputs: tuple[str, ...]  #: Inputs that take part
    formula: str  #: As the literature writes it
    result: MomentTest
    p_holm: float = np.nan  #: Over all tests of all channels: of one or more false alarms
    p_bh: float = np.nan  #: The same as a share of false alarms among the alarms

    @property
    def name(self) -> str:
        """Unique within a channel."""
        return "_".join((self.kind, *self.inputs))

    def failed(self, level: float = 0.05) -> bool:
        """Whether the family-wise p-value is below the level."""
        return bool(self.p_holm < level)


@dataclass(frozen=True)
class ResidualTests:
    """All tests of a set of residuals."""

    tests: tuple[ResidualTest, ...]
    #: Order of the autoregression that was taken out of each residual before all tests but ``auto``
    #: and ``ljung_box``
    whitening_order: Mapping[str, int]
    level: float = 0.05  #: Family-wise

    def of(self, channel: str) -> list[ResidualTest]:
        """The tests of one channel."""
        return [test for test in self.tests if test.channel == channel]

    def failures(self) -> list[ResidualTest]:
        """Those that fail at the family-wise level, smallest p first."""
        failed = [test for test in self.tests if test.failed(self.level)]
        return sorted(failed, key=lambda test: test.result.p_value)

    def with_p_values(self, p_values: Sequence[float]) -> ResidualTests:
        """The same tests with other p-values (from simulation), adjusted again."""
        adjusted = [
            replace(test, result=replace(test.result, p_value=float(p)))
            for test, p in zip(self.tests, p_values, strict=True)
        ]
        return ResidualTests(_with_family_p_values(adjusted), self.whitening_order, self.level)


def residual_tests(
    residuals: Mapping[str, FloatArray],
    inputs: Mapping[str, FloatArray],
    outputs: Mapping[str, FloatArray],
    *,
    lags: int = 20,
    longest_lag: int | None = None,
    level: float = 0.05,
) -> ResidualTests:
    """Test one-step residuals.

    ``residuals``, ``outputs``: (n,) arrays by channel: measured minus predicted from the past;
    measured. NaN where missing. ``inputs``: (n,) arrays; ``u(t)`` acts from sample t to t + 1, so
    ``ξ(t)`` may depend on ``u(t − 1)`` first. ``lags``: of the autocorrelation, 1 … lags.
    ``longest_lag``: of the tests with inputs, whose lags grow geometrically from 1; default `lags`.
    ``level``: family-wise.
    """
    far = geometric_lags(longest_lag or lags)
    white = {name: whiten_residual(residual, lags) for name, residual in residuals.items()}
    moving = {name: u for name, u in inputs.items() if _moves(u)}
    tests: list[ResidualTest] = []
    for name, residual in residuals.items():
        others = [white[other][0] for other in residuals if other != name]
        tests += _of_channel(
            name, residual, white[name][0], outputs[name], moving, others, lags, far
        )
    orders = {name: order for name, (_, order) in white.items()}
    return ResidualTests(_with_family_p_values(tests), orders, level)


def _of_channel(
    channel: str,
    raw: FloatArray,
    residual: FloatArray,
    output: FloatArray,
    inputs: Mapping[str, FloatArray],
    others: Sequence[FloatArray],
    lags: int,
    far: Sequence[int],
) -> list[ResidualTest]:
    near = range(1, lags + 1)
    centred = _centred(residual)
    square, _ = whiten_residual(centred**2, lags)
    with_output, _ = whiten_residual(_centred(output) * residual, lags)

    def test(kind: str, formula: str, result: MomentTest, *names: str) -> ResidualTest:
        return ResidualTest(channel, kind, names, formula, result)

    tests = [
        test("mean", "E[ξ]", mean_test(residual)),
        test("auto", "φ_ξξ", moment_test(raw, raw, near)),
        test("ljung_box", "Q of φ_ξξ", ljung_box(raw, lags)),
    ]
    if others:
        tests.append(test("other", "φ_ξ'ξ", moment_test(residual, others, _FEW)))
    squares = {name: _centred(u) ** 2 for name, u in inputs.items()}
    for name, u in inputs.items():
        tests += [
            test("input", f"φ_uξ, {name}", moment_test(residual, u, far), name),
            test("square", f"φ_u²'ξ, {name}", moment_test(residual, squares[name], far), name),
            test(
                "square_square", f"φ_u²'ξ², {name}", moment_test(square, squares[name], far), name
            ),
            test("bilinear", f"φ_ξ(ξu), {name}", moment_test(residual, centred * u, far), name),
            test(
                "output_input",
                f"φ_(yξ)u², {name}",
                moment_test(with_output, squares[name], far),
                name,
            ),
        ]
    for one, two in combinations(inputs, 2):
        product = _centred(inputs[one]) * _centred(inputs[two])
        tests.append(
            test("product", f"φ_(uu)'ξ, {one}·{two}", moment_test(residual, product, far), one, two)
        )
    tests.append(test("output_error", "φ_(yξ)ξ²", moment_test(with_output, centred**2, far)))
    return tests


#: Lags at which the other channels' residuals are looked at.
_FEW = (1, 2, 3, 5)


def geometric_lags(longest: int, ratio: float = 1.5) -> list[int]:
    """1, 2, 3, 4, 6, 9, … up to about `longest` samples."""
    lags: list[int] = []
    lag = 1.0
    while round(lag) <= longest:
        if not lags or round(lag) > lags[-1]:
            lags.append(round(lag))
        lag = max(lag * ratio, lag + 1)
    return lags


def _with_family_p_values(tests: Sequence[ResidualTest]) -> tuple[ResidualTest, ...]:
    p = [test.result.p_value for test in tests]
    return tuple(
        replace(test, p_holm=float(family), p_bh=float(share))
        for test, family, share in zip(tests, holm(p), benjamini_hochberg(p), strict=True)
    )


def _centred(values: FloatArray) -> FloatArray:
    present = values[~np.isnan(values)]
    return values - present.mean() if present.size else values


def _moves(values: FloatArray) -> bool:
    present = values[~np.isnan(values)]
    return bool(present.size and np.ptp(present) > 0)


def p_words(p: float | None) -> str:
    """A p-value over the whole family, in words."""
    if p is None:
        return "no p-value"
    return "p < 0.001" if p < 1e-3 else f"p = {p:.2g}"
