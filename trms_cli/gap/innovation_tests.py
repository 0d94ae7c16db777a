"""Is there a gap? Tests of the refitted model's innovations.

Under the hypothesis that nothing but the usual error of the equations is left, innovations in that
metric are white, have unit variance and know nothing of the inputs. Sensors round, and fitting
takes something out, so that textbook limits are wrong in both directions: every statistic is
compared with its distribution over recordings that are drawn (a parametric bootstrap): the
linearised model moves about the recording with noise on its equations, its sensors round as the
real ones do, and what a fit would have taken is taken out. p-values are corrected by Holm (1979).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from scipy import stats

from trms_cli.core.arrays import BoolArray, ComplexArray, FloatArray
from trms_cli.gap.diagnosis import GapTest
from trms_cli.gap.fitting import FittedModel, InnovationObjective, Metric, ModelStructure
from trms_cli.gap.problem import quantum_of
from trms_cli.identification.validation.residual_tests import holm
from trms_cli.models.model import names

#: s. Longest lag of the tests, and samples at least and at most.
_LONGEST_LAG, _FEWEST_LAGS, _MOST_LAGS = 0.5, 4, 25
_LEVEL = 0.05
_BANDS = 4


def innovation_tests(fitted: FittedModel, *, draws: int = 40, seed: int = 0) -> tuple[GapTest, ...]:
    """Test every measured channel.

    ``fitted``: in a metric of the discrepancies that rigs without a gap have. ``draws``: of the
    bootstrap.
    """
    structure, fit, metric = fitted.structure, fitted.fit, fitted.metric
    starts = structure.starts(fit.theta, fitted.centres)
    objective = InnovationObjective(structure.windows, metric, starts)
    _, _, residuals = objective.parabola(fit.theta, fit.starts)
    columns = objective.columns(residuals)
    measured = structure.windows.measured
    z = np.where(measured, np.clip(columns[..., -1], -6, 6), 0.0)
    take = _taken_by_fits(columns[..., :-1], structure, objective)
    random = np.random.default_rng(np.random.SeedSequence([seed, 0x6A9]))
    commands = structure.windows.commands
    observed = _statistics(z, measured, commands, structure.windows.sample_time)
    drawn: dict[tuple[str, int], list[float]] = {key: [] for key in observed}
    target = structure.windows.target
    quanta = np.array([quantum_of(target[..., i]) for i in range(target.shape[2])])
    for drawn_residual in _drawn(metric, quanta, draws, random):
        white = np.where(
            measured, np.clip(metric.whitened(drawn_residual[..., None])[..., 0], -6, 6), 0.0
        )
        left = np.where(measured, take(white), 0.0)
        again = _statistics(left, measured, commands, structure.windows.sample_time)
        for key, value in again.items():
            drawn[key].append(value)
    outputs = names(structure.problem.model.outputs)
    keys = list(observed)
    p = np.array([_tail(observed[key], np.array(drawn[key])) for key in keys])
    corrected = holm(p)
    return tuple(
        GapTest(
            name=name,
            channel=outputs[i],
            statistic=observed[name, i],
            p_value=float(p[k]),
            p_corrected=float(corrected[k]),
            rejected=bool(corrected[k] < _LEVEL),
        )
        for k, (name, i) in enumerate(keys)
    )


def _drawn(
    metric: Metric, quanta: FloatArray, draws: int, random: np.random.Generator
) -> Iterator[FloatArray]:
    """Residuals (m, c, n_y) of rigs that move about the recording as the metric says."""
    discrepancy = metric.discrepancy
    system, trajectory = discrepancy.system, discrepancy.trajectory
    m, c, _, n = system.h.shape
    sizes = discrepancy.effective(metric.shares)
    spread = sizes * np.sqrt(1 - discrepancy.forgotten**2)
    n_x = n - len(spread)
    x = np.zeros((m, n, draws))
    x[:, n_x:] = sizes[:, None] * random.standard_normal((m, len(spread), draws))
    away = np.empty((m, c, system.h.shape[2], draws))
    for t in range(c):
        away[:, t] = system.h[:, t] @ x
        x = system.f[:, t] @ x
        x[:, n_x:] += spread[:, None] * random.standard_normal((m, len(spread), draws))
    noise = np.sqrt(np.maximum(system.r - quanta**2 / 12, 0.0))
    away += noise[:, None] * random.standard_normal(away.shape)
    coarse = np.maximum(quanta, 1e-12)[:, None]
    y = trajectory.y[..., None] + away
    rounded = np.where(quanta[:, None] > 0, coarse * np.round(y / coarse), y)
    for k in range(draws):
        yield rounded[..., k] - trajectory.y


def _statistics(
    z: FloatArray, measured: BoolArray, commands: FloatArray, sample_time: float
) -> dict[tuple[str, int], float]:
    """All statistics by name and output; large ones speak against the model."""
    lags = int(np.clip(round(_LONGEST_LAG / sample_time), _FEWEST_LAGS, _MOST_LAGS))
    lags = min(lags, z.shape[1] // 3)
    size = 2 ** int(np.ceil(np.log2(z.shape[1] + lags + 1)))
    u = commands - commands.mean(axis=1, keepdims=True)
    spectrum_u = np.fft.rfft(u, size, axis=1)
    power_u = np.maximum(np.mean(u**2, axis=(0, 1)), 1e-12)
    found: dict[tuple[str, int], float] = {}
    for i in range(z.shape[2]):
        count = int(measured[..., i].sum())
        if count < 10 * lags:
            continue
        e = z[..., i]
        power = float(np.sum(e**2) / count)
        spectrum = np.fft.rfft(e, size, axis=1)
        found["variance", i] = power
        found["whiteness", i] = _portmanteau(spectrum, spectrum, lags, count, power**2)
        squares = np.where(measured[..., i], e**2 - power, 0.0)
        spread = max(float(np.sum(squares**2) / count), 1e-12)
        of_squares = np.fft.rfft(squares, size, axis=1)
        found["squares", i] = _portmanteau(of_squares, of_squares, lags, count, spread**2)
        found["inputs", i] = math.fsum(
            _portmanteau(spectrum, spectrum_u[..., k], lags, count, power * power_u[k], zero=True)
            for k in range(u.shape[2])
        )
        density = np.sum(np.abs(np.fft.rfft(e, axis=1)) ** 2, axis=0)[1:]
        bands = np.array([b.mean() for b in np.array_split(density, _BANDS)])
        found["bands", i] = float(np.max(bands) / np.mean(density))
    return found


def _portmanteau(
    one: ComplexArray,
    other: ComplexArray,
    lags: int,
    count: int,
    scale: float,
    *,
    zero: bool = False,
) -> float:
    """Sum of squared correlations; the first lags behind the second (closed loops)."""
    crossed = np.fft.irfft(one * np.conj(other), axis=1)[:, : lags + 1].sum(axis=0) / count
    chosen = crossed if zero else crossed[1:]
    return float(count * np.sum(chosen**2) / max(scale, 1e-300))


def _taken_by_fits(
    slopes: FloatArray, structure: ModelStructure, objective: InnovationObjective
) -> Callable[[FloatArray], FloatArray]:
    """What is left of innovations (m, c, n_y) when starts and parameters were fitted to them."""
    m, n = len(structure.windows), structure.windows.n_x
    flat = slopes.reshape(m, -1, slopes.shape[-1])
    a, b = flat[..., :n], flat[..., n:]
    own = np.swapaxes(a, 1, 2) @ a + np.eye(n)
    root = np.linalg.inv(np.linalg.cholesky(own))
    thin = a @ np.swapaxes(root, 1, 2)
    free = b - thin @ (np.swapaxes(thin, 1, 2) @ b)
    prior = np.diag(objective.precisions * objective.scales**2)
    inner = np.einsum("mkf,mkg->fg", b, free) + prior
    inverse = np.linalg.pinv(inner, hermitian=True, rcond=1e-12)

    def left(z: FloatArray) -> FloatArray:
        v = z.reshape(m, -1)
        v = v - np.einsum("mkn,mn->mk", thin, np.einsum("mkn,mk->mn", thin, v))
        theta = inverse @ np.einsum("mkf,mk->f", free, z.reshape(m, -1))
        v = v - free @ theta
        return v.reshape(z.shape)

    return left


def _tail(value: float, drawn: FloatArray) -> float:
    """Probability of a statistic so large, by a gamma law with the mean and spread of the draws."""
    mean, variance = float(drawn.mean()), max(float(drawn.var(ddof=1)), 1e-12)
    return float(stats.gamma.sf(value, mean**2 / variance, scale=variance / mean))
