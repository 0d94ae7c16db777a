"""``trms runs``: what has been run, filtered and sorted."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

from trms_cli.commands.plain_options import PlainOptions
from trms_cli.core.errors import EXIT_OK
from trms_cli.core.printable import print_json
from trms_cli.scoring.figures import Figure, of_group

if TYPE_CHECKING:
    from trms_cli.runs.query import QueryResult

SUMMARY = "what has been run: list, filter, sort, export"

_HELP = """\
Usage: trms runs [FILTER] [--in FOLDER]… [--sort COLUMN] [--desc] [--columns A,B] [--limit N]
                 [--json] [--csv FILE] [--parquet FILE] [--rebuild]

Lists the runs under the working folder, the latest first. Their figures are kept in an index,
which is brought up to date each time: logs that are new or have changed are read, those that
are gone are taken out. It is made from the logs alone and can be deleted at any time.

  FILTER           in quotes: "controller == 'newton_mpc' and rmse_yaw < 0.05"
  --in FOLDER      look here instead, however deep; may be repeated
  --all            every run that this machine knows of
  --sort COLUMN    smallest first; what has no value comes last (time, latest first)
  --desc           largest first
  --columns A,B    these columns; +A,B adds to the usual ones; all
  --limit N        N runs at most; 0: all (on a terminal as many as are read at a glance)
  --json           print trms.runs/1
  --csv FILE       write all columns, or those of --columns; - prints it
  --parquet FILE   the same, with types and units
  --force          replace FILE if it exists
  --unreadable     the logs that could not be read, with the reason
  --rebuild        read every log again

filters
  == != < <= > >=    + - * /    and or not    in ('pid', 'lqr')    is None    0.1 < rmse < 0.5
  controller like '*mpc' (* any text, ? one character)    effects contains 'friction'
  plant.prior_seed == 3    a key that was typed for the run, by its dots
  What a run does not have is None: it satisfies no <, >, in, like or contains.

columns
  run        path log time command outcome complete problem seed duration sample_time took
             recording loop
  chosen     controller observer ref model plant supervisor experiment effects faults
FIGURES
  origin     git version platform versions overrides choices

Examples:
  trms runs
  trms runs "controller == 'newton_mpc' and rmse_yaw < 0.05" --sort rmse_yaw
  trms runs "not complete or failures > 0" --in outputs --columns +outcome,command
  trms runs --sort solve_p99 --desc --limit 5
  trms runs "effects contains 'friction'" --csv friction.csv
"""


def figure_columns() -> str:
    """The columns that hold figures, as the registry has them."""
    channels, inputs = of_group("channels"), of_group("inputs")
    summed = " ".join(figure.column_name for figure in channels if figure.total == "sum")
    added = " ".join(figure.column_name for figure in inputs if figure.total)
    names = {
        "tracking": f"{summed}, summed; of each channel with _yaw or _pitch (or _alpha_h, "
        f"_alpha_v): {_names(channels)}",
        "inputs": f"{added}; of each with _main or _tail (or _u_v, _u_h): {_names(inputs)}",
        "solver": f"{_names(of_group('solver'))}; times in ms",
        "trouble": _names(of_group("run")),
        "estimate": f"{_names(of_group('estimate'))}; estimate_rmse_STATE prediction_rmse_OUTPUT",
    }
    return "\n".join(
        fill(words, 99, initial_indent=f"  {head:9}  ", subsequent_indent=" " * 13)
        for head, words in names.items()
    )


def _names(some: Sequence[Figure]) -> str:
    return " ".join(figure.column_name for figure in some)


HELP = _HELP.replace("FIGURES", figure_columns())

#: Runs that a terminal shows when nobody says how many.
_GLANCE = 40


def main(argv: list[str]) -> int:
    """Run the command; return the exit code."""
    given = _given(argv)
    from trms_cli.reporting.progress import ReadingProgress
    from trms_cli.runs.columns import COLUMNS
    from trms_cli.runs.filter import names_in
    from trms_cli.runs.query import Query, find

    shown = not (given.json or given.csv or given.parquet)
    extra, asked = _asked(given.columns)
    usual = extra or not asked
    if asked == ["all"]:
        asked = list(COLUMNS)
    told = [*asked, *([given.sort] if given.sort else []), *names_in(given.filter)]
    limit = given.limit
    if limit is None and shown and sys.stdout.isatty():
        limit = _GLANCE
    if shown and usual:
        from trms_cli.commands.runs.screen import OVERRIDES, USUAL

        columns = tuple(dict.fromkeys([*USUAL, *told, OVERRIDES]))
    else:
        columns = tuple(dict.fromkeys([*COLUMNS, *asked] if usual else asked))
    question = Query(
        filter=given.filter,
        folders=tuple(given.folders),
        everywhere=given.all,
        sort=given.sort or "time",
        descending=given.desc or not given.sort,
        columns=columns,
        limit=limit or None,
        rebuild=given.rebuild,
    )
    with ReadingProgress() as tell:
        found = find(question, tell)
    _present(found, given, told if usual else None, shown)
    return EXIT_OK


def _present(found: QueryResult, given: Any, told: list[str] | None, shown: bool) -> None:
    from trms_cli.commands.runs import screen as runs_screen

    if given.csv:
        runs_screen.write_csv(found, given.csv, force=given.force)
    if given.parquet:
        runs_screen.write_parquet(found, given.parquet, force=given.force)
    if given.json:
        print_json(runs_screen.document(found, given.filter), allow_nan=False)
    if given.unreadable and shown:
        runs_screen.print_unreadable(found)
    elif shown:
        runs_screen.print_runs(found, told, filtered=bool(given.filter.strip()))
    elif not given.json and given.csv != Path("-"):
        files = " and ".join(str(file) for file in (given.csv, given.parquet) if file)
        print(f"{len(found.runs)} runs written to {files}")
    runs_screen.say_remarks(found, unreadable=not given.unreadable)


def _given(argv: list[str]) -> Any:
    options = PlainOptions("trms runs", HELP)
    options.add_argument("filter", nargs="*", metavar="FILTER")
    options.add_argument("--in", action="append", default=[], dest="folders", metavar="FOLDER")
    options.add_argument("--sort", default="")
    options.add_argument("--columns", default="")
    options.add_argument("--limit", type=int)
    options.add_argument("--csv", type=Path)
    options.add_argument("--parquet", type=Path)
    options.add_flags("--all", "--desc", "--json", "--force", "--unreadable", "--rebuild")
    given = options.parse_args(argv)
    if len(given.filter) > 1:
        options.error(
            f"{len(given.filter)} words given where one filter goes: put all of it in quotes, "
            "and texts inside into the other kind of quotes"
        )
    given.filter = given.filter[0] if given.filter else ""
    if given.filter and Path(given.filter).is_dir():
        options.error(f"{given.filter!r} is a folder: write --in {given.filter}")
    if given.limit is not None and given.limit < 0:
        options.error(f"--limit {given.limit} is less than none")
    if given.all and given.folders:
        options.error("--all goes without --in")
    if given.force and not (given.csv or given.parquet):
        options.error("--force goes with --csv or --parquet")
    if given.json and given.csv == Path("-"):
        options.error("--json and --csv - both print")
    return given


def _asked(text: str) -> tuple[bool, list[str]]:
    """Whether the columns named are to be added to the usual ones, and their names."""
    names = [name.strip() for name in text.removeprefix("+").split(",")]
    return text.startswith("+"), [name for name in names if name]
