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
    arguments = _parse_arguments(argv)
    from trms_cli.reporting.progress import ReadingProgress
    from trms_cli.runs.filter import names_in
    from trms_cli.runs.query import Query, find

    is_on_screen = not (arguments.json or arguments.csv or arguments.parquet)
    extra, requested_columns = _parse_columns(arguments.columns)
    usual = extra or not requested_columns
    if requested_columns == ["all"]:
        requested_columns = ["*"]
    mentioned_columns = [
        *requested_columns,
        *([arguments.sort] if arguments.sort else []),
        *names_in(arguments.filter),
    ]
    limit = arguments.limit
    if limit is None and is_on_screen and sys.stdout.isatty():
        limit = _GLANCE
    if is_on_screen and usual:
        from trms_cli.runs.table import OVERRIDES, USUAL

        columns = tuple(dict.fromkeys([*USUAL, *mentioned_columns, OVERRIDES]))
    else:
        columns = tuple(dict.fromkeys(["*", *requested_columns] if usual else requested_columns))
    question = Query(
        filter=arguments.filter,
        folders=tuple(arguments.folders),
        everywhere=arguments.all,
        sort=arguments.sort or "time",
        descending=arguments.desc or not arguments.sort,
        columns=columns,
        limit=limit or None,
        rebuild=arguments.rebuild,
    )
    with ReadingProgress() as tell:
        result = find(question, tell)
    _present(result, arguments, mentioned_columns if usual else None, is_on_screen)
    return EXIT_OK


def _present(
    result: QueryResult, arguments: Any, mentioned_columns: list[str] | None, is_on_screen: bool
) -> None:
    from trms_cli.commands.runs import screen as runs_screen

    if arguments.csv:
        runs_screen.write_csv(result, arguments.csv, force=arguments.force)
    if arguments.parquet:
        from trms_cli.runs.frame import write_parquet

        write_parquet(result, arguments.parquet, force=arguments.force)
    if arguments.json:
        print_json(runs_screen.document(result, arguments.filter), allow_nan=False)
    if arguments.unreadable and is_on_screen:
        runs_screen.print_unreadable(result)
    elif is_on_screen:
        runs_screen.print_runs(result, mentioned_columns, filtered=bool(arguments.filter.strip()))
    elif not arguments.json and arguments.csv != Path("-"):
        files = " and ".join(str(file) for file in (arguments.csv, arguments.parquet) if file)
        print(f"{len(result.runs)} runs written to {files}")
    runs_screen.say_remarks(result, unreadable=not arguments.unreadable)


def _parse_arguments(argv: list[str]) -> Any:
    options = PlainOptions("trms runs", HELP)
    options.add_argument("filter", nargs="*", metavar="FILTER")
    options.add_argument("--in", action="append", default=[], dest="folders", metavar="FOLDER")
    options.add_argument("--sort", default="")
    options.add_argument("--columns", default="")
    options.add_argument("--limit", type=int)
    options.add_argument("--csv", type=Path)
    options.add_argument("--parquet", type=Path)
    options.add_flags("--all", "--desc", "--json", "--force", "--unreadable", "--rebuild")
    arguments = options.parse_args(argv)
    if len(arguments.filter) > 1:
        options.error(
            f"{len(arguments.filter)} words given where one filter goes: put all of it in quotes, "
            "and texts inside into the other kind of quotes"
        )
    arguments.filter = arguments.filter[0] if arguments.filter else ""
    if arguments.filter and Path(arguments.filter).is_dir():
        options.error(f"{arguments.filter!r} is a folder: write --in {arguments.filter}")
    if arguments.limit is not None and arguments.limit < 0:
        options.error(f"--limit {arguments.limit} is less than none")
    if arguments.all and arguments.folders:
        options.error("--all goes without --in")
    if arguments.force and not (arguments.csv or arguments.parquet):
        options.error("--force goes with --csv or --parquet")
    if arguments.json and arguments.csv == Path("-"):
        options.error("--json and --csv - both print")
    return arguments


def _parse_columns(text: str) -> tuple[bool, list[str]]:
    """Whether the columns named are to be added to the usual ones, and their names."""
    names = [name.strip() for name in text.removeprefix("+").split(",")]
    return text.startswith("+"), [name for name in names if name]
