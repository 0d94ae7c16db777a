"""The judgement of several methods on one set: read, judged, as one document and as Markdown."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from experiments.command_line import process_pool
from experiments.gap.blind.judgement import FreshResult, JudgedCase, answer_of, on_fresh
from experiments.gap.blind.measures import VERY_SURE, Row, Table, Target
from experiments.gap.blind.sealing import OpenedKey
from experiments.gap.blind.severity import LEVELS
from experiments.gap.blind.statistics import Estimate, share
from trms_cli.core.data_file import not_as_written, read_json
from trms_cli.core.errors import RecordingError

SCHEMA = "trms.blind.score/1"
#: A diagnosis lies in its folder or, from other programs, as a file of the recording's name.
DOCUMENT = "diagnosis.json"
_TIMING = "blind.json"
#: Nats from which on the truth clearly explains more than a wrong answer.
_LEADS = 10.0


def judge(key: OpenedKey, folder: Path) -> list[JudgedCase]:
    """All diagnoses in a folder, by the recordings' names; those missing are left out.

    Raises RecordingError if there is none, or one that cannot be read, or one of another recording.
    """
    judged_cases = []
    for name, case in key.cases.items():
        file = _file(folder, name)
        if file is None:
            continue
        try:
            document = read_json(file)
            with not_as_written(str(file)):
                answer = answer_of(document, _seconds(file.parent))
        except (OSError, ValueError) as error:
            raise RecordingError(
                f"this is no diagnosis: {error}",
                where=str(file),
                remedy="diagnose it again: remove it, and `trms blind run`",
            ) from error
        digests = {r.get("sha256") for r in document.get("recordings", [])} - {None, ""}
        if digests and key.files[name] not in digests:
            raise RecordingError(
                f"this is the diagnosis of another recording than {name} of this set",
                where=str(file),
                remedy="give the diagnoses of this set: diagnoses=FOLDER",
            )
        judged_cases.append(JudgedCase(name=name, case=case, answer=answer))
    if not judged_cases:
        raise RecordingError(
            "there is no diagnosis of this set",
            where=str(folder),
            remedy=f"`trms blind run` writes them: NAME/{DOCUMENT}",
        )
    return judged_cases


def with_fresh(
    judged_cases: Sequence[JudgedCase], folder: Path, fresh: Path, jobs: int
) -> list[JudgedCase]:
    """The same with how the models do on the second recordings."""
    tasks = [(j, folder / j.name, fresh / f"{j.name}.csv") for j in judged_cases]
    if jobs == 1:
        fresh_results = [_on_fresh(*task) for task in tasks]
    else:
        with process_pool(jobs) as pool:
            fresh_results = list(pool.map(_on_fresh, *zip(*tasks, strict=True)))
    return [
        replace(j, fresh=fresh_result)
        for j, fresh_result in zip(judged_cases, fresh_results, strict=True)
    ]


def _on_fresh(judged_case: JudgedCase, folder: Path, recording: Path) -> FreshResult | None:
    return on_fresh(judged_case.answer, folder, recording) if recording.is_file() else None


def document_of(
    key: OpenedKey, tables: Mapping[str, Table], cases_by_method: Mapping[str, Sequence[JudgedCase]]
) -> dict[str, Any]:
    """The content of ``score.json``."""
    return {
        "schema": SCHEMA,
        "set": key.set_name,
        "seed": key.seed,
        "commitment": key.commitment,
        "cases": len(key.cases),
        "methods": {
            name: {
                "diagnosed": len(cases_by_method[name]),
                "mean_seconds": table.seconds,
                "measures": [_row(row) for row in table.rows],
                "by_effect": {
                    effect: {level: asdict(e) for level, e in levels.items()}
                    for effect, levels in table.by_effect.items()
                },
                "confusions": table.confusions,
                "reliability": asdict(table.reliability),
                "between_recordings": [asdict(spread) for spread in table.spreads],
                "judged": {j.name: _facts(j) for j in cases_by_method[name]},
            }
            for name, table in tables.items()
        },
    }


def markdown(document: Mapping[str, Any]) -> str:
    """The same as tables that documentation takes."""
    methods: Mapping[str, Any] = document["methods"]
    lines = [
        f"Set `{document['set']}`, {document['cases']} rigs, seed {document['seed']}, "
        f"commitment `{document['commitment'][:16]}…`. In brackets 95 % intervals, then the "
        "number of cases.",
        "",
        _line("measure", "reach", *methods),
        _line("---", "---", *("---" for _ in methods)),
    ]
    first = next(iter(methods.values()))
    for i, row in enumerate(first["measures"]):
        cells = [_cell(m["measures"][i]) for m in methods.values()]
        lines.append(_line(row["measure"], row["reach"] or "", *cells))
    times = [
        "–" if m["mean_seconds"] is None else f"{m['mean_seconds']:.1f} s" for m in methods.values()
    ]
    lines.append(_line("mean time", "", *times))
    values = [m["reliability"]["brier"] for m in methods.values()]
    lines.append(_line("Brier", "", *("–" if v is None else f"{v:.3f}" for v in values)))
    missing = [document["cases"] - m["diagnosed"] for m in methods.values()]
    lines.append(_line("recordings without a diagnosis", "", *map(str, missing)))
    for name, method in methods.items():
        lines += ["", f"### {name}: exact, by effect", "", *_by_effect(method["by_effect"])]
        cases = list(method["judged"].values())
        lines += ["", f"### {name}: right, by kind", "", *_by_kind(cases)]
        lines += ["", f"### {name}: what was missed", "", *_misses(cases)]
        lines += ["", f"### {name}: reliability", "", *_bins(method["reliability"]["bins"])]
        if spreads := method["between_recordings"]:
            lines += ["", f"### {name}: errors on the second recordings", "", *_spreads(spreads)]
    return "\n".join(lines) + "\n"


def figure_text(value: float | None, unit: str) -> str:
    """A figure of the table."""
    if value is None:
        return "–"
    if unit == "s":
        return f"{value:.1f} s"
    return f"{100 * value:.1f} %" if unit == "%" else f"{value:.3g}"


def reach(target: Target | None, unit: str) -> str:
    """A target in a word."""
    if target is None:
        return ""
    low, high = (_bound(v, unit) for v in (target.low, target.high))
    return {"at least": f"≥ {low}", "at most": f"≤ {high}", "within": f"{low} – {high}"}[
        target.kind
    ]


def _bound(value: float, unit: str) -> str:
    if unit == "s":
        return f"{value:g} s"
    return f"{100 * value:g} %" if unit == "%" else f"{value:g}"


def _file(folder: Path, name: str) -> Path | None:
    places = (folder / name / DOCUMENT, folder / f"{name}.json")
    return next((place for place in places if place.is_file()), None)


def _seconds(folder: Path) -> float | None:
    """What `trms blind run` measured, if it did."""
    try:
        return float(json.loads((folder / _TIMING).read_text(encoding="utf-8"))["seconds"])
    except (OSError, ValueError, KeyError):
        return None


def _row(row: Row) -> dict[str, Any]:
    return {
        "measure": row.measure,
        "unit": row.unit,
        **asdict(row.estimate),
        "reach": reach(row.target, row.unit) or None,
        "reached": row.is_reached,
    }


def _facts(j: JudgedCase) -> dict[str, Any]:
    return {
        "kind": j.case.kind,
        "label": j.label,
        "truth": sorted(j.case.effects),
        "severity": dict(j.case.severity),
        "duration_s": j.case.duration,
        "moved": dict(j.case.moved),
        "onset_error_s": j.onset_error,
        "verdict": j.answer.verdict,
        "first": list(j.answer.first[0]),
        "probability": j.answer.first[1],
        "where": list(j.answer.places[:1]),
        "exact": j.exact,
        "in_group": j.in_group,
        "located": j.located,
        "right": j.right,
        "lead_nats": j.lead,
        "size_errors": j.size_errors,
        "fresh": None if j.fresh is None else asdict(j.fresh),
        "seconds": j.answer.seconds,
    }


def _cell(row: Mapping[str, Any]) -> str:
    if row["value"] is None:
        return "n/a"
    text = figure_text(row["value"], row["unit"])
    if row["low"] is not None:
        low, high = figure_text(row["low"], row["unit"]), figure_text(row["high"], row["unit"])
        low, high = (t.removesuffix(" %").removesuffix(" s") for t in (low, high))
        text += f" [{low}, {high}]"
    mark = {True: " ✓", False: " ✗", None: ""}[row["reached"]]
    return f"{text} ({row['count']}){mark}"


def _line(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _by_effect(effects: Mapping[str, Mapping[str, Any]]) -> list[str]:
    columns = (*LEVELS, "all")
    lines = [_line("effect", *columns), _line("---", *("---" for _ in columns))]
    for effect, levels in effects.items():
        cells = [_of(levels.get(column)) for column in columns]
        lines.append(_line(effect, *cells))
    return lines


def _of(estimate: Mapping[str, Any] | Estimate | None) -> str:
    if estimate is None:
        return ""
    e = asdict(estimate) if isinstance(estimate, Estimate) else estimate
    return f"{round(e['value'] * e['count'])} of {e['count']}"


def _by_kind(cases: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = [_line("kind", "rigs", "right", f"said with {VERY_SURE} and more", "right of these")]
    lines.append(_line(*["---"] * 5))
    for kind in sorted({case["kind"] for case in cases}):
        right = [c["right"] for c in cases if c["kind"] == kind]
        sure = [c["right"] for c in cases if c["kind"] == kind and c["probability"] >= VERY_SURE]
        lines.append(_line(kind, str(len(right)), _share(right), str(len(sure)), _share(sure)))
    return lines


def _share(hits: Sequence[bool]) -> str:
    return _cell({**asdict(share(hits)), "unit": "%", "reached": None})


def _misses(cases: Sequence[Mapping[str, Any]]) -> list[str]:
    """Cases whose likeliest cause is not the truth: what they have, and what was said instead."""
    rows: dict[tuple[str, str], list[str]] = {}
    missed = [c for c in sorted(cases, key=lambda c: -c["probability"]) if not c["right"]]
    for case in missed:
        lead = "" if case["lead_nats"] is None else f", {case['lead_nats']:+.0f}"
        likeliest = f"{'+'.join(case['first'])} ({case['probability']:.2f}{lead})"
        rows.setdefault((case["kind"], case["label"]), []).append(likeliest)
    head = ("kind", "the rig has", "likeliest cause (probability, nats by which the truth leads)")
    lines = [_line(*head), _line(*["---"] * 3)]
    lines += [_line(*key, ", ".join(answers)) for key, answers in sorted(rows.items())]
    leads = [c["lead_nats"] for c in missed if c["lead_nats"] is not None]
    if leads:
        beyond = sum(lead >= _LEADS for lead in leads)
        lines += [
            "",
            f"{len(leads)} of the {len(missed)} were fitted with the rig's own effects, too: in "
            f"{beyond} of these they explain {_LEADS:g} nats more, and more, than what is told.",
        ]
    return lines


def _bins(bins: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = [_line("stated probability", "mean", "right", "cases"), _line(*["---"] * 4)]
    for b in bins:
        low, high = b["right_ci95"]
        right = f"{b['right']:.2f} [{low:.2f}, {high:.2f}]"
        span = f"{b['low']:.1f} to {b['high']:.1f}"
        lines.append(_line(span, f"{b['predicted']:.2f}", right, str(b["count"])))
    return lines


def _spreads(spreads: Sequence[Mapping[str, Any]]) -> list[str]:
    """Standard deviations of the logarithm, and by which factor the two models differ before."""
    head = ("channels", "models differ by", "refitted", "corrected", "difference", "correlation")
    lines = [_line(*head, "channels of rigs"), _line(*["---"] * 7)]
    for s in spreads:
        if s["high"] is None:
            band = "any" if s["low"] <= 1 else f"{s['low']:g} and more"
        else:
            band = f"{s['low']:g} to {s['high']:g}"
        figures = [f"{s[key]:.2f}" for key in ("refit", "corrected", "apart")]
        together = "–" if s["correlation"] is None else f"{s['correlation']:.2f}"
        lines.append(_line(s["channels"], band, *figures, together, str(s["count"])))
    return lines
