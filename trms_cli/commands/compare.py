"""``trms compare``: which of many runs won, by how much, and how sure that is."""

from collections.abc import Sequence
from pathlib import Path

from trms_cli.commands.plain_options import PlainOptions
from trms_cli.core.errors import EXIT_OK
from trms_cli.core.printable import print_json
from trms_cli.core.uncollected import uncollected
from trms_cli.library.tasks.compare import METRICS, SORTS, ranking_of, runs_from, sort_standings

SUMMARY = "many runs ranked: tracking, effort, robustness, time of a step, failures"

HELP = """\
Usage: trms compare LOG…|FOLDER… [--by KEY,KEY] [--where KEY=VALUE]… [--metric METRIC]
                    [--sort COLUMN] [--json]

Reads every run in folders, however deep: logs, the jobs of sweeps, and those that failed. Runs
are told apart by what they differ in: controller, observer and model name who ran, the reference,
the rig and the seed name in what. Everybody is held against the best on the same reference, rig
and seed; a failed run counts as the worst there. Intervals are of a bootstrap over rigs, 95 %; an
entrant differs significantly from the first when the interval of its ratio to the first excludes 1.
Who was in far fewer conditions, or knew more than the others, is listed without a rank; the
others are ranked on the conditions that all of them were in.
Two logs are put side by side instead.

  LOG, FOLDER            MCAP logs of trms, folders of runs, of sweeps, of tournaments
  --by KEY,KEY           what names who ran: controller, observer, ref, plant.prior_seed, …
  --where KEY=VALUE      only these runs; several values with commas, * as in file names; may be
                         repeated
  --metric rmse|iae|ise|itae|max_abs_error
                         the tracking error that ranks, all channels added (rmse)
  --sort rank|tracking|worst|effort|variation|time|failures|name
                         the order of the rows; the rank stays what it is (rank)
  --json                 print trms.compare/1 (of two logs trms.compare_pair/1)

Examples:
  trms run -m controller=pid,lqr,newton_mpc ref=square,sine plant.prior_seed=1,2,3 out=sweep
  trms compare sweep
  trms compare sweep --by controller --where ref=sine --json
  trms compare outputs/2025-01-31/12-00-00-run outputs/2025-01-31/12-00-05-run
"""

#: Entrants that the screen shows; the document has all.
_MOST_ROWS = 60


@uncollected()
def main(argv: list[str]) -> int:
    """Run the command; return the exit code."""
    options = PlainOptions("trms compare", HELP)
    options.add_argument("paths", type=Path, nargs="+", metavar="LOG")
    options.add_argument("--by", default="")
    options.add_argument("--where", action="append", default=[])
    options.add_argument("--metric", choices=METRICS, default="rmse")
    options.add_argument("--sort", choices=SORTS, default="rank")
    options.add_argument("--json", action="store_true")
    arguments = options.parse_args(argv)
    gathered = runs_from(arguments.paths, _where(arguments.where, options))
    from trms_cli.scoring.comparison.findings import pair, pair_findings, ranking_findings

    if len(gathered.runs) == 2 and not arguments.by:
        findings = pair_findings(pair(*gathered.runs))
    else:
        by = [key for key in arguments.by.split(",") if key]
        ranking = ranking_of(gathered, by, arguments.metric, arguments.paths)
        findings = ranking_findings(ranking, gathered, sort_standings(ranking, arguments.sort))
    if arguments.json:
        print_json(findings.results, allow_nan=False)
        return EXIT_OK
    from trms_cli.reporting.screen import show

    show(findings, "compare", rows=_MOST_ROWS)
    return EXIT_OK


def _where(conditions: Sequence[str], options: PlainOptions) -> dict[str, list[str]]:
    values_by_key: dict[str, list[str]] = {}
    for word in conditions:
        key, equals, values = word.partition("=")
        if not (key and equals and values):
            options.error(f"--where {word!r} names no KEY=VALUE")
        values_by_key.setdefault(key, []).extend(values.split(","))
    return values_by_key
