"""Which experiment to make next: what each would record and tell, compared.

Each of a handful of open-loop experiments is simulated; along that motion the traces of the effects
asked after are projected and compared as those of the recordings are, in nats.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.wording import listing
from trms_cli.gap.competing_model import FittedModel, Refit
from trms_cli.gap.diagnosis import NextExperiment, OpenLoopExperiment, PredictedExperiment
from trms_cli.gap.experiments import command_line
from trms_cli.gap.predicted_recording import (
    between,
    is_fitted,
    predicted_recordings,
    signatures,
    visibility,
    with_rows,
)
from trms_cli.gap.problem import CandidateEffect

#: Effects that are asked after at a time.
_AT_ONCE = 3
#: Nats that decide between two: odds of 20 to 1. Below, an experiment separates nothing.
DECIDES = 3.0
#: Nats at which an effect is visible: five standard deviations, as for what is testable.
VISIBLE = 12.5
#: Nats beyond which more does not count when several effects are to be served.
_ENOUGH = 10 * VISIBLE
#: Of names of effects that need a long load, or a beam that hangs low, to show.
_OF_LOAD = ("derating", "ground")
#: Of names of effects that show where an axis comes to rest and breaks away.
_OF_REST = ("coulomb_friction", "stribeck_friction", "hysteresis")
#: Share of the refit's discrepancy that is taken to be left once the cause is in the model.
_LEFT = 1 / 3


@dataclass(frozen=True)
class _Question:
    """What is to be found out."""

    candidates: tuple[CandidateEffect, ...]  #: With the rows that are simulated
    apart: bool  #: Whether they are to be told apart, the first from each other; else to be seen
    fitted_names: tuple[str, ...] = ()  #: Those whose first row is their fitted size
    #: Rows that the recordings do not show
    hidden_rows: Mapping[str, tuple[int, ...]] | None = None

    def worth(self, recording: FittedModel) -> tuple[float, ...]:
        """Nats that a recording gives for each thing asked, in the order asked."""
        signs = signatures(recording, self.candidates)
        names = [candidate.name for candidate in self.candidates]
        if self.apart:
            first = names[0]
            nats = [between(signs, first, other, self.fitted_names) for other in names[1:]]
            return (min(nats),)
        hidden_rows = self.hidden_rows or {}
        return tuple(visibility(signs, name, hidden_rows.get(name)) for name in names)


def advise(
    *,
    refit: Refit,
    candidates: Mapping[str, CandidateEffect],
    model_name: str,
    apart: Sequence[str] = (),
    untested: Sequence[str] = (),
    values: Mapping[str, float] | None = None,
    shares: FloatArray | None = None,
) -> NextExperiment | None:
    """The best of a handful of open-loop experiments, and what it promises.

    Each is simulated with the refitted model; along that motion the traces of the effects asked
    after are projected and compared as those of the recordings are
    (:mod:`trms_cli.gap.signatures`). A second or two on one core where the models of the effects
    are compiled, as they are after the race. None where no experiment can be predicted: in open
    loop the angles would not stay within their bounds at any amplitude.

    ``apart``: effects that cannot be told apart, the likeliest first; used where it names two or
    more. ``untested``: else these are to be made visible; the first three count. Where both are
    empty, the first of the candidates that the recordings hardly show are. ``values``: fitted sizes
    by name, ``<effect>.<size>``; the others are taken at typical sizes. ``shares``, (n_d,) array:
    discrepancy to be reckoned with; None: a third of the refit's, for most of that goes when the
    cause is in the model.
    """
    values = values or {}
    step = refit.structure.windows.sample_time
    apart_names = [name for name in apart if name in candidates]
    if len(apart_names) >= 2 and any(candidates[name].stochastic for name in apart_names):
        return _repetition_advice(apart_names, candidates, model_name, step)
    if shares is None:
        shares = np.maximum(refit.metric.discrepancy.floor, _LEFT * refit.metric.shares)
    present = replace(refit, metric=replace(refit.metric, shares=shares))
    question = _question(apart_names, untested, candidates, values, present)
    if question is None:
        return None
    now = question.worth(present)
    load, rest = (
        any(word in s.name for s in question.candidates for word in of)
        for of in (_OF_LOAD, _OF_REST)
    )
    predictions = [
        (question.worth(recording), experiment)
        for experiment, recording in predicted_recordings(
            refit, shares, model_name, load=load, rest=rest
        )
    ]
    if not predictions:
        return None
    best, experiment = max(
        predictions, key=lambda pair: sum(min(n, _ENOUGH) for n in pair[0]) + 1e-6 * sum(pair[0])
    )
    duration = sum(dataset.duration for dataset in refit.structure.problem.datasets)
    why = _why(question, now, best, experiment, duration, step, len(predictions))
    prediction = PredictedExperiment(
        experiment=experiment,
        apart=tuple(s.name for s in question.candidates) if question.apart else (),
        nats=min(best),
        longer=question.apart and min(best) * duration < min(now) * len(experiment.commands) * step,
    )
    return NextExperiment(why=why, command=experiment.command, prediction=prediction)


def _question(
    apart: Sequence[str],
    untested: Sequence[str],
    candidates: Mapping[str, CandidateEffect],
    values: Mapping[str, float],
    present: FittedModel,
) -> _Question | None:
    if len(apart) >= 2:
        selection = [candidates[name] for name in apart[:_AT_ONCE]]
        # what a fit made of one's special case says nothing of how the two differ
        for candidate in selection:
            if candidate.special_case(candidates) is not None:
                values = candidate.apart_from_special_case(values)
        rows = tuple(with_rows(candidate, values) for candidate in selection)
        return _Question(rows, True, tuple(s.name for s in selection if is_fitted(s, values)))
    names = [
        n for n in (untested or candidates) if n in candidates and not candidates[n].stochastic
    ]
    if not names:
        return None
    selection = [candidates[name] for name in names]
    if untested:
        selection = selection[:_AT_ONCE]
    signs = signatures(present, selection)
    # where nothing was asked after, those that the recordings show least
    selection = sorted(selection, key=lambda candidate: visibility(signs, candidate.name))[
        :_AT_ONCE
    ]
    hidden_rows = {
        s.name: tuple(
            np.flatnonzero(0.5 * signs.projected_energy[signs.rows(s.name)] < VISIBLE).tolist()
        )
        for s in selection
    }
    return _Question(
        tuple(selection), False, (), {name: rows for name, rows in hidden_rows.items() if rows}
    )


def _repetition_advice(
    apart: Sequence[str], candidates: Mapping[str, CandidateEffect], model_name: str, step: float
) -> NextExperiment:
    noise = [name for name in apart if candidates[name].stochastic]
    rest = [name for name in apart if name not in noise]
    against = f" from {listing(rest)}" if rest else ""
    keys = ["excitation=multisine", "excitation.periods=4", "excitation.iterations=0"]
    return NextExperiment(
        why=f"a signal that repeats itself four times tells {listing(noise)}{against}: what "
        "returns with every period belongs to the rig, what does not comes from outside; how "
        "clearly was not predicted",
        command=command_line("excite", model_name, keys, step),
    )


def _why(
    question: _Question,
    now: tuple[float, ...],
    best: tuple[float, ...],
    experiment: OpenLoopExperiment,
    duration: float,
    step: float,
    count: int,
) -> str:
    names = [candidate.name for candidate in question.candidates]
    seconds = len(experiment.commands) * step
    if question.apart:
        pair = listing(names) if len(names) > 2 else " from ".join(names)
        gain = f"{_nats(best[0])} in {seconds:.0f} s, against {_nats(now[0])} in the "
        gain += f"{duration:.0f} s recorded"
        of_the_best = f"the command is that of the best, {experiment.words}: {gain}"
        if best[0] < DECIDES:
            return (
                f"none of {count} open-loop experiments tells {pair}, and no input of this kind "
                f"does; {of_the_best}, where {DECIDES:g} would be odds of 20 to 1"
            )
        if best[0] * duration < now[0] * seconds:
            return (
                "record longer, in the way of the present recording: none of "
                f"{count} open-loop experiments tells {pair} faster. Only if that cannot be done, "
                f"{of_the_best}"
            )
        return f"{experiment.words}: tells {pair} by {gain}"
    visible = [n for n, nats in zip(names, best, strict=True) if nats >= VISIBLE]
    by = ", ".join(
        f"{name} {_nats(then)} against {_nats(before)}"
        for name, then, before in zip(names, best, now, strict=True)
        if name in visible or not visible
    )
    if not visible:
        return (
            f"none of {count} open-loop experiments makes {listing(names)} visible at typical "
            f"sizes ({VISIBLE:g} nats); the command is that of the best, {experiment.words}: {by} "
            "in what is recorded"
        )
    invisible = [name for name in names if name not in visible]
    rest = f"; {listing(invisible)} would still not show" if invisible else ""
    return (
        f"{experiment.words}: makes visible at typical sizes, in {seconds:.0f} s: {by} in what is "
        f"recorded{rest}"
    )


def _nats(value: float) -> str:
    if value < 0.05:
        return "no nats"
    return f"{value:.2g} nats" if value < 10 else f"{value:.0f} nats"
