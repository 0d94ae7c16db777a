"""How probable a change is: what it leaves of the missing forces, against the standing error."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import logsumexp

from trms_cli.core.arrays import FloatArray
from trms_cli.gap.diagnosis import Onset
from trms_cli.gap.differences import Difference, DifferenceFamily, NewRecordings
from trms_cli.gap.short_runs import ShortRuns
from trms_cli.gap.standing import robust, robust_weight


@dataclass(frozen=True)
class DifferenceScore:
    """A difference with its evidence."""

    difference: Difference
    always: float  #: nats; acting from the beginning on, its prior included
    begins: float  #: nats; acting from some time on, averaged over that time, its prior included
    value: FloatArray  #: (n_s,) array; most probable sizes
    sd: FloatArray  #: (n_s,) array
    onset: Onset | None  #: Where that is the more probable
    recording: int  #: In which it begins
    change: FloatArray  #: (m, e) array; what it then adds to the missing forces

    @property
    def evidence(self) -> float:
        """nats; of both."""
        return float(np.logaddexp(self.always, self.begins))

    @property
    def began(self) -> Onset | None:
        """The onset, where it is all but sure that there is one."""
        return self.onset if self.begins > self.always + _SURE_ONSET else None


#: nats by which an onset must be more probable than none to be told.
_SURE_ONSET = 2.5
#: Log prior that a difference acts from the beginning of the recordings on, or begins in them.
_ALWAYS, _BEGINS = float(np.log(0.6)), float(np.log(0.4))


@dataclass(frozen=True)
class _Law:
    """What one choice of the standing error's sizes foretells of all equations."""

    log_weight: float  #: nats; belief in the sizes
    whitener: tuple[FloatArray, ...]  #: By equation: (m_e, m_e) arrays
    z: FloatArray  #: (n,) array; innovations of all equations with nothing changed
    constant: float  #: nats; of the density


class ChangeEvidence:
    """Log evidence of whatever may have happened to recordings in question.

    Of all windows in which an equation's force was measured, n together.
    """

    def __init__(self, questioned: NewRecordings) -> None:
        self.questioned = questioned
        self.known, self.runs, self.forces = questioned.known, questioned.runs, questioned.forces
        self.series = self.known.series(self.runs, self.forces)
        self._rows = [np.isfinite(self.forces.force[:, e]) for e in range(len(self.series))]
        self._laws = self._of_laws([0.0] * len(self.series))
        self.unchanged = float(self._density(self._laws))

    def _of_laws(self, more: Sequence[FloatArray | float]) -> list[_Law]:
        own = [series.only(rows) for series, rows in zip(self.series, self._rows, strict=True)]
        by_equation = [
            list(error.predictions(series, extra))
            for error, series, extra in zip(self.known.errors, own, more, strict=True)
        ]
        laws = []
        for together in zip(*by_equation, strict=True):
            inverse = tuple(
                solve_triangular(p.factor, np.eye(len(p.mean)), lower=True) for p in together
            )
            z = [
                w @ (series.force - p.mean)
                for w, series, p in zip(inverse, own, together, strict=True)
            ]
            constant = -sum(float(np.log(np.diag(p.factor)).sum()) for p in together)
            weight = sum(p.log_weight for p in together)
            laws.append(_Law(weight, inverse, np.concatenate(z), constant))
        total = logsumexp([law.log_weight for law in laws])
        kept = [replace(law, log_weight=law.log_weight - total) for law in laws]
        return [law for law in kept if law.log_weight > _NEGLIGIBLE]

    def _density(self, laws: Sequence[_Law]) -> float:
        found = [law.log_weight + law.constant - robust(law.z).sum() for law in laws]
        return float(logsumexp(found))

    def of(self, change: FloatArray, slope: FloatArray) -> tuple[FloatArray, ...]:
        """Of changes of the missing forces with any part, 0 to 1, of a slope, (k, m, e) each.

        Returns the log evidence, the most probable part and its standard deviation, (k,) arrays.
        """
        found, parts, spreads = [], [], []
        for law in self._laws:
            begin = law.z[:, None] + self._whitened(law, change)
            added = self._whitened(law, slope)
            part = np.full(len(change), 0.5)
            for _ in range(_REWEIGHED):
                weight = robust_weight(begin + part * added)
                curvature = np.maximum(np.sum(weight * added**2, axis=0), 1e-12)
                part = np.clip(-np.sum(weight * added * begin, axis=0) / curvature, 0.0, 1.0)
            cost = robust(begin + part * added).sum(axis=0)
            spread = 1 / np.sqrt(curvature)
            occam = np.minimum(np.log(np.sqrt(2 * np.pi) * spread), 0.0)
            found.append(law.log_weight + law.constant - cost + occam)
            parts.append(part)
            spreads.append(spread)
        best = np.argmax(found, axis=0)[None]
        chosen = [np.take_along_axis(np.array(v), best, 0)[0] for v in (parts, spreads)]
        return (np.asarray(logsumexp(found, axis=0)), *chosen)

    def _whitened(self, law: _Law, change: FloatArray) -> FloatArray:
        """Changes (k, m, e) of the missing forces as innovations, (n, k)."""
        both = enumerate(zip(law.whitener, self._rows, strict=True))
        return np.concatenate([w @ change[:, rows, e].T for e, (w, rows) in both])

    def alike(self, one: DifferenceScore, other: DifferenceScore) -> float:
        """Cosine between what two differences add, as innovations."""
        law = max(self._laws, key=lambda law: law.log_weight)
        a, b = self._whitened(law, np.stack([one.change, other.change])).T
        return float(a @ b / max(np.sqrt((a @ a) * (b @ b)), 1e-12))

    def free_force(self) -> FloatArray:
        """Of a force without a name on each equation alone, (e,) nats."""
        found = np.zeros(len(self.series))
        for e, (series, rows) in enumerate(zip(self.series, self._rows, strict=True)):
            own, scale = series.only(rows), self.known.errors[e].scale
            apart = np.abs(own.time[:, None] - own.time)
            same = own.recording[:, None] == own.recording
            values = []
            for size, time in itertools.product(_FREE_SIZES, _FREE_TIMES):
                more: list[FloatArray | float] = [0.0] * len(self.series)
                more[e] = (size * scale) ** 2 * np.exp(-apart / time) * same
                values.append(self._density(self._of_laws(more)))
            found[e] = logsumexp(values) - np.log(len(values))
        return found


#: Sizes of a force without a name, as shares of what acts there, and its times in s.
_FREE_SIZES, _FREE_TIMES = (0.1, 0.3, 1.0), (3.0, 30.0)
#: nats; less probable sizes of the standing error are left out.
_NEGLIGIBLE = -4.0
#: Rounds of robust least squares for a part.
_REWEIGHED = 5


class _Trial(NamedTuple):
    """A family at its sizes, at some onsets or from the beginning on."""

    family: DifferenceFamily
    onsets: FloatArray  #: (t, 2) array; recording and s; empty: from the beginning on
    log: FloatArray  #: (t, k) array; log evidence with all priors, nats
    part: FloatArray  #: (t, k) array; of the stretches
    sd: FloatArray  #: (t, k) array; of the parts


def judge(
    evidence: ChangeEvidence, difference: Difference, *, finely: bool = False
) -> DifferenceScore:
    """Evidence of a difference, with its most probable size and onset.

    ``finely``: onsets are tried in steps of a tenth of a second about the most probable one.
    """
    onsets, step = _onsets(evidence.runs)
    whole = len(onsets) * step
    gates = _gates(evidence.runs, onsets)
    always, begins = [], []
    for family in difference.families:
        found = evidence.of(family.change, family.slope)
        value, part, sd = (v[None] for v in found)
        always.append(_Trial(family, onsets[:0], value + family.prior + _ALWAYS, part, sd))
        if not len(onsets):  # runs of a single second
            continue
        coarse = _gated(evidence, family, onsets, gates, step / whole)
        begins.append(coarse)
        if finely and coarse.log.size:
            at = onsets[np.unravel_index(int(np.argmax(coarse.log)), coarse.log.shape)[0]]
            fine = step * _REACH / _FINE
            near = at + fine * np.outer(np.arange(-_FINE, _FINE + 1), [0.0, 1.0])
            near = near[near[:, 1] > 0]
            same = (onsets[:, 0] == at[0]) & (np.abs(onsets[:, 1] - at[1]) < step * _REACH)
            coarse.log[same] = -np.inf
            again = _gates(evidence.runs, near)
            begins.append(_gated(evidence, family, near, again, fine / whole))
    best = max((*always, *begins), key=lambda trial: np.max(trial.log, initial=-np.inf))
    t, k = np.unravel_index(int(np.argmax(best.log)), best.log.shape)
    family, part = best.family, best.part[t, k]
    reach = family.high[k] - family.low[k]
    value, sd = family.low[k] + part * reach, np.abs(reach) * min(best.sd[t, k], 1.0)
    onset, recording = None, 0
    if len(best.onsets):
        recording = int(best.onsets[t, 0])
        onset = _most_probable(begins, recording, float(best.onsets[t, 1]))
    gates = _gates(evidence.runs, best.onsets[t : t + 1]) if onset else np.ones((1, 1, 1))
    return DifferenceScore(
        difference,
        _together(always),
        _together(begins),
        value,
        sd,
        onset,
        recording,
        gates[0] * (family.change[k] + part * family.slope[k]),
    )


def _together(trials: Sequence[_Trial]) -> float:
    """Log evidence of some trials, nats."""
    return float(logsumexp(np.concatenate([[-np.inf], *(trial.log.ravel() for trial in trials)])))


def _gated(
    evidence: ChangeEvidence,
    family: DifferenceFamily,
    onsets: FloatArray,
    gates: FloatArray,
    share: float,
) -> _Trial:
    """A family from some onsets on; ``share``: prior of each onset."""
    change, slope = (
        (gates[:, None] * v).reshape(-1, *gates.shape[1:]) for v in (family.change, family.slope)
    )
    shape = len(gates), len(family.prior)
    value, part, sd = (v.reshape(shape) for v in evidence.of(change, slope))
    return _Trial(family, onsets, value + family.prior + _BEGINS + np.log(share), part, sd)


def _most_probable(trials: Sequence[_Trial], recording: int, at: float) -> Onset:
    """The most probable onset in a recording, with its interval."""
    times = np.concatenate([trial.onsets for trial in trials])
    log = np.concatenate([logsumexp(trial.log, axis=1) for trial in trials])
    chosen = times[:, 0] == recording
    order = np.argsort(times[chosen, 1])
    times, log = times[chosen, 1][order], log[chosen][order]
    share = np.cumsum(np.exp(log - log.max()))
    low, high = np.interp([0.025, 0.975], share / share[-1], times)
    return Onset(time_s=at, ci95=(float(min(low, at)), float(max(high, at))))


#: s between onsets that are tried first, and how many of them at most.
_COARSE, _MOST_ONSETS = 1.0, 90
#: Steps of the first trial to either side of its best that are tried finely, in so many steps.
_REACH, _FINE = 1.5, 15


def _onsets(runs: ShortRuns) -> tuple[FloatArray, float]:
    """Onsets (k, 2) as (recording, s) over all recordings, and the time that each stands for."""
    step = max(_COARSE, len(runs) * runs.length / _MOST_ONSETS)
    rows = []
    for recording in np.unique(runs.recording):
        begin = runs.begin[runs.recording == recording]
        rows += [(recording, t) for t in np.arange(begin[0] + step, begin[-1] + step / 2, step)]
    return np.array(rows, dtype=float).reshape(-1, 2), step


def _gates(runs: ShortRuns, onsets: FloatArray) -> FloatArray:
    """Share of a unit force from each onset on, (k, m, e)."""
    gate = runs.gate(onsets[:, 1])
    before = runs.recording < onsets[:, :1]
    after = runs.recording > onsets[:, :1]
    return np.where(before[..., None], 0.0, np.where(after[..., None], 1.0, gate))
