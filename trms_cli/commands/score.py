"""``trms score``: metrics of run logs, and comparison with a baseline."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.commands.plain_options import PlainOptions
from trms_cli.core.errors import EXIT_OK, EXIT_WORSE, RecordingError
from trms_cli.runs.run_folder import log_of

if TYPE_CHECKING:
    from trms_cli.recordings.log_reader import LoggedRun
    from trms_cli.scoring.baseline import Baseline, Row

SUMMARY = "metrics of logs, and comparison with a baseline"

HELP = """\
Usage: trms score LOG… [--baseline FILE] [--write-baseline FILE] [--json]

Prints how well runs tracked their references, what that took, how good the estimates were and
how the solver did. Channels are scored on the rig's true state where the log has it, else on
the measurements. A dash stands for what does not exist: a sine has no settling time. With
several steps the worst one counts; the median over the steps stands below it. A step is judged
until the reference changes again: if a push comes in between, it has settled when it is back
after the push; and with a controller that leaves for the next step early (preview), it has not.
The log of a run that died is scored as far as it goes, and said to be incomplete.

  LOG                    MCAP logs of trms, or folders of runs
  --baseline FILE        compare with a baseline, or with a score that --json printed; the exit
                         code is 1 if tracking, estimation, limits or solver failures got worse
                         by more than the tolerances
  --all                  with --baseline: show also the figures that stayed the same
  --write-baseline FILE  make the score of LOG the baseline (one LOG)
  --reason TEXT          why, kept in the baseline
  --force                replace FILE if it exists
  --json                 print the scores as JSON

Examples:
  trms score outputs/2025-01-31/12-00-00-run/run.mcap
  trms score run.mcap --json > score.json
  trms score run.mcap --write-baseline square.json --reason "first tuning"
  trms score new.mcap --baseline square.json
"""

#: Printed figures of a channel: key, label, unit ({} is the channel's).
_TRACKING = (
    ("rmse", "RMSE", "{}"),
    ("iae", "IAE", "{} s"),
    ("ise", "ISE", "{}² s"),
    ("itae", "ITAE", "{} s²"),
    ("max_abs_error", "largest error", "{}"),
    ("steady_state_error", "steady-state error", "{}"),
    ("overshoot_percent", "overshoot, worst step", "%"),
    ("overshoot_median_percent", "overshoot, median", "%"),
    ("rise_time_s", "rise time, worst step", "s"),
    ("rise_time_median_s", "rise time, median", "s"),
    ("settling_time_s", "settling time, worst step", "s"),
    ("settling_time_median_s", "settling time, median", "s"),
    ("steps", "steps", ""),
    ("unsettled_steps", "steps not settled", ""),
)
_INPUTS = (
    ("effort", "effort ∫u²dt", "{}² s"),
    ("total_variation", "total variation", "{}"),
    ("saturation_share", "share of time saturated", ""),
)
#: What is more than sensors do: an encoder's steps alone, under a model that is exactly right,
#: correlate neighbouring innovations by up to 0.6, and thousands of samples make that certain.
_MUCH_CORRELATION = 0.7
_MUCH_NIS = 2.0
_VIOLATIONS = (("samples", "samples outside", ""), ("worst", "worst excess", "{}"))


def main(argv: list[str]) -> int:
    """Run the command; return the exit code."""
    options = PlainOptions("trms score", HELP)
    options.add_argument("logs", type=Path, nargs="+", metavar="LOG")
    options.add_argument("--baseline", type=Path)
    options.add_argument("--all", action="store_true")
    options.add_argument("--write-baseline", type=Path)
    options.add_argument("--reason", default="")
    options.add_argument("--force", action="store_true")
    options.add_argument("--json", action="store_true")
    given = options.parse_args(argv)
    if given.write_baseline and len(given.logs) > 1:
        options.error("--write-baseline takes one LOG")
    if given.all and not given.baseline:
        options.error("--all goes with --baseline")
    if given.reason and not given.write_baseline:
        options.error("--reason goes with --write-baseline")

    if given.write_baseline and given.write_baseline.exists() and not given.force:
        raise RecordingError(
            "there is a file of this name already; nothing is overwritten unasked",
            where=str(given.write_baseline),
            remedy="give another name, or --force to replace it",
        )

    from trms_cli.recordings.log_reader import read_log
    from trms_cli.scoring.baseline import compare, read_baseline, regressed
    from trms_cli.scoring.score import score_log

    baseline = read_baseline(given.baseline) if given.baseline else None
    scored: list[tuple[LoggedRun, dict[str, Any], list[Row] | None]] = []
    for path in map(log_of, given.logs):
        log = read_log(path)
        score = score_log(log)
        scored.append((log, score, compare(score, baseline) if baseline else None))
    worse = any(regressed(rows) for _, _, rows in scored if rows is not None)

    if given.json:
        _print_json([(score, rows) for _, score, rows in scored], given.baseline)
    else:
        for log, score, rows in scored:
            _print_score(log, score)
            if rows is not None and baseline is not None:
                _print_comparison(rows, baseline, given.baseline, everything=given.all)
    if given.write_baseline:
        _write_baseline(given.write_baseline, scored[0][1], given.reason, force=given.force)
        if not given.json:
            print(f"baseline written: {given.write_baseline}")
    return EXIT_WORSE if worse else EXIT_OK


def _print_json(
    scored: list[tuple[dict[str, Any], list[Row] | None]], baseline: Path | None
) -> None:
    whole = document_of(scored, baseline)
    json.dump(whole, sys.stdout, indent=2, ensure_ascii=False, allow_nan=False)
    sys.stdout.write("\n")


def document_of(
    scored: list[tuple[dict[str, Any], list[Row] | None]], baseline: Path | None
) -> dict[str, Any]:
    """One document: the score, or ``trms.scores/1`` with several of them."""
    from dataclasses import asdict

    from trms_cli.scoring.baseline import regressed

    documents = []
    for score, rows in scored:
        document = dict(score)
        if rows is not None:
            document["comparison"] = {
                "baseline": str(baseline),
                "worse": regressed(rows),
                "figures": [asdict(row) for row in rows],
            }
        documents.append(document)
    return documents[0] if len(documents) == 1 else {"schema": "trms.scores/1", "scores": documents}


def _write_baseline(path: Path, score: dict[str, Any], reason: str, *, force: bool) -> None:
    from trms_cli.recordings.output_file import whole_file
    from trms_cli.scoring.baseline import Baseline

    text = json.dumps(Baseline(score, reason=reason).document(), indent=2, ensure_ascii=False)
    with whole_file(path, force=force) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def print_score(score: dict[str, Any]) -> None:
    """Print a score as tables: what ``trms run`` ends with, too."""
    _print_channels("tracking", score["channels"], _TRACKING)
    _print_channels("inputs", score["inputs"], _INPUTS)
    _print_estimate(score["estimate"])
    _print_solver(score["solver"])
    violated = {n: v for n, v in score["constraint_violations"].items() if v["samples"]}
    _print_channels("limits that were exceeded", violated, _VIOLATIONS)
    from trms_cli.commands.run_screen import degraded_lines

    for line in degraded_lines(score["degraded"]):
        _console().print(line, highlight=False)


def _print_score(log: LoggedRun, score: dict[str, Any]) -> None:
    console = _console()
    console.print(f"{log.path}", style="bold", highlight=False, soft_wrap=True)
    sources = {values["scored_on"] for values in score["channels"].values()}
    names = {"state": "true state", "measurement": "measurements"}
    on = f", scored on the {' and '.join(names[s] for s in sorted(sources))}" if sources else ""
    console.print(f"{score['duration_s']:g} s, {log.outcome}{on}", highlight=False)
    if not score["complete"]:
        console.print("incomplete:", style="yellow", end=" ")
        console.print("; ".join(log.problems) or "the run did not end", highlight=False)
    console.print()
    print_score(score)


def _print_channels(
    title: str, channels: dict[str, Any], figures: tuple[tuple[str, str, str], ...]
) -> None:
    if not channels:
        return
    table = _table(title, *channels)
    units = [values.get("unit", "") for values in channels.values()]
    for key, label, unit in figures:
        values = [channel.get(key) for channel in channels.values()]
        absent = all(value is None for value in values)
        once = all(channel.get("steps", 0) < 2 for channel in channels.values())
        if (absent and "worst" not in label) or (once and "median" in label):
            continue
        own = unit.replace("{}", units[0] if len(set(units)) == 1 else "")
        table.add_row(label, own.strip(), *map(_number, values))
    _console().print(table)


def _print_estimate(estimate: dict[str, Any]) -> None:
    rmse, prediction = estimate["rmse"], estimate["prediction_rmse"]
    columns = {"RMSE of state": rmse, "RMSE of 1-step prediction": prediction}
    # an observer that is handed the true state has no error worth a column
    columns = {title: values for title, values in columns.items() if any(values.values())}
    names = [
        name
        for name in dict.fromkeys([*rmse, *prediction])
        if any(values.get(name) is not None for values in columns.values())
    ]
    if not names:
        return
    table = _table("estimate", *columns)
    for name in names:
        numbers = [_number(values.get(name)) for values in columns.values()]
        table.add_row(name, estimate["units"].get(name, ""), *numbers)
    console = _console()
    console.print(table)
    if estimate["nees_mean"] is not None:
        expected = f"{estimate['nees_expected']} is consistent, more is overconfident"
        console.print(f"  NEES {_number(estimate['nees_mean'])} ({expected})", highlight=False)
    for line in _innovation_lines(estimate):
        console.print(f"  {line}", highlight=False)
    console.print()


def _innovation_lines(estimate: dict[str, Any]) -> list[str]:
    """How far the innovations are from those of a filter that knows everything."""
    channels = estimate["innovations"].values()
    correlations = [c["correlation"] for c in channels if c["correlation"] is not None]
    squares = [c["normalised_square"] for c in channels if c["normalised_square"] is not None]
    correlation = max(correlations, key=abs, default=0.0)
    lines = []
    p = estimate["innovation_whiteness_p"]
    if p is not None and p >= 0.05:
        lines.append("innovations white")
    elif p is not None:
        lines.append(f"innovations not white (lag-1 correlation {correlation:.2f} at most)")
    if squares:
        low, high = min(squares), max(squares)
        range_ = f"{low:.2f}" if f"{low:.2f}" == f"{high:.2f}" else f"{low:.2f} to {high:.2f}"
        lines.append(f"NIS {range_} a channel (1 is consistent, more is overconfident)")
    if estimate.get("nis_mean") is not None:
        inside = f"{estimate['nis_share_inside']:.0%} inside its 95 % interval"
        lines.append(
            f"NIS of all {_number(estimate['nis_mean'])} ({estimate['nis_expected']} is "
            f"consistent), {inside}"
        )
    lines += _lost_lines(estimate)
    if abs(correlation) > _MUCH_CORRELATION or max(squares, default=0.0) > _MUCH_NIS:
        lines.append("the model, or the noise that the observer was told, misses something")
    return lines


def _lost_lines(estimate: dict[str, Any]) -> list[str]:
    """How many samples were missing or rejected, and of which channels."""
    lines = []
    for key, words in (("missing", "missing"), ("rejected", "rejected as outliers")):
        counts = {name: c.get(key, 0) for name, c in estimate["innovations"].items()}
        told = ", ".join(f"{name} {count}" for name, count in counts.items() if count)
        if told:
            lines.append(f"samples {words}: {told}")
    return lines


def _print_solver(solver: dict[str, Any]) -> None:
    times = solver["time_ms"]
    if times["median"] is None:
        return
    table = _table("solver", "median", "p99", "max")
    table.add_row(
        "time of a step", "ms", *(_number(times[key]) for key in ("median", "p99", "max"))
    )
    console = _console()
    console.print(table)
    words = [
        f"{_number(solver[key])} {label}"
        for key, label in (
            ("deadline_misses", "deadlines missed"),
            ("failures", "failures"),
            ("iterations_mean", "iterations on average"),
        )
        if solver[key] is not None
    ]
    console.print("  " + ", ".join(words), highlight=False)
    if solver["objective_total"] is not None:
        console.print(f"  objective, summed {_number(solver['objective_total'])}", highlight=False)
    console.print()


def _print_comparison(rows: list[Row], baseline: Baseline, path: Path, *, everything: bool) -> None:
    """The figures that changed, those that decide first in colour."""
    from trms_cli.scoring.baseline import regressed

    console = _console()
    shown = [row for row in rows if everything or row.verdict != "same"]
    if shown:
        table = _table(f"against {path.name}", "baseline", "now", "tolerance", "", unit=False)
        for row in shown:
            style = "bold red" if row.regressed else {"better": "green"}.get(row.verdict, "")
            word = row.verdict if row.judged else f"({row.verdict})"
            name = f"{_short(row.key)} [dim]{row.unit}[/dim]" if row.unit else _short(row.key)
            numbers = (_number(row.baseline), _number(row.now), f"±{_number(row.tolerance)}")
            table.add_row(name, *numbers, word, style=style)
        console.print(table)
        if any(not row.judged for row in shown):
            console.print("  (in brackets: shown only, does not decide)", style="dim")
    if baseline.reason:
        console.print(f"  the baseline: {baseline.reason}", highlight=False)
    same = sum(row.verdict == "same" for row in rows)
    better = sum(row.judged and row.verdict == "better" for row in rows)
    bad = sum(row.regressed for row in rows)
    verdict = "worse than the baseline" if regressed(rows) else "not worse than the baseline"
    console.print(
        f"{verdict}: {bad} figures worse, {better} better, {same} the same",
        style="bold red" if bad else "bold green",
        highlight=False,
    )
    console.print()


def _short(key: str) -> str:
    """``channels.alpha_v.rmse`` as ``alpha_v rmse``."""
    group, _, rest = key.partition(".")
    words = rest if group in ("channels", "inputs") else key
    name = words.replace(".", " ").replace("constraint_violations", "limits")
    return name.removesuffix("_percent").removesuffix("_s").replace("prediction_rmse", "prediction")


def _number(value: float | int | None) -> str:
    """Four digits; a dash for what does not exist."""
    if value is None:
        return "–"
    if isinstance(value, int):
        return str(value)
    if value != 0 and not 1e-3 <= abs(value) < 1e5:
        return f"{value:.2e}"
    return f"{value:.4g}"


def _table(title: str, *columns: str, unit: bool = True) -> Any:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    table.add_column(title, header_style="bold cyan", no_wrap=True)
    if unit:
        table.add_column("", style="dim")
    for column in columns:
        table.add_column(column, justify="right", no_wrap=True)
    return table


def _console() -> Any:
    from rich.console import Console

    return Console()
