"""``trms score``: metrics of run logs, and comparison with a baseline."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.commands.plain_options import PlainOptions
from trms_cli.core.errors import EXIT_OK, EXIT_WORSE, RecordingError
from trms_cli.core.printable import print_json
from trms_cli.runs.run_folder import LOG_NAME, log_of

if TYPE_CHECKING:
    from trms_cli.core.findings import Findings
    from trms_cli.recordings.log_reader import LoggedRun
    from trms_cli.scoring.baseline import Baseline, BaselineRow

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

#: All of a score are shown.
_MOST_ROWS = 500


def main(argv: list[str]) -> int:
    """Run the command; return the exit code."""
    options = PlainOptions("trms score", HELP)
    options.add_argument("logs", type=Path, nargs="+", metavar="LOG")
    options.add_argument("--baseline", type=Path)
    options.add_argument("--write-baseline", type=Path)
    options.add_argument("--reason", default="")
    options.add_flags("--all", "--force", "--json")
    arguments = options.parse_args(argv)
    if arguments.write_baseline and len(arguments.logs) > 1:
        options.error("--write-baseline takes one LOG")
    if arguments.all and not arguments.baseline:
        options.error("--all goes with --baseline")
    if arguments.reason and not arguments.write_baseline:
        options.error("--reason goes with --write-baseline")

    if arguments.write_baseline and arguments.write_baseline.exists() and not arguments.force:
        raise RecordingError(
            "there is a file of this name already; nothing is overwritten unasked",
            where=str(arguments.write_baseline),
            remedy="give another name, or --force to replace it",
        )

    from trms_cli.recordings.log_reader import read_log
    from trms_cli.scoring.baseline import compare, document_of, has_regressed, read_baseline
    from trms_cli.scoring.score import score_log

    baseline = read_baseline(arguments.baseline) if arguments.baseline else None
    scored: list[tuple[LoggedRun, dict[str, Any], list[BaselineRow] | None]] = []
    for path in map(log_of, arguments.logs):
        log = read_log(path)
        score = score_log(log)
        scored.append((log, score, compare(score, baseline) if baseline else None))
    worse = any(has_regressed(rows) for _, _, rows in scored if rows is not None)

    if arguments.json:
        whole = document_of([(score, rows) for _, score, rows in scored], arguments.baseline)
        print_json(whole, allow_nan=False)
    else:
        from trms_cli.reporting.screen import show

        name = arguments.baseline.name if arguments.baseline else ""
        for number, (log, score, rows) in enumerate(scored):
            print("\n" if number else "", end="")
            findings = findings_of(log, score, rows, baseline, name, everything=arguments.all)
            show(findings, "score", rows=_MOST_ROWS)
    if arguments.write_baseline:
        _write_baseline(
            arguments.write_baseline, scored[0][1], arguments.reason, force=arguments.force
        )
        if not arguments.json:
            print(f"baseline written: {arguments.write_baseline}")
    return EXIT_WORSE if worse else EXIT_OK


def _write_baseline(path: Path, score: dict[str, Any], reason: str, *, force: bool) -> None:
    from trms_cli.core.whole_file import whole_file
    from trms_cli.scoring.baseline import Baseline

    text = json.dumps(Baseline(score, reason=reason).document(), indent=2, ensure_ascii=False)
    with whole_file(path, force=force, option="--write-baseline") as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def findings_of(
    log: LoggedRun,
    score: dict[str, Any],
    rows: list[BaselineRow] | None = None,
    baseline: Baseline | None = None,
    name: str = "",
    *,
    everything: bool = False,
) -> Findings:
    """What a score has to tell, also of its baseline where it is held against one."""
    from trms_cli.core.findings import Findings, Section
    from trms_cli.scoring import findings as report

    how = [f"{score['duration_s']:g} s", log.outcome, report.scored_on(score)]
    lead = [f"{', '.join(filter(None, how))}."]
    warnings = report.warnings_of(score)
    if not score["complete"]:
        warnings.append(f"incomplete: {'; '.join(log.problems) or 'the run did not end'}")
    sections = [Section("Score", blocks=report.tables_of(score))]
    if rows is not None:
        because = [f"The baseline: {baseline.reason}"] if baseline and baseline.reason else []
        table = report.comparison_table(rows, name, everything=everything)
        sections.append(Section("Against the baseline", because, [table]))
        lead.append(f"{report.comparison_sentence(rows, name)}.")
        lead += because
    path = log.path
    title = path.parent.name if path.name == LOG_NAME else path.name
    return Findings(title or str(path), lead, sections, score, warnings, files={"log": path})
