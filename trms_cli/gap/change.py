"""What changed since the rig was in a known state: a diagnosis against other recordings of it.

    fit to the known state → learn the standing error → one difference at a time → how probable

Parameters are those of the known state, and so is what the model lacks there: neither has to be
explained. A constant torque on an axis, a parameter, an effect of the library is tried, from the
beginning of the recordings in question on or from some time on. That nothing changed is an answer,
and it is held against how much recordings of the known state differ among themselves: what would
be seen between these, one in turn questioned against the others, is no change.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.gap.belief import (
    UNNAMED,
    calibration,
    change_probabilities,
    change_worth,
    unnamed_gain,
    usual_gains,
)
from trms_cli.gap.competing_model import nominal_parameters
from trms_cli.gap.differences import NewRecordings, differences
from trms_cli.gap.evidence import ChangeEvidence, DifferenceScore, coarser_sensors, judge
from trms_cli.gap.known_state import KnownState, StandingError, known_state
from trms_cli.gap.problem import (
    CandidateEffect,
    GapProblem,
    applicable_candidates,
    comparable_datasets,
)
from trms_cli.gap.unnamed_force import law_evidence, with_random_torque
from trms_cli.identification.dataset import Dataset

#: Nats of belief behind the best within which a difference is judged finely, and how many at most.
_NEAR, _FINALISTS = 9.0, 8
#: Effects that are tried between the recordings of the known state, besides all else.
_MOST_EFFECTS = 6
#: Differences that add the same to the missing forces, by the cosine, cannot be told apart.
_ALIKE = 0.97


@dataclass(frozen=True)
class StateComparison:
    """What was found out about a change."""

    questioned: NewRecordings
    judged: tuple[DifferenceScore, ...]  #: Descending
    gains: FloatArray  #: (k,) array; nats of each above that nothing changed
    #: nats that parameters, torques, the likeliest effects and a force without a name gain where
    #: each reference is questioned, by name
    between: Sequence[Mapping[str, float]]
    probabilities: FloatArray  #: (k,) array; of each
    unchanged: float  #: Probability that nothing changed
    unnamed: float  #: Probability of something else
    by_equation: FloatArray  #: (e,) array; nats that a free force gains on each equation alone
    alike: tuple[int, ...]  #: Those that are not told from the first
    candidates: Mapping[str, CandidateEffect]  #: Effects that were tried
    left_out: Mapping[str, str]  #: Why other effects cannot be the cause here
    #: s; where in their recordings those in question begin; empty: with them
    begins: tuple[float, ...] = ()


def compare(
    problem: GapProblem, watch: Callable[[float, str], bool] = lambda share, message: True
) -> StateComparison:
    """Weigh everything that may have changed against the recordings of the known state.

    ``watch``: told the share that is done and what is being done.
    """
    against = comparable_datasets(problem, problem.against)
    recordings = comparable_datasets(problem, problem.datasets)
    candidates, left_out = applicable_candidates(problem.model, problem.candidates)
    watch(0.0, "the known state")
    return compare_with(
        known_state(problem.model, nominal_parameters(problem.model), against),
        recordings,
        candidates,
        left_out,
        problem.jobs,
        watch,
    )


def compare_with(
    known_state: KnownState,
    recordings: Sequence[Dataset],
    candidates: Mapping[str, CandidateEffect],
    left_out: Mapping[str, str],
    jobs: int = 1,
    watch: Callable[[float, str], bool] = lambda share, message: True,
    *,
    ends: bool = False,
) -> StateComparison:
    """The same with the known state at hand.

    ``ends``: whether what differs may end within the recordings, and not begin.
    """
    questioned = NewRecordings.of(known_state, recordings)
    if not questioned.runs.equations:
        raise ConfigurationError(
            "no angle of an axis and no speed of a rotor is measured on both sides",
            where="against",
            remedy="compare recordings that have the channels of the model's outputs",
        )
    evidence = ChangeEvidence(questioned, ends=ends)
    count = len(known_state.free) + len(candidates) + 2
    scores = coarser_sensors(evidence, candidates)
    for k, difference in enumerate(differences(questioned, candidates, jobs=jobs)):
        scores.append(with_random_torque(evidence, judge(evidence, difference)))
        watch(0.2 + 0.5 * k / count, difference.name)
    if not scores:
        raise ConfigurationError(
            "there is nothing that may have changed: no parameter has a prior, no axis is measured "
            "and no candidate acts on this model",
            where="candidates",
            remedy="name effects, or give parameters priors",
        )
    constants = calibration().change
    scores, worth = _in_order(scores, constants)
    near = [j for j, w in zip(scores, worth, strict=True) if w > worth[0] - _NEAR][:_FINALISTS]
    watch(0.75, "when")
    finely = [
        with_random_torque(evidence, judge(evidence, j.difference, finely=True))
        if j.difference.families
        else j
        for j in near
    ]
    judged, worth = _in_order([*finely, *scores[len(near) :]], constants)
    free = law_evidence(evidence) - evidence.unchanged
    watch(0.85, "between recordings of the known state")
    gains = np.array([j.evidence for j in judged]) - evidence.unchanged
    unnamed = unnamed_gain(free)
    between = _usual_gains(known_state, candidates, judged, jobs)
    kinds = [j.difference.kind for j in judged]
    gain_by_name = {j.difference.name: gain for j, gain in zip(judged, gains.tolist(), strict=True)}
    usual = usual_gains({**gain_by_name, UNNAMED: unnamed}, between)
    probabilities, unchanged, other = change_probabilities(
        kinds, gains, _beliefs(judged), unnamed, usual, constants
    )
    alike = tuple(
        k
        for k, j in enumerate(judged)
        if k and abs(evidence.alike(judged[0], j)) > _ALIKE and worth[k] > worth[0] - _NEAR
    )
    return StateComparison(
        questioned,
        tuple(judged),
        gains,
        between,
        probabilities,
        unchanged,
        other,
        free,
        alike,
        candidates,
        left_out,
    )


def _in_order(
    scores: Sequence[DifferenceScore], constants: Mapping[str, float]
) -> tuple[list[DifferenceScore], FloatArray]:
    """The likeliest first, and the logarithm of how likely each is, up to a constant."""
    kinds = [j.difference.kind for j in scores]
    evidence = np.array([j.evidence for j in scores])
    worth = change_worth(kinds, evidence, _beliefs(scores), constants)
    order = np.argsort(-worth, kind="stable")
    return [scores[k] for k in order], worth[order]


def _beliefs(scores: Sequence[DifferenceScore]) -> FloatArray:
    return np.array([j.belief for j in scores])


def _usual_gains(
    known_state: KnownState,
    candidates: Mapping[str, CandidateEffect],
    judged: Sequence[DifferenceScore],
    jobs: int,
) -> list[dict[str, float]]:
    """Nats that differences gain, by name, where each recording of the known state is questioned.

    A force without a name is among them: ``unnamed``.
    """
    effects = [j.difference.name for j in judged if j.difference.kind == "effect"]
    others = [j.difference.name for j in judged if j.difference.kind != "effect"]
    names = {*effects[:_MOST_EFFECTS], *others}
    gains_by_recording = []
    for k, dataset in enumerate(known_state.runs.windows.datasets):
        if not np.isfinite(dataset.measurements).any():
            continue  # it lies in a contact with a stop throughout
        # as if the recording had never been seen: sizes of the standing error are of the others
        rest = tuple(
            StandingError.fit(
                e.reference.only(e.reference.recording != k),
                e.scale,
                max(e.sessions - 1, 1),
                begin=e.sizes,
            )
            for e in known_state.errors
        )
        evidence = ChangeEvidence(NewRecordings.of(replace(known_state, errors=rest), [dataset]))
        gains = {
            difference.name: with_random_torque(evidence, judge(evidence, difference)).evidence
            - evidence.unchanged
            for difference in differences(evidence.questioned, candidates, only=names, jobs=jobs)
        }
        free = law_evidence(evidence) - evidence.unchanged
        gains_by_recording.append({**gains, UNNAMED: unnamed_gain(free)})
    return gains_by_recording
