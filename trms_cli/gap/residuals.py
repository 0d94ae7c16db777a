"""What a refit leaves: whether there is a gap at all, and where it lies.

Tests of the innovations say whether there is a gap. Under the hypothesis that nothing but the usual
error of the equations is left, innovations in that metric are white, have unit variance and know
nothing of the inputs. Sensors round, and fitting takes something out, so that textbook limits are
wrong in both directions: every statistic is compared with its distribution over recordings that are
drawn (a parametric bootstrap): the linearised model moves about the recording with noise on its
equations, its sensors round as the real ones do, and what a fit would have taken is taken out.

No model is exact, and with enough samples any error is significant. So the question is not whether
there is one, but whether it is larger than errors of usual size by a margin (a test of
non-inferiority; Wellek, Testing Statistical Hypotheses of Equivalence and Noninferiority, 2010):
innovations :data:`POWER` times as strong, and correlations of :data:`CORRELATION` in the mean over
the lags, count as usual. A statistic is rejected that is too large even for those. p-values are
corrected by Holm (1979).

One generalised disturbance at a time on every equation and sensor says where. Each place in turn
may err as much as is most likely, all others only as much as those of rigs without a gap; the share
of the likelihood that a place gains, of what all of them together gain, is its share of the gap.
Places that move the same equation alike (a drive and its motor, a thrust and the moment that it
makes) have one disturbance; which of them it is follows from the causes.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from trms_cli.core.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from trms_cli.gap.competing_model import FittedModel, InnovationObjective, Metric, ModelStructure
from trms_cli.gap.diagnosis import GapTest
from trms_cli.gap.discrepancy import (
    Discrepancy,
    equation_channels,
    likely_shares,
    log_likelihood,
    sensor_channels,
)
from trms_cli.gap.force.laws import ForceRecord
from trms_cli.gap.problem import quantum_of
from trms_cli.identification.validation.residual_tests import holm
from trms_cli.models.model import Model, names
from trms_cli.models.rig_parts import parts_of

#: s. Longest lag of the tests, and samples at least and at most.
_LONGEST_LAG, _FEWEST_LAGS, _MOST_LAGS = 0.5, 4, 25
_LEVEL = 0.05
_BANDS = 4
#: Margins: the power of innovations over that of usual ones, and their correlations.
POWER, CORRELATION = 1.25, 0.05
_OF_POWER = ("variance", "bands")


def innovation_tests(fitted: FittedModel, *, draws: int = 40, seed: int = 0) -> tuple[GapTest, ...]:
    """Test every measured channel.

    ``fitted``: in a metric of the discrepancies that rigs without a gap have. ``draws``: how many.
    """
    structure, fit, metric = fitted.structure, fitted.fit, fitted.metric
    objective = fitted.objective
    _, _, residuals = objective.parabola(fit.point, fit.starts)
    columns = objective.columns(residuals)
    measured = structure.windows.measured
    z = np.where(measured, np.clip(columns[..., -1], -6, 6), 0.0)
    take = _fit_projection(columns[..., :-1], structure, objective)
    random = np.random.default_rng(np.random.SeedSequence([seed, 0x6A9]))
    commands = structure.windows.commands
    statistics = _statistics(z, measured, commands, structure.windows.sample_time)
    bootstrap: dict[tuple[str, int], list[float]] = {key: [] for key in statistics}
    target = structure.windows.target
    units = [signal.unit for signal in structure.problem.model.outputs]
    quanta = np.array([quantum_of(target[..., i], unit) for i, unit in enumerate(units)])
    for bootstrap_residual in _bootstrap_residuals(metric, quanta, draws, random):
        white = np.clip(metric.whitened(bootstrap_residual[..., None])[..., 0], -6, 6)
        innovations = np.where(measured, take(np.where(measured, white, 0.0)), 0.0)
        again = _statistics(innovations, measured, commands, structure.windows.sample_time)
        for key, value in again.items():
            bootstrap[key].append(value)
    outputs = names(structure.problem.model.outputs)
    keys = list(statistics)
    counts = measured.sum(axis=(0, 1))
    lags = _lags(z.shape[1], structure.windows.sample_time)
    lag_counts = {"whiteness": lags, "squares": lags, "inputs": (lags + 1) * commands.shape[2]}
    p = np.array(
        [
            _tail(
                statistics[name, i],
                np.array(bootstrap[name, i]),
                times=POWER if name in _OF_POWER else 1.0,
                beyond=CORRELATION**2 * counts[i] * lag_counts.get(name, 0),
            )
            for name, i in keys
        ]
    )
    corrected_p = holm(p)
    return tuple(
        GapTest(
            name=name,
            channel=outputs[i],
            statistic=statistics[name, i],
            p_value=float(p[k]),
            p_corrected=float(corrected_p[k]),
            rejected=bool(corrected_p[k] < _LEVEL),
            margin=POWER if name in _OF_POWER else CORRELATION,
        )
        for k, (name, i) in enumerate(keys)
    )


def _bootstrap_residuals(
    metric: Metric, quanta: FloatArray, draws: int, random: np.random.Generator
) -> Iterator[FloatArray]:
    """Residuals (m, c, n_y) of rigs that move about the recording as the metric says."""
    discrepancy = metric.discrepancy
    system, trajectory = discrepancy.system, discrepancy.trajectory
    m, c, _, n = system.h.shape
    sizes = metric.shares
    spread = sizes * np.sqrt(1 - discrepancy.autocorrelation**2)
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
    rounded_outputs = np.where(quanta[:, None] > 0, coarse * np.round(y / coarse), y)
    drift = metric.drift.sd(metric.drift_sizes)
    for k in range(draws):
        drift_outputs = metric.drift.columns @ (drift * random.standard_normal(len(drift)))
        yield rounded_outputs[..., k] - trajectory.y + drift_outputs


def _statistics(
    z: FloatArray, measured: BoolArray, commands: FloatArray, sample_time: float
) -> dict[tuple[str, int], float]:
    """All statistics by name and output; large ones speak against the model."""
    lags = _lags(z.shape[1], sample_time)
    size = 2 ** int(np.ceil(np.log2(z.shape[1] + lags + 1)))
    u = commands - commands.mean(axis=1, keepdims=True)
    spectrum_u = np.fft.rfft(u, size, axis=1)
    power_u = np.maximum(np.mean(u**2, axis=(0, 1)), 1e-12)
    statistics: dict[tuple[str, int], float] = {}
    for i in range(z.shape[2]):
        count = int(measured[..., i].sum())
        if count < 10 * lags:
            continue
        e = z[..., i]
        power = float(np.sum(e**2) / count)
        spectrum = np.fft.rfft(e, size, axis=1)
        statistics["variance", i] = power
        statistics["whiteness", i] = _portmanteau(spectrum, spectrum, lags, count, power**2)
        squares = np.where(measured[..., i], e**2 - power, 0.0)
        spread = max(float(np.sum(squares**2) / count), 1e-12)
        of_squares = np.fft.rfft(squares, size, axis=1)
        statistics["squares", i] = _portmanteau(of_squares, of_squares, lags, count, spread**2)
        statistics["inputs", i] = math.fsum(
            _portmanteau(spectrum, spectrum_u[..., k], lags, count, power * power_u[k], zero=True)
            for k in range(u.shape[2])
        )
        density = np.sum(np.abs(np.fft.rfft(e, axis=1)) ** 2, axis=0)[1:]
        bands = np.array([b.mean() for b in np.array_split(density, _BANDS)])
        statistics["bands", i] = float(np.max(bands) / np.mean(density))
    return statistics


def _lags(samples: int, sample_time: float) -> int:
    """How many lags are looked at in blocks of so many samples."""
    lags = int(np.clip(round(_LONGEST_LAG / sample_time), _FEWEST_LAGS, _MOST_LAGS))
    return min(lags, samples // 3)


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
    first = 0 if zero else 1
    products = np.fft.irfft(one * np.conj(other), axis=1)[:, : lags + 1].sum(axis=0)
    correlations = products[first:] / count
    return float(count * np.sum(correlations**2) / max(scale, 1e-300))


def _fit_projection(
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

    def remainder(z: FloatArray) -> FloatArray:
        v = z.reshape(m, -1)
        v = v - np.einsum("mkn,mn->mk", thin, np.einsum("mkn,mk->mn", thin, v))
        theta = inverse @ np.einsum("mkf,mk->f", free, z.reshape(m, -1))
        v = v - free @ theta
        return v.reshape(z.shape)

    return remainder


def _tail(value: float, draws: FloatArray, times: float, beyond: float) -> float:
    """Probability of a statistic so large, by a gamma law with the mean and spread of the draws.

    ``times``, ``beyond``: the margin, by which a statistic is larger than the draws and still of
    usual size: a factor, and what is added to a sum of squares (its spread grows as that of a
    noncentral chi-squared variable).
    """
    from scipy.special import gammaincc  # scipy.stats takes half a second to import

    mean, variance = float(draws.mean()), max(float(draws.var(ddof=1)), 1e-12)
    variance = times**2 * variance + 2 * beyond * variance / max(mean, 1e-12)
    mean = times * mean + beyond
    return float(gammaincc(mean**2 / variance, max(value, 0.0) * mean / variance))


#: A sensor of a rig without a gap errs by this share of what it reads.
_SENSOR_FLOOR = 1e-4
#: Size at which the search for a disturbance begins, and how often it is improved.
_FIRST, _FIRST_OF_SENSORS, _ITERATIONS = 0.1, 0.01, 4


@dataclass(frozen=True)
class Location:
    """What each place closes of the gap."""

    locations: tuple[str, ...]
    gains: FloatArray  #: (k, m) array; nats by which each place raises the likelihood of each block
    together: FloatArray  #: (m,) array; the same of all places
    sizes: FloatArray  #: (k,) array; of each place's disturbance alone, over what acts there

    def share(self, blocks: IntArray | None = None) -> dict[str, float]:
        """Share of the gap by place, from some blocks (with repetition); None: from all."""
        selection = slice(None) if blocks is None else blocks
        total = max(float(self.together[selection].sum()), 1e-9)
        gains = np.clip(self.gains[:, selection].sum(axis=1) / total, 0.0, 1.0)
        return dict(zip(self.locations, gains.tolist(), strict=True))


def locate(nominal: FittedModel, usual: Mapping[str, float]) -> Location:
    """Try every equation and every measured sensor.

    ``usual``: share by which each equation errs on rigs without a gap.
    """
    model, windows = nominal.structure.problem.model, nominal.structure.windows
    channels = (*equation_channels(model), *sensor_channels(model, windows.measured))
    every = replace(nominal.metric.discrepancy, channels=channels)
    sensors = np.array([channel.kind == "output" for channel in channels])
    equations = [usual.get(channel.location, 0.03) for channel in channels]
    floor = np.where(sensors, _SENSOR_FLOOR, equations)
    begins = np.maximum(floor, np.where(sensors, _FIRST_OF_SENSORS, _FIRST))
    r = nominal.residuals
    none = log_likelihood(every, r, floor)
    gains, shares = [], []
    for i in range(len(channels)):
        moving = np.arange(len(channels)) == i
        first = np.where(moving, begins, floor)
        estimate = likely_shares(
            every, r, first, moving=moving, iterations=_ITERATIONS, least=floor
        )
        gains.append(log_likelihood(every, r, estimate) - none)
        shares.append(estimate[i])
    start = np.maximum(floor, 0.7 * np.array(shares))
    both = likely_shares(every, r, start, iterations=_ITERATIONS, least=floor)
    together = log_likelihood(every, r, both) - none
    return Location(
        tuple(c.location for c in channels), np.array(gains), together, np.array(shares)
    )


def smoothed_forces(refit: FittedModel, entry: FittedModel) -> dict[str, ForceRecord]:
    """The force that each nominal equation lacks beside a fit, read by a smoother from the rest.

    In the nominal model's states, along the motion of the refit, with its discrepancy's sizes.
    """
    structure, along = entry.structure, refit.metric.discrepancy
    model, windows = structure.problem.model, structure.windows
    discrepancy = Discrepancy(refit.structure.windows, along.trajectory, along.channels)
    x, variance = discrepancy.smoothed(refit.metric.shares, entry.residuals)
    n = discrepancy.trajectory.x.shape[-1]
    inside = windows.inside
    states = discrepancy.trajectory.x[..., : model.n_x]
    # as recorded: what is fitted of a recording may begin within it
    recorded_time = np.concatenate([d.time for d in structure.problem.datasets])
    sample = windows.first[:, None] + np.arange(inside.shape[1])
    time = recorded_time[np.minimum(sample, len(recorded_time) - 1)]
    motion = _motion(model, states, windows.commands, windows.sample_time)
    records = {}
    for i, channel in enumerate(discrepancy.channels):
        if channel.kind != "disturbance":
            continue
        records[channel.location] = ForceRecord(
            location=channel.location,
            unit=channel.unit,
            time=time[inside],
            recording=np.broadcast_to(windows.recording[:, None], inside.shape)[inside],
            force=x[..., n + i][inside],
            sd=np.sqrt(variance[..., n + i][inside]),
            parts=parts_of(model),
            **{kind: {k: v[inside] for k, v in group.items()} for kind, group in motion.items()},
        )
    return records


def _motion(
    model: Model, states: FloatArray, commands: FloatArray, sample_time: float
) -> dict[str, dict[str, FloatArray]]:
    """Angles, rates, speeds and commands by the names that a force record has."""
    angles, rates = {}, {}
    for name, axis in model.axes.items():
        angles[name] = states[..., model.state_index(axis.angle)]
        rates[name] = np.gradient(angles[name], sample_time, axis=1)
    inputs = names(model.inputs)
    speeds = {
        rotor: states[..., model.state_index(speed)] for rotor, speed in model.rotor_speeds.items()
    }
    drives = parts_of(model).drives
    by_drive = {name: commands[..., inputs.index(own)] for name, own in drives.items()}
    return {"angles": angles, "rates": rates, "speeds": speeds, "commands": by_drive}
