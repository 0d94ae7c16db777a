"""A comparison with a known state as a diagnosis: verdict, causes, places, onset, the sentence."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.special import logsumexp

from trms_cli.core.wording import gap_share, listing, number, readable
from trms_cli.effects.constant_torque import ConstantTorque
from trms_cli.gap.change import StateComparison
from trms_cli.gap.change_shrinkage import change_shrinkage, stand_in
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
from trms_cli.gap.moved_parameters import WORTH_TELLING, change_in_words
from trms_cli.gap.problem import (
    GapProblem,
    diagnosed_recordings,
    mean_pitch,
    poor_excitation,
)
from trms_cli.gap.shrinkage import TOLD_AT, Shrinkage
from trms_cli.gap.wording import ELSEWHERE, probability_text, sizes

#: Probability from which a verdict is given, and below which a cause is not told.
_DECIDED, _LEAST = 0.5, 0.002


def change_result(problem: GapProblem, found: StateComparison) -> DiagnosisResult:
    """The comparison as a diagnosis."""
    verdict = _verdict(found)
    causes = _causes(found)
    questioned, known = found.questioned, found.questioned.known
    best = _answer(found, verdict)
    changed = verdict in ("effect", "parameters_only", "undecided")
    before = {
        f.name: f.prior_mean + d * f.scale for f, d in zip(known.free, known.moved, strict=True)
    }
    change = {}
    if verdict == "parameters_only" and best.began is None:
        change[best.difference.name] = (float(best.value[0]), float(best.sd[0]))
    # of what has ended the known state is the part that free runs are made on: nothing is left
    ended = best.began is not None and best.began.ends
    added = None if ended else _added(found, verdict, causes)
    shrinkage = None if ended else change_shrinkage(problem, found, added)
    remarks = [remark for d in (*problem.datasets, *problem.against) for remark in d.remarks]
    return DiagnosisResult(
        recordings=diagnosed_recordings(problem.datasets),
        against=diagnosed_recordings(problem.against),
        model=problem.model_name,
        seed=problem.seed,
        versions={},
        verdict=verdict,
        where=_where(found) if verdict != "no_change" else (),
        region=(),
        causes=causes,
        confusable=_confusable(found) if changed else (),
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
            for f, moved, sd in zip(known.free, known.moved, known.sd, strict=True)
        },
        gap=shrinkage.gap if shrinkage else {},
        shrink=shrinkage.shrink if shrinkage else {},
        worse=shrinkage.worse if shrinkage else (),
        next_experiment=_next(problem, found) if changed and problem.advise else None,
        inclusion=_inclusion(found),
        moved=_moved(found, mean_pitch(problem.datasets)),
        rejected=_rejected(found),
        excitation=poor_excitation(problem.model, problem.datasets),
        sentence=change_sentence(found, verdict, _known_words(problem, ended), shrinkage),
        race=_race(found),
        warnings=(*problem.warnings, *dict.fromkeys(remarks)),
        effort=problem.effort,
        refit=before,
        residual=_residual(added),
        evidence={
            "gains": {
                j.difference.name: {"kind": j.difference.kind, "nats": float(gain)}
                for j, gain in zip(found.judged, found.gains, strict=True)
            },
            "usual": [dict(gained) for gained in found.between],
            "free_force": {
                e.location: float(g)
                for e, g in zip(questioned.runs.equations, found.by_equation, strict=True)
            },
            "standing": {
                e.location: error.sizes._asdict()
                for e, error in zip(questioned.runs.equations, known.errors, strict=True)
            },
        },
        traces=_traces(found, verdict),
    )


def _group(found: StateComparison) -> list[int]:
    return [0, *found.alike]


def _answer(found: StateComparison, verdict: Verdict) -> DifferenceScore:
    """The difference that a verdict is of: the likeliest, or the likeliest parameter."""
    group = [found.judged[k] for k in _group(found)]
    if verdict in ("effect", "parameters_only"):
        wanted = verdict == "parameters_only"
        return next(j for j in group if (j.difference.kind == "parameter") == wanted)
    return group[0]


def _known_words(problem: GapProblem, ended: bool) -> str:
    """What the recordings in question are compared with."""
    count = len(problem.against)
    if not count:
        several = "s" if len(problem.datasets) > 1 else ""
        return f"the {'end' if ended else 'beginning'} of the recording{several}"
    return f"the known state ({count} recording{'s' if count > 1 else ''})"


def _verdict(found: StateComparison) -> Verdict:
    if found.unchanged >= _DECIDED:
        return "no_change"
    if found.unnamed >= _DECIDED:
        return "none_of_these"
    group = _group(found)
    if found.probabilities[group].sum() < _DECIDED:
        return "undecided"
    by_kind = [found.judged[k].difference.kind == "parameter" for k in group]
    of_parameters = float(found.probabilities[group][by_kind].sum())
    return "parameters_only" if of_parameters > found.probabilities[group].sum() / 2 else "effect"


def _causes(found: StateComparison) -> tuple[Cause, ...]:
    rows = [
        Cause(effects=("no_change",), probability=found.unchanged),
        Cause(effects=("none_of_these",), probability=found.unnamed),
    ]
    of_parameters, first = 0.0, None
    for j, probability in zip(found.judged, found.probabilities.tolist(), strict=True):
        if j.difference.kind == "parameter":
            of_parameters, first = of_parameters + probability, first or j
        elif probability >= _LEAST:
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


def _added(
    found: StateComparison, verdict: Verdict, causes: Sequence[Cause]
) -> DifferenceScore | None:
    """What the corrected model has beyond the known state's."""
    best = _answer(found, verdict)
    if verdict == "parameters_only":
        return best if best.began is None else None
    if verdict == "effect":
        return best
    if verdict != "undecided":
        return None
    by_name = {j.difference.name: j for j in found.judged if j.difference.kind != "parameter"}
    return by_name.get(causes[0].effects[0])


def _residual(added: DifferenceScore | None) -> dict[str, dict[str, Any]]:
    """A constant torque as an effect of the corrected model."""
    torque = stand_in(added) if added is not None else None
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


def _where(found: StateComparison) -> tuple[LocationShare, ...]:
    """By the probabilities of the differences, each at its places; else by free forces."""
    shares: dict[str, float] = {}
    for j, probability in zip(found.judged, found.probabilities.tolist(), strict=True):
        for place in j.difference.locations:
            part = probability / len(j.difference.locations)
            shares[place] = shares.get(place, 0.0) + part
    free = np.exp(found.by_equation - logsumexp(found.by_equation)) * found.unnamed
    for equation, share in zip(found.questioned.runs.equations, free.tolist(), strict=True):
        shares[equation.location] = shares.get(equation.location, 0.0) + share
    total = sum(shares.values())
    listed = sorted(
        ((place, share / total) for place, share in shares.items()), key=lambda r: -r[1]
    )
    return tuple(
        LocationShare(location=place, share=share, ci95=_interval(share))
        for place, share in listed
        if share >= 0.02
    )


#: A tail of a 95 % interval.
_TAIL = 0.025


def _interval(share: float) -> tuple[float, float]:
    """Of a single difference's place: it is there or not, with that probability."""
    return share if share >= 1 - _TAIL else 0.0, share if share <= _TAIL else 1.0


def _confusable(found: StateComparison) -> tuple[tuple[str, ...], ...]:
    group = [
        "parameters_only"
        if found.judged[k].difference.kind == "parameter"
        else found.judged[k].difference.name
        for k in _group(found)
    ]
    unique = tuple(dict.fromkeys(group))
    return (unique,) if len(unique) > 1 else ()


#: rad, between the angle that was held and each of the two to hold next; s, at each of them.
_APART, _HELD = 0.2, 10.0
#: Differences that pull a held axis steadily; frictions are alike for other reasons.
_STEADY = {"pitch_disturbance", "yaw_disturbance", "pitch_mass_imbalance", "parameters_only"}


def _next(problem: GapProblem, found: StateComparison) -> NextExperiment | None:
    """What parts differences that are one where an axis is held: two other angles."""
    groups = [g for g in _confusable(found) if len(_STEADY.intersection(g)) > 1]
    moments = {f"{name}_moment": axis.angle for name, axis in problem.model.axes.items()}
    places = [at for at in found.judged[0].difference.locations if at in moments]
    if not groups or not places:
        return None
    angle = moments[places[0]]
    recorded = [
        d.measurements[:, i]
        for d in problem.datasets
        for i, output in enumerate(d.outputs)
        if output.name == angle
    ]
    if not recorded:
        return None
    held = float(np.nanmedian(np.concatenate(recorded)))
    words = [f"ref.{angle}.amplitude={_APART:g}", f"ref.{angle}.offset={held:.2f}"]
    words += [f"ref.{angle}.frequency={0.5 / _HELD:g}"]
    words += [f"ref.{other}.amplitude=0" for other in moments.values() if other != angle]
    return NextExperiment(
        why=f"{listing([readable(name) for name in groups[0]])} are one where {readable(angle)} is "
        f"held at {held:.2f} rad: held at {held - _APART:.2f} and {held + _APART:.2f} rad, "
        f"{_HELD:g} s each, a constant torque, a weight and a gain differ; record it on the rig, "
        "and compare it with the same recordings",
        command=f"trms run model={problem.model_name} controller=newton_mpc ref=square "
        f"{' '.join(words)} sim.duration=80",
    )


def _inclusion(found: StateComparison) -> dict[str, float]:
    return {
        j.difference.name: float(p)
        for j, p in sorted(
            zip(found.judged, found.probabilities, strict=True), key=lambda row: -row[1]
        )
        if j.difference.kind != "parameter" and p >= _LEAST
    }


def _moved(found: StateComparison, pitch: float) -> tuple[MovedParameter, ...]:
    rows = [
        (j, float(p))
        for j, p in zip(found.judged, found.probabilities, strict=True)
        if j.difference.kind == "parameter"
    ]
    total = sum(p for _, p in rows)
    if total < WORTH_TELLING:
        return ()
    model = found.questioned.known.model
    made = []
    for j, p in rows:
        if p / total < 0.02:
            continue
        name, change, sd = j.difference.name, float(j.value[0]), float(j.sd[0])
        made.append(
            MovedParameter(
                parameter=name,
                probability=p / total,
                change=change,
                sd=sd,
                unit=j.difference.units[0],
                words=change_in_words(model, model.parameters[name], change, pitch, sd),
            )
        )
    return tuple(sorted(made, key=lambda m: -m.probability))


def _rejected(found: StateComparison) -> tuple[Rejected, ...]:
    group = set(_group(found))
    rows = []
    for k, (j, gain) in enumerate(zip(found.judged, found.gains.tolist(), strict=True)):
        if k in group or j.difference.kind == "parameter":
            continue
        size = next(iter(_sizes(j).values()))
        behind = found.gains[0] - gain
        reason = "nothing in these recordings calls for it"
        if gain > 0 and behind > 0:
            reason = f"it explains the difference worse by {number(behind)} nats"
        elif gain > 0:
            reason = "it explains the difference as well, by a kind of cause that is less usual"
        rows.append(
            Rejected(
                effect=j.difference.name, score=gain, size=size, upper_bound=None, reason=reason
            )
        )
    judged = {j.difference.name for j in found.judged}
    unjudged = {
        name: "no simulation with it stays finite"
        if candidate.simulated
        else "rounding is not compared: diagnose the recording without against"
        for name, candidate in found.candidates.items()
        if name not in judged
    }
    rows += [
        Rejected(effect=name, score=None, size=None, upper_bound=None, reason=why)
        for name, why in {**unjudged, **found.left_out}.items()
    ]
    return tuple(rows)


def _race(found: StateComparison) -> tuple[RaceEntry, ...]:
    best = max(float(found.gains.max()), 1e-9)
    rows = [RaceEntry(effects=("no_change",), score=0.0, explained=0.0)]
    rows += [
        RaceEntry(
            effects=(j.difference.name,),
            score=gain,
            explained=float(np.clip(gain / best, 0.0, 1.0)),
            parameters=_sizes(j),
        )
        for j, gain in zip(found.judged, found.gains.tolist(), strict=True)
        if j.difference.kind != "parameter"
    ]
    return tuple(sorted(rows, key=lambda row: -row.score))


def _traces(found: StateComparison, verdict: Verdict) -> Traces:
    runs = found.questioned.runs
    first = runs.recording == 0
    best = _answer(found, verdict)
    known = found.questioned.known
    begin = found.begins[0] if found.begins else 0.0
    force, explained = {}, {}
    for e, equation in enumerate(runs.equations):
        values = found.questioned.forces.force[first, e]
        force[equation.location] = np.nan_to_num(values)
        own = known.errors[e].sizes
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
    )


def change_sentence(
    found: StateComparison, verdict: Verdict, known: str, shrinkage: Shrinkage | None = None
) -> str:
    """What a colleague would say; ``known``: what was compared with."""
    best = _answer(found, verdict)
    place = listing([readable(p) for p in best.difference.locations], "and")
    if verdict == "no_change":
        return (
            f"Nothing changed against {known}, with probability "
            f"{probability_text(found.unchanged)}: what these recordings lack is what those lack, "
            "within what they differ among themselves."
        )
    if verdict == "none_of_these":
        e = int(np.argmax(found.by_equation))
        where = readable(found.questioned.runs.equations[e].location)
        return (
            f"Something changed against {known} that is none of the differences tried, with "
            f"probability {probability_text(found.unnamed)}; it acts mostly on the {where}."
        )
    since, differs = "", "differs"
    if best.began is not None:
        low, high = best.began.ci95
        since, differs = (" until", "differed") if best.began.ends else (", since", "differs")
        since += f" {best.began.time_s:.1f} s ({low:.1f} to {high:.1f} s)"
    group = _group(found)
    together = float(found.probabilities[group].sum())
    others = [_name(found.judged[k]) for k in group if found.judged[k] is not best]
    text = f"Against {known} the {place} {differs}{since}: {_name(best)}"
    told = sizes(dict(list(_sizes(best).items())[:1]))
    text += f" ({told})" if told else ""
    if others:
        text += f", or what these recordings do not tell from it, {listing(others, 'or')}"
    text += f", with probability {probability_text(together)}"
    if verdict == "undecided":
        return (
            f"These recordings do not decide what changed. Likeliest: {text[0].lower()}{text[1:]}."
        )
    shrink = shrinkage.shrink["all"].get(TOLD_AT) if shrinkage else None
    if shrink is not None and shrink.fraction is not None and shrink.fraction > 0:
        closed = gap_share(shrink.fraction, shrink.ci95, "of the gap at 2 s", ELSEWHERE)
        text += f". Sized without the last part, it closes there {closed}"
    return f"{text}."


def _name(j: DifferenceScore) -> str:
    kind = j.difference.kind
    if kind == "parameter":
        return f"another {j.difference.name}"
    if kind == "torque":
        sort = "a torque that varies at random" if j.varies else "a constant torque"
        return f"{sort} on {j.difference.name.split('_')[0]}"
    return readable(j.difference.name)
