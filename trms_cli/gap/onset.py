"""Whether something began within the recordings, or ended: a part of them is the known state then.

Most rigs that change do so while they run: a mass is hung on, a cable is caught, a supply sags. The
first quarter of each recording (where that leaves it open, the first half), with all that its model
lacks there, is taken for what the rig was like, and the rest is questioned against it. What acts
from the beginning to the end is in both, and is no change. A first look tries parameters and
constant torques alone, which any cause resembles to some degree; only where it sees something are
the effects tried.

What ends is questioned against the last part. An effect whose size has a sign of its own (friction
is never negative) tells the two apart: of a torque, a parameter or a sensor's bias the end is the
beginning of its opposite, and is told so.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from trms_cli.core.errors import TrmsError
from trms_cli.gap.change import StateComparison, compare_with
from trms_cli.gap.change_result import change_result
from trms_cli.gap.competing_model import nominal_parameters
from trms_cli.gap.diagnosis import DiagnosisResult
from trms_cli.gap.known_state import KnownState, known_state
from trms_cli.gap.problem import GapProblem, applicable_candidates, comparable_datasets
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import names

#: Shares of each recording that are taken for the known state, one after the other while the look
#: leaves it open, and their least length in s.
_FIRST, _LEAST = (0.25, 0.5), 10.0
#: Probability that nothing changed: from which the look ends, up to which effects are tried, and up
#: to which something is told.
_CALM, _LOOKED_AT, _TOLD = 0.75, 0.5, 0.05
#: Probability that something else changed, up to which something is told.
_OTHER = 0.5
#: nats by which an end has to be more probable than a beginning.
_RATHER_ENDS = 3.0


def diagnose_onset(
    problem: GapProblem, watch: Callable[[float, str], bool] = lambda share, message: True
) -> DiagnosisResult | None:
    """A diagnosis of what began within the recordings; None where nothing clearly did."""
    recordings = comparable_datasets(problem, problem.datasets)
    if len({names(d.outputs) for d in recordings}) > 1:
        return None  # each is compared with what is known of all
    for share in _FIRST:
        cuts = [max(int(share * len(d)), round(_LEAST / d.sample_time)) for d in recordings]
        if any(2 * cut > len(d) for cut, d in zip(cuts, recordings, strict=True)):
            return None
        try:
            look, begins, ends = _comparisons(problem, recordings, cuts, watch)
        except (TrmsError, FloatingPointError, np.linalg.LinAlgError):
            return None  # a look that fails is no reason to lose a diagnosis
        times = [cut * d.sample_time for cut, d in zip(cuts, recordings, strict=True)]
        clear, words = None, ""
        is_effect = ends is not None and ends.judged[0].difference.kind == "effect"
        if (
            begins
            and ends
            and is_effect
            and _clear(ends)
            and ends.gains[0] - begins.gains[0] > _RATHER_ENDS
        ):
            clear, words = ends, "ended is told against the last"
        elif begins and _clear(begins):
            clear, words = _later(begins, times), "began is told against the first"
        if clear:
            result, length = change_result(problem, clear), ", ".join(f"{t:.3g}" for t in times)
            warning = f"what {words} {length} s, taken for the known state"
            return replace(result, warnings=(*result.warnings, warning))
        if look.unchanged > _CALM:
            return None
    return None


def _clear(comparison: StateComparison) -> bool:
    """Whether something changed, at a moment, and has a name."""
    has_name = comparison.unchanged < _TOLD and comparison.unnamed < _OTHER
    return has_name and comparison.judged[0].began is not None


def _comparisons(
    problem: GapProblem,
    recordings: list[Dataset],
    cuts: list[int],
    watch: Callable[[float, str], bool],
) -> tuple[StateComparison, StateComparison | None, StateComparison | None]:
    """The rests of recordings against their beginnings: a look, and all if it sees something.

    Then their beginnings against their last parts, too.
    """

    def known(parts: list[Dataset]) -> KnownState:
        return known_state(problem.model, nominal_parameters(problem.model), parts)

    def within(low: float, reach: float) -> Callable[[float, str], bool]:
        return lambda share, message: watch(low + reach * share, message)

    pairs = list(zip(recordings, cuts, strict=True))
    first, rest = known([d.part(0, cut) for d, cut in pairs]), [d.part(c, len(d)) for d, c in pairs]
    look = compare_with(first, rest, {}, {}, watch=within(0.0, 0.3))
    watch(0.3, "since when")
    if look.unchanged > _LOOKED_AT:
        return look, None, None
    effects = applicable_candidates(problem.model, problem.candidates)
    begins = compare_with(first, rest, *effects, problem.jobs, within(0.3, 0.35))
    last = known([d.part(len(d) - cut, len(d)) for d, cut in pairs])
    before = [d.part(0, len(d) - cut) for d, cut in pairs]
    ends = compare_with(last, before, *effects, problem.jobs, within(0.65, 0.35), ends=True)
    return look, begins, ends


def _later(comparison: StateComparison, times: list[float]) -> StateComparison:
    """With onsets counted from the beginning of the recordings and not of their rests."""
    judgements = []
    for j in comparison.judged:
        onset = j.onset
        if onset is not None:
            by = times[j.recording]
            low, high = onset.ci95
            onset = replace(onset, time_s=onset.time_s + by, ci95=(low + by, high + by))
        judgements.append(replace(j, onset=onset))
    return replace(comparison, judged=tuple(judgements), begins=tuple(times))
