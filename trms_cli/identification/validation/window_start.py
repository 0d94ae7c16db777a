"""The state at the start of a free run, from a stretch of the recording.

Gauss–Newton with exact sensitivities fits the state at the beginning of the stretch,

    min over x₀  Σ_k |(y_k − ŷ_k(x₀))/σ|² + |(x₀ − x̂)/s|²

by Levenberg–Marquardt, all stretches at once. The prior (x̂ from the filter, s wide) only settles
what the measurements leave open. Where the stretch lies *before* a window, the model's state at its
end is the window's start: nothing of the window has been seen.
"""

from __future__ import annotations

import numpy as np

from trms_cli.identification.dataset import Dataset, FloatArray, IntArray
from trms_cli.models.model import Model, index_of
from trms_cli.models.state_kinds import kinds_of_states
from trms_cli.observers.augmentation import InitialSd
from trms_cli.simulation.rollout import Rollout

_ITERATIONS = 12
_FIRST_DAMPING = 1e-3
_GOOD_ENOUGH = 1e-4  # relative fall of the cost


def fitted_starts(
    model: Model,
    rollout: Rollout,
    dataset: Dataset,
    first: IntArray,
    count: IntArray,
    prior: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Fit the states at the beginnings of stretches.

    Parameters
    ----------
    first, count : (m,) arrays of int
        First sample and number of samples of each stretch.
    prior : (m, n_x) array
        States (without memory) around which the start is sought.

    Returns
    -------
    starts, ends : (m, rollout.n_x) arrays
        States at the first sample, and one sample after the last; with memory.
    """
    columns = [index_of(model.outputs, s.name, "an output") for s in dataset.outputs]
    prior_sd = _prior_sd(model)
    samples = np.concatenate([np.arange(a, a + c) for a, c in zip(first, count, strict=True)])
    window = np.repeat(np.arange(len(first)), count)
    measured = dataset.measurements[samples]
    n = model.n_x
    x = with_memory(rollout, dataset, first, prior)
    sd = dataset.noise_sd

    def residuals(y: FloatArray) -> FloatArray:
        weighted = (measured - y[:, columns]) / sd
        return np.where(np.isnan(measured), 0.0, weighted)

    def costs(r: FloatArray, at: FloatArray) -> FloatArray:
        # A start that makes the model overflow costs more than anything.
        with np.errstate(all="ignore"):
            of_data = np.bincount(window, np.sum(r**2, axis=1), len(first))
            total = of_data + np.sum(((at[:, :n] - prior) / prior_sd) ** 2, axis=1)
        return np.where(np.isfinite(total), total, np.inf)

    damping = np.full(len(first), _FIRST_DAMPING)
    now = rollout.sensitivities(dataset.commands, first, count, x)
    r, ends = residuals(now.y), now.ends
    cost = costs(r, x)
    for _ in range(_ITERATIONS):
        slope = now.dy[:, columns, :n] / sd[None, :, None]
        slope = np.where(np.isnan(measured)[:, :, None], 0.0, slope)
        slope = np.where(np.isfinite(slope), slope, 0.0)
        normal = _by_window(np.einsum("kci,kcj->kij", slope, slope), window, len(first))
        right = _by_window(
            np.einsum("kci,kc->ki", slope, np.where(np.isfinite(r), r, 0.0)), window, len(first)
        )
        normal += np.diag(prior_sd**-2.0)
        right += (prior - x[:, :n]) / prior_sd**2
        diagonal = np.einsum("jii->ji", normal)
        damped = normal + damping[:, None, None] * np.einsum("ji,ik->jik", diagonal, np.eye(n))
        trial = x.copy()
        trial[:, :n] += np.linalg.solve(damped, right[:, :, None])[:, :, 0]
        after = rollout.sensitivities(dataset.commands, first, count, trial)
        r_after = residuals(after.y)
        cost_after = costs(r_after, trial)
        better = cost_after < cost
        gained = np.where(better, (cost - cost_after) / np.maximum(cost, 1e-300), 0.0)
        rows = better[window]
        x[better], ends[better], cost[better] = (
            trial[better],
            after.ends[better],
            cost_after[better],
        )
        r[rows] = r_after[rows]
        now.dy[rows] = after.dy[rows]
        damping = np.where(better, damping / 10, damping * 10)
        if np.all((gained < _GOOD_ENOUGH) & (better | (damping > 1e2))):
            break
    return x, ends


def _by_window(values: FloatArray, window: IntArray, m: int) -> FloatArray:
    """Sums over the rows of each window; rows of a window lie together."""
    edges = np.searchsorted(window, np.arange(m))
    return np.asarray(np.add.reduceat(values, edges, axis=0))


def with_memory(
    rollout: Rollout, dataset: Dataset, first: IntArray, states: FloatArray
) -> FloatArray:
    """States completed by what the input path remembers, which follows from the commands alone.

    Parameters
    ----------
    first : (m,) array of int
        Samples of the states.
    states : (m, n_x) array
        The model's own.
    """
    n = rollout.model.n_x
    full = np.empty((len(first), rollout.n_x))
    full[:, :n] = states
    if rollout.n_x == n:
        return full
    rest = rollout.model.rest()
    x, at = rollout.initial(rest, dataset.commands[0]), 0
    for j in np.argsort(first, kind="stable"):
        if first[j] > at:
            between = [at], [int(first[j]) - at]
            x[n:] = rollout.outputs(dataset.commands, *between, x[None]).ends[0, n:]
            x[:n], at = rest, int(first[j])
        full[j, n:] = x[n:]
    return full


def _prior_sd(model: Model) -> FloatArray:
    """Wide: what the house's observer believes before the first measurement."""
    table = InitialSd()
    return np.array([getattr(table, kind) for kind in kinds_of_states(model)])
