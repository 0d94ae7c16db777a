"""``python -m experiments.chapter7.observers``: observers side by side on the same records."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import msgspec

from experiments.chapter7.observers.comparison import Cell, cells_of, tally
from experiments.chapter7.observers.innovations import replay_all
from experiments.chapter7.observers.page import (
    free_prediction_table,
    recordings_table,
    tables_of,
)
from experiments.chapter7.observers.records import Outcome, run_job
from experiments.chapter7.observers.study import HERE, STUDY, Job, Study, jobs_of, read_study
from experiments.chapter7.observers.traces import draw_traces, trace_all
from experiments.command_line import exit_code_of
from experiments.expected_figures import json_text, rounded
from trms_cli.core.errors import EXIT_OK, ConfigurationError

SCHEMA = "trms.observers/1"
RESULTS = HERE / "results.json"
DOCS = HERE.parents[2] / "docs"
PAGE, FIGURES = DOCS / "chapter7.md", DOCS / "figures" / "chapter7"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m experiments.chapter7.observers")
    parser.add_argument("--study", type=Path, default=STUDY, help="another study.yaml")
    parser.add_argument("--quick", action="store_true", help="two short records a condition")
    parser.add_argument(
        "--part",
        choices=("all", "recordings", "traces"),
        default="all",
        help="recordings: these alone; traces: the figures of the two estimator cases alone",
    )
    parser.add_argument("--records", type=Path, help="folder of recordings of real rigs")
    parser.add_argument("--no-times", action="store_true", help="leave out the times of a step")
    parser.add_argument("--jobs", type=int, default=2, help="processes at once (default: 2)")
    parser.add_argument("--out", type=Path, help="folder for tables and JSON")
    parser.add_argument(
        "--update", action="store_true", help="write docs/chapter7.md and results.json"
    )
    arguments = parser.parse_args(argv)
    return exit_code_of(lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    study = read_study(arguments.study)
    if arguments.quick:
        study = msgspec.structs.replace(study, seeds=2, duration=12.0)
    if arguments.part != "all":
        return _run_part(arguments, study)
    begin = perf_counter()
    outcomes = []
    for outcome in run_all(study, arguments.jobs):
        outcomes.append(outcome)
        message = outcome.problem or "done"
        sys.stdout.write(
            f"{perf_counter() - begin:6.1f} s  {outcome.job.condition}, record "
            f"{outcome.job.seed}: {message}\n"
        )
        sys.stdout.flush()
    cells = cells_of(outcomes, study.observers, study.against)
    innovations = replay_all(study, arguments.records) if arguments.records else {}
    tables = tables_of(cells, study.observers, study.against, times=not arguments.no_times)
    tables |= _tables_of_recordings(study, innovations)
    text = json_text(rounded(document_of(study, cells, innovations, times=not arguments.no_times)))
    for name, table in tables.items():
        sys.stdout.write(f"\n{name}\n\n{table}\n")
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
        (arguments.out / "observers.json").write_text(text, encoding="utf-8")
        words = "\n\n".join(f"## {name}\n\n{table}" for name, table in tables.items())
        (arguments.out / "observers.md").write_text(words + "\n", encoding="utf-8")
        draw_traces(trace_all(study), arguments.out)
    if arguments.update:
        from experiments.page_tables import write_tables

        draw_traces(trace_all(study), FIGURES)
        if not innovations:  # those that stand there were made where they are
            for name in _tables_of_recordings(study, {}):
                tables.pop(name)
        write_tables(PAGE, tables)
        RESULTS.write_text(text, encoding="utf-8")
    failed = [outcome for outcome in outcomes if outcome.problem]
    return 1 if failed else EXIT_OK


def _run_part(arguments: argparse.Namespace, study: Study) -> int:
    """The recordings, or the figures of the traces; what else stands on the page stays."""
    from experiments.page_tables import write_alone, write_tables

    out = FIGURES if arguments.update else arguments.out
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    if arguments.part == "traces":
        traced = trace_all(study)
        if out is not None:
            draw_traces(traced, out)
        return EXIT_OK
    if arguments.records is None:
        raise ConfigurationError(
            "no folder given", where="--part recordings", remedy="--records FOLDER"
        )
    innovations = replay_all(study, arguments.records)
    tables = _tables_of_recordings(study, innovations)
    for name, table in tables.items():
        sys.stdout.write(f"\n{name}\n\n{table}\n")
    if arguments.update:
        document = json.loads(RESULTS.read_text(encoding="utf-8"))
        document["recordings"] = rounded(innovations)
        RESULTS.write_text(json_text(document), encoding="utf-8")
        write_tables(PAGE, tables)
    elif out is not None:
        write_alone(out, tables)
    return EXIT_OK


def _tables_of_recordings(study: Study, innovations: dict[str, Any]) -> dict[str, str]:
    return {
        "recordings": recordings_table(innovations, study.observers),
        "free prediction": free_prediction_table(
            innovations, study.observers, study.free_prediction.horizons
        ),
    }


def run_all(study: Study, jobs: int) -> Iterator[Outcome]:
    """Every job of the study, in order, in worker processes."""
    work: list[Job] = jobs_of(study)
    if jobs <= 1:
        yield from map(partial(run_job, study), work)
        return
    # A fresh process each, also where forking is usual: casadi's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=jobs, mp_context=context) as pool:
        yield from pool.map(partial(run_job, study), work)


def document_of(
    study: Study, cells: Sequence[Cell], innovations: dict[str, Any], *, times: bool
) -> dict[str, Any]:
    """The JSON twin of the tables."""
    return {
        "schema": SCHEMA,
        "against": study.against,
        "conditions": [
            {
                "rig": cell.condition,
                "channels": cell.channels,
                "torques": cell.torques,
                "records": cell.records,
                "rmse": cell.rmse,
                "ratio": {
                    observer: {state: [r.mean, r.low, r.high] for state, r in of.items()}
                    for observer, of in cell.ratios.items()
                },
                **({"microseconds": cell.microseconds} if times else {}),
            }
            for cell in cells
        ],
        "tally": {
            observer: {verdict: len(where) for verdict, where in tally(cells, observer).items()}
            for observer in study.observers
            if observer != study.against
        },
        "recordings": innovations,
    }


if __name__ == "__main__":
    sys.exit(main())
