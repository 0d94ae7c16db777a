"""A log, or a job of a sweep that failed before it had one, as a row of the index."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec

from trms_cli.core.data_file import json_or_none, unreadable
from trms_cli.core.errors import RecordingError
from trms_cli.core.printable import printable
from trms_cli.core.whole_file import BINARY
from trms_cli.core.wording import named_files, typed_models
from trms_cli.recordings.log_head import LogHead, read_log_head
from trms_cli.runs.columns import COLUMNS, figures_of, units_of

#: The file of a run in its folder; a run is called by that folder.
LOG_NAME = "run.mcap"
#: Options of these groups are a column each.
_GROUPS = ("controller", "observer", "ref", "model", "plant", "supervisor", "experiment")
_ENDINGS = frozenset({"completed", "interrupted", "failed"})
_LARGEST = 2**63 - 1  # of the database's whole numbers
_PATHS = ("log", "path")  # kept as they are: a command opens what they name
_LONGEST_TEXT = 20_000  # of a cell


@dataclass(frozen=True)
class RunWords:
    """What a comparison needs of a run that ended, beside the figures."""

    state: str  #: Of :class:`trms_cli.scoring.comparison.runs.State`, by its value
    message: str  #: Why it failed or is incomplete
    non_finite: int  #: Commands that were not finite
    coordinates: Mapping[str, str]  #: As a comparison names them, but for the seed
    seed: str
    config: str  #: The resolved configuration as YAML


@dataclass(frozen=True)
class IndexEntry:
    """What the index keeps of a log."""

    log: str  #: Its absolute path
    #: dict of str to anything; by the names of :data:`~trms_cli.runs.columns.COLUMNS`
    values: dict[str, Any]
    #: dict of str to anything; values that were typed as KEY=VALUE, by their dotted keys
    typed: dict[str, Any] = field(default_factory=dict)
    #: Figures of other channels than the twin rotor's, and errors of estimates
    more: dict[str, float] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)  #: Of those, and of totals over them
    words: RunWords | None = None  #: What a comparison needs beside the figures


def read_entry(path: Path) -> IndexEntry | None:
    """Read a log's row; None for a log that is no run of the loop: an imported recording.

    A run that was killed has no score in its log; it is scored here as far as it goes.

    Raises RecordingError if the log cannot be read.
    """
    try:
        head = read_log_head(path)
        if not head.of_trms or not (head.config or "choices" in head.run):
            return None
        return _entry(head)
    except RecordingError:
        raise
    except Exception as error:  # a log from a stranger may hold anything
        raise RecordingError(
            f"its words are not as trms writes them ({type(error).__name__}: {error})",
            where=str(path),
        ) from error


def _entry(head: LogHead) -> IndexEntry:
    run, path = head.run, head.path
    outcome = run.get("outcome", "")
    outcome = outcome if outcome in _ENDINGS else "unfinished"
    overrides = _strings(json_or_none(run.get("overrides")))
    choices = _choices(head, overrides)
    versions = json_or_none(run.get("versions"))
    score = head.score or _scored(path)
    figures = figures_of(score)
    begin, end = _moment(run.get("start")), _moment(run.get("end"))
    values: dict[str, Any] = dict.fromkeys(COLUMNS) | {
        name: value for name, value in figures.items() if name in COLUMNS
    }
    values |= {
        "path": str(path.parent if path.name == LOG_NAME else path),
        "log": str(path),
        "time": None if begin is None else begin.strftime("%Y-%m-%d %H:%M:%S"),
        "command": run.get("command"),
        "outcome": outcome,
        "complete": head.finished and outcome == "completed",
        **choices_of_run(named_files(choices, head.config)),
        "recording": run.get("recording.file"),
        "loop": run.get("loop"),
        "seed": _parse(run.get("seed", "")),
        "sample_time": _sample_time(head.config),
        "took": None if begin is None or end is None else (end - begin).total_seconds(),
        "git": run.get("git"),
        "version": _text(versions.get("trms")) if isinstance(versions, Mapping) else None,
        "platform": run.get("platform"),
        "versions": run.get("versions"),
        "overrides": json.dumps(overrides, ensure_ascii=False),
        "choices": json.dumps(choices, ensure_ascii=False),
    }
    more = {k: float(v) for k, v in figures.items() if k not in COLUMNS and v is not None}
    typed = typed_overrides(overrides)
    return IndexEntry(str(path), cells(values), typed, more, units_of(score), _words(head))


def _words(head: LogHead) -> RunWords | None:
    """What a comparison reads of a log; None where the index cannot tell it."""
    from trms_cli.scoring.comparison.runs import of_log_head

    run = of_log_head(head)
    if run is None:
        return None
    coordinates = dict(run.coordinates)
    seed = coordinates.pop("seed")
    state = run.state.value
    return RunWords(state, run.message, run.non_finite or 0, coordinates, seed, head.config)


def choices_of_run(choices: Mapping[str, Any]) -> dict[str, str | None]:
    """The columns of what was choices_of_run, from the option of each group."""
    options = {group: _text(choices.get(group)) for group in _GROUPS}
    return options | {
        "effects": _join(choices.get("effect")),
        "faults": _join(choices.get("fault")),
    }


def cells(values: Mapping[str, Any]) -> dict[str, Any]:
    """The values as their columns have them; None for what a column cannot hold."""
    return {name: _cell(name, value) for name, value in values.items()}


def _choices(head: LogHead, overrides: list[str]) -> dict[str, Any]:
    """The option of each group; logs of older versions do not name them."""
    choices = json_or_none(head.run.get("choices"))
    if isinstance(choices, Mapping) and choices:
        return dict(choices)
    from trms_cli.core.yaml_data import load_yaml
    from trms_cli.scoring.comparison.runs import choices_of

    config = load_yaml(head.config)
    return choices_of(config if isinstance(config, Mapping) else {}, overrides)


def _scored(path: Path) -> Mapping[str, Any]:
    """The score of a log that has none; empty where there is too little to be scored."""
    from trms_cli.recordings.log_reader import read_log
    from trms_cli.scoring.score import score_log

    try:
        return score_log(read_log(path))
    except (RecordingError, ValueError, KeyError, IndexError):
        return {}


def _sample_time(config: str) -> float | None:
    """``sim.sample_time``: the block is cut out, since YAML takes 100 times as long as the rest."""
    lines = config.splitlines()
    begin = next((i for i, line in enumerate(lines) if line.rstrip() == "sim:"), None)
    if begin is None:
        return None
    length = next(
        (i for i, line in enumerate(lines[begin + 1 :]) if line[:1] not in (" ", "")), None
    )
    block = lines[begin : None if length is None else begin + 1 + length]
    return _sample_time_in("\n".join(block[:50]))


@lru_cache(maxsize=64)
def _sample_time_in(block: str) -> float | None:
    """The same of that block alone, of which runs of a sweep have few."""
    import yaml

    from trms_cli.core.yaml_data import load_yaml

    try:
        document = load_yaml(block)
    except yaml.YAMLError:
        return None
    value = document["sim"].get("sample_time") if isinstance(document.get("sim"), dict) else None
    return float(value) if isinstance(value, (int, float)) else None


def typed_overrides(overrides: list[str]) -> dict[str, Any]:
    """What was typed, by its key; a sweep's own settings are none of the run's."""
    return dict(each for word in overrides if (each := _typed_override(word)))


@lru_cache(maxsize=4096)
def _typed_override(word: str) -> tuple[str, Any] | None:
    """The same of one word, of which runs of a sweep share most."""
    key, equals, value = word.lstrip("+").partition("=")
    return (key, _parse(value)) if equals and not key.startswith("hydra") else None


def _parse(text: str) -> Any:
    """A number, truth value, null or text, as it was typed."""
    for kind in (int, float):
        try:
            value = kind(text)
        except ValueError:
            continue
        return value if abs(value) < 1e300 else text
    words = {"true": True, "false": False, "null": None}
    return words.get(text.lower(), text.strip("'\""))


def _strings(value: Any) -> list[str]:
    return [str(word) for word in value] if isinstance(value, list) else []


def _join(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return "+".join(map(str, value))
    return "" if value is None else str(value)


def _text(value: Any) -> str | None:
    return None if value is None else _join(value)


def _moment(text: str | None) -> datetime | None:
    try:
        moment = datetime.fromisoformat(text or "")
    except ValueError:
        return None
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).astimezone(UTC)


def _cell(name: str, value: Any) -> Any:
    """The value as its column has it; None for what the column cannot hold."""
    if value is None:
        return None
    kind = COLUMNS[name].kind
    if kind == "text":
        text = str(value)[:_LONGEST_TEXT]
        return text if name in _PATHS else printable(text)
    if kind == "truth":
        return bool(value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    if kind == "whole":
        whole = float(value).is_integer() and abs(value) <= _LARGEST
        return int(value) if whole else None
    return float(value)


STATUS_NAME = "status.json"
STATUS_SCHEMA = "trms.status/1"
_LONGEST = 2**24  # bytes


def status_document(file: Path | str) -> dict[str, Any] | None:
    """The content of a ``status.json``; None for a file of this name that is somebody else's.

    Raises OSError if the file cannot be read.
    """
    descriptor = os.open(file, os.O_RDONLY | BINARY)  # for a hundred thousand of them
    try:
        content = os.read(descriptor, min(os.fstat(descriptor).st_size, _LONGEST))
    finally:
        os.close(descriptor)
    try:
        try:
            document = msgspec.json.decode(content)  # in a fifth of the time
        except msgspec.DecodeError:  # it may still be what the standard library takes
            document = json.loads(content)
    except (ValueError, RecursionError):
        return None
    ours = isinstance(document, dict) and document.get("schema") == STATUS_SCHEMA
    return document if ours else None


def read_status(path: Path) -> IndexEntry | None:
    """Read the row of a job; None for a file of this name that is somebody else's.

    Raises RecordingError if the file cannot be read.
    """
    try:
        document = status_document(path)
    except OSError as error:
        raise unreadable(error, path) from error
    if document is None:
        return None
    overrides = _strings(document.get("overrides"))
    keys = typed_overrides(overrides)
    choices = document.get("choices")
    if not isinstance(choices, Mapping):
        choices = {key: value for key, value in keys.items() if "." not in key}
    ended = document.get("state") in ("failed", "done")
    values: dict[str, Any] = dict.fromkeys(COLUMNS) | {
        "path": str(path.parent),
        "log": str(path),
        "outcome": "failed" if ended else "unfinished",
        "complete": False,
        "problem": _problem(document.get("error")),
        **choices_of_run({**choices, **typed_models(choices, keys)}),
        "seed": keys.get("seed"),
        "overrides": json.dumps(overrides, ensure_ascii=False),
        "choices": json.dumps(choices, ensure_ascii=False),
    }
    return IndexEntry(str(path), cells(values), keys)


def _problem(error: Any) -> str | None:
    """The sentence of an error: text, or a mapping with the problem."""
    if isinstance(error, Mapping):
        error = " ".join(str(error[key]) for key in ("where", "problem") if error.get(key))
    return str(error) if error else None
