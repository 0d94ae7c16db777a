"""``python -m experiments.regression``: run the matrix, compare, fail when a score got worse."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

from experiments.command_line import RunsBar, exit_code_of
from experiments.regression import comparison as comparing
from experiments.regression.matrix import MATRIX, Case, read_matrix
from experiments.regression.runs import Outcome, run_all
from trms_cli.core.errors import EXIT_OK, EXIT_WORSE, ConfigurationError, TrmsError


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code: 1 when a score got worse, 2 for bad input."""
    arguments = _parser().parse_args(argv)
    return exit_code_of(lambda: _regression(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m experiments.regression", description=__doc__)
    parser.add_argument("--update", action="store_true", help="make these scores the baseline")
    parser.add_argument("--reason", default="", help="why the baseline changes (with --update)")
    parser.add_argument("--json", action="store_true", help="print trms.regression/1")
    parser.add_argument("--only", default="*", metavar="PATTERN", help="runs: 'pid/*', '*/ideal'")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--matrix", type=Path, default=MATRIX, help="another matrix.yaml")
    parser.add_argument("--baseline", type=Path, default=comparing.BASELINE, help="another file")
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="KEY=VALUE",
        help="what every run gets besides: how would the scores be with it?",
    )
    return parser


def _regression(arguments: argparse.Namespace) -> int:
    _check(arguments)
    cases = read_matrix(arguments.matrix, arguments.only, arguments.overrides)
    recorded = _recorded(arguments)
    if not arguments.update and not arguments.overrides:
        comparing.check_matrix(cases, recorded)
    begin = perf_counter()
    outcomes = _outcomes(cases, arguments.jobs)
    seconds = perf_counter() - begin
    comparisons = [comparing.compare_outcome(outcome, recorded) for outcome in outcomes]

    from experiments.regression import screen

    if arguments.json:
        words = screen.document(comparisons, recorded)
        json.dump(words, sys.stdout, indent=2, ensure_ascii=False, allow_nan=False)
        sys.stdout.write("\n")
    else:
        screen.print_runs(comparisons, recorded)
        screen.print_changes(comparisons)
    if arguments.update:
        return _update(arguments, outcomes, recorded)
    if not arguments.json:
        screen.print_verdict(comparisons, recorded, seconds)
    return EXIT_WORSE if any(comparison.bad for comparison in comparisons) else EXIT_OK


def _check(arguments: argparse.Namespace) -> None:
    if arguments.update and not arguments.reason.strip():
        raise ConfigurationError(
            "a baseline changes with a reason",
            where="--update",
            remedy='make regression-update REASON="why"',
        )
    if arguments.update and (arguments.only != "*" or arguments.overrides):
        raise ConfigurationError(
            "a baseline is of the whole matrix as it is written",
            where="--update",
            remedy="leave out --only and the overrides",
        )
    if arguments.reason and not arguments.update:
        raise ConfigurationError("--reason goes with --update", where="--reason")


def _recorded(arguments: argparse.Namespace) -> comparing.BaselineFile:
    """The baseline; an update needs none, and may replace a broken one."""
    try:
        return comparing.read_recorded(arguments.baseline)
    except TrmsError:
        if arguments.update:
            return comparing.BaselineFile()
        raise


def _outcomes(cases: Sequence[Case], jobs: int) -> list[Outcome]:
    """In the order of the cases; a bar on a terminal."""
    outcomes: dict[str, Outcome] = {}
    with RunsBar(len(cases)) as advance:
        for outcome in run_all(cases, jobs):
            outcomes[outcome.case.name] = outcome
            advance(outcome.case.name)
    return [outcomes[case.name] for case in cases]


def _update(
    arguments: argparse.Namespace, outcomes: list[Outcome], before: comparing.BaselineFile
) -> int:
    from experiments.regression.screen import console
    from trms_cli.library.tasks.git_revision import GitRevision

    new = comparing.write_recorded(
        outcomes, before, arguments.reason.strip(), GitRevision.ask().answer(), arguments.baseline
    )
    if arguments.baseline == comparing.BASELINE:
        from experiments.regression.expectation import write_expectation

        write_expectation(outcomes, new)
    if not arguments.json:
        console().print(f"baseline recorded: {new.reason} ({new.date}, {new.git})")
    return EXIT_OK


if __name__ == "__main__":
    sys.exit(main())
