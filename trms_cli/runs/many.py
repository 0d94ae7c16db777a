"""Thousands of runs for a comparison, out of the index: no log is opened that has not changed.

What a log alone can tell (a run that died, one of an older version) is read from it as ever, and so
are jobs that left no log and scores that lie alone.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from trms_cli.core.data_file import not_as_written
from trms_cli.core.errors import RecordingError
from trms_cli.runs.entry import LOG_NAME
from trms_cli.runs.index import scope_sql
from trms_cli.runs.query import Tell, current_index
from trms_cli.scoring.comparison.runs import (
    FIGURE_COLUMNS,
    ComparisonRun,
    FlatConfiguration,
    RunCollection,
    State,
    gather,
    of_log,
    of_run_folder,
    runs_in_folder,
)

#: Logs from which on the index is asked: fewer are read in less than a second or two.
MANY = 50
Folder = tuple[list[ComparisonRun], list[tuple[str, str]]]


def gather_runs(paths: Sequence[Path], tell: Tell = lambda count, of: None) -> RunCollection:
    """Every run in files and folders as :func:`gather` has them, folders of many by the index.

    `tell` is called with the number of logs read and of those to be read. Raises RecordingError as
    `gather` does.
    """

    def of_folder(folder: Path) -> Folder:
        return _of_index(folder, tell) if _has_many(folder) else runs_in_folder(folder)

    return gather(paths, of_folder)


def _has_many(root: Path) -> bool:
    count = 0
    for _, _, files in os.walk(root):
        count += sum(name.endswith(".mcap") for name in files)
        if count >= MANY:
            return True
    return False


def _of_index(root: Path, tell: Tell) -> Folder:
    place = os.path.realpath(root)
    runs: list[tuple[Any, ComparisonRun]] = []
    left_out: list[tuple[str, str]] = []
    to_read: dict[str, None] = {}
    with current_index([place], tell) as (index, walk):
        bases, own = index.bases(), index.units(scope_sql([place]))
        units = {"channels": own.get("rmse", "rad"), "inputs": own.get("total_variation", "V")}
        decode = msgspec.json.Decoder(list[Any]).decode
        for log, text, figures in index.compared(FIGURE_COLUMNS, scope_sql([place])):
            if text is None:
                to_read[log] = None
                continue
            state, message, non_finite, seed, number, changes = decode(text)
            coordinates, base = bases[number]
            folder, _, name = log.rpartition(os.sep)
            run = ComparisonRun(
                path=_as_named(folder if name == LOG_NAME else log, place, root),
                coordinates={**coordinates, "seed": seed},
                state=State(state),
                message=message,
                non_finite=non_finite,
                figures=figures,
                units=units,
                settings=FlatConfiguration(base, changes),
            )
            runs.append((_order(log), run))
        to_read |= dict.fromkeys(index.others([place]))
    for file in (*to_read, *(os.path.join(folder, "") for folder in walk.scores)):
        path = Path(_as_named(file, place, root))
        beside = path if file.endswith(os.sep) else path.parent
        is_log_alone = path.suffix == ".mcap" and path.name != LOG_NAME
        try:
            with not_as_written(str(path)):
                files = {*os.listdir(beside)}
                run_there = of_log(path) if is_log_alone else of_run_folder(beside, files)
        except RecordingError as error:
            left_out.append((error.where or str(beside), error.problem))
            continue
        if run_there is not None:
            runs.append((_order(file), run_there))
    runs.sort(key=lambda each: each[0])
    return [run for _, run in runs], sorted(left_out)


def _as_named(path: str, place: str, root: Path) -> str:
    """A path below a folder as it follows from what was typed for that."""
    below = path[len(place) :].lstrip(os.sep)
    return os.path.join(str(root), below) if below else str(root)


def _order(log: str) -> tuple[list[str], bool, str]:
    """As a walk through sorted folders has them: what lies in a folder, then what below it."""
    folder, _, name = log.rpartition(os.sep)
    is_other = name.endswith(".mcap") and name != LOG_NAME
    return folder.split(os.sep), is_other, name
