"""How far a change closes the gap: free runs on the end of the recordings, kept aside for it.

Which difference it is was chosen on the whole of the recordings, for a change is often seen in a
part of them alone. Its sizes are estimated anew without the part that the free runs are made on.
"""

from __future__ import annotations

from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.forces import ConstantTorque
from trms_cli.gap.change import StateComparison
from trms_cli.gap.differences import NewRecordings, differences
from trms_cli.gap.evidence import ChangeEvidence, DifferenceScore, judge
from trms_cli.gap.problem import GapProblem, Parts, divide
from trms_cli.gap.shrinkage import Shrinkage, measure_shrinkage
from trms_cli.identification.problem import with_values
from trms_cli.models.model import Model

#: s after an onset that must be left to estimate sizes from.
_LEAST_AFTER = 5.0


def change_shrinkage(
    problem: GapProblem, comparison: StateComparison, correction: DifferenceScore | None
) -> Shrinkage | None:
    """Free runs of the model as it was, of the known state's, and of that with the difference.

    ``correction``: what the corrected model has beyond the known state's; None: nothing. None where
    the recordings are too short to keep a part aside, or the difference begins within that part.
    """
    try:
        parts = divide(problem.datasets, problem.block, problem.sealed_share, problem.model.stops)
    except ConfigurationError:
        return None
    known_model = comparison.questioned.known_state.model
    corrected = known_model if correction is None else _corrected(comparison, parts, correction)
    if corrected is None:
        return None
    return measure_shrinkage(problem, parts, problem.model, known_model, corrected)


def _corrected(
    comparison: StateComparison, parts: Parts, correction: DifferenceScore
) -> Model | None:
    """The known state's model with the difference, of sizes that the sealed part has no say in."""
    known_state = comparison.questioned.known_state
    # nothing foretells what varies at random, and rounding is in no model
    if correction.varies or not correction.difference.families:
        return known_state.model
    if correction.began is not None:
        within = (
            parts.fitted[correction.recording] if correction.recording < len(parts.fitted) else None
        )
        if within is None or within.duration - correction.began.time_s < _LEAST_AFTER:
            return None
    name = correction.difference.name
    evidence = ChangeEvidence(NewRecordings.of(known_state, parts.fitted))
    again = differences(evidence.questioned, comparison.candidates, only={name})
    difference = next(iter(again), None)
    if difference is None:  # it diverges there
        return None
    score = judge(evidence, difference)
    if correction.difference.kind == "parameter":
        value = known_state.model.parameters[name].value + float(score.value[0])
        return with_values(known_state.model, {name: value})
    sizes = dict(zip(score.difference.labels, score.value.tolist(), strict=True))
    effect = stand_in(correction) or comparison.candidates[name].effect
    with_effect = extend_model(known_state.model, {name: effect})
    return with_values(with_effect, {f"{name}.{size}": value for size, value in sizes.items()})


def stand_in(score: DifferenceScore) -> ConstantTorque | None:
    """What a model has in place of a torque from outside; None for any other difference."""
    if score.difference.kind != "torque" or score.varies:
        return None
    axis = score.difference.name.split("_")[0]
    return ConstantTorque(axis=axis, torque=float(score.value[0]))
