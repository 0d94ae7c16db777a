"""How probable a change is: what it leaves of the missing forces, against the standing error."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from trms_cli.core.arrays import FloatArray
from trms_cli.effects.quantisation import Quantisation
from trms_cli.gap.diagnosis import Onset
from trms_cli.gap.differences import Difference, DifferenceFamily, NewRecordings, SensorJump
from trms_cli.gap.known_state import robust, robust_weight
from trms_cli.gap.problem import CandidateEffect, is_coarser, quantum_of
from trms_cli.gap.short_runs import ShortRuns
from trms_cli.models.model import names


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
    varies: bool = False  #: A torque that varies at random, of which ``value`` is the deviation

    @property
    def evidence(self) -> float:
        """nats; of both."""
        return float(np.logaddexp(self.always, self.begins))

    @property
    def belief(self) -> float:
        """Logarithm of what is believed beforehand of a law of a rig's build: that it acts always.

        It counts in full, where nats of an imperfect likelihood do not.
        """
        if self.difference.may_begin:
            return 0.0
        return float(np.log1p((_BUILT_IN - 1) * np.exp(self.begins - self.evidence)))

    @property
    def began(self) -> Onset | None:
        """The onset, where it is all but sure that there is one."""
        return self.onset if self.begins > self.always + _SURE_ONSET else None


#: nats by which an onset must be more probable than none to be told.
_SURE_ONSET = 2.5
#: Log prior that a difference acts from the beginning of the recordings on, or begins in them.
_ALWAYS, _BEGINS = float(np.log(0.6)), float(np.log(0.4))
#: How likely a law of a rig's build is to begin within recordings, by what is hung on, rubs, slips.
_BUILT_IN = 0.1


@dataclass(frozen=True)
class _Law:
    """What one choice of the standing error's sizes foretells of all equations."""

    number: int  #: Of the choice
    log_weight: float  #: nats; belief in the sizes
    whitener: tuple[FloatArray, ...]  #: By equation: (m_e, m_e) arrays
    parts: tuple[FloatArray, ...]  #: By equation: (m_e,) arrays; innovations with nothing changed
    constants: tuple[float, ...]  #: nats; of each equation's density

    @cached_property
    def densities(self) -> FloatArray:
        """(e,) array; log density of each equation's forces with nothing changed, nats."""
        both = zip(self.constants, self.parts, strict=True)
        return np.array([constant - robust(z).sum() for constant, z in both])


class ChangeEvidence:
    """Log evidence of whatever may have happened to recordings in question.

    Of all windows in which an equation's force was measured, n together. ``ends``: whether what
    happened may end within them, and not begin.
    """

    def __init__(self, questioned: NewRecordings, *, ends: bool = False) -> None:
        self.questioned, self.ends = questioned, ends
        self.known_state, self.runs = questioned.known_state, questioned.runs
        self.forces = questioned.forces
        self.series = self.known_state.series(self.runs, self.forces)
        #: By equation: (m,) arrays of bool; where something was measured
        self.rows = [np.isfinite(self.forces.force[:, e]) for e in range(len(self.series))]
        #: By equation: what was measured of it
        self.own = [s.only(rows) for s, rows in zip(self.series, self.rows, strict=True)]
        self._laws = self._of_laws()
        log_evidence = [law.log_weight + law.densities.sum() for law in self._laws]
        self.unchanged = float(logsumexp(log_evidence))

    def _of_laws(self) -> list[_Law]:
        by_equation = [
            list(error.predictions(own))
            for error, own in zip(self.known_state.errors, self.own, strict=True)
        ]
        laws = []
        for number, together in enumerate(zip(*by_equation, strict=True)):
            z = [
                p.whitener @ (own.force - p.mean) for own, p in zip(self.own, together, strict=True)
            ]
            laws.append(
                _Law(
                    number,
                    # the factors are those of the recording, not of each of its equations
                    together[0].log_weight,
                    tuple(p.whitener for p in together),
                    tuple(z),
                    tuple(p.constant for p in together),
                )
            )
        total = logsumexp([law.log_weight for law in laws])
        normalised_laws = [replace(law, log_weight=law.log_weight - total) for law in laws]
        return [law for law in normalised_laws if law.log_weight > _NEGLIGIBLE]

    @cached_property
    def onsets(self) -> tuple[FloatArray, float, FloatArray]:
        """Onsets that are tried first (t, 2), the time in s that each stands for, their gates."""
        onsets, step = _onsets(self.runs)
        return onsets, step, self.gates(onsets)

    def gates(self, onsets: FloatArray) -> FloatArray:
        """Share of a unit force that each window shows if it begins, or ends, at each onset.

        (k, m, e) array.
        """
        runs, recording = self.runs, onsets[:, :1]
        gates = np.where((runs.recording > recording)[..., None], 1.0, runs.gate(onsets[:, 1]))
        gates = np.where((runs.recording < recording)[..., None], 0.0, gates)
        return 1.0 - gates if self.ends else gates

    def with_covariance(self, e: int, covariance: FloatArray) -> float:
        """Log evidence of a further force on an equation, (m_e, m_e) its covariance."""
        laws_by_number = {law.number: law for law in self._laws}
        error, own = self.known_state.errors[e], self.own[e]
        logs = [
            law.log_weight
            + law.densities.sum()
            - law.densities[e]
            + prediction.constant
            - robust(prediction.whitener @ (own.force - prediction.mean)).sum()
            for law, prediction in zip(
                laws_by_number.values(),
                error.predictions(own, covariance, laws_by_number),
                strict=True,
            )
        ]
        return float(logsumexp(logs))

    def with_columns(self, e: int, columns: FloatArray, size: float) -> float:
        """Log evidence of a force that is a sum of columns (m_e, k), coefficients N(0, size²).

        Laplace's approximation about the most probable coefficients.
        """
        logs = []
        for law in self._laws:
            white, z = law.whitener[e] @ columns, law.parts[e]
            part: FloatArray = np.zeros(columns.shape[1])
            for _ in range(_REWEIGHED):
                weight = robust_weight(z + white @ part)[:, None]
                curvature = white.T @ (weight * white) + np.eye(len(part)) / size**2
                part = np.asarray(-np.linalg.solve(curvature, white.T @ (weight[:, 0] * z)))
            cost = robust(z + white @ part).sum() + 0.5 * part @ part / size**2
            occam = 0.5 * np.linalg.slogdet(size**2 * curvature)[1]
            others = law.densities.sum() - law.densities[e]
            logs.append(law.log_weight + others + law.constants[e] - cost - occam)
        return float(logsumexp(logs))

    def of(self, change: FloatArray, slope: FloatArray) -> tuple[FloatArray, ...]:
        """Of changes of the missing forces with any part, 0 to 1, of a slope, (k, m, e) each.

        Returns the log evidence, the most probable part and its standard deviation, (k,) arrays.
        """
        log_evidence, parts, spreads = [], [], []
        equations = self._affected_equations(change, slope)
        for law in self._laws:
            z = np.concatenate([law.parts[e] for e in equations])
            white_residual = z[:, None] + self._whitened(law, change, equations)
            white_slope = self._whitened(law, slope, equations)
            others = law.densities.sum() - law.densities[equations].sum()
            constant = others + sum(law.constants[e] for e in equations)
            part = np.full(len(change), 0.5)
            for _ in range(_REWEIGHED):
                weight = robust_weight(white_residual + part * white_slope)
                weight *= white_slope
                curvature = np.maximum(np.einsum("nk,nk->k", weight, white_slope), 1e-12)
                part = np.clip(-np.einsum("nk,nk->k", weight, white_residual) / curvature, 0.0, 1.0)
            cost = robust(white_residual + part * white_slope).sum(axis=0)
            spread = 1 / np.sqrt(curvature)
            occam = np.minimum(np.log(np.sqrt(2 * np.pi) * spread), 0.0)
            log_evidence.append(law.log_weight + constant - cost + occam)
            parts.append(part)
            spreads.append(spread)
        best = np.argmax(log_evidence, axis=0)[None]
        part_and_sd = [np.take_along_axis(np.array(v), best, 0)[0] for v in (parts, spreads)]
        return (np.asarray(logsumexp(log_evidence, axis=0)), *part_and_sd)

    def _affected_equations(self, *changes: FloatArray) -> list[int]:
        """Equations on which changes (k, m, e) act at all: most act on one or two."""
        white = np.array([error.sizes.white for error in self.known_state.errors])
        largest = np.max([np.abs(c).max(axis=(0, 1), initial=0.0) for c in changes], axis=0)
        acts = largest > _UNSEEN * white
        return [int(e) for e in np.flatnonzero(acts)] or [int(np.argmax(largest / white))]

    def _whitened(self, law: _Law, change: FloatArray, equations: Sequence[int]) -> FloatArray:
        """Changes (k, m, e) of the missing forces of some equations as innovations, (n, k)."""
        return np.concatenate([law.whitener[e] @ change[:, self.rows[e], e].T for e in equations])

    def alike(self, one: DifferenceScore, other: DifferenceScore) -> float:
        """Cosine between what two differences add, as innovations."""
        law = max(self._laws, key=lambda law: law.log_weight)
        a, b = self._whitened(law, np.stack([one.change, other.change]), range(len(self.rows))).T
        return float(a @ b / max(np.sqrt((a @ a) * (b @ b)), 1e-12))


#: nats; less probable sizes of the standing error are left out.
_NEGLIGIBLE = -4.0
#: Share of what an equation errs by in any second below which a change does not act on it.
_UNSEEN = 1e-3
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
    onsets, step, gates = evidence.onsets
    whole = len(onsets) * step
    always, begins = [], []
    for family in difference.families:
        estimates = evidence.of(family.change, family.slope)
        value, part, sd = (v[None] for v in estimates)
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
            again = evidence.gates(near)
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
        onset = replace(onset, ends=evidence.ends)
    shape = replace(family, change=family.change[[k]], slope=family.slope[[k]])
    if family.jump is not None:
        jump = family.jump
        shape = replace(shape, jump=replace(jump, change=jump.change[[k]], slope=jump.slope[[k]]))
    change, slope = shape.change, shape.slope
    if onset is not None:
        at = best.onsets[t : t + 1]
        change, slope = (v[0] for v in _from(evidence, shape, at, evidence.gates(at)))
    return DifferenceScore(
        difference,
        _together(always),
        _together(begins),
        value,
        sd,
        onset,
        recording,
        (change + part * slope)[0],
    )


def coarser_sensors(
    evidence: ChangeEvidence, candidates: Mapping[str, CandidateEffect]
) -> list[DifferenceScore]:
    """Sensors that round coarser than in any recording of the known state; seen in their steps.

    A reading of the known state lies on steps r times as coarse by chance in one of r. So much
    speaks for them with each level that was met, and no simulation tells more.
    """
    model = evidence.known_state.model
    scores = []
    for name, candidate in candidates.items():
        if not isinstance(candidate.effect, Quantisation):
            continue
        channel = model.outputs[candidate.effect.row(model)].name
        now, before = (
            [d.output(channel) for d in runs.windows.datasets if channel in names(d.outputs)]
            for runs in (evidence.runs, evidence.known_state.runs)
        )
        quantum = min(map(quantum_of, now), default=0.0)
        usual = max(map(quantum_of, before), default=np.inf)
        if not is_coarser(quantum, usual):
            continue
        ratio = min(quantum / max(usual, 1e-12), _MOST_COARSER)
        levels = sum(len(np.unique(np.round(v[np.isfinite(v)] / quantum))) for v in now)
        labels, units = zip(*((p.name, p.unit) for p in candidate.effect.parameters()), strict=True)
        scores.append(
            DifferenceScore(
                Difference(name, "effect", labels, units, candidate.locations, ()),
                always=evidence.unchanged + levels * float(np.log(ratio)),
                begins=-np.inf,
                value=np.array([quantum]),
                sd=np.array([quantum / levels]),
                onset=None,
                recording=0,
                change=np.zeros_like(evidence.forces.force),
            )
        )
    return scores


#: Steps are called coarser by this factor at most; those of a smooth reading are not known.
_MOST_COARSER = 10.0


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
    change, slope = _from(evidence, family, onsets, gates)
    change, slope = (v.reshape(-1, *gates.shape[1:]) for v in (change, slope))
    shape = len(gates), len(family.prior)
    value, part, sd = (v.reshape(shape) for v in evidence.of(change, slope))
    return _Trial(family, onsets, value + family.prior + _BEGINS + np.log(share), part, sd)


def _from(
    evidence: ChangeEvidence, family: DifferenceFamily, onsets: FloatArray, gates: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What a family adds from each onset on, or until it; change and slope, (t, k, m, e) each."""
    change, slope = (gates[:, None] * v for v in (family.change, family.slope))
    if family.jump is not None:
        _put_jumps(evidence, onsets, family.jump, change, slope)
    return change, slope


def _put_jumps(
    evidence: ChangeEvidence,
    onsets: FloatArray,
    jump: SensorJump,
    change: FloatArray,
    slope: FloatArray,
) -> None:
    """In each onset's window, of changes (t, k, m, e), what a sensor that jumps there shows."""
    runs, back = evidence.runs, -1.0 if evidence.ends else 1.0
    step = runs.windows.sample_time
    for t, (recording, time) in enumerate(onsets):
        within = (runs.recording == recording) & (runs.begin < time)
        within &= time < runs.begin + runs.length
        for j in np.flatnonzero(within):
            into = int(np.ceil((time - runs.begin[j]) / step - 1e-9))
            sample = min(into, jump.change.shape[2] - 1)
            for v, shift in ((change, jump.change), (slope, jump.slope)):
                v[t, :, j] = 0.0
                v[t, :, j, jump.equation] = back * shift[:, j, sample]


def _most_probable(trials: Sequence[_Trial], recording: int, at: float) -> Onset:
    """The most probable onset in a recording, with its interval."""
    times = np.concatenate([trial.onsets for trial in trials])
    log = np.concatenate([logsumexp(trial.log, axis=1) for trial in trials])
    in_recording = times[:, 0] == recording
    order = np.argsort(times[in_recording, 1])
    times, log = times[in_recording, 1][order], log[in_recording][order]
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
