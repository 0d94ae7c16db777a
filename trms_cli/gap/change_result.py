"""A comparison with a known state as a diagnosis: verdict, causes, places, onset, the sentence."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.special import logsumexp

from trms_cli.core.wording import gap_share, listing, number, readable
from trms_cli.effects.constant_torque import ConstantTorque
from trms_cli.gap.change import StateComparison
from trms_cli.gap.diagnosis import (
    Cause,
    DiagnosisResult,
    FittedParameter,
    LocationShare,
    MovedParameter,
    NextExperiment,
    RaceEntry,
    Rejected,
    SizeEstimate,
    Traces,
    Verdict,
)
from trms_cli.gap.evidence import DifferenceScore
from trms_cli.gap.moved_parameters import WORTH_TELLING, moved_parameter
from trms_cli.gap.problem import (
    GapProblem,
    diagnosed_recordings,
    mean_tilt,
    poor_excitation,
    recorded_values,
)
from trms_cli.gap.shrinkage import Shrinkage, change_shrinkage, stand_in
from trms_cli.gap.wording import ELSEWHERE, effects_text, probability_text, sizes
from trms_cli.models.rig_parts import diagram_rows, parts_of
from trms_cli.models.scales import port_scale

#: Probability from which a verdict is given, below which an effect's part is not told, and below
#: which a cause is left out.
_DECIDED, _LEAST, _NEGLIGIBLE = 0.5, 0.002, 1e-6


def change_result(problem: GapProblem, comparison: StateComparison) -> DiagnosisResult:
    """The comparison as a diagnosis."""
    verdict = _verdict(comparison)
    causes = _causes(comparison)
    questioned, known_state = comparison.questioned, comparison.questioned.known_state
    best = _answer(comparison, verdict)
    changed = verdict in ("effect", "parameters_only", "undecided")
    before = {f.name: known_state.model.parameters[f.name].value for f in known_state.free}
    change = {}
    if verdict == "parameters_only" and best.began is None:
        change[best.difference.name] = (float(best.value[0]), float(best.sd[0]))
    # of what has ended the known state is the part that free runs are made on: nothing is left
    ended = best.began is not None and best.began.ends
    correction = None if ended else _correction(comparison, verdict, causes)
    shrinkage = None if ended else change_shrinkage(problem, comparison, correction)
    remarks = [remark for d in (*problem.datasets, *problem.against) for remark in d.remarks]
    return DiagnosisResult(
        recordings=diagnosed_recordings(problem.datasets),
        against=diagnosed_recordings(problem.against),
        model=problem.model_name,
        seed=problem.seed,
        versions={},
        verdict=verdict,
        where=_where(comparison) if verdict != "no_change" else (),
        region=(),
        causes=causes,
        confusable=_confusable(comparison) if changed else (),
        not_testable=(),
        detectable={},
        parameters={
            f.name: FittedParameter(
                prior=float(problem.model.parameters[f.name].value),
                fitted=before[f.name] + change.get(f.name, (0.0, 0.0))[0],
                sd=float(np.hypot(sd * f.scale, change.get(f.name, (0.0, 0.0))[1])),
                unit=f.unit,
                moved=float(moved + change.get(f.name, (0.0, 0.0))[0] / f.scale),
            )
            for f, moved, sd in zip(
                known_state.free, known_state.deviation, known_state.sd, strict=True
            )
        },
        gap=shrinkage.gap if shrinkage else {},
        shrink=shrinkage.shrink if shrinkage else {},
        worse=shrinkage.worse if shrinkage else (),
        next_experiment=_next(problem, comparison) if changed and problem.advise else None,
        inclusion=_inclusion(comparison),
        moved=_moved_parameters(comparison, mean_tilt(problem.model, problem.datasets)),
        rejected=_rejected(comparison),
        excitation=poor_excitation(problem.model, problem.datasets),
        sentence=change_sentence(comparison, verdict, _baseline_words(problem, ended), shrinkage),
        race=_race(comparison),
        warnings=(*problem.warnings, *dict.fromkeys(remarks)),
        effort=problem.effort,
        refit=before,
        residual=_residual(correction),
        evidence={
            "gains": {
                j.difference.name: {
                    "kind": j.difference.kind,
                    "nats": float(gain),
                    "belief": j.belief,
                }
                for j, gain in zip(comparison.judged, comparison.gains, strict=True)
            },
            "usual": [dict(gains) for gains in comparison.between],
            "free_force": {
                e.location: float(g)
                for e, g in zip(questioned.runs.equations, comparison.by_equation, strict=True)
            },
            "standing": {
                e.location: error.sizes._asdict()
                for e, error in zip(questioned.runs.equations, known_state.errors, strict=True)
            },
        },
        traces=_traces(comparison, verdict),
    )


def _group(comparison: StateComparison) -> list[int]:
    return [0, *comparison.alike]


def _answer(comparison: StateComparison, verdict: Verdict) -> DifferenceScore:
    """The difference that a verdict is of: the likeliest, or the likeliest parameter."""
    group = [(comparison.probabilities[k], comparison.judged[k]) for k in _group(comparison)]
    if verdict in ("effect", "parameters_only"):
        is_parameter = verdict == "parameters_only"
        group = [row for row in group if (row[1].difference.kind == "parameter") == is_parameter]
        return max(group, key=lambda row: row[0])[1]
    return group[0][1]


def _baseline_words(problem: GapProblem, ended: bool) -> str:
    """What the recordings in question are compared with."""
    count = len(problem.against)
    if not count:
        several = "s" if len(problem.datasets) > 1 else ""
        return f"the {'end' if ended else 'beginning'} of the recording{several}"
    return f"the known state ({count} recording{'s' if count > 1 else ''})"


def _verdict(comparison: StateComparison) -> Verdict:
    if comparison.unchanged >= _DECIDED:
        return "no_change"
    if comparison.unnamed >= _DECIDED:
        return "none_of_these"
    group = _group(comparison)
    if comparison.probabilities[group].sum() < _DECIDED:
        return "undecided"
    by_kind = [comparison.judged[k].difference.kind == "parameter" for k in group]
    of_parameters = float(comparison.probabilities[group][by_kind].sum())
    return (
        "parameters_only" if of_parameters > comparison.probabilities[group].sum() / 2 else "effect"
    )


def _causes(comparison: StateComparison) -> tuple[Cause, ...]:
    rows = [
        Cause(effects=("no_change",), probability=comparison.unchanged),
        Cause(effects=("none_of_these",), probability=comparison.unnamed),
    ]
    of_parameters, first = 0.0, None
    for j, probability in zip(comparison.judged, comparison.probabilities.tolist(), strict=True):
        if j.difference.kind == "parameter":
            of_parameters, first = of_parameters + probability, first or j
        elif probability >= _NEGLIGIBLE:
            rows.append(
                Cause(
                    effects=(j.difference.name,),
                    probability=probability,
                    parameters=_sizes(j),
                    onset=j.began,
                )
            )
    rows.append(
        Cause(
            effects=("parameters_only",),
            probability=of_parameters,
            onset=first.began if first is not None and of_parameters > _LEAST else None,
        )
    )
    total = sum(row.probability for row in rows)
    rows = [replace(row, probability=row.probability / total) for row in rows]
    return tuple(sorted(rows, key=lambda row: -row.probability))


def _correction(
    comparison: StateComparison, verdict: Verdict, causes: Sequence[Cause]
) -> DifferenceScore | None:
    """What the corrected model has beyond the known state's."""
    best = _answer(comparison, verdict)
    if verdict == "parameters_only":
        return best if best.began is None else None
    if verdict == "effect":
        return best
    if verdict != "undecided":
        return None
    by_name = {j.difference.name: j for j in comparison.judged if j.difference.kind != "parameter"}
    return by_name.get(causes[0].effects[0])


def _residual(correction: DifferenceScore | None) -> dict[str, dict[str, Any]]:
    """A constant torque as an effect of the corrected model."""
    torque = stand_in(correction) if correction is not None else None
    if torque is None:
        return {}
    node = {"_target_": f"{ConstantTorque.__module__}.{ConstantTorque.__name__}"}
    return {
        f"{torque.axis}_constant_torque": {**node, "axis": torque.axis, "torque": torque.torque}
    }


def _sizes(j: DifferenceScore) -> dict[str, SizeEstimate]:
    d = j.difference
    return {
        f"{d.name}.{label}": SizeEstimate(value=float(value), sd=float(sd), unit=unit)
        for label, unit, value, sd in zip(d.labels, d.units, j.value, j.sd, strict=True)
    }


def _where(comparison: StateComparison) -> tuple[LocationShare, ...]:
    """By the probabilities of the differences, each at its places; else by free forces."""
    shares: dict[str, float] = {}
    for j, probability in zip(comparison.judged, comparison.probabilities.tolist(), strict=True):
        for place in j.difference.locations:
            part = probability / len(j.difference.locations)
            shares[place] = shares.get(place, 0.0) + part
    free = np.exp(comparison.by_equation - logsumexp(comparison.by_equation)) * comparison.unnamed
    for equation, share in zip(comparison.questioned.runs.equations, free.tolist(), strict=True):
        shares[equation.location] = shares.get(equation.location, 0.0) + share
    total = sum(shares.values())
    rows = sorted(((place, share / total) for place, share in shares.items()), key=lambda r: -r[1])
    ends = [(s if s >= 1 - _TAIL else 0.0, s if s <= _TAIL else 1.0) for _, s in rows]
    places = zip(rows, ends, strict=True)
    return tuple(LocationShare(location=p, share=s, ci95=e) for (p, s), e in places if s >= 0.02)


#: A tail of a 95 % interval: a single difference is at its place or not, with its probability.
_TAIL = 0.025


def _confusable(comparison: StateComparison) -> tuple[tuple[str, ...], ...]:
    group = [
        "parameters_only"
        if comparison.judged[k].difference.kind == "parameter"
        else comparison.judged[k].difference.name
        for k in _group(comparison)
    ]
    unique = tuple(dict.fromkeys(group))
    return (unique,) if len(unique) > 1 else ()


#: Travels, rad on small benches, between what was held and the two to hold next; s, at each.
_ANGLE_STEP, _HOLD_TIME = 0.2, 10.0
#: Differences that pull a held axis steadily; frictions are alike for other reasons.
_STEADY = ("_disturbance", "_mass_imbalance", "parameters_only")


def _next(problem: GapProblem, comparison: StateComparison) -> NextExperiment | None:
    """What parts differences that are one where an axis is held: two other angles."""
    groups = [g for g in _confusable(comparison) if sum(name.endswith(_STEADY) for name in g) > 1]
    moments = {axis.moment: axis.angle for axis in problem.model.axes.values()}
    places = [at for at in comparison.judged[0].difference.locations if at in moments]
    if not groups or not places:
        return None
    angle = moments[places[0]]
    angles = recorded_values(problem.datasets, angle)
    if not len(angles):
        return None
    hold_angle = float(np.median(angles))
    parts = parts_of(problem.model)
    axis = parts.axis_at(places[0])
    unit, travel = parts.unit(axis), port_scale(problem.model, axis=axis).travel
    step = float(f"{_ANGLE_STEP * travel:.2g}")
    words = [f"ref.{angle}.amplitude={step:g}", f"ref.{angle}.offset={hold_angle:.2f}"]
    words += [f"ref.{angle}.frequency={0.5 / _HOLD_TIME:g}"]
    words += [f"ref.{other}.amplitude=0" for other in moments.values() if other != angle]
    return NextExperiment(
        why=f"{effects_text(groups[0])} are one where {readable(angle)} is "
        f"held at {hold_angle:.2f} {unit}: held at {hold_angle - step:.2f} and "
        f"{hold_angle + step:.2f} {unit}, {_HOLD_TIME:g} s each, a constant torque, a weight "
        "and a gain differ; record it on the rig, and compare it with the same recordings",
        command=f"trms run model={problem.model_name} controller=newton_mpc ref=square "
        f"{' '.join(words)} sim.duration=80",
    )


def _inclusion(comparison: StateComparison) -> dict[str, float]:
    return {
        j.difference.name: float(p)
        for j, p in sorted(
            zip(comparison.judged, comparison.probabilities, strict=True), key=lambda row: -row[1]
        )
        if j.difference.kind != "parameter" and p >= _LEAST
    }


def _moved_parameters(comparison: StateComparison, tilt: float) -> tuple[MovedParameter, ...]:
    rows = [
        (j, float(p))
        for j, p in zip(comparison.judged, comparison.probabilities, strict=True)
        if j.difference.kind == "parameter"
    ]
    total = sum(p for _, p in rows)
    if total < WORTH_TELLING:
        return ()
    model = comparison.questioned.known_state.model
    parameters = []
    for j, p in rows:
        if p / total >= 0.02:
            parameter = model.parameters[j.difference.name]
            change = float(j.value[0]), float(j.sd[0])
            parameters.append(moved_parameter(model, parameter, p / total, *change, tilt))
    return tuple(sorted(parameters, key=lambda m: -m.probability))


def _rejected(comparison: StateComparison) -> tuple[Rejected, ...]:
    group = set(_group(comparison))
    rows = []
    for k, (j, gain) in enumerate(zip(comparison.judged, comparison.gains.tolist(), strict=True)):
        if k in group or j.difference.kind == "parameter":
            continue
        size = next(iter(_sizes(j).values()))
        behind = comparison.gains[0] - gain
        reason = "nothing in these recordings calls for it"
        if gain > 0 and behind > 0:
            reason = f"it explains the difference worse by {number(behind)} nats"
        elif gain > 0:
            reason = "it explains the difference as well, by a kind of cause that is less usual"
        rows.append(Rejected(effect=j.difference.name, score=gain, size=size, reason=reason))
    judged_names = {j.difference.name for j in comparison.judged}
    unjudged = {
        name: "no simulation with it stays finite"
        if candidate.simulated
        else "its steps are no coarser than in the known state"
        for name, candidate in comparison.candidates.items()
        if name not in judged_names
    }
    others = {**unjudged, **comparison.left_out}
    return (*rows, *(Rejected(effect=name, reason=why) for name, why in others.items()))


def _race(comparison: StateComparison) -> tuple[RaceEntry, ...]:
    best = max(float(comparison.gains.max()), 1e-9)
    rows = [RaceEntry(effects=("no_change",), score=0.0, explained=0.0)]
    rows += [
        RaceEntry(
            effects=(j.difference.name,),
            score=gain,
            explained=float(np.clip(gain / best, 0.0, 1.0)),
            parameters=_sizes(j),
        )
        for j, gain in zip(comparison.judged, comparison.gains.tolist(), strict=True)
        if j.difference.kind != "parameter"
    ]
    return tuple(sorted(rows, key=lambda row: -row.score))


def _traces(comparison: StateComparison, verdict: Verdict) -> Traces:
    runs = comparison.questioned.runs
    first = runs.recording == 0
    best = _answer(comparison, verdict)
    known_state = comparison.questioned.known_state
    begin = comparison.begins[0] if comparison.begins else 0.0
    force, explained = {}, {}
    for e, equation in enumerate(runs.equations):
        values = comparison.questioned.forces.force[first, e]
        force[equation.location] = np.nan_to_num(values)
        own = known_state.errors[e].sizes
        sd = float(np.hypot(own.white, np.hypot(own.slow, own.offset)))
        force[f"{equation.location}.sd"] = np.full(len(values), sd)
        if verdict in ("effect", "parameters_only", "undecided"):
            explained[equation.location] = -best.change[first, e]
    return Traces(
        force_time=begin + runs.begin[first] + runs.length / 2,
        force=force,
        force_unit={e.location: e.unit for e in runs.equations},
        explained=explained,
        run_time=np.zeros(0),
        runs={},
        rows=diagram_rows(parts_of(runs.model)),
    )


def change_sentence(
    comparison: StateComparison, verdict: Verdict, baseline: str, shrinkage: Shrinkage | None = None
) -> str:
    """What a colleague would say; ``baseline``: what was compared with."""
    best = _answer(comparison, verdict)
    place = effects_text(best.difference.locations)
    if verdict == "no_change":
        return (
            f"Nothing changed against {baseline}, with probability "
            f"{probability_text(comparison.unchanged)}: what these recordings lack is what those "
            "lack, within what they differ among themselves."
        )
    if verdict == "none_of_these":
        e = int(np.argmax(comparison.by_equation))
        where = readable(comparison.questioned.runs.equations[e].location)
        return (
            f"Something changed against {baseline} that is none of the differences tried, with "
            f"probability {probability_text(comparison.unnamed)}; it acts mostly on the {where}."
        )
    since, differs = "", "differs"
    if best.began is not None:
        low, high = best.began.ci95
        since, differs = (" until", "differed") if best.began.ends else (", since", "differs")
        since += f" {best.began.time_s:.1f} s ({low:.1f} to {high:.1f} s)"
    group = _group(comparison)
    together = float(comparison.probabilities[group].sum())
    others = [_name(comparison.judged[k]) for k in group if comparison.judged[k] is not best]
    text = f"Against {baseline} the {place} {differs}{since}: {_name(best)}"
    size_text = sizes(dict(list(_sizes(best).items())[:1]))
    text += f" ({size_text})" if size_text else ""
    if others:
        text += f", or what these recordings do not tell from it, {listing(others, 'or')}"
    text += f", with probability {probability_text(together)}"
    if verdict == "undecided":
        return (
            f"These recordings do not decide what changed. Likeliest: {text[0].lower()}{text[1:]}."
        )
    shrink = shrinkage.shrink["all"].get(shrinkage.told_at) if shrinkage else None
    if shrink is not None and shrink.fraction is not None and shrink.fraction > 0:
        of = f"of the gap at {float(shrinkage.told_at):g} s" if shrinkage else ""
        share_text = gap_share(shrink.fraction, shrink.ci95, of, ELSEWHERE)
        text += f". Sized without the last part, it closes there {share_text}"
    return f"{text}."


def _name(j: DifferenceScore) -> str:
    kind = j.difference.kind
    if kind == "parameter":
        return f"another {j.difference.name}"
    if kind == "torque":
        sort = "a torque that varies at random" if j.varies else "a constant torque"
        return f"{sort} on {j.difference.name.split('_')[0]}"
    return readable(j.difference.name)
