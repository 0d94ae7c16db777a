"""Runs as a comparison reads them: from folders, with their figures and what they were runs of.

A folder of a run holds ``run.mcap``, ``score.json`` or ``status.json``, or several of them. The log
tells the most: the configuration is attached to it. A score alone has to say under ``run`` what it
is a score of, as those of ``experiments.tournament`` do: ``coordinates``, ``outside`` (why it is
not ranked) and ``non_finite``. A status alone is of a job that failed before its log.

A run's coordinates are the options that were chosen (``controller``, ``ref``, …) and, where runs
with the same options have other values, the keys of the configuration in which they differ.
"""

import json
import math
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import Any

from trms_cli.core.data_file import absent, not_as_written, read_json
from trms_cli.core.errors import RecordingError
from trms_cli.core.printable import printable
from trms_cli.core.wording import named_files, typed_models
from trms_cli.scoring.figures import entries
from trms_cli.scoring.score import SCHEMA as SCORE_SCHEMA


class State(Enum):
    """How a run ended, with the words that tell it."""

    DONE = "done"
    FAILED = "failed"
    INCOMPLETE = "incomplete"

    @property
    def ranked(self) -> bool:
        """Whether it counts: one that somebody ended says nothing about who ran in it."""
        return self is not State.INCOMPLETE


@dataclass(frozen=True, kw_only=True)
class ComparisonRun:
    """One run."""

    path: str  #: Its folder or file
    #: What it was a run of: ``controller``, ``observer``, ``ref``, …, ``seed``, and dotted keys of
    #: the configuration in which it differs from others
    coordinates: Mapping[str, str]
    state: State = State.DONE
    score: Mapping[str, Any] | None = None  #: ``trms.score/1``; None if there is none
    message: str = ""  #: Why it failed or is incomplete
    #: Times at which a command was not finite and the one before was held; None: not counted
    non_finite: int | None = None
    outside: str = ""  #: Why it is not ranked ("knows the reference ahead"); "" if it is
    config: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """The resolved configuration, where the log has it."""
    typed: Mapping[str, str] = field(default_factory=dict, repr=False)
    """Of a job that left no log: dotted keys as typed, all that is known of its configuration."""

    def error(self, metric: str = "rmse") -> float:
        """Tracking error: a metric summed over the channels; NaN where there is none."""
        channels = (self.score or {}).get("channels", {}).values()
        values = [channel.get(metric) for channel in channels]
        if not values or any(value is None for value in values):
            return math.nan
        return float(sum(values))

    def channel(self, name: str, metric: str = "rmse") -> float:
        """One channel's metric; NaN where there is none."""
        return _number((self.score or {}).get("channels", {}).get(name, {}).get(metric))

    def input_sum(self, figure: str) -> float:
        """A figure of the inputs (``effort``, ``total_variation``), summed; NaN without one."""
        inputs = (self.score or {}).get("inputs", {}).values()
        values = [_number(each.get(figure)) for each in inputs]
        return sum(values) if values else math.nan

    def solver(self, figure: str) -> float:
        """A figure of the solver: ``failures``, ``deadline_misses``, …; NaN where there is none."""
        return _number((self.score or {}).get("solver", {}).get(figure))

    def step_time(self, figure: str) -> float:
        """``median``, ``p99`` or ``max`` of the time of a control step, ms."""
        return _number((self.score or {}).get("solver", {}).get("time_ms", {}).get(figure))

    def of_run(self, key: str) -> float:
        """A figure of the run as a whole: ``degraded`` (s), ``violations``; NaN without one."""
        entry = next((e for e in entries(self.score or {}, "run") if e.key == key), None)
        return _number(None if entry is None else entry.value)


def _number(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan


#: Where a run's files go, and what is drawn and logged: no part of what was run.
_NO_COORDINATES = frozenset({"out", "picture", "sim.prediction_every", "sim.scene_every"})
#: Resolved copies of what other groups say.
_COPIES = ("plant.effects", "plant.model", "plant.faults")
_GROUPS = ("model", "plant", "effect", "fault", "observer", "controller", "ref", "supervisor")
_CAPITAL = re.compile(r"(?<!^)(?=[A-Z])")
#: The choice of a rig's own equations, and what stands there where none are chosen.
_RIG, _NOTHING = "model@plant.model", "none"
#: Coordinates that a run without a word of them shares with the others.
_NONE = "–"


def choices_of(config: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """The options of a log that does not name them: from what was typed, else by their classes."""
    typed = of_overrides(overrides)
    choices: dict[str, Any] = {}
    for group in _GROUPS:
        content = config.get(group)
        if group in typed:
            choices[group] = typed[group]
        elif group in ("effect", "fault") and isinstance(content, Mapping):
            choices[group] = list(content)
        elif isinstance(content, Mapping):
            choices[group] = _class_name(content if group != "ref" else _first_signal(content))
    return choices | {key: value for key, value in typed.items() if "@" in key}


def of_overrides(overrides: Sequence[str]) -> dict[str, str]:
    """Coordinates as typed: ``controller=pid`` and ``plant.prior_seed=3`` alike."""
    coordinates = {}
    for word in overrides:
        key, equals, value = word.lstrip("+").partition("=")
        if equals and key not in _NO_COORDINATES and not key.startswith("hydra"):
            coordinates[key] = value.strip("'\"").strip("[]").replace(",", "+")
    return coordinates


def complete_coordinates(runs: Sequence[ComparisonRun]) -> list[ComparisonRun]:
    """Give every run a value for each coordinate, and the keys in which configurations differ."""
    runs = _with_settings(with_rigs(runs))
    usual: dict[str, Counter[str]] = {}
    for run in runs:
        for key, value in run.coordinates.items():
            usual.setdefault(key, Counter())[value] += 1
    implied = {key for key in usual if "@" in key and _is_implied(key, runs)}
    whole = []
    for run in runs:
        filled = {key: value for key, value in run.coordinates.items() if key not in implied}
        for key, values in usual.items():
            if key not in filled and key not in implied:
                # a setting of one option's is none of another's; an option left out is the usual
                filled[key] = _NONE if "." in key else values.most_common(1)[0][0]
        whole.append(replace(run, coordinates=filled))
    return whole


def with_rigs(runs: Sequence[ComparisonRun]) -> list[ComparisonRun]:
    """The runs with the equations of each rig named, where a run among them chose its rig's.

    The rig of a run that chose none has those of its model: what is chosen to be what it was
    (``trms run --from LOG model=…``) is no difference.
    """
    if all(run.coordinates.get(_RIG, _NOTHING) == _NOTHING for run in runs):
        return list(runs)
    return [
        replace(run, coordinates={**run.coordinates, _RIG: _equations(run.coordinates)})
        if _RIG in run.coordinates
        else run
        for run in runs
    ]


def _equations(coordinates: Mapping[str, str]) -> str:
    keys = (_RIG, "model@model.rig", "model")
    names = (coordinates.get(key, _NOTHING) for key in keys)
    return next((name for name in names if name != _NOTHING), _NOTHING)


def _is_implied(key: str, runs: Sequence[ComparisonRun]) -> bool:
    """Whether an option of an option (``signal@ref.alpha_v``) follows from the one it is in."""
    group = key.partition("@")[2].partition(".")[0]
    values: dict[str, set[str]] = {}
    for run in runs:
        if key in run.coordinates:
            values.setdefault(run.coordinates.get(group, ""), set()).add(run.coordinates[key])
    return all(len(options) == 1 for options in values.values())


def differing_coordinates(runs: Sequence[ComparisonRun]) -> list[str]:
    """Coordinates with more than one value, in the order in which runs have them."""
    keys = dict.fromkeys(key for run in runs for key in run.coordinates)
    return [key for key in keys if len({run.coordinates.get(key) for run in runs}) > 1]


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Keys in which two configurations differ, with both values."""
    left, right = flat(one), flat(other)
    rows = []
    for key in dict.fromkeys([*left, *right]):
        if key.startswith(_COPIES) or key in _NO_COORDINATES or left.get(key) == right.get(key):
            continue
        rows.append((key, left.get(key, _NONE), right.get(key, _NONE)))
    return rows


def flat(config: Mapping[str, Any], stem: str = "") -> dict[str, str]:
    """A nested mapping as dotted keys."""
    values: dict[str, str] = {}
    for key, value in config.items():
        place = f"{stem}{key}"
        if isinstance(value, Mapping) and value:
            values |= flat(value, f"{place}.")
        else:
            values[place] = "none" if value in (None, {}, []) else str(value)
    return values


def _with_settings(runs: Sequence[ComparisonRun]) -> list[ComparisonRun]:
    """Add dotted keys in which runs of the same options differ."""
    flats = [flat(run.config) if run.config else _as_flat(run.typed) for run in runs]
    # of a job without a log only what was typed is known, and nothing can be said of the rest
    partial = [not run.config for run in runs]
    settings = differing_settings([run.coordinates for run in runs], flats, partial)
    return [
        replace(run, coordinates={**run.coordinates, **added})
        for run, added in zip(runs, settings, strict=True)
    ]


def differing_settings(
    choices: Sequence[Mapping[str, Any]],
    flats: Sequence[Mapping[str, str]],
    partial: Sequence[bool],
) -> list[dict[str, str]]:
    """Of each run the dotted keys in which it differs from runs of the same options.

    ``choices``: the option of each group. ``flats``: dotted keys with their values. ``partial``:
    whether other keys of a run are not known, so that it is not said to have none.
    """
    groups: dict[tuple[str, str], list[int]] = {}
    for i, options in enumerate(choices):
        for group in dict.fromkeys(key.partition(".")[0] for key in flats[i]):
            groups.setdefault((group, str(options.get(group, ""))), []).append(i)
    settings: list[dict[str, str]] = [{} for _ in choices]
    for (group, _), members in groups.items():
        keys = dict.fromkeys(
            key for i in members for key in flats[i] if key.startswith(f"{group}.")
        )
        for key in keys:
            indices = [i for i in members if key in flats[i] or not partial[i]]
            values = {flats[i].get(key, _NONE) for i in indices}
            if len(values) > 1 and key not in _NO_COORDINATES and not key.startswith(_COPIES):
                for i in indices:
                    settings[i][key] = flats[i].get(key, _NONE)
    return settings


def _as_flat(typed: Mapping[str, str]) -> dict[str, str]:
    """Dotted keys as typed, their values as those of a configuration."""
    import yaml

    from trms_cli.core.yaml_data import load_yaml

    values: dict[str, str] = {}
    for key, text in typed.items():
        try:
            value = load_yaml(text)
        except yaml.YAMLError:
            value = text
        values |= flat(value, f"{key}.") if isinstance(value, Mapping) else flat({key: value})
    return values


def _class_name(content: Mapping[str, Any]) -> str:
    """``….newton_mpc.NewtonMpc`` as ``newton_mpc``."""
    name = str(content.get("_target_", "")).rpartition(".")[2]
    return _CAPITAL.sub("_", name).lower() or _NONE


def _first_signal(ref: Mapping[str, Any]) -> Mapping[str, Any]:
    """What the first axis of a reference follows."""
    signals = [
        value for value in ref.values() if isinstance(value, Mapping) and "_target_" in value
    ]
    return signals[0] if signals else ref


LOG, SCORE, STATUS = "run.mcap", "score.json", "status.json"
#: Key of a score with what it is a score of.
RUN_KEY = "run"
#: Keys of the log's ``trms.run`` record, with JSON.
CHOICES_KEY, OVERRIDES_KEY = "choices", "overrides"
_ENDINGS = {"interrupted": State.INCOMPLETE, "died": State.INCOMPLETE, "failed": State.FAILED}


@dataclass(frozen=True)
class RunCollection:
    """What lies in the folders."""

    runs: tuple[ComparisonRun, ...]  #: In the order of their paths
    #: Files that look like runs and are none that can be compared, with the reason
    left_out: tuple[tuple[str, str], ...] = ()


def gather(paths: Sequence[Path]) -> RunCollection:
    """Read every run in files and folders, however deep.

    Raises RecordingError if a path does not exist, a file is no log and no score, or there is no
    run at all.
    """
    runs: list[ComparisonRun] = []
    left_out: list[tuple[str, str]] = []
    places: set[Path] = set()
    for path in paths:
        if not path.exists():
            raise absent(path, "file or folder")
        with not_as_written(str(path)):
            path_runs = [_of_file(path)] if path.is_file() else _of_folder(path, left_out)
        for run in path_runs:
            place = Path(run.path).resolve()
            if place not in places:
                places.add(place)
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


def _of_folder(root: Path, left_out: list[tuple[str, str]]) -> list[ComparisonRun]:
    runs = []
    for folder, folders, files in os.walk(root):
        folders.sort()
        try:
            with not_as_written(folder):
                run = _of_run_folder(Path(folder), set(files))
        except RecordingError as error:
            left_out.append((error.where or folder, error.problem))
            continue
        if run is not None:
            runs.append(run)
        for name in sorted(files):  # logs by other names, as a user files them
            if name.endswith(".mcap") and name != LOG:
                try:
                    with not_as_written(str(Path(folder, name))):
                        runs.append(_of_log(Path(folder, name)))
                except RecordingError as error:
                    left_out.append((str(Path(folder, name)), error.problem))
    return runs


def _of_run_folder(folder: Path, files: set[str]) -> ComparisonRun | None:
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


def _of_file(path: Path) -> ComparisonRun:
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


def _of_log(path: Path) -> ComparisonRun:
    from trms_cli.recordings.log_reader import read_log

    log = read_log(path, ("/event",))
    if log.run.get("schema", "").partition("/")[0] != "trms.run":
        raise RecordingError(
            "this log is no run of the loop", where=str(path), remedy="compare logs of `trms run`"
        )
    from trms_cli.core.yaml_data import load_yaml

    config = load_yaml(log.config) or {}
    overrides = json.loads(log.run.get(OVERRIDES_KEY, "[]"))
    options = json.loads(log.run.get(CHOICES_KEY, "{}")) or choices_of(config, overrides)
    choices = named_files(options, config)
    state = State.DONE if log.complete else State.INCOMPLETE
    state = _ENDINGS.get(log.outcome, state)
    score: Mapping[str, Any] | None = log.score or None
    if score is None and state is State.DONE:
        from trms_cli.scoring.score import score_log

        score = score_log(read_log(path))
    return ComparisonRun(
        path=str(path.parent if path.name == LOG else path),
        coordinates=_as_text(choices) | {"seed": str(log.run.get("seed", ""))},
        state=state,
        score=score,
        message="; ".join(log.problems) or ("" if state is State.DONE else log.outcome),
        non_finite=_faults(log),
        config=config,
    )


def _of_score(score: Mapping[str, Any], path: Path) -> ComparisonRun:
    said: Mapping[str, Any] = score.get(RUN_KEY, {})
    whole = bool(score.get("complete", True))
    return ComparisonRun(
        path=str(path),
        coordinates=_as_text(said.get("coordinates", {"run": str(path)})),
        state=State.DONE if whole else State.INCOMPLETE,
        score=score,
        message="" if whole else "the run did not end",
        non_finite=said.get("non_finite"),
        outside=str(said.get("outside", "")),
    )


def _of_status(status: Mapping[str, Any], folder: Path) -> ComparisonRun:
    """A job of a sweep, or a run of a tournament, that left no log and no score."""
    own_coordinates = status.get("coordinates")
    overrides = [str(word) for word in status.get("overrides", ())]
    typed = of_overrides(overrides)
    named = {key: value for key, value in typed.items() if "." not in key or "@" in key}
    choices = status.get("choices") or {}
    models = typed_models(choices, typed)
    state = State.FAILED if status.get("state") in ("failed", "done") else State.INCOMPLETE
    return ComparisonRun(
        path=str(folder),
        coordinates=_as_text(own_coordinates or {**choices, **named, **models}),
        state=state,
        message=_reason(status),
        outside=str(status.get("outside", "")),
        typed={} if own_coordinates else {k: v for k, v in typed.items() if k not in named},
    )


def _with_status(run: ComparisonRun, status: Mapping[str, Any]) -> ComparisonRun:
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
