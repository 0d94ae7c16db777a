"""The tables of ``docs/model-study.md``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.model_study.judgement import ANGLES, Judgement
from experiments.model_study.loops import AXES
from experiments.model_study.ranking import Ratio, Standing, choose, paired_ratio, rank
from experiments.model_study.results import Results, geometric
from experiments.model_study.study import Family
from experiments.page_tables import markdown

#: What somebody has who looks for a model, and the families that it suffices for.
HAS: Mapping[str, tuple[Family, ...]] = {
    "the data sheet, no recording": ("white",),
    "a recording and the equations": ("white", "grey"),
    "a recording, no equations": ("network", "linear"),
    "a recording, no equations, and a linear law is wanted": ("linear",),
}
_MILLI = 1e3
#: An error from which on a free run has left the rig, mrad.
_GONE = 1e5


def tables(results: Results) -> dict[str, str]:
    """All tables by their marks; those of the record only where it was there."""
    made = {
        "choice": _choice(results),
        "loops": _loops(results),
        "free runs": _free_runs(results),
        "errors": _errors(results),
        "forms": _forms(results),
        "time": _time(results),
        "acceptance": _acceptance(results),
    }
    if results.record is not None:
        names = {name: e.name for name, e in results.study.record.models.items()}  # type: ignore[union-attr]
        forms = results.study.record.forms.models  # type: ignore[union-attr]
        made["record"] = _record(results.record.judgements, names, results.study.worst)
        made["record forms"] = _record(results.record.forms, forms, results.study.worst)
    return {name: markdown(rows) for name, rows in made.items() if len(rows) > 1}


def name_of(results: Results, entrant: str) -> str:
    """What an entrant is called."""
    return results.study.models[entrant].name


def _loops(results: Results) -> list[list[str]]:
    """The ranking, with the errors that it is made of."""
    study = results.study
    tasks = list(study.loops.chosen())
    head = ["", "model", "error over the best's", *(f"{t}: pitch, yaw [mrad]" for t in tasks)]
    rows = [[*head, "Σ\\|Δu\\| [V/s]", "rigs", "broke off"]]
    for place, s in enumerate(results.by_loop, start=1):
        errors = []
        for task in tasks:
            pair = [_mean([r.loops[task][s.name].rmse[a] for r in results.common]) for a in AXES]
            errors.append(", ".join(_milli(value) for value in pair))
        task = results.ranked_tasks[0]
        moved = _mean([sum(r.loops[task][s.name].movement.values()) for r in results.common])
        ratio = "1" if s.is_first else _ratio(s.against_first)
        broke = f"{s.failures}" if s.failures else "–"
        rows.append(
            [
                str(place),
                name_of(results, s.name),
                ratio,
                *errors,
                f"{moved:.1f}",
                str(s.rigs),
                broke,
            ]
        )
    return rows


def _free_runs(results: Results) -> list[list[str]]:
    """The ranking by free runs, with residual tests."""
    horizons = [str(h) for h in results.study.horizons]
    head = ["", "model", "error over no change's", "over the best's"]
    head += [f"pitch, yaw at {float(h):g} s" for h in horizons]
    rows = [[*head, "failed tests"]]
    for place, s in enumerate(results.by_free_runs, start=1):
        cells = []
        for horizon in horizons:
            pair = [results.over_no_change(s.name, [a], horizon) for a in ANGLES]
            cells.append(", ".join(f"{value:.2f}" for value in pair))
        failed = [r.judgements[s.name].failed_tests for r in results.common]
        tests = max(r.judgements[s.name].tests for r in results.common)
        ratio = "1" if s.is_first else _ratio(s.against_first)
        words = f"{np.median(failed):g} of {tests}"
        rows.append(
            [
                str(place),
                name_of(results, s.name),
                f"{results.over_no_change(s.name):.3f}",
                ratio,
                *cells,
                words,
            ]
        )
    return rows


def _errors(results: Results) -> list[list[str]]:
    """RMS of free runs of the angles, medians over the rigs."""
    horizons = [str(h) for h in results.study.horizons]
    words = [f"{float(h):g} s" for h in horizons]
    rows = [["model", *(f"pitch, {w}" for w in words), *(f"yaw, {w}" for w in words)]]
    for name in results.names:
        cells = [
            _milli(float(np.median([r.judgements[name].errors[angle][h] for r in results.common])))
            for angle in ANGLES
            for h in horizons
        ]
        rows.append([name_of(results, name), *cells])
    first = results.names[0]
    cells = [
        _milli(float(np.median([r.judgements[first].unchanged[angle][h] for r in results.common])))
        for angle in ANGLES
        for h in horizons
    ]
    return [*rows, ["no change", *cells]]


def _forms(results: Results) -> list[list[str]]:
    """Newtonian and Lagrangian, each against the rigs, and then each other."""
    pairs = [
        ("as they are", "newtonian", "lagrangian"),
        ("multiple shooting", "newtonian_shooting", "lagrangian_shooting"),
    ]
    head = ["parameters", "form", "RMS against the rig over 0.5 s: pitch, yaw [mrad]"]
    head += ["over 2 s", "error over no change's", "in the loop: pitch, yaw [mrad]"]
    rows = [[*head, "Lagrangian over Newtonian: free runs", "in the loop"]]
    task = results.ranked_tasks[0]
    for words, *forms in pairs:
        if not all(form in results.names for form in forms):
            continue
        free, loop = (
            paired_ratio(*(errors(form) for form in reversed(forms)))
            for errors in (
                results.free_run_errors,
                lambda form: results.loop_errors(form, results.ranked_tasks),
            )
        )
        for form, name in zip(forms, ("Newtonian", "Lagrangian"), strict=True):
            free_runs = [
                ", ".join(
                    _milli(_mean([r.judgements[form].errors[a][h] for r in results.rigs_of(form)]))
                    for a in ANGLES
                )
                for h in ("0.5", "2.0")
            ]
            closed = ", ".join(
                _milli(_mean([r.loops[task][form].rmse[a] for r in results.rigs_of(form)]))
                for a in AXES
            )
            over = f"{geometric(results.free_run_errors(form)):.3f}"
            both = [_ratio(free), _ratio(loop)] if name == "Lagrangian" else ["", ""]
            rows.append([words, name, *free_runs, over, closed, *both])
    return rows


def _time(results: Results) -> list[list[str]]:
    """What a model costs; of the machine that made the page."""
    tasks = list(results.study.loops.chosen())
    head = ["model", "fitted numbers", "fit [s]"]
    rows = [[*head, *(f"a control sample, {task} [ms]" for task in tasks)]]
    for name in results.names:
        fits = [r.fits[name] for r in results.rigs_of(name)]
        numbers = int(np.median([f.coefficients for f in fits]))
        fit = f"{results.seconds(name):.1f}" if results.study.models[name].fit else "–"
        steps = [f"{results.step_ms(name, task):.2f}" for task in tasks]
        rows.append([name_of(results, name), str(numbers) if numbers else "–", fit, *steps])
    return rows


def _acceptance(results: Results) -> list[list[str]]:
    """Which law takes which model; why not, below the table, is the program's own word."""
    answers = results.acceptance
    models = list(next(iter(answers.values()), {}))
    rows = [["law", *(name_of(results, m) for m in models), "what it says"]]
    for law, by_model in answers.items():
        reasons = dict.fromkeys(p.partition(" (")[0] for p in by_model.values() if p)
        cells = ["no" if by_model[m] else "yes" for m in models]
        rows.append([f"`{law}`", *cells, "; ".join(reasons)])
    return rows


def _choice(results: Results) -> list[list[str]]:
    """The model to take, by what somebody has."""
    level = results.study.loops.level
    head = ["who has", "take", "error over the best of all", "as good, not taken"]
    rows = [[*head, "best in free runs"]]
    ranked = results.ranked_tasks
    best = next(s.name for s in results.by_loop if s.is_first)
    effort = {name: results.seconds(name) for name in results.names}
    cases = {"anything": ("white", "grey", "network", "linear"), **HAS}
    for words, families in cases.items():
        names = [n for n in results.names if results.study.models[n].family in families]
        if not names:
            continue
        standings = rank({n: results.loop_errors(n, ranked) for n in names})
        taken, equals = choose(standings, effort, level)
        ratio = paired_ratio(results.loop_errors(taken, ranked), results.loop_errors(best, ranked))
        others = "; ".join(name_of(results, n) for n in equals if n != taken) or "–"
        foresight: Standing = rank({n: results.free_run_errors(n) for n in names})[0]
        over = "1" if taken == best else _ratio(ratio)
        rows.append(
            [words, name_of(results, taken), over, others, name_of(results, foresight.name)]
        )
    return rows


def _record(
    judgements: Mapping[str, Judgement], names: Mapping[str, str], worst: float
) -> list[list[str]]:
    """Models on the held-out part of the record, the best first."""
    if not judgements:
        return []
    first = next(iter(judgements.values()))
    horizons = list(first.errors[ANGLES[0]])
    head = ["model", "error over no change's", *(f"pitch, {float(h):g} s" for h in horizons)]
    rows = [[*head, *(f"yaw, {float(h):g} s" for h in horizons), "failed tests"]]
    for name in sorted(judgements, key=lambda n: judgements[n].relative(worst)):
        judgement = judgements[name]
        cells = [_milli(judgement.errors[angle][h]) for angle in ANGLES for h in horizons]
        tests = f"{judgement.failed_tests} of {judgement.tests}"
        rows.append([names[name], f"{judgement.relative(worst):.3f}", *cells, tests])
    cells = [_milli(first.unchanged[angle][h]) for angle in ANGLES for h in horizons]
    return [*rows, ["no change", "1", *cells, "–"]]


def _ratio(ratio: Ratio) -> str:
    if math.isnan(ratio.value):
        return "–"
    interval = "" if math.isnan(ratio.low) else f" [{ratio.low:.2f}, {ratio.high:.2f}]"
    return f"{ratio.value:.2f}{interval}"


def _milli(value: float) -> str:
    """rad as mrad, three digits."""
    milli = _MILLI * value
    if not math.isfinite(milli) or milli > _GONE:
        return "ran away"
    return f"{milli:.0f}" if milli >= 100 else f"{milli:.3g}"


def _mean(values: Sequence[float]) -> float:
    present = [value for value in values if math.isfinite(value)]
    return float(np.mean(present)) if present else math.inf
