"""Effects that begin within the recordings, fitted and compared like all that act throughout.

Where in the recordings an effect begins is looked for by its trace (:mod:`trms_cli.gap.signatures`)
alone: with the windows before some moment left as they are it promises so many nats, and no fit is
made. What promises clearly more than throughout is fitted: the windows from one on with the effect,
those before without it, the model's parameters in common. The moment itself follows from the window
that it lies in, which is simulated without the effect up to some sample and with it from there on.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.gap.competing_model import FittedModel, ModelStructure
from trms_cli.gap.diagnosis import Onset
from trms_cli.gap.problem import CandidateEffect, is_amplitude
from trms_cli.gap.signatures import EffectTraces, projected_gain, whitened_part, window_products
from trms_cli.identification.greybox.windows import Residuals, Windows

#: s. Steps in which the moment is looked for.
_STEP = 0.1
#: A tail of a 95 % interval.
_TAIL = 0.025


class GatedWindows(Windows):
    """Windows in the first of which the effects do not act.

    ``whole``: the windows of a model with effects. ``effects``: all of these. ``begins``: number of
    the first window in which they act.
    """

    def __init__(self, whole: Windows, effects: tuple[CandidateEffect, ...], begins: int) -> None:
        self.__dict__.update(whole.__dict__)
        self.begins = begins
        names, free = whole.problem.model.parameters.names, whole.problem.names
        own = {effect.name: effect.effect.parameters() for effect in effects}
        self._vanishing = [
            names.index(f"{effect}.{size.name}")
            for effect, sizes in own.items()
            for i, size in enumerate(sizes)
            if is_amplitude(sizes, i)
        ]
        self._sizes = [k for k, name in enumerate(free) if name.split(".")[0] in own]

    def residuals(self, p: FloatArray, starts: FloatArray, *, slopes: bool = False) -> Residuals:
        """As of :class:`Windows`; slopes in the sizes are zero before the effects begin."""
        acting = super().residuals(p, starts, slopes=slopes)
        before = super().residuals(self.without(p), starts, slopes=slopes)
        late = np.arange(len(self)) >= self.begins

        def chosen(one: FloatArray, other: FloatArray) -> FloatArray:
            return np.where(late.reshape(-1, *[1] * (one.ndim - 1)), one, other)

        r, ends = chosen(acting.r, before.r), chosen(acting.ends, before.ends)
        if acting.j is None or before.j is None or acting.dends is None or before.dends is None:
            return Residuals(r, None, ends, None)
        columns = [self.n_x + k for k in self._sizes]
        before.j[..., columns] = before.dends[..., columns] = 0.0
        return Residuals(r, chosen(acting.j, before.j), ends, chosen(acting.dends, before.dends))

    def without(self, p: FloatArray) -> FloatArray:
        """All parameters with sizes at which the effects vanish, (n_p,) array."""
        found = p.copy()
        found[self._vanishing] = 0.0
        return found

    def joined(
        self, j: int, p: FloatArray, starts: FloatArray, samples: list[int]
    ) -> tuple[FloatArray, FloatArray]:
        """Window ``j`` if the effects begin at some of its samples.

        Residuals (k, c, n_y), and their slopes in the window's start (k, c, n_y, n_x).
        """
        first, count, n = int(self.first[j]), int(self.count[j]), self.n_x
        without = self.without(p)
        begin = self.with_memory(without, starts)[j : j + 1]
        y = np.zeros((len(samples), *self.target.shape[1:]))
        slopes = np.zeros((*y.shape, n))
        for k, sample in enumerate(samples):
            x, moved = begin, np.eye(begin.shape[1])[:, :n]
            for at, end, values in ((0, sample, without), (sample, count, p)):
                if end > at:
                    made = self.rollout.sensitivities(
                        self._commands, [first + at], [end - at], x, values
                    )
                    y[k, at:end] = made.y
                    slopes[k, at:end] = made.dy[..., : len(moved)] @ moved
                    x, moved = made.ends, made.dends[0, :, : len(moved)] @ moved
        seen = self.measured[j]
        return np.where(seen, y - self.target[j], 0.0), np.where(seen[..., None], slopes, 0.0)


def beginning_at(structure: ModelStructure, window: int) -> ModelStructure:
    """A structure whose effects act from a window on."""
    made = copy.copy(structure)
    made.windows = GatedWindows(structure.windows, structure.effects, window)
    return made


def begins_at(fitted: FittedModel) -> int | None:
    """The window that a fit's effects begin with; None: they act throughout."""
    windows = fitted.structure.windows
    return windows.begins if isinstance(windows, GatedWindows) else None


def promised_beginnings(fitted: FittedModel, traces: EffectTraces) -> FloatArray:
    """Nats that each trace promises if its effect begins with each window, (k, m) array.

    ``fitted``: the model without the effects. The first column is that of effects throughout.
    """
    n_f = len(fitted.fit.point)
    across, own, towards, parameters, prior = [], [], [], np.zeros((n_f, n_f)), np.zeros(n_f)
    for products in window_products(fitted, traces):
        parameters += products[:, :n_f, :n_f].sum(axis=0)
        prior += products[:, :n_f, -1].sum(axis=0)
        across.append(products[:, :n_f, n_f:-1])
        own.append(np.einsum("mii->mi", products[:, n_f:-1, n_f:-1]))
        towards.append(products[:, n_f:-1, -1])
    objective = fitted.objective
    root = objective.precisions * objective.scales
    parameters += np.diag(root * objective.scales)
    prior += root * (fitted.fit.point - objective.means)
    # sums over all windows from each on
    late = [np.cumsum(np.concatenate(v)[::-1], axis=0)[::-1] for v in (across, own, towards)]
    found = []
    for c, length, inner in zip(*late, strict=True):
        solved = np.linalg.solve(parameters, c)
        left = np.maximum(length - np.einsum("fk,fk->k", c, solved), 1e-12)
        found.append(projected_gain(left, -(inner - solved.T @ prior)))
    return np.array(found).T


def onset_of(fitted: FittedModel) -> Onset | None:
    """When the effects of a fit begin, of the windows about the first in which they act.

    Flat over the moment before the recordings. None where they act throughout.
    """
    windows = fitted.structure.windows
    if not isinstance(windows, GatedWindows):
        return None
    begins, step = windows.begins, windows.sample_time
    p = windows.problem.all_values(fitted.fit.theta)
    near = [j for j in (begins - 1, begins) if 0 <= j < len(windows)]
    if len(near) == 2 and not windows.follows[begins]:
        near = [begins]  # the window before is of another recording
    every = max(1, round(_STEP / step))
    drift = fitted.metric.drift.columns @ fitted.fit.gains
    times: list[float] = []
    by_window: dict[int, FloatArray] = {}
    for j in near:
        samples = [*range(0, int(windows.count[j]), every), int(windows.count[j])]
        r, slopes = windows.joined(j, p, fitted.fit.starts, samples)
        columns = np.concatenate([slopes * windows.spread, (r + drift[j])[..., None]], axis=-1)
        flat = np.moveaxis(columns, 0, -2).reshape(1, *r.shape[1:], -1)
        white = whitened_part(fitted.metric, slice(j, j + 1), flat)
        white = np.moveaxis(white.reshape(-1, len(samples), columns.shape[-1]), 1, 0)
        gap = (fitted.fit.starts[j] - fitted.objective.centres[j]) / windows.spread
        by_window[j] = _with_best_start(white, gap)
        times += [(int(windows.first[j]) + s) * step for s in samples]
    # while it begins in one window, the one before is without it, and the one after has it
    log = np.concatenate(
        [
            -by_window[j] - sum(by_window[i][-1 if i < j else 0] for i in near if i != j)
            for j in near
        ]
    )
    start = _beginning_of_recording(windows, begins) * step
    at, share = np.array(times) - start, np.exp(log - log.max())
    order = np.argsort(at, kind="stable")
    cumulated = np.cumsum(share[order]) / share.sum()
    low, high = (float(at[order][np.searchsorted(cumulated, q)]) for q in (_TAIL, 1 - _TAIL))
    best = float(at[int(np.argmax(log))])
    reach = every * step / 2
    return Onset(time_s=best, ci95=(min(low, best) - reach, max(high, best) + reach))


def _with_best_start(white: FloatArray, gap: FloatArray) -> FloatArray:
    """Half the least squares of each row of a window's innovations over its start, (k,) array.

    ``white``, (k, n, n_x + 1) array: slopes in the start, scaled by its spread, and innovations.
    ``gap``, (n_x,) array: of the start from its centre, scaled.
    """
    slopes, z = white[..., :-1], white[..., -1]
    inner = np.swapaxes(slopes, 1, 2) @ slopes + np.eye(len(gap))
    across = np.einsum("knx,kn->kx", slopes, z) + gap
    taken = np.einsum("kx,kx->k", across, np.linalg.solve(inner, across[..., None])[..., 0])
    return np.asarray(0.5 * ((z**2).sum(axis=1) + gap @ gap - taken))


def _beginning_of_recording(windows: Windows, window: int) -> int:
    """The first sample, of all recordings in a row, of the one that a window is of."""
    ends = np.cumsum([len(dataset) for dataset in windows.datasets])
    number = int(np.searchsorted(ends, windows.first[window], side="right"))
    return int(ends[number] - len(windows.datasets[number]))


def later_and_better(
    gains: FloatArray, names: tuple[str, ...], more: float, count: int
) -> Mapping[str, tuple[int, int]]:
    """Effects that promise more from some window on than anything does throughout.

    Parameters
    ----------
    gains : (k, m) array
        Of :func:`promised_beginnings`.
    names : tuple of str
        Of the effect of each row.
    more : float
        Nats by which.
    count : int
        Effects at most.

    Returns
    -------
    mapping
        By name, the most promising first: the row of its trace, and the window.
    """
    throughout = float(gains[:, 0].max(initial=0.0))
    found: dict[str, tuple[int, int]] = {}
    rows, windows = np.unravel_index(np.argsort(-gains, axis=None), gains.shape)
    for row, window in zip(rows.tolist(), windows.tolist(), strict=True):
        gain = float(gains[row, window])
        if gain < throughout + more or len(found) >= count:
            break
        if window:
            found.setdefault(names[row], (row, window))
    return found
