"""``python -m experiments.chapter4``: white against grey, and methods against each other."""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from time import perf_counter

from experiments.command_line import exit_code_of, one_thread_each
from trms_cli.core.errors import EXIT_OK


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study, print its tables, write them into the documentation on request."""
    arguments = _parser().parse_args(argv)
    one_thread_each()
    return exit_code_of(lambda: _study(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m experiments.chapter4", description=__doc__)
    parser.add_argument("--only", default="*", metavar="PATTERN", help="cases: 3, 'vertical*'")
    parser.add_argument("--quick", action="store_true", help="small, to see that it works")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument(
        "--publish", action="store_true", help="put tables and figures into docs/chapter4.md"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("outputs/chapter4"), help="folder of tables and figures"
    )
    return parser


def _study(arguments: argparse.Namespace) -> int:
    from experiments.chapter4 import page
    from experiments.chapter4.cases import Case, read_study
    from experiments.chapter4.fits import CaseOutcome, run_case
    from experiments.page_tables import print_tables

    study = read_study(arguments.only, arguments.quick)
    begin = perf_counter()
    # The comparison first: its searches are the longest.
    work: list[tuple[Case, dict[str, tuple[str, ...]], tuple[int, ...], bool]] = [
        (case, {name: words}, (seed,), True)
        for case in study.compared
        for name, words in study.comparison.items()
        for seed in study.seeds
    ]
    work += [(case, study.methods, (0,), False) for case in study.cases]
    outcomes: dict[int, CaseOutcome] = {}
    compared: dict[int, CaseOutcome] = {}
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=arguments.jobs, mp_context=context) as pool:
        waiting = {pool.submit(run_case, *item[:3]): item for item in work}
        try:
            for count, future in enumerate(as_completed(waiting), start=1):
                case, methods, _, of_comparison = waiting[future]
                outcome = future.result()
                _tell(count, len(work), case.name, ", ".join(methods))
                if not of_comparison:
                    outcomes[case.number] = outcome
                elif case.number in compared:
                    compared[case.number].fits += outcome.fits
                else:
                    compared[case.number] = outcome
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    seconds = perf_counter() - begin
    findings = page.Findings(
        [outcomes[number] for number in sorted(outcomes)],
        [compared[number] for number in sorted(compared)],
        seconds,
    )
    tables = {name: rows for name, rows in page.tables(findings).items() if len(rows) > 1}
    print_tables(tables, width=120)
    page.write_out(findings, arguments.out)
    if arguments.publish:
        page.publish(findings)
    print(f"{seconds:.0f} s; tables and figures: {arguments.out}")
    return EXIT_OK


def _tell(count: int, of: int, name: str, methods: str) -> None:
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\033[K{count} of {of}: {name} ({methods})")
        if count == of:
            sys.stderr.write("\r\033[K")
        sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
