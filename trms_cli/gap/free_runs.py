"""The gap as it is told: errors of free runs, from starts that know the past only.

A free run begins every `stride` seconds of a span. Its start is the end of the model's own best run
over the :data:`HISTORY` before it, fitted to the measurements there and to nothing later; what such
a short run leaves open (a rotor without tacho, a slow memory) is simulated from the beginning of
the recording. So every model is measured alike, with friction, delays or modes of its own, with
two angles or with rotor speeds. A longer history would know rates better where the model is right,
and would bend them where it is wrong, by half of the history times what the acceleration lacks.

Errors stay apart by start, with the block that a start lies in, so that blocks can be resampled.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.gap.problem import HORIZONS
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.free_runs import StartSearch, fitted_starts, simulated_windows
from trms_cli.identification.greybox.windows import StartEstimator, spreads
from trms_cli.models.model import Model, names
from trms_cli.models.scales import longest_run
from trms_cli.simulation.rollout import Rollout

#: s before a start that it is fitted to, and samples at least.
HISTORY = 0.3
_FEWEST = 8
#: s between the samples at which a simulation from the beginning is put right by measurements.
_ANCHORED = 1.0
#: Thousands of starts need no more care than their errors show.
_START_SEARCH = StartSearch(iterations=10, enough=1e-3, least_cost=1.0, most_damping=1.0)

#: Number of a dataset, first sample, and the sample after the last.
Span = tuple[int, int, int]


@dataclass(frozen=True)
class HorizonErrors:
    """Free runs of one channel at one horizon."""

    #: (m,) array; mean squared error of each run, in its unit squared; infinite if it ran away
    squared: FloatArray
    block: IntArray  #: (m,) array of int; block that the run begins in, counted through all spans

    @property
    def rms(self) -> float:
        """Over all runs."""
        return float(np.sqrt(np.mean(self.squared)))


#: Free runs by channel, then by horizon in s.
Errors = Mapping[str, Mapping[float, HorizonErrors]]


def free_run_errors(
    model: Model,
    datasets: Sequence[Dataset],
    parts: Sequence[Span],
    *,
    horizons: Sequence[float] = HORIZONS,
    stride: float = 0.5,
    block: float = 10.0,
    rollout: Rollout | None = None,
    jobs: int = 1,
) -> dict[str, dict[float, HorizonErrors]]:
    """Errors of free runs that lie within spans of recordings, by channel, then by horizon.

    ``datasets``: whole recordings of one sample time, for a start may know what was before its
    span. ``horizons``: s; one that no span holds is left out. ``stride``, ``block``: s, between two
    starts, and of the blocks. ``rollout``: of the same model at the recordings' sample time, if
    there is one already; the values of parameters are ``model``'s. ``jobs``: threads.
    """
    step = datasets[0].sample_time
    rollout = rollout or Rollout(model, step, jobs=jobs)
    errors: list[tuple[str, float, HorizonErrors]] = []
    blocks = 0
    for number, spans in groupby(sorted(parts), key=lambda part: part[0]):
        dataset = datasets[number]
        firsts, owners = [], []
        for _, first, last in spans:
            every, block_of = _firsts(dataset, first, last, (stride, block, min(horizons)))
            firsts.append(np.stack([every, np.full(len(every), last)]))
            owners.append(block_of + blocks)
            blocks += int(block_of.max(initial=-1)) + 1
        (begins, limits), block_of = np.hstack(firsts), np.concatenate(owners)
        if not begins.size:
            continue
        starts = start_states(model, rollout, dataset, begins)
        for horizon in horizons:
            samples = max(1, round(horizon / step))
            inside = begins + samples <= limits
            if not inside.any():
                continue
            squares = _mean_squared_errors(
                model, rollout, dataset, begins[inside], samples, starts[inside]
            )
            for name, column in zip(names(dataset.outputs), squares.T, strict=True):
                is_measured = ~np.isnan(column)
                if not is_measured.any():  # a sensor that died before
                    continue
                own = HorizonErrors(column[is_measured], block_of[inside][is_measured])
                errors.append((name, horizon, own))
    return joined_errors(errors)


def start_states(model: Model, rollout: Rollout, dataset: Dataset, first: IntArray) -> FloatArray:
    """States, memory included, at samples of a recording, from what was measured before them.

    ``first``, (m,) array of int: ascending, each at least :func:`history` samples into the
    recording. Returns (m, rollout.n_x) array.
    """
    samples = history(dataset.sample_time)
    begin = first - samples
    # From the beginning of the recording step by step, so that slow memories follow the rig.
    anchors = np.arange(0, begin[-1], max(1, round(_ANCHORED / dataset.sample_time)))
    # a start stands in for an anchor that it follows within a few samples
    after = np.minimum(np.searchsorted(begin, anchors), len(begin) - 1)
    far = np.abs(begin[after] - anchors) > 2 * samples
    stops = np.unique(np.concatenate([anchors[far], begin]))
    p = model.parameters.values
    guess = StartEstimator(rollout, dataset, stops).at(p).states[np.searchsorted(stops, begin)]
    prior_sd = _prior_sd(model, dataset.sample_time)
    return fitted_starts(
        rollout, dataset, begin, samples, guess, prior_sd, search=_START_SEARCH, p=p
    )[1]


def history(sample_time: float) -> int:
    """Samples before a start that it is fitted to."""
    return max(_FEWEST, round(HISTORY / sample_time))


def expected_errors(
    model: Model,
    datasets: Sequence[Dataset],
    parts: Sequence[Span],
    *,
    seed: int = 0,
    rollout: Rollout | None = None,
    jobs: int = 1,
    **options: Any,
) -> dict[str, dict[float, HorizonErrors]]:
    """Errors that a right model would have: the model against its own simulation.

    The floor of :func:`free_run_errors` at longer horizons, where the noise on the start has
    grown through the model: the recordings' measurements are replaced by a simulation of the
    model on their commands with the declared white noise.

    ``seed``: of the noise. ``options``: as there.
    """
    rollout = rollout or Rollout(model, datasets[0].sample_time, jobs=jobs)
    random = np.random.default_rng(np.random.SeedSequence([seed, 0xF100]))
    p, simulations = model.parameters.values, []
    step, longest = datasets[0].sample_time, longest_run(model)
    if np.isfinite(longest):  # what falls over is simulated piece by piece, a run in each
        before = history(step)
        samples = before + round(max(options.get("horizons", HORIZONS)) / step)
        parts = [
            (number, begin + before, begin + samples)
            for number, first, last in parts
            for begin in range(max(first - before, 0), last - samples + 1, samples)
        ]
    for number, dataset in enumerate(datasets):
        begins, length = np.zeros(1, dtype=np.int64), len(dataset)
        if np.isfinite(longest):
            begins, length = np.array([b - before for n, b, _ in parts if n == number]), samples
        start = StartEstimator(rollout, dataset, begins).at(p).states
        y = dataset.measurements.copy()
        for begin, piece in zip(
            begins, simulated_windows(rollout, dataset, begins, length, start, p), strict=True
        ):
            y[begin : begin + length] = piece
        noisy = y + dataset.noise_sd * random.standard_normal(y.shape)
        noisy[np.isnan(dataset.measurements)] = np.nan
        simulations.append(replace(dataset, measurements=noisy))
    return free_run_errors(model, simulations, parts, rollout=rollout, **options)


def _firsts(
    dataset: Dataset, first: int, last: int, times: tuple[float, float, float]
) -> tuple[IntArray, IntArray]:
    """Samples at which runs begin in a span, and the block of each within the span."""
    stride, block, shortest = (max(1, round(t / dataset.sample_time)) for t in times)
    begin = max(first, history(dataset.sample_time))
    every = np.arange(begin, last - shortest + 1, stride, dtype=np.int64)
    # What is left over at the end of a span belongs to its last whole block.
    whole = max(1, (last - first) // block)
    of_block = np.minimum((every - first) // block, whole - 1)
    return every, of_block.astype(np.int64)


def _mean_squared_errors(
    model: Model,
    rollout: Rollout,
    dataset: Dataset,
    first: IntArray,
    samples: int,
    starts: FloatArray,
) -> FloatArray:
    """Mean squared errors, (m, n_y); NaN where nothing was measured."""
    measurements = dataset.measurements[first[:, None] + np.arange(samples)]
    present = ~np.isnan(measurements)
    y = simulated_windows(rollout, dataset, first, samples, starts, model.parameters.values)
    with np.errstate(all="ignore"):
        squares = (measurements - y) ** 2
        squares = np.where(np.isfinite(squares), squares, np.inf)
        total = np.sum(np.where(present, squares, 0.0), axis=1)
        mean: FloatArray = total / present.sum(axis=1)
    return np.where(present.any(axis=1), mean, np.nan)


def joined_errors(
    parts: Iterable[tuple[str, float, HorizonErrors]],
) -> dict[str, dict[float, HorizonErrors]]:
    """By channel and horizon, of parts with these."""
    joined: dict[str, dict[float, HorizonErrors]] = {}
    for name, horizon, own in parts:
        of_channel = joined.setdefault(name, {})
        if (before := of_channel.get(horizon)) is not None:
            squared = np.concatenate([before.squared, own.squared])
            own = HorizonErrors(squared, np.concatenate([before.block, own.block]))
        of_channel[horizon] = own
    return joined


def _prior_sd(model: Model, step: float) -> FloatArray:
    """How far a state may lie from its first guess; one that noise drives, as far as it strays."""
    sd = spreads(model)
    if model.sample_time is not None:
        return sd
    x, u, p, w = model.symbols()
    rate = ca.diag(ca.jacobian(model.dynamics(x, u, p, w), x))
    of_states = ca.Function("strays", [x, u, p, w], [rate, model.noise_sd(p, step)])
    at = (model.rest(), np.zeros(model.n_u), model.parameters.values, np.zeros(model.n_w))
    rates, noise_sd = (np.array(ca.DM(v).full()).ravel() for v in of_states(*at))
    squared_pole = np.exp(2 * step * np.minimum(rates, -1e-3))
    return np.where(noise_sd > 0, noise_sd / np.sqrt(1 - squared_pole), sd)
