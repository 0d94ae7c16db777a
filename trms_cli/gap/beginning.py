"""Effects that begin within the recordings, fitted and compared like all that act throughout.

Where in the recordings an effect begins is looked for by its trace (:mod:`trms_cli.gap.signatures`)
alone: with the windows before some moment left as they are it promises so many nats, and no fit is
made. What promises clearly more than throughout is fitted: the windows from one on with the effect,
those before without it, the model's parameters in common. The moment itself follows from the window
that it lies in, which is simulated without the effect up to some sample and with it from there on.
An error of a sensor that sets in at once, as of an encoder that slips, shows as a jump within one
window, where it is looked for at every moment.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.gap.competing_model import FittedModel, Metric, ModelStructure
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

    ``whole``: the windows of a model with effects. ``effects``: all of these. ``begins``,
    ``sample``: number of the window, and of the sample in it, from which on they act.
    """

    def __init__(
        self, whole: Windows, effects: tuple[CandidateEffect, ...], begins: int, sample: int = 0
    ) -> None:
        self.__dict__.update(whole.__dict__)
        self.begins, self.sample = begins, sample
        names, free = whole.problem.model.parameters.names, whole.problem.names
        own = {effect.name: effect.effect.parameters() for effect in effects}
        self._vanishing = [
            names.index(f"{effect}.{size.name}")
            for effect, sizes in own.items()
            for i, size in enumerate(sizes)
            if is_amplitude(sizes, i)
        ]
        self._sizes = [self.n_x + k for k, name in enumerate(free) if name.split(".")[0] in own]

    def residuals(self, p: FloatArray, starts: FloatArray, *, slopes: bool = False) -> Residuals:
        """As of :class:`Windows`; slopes in the sizes are zero before the effects begin.

        The end of the window that they begin in is that with them throughout.
        """
        acting = super().residuals(p, starts, slopes=slopes)
        before = super().residuals(self.without(p), starts, slopes=slopes)
        late = np.arange(len(self)) >= self.begins

        def gate(one: FloatArray, other: FloatArray) -> FloatArray:
            return np.where(late.reshape(-1, *[1] * (one.ndim - 1)), one, other)

        r, ends = gate(acting.r, before.r), gate(acting.ends, before.ends)
        j = dends = None
        if before.j is not None and before.dends is not None:
            assert acting.j is not None and acting.dends is not None
            before.j[..., self._sizes] = before.dends[..., self._sizes] = 0.0
            j, dends = gate(acting.j, before.j), gate(acting.dends, before.dends)
        if self.sample:
            own, slope = self.joined_to_beginning(self.begins, p, starts, [self.sample])
            r[self.begins] = own[0]
            if j is not None:
                j[self.begins] = slope[0]
        return Residuals(r, j, ends, dends)

    def without(self, p: FloatArray) -> FloatArray:
        """All parameters with sizes at which the effects vanish, (n_p,) array."""
        parameters = p.copy()
        parameters[self._vanishing] = 0.0
        return parameters

    def joined_to_beginning(
        self, j: int, p: FloatArray, starts: FloatArray, samples: list[int]
    ) -> tuple[FloatArray, FloatArray]:
        """Window ``j`` if the effects begin at some of its samples.

        Residuals (k, c, n_y), and their slopes in the window's start and in all that is free
        (k, c, n_y, n_x + n_f). What is remembered of the commands before is taken as it is.
        """
        first, count, n = int(self.first[j]), int(self.count[j]), self.n_x
        without = self.without(p)
        begin = self.with_memory(without, starts)[j : j + 1]
        n_all, wide = begin.shape[1], n + len(self.rollout.free)
        y = np.zeros((len(samples), *self.target.shape[1:]))
        slopes = np.zeros((*y.shape, wide))
        for k, sample in enumerate(samples):
            x, transition = begin, np.eye(n_all, wide)
            transition[:, n:] = 0.0
            for at, end, values in ((0, sample, without), (sample, count, p)):
                if end <= at:
                    continue
                sensitivities = self.rollout.sensitivities(
                    self._commands, [first + at], [end - at], x, values
                )
                direct, after = sensitivities.dy[..., n_all:], sensitivities.dends[0, :, n_all:]
                if values is without:
                    own = [i - n for i in self._sizes]
                    direct[..., own] = after[..., own] = 0.0
                y[k, at:end] = sensitivities.y
                slopes[k, at:end] = sensitivities.dy[..., :n_all] @ transition
                slopes[k, at:end, :, n:] += direct
                x, transition = sensitivities.ends, sensitivities.dends[0, :, :n_all] @ transition
                transition[:, n:] += after
        mask = self.measured[j]
        return np.where(mask, y - self.target[j], 0.0), np.where(mask[..., None], slopes, 0.0)


def beginning_at(structure: ModelStructure, window: int, sample: int = 0) -> ModelStructure:
    """A structure whose effects act from a sample of a window on."""
    gated_structure = copy.copy(structure)
    gated_structure.windows = GatedWindows(structure.windows, structure.effects, window, sample)
    return gated_structure


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
    for products, _ in window_products(fitted, traces):
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
    gains = []
    for c, length, inner in zip(*late, strict=True):
        coefficients = np.linalg.solve(parameters, c)
        residual_squares = np.maximum(length - np.einsum("fk,fk->k", c, coefficients), 1e-12)
        gains.append(projected_gain(residual_squares, -(inner - coefficients.T @ prior)))
    return np.array(gains).T


#: Largest discrepancy of an equation while jumps are looked for, as a share of what acts there: it
#: is estimated large where a jump is taken for a blow. Share of what its window lacks more than
#: others do that a jump has to explain, and nats that it has to.
_CALM, _OF_WINDOW, _LEAST_JUMP = 0.03, 0.5, 30.0
#: Samples that are tried at a time.
_AT_ONCE = 128


class Jump(NamedTuple):
    """A sensor's error that sets in at once, as its trace promises it."""

    row: int  #: Of the trace
    window: int
    sample: int  #: Of the window
    factor: float  #: By which the trace's change is to be taken
    nats: float


def promised_jumps(fitted: FittedModel, traces: EffectTraces) -> dict[str, Jump]:
    """The most promising jump of each effect that shifts a reading once and for all, by name.

    Such an effect shows in the one window in which it begins, and hardly in those after, which
    begin where the sensor says. ``fitted``: the model without the effects.
    """
    calm, windows = calm_metric(fitted.metric), fitted.structure.windows
    residuals = fitted.objective.simulated(fitted.fit.point, fitted.fit.starts, slopes=True)
    assert residuals.j is not None
    slopes = residuals.j[..., : windows.n_x] * windows.spread
    gaps = (fitted.fit.starts - fitted.objective.centres) / windows.spread
    jumps: dict[str, list[tuple[Jump, float]]] = {}
    for row in _shifts(traces, windows):
        change = traces.changes[row]
        for j, count in enumerate(windows.count):
            for first in range(1, int(count), _AT_ONCE):
                samples = np.arange(first, min(first + _AT_ONCE, int(count)))
                after = np.arange(change.shape[1])[:, None] >= samples
                steps = change[j][..., None] * after[:, None]
                columns = np.concatenate([slopes[j], residuals.r[j][..., None], steps], axis=-1)
                white = whitened_part(calm, slice(j, j + 1), columns[None])[0]
                residual_squares, towards, misfit = _beside_start(white, gaps[j])
                gain = 0.5 * towards**2 / residual_squares
                best = int(np.argmax(gain))
                factor = float(towards[best] / residual_squares[best])
                jump = Jump(row, j, int(samples[best]), factor, float(gain[best]))
                jumps.setdefault(traces.names[row], []).append((jump, misfit))
    best_jumps = {}
    for name, each in jumps.items():
        jump, misfit = max(each, key=lambda item: item[0].nats)
        usual = float(np.median([other for _, other in each]))
        if jump.nats > max(_LEAST_JUMP, _OF_WINDOW * (misfit - usual)):
            best_jumps[name] = jump
    return best_jumps


def calm_metric(metric: Metric) -> Metric:
    """The metric in which jumps are looked for and first fitted."""
    return replace(metric, shares=np.minimum(metric.shares, _CALM))


def _shifts(traces: EffectTraces, windows: Windows) -> list[int]:
    """A row of each effect that changes readings by the same in every sample."""
    rows: dict[str, int] = {}
    for row, change in enumerate(traces.changes):
        mask = windows.measured & (np.abs(change) > 0)
        if mask.any() and np.ptp(change[mask]) < 1e-9 * np.abs(change[mask]).max():
            rows.setdefault(traces.names[row], row)
    return list(rows.values())


def _beside_start(white: FloatArray, gap: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Squared lengths of a window's columns, and their products with what is left over, (k,) each.

    With them half the square of that, nats. All freed of what the window's start can do.
    ``white``, (c, n_y, n_x + 1 + k) array: slopes in the start, residual, columns. ``gap``, (n_x,)
    array: of the start from its centre, scaled.
    """
    n = len(gap)
    flat = white.reshape(-1, white.shape[-1])
    start, z, columns = flat[:, :n], flat[:, n], flat[:, n + 1 :]
    inverse = np.linalg.inv(start.T @ start + np.eye(n))
    across, own = start.T @ columns, start.T @ z + gap
    residual_squares = np.einsum("ck,ck->k", columns, columns)
    residual_squares -= np.einsum("nk,nk->k", across, inverse @ across)
    towards = columns.T @ z - across.T @ inverse @ own
    misfit = 0.5 * float(z @ z + gap @ gap - own @ inverse @ own)
    return np.maximum(residual_squares, 1e-12), -towards, misfit


def onset_of(fitted: FittedModel) -> Onset | None:
    """When the effects of a fit begin, of the windows about the first in which they act.

    None where they act throughout.
    """
    windows = fitted.structure.windows
    if not isinstance(windows, GatedWindows):
        return None
    samples, log = _moments(fitted, windows)
    start = windows.first - windows.first_in_recording  # of the recording
    at, share = (samples - start[windows.begins]) * windows.sample_time, np.exp(log - log.max())
    order = np.argsort(at, kind="stable")
    cumulated = np.cumsum(share[order]) / share.sum()
    low, high = (float(at[order][np.searchsorted(cumulated, q)]) for q in (_TAIL, 1 - _TAIL))
    best, reach = float(at[int(np.argmax(log))]), _STEP / 2
    return Onset(time_s=best, ci95=(max(min(low, best) - reach, 0.0), max(high, best) + reach))


def at_its_moment(fitted: FittedModel, whole: ModelStructure) -> ModelStructure:
    """The structure whose effects begin where a fit, from some window on, has them begin.

    ``whole``: the same with the effects throughout.
    """
    windows = fitted.structure.windows
    assert isinstance(windows, GatedWindows)
    samples, log = _moments(fitted, windows)
    moment = int(samples[int(np.argmax(log))])
    window = int(np.searchsorted(windows.first, moment, side="right")) - 1
    return beginning_at(whole, window, moment - int(windows.first[window]))


def _moments(fitted: FittedModel, windows: GatedWindows) -> tuple[FloatArray, FloatArray]:
    """Samples, of all recordings in a row, and the log likelihood of each as the moment."""
    p = windows.problem.all_values(fitted.fit.theta)
    near = [windows.begins]
    if windows.begins and windows.follows[windows.begins]:
        near.insert(0, windows.begins - 1)
    after = windows.begins + 1
    if after < len(windows) and windows.follows[after]:
        near.append(after)
    every = max(1, round(_STEP / windows.sample_time))
    drift = fitted.metric.drift.columns @ fitted.fit.gains
    moments: list[int] = []
    by_window: dict[int, FloatArray] = {}
    for j in near:
        samples = [*range(0, int(windows.count[j]), every), int(windows.count[j])]
        r, slopes = windows.joined_to_beginning(j, p, fitted.fit.starts, samples)
        own = slopes[..., : windows.n_x] * windows.spread
        columns = np.concatenate([own, (r + drift[j])[..., None]], axis=-1)
        flat = np.moveaxis(columns, 0, -2).reshape(1, *r.shape[1:], -1)
        white = whitened_part(fitted.metric, slice(j, j + 1), flat)
        white = np.moveaxis(white.reshape(-1, len(samples), columns.shape[-1]), 1, 0)
        gap = (fitted.fit.starts[j] - fitted.objective.centres[j]) / windows.spread
        by_window[j] = _with_best_start(white, gap)
        moments += [int(windows.first[j]) + s for s in samples]
    # while it begins in one window, those before are without it, and those after have it
    log = [
        -by_window[j] - sum(by_window[i][-1 if i < j else 0] for i in near if i != j) for j in near
    ]
    return np.array(moments, dtype=float), np.concatenate(log)


def _with_best_start(white: FloatArray, gap: FloatArray) -> FloatArray:
    """Half the least squares of each row of a window's innovations over its start, (k,) array.

    ``white``, (k, n, n_x + 1) array: slopes in the start, scaled by its spread, and innovations.
    ``gap``, (n_x,) array: of the start from its centre, scaled.
    """
    slopes, z = white[..., :-1], white[..., -1]
    inner = np.swapaxes(slopes, 1, 2) @ slopes + np.eye(len(gap))
    across = np.einsum("knx,kn->kx", slopes, z) + gap
    explained_squares = np.einsum(
        "kx,kx->k", across, np.linalg.solve(inner, across[..., None])[..., 0]
    )
    return np.asarray(0.5 * ((z**2).sum(axis=1) + gap @ gap - explained_squares))


def later_and_better(
    gains: FloatArray, names: tuple[str, ...], more: float, count: int
) -> Mapping[str, tuple[int, int]]:
    """Effects that promise more from some window on than anything does throughout.

    By name, the most promising first: the row of its trace, and the window. ``gains``: (k, m)
    array, of :func:`promised_beginnings`. ``names``: of the effect of each row. ``more``: nats by
    which. ``count``: effects at most.
    """
    throughout = float(gains[:, 0].max(initial=0.0))
    beginnings: dict[str, tuple[int, int]] = {}
    rows, windows = np.unravel_index(np.argsort(-gains, axis=None), gains.shape)
    for row, window in zip(rows.tolist(), windows.tolist(), strict=True):
        gain = float(gains[row, window])
        if gain < throughout + more or len(beginnings) >= count:
            break
        if window:
            beginnings.setdefault(names[row], (row, window))
    return beginnings
