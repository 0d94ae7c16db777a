"""``python -m benchmarks [SUBJECT…]``: run, print, write ``trms.bench/1``."""

from __future__ import annotations

import argparse
import importlib
import os
import shlex
import sys
import time
import warnings
from pathlib import Path

from benchmarks.document import Table, document, print_table, write_document
from benchmarks.options import Options
from trms_cli.core.threads import ONE_THREAD

#: In the order of running; a module each under benchmarks.subjects.
SUBJECTS = (
    *("newton_time", "linear_time", "exported", "peers", "acados", "objective", "tracking"),
    *("parts", "real_time", "identification", "program", "growth", "run_overhead", "sweeps"),
    *("diagnosis", "scale"),
)


def main(argv: list[str] | None = None) -> int:
    """Run the chosen subjects; the exit code is 0 also when limits are missed."""
    parser = _parser()
    arguments = parser.parse_args(argv)
    for name in arguments.subjects:
        if name not in SUBJECTS:
            parser.error(f"no subject {name!r}; there are: {', '.join(SUBJECTS)}")
    # Before NumPy and CasADi load: one thread for everybody.
    os.environ.update(ONE_THREAD)
    # CasADi tells do-mpc what will change in its next major version.
    warnings.filterwarnings("ignore", category=FutureWarning, module=r"casadi|do_mpc")
    from benchmarks.machine import describe

    options = Options(arguments.quick, arguments.out)
    machine = describe()
    print(
        f"{machine['processor']}, {machine['cores']} cores, load {machine['load_1min']}, "
        f"Python {machine['python']}, one thread"
    )
    if machine["load_1min"] > 0.5:
        print("The machine is busy: take these figures for upper bounds.")
    tables: list[Table] = []
    for name in arguments.subjects or SUBJECTS:
        subject = importlib.import_module(f"benchmarks.subjects.{name}")
        begin = time.perf_counter()
        subject_tables = subject.run(options)
        for table in subject_tables:
            print_table(table)
        tables += subject_tables
        print(f"  ({name}: {time.perf_counter() - begin:.0f} s)")
    command = shlex.join(["python", "-m", "benchmarks", *(sys.argv[1:] if argv is None else argv)])
    path = options.out / "bench.json"
    write_document(document(machine, command, tables), path)
    if arguments.publish:
        from benchmarks.publish import PAGE, publish

        publish(tables, machine, options.out)
        print(f"published: {PAGE}")
    missed = sum(len(table.misses) for table in tables)
    limit_count = sum("met" in row for table in tables for row in table.rows)
    print(f"\n{limit_count - missed} of {limit_count} limits met; all figures: {path}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Speed and quality against peers and limits, as ratios.",
    )
    parser.add_argument(
        "subjects", nargs="*", metavar="SUBJECT", help=f"of: {', '.join(SUBJECTS)} (default: all)"
    )
    parser.add_argument(
        "--quick", action="store_true", help="few samples, to see that everything works"
    )
    parser.add_argument(
        "--publish", action="store_true", help="also put the figures into docs/benchmarks.md"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Options.out,
        metavar="FOLDER",
        help="of the document and the figures (default: %(default)s)",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
