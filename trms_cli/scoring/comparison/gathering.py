"""Finds the runs in folders: logs, scores and the words that a sweep leaves of its jobs.

A folder of a run holds ``run.mcap``, ``score.json`` or ``status.json``, or several of them. The
log tells the most: the configuration is attached to it. A score alone has to say under ``run``
what it is a score of, as those of ``experiments.tournament`` do: ``coordinates``, ``outside`` (why
it is not ranked) and ``non_finite``. A status alone is that of a job that failed before it had a
log.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from trms_cli.core.data_file import not_as_written, read_json
from trms_cli.core.errors import RecordingError
from trms_cli.core.headline import shown_choices
from trms_cli.core.printable import printable
from trms_cli.scoring.comparison.compared_run import ComparedRun, State
from trms_cli.scoring.comparison.coordinates import (
    choices_of,
    complete_coordinates,
    of_overrides,
)
from trms_cli.scoring.score import SCHEMA as SCORE_SCHEMA

LOG, SCORE, STATUS = "run.mcap", "score.json", "status.json"
#: Key of a score with what it is a score of.
RUN_KEY = "run"
#: Keys of the log's ``trms.run`` record, with JSON.
CHOICES_KEY, OVERRIDES_KEY = "choices", "overrides"
_ENDINGS = {"interrupted": State.INCOMPLETE, "died": State.INCOMPLETE, "failed": State.FAILED}


@dataclass(frozen=True)
class RunCollection:
    """What lies in the folders."""

    runs: tuple[ComparedRun, ...]  #: In the order of their paths
    #: Files that look like runs and are none that can be compared, with the reason
    left_out: tuple[tuple[str, str], ...] = ()


def gather(paths: Sequence[Path]) -> RunCollection:
    """Read every run in files and folders, however deep.

    Raises RecordingError if a path does not exist, a file is no log and no score, or there is no
    run at all.
    """
    runs: list[ComparedRun] = []
    left_out: list[tuple[str, str]] = []
    seen: set[Path] = set()
    for path in paths:
        if not path.exists():
            raise RecordingError("there is no such file or folder", where=str(path))
        with not_as_written(str(path)):
            found = [_of_file(path)] if path.is_file() else _of_folder(path, left_out)
        for run in found:
            place = Path(run.path).resolve()
            if place not in seen:
                seen.add(place)
                runs.append(run)
    if not runs:
        words = f"; {left_out[0][0]}: {left_out[0][1]}" if left_out else ""
        raise RecordingError(
            f"there is no run here{words}",
            where=", ".join(map(str, paths)),
            remedy="a run's folder holds run.mcap or score.json: make some by "
            "`trms run -m controller=pid,lqr,newton_mpc`",
        )
    return RunCollection(tuple(complete_coordinates(runs)), tuple(left_out))


def _of_folder(root: Path, left_out: list[tuple[str, str]]) -> list[ComparedRun]:
    found = []
    for folder, folders, files in os.walk(root):
        folders.sort()
        try:
            with not_as_written(folder):
                run = _of_run_folder(Path(folder), set(files))
        except RecordingError as error:
            left_out.append((error.where or folder, error.problem))
            continue
        if run is not None:
            found.append(run)
        for name in sorted(files):  # logs by other names, as a user files them
            if name.endswith(".mcap") and name != LOG:
                try:
                    with not_as_written(str(Path(folder, name))):
                        found.append(_of_log(Path(folder, name)))
                except RecordingError as error:
                    left_out.append((str(Path(folder, name)), error.problem))
    return found


def _of_run_folder(folder: Path, files: set[str]) -> ComparedRun | None:
    status = _document(folder / STATUS) if STATUS in files else {}
    if LOG in files:
        try:
            return _with_status(_of_log(folder / LOG), status)
        except RecordingError:
            if not status:
                raise
    elif SCORE in files:
        score = _document(folder / SCORE)
        if score.get("schema") == SCORE_SCHEMA and RUN_KEY in score:
            return _of_score(score, folder)
        if not status:
            raise RecordingError(
                "the score does not say what it is a score of, and its log is gone",
                where=str(folder / SCORE),
            )
    if status.get("schema") == "trms.status/1":
        return _of_status(status, folder)
    return None


def _of_file(path: Path) -> ComparedRun:
    if path.suffix != ".json":
        return _of_log(path)
    document = _document(path)
    if document.get("schema") != SCORE_SCHEMA:
        raise RecordingError(
            "this is no score of a run", where=str(path), remedy="give logs, or folders of runs"
        )
    beside = path.with_name(LOG)
    if RUN_KEY not in document and beside.is_file():
        return _of_log(beside)
    return _of_score(document, path)


def _of_log(path: Path) -> ComparedRun:
    from trms_cli.recordings.log_reader import read_log

    log = read_log(path, ("/event",))
    if log.run.get("schema", "").partition("/")[0] != "trms.run":
        raise RecordingError(
            "this log is no run of the loop", where=str(path), remedy="compare logs of `trms run`"
        )
    from trms_cli.core.yaml_data import load_yaml

    config = load_yaml(log.config) or {}
    overrides = json.loads(log.run.get(OVERRIDES_KEY, "[]"))
    chosen = json.loads(log.run.get(CHOICES_KEY, "{}")) or choices_of(config, overrides)
    named = shown_choices(chosen, config)  # a fitted model is called by its file or fit
    choices = {g: named[g] if c == "from_file" else c for g, c in chosen.items()}
    state = State.DONE if log.complete else State.INCOMPLETE
    state = _ENDINGS.get(log.outcome, state)
    score: Mapping[str, Any] | None = log.score or None
    if score is None and state is State.DONE:
        from trms_cli.scoring.score import score_log

        score = score_log(read_log(path))
    return ComparedRun(
        path=str(path.parent if path.name == LOG else path),
        coordinates=_as_text(choices) | {"seed": str(log.run.get("seed", ""))},
        state=state,
        score=score,
        message="; ".join(log.problems) or ("" if state is State.DONE else log.outcome),
        non_finite=_faults(log),
        config=config,
    )


def _of_score(score: Mapping[str, Any], path: Path) -> ComparedRun:
    said: Mapping[str, Any] = score.get(RUN_KEY, {})
    whole = bool(score.get("complete", True))
    return ComparedRun(
        path=str(path),
        coordinates=_as_text(said.get("coordinates", {"run": str(path)})),
        state=State.DONE if whole else State.INCOMPLETE,
        score=score,
        message="" if whole else "the run did not end",
        non_finite=said.get("non_finite"),
        outside=str(said.get("outside", "")),
    )


def _of_status(status: Mapping[str, Any], folder: Path) -> ComparedRun:
    """A job of a sweep, or a run of a tournament, that left no log and no score."""
    given = status.get("coordinates")
    overrides = [str(word) for word in status.get("overrides", ())]
    typed = of_overrides(overrides)
    named = {key: value for key, value in typed.items() if "." not in key or "@" in key}
    state = State.FAILED if status.get("state") in ("failed", "done") else State.INCOMPLETE
    return ComparedRun(
        path=str(folder),
        coordinates=_as_text(given or {**(status.get("choices") or {}), **named}),
        state=state,
        message=_reason(status),
        outside=str(status.get("outside", "")),
        typed={} if given else {k: v for k, v in typed.items() if k not in named},
    )


def _with_status(run: ComparedRun, status: Mapping[str, Any]) -> ComparedRun:
    """What the sweep says of a job counts more than its log does."""
    if status.get("state") == "failed" and run.state is not State.FAILED:
        return replace(run, state=State.FAILED, message=_reason(status))
    if run.state is State.FAILED and status.get("error"):
        return replace(run, message=_reason(status))
    return run


def _reason(status: Mapping[str, Any]) -> str:
    """The sentence of a status: its error is text, or a mapping with the problem."""
    error = status.get("error")
    if isinstance(error, Mapping):
        error = error.get("problem") or error.get("message") or json.dumps(dict(error))
    return str(error or status.get("state", "")).strip().splitlines()[0]


def _faults(log: Any) -> int:
    """Events in which a controller asked for what is no finite number."""
    events = log.tables.get("/event")
    if events is None or not len(events):
        return 0
    kinds, sources = events.columns["kind"], events.columns["source"]
    return sum(k == "fault" and s == "controller" for k, s in zip(kinds, sources, strict=True))


def _document(path: Path) -> dict[str, Any]:
    try:
        document = read_json(path)
    except (OSError, ValueError) as error:
        raise RecordingError(f"it cannot be read ({error})", where=str(path)) from error
    if not isinstance(document, dict):
        raise RecordingError("this is no document of trms", where=str(path))
    return document


def _as_text(coordinates: Mapping[str, Any]) -> dict[str, str]:
    """Names of choices; several of them in one text, none as "none"."""

    def text(value: Any) -> str:
        if isinstance(value, (list, tuple)):
            return printable("+".join(map(str, value))) or "none"
        return "none" if value is None else printable(str(value))

    return {str(key): text(value) for key, value in coordinates.items()}
