"""The family of residual tests: what each would find, its verdict, and the verdict of all.

Linear and nonlinear correlation tests of one-step residuals ξ with the inputs u and outputs y. The
nonlinear ones find what a linear correlation is blind to: an even term, a product, a bilinear one.

Sources: S. A. Billings, W. S. F. Voon, "Correlation based model validity tests for non-linear
models", Int. J. Control 44(1), 1986 (ξξ, uξ, u²'ξ, u²'ξ², ξ(ξu)); S. A. Billings, Q. M. Zhu,
"Nonlinear model validation using correlation tests", Int. J. Control 60(6), 1994 ((yξ) with ξ² and
u²); the same, "Model validation tests for multivariable nonlinear models including neural
networks", Int. J. Control 62(4), 1995 (products of two inputs). Their bands ±1.96/√n hold for
white series; :mod:`moment_test` has bands for any input.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from trms_cli.identification.validation.moment_test import (
    MomentTest,
    ljung_box,
    mean_test,
    moment_test,
)
from trms_cli.identification.validation.multiplicity import benjamini_hochberg, holm
from trms_cli.identification.validation.whitening import whitened

FloatArray = npt.NDArray[np.float64]

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
    #: p-value over all tests of all channels: one or more false alarms with this probability
    p_holm: float = np.nan
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
        return ResidualTests(_adjusted(adjusted), self.whitening_order, self.level)


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

    Parameters
    ----------
    residuals, outputs : dict of str to (n,) arrays
        By channel: measured minus predicted from the past; measured. NaN where missing.
    inputs : dict of str to (n,) arrays
        ``u(t)`` acts from sample t to t + 1, so ``ξ(t)`` may depend on ``u(t − 1)`` first.
    lags : int
        Lags of the autocorrelation, 1 … lags.
    longest_lag : int
        Of the tests with inputs, whose lags grow geometrically from 1; default `lags`.
    level : float
        Family-wise.
    """
    far = geometric_lags(longest_lag or lags)
    white = {name: whitened(residual, lags) for name, residual in residuals.items()}
    moving = {name: u for name, u in inputs.items() if _moves(u)}
    tests: list[ResidualTest] = []
    for name, residual in residuals.items():
        others = [white[other][0] for other in residuals if other != name]
        tests += _of_channel(
            name, residual, white[name][0], outputs[name], moving, others, lags, far
        )
    orders = {name: order for name, (_, order) in white.items()}
    return ResidualTests(_adjusted(tests), orders, level)


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
    centred = residual - np.nanmean(residual) if np.any(~np.isnan(residual)) else residual
    square, _ = whitened(centred**2, lags)
    with_output, _ = whitened(_centred(output) * residual, lags)

    def test(kind: str, formula: str, result: MomentTest, *names: str) -> ResidualTest:
        return ResidualTest(channel, kind, names, formula, result)

    found = [
        test("mean", "E[ξ]", mean_test(residual)),
        test("auto", "φ_ξξ", moment_test(raw, raw, near)),
        test("ljung_box", "Q of φ_ξξ", ljung_box(raw, lags)),
    ]
    if others:
        found.append(test("other", "φ_ξ'ξ", moment_test(residual, others, _FEW)))
    squares = {name: _centred(u) ** 2 for name, u in inputs.items()}
    for name, u in inputs.items():
        found += [
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
        found.append(
            test("product", f"φ_(uu)'ξ, {one}·{two}", moment_test(residual, product, far), one, two)
        )
    found.append(test("output_error", "φ_(yξ)ξ²", moment_test(with_output, centred**2, far)))
    return found


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


def _adjusted(tests: Sequence[ResidualTest]) -> tuple[ResidualTest, ...]:
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
