"""What a sweep has to tell: how it stands, what was searched or drawn, what to type next.

Made of the documents alone (``trms.sweep-status/1``, and in it the summary of the sampler), so
that a screen shows of an old sweep what it showed at its end.
"""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from trms_cli.core import wording
from trms_cli.core.findings import Cell, Findings, NextCommand, Section, Table
from trms_cli.core.invocation import program
from trms_cli.sweeps.outcome import few
from trms_cli.sweeps.space import short_keys

#: Pictures that are drawn of a summary, by its kind.
PICTURES = {
    "optimisation": ("pareto.png", "search.png"),
    "robustness": ("robustness.png", "sensitivity.png"),
}
_MOST_ROWS = 12
_MOST_REASONS = 5
_MOST_NUMBERS = 6
#: So many parameters are named for each figure.
_MOST_NAMED = 5
#: Of p values that are adjusted for their number.
_LEVEL = 0.05
#: What runs are given because they are many.
_SET_BY_SWEEPS = ("picture", "sim.scene_every", "sim.estimate_every")
_STATES = ("failed", "lost", "interrupted", "running", "left")


def sweep_findings(document: Mapping[str, Any]) -> Findings:
    """How a sweep stands.

    ``document``: ``trms.sweep-status/1``.
    """
    counts, summary = document["counts"], document["summary"]
    of = "" if document["total"] is None else f" of {document['total']}"
    states = [f"{counts[state]} {state}" for state in _STATES if counts.get(state)]
    lead = [", ".join([f"{counts['done']}{of} runs done", *states])]
    if document["state"] != "done":
        lead[0] += "; " + ("going on" if document["driven"] else "stopped before its end")
    facts = {}
    if document["rate"]:
        retried = f", {document['retried']} tried again" if document["retried"] else ""
        facts["rate"] = f"{rate(document['rate'])}{retried}"
    best = document["best"]
    if not summary and best is not None and counts["done"] > 1:
        facts["best"] = f"run {best['run']}  {best['objective']:.4g}  {few(best['overrides'])}"
    folder = Path(document["folder"])
    pictures = [folder / name for name in PICTURES.get(summary.get("kind", ""), ())]
    picture_files = {path.stem: path for path in pictures if path.is_file()}
    about = summary_findings(summary, document["primary"])
    warnings = list(about.warnings)
    if document["failures"] and all(each.get("bad_input") for each in document["failures"]):
        warnings.append(
            "mend what was typed and make the sweep anew: each of these runs would fail again of "
            "the same"
        )
    return Findings(
        "",
        [*lead, *about.lead],
        [*_runs(document), *_failures(document), *about.sections],
        warnings=warnings,
        facts=facts,
        files=picture_files | {"folder": folder},
        next=[*about.next, *_next(document)],
    )


def summary_findings(summary: Mapping[str, Any], primary: str = "run") -> Findings:
    """What the sampler of a sweep has to tell; nothing of one that tells nothing."""
    match summary.get("kind"):
        case "optimisation":
            return _search(summary, primary)
        case "robustness":
            return _robustness(summary)
    return Findings("", [])


def rate(runs_per_second: float) -> str:
    """``6.3 runs/s``, ``12 runs/min``."""
    if runs_per_second >= 1:
        return f"{runs_per_second:.3g} runs/s"
    return f"{60 * runs_per_second:.3g} runs/min"


def _runs(document: Mapping[str, Any]) -> list[Section]:
    """What each run says of itself, for a sweep of few."""
    rows = [[line.strip()] for line in document["told"]]
    return [Section("Runs", blocks=[Table([""], rows)])] if rows else []


def _failures(document: Mapping[str, Any]) -> list[Section]:
    failures = document["failures"]
    if not failures:
        return []
    rows: list[list[Cell]] = []
    for failure in failures[:_MOST_REASONS]:
        where = f"{failure['where']}: " if failure["where"] else ""
        numbers = ", ".join(map(str, failure["runs"][:_MOST_NUMBERS]))
        more = ", …" if failure["count"] > _MOST_NUMBERS else ""
        problem = "\n".join(part for part in (failure["problem"], failure["remedy"]) if part)
        rows.append([failure["state"], f"{failure['count']}×", where + problem, numbers + more])
    remaining = len(failures) - _MOST_REASONS
    caption = f"and {wording.count(remaining, 'other reason')} (--json)" if remaining > 0 else ""
    columns = ["state", "runs", "why", "which"]
    return [Section("Failures", blocks=[Table(columns, rows, caption)])]


def _next(document: Mapping[str, Any]) -> list[NextCommand]:
    quoted, trms = shlex.quote(str(document["folder"])), program()
    counts, failures = document["counts"], document["failures"]
    going_on = counts.get("left") or counts.get("interrupted") or document["state"] != "done"
    if document["driven"]:
        return [NextCommand(f"{trms} watch {quoted}")]
    if going_on:
        return [NextCommand(f"{trms} sweep resume {quoted}")]
    if any(not failure.get("bad_input") for failure in failures):
        return [NextCommand(f"{trms} sweep resume {quoted} --retry-failed")]
    if failures:  # each of these runs would fail again of the same
        return []
    if document["primary"] == "run":
        return [
            NextCommand(f"{trms} compare {quoted}"),
            NextCommand(f"{trms} runs --in {quoted} --sort rmse"),
        ]
    return []


def trial_to_run(summary: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The best trial; of a front the one nearest to what would be best in everything.

    Nearness is measured in spans of the front.
    """
    best = front_of(summary)
    if not best:
        return None
    losses = np.array([_losses(summary, each) for each in best])
    span = np.ptp(losses, axis=0)
    scaled = (losses - losses.min(axis=0)) / np.where(span > 0, span, 1.0)
    return best[int(np.linalg.norm(scaled, axis=1).argmin())]


def front_of(summary: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The best trials, along the first objective."""
    by_number = {each["trial"]: each for each in summary["trials"]}
    return [by_number[number] for number in summary["pareto"]]


def baseline_of(summary: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The trial of the configuration as it was, if it was tried."""
    if summary.get("baseline") is None:
        return None
    return next((t for t in summary["trials"] if t["trial"] == summary["baseline"]), None)


def _search(summary: Mapping[str, Any], primary: str) -> Findings:
    trials = summary["trials"]
    failed = sum("problem" in each for each in trials)
    beyond = sum(not each["allowed"] for each in trials) - failed
    parts = [f"{len(trials)} trials by {summary['method']}"]
    if summary["conditions"] > 1:
        parts.append(f"{summary['over_conditions']} of {summary['conditions']} conditions each")
    parts += [f"{failed} failed"] * bool(failed) + [f"{beyond} beyond a limit"] * bool(beyond)
    title = ", ".join(parts)
    best, before = front_of(summary), baseline_of(summary)
    if not best:
        return Findings("", [title, "no trial ran to its end within the limits"])
    trial = trial_to_run(summary)
    rows = _few(best, trial)
    notes = []
    if any("confirmed" in each for each in best):
        notes.append(
            "again: under fresh conditions, an estimate, while the score of the best was chosen"
        )
    if len(rows) < len(best):
        notes.append(f"{len(best)} trials are on the front; --json has all")
    table = _trials(summary, rows, before, "; ".join(notes))
    lead = [title, *_gains(summary, best, before)]
    return Findings("", lead, [Section("Trials", blocks=[table])], next=_alone(summary, primary))


def _alone(summary: Mapping[str, Any], primary: str) -> list[NextCommand]:
    trial = trial_to_run(summary)
    if trial is None or not trial["overrides"]:
        return []
    fixed = [word for word in summary["fixed"] if word.partition("=")[0] not in _SET_BY_SWEEPS]
    words = shlex.join([*fixed, *trial["overrides"]])
    return [NextCommand(f"{program()} {primary} {words}", f"trial {trial['trial']} alone")]


def _trials(
    summary: Mapping[str, Any],
    rows: Sequence[Mapping[str, Any]],
    before: Mapping[str, Any] | None,
    caption: str,
) -> Table:
    objectives, keys = summary["objectives"], list(rows[0]["values"])
    names = short_keys(keys)
    confirmed = any("confirmed" in each for each in rows)
    columns = ["trial"]
    for objective in objectives:
        sign = "↑" if objective["direction"] == "maximise" else "↓"
        columns.append(f"{wording.with_unit(_spaced(objective['name']), objective['unit'])} {sign}")
        columns += ["again"] * confirmed
    columns += [_spaced(names[key]) for key in keys]

    def cells(name: str, trial: Mapping[str, Any]) -> list[Cell]:
        values: list[Cell] = [name]
        for objective in objectives:
            values.append(_number(trial["figures"].get(objective["name"])))
            if confirmed:
                again = trial.get("confirmed", {}).get("figures", {})
                values.append(_number(again.get(objective["name"])))
        return values + [_number(trial["values"].get(key)) for key in keys]

    table_rows = [each for each in rows if before is None or each["trial"] != before["trial"]]
    body = [cells(str(each["trial"]), each) for each in table_rows]
    if before is not None:
        body.append(cells("before", before))
    return Table(columns, body, caption)


def _spaced(name: str) -> str:
    """A key that a narrow column may fold."""
    return name.replace(".", ". ").replace("_", "_ ").replace("_ weights", "_weights")


def _number(value: float | None) -> Cell:
    return None if value is None else wording.number(float(value), 4)


def _gains(
    summary: Mapping[str, Any],
    best: Sequence[Mapping[str, Any]],
    before: Mapping[str, Any] | None,
) -> list[str]:
    """By how much the best are better than what was, also where they were run again."""
    if before is None:
        return []
    if not before["figures"]:
        return [f"the configuration as it was failed: {before.get('problem', '')}"]
    lines = []
    for objective in summary["objectives"]:
        name = objective["name"]
        pick = max if objective["direction"] == "maximise" else min
        first = pick(best, key=lambda each: each["figures"][name])
        words = _change(first["figures"].get(name), before["figures"].get(name))
        again = _change(
            first.get("confirmed", {}).get("figures", {}).get(name),
            before.get("confirmed", {}).get("figures", {}).get(name),
        )
        fresh = f", {again} under fresh conditions" if again else ""
        lines.append(f"{name}: trial {first['trial']} {words}{fresh} against as it was")
    if len(summary["objectives"]) > 1:
        mine = np.array([_losses(summary, each) for each in best])
        better = np.all(mine < np.array(_losses(summary, before)), axis=1)
        numbers = [str(each["trial"]) for each, one in zip(best, better, strict=True) if one]
        lines.append(
            f"better in everything: trials {', '.join(numbers[:_MOST_ROWS])}"
            if numbers
            else "none is better than as it was in everything"
        )
    return lines


def _change(value: float | None, before: float | None) -> str:
    if value is None or not before:
        return ""
    return f"{100 * (value / before - 1):+.1f} %"


def _losses(summary: Mapping[str, Any], trial: Mapping[str, Any]) -> list[float]:
    return [
        trial["figures"][o["name"]] * (-1.0 if o["direction"] == "maximise" else 1.0)
        for o in summary["objectives"]
    ]


def _few(
    best: Sequence[Mapping[str, Any]], trial: Mapping[str, Any] | None
) -> list[Mapping[str, Any]]:
    """At most a screenful, evenly along the front, with the one that is to be run."""
    if len(best) <= _MOST_ROWS:
        return list(best)
    at = set(np.linspace(0, len(best) - 1, _MOST_ROWS).round().astype(int).tolist())
    return [each for i, each in enumerate(best) if i in at or each is trial]


def choices_of(group: Mapping[str, Any]) -> str:
    """``controller=pid``; "all" where nothing was chosen."""
    keys = short_keys(list(group["choices"]))
    return " ".join(f"{keys[key]}={value}" for key, value in group["choices"].items()) or "all"


def _robustness(summary: Mapping[str, Any]) -> Findings:
    if not summary["groups"]:
        return Findings("", [])
    varied = summary["varied"]
    named = ", ".join(short_keys(varied)[key] for key in varied[:3])
    more = f", … ({len(varied)})" if len(varied) > 3 else ""
    limits = ", ".join(f"{name} ≤ {bound:g}" for name, bound in summary["limits"].items())
    sensitivities = _sensitivities(summary)
    none = "no figure is correlated with a drawn value, as far as these runs can tell"
    return Findings(
        "",
        [f"drawn: {named}{more}"],
        [
            Section("Distributions", blocks=[_distributions(summary)]),
            Section("Failures", blocks=[_shares_failed(summary, limits)]),
            Section("Sensitivity", blocks=[sensitivities] if sensitivities.rows else []),
        ],
        warnings=[] if sensitivities.rows else [none],
    )


def _distributions(summary: Mapping[str, Any]) -> Table:
    several = len(summary["groups"]) > 1
    columns = ["figure", "of", "median", "5 %", "95 %", "worst", *["best on"] * several]
    rows: list[list[Cell]] = []
    for name, about in summary["figures"].items():
        for group in summary["groups"]:
            figures = group["figures"].get(name)
            if figures is None:
                continue
            cells: list[Cell] = [wording.with_unit(name, about["unit"]), choices_of(group)]
            cells += [figures[key] for key in ("median", "q05", "q95", "max")]
            rows.append(cells + [wording.percent(figures.get("best_share"))] * several)
    return Table(columns, rows, heads=2)


def _shares_failed(summary: Mapping[str, Any], limits: str) -> Table:
    rows: list[list[Cell]] = []
    for group in summary["groups"]:
        failures = group["failures"]
        share = failures["share"]
        loss_remark = f" and {group['lost']} lost with their workers" if group["lost"] else ""
        has_share = share is not None
        rows.append(
            [
                choices_of(group),
                failures["draws"],
                f"{failures['count']}{loss_remark}",
                wording.percent(share, 1),
                wording.percent_interval(failures["low"], failures["high"], 1)
                if has_share
                else None,
            ]
        )
    what = "failed, or beyond a limit" if limits else "failed"
    caption = f"limits: {limits}" if limits else ""
    return Table([what, "draws", "failures", "share", "95 %"], rows, caption)


def _sensitivities(summary: Mapping[str, Any]) -> Table:
    short = short_keys(summary["varied"])
    rows: list[list[Cell]] = []
    for name in summary["figures"]:
        for group in summary["groups"]:
            words = [
                f"{short[each['key']]} {each['rho']:+.2f}"
                for each in group["sensitivity"]
                if each["figure"] == name and each["p"] < _LEVEL
            ]
            if words:
                rows.append([name, choices_of(group), wording.listing(words, most=_MOST_NAMED)])
    return Table(["rank correlation with", "of", "strongest first"], rows, heads=2)
