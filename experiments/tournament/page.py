"""Tables of the tournament: on the screen, as JSON, and in ``docs/tournament.md``."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.page_tables import number
from experiments.provenance import record_publication
from experiments.tournament.publications import Beside
from experiments.tournament.schedule import Criteria
from experiments.tournament.verdict import Results, by_rig
from trms_cli.scoring.comparison.findings import document, rule
from trms_cli.scoring.comparison.ranking import Ranking, RatioInterval, figures_of
from trms_cli.scoring.comparison.runs import State

ROOT = Path(__file__).resolve().parents[2]
PAGE, FIGURES = ROOT / "docs" / "tournament.md", ROOT / "docs" / "figures" / "tournament"
SCHEMA = "trms.tournament/1"
BEGIN, END = "<!-- made: {} begin -->", "<!-- made: {} end -->"
#: What figures show, by file name.
_SHOWN = {
    "ratios.png": "Error over the best's in every run, by entrant and class of rigs",
    "effects.png": "Error over the best's, entrants by effects",
    "cost.png": "Tracking against how much the commands move, and against the time of a step",
}
#: Rows of a list; report.json has all.
_MOST = 40

Rows = list[list[str]]


def report(
    results: Results, besides: Sequence[Beside], about: Mapping[str, Any], criteria: Criteria
) -> dict[str, Any]:
    """``trms.tournament/1``."""

    def ranking_data(ranking: Ranking | None, block: str = "main") -> dict[str, Any] | None:
        if ranking is None:
            return None
        return document(ranking, results.gathered[block], ranking.standings)

    def short(ranking: Ranking) -> list[dict[str, Any]]:
        return [
            {
                "name": standing.name,
                "rank": standing.rank,
                "ratio": standing.ratio,
                "interval": _as_list(standing.interval),
                "against_first": _finite(standing.against_first),
                "different_from_first": standing.different,
            }
            for standing in ranking.standings
        ]

    return {
        "schema": SCHEMA,
        "about": dict(about),
        "runs": results.runs,
        "aims": [{"words": a.words, "met": a.is_met, "figures": a.figures} for a in results.aims],
        "main": ranking_data(results.main),
        "faults": ranking_data(results.faults, "faults"),
        "observers": ranking_data(results.observers, "observers"),
        "classes": {name: short(ranking) for name, ranking in results.classes.items()},
        "references": {name: short(ranking) for name, ranking in results.references.items()},
        "by_rig": {
            standing.name: by_rig(results.main, standing.name)
            for standing in results.main.standings
        },
        "behind": {
            "champion": criteria.champion,
            "within": criteria.within,
            "runs": [vars(each) for each in results.behind],
        },
        "published": [
            {
                "author": beside.published.author,
                "condition": beside.published.condition,
                "rig": beside.published.rig,
                "theirs": beside.published.theirs,
                "ours": {
                    words: {"value": value, "unit": unit}
                    for words, (value, unit) in beside.figures.items()
                },
                "problem": beside.problem,
            }
            for beside in besides
        ],
    }


def tables(
    results: Results, besides: Sequence[Beside], criteria: Criteria
) -> dict[str, list[str] | Rows]:
    """What is made, by name: tables with their heads first, or lines of text."""
    contents: dict[str, list[str] | Rows] = {
        "summary": summary_lines(results),
        "ranking": ranking_rows(results.main),
        "cost": cost_rows(results.main),
        "classes": part_rows(results.classes),
        "references": part_rows(results.references),
        "behind": behind_rows(results, criteria),
        "failures": failure_lines(results),
        "published": published_rows(besides),
    }
    if results.observers is not None:
        contents["observers"] = ranking_rows(results.observers)
    if results.faults is not None:
        contents["faults"] = fault_rows(results.faults)
    return contents


def summary_lines(results: Results) -> list[str]:
    """The aims, met or missed."""
    words = {True: "**met**", False: "**missed**", None: "not told"}
    return [f"- {aim.words}: {words[aim.is_met]} ({aim.figures})" for aim in results.aims]


def ranking_rows(ranking: Ranking) -> Rows:
    """Rank, tracking with intervals, robustness."""
    head = "|entrant|runs|RMSE [rad]|over best|95 %|over first|95 %||p95|worst"
    rows = [head.split("|")]
    for standing in ranking.standings:
        figures = figures_of(standing, ranking.metric)
        first = standing.rank == 1
        mark = {None: "", True: "≠", False: "="}[standing.different]
        rows.append(
            [
                "" if standing.rank is None else str(standing.rank),
                standing.name,
                str(figures.runs),
                number(figures.error_mean),
                _ratio(standing.ratio),
                _between(standing.interval),
                "" if first else _ratio(standing.against_first),
                "" if first else _between(standing.against_interval),
                "" if first else mark,
                _ratio(figures.ratio_p95),
                _ratio(figures.ratio_worst),
            ]
        )
    return rows


def cost_rows(ranking: Ranking) -> Rows:
    """Effort, time of a step, failures."""
    rows = [["", "entrant", "∫u²dt [V² s]", "Σ\\|Δu\\| [V]", "step [ms]", "p99 [ms]"]]
    rows[0] += ["failed runs", "not finite", "fall-backs", "deadlines missed", "degraded [s]"]
    for standing in ranking.standings:
        figures = figures_of(standing, ranking.metric)
        rows.append(
            [
                "" if standing.rank is None else str(standing.rank),
                standing.name,
                number(figures.effort),
                number(figures.variation),
                number(figures.step_ms, 2),
                number(figures.step_p99_ms, 2),
                str(figures.failed),
                "–" if figures.non_finite is None else str(figures.non_finite),
                str(figures.fallbacks),
                str(figures.missed),
                number(figures.degraded_s),
            ]
        )
    return rows


def part_rows(parts: Mapping[str, Ranking]) -> Rows:
    """Error over the best, an entrant a row and a part of the runs a column."""
    names = list(dict.fromkeys(each.name for part in parts.values() for each in part.standings))
    rows = [["entrant", *parts]]
    for name in names:
        cells = [name]
        for ranking in parts.values():
            standing = next((each for each in ranking.standings if each.name == name), None)
            if standing is None:
                cells.append("–")
                continue
            place = "" if standing.rank is None else f" ({standing.rank})"
            cells.append(f"{_ratio(standing.ratio)}{place}")
        rows.append(cells)
    return rows


def behind_rows(results: Results, criteria: Criteria) -> Rows:
    """Where the champion is not within the limit."""
    rows = [["class", "rig", "reference", "over best", "best", "RMSE [rad]", "best's [rad]"]]
    rows += [
        [b.rig_class, b.rig, b.ref, _ratio(b.ratio), b.best, number(b.error), number(b.best_error)]
        for b in results.behind[:_MOST]
    ]
    return rows


def fault_rows(ranking: Ranking) -> Rows:
    """RMSE and degraded time, a fault a row and an entrant a column."""
    entrants = ranking.standings
    rows = [["fault", *(standing.name for standing in entrants)]]
    for c in range(len(ranking.contest.conditions)):
        condition = ranking.contest.conditions[c]
        cells = [condition.get("rig", "").removeprefix("fault_").replace("_", " ")]
        for standing in entrants:
            at = [i for i, each in enumerate(standing.conditions) if int(each) == c]
            if not at:
                cells.append("–")
                continue
            run = standing.runs[at[0]]
            if run.state is State.FAILED:
                cells.append("failed")
                continue
            degraded = run.of_run("degraded")
            words = f", {number(degraded)} s" if degraded > 0 else ""
            cells.append(f"{number(run.error(ranking.metric))}{words}")
        rows.append(cells)
    return rows


def failure_lines(results: Results) -> list[str]:
    """Runs that failed, each once."""
    failed = {
        tuple(run.coordinates.values()): run
        for run in results.all_runs()
        if run.state is State.FAILED
    }
    if not failed:
        return ["No run failed."]
    lines = [
        f"- `{run.coordinates.get('controller')}` with `{run.coordinates.get('observer')}` on "
        f"{run.coordinates.get('rig')}, {run.coordinates.get('ref')}: {run.message}"
        for run in failed.values()
    ]
    more = len(lines) - _MOST
    return lines[:_MOST] + ([f"- and {more} more (`report.json`)"] if more > 0 else [])


def published_rows(besides: Sequence[Beside]) -> Rows:
    """Theirs and ours."""
    rows = [["source", "condition", "theirs", "ours, simulated (`newton_mpc` and `ukf`)"]]
    for beside in besides:
        published = beside.published
        ours = "not repeated: the condition is not told, or needs their record"
        if beside.problem:
            ours = f"failed: {beside.problem}"
        elif beside.figures:
            ours = "; ".join(
                f"{words} {'not reached' if value is None else f'{number(value)} {unit}'}"
                for words, (value, unit) in beside.figures.items()
            )
            if published.ours is not None and published.ours.note:
                ours += f" ({published.ours.note})"
        rows.append(
            [published.author, published.condition, f"{published.theirs} ({published.rig})", ours]
        )
    return [[cell.replace("|", "\\|") for cell in row] for row in rows]


def print_results(results: Results) -> None:
    """The ranking as ``trms compare`` prints it, then the aims."""
    from trms_cli.reporting.screen import show, terminal
    from trms_cli.scoring.comparison.findings import ranking_findings

    out = terminal()
    main = results.main
    show(ranking_findings(main, results.gathered["main"], main.standings), "compare", rows=100)
    words = {True: ("met", "bold green"), False: ("missed", "bold red"), None: ("not told", "")}
    out.print()
    for aim in results.aims:
        word, style = words[aim.is_met]
        out.print([(f"{word:>8}", style), (f"  {aim.words}: {aim.figures}", "")])


def markdown(rows: Rows) -> str:
    """A table of Markdown; text to the left, numbers to the right."""
    head, *body = rows
    right = [_is_number(column) for column in zip(*body, strict=True)] if body else []
    lines = ["| " + " | ".join(head) + " |"]
    lines.append(
        "|" + "|".join("---:" if at else "---" for at in right or [False] * len(head)) + "|"
    )
    lines += ["| " + " | ".join(row) + " |" for row in body]
    return "\n".join(lines)


def publish(
    contents: Mapping[str, list[str] | Rows],
    about: Mapping[str, Any],
    results: Results,
    figures: Sequence[Path],
    page: Path = PAGE,
    folder: Path = FIGURES,
) -> None:
    """Rewrite the page between its marks, and copy the figures.

    Raises ValueError if the page lacks the marks of a part.
    """
    text = page.read_text(encoding="utf-8")
    parts: dict[str, list[str] | Rows] = {"about": [_about(about, results)], **contents}
    for figure in figures:
        link = f"![{_SHOWN[figure.name]}](figures/tournament/{figure.name})"
        parts[f"figure {figure.stem}"] = [link]
    for name, content in parts.items():
        before, begin, rest = text.partition(BEGIN.format(name))
        _, end, after = rest.partition(END.format(name))
        if not (begin and end):
            raise ValueError(f"{page} has no {BEGIN.format(name)}")
        text = f"{before}{begin}\n{_as_text(content)}\n{end}{after}"
    page.write_text(text, encoding="utf-8")
    folder.mkdir(parents=True, exist_ok=True)
    for figure in figures:
        shutil.copyfile(figure, folder / figure.name)
    record_publication(page, parts)


def _as_text(content: list[str] | Rows) -> str:
    if content and isinstance(content[0], list):
        rows = [row for row in content if isinstance(row, list)]
        return markdown(rows) if len(rows) > 1 else "None."
    return "\n".join(str(line) for line in content)


def _about(about: Mapping[str, Any], results: Results) -> str:
    machine = about["machine"]
    part = "" if about["whole"] else " **Only a part of the tournament was run.**"
    return (
        f"{results.runs} runs in {about['seconds'] / 60:.0f} min on {about['jobs']} processes of "
        f"{machine['processor']}, {machine['cores']} cores, Python {machine['python']}; "
        f"{rule(results.main)}{part}"
    )


def _is_number(column: Sequence[str]) -> bool:
    return any(cell for cell in column) and all(
        not cell or cell[0].isdigit() or cell in "–≠=-" for cell in column
    )


def _between(interval: RatioInterval | None) -> str:
    return "–" if interval is None else f"{interval.low:.3f}–{interval.high:.3f}"


def _ratio(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3f}" if value < 9.9995 else f"{value:.3g}"


def _as_list(interval: RatioInterval | None) -> list[float] | None:
    return None if interval is None else [interval.low, interval.high]


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
