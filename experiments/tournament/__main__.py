"""``python -m experiments.tournament``: everybody against everybody, ranked with intervals."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

from experiments.command_line import RunsBar, one_thread_each
from experiments.tournament.schedule import TOURNAMENT, Plan, Run, read_plan, runs_of
from trms_cli.cli import describe_error
from trms_cli.core.errors import EXIT_INTERRUPTED, EXIT_OK, ConfigurationError, TrmsError

_ABOUT = "about.json"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tournament, print its tables, write them into the documentation on request."""
    arguments = _parser().parse_args(argv)
    one_thread_each()
    try:
        return _tournament(arguments)
    except TrmsError as error:
        sys.stderr.write(describe_error(error, colour=sys.stderr.isatty()))
        return error.exit_code
    except KeyboardInterrupt:
        sys.stderr.write("\ninterrupted; --resume goes on\n")
        return EXIT_INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m experiments.tournament", description=__doc__)
    parser.add_argument(
        "--only",
        default="*",
        metavar="PATTERN",
        help="runs: 'newton_mpc+*', '*/sine/*', '*/draw_*'",
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--quick", action="store_true", help="small, to see that it works")
    parser.add_argument("--resume", action="store_true", help="go on in a folder; no run twice")
    parser.add_argument("--logs", action="store_true", help="keep the log of every run")
    parser.add_argument(
        "--publish", action="store_true", help="put tables and figures into docs/tournament.md"
    )
    parser.add_argument("--tournament", type=Path, default=TOURNAMENT, help="another YAML")
    parser.add_argument(
        "--out", type=Path, default=Path("outputs/tournament"), help="folder of runs and tables"
    )
    return parser


def _tournament(arguments: argparse.Namespace) -> int:
    from experiments.tournament import figures, page
    from experiments.tournament.publications import put_beside, read_published
    from experiments.tournament.verdict import read_results
    from trms_cli.runs.run_folder import write_document

    if arguments.jobs < 1:
        raise ConfigurationError(
            f"{arguments.jobs} given", where="--jobs", remedy="one at the least"
        )
    plan = read_plan(arguments.tournament)
    runs = runs_of(plan, pattern=arguments.only, quick=arguments.quick)
    published = read_published()
    seconds = _run(runs, arguments, plan)
    results = read_results(arguments.out, plan.criteria)
    besides = [put_beside(each, arguments.out / "published") for each in published]
    about = _about(arguments, seconds, whole=arguments.only == "*" and not arguments.quick)
    write_document(
        page.report(results, besides, about, plan.criteria), arguments.out / "report.json"
    )
    pictures = figures.draw(results, arguments.out / "figures")
    page.print_results(results)
    print(f"\n{results.runs} runs; tables and figures: {arguments.out}; the ranking again:")
    print(f"  trms compare {arguments.out / 'main'}")
    if arguments.publish:
        page.publish(page.tables(results, besides, plan.criteria), about, results, pictures)
    return EXIT_OK


def _run(runs: Sequence[Run], arguments: argparse.Namespace, plan: Plan) -> float:
    """Run what has not been run; returns the seconds that all of it took, resumed or not."""
    from experiments.tournament.worker_runs import is_done, run_all

    arguments.out.mkdir(parents=True, exist_ok=True)
    if any(arguments.out.iterdir()) and not arguments.resume:
        raise ConfigurationError(
            f"the folder {str(arguments.out)!r} is not empty, and nothing is written over",
            where="--out",
            remedy="--resume goes on in it, or name another",
        )
    before = _earlier(arguments.out)
    todo = [run for run in runs if not is_done(run, arguments.out)]
    begin = perf_counter()
    with RunsBar(len(todo)) as advance:
        for run in run_all(
            todo,
            arguments.out,
            jobs=arguments.jobs,
            time_limit=plan.time_limit,
            logs=arguments.logs,
        ):
            advance(run.name)
            seconds = before + perf_counter() - begin
            (arguments.out / _ABOUT).write_text(json.dumps({"seconds": seconds}), encoding="utf-8")
    return before + perf_counter() - begin


def _earlier(out: Path) -> float:
    """Seconds that were spent before this was resumed."""
    try:
        return float(json.loads((out / _ABOUT).read_text(encoding="utf-8"))["seconds"])
    except (OSError, ValueError, KeyError):
        return 0.0


def _about(arguments: argparse.Namespace, seconds: float, *, whole: bool) -> dict[str, Any]:
    from benchmarks.machine import describe
    from trms_cli.library.tasks.git_revision import GitRevision

    return {
        "seconds": round(seconds, 1),
        "jobs": arguments.jobs,
        "whole": whole,
        "git": GitRevision.ask().answer(),
        "machine": describe(),
    }


if __name__ == "__main__":
    sys.exit(main())
