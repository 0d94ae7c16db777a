"""The page of a fit: errors first, then parameters with doubts, the search, the recordings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from trms_cli.core.findings import Cell, Judged, Judgement
from trms_cli.reporting.page import Page
from trms_cli.reporting.style import LABELS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PARTS = {"held_out": "held out", "fit": "fitted"}
_MOST_SETS = 12
#: Relative change of an error that is none.
_NO_CHANGE = 0.01


def identification_page(
    document: Mapping[str, Any], figures: Mapping[str, tuple[Figure, str]]
) -> Page:
    """Lay out a fit.

    Parameters
    ----------
    document : dict
        ``trms.identification/1``.
    figures : dict of str to (figure, caption)
        ``free_runs``, ``parameters``, ``convergence``, where they were drawn.
    """
    page = Page(
        f"Fit of {document['model']} by {document['method']}", _lead(document), _facts(document)
    )
    page.section(
        "Free runs",
        "The model alone over windows, each started from what was measured in the two seconds "
        "before it. What was held out played no part in the fit.",
    )
    page.table(
        ["output", "recording", "RMSE before", "RMSE fitted", "largest error", "fit [%]", "unit"],
        list(_error_rows(document["errors"])),
    )
    _figure(page, figures, "free_runs")
    if document["parameters"]:
        _parameters(page, document, figures)
    page.section("The search", _search(document))
    _figure(page, figures, "convergence")
    page.section("Recordings")
    page.table(
        ["recording", "part", "from [s]", "to [s]", "rate [Hz]", "SHA-256"],
        [
            [
                r["source"],
                _PARTS[r["part"]],
                r["from_s"],
                r["to_s"],
                1 / r["sample_time_s"],
                r["sha256"][:16],
            ]
            for r in document["recordings"]
        ],
    )
    remarks = dict.fromkeys(remark for r in document["recordings"] for remark in r["remarks"])
    points: list[str | Judged] = [*remarks]
    points += [
        Judged(f"{issue['problem']} ({issue['remedy']})", "doubtful")
        for issue in document["admission"]
    ]
    if points:
        page.points(points)
    return page


def _lead(document: Mapping[str, Any]) -> list[str]:
    part = "held_out" if document["errors"]["held_out"]["after"] else "fit"
    errors = document["errors"][part]
    words = []
    for name, after in (errors["after"] or {}).items():
        before = (errors["before"] or {}).get(name, {}).get("rmse")
        was = "" if before is None else f" (before: {_short(before)})"
        label = LABELS.get(name, name)
        words.append(f"{label} to **{_short(after['rmse'])} {after['unit']}**{was}")
    data = "data that it has not seen" if part == "held_out" else "the data that it was fitted to"
    length = document["windows"]["length_s"]
    first = f"Alone over windows of up to {length:g} s, on {data}, the model foretells "
    ended = f"How it ended: {document['sentence']}."
    return [first + ", ".join(words) + " RMS." if words else "", ended]


def _facts(document: Mapping[str, Any]) -> dict[str, str]:
    facts = {"command": f"`{document['command']}`"}
    if document["effects"]:
        facts["effects"] = ", ".join(document["effects"])
    if document["driven"]:
        facts["driven by measured"] = ", ".join(document["driven"])
    facts["simulations"] = str(document["evaluations"])
    facts["time"] = f"{document['seconds']['fit']:.1f} s"
    facts["versions"] = ", ".join(f"{k} {v}" for k, v in document["versions"].items())
    return facts


def _error_rows(errors: Mapping[str, Any]) -> list[list[Cell]]:
    rows: list[list[Cell]] = []
    for part, words in _PARTS.items():
        before = errors[part]["before"] or {}
        for name, after in (errors[part]["after"] or {}).items():
            was = before.get(name, {}).get("rmse")
            mark: Judgement = ""
            if was is not None and after["rmse"] is not None:
                change = after["rmse"] / was - 1 if was > 0 else 0.0
                if abs(change) > _NO_CHANGE:
                    mark = "good" if change < 0 else "bad"
            rows.append(
                [
                    LABELS.get(name, name),
                    words,
                    was,
                    Judged(after["rmse"], mark),
                    after["max_abs_error"],
                    after["fit_percent"],
                    after["unit"],
                ]
            )
    return rows


def _parameters(
    page: Page, document: Mapping[str, Any], figures: Mapping[str, tuple[Figure, str]]
) -> None:
    page.section(
        "Parameters",
        "± is one standard deviation: of the estimate, with the residuals' own size and "
        "correlation, and of what was known before.",
    )
    rows: list[list[Cell]] = []
    for name, p in document["parameters"].items():
        bound = p["at_bound"]
        rows.append(
            [
                name,
                Judged(p["value"], sd=p["sd"]),
                p["sd"],
                p["prior_mean"],
                p["prior_sd"],
                Judged(f"{bound} bound", "doubtful") if bound else "",
                p["unit"] or "1",
            ]
        )
    page.table(["parameter", "fitted", "±", "before", "±", "", "unit"], rows)
    _figure(page, figures, "parameters")
    points = _doubts(document)
    if points:
        page.text("What these data do not tell:")
        page.points(points)


def _doubts(document: Mapping[str, Any]) -> list[Judged]:
    known = document.get("identifiability") or {}
    points = []
    for found in known.get("confounded", [])[:_MOST_SETS]:
        points.append(
            Judged(
                f"{', '.join(found['names'])} imitate each other (collinearity "
                f"{found['index']:.0f}): only a combination of them is known.",
                "doubtful",
            )
        )
    more = len(known.get("confounded", [])) - _MOST_SETS
    if more > 0:
        points.append(Judged(f"{more} more such sets: see identification.json."))
    vague = known.get("uninformed", [])
    if vague:
        points.append(
            Judged(f"{', '.join(vague)}: next to nothing; the prior decided.", "doubtful")
        )
    return points


def _search(document: Mapping[str, Any]) -> list[str]:
    settings = ", ".join(f"{k} {v}" for k, v in document["settings"].items() if k[0] != "_")
    words = [f"{document['method']}: {settings}."]
    agree = document["details"].get("starts_agree")
    if agree is not None:
        words.append(
            "All starts ended in the same optimum."
            if agree
            else "The starts ended in different optima; the best is kept."
        )
    return words


def _figure(page: Page, figures: Mapping[str, tuple[Figure, str]], name: str) -> None:
    if name in figures:
        page.figure(*figures[name])


def _short(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
