"""``trms report``: one self-contained page of a run, of a few runs, or of many."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.commands.plain_options import PlainOptions
from trms_cli.core.errors import EXIT_OK
from trms_cli.core.invocation import program
from trms_cli.core.printable import print_json, printable
from trms_cli.core.uncollected import uncollected

if TYPE_CHECKING:
    from trms_cli.library.report.pages import Report

SUMMARY = "one HTML page of a run, a comparison or a sweep: plots and tables, nothing fetched"

HELP = """\
Usage: trms report LOG…|FOLDER… [--out FILE.html] [--title TEXT] [--force] [--json]

Writes one page that stands alone: it opens from the disk, fetches nothing, and can be sent to
anybody. One run: its signals with linked time axes, events, predictions, phase plots, the times of
the solver, its score and configuration. Up to eight runs: over one another, with their scores side
by side. More, or the folder of a sweep: the ranking, how figures spread and on what they depend,
what failed and why, and a table of all runs to sort and filter.
Logs of runs that died are drawn as far as they go.

  LOG, FOLDER            MCAP logs of trms, folders of a run, of sweeps, of scores, however deep
  --out FILE.html        where to write it (report.html in the folder of the run or the sweep, or
                         beside the log; in the working folder for several)
  --title TEXT           its heading
  --force                replace FILE.html if it exists
  --json                 print trms.report/1: what the page is of, and where it is

Examples:
  trms run controller=newton_mpc out=first
  trms report first
  trms report first/run.mcap second/run.mcap --out rivals.html --title "two rivals"
  trms run -m controller=pid,lqr plant.prior_seed=range(1,11) out=sweep
  trms report sweep
"""

SCHEMA = "trms.report/1"


@uncollected()
def main(argv: list[str]) -> int:
    """Run the command; return the exit code."""
    options = PlainOptions("trms report", HELP)
    options.add_argument("paths", type=Path, nargs="+", metavar="LOG")
    options.add_argument("--out", type=Path)
    options.add_argument("--title", default="")
    options.add_flags("--force", "--json")
    arguments = options.parse_args(argv)
    if arguments.out is not None and arguments.out.suffix.lower() not in (".html", ".htm"):
        options.error(f"--out {str(arguments.out)!r} is no page: its name ends in .html")

    from trms_cli.library.report.pages import write_report

    report, path = write_report(
        arguments.paths, out=arguments.out, title=arguments.title, force=arguments.force
    )
    if arguments.json:
        print_json(document(report, path))
    else:
        _say(report, path)
    return EXIT_OK


def document(report: Report, path: Path) -> dict[str, Any]:
    """``trms.report/1``."""
    return {
        "schema": SCHEMA,
        "file": str(path),
        "bytes": path.stat().st_size,
        "kind": report.kind,
        "title": report.findings.title,
        "lead": [paragraph.replace("**", "") for paragraph in report.findings.lead],
        "runs": list(report.runs),
        "left_out": [{"path": file, "problem": why} for file, why in report.left_out],
    }


def _say(report: Report, path: Path) -> None:
    """What it is of, in its own sentences, where it is, and what to do next."""
    print(printable(report.findings.title))
    for paragraph in report.findings.lead:
        print(f"  {printable(paragraph.replace('**', '').replace('`', ''))}")
    print()
    count = len(report.runs)
    of = "a run" if report.kind == "run" else f"{count} runs"
    print(f"report     {path}  ({report.kind}: {of}, {path.stat().st_size / 1e6:.1f} MB)")
    for file, why in report.left_out[:5]:
        print(f"left out   {printable(file)}: {printable(why)}")
    if len(report.left_out) > 5:
        print(f"           and {len(report.left_out) - 5} more (--json has all)")
    print()
    trms, name = program(), shlex.quote(str(path))
    print(f"next       open {name} in a browser; it needs no network and can be sent as it is")
    if report.kind == "run":
        print(f"           {trms} report {shlex.quote(report.runs[0])} OTHER_LOG   compares")
    else:
        print(f"           {trms} report {shlex.quote(report.runs[0])}   one of them alone")
