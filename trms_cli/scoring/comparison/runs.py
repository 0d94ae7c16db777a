"""Runs as a comparison reads them: from folders, with their figures and what they were runs of.

A folder of a run holds ``run.mcap``, ``score.json`` or ``status.json``, or several of them. The log
tells the most: the configuration is attached to it. A score alone has to say under ``run`` what it
is a score of, as those of ``experiments.tournament`` do: ``coordinates``, ``outside`` (why it is
not ranked) and ``non_finite``. A status alone is of a job that failed before its log.

A run's coordinates are the options that were chosen (``controller``, ``ref``, …) and, where runs
with the same options have other values, the keys of the configuration in which they differ.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.core.data_file import absent, json_or_none, not_as_written, read_json
from trms_cli.core.errors import RecordingError
from trms_cli.core.printable import printable
from trms_cli.core.wording import named_files, typed_models
from trms_cli.scoring.figures import Group, entries, of_group, part
from trms_cli.scoring.score import SCHEMA as SCORE_SCHEMA

if TYPE_CHECKING:
    from trms_cli.recordings.log_head import LogHead


class State(Enum):
    """How a run ended, with the words that tell it."""

    DONE = "done"
    FAILED = "failed"
    INCOMPLETE = "incomplete"

    @property
    def ranked(self) -> bool:
        """Whether it counts: one that somebody ended says nothing about who ran in it."""
        return self is not State.INCOMPLETE


_FIGURES = [
    figure
    for figure in of_group("channels", "inputs", "solver", "run")
    if figure.total == "sum" or figure.group in ("solver", "run")
]
#: What a comparison asks of a score, and its place among :attr:`ComparisonRun.figures`.
FIGURES = {(figure.group, figure.key): place for place, figure in enumerate(_FIGURES)}
#: The same by the names that ``trms runs`` has for them.
FIGURE_COLUMNS = tuple(figure.column_name for figure in _FIGURES)


@dataclass(frozen=True, slots=True)
class FlatConfiguration:
    """A configuration by dotted keys, as what it has in place of that of another run.

    Thousands of runs of a sweep share one ``base`` and differ in a few keys.
    """

    base: Mapping[str, str]
    changes: Mapping[str, str | None] = field(default_factory=dict)  #: None: the key is not there
    is_partial: bool = False  #: Whether there may be keys that are not known

    def get(self, key: str) -> str | None:
        """The value of a key; None where there is none."""
        return self.changes[key] if key in self.changes else self.base.get(key)

    def below(self, stem: str) -> tuple[tuple[str, str], ...]:
        """Keys that are `stem` or stand below it, sorted, with their values."""
        own = {**self.base, **self.changes}
        below = f"{stem}."
        return tuple(
            sorted(
                (key, value)
                for key, value in own.items()
                if value is not None and (key == stem or key.startswith(below))
            )
        )


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
    #: Of a run that the index tells of, in place of its score: values of :data:`FIGURES`
    figures: Sequence[float | None] | None = field(default=None, repr=False)
    #: likewise: units of ``channels`` and ``inputs``; empty: the score has them
    units: Mapping[str, str] = field(default_factory=dict, repr=False)
    #: likewise, in place of its configuration
    settings: FlatConfiguration | None = field(default=None, repr=False)

    def flat_settings(self) -> FlatConfiguration:
        """All that is known of its configuration, by dotted keys."""
        if self.settings is not None:
            return self.settings
        if self.config:
            return FlatConfiguration(flat(self.config))
        return FlatConfiguration(_as_flat(self.typed), is_partial=True)

    def with_coordinates(self, coordinates: Mapping[str, str]) -> ComparisonRun:
        """The same run, told apart by others; a hundred thousand are made so."""
        made = object.__new__(ComparisonRun)
        made.__dict__.update(self.__dict__, coordinates=coordinates)
        return made

    def _figure(self, group: Group, key: str) -> float:
        assert self.figures is not None
        place = FIGURES.get((group, key))
        value = None if place is None else self.figures[place]
        return math.nan if value is None else value

    def row(self) -> Sequence[float | None]:
        """All of :data:`FIGURES`, for a table of many runs; None or NaN where there is none."""
        if self.figures is not None:
            return self.figures
        return tuple(
            self.error(key)
            if group == "channels"
            else self.input_sum(key)
            if group == "inputs"
            else self.of_run(key)
            if group == "run"
            else self.step_time(key.removeprefix("time_ms."))
            if key.startswith("time_ms.")
            else self.solver(key)
            for group, key in FIGURES
        )

    def error(self, metric: str = "rmse") -> float:
        """Tracking error: a metric summed over the channels; NaN where there is none."""
        if self.figures is not None:
            return self._figure("channels", metric)
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
        if self.figures is not None:
            return self._figure("inputs", figure)
        inputs = (self.score or {}).get("inputs", {}).values()
        values = [_number(each.get(figure)) for each in inputs]
        return sum(values) if values else math.nan

    def solver(self, figure: str) -> float:
        """A figure of the solver: ``failures``, ``deadline_misses``, …; NaN where there is none."""
        if self.figures is not None:
            return self._figure("solver", figure)
        return _number((self.score or {}).get("solver", {}).get(figure))

    def step_time(self, figure: str) -> float:
        """``median``, ``p99`` or ``max`` of the time of a control step, ms."""
        if self.figures is not None:
            return self._figure("solver", f"time_ms.{figure}")
        return _number((self.score or {}).get("solver", {}).get("time_ms", {}).get(figure))

    def of_run(self, key: str) -> float:
        """A figure of the run as a whole: ``degraded`` (s), ``violations``; NaN without one."""
        if self.figures is not None:
            return self._figure("run", key)
        entry = next((e for e in entries(self.score or {}, "run") if e.key == key), None)
        return _number(None if entry is None else entry.value)


def _number(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan


#: Where a run's files go, and what is drawn and logged: no part of what was run.
NO_COORDINATES = frozenset(
    {"out", "picture", "sim.prediction_every", "sim.scene_every", "sim.estimate_every"}
)
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
        if equals and key not in NO_COORDINATES and not key.startswith("hydra"):
            coordinates[key] = value.strip("'\"").strip("[]").replace(",", "+")
    return coordinates


def complete_coordinates(runs: Sequence[ComparisonRun]) -> list[ComparisonRun]:
    """Give every run a value for each coordinate, and the keys in which configurations differ."""
    runs = _with_settings(with_rigs(runs))
    names = dict.fromkeys(key for run in runs for key in run.coordinates)
    usual = {
        key: Counter(run.coordinates[key] for run in runs if key in run.coordinates)
        for key in names
    }
    implied = {key for key in usual if "@" in key and _is_implied(key, runs)}
    # a setting of one option's is none of another's; an option left out is the usual
    defaults = {
        key: _NONE if "." in key else values.most_common(1)[0][0]
        for key, values in usual.items()
        if key not in implied
    }
    whole = []
    for run in runs:
        filled = dict(run.coordinates)
        for key in implied:
            filled.pop(key, None)
        if len(filled) < len(defaults):
            filled |= {key: value for key, value in defaults.items() if key not in filled}
        whole.append(run.with_coordinates(filled))
    return whole


def with_rigs(runs: Sequence[ComparisonRun]) -> list[ComparisonRun]:
    """The runs with the equations of each rig named, where a run among them chose its rig's.

    The rig of a run that chose none has those of its model: what is chosen to be what it was
    (``trms run --from LOG model=…``) is no difference.
    """
    if all(run.coordinates.get(_RIG, _NOTHING) == _NOTHING for run in runs):
        return list(runs)
    return [
        run.with_coordinates({**run.coordinates, _RIG: _equations(run.coordinates)})
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
    pairs = {
        (run.coordinates.get(group, ""), run.coordinates[key])
        for run in runs
        if key in run.coordinates
    }
    return len({option for option, _ in pairs}) == len(pairs)


def differing_coordinates(runs: Sequence[ComparisonRun]) -> list[str]:
    """Coordinates with more than one value, in the order in which runs have them."""
    keys = dict.fromkeys(key for run in runs for key in run.coordinates)
    return [key for key in keys if len({run.coordinates.get(key) for run in runs}) > 1]


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Keys in which two configurations differ, with both values."""
    left, right = flat(one), flat(other)
    rows = []
    for key in dict.fromkeys([*left, *right]):
        if key.startswith(_COPIES) or key in NO_COORDINATES or left.get(key) == right.get(key):
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
    settings = differing_settings(
        [run.coordinates for run in runs], [run.flat_settings() for run in runs]
    )
    return [
        run.with_coordinates({**run.coordinates, **added}) if added else run
        for run, added in zip(runs, settings, strict=True)
    ]


def differing_settings(
    choices: Sequence[Mapping[str, Any]], configurations: Sequence[FlatConfiguration]
) -> list[dict[str, str]]:
    """Of each run the dotted keys in which it differs from runs of the same options.

    ``choices``: the option of each group. A run of which only a part of the configuration is known,
    a job without a log, is not said to have none of the other keys.
    """
    heads: dict[int, dict[str, None]] = {}
    # runs of the same configuration but for values, and of the same options: most of a sweep
    alike: dict[tuple[Any, ...], list[int]] = {}
    for i, (options, own) in enumerate(zip(choices, configurations, strict=True)):
        base = id(own.base)
        if base not in heads:
            heads[base] = _heads(own.base)
        names = heads[base] | _heads(own.changes) if own.changes else heads[base]
        signature = (base, *own.changes, None, *[str(options.get(name, "")) for name in names])
        alike.setdefault(signature, []).append(i)
    groups: dict[tuple[str, str], list[list[int]]] = {}
    for several in alike.values():
        options, own = choices[several[0]], configurations[several[0]]
        for group in heads[id(own.base)] | _heads(own.changes):
            groups.setdefault((group, str(options.get(group, ""))), []).append(several)
    settings: list[dict[str, str]] = [{} for _ in choices]
    for (group, _), families in groups.items():
        keys = _keys_that_may_differ(f"{group}.", [configurations[each[0]] for each in families])
        members = sorted(chain.from_iterable(families)) if keys else ()
        for key in keys:
            if key in NO_COORDINATES or key.startswith(_COPIES):
                continue
            values = [configurations[i].get(key) for i in members]
            told = [
                (i, _NONE if value is None else value)
                for i, value in zip(members, values, strict=True)
                if value is not None or not configurations[i].is_partial
            ]
            if len({value for _, value in told}) > 1:
                for i, value in told:
                    settings[i][key] = value
    return settings


def _heads(keys: Iterable[str]) -> dict[str, None]:
    """What stands before the first dot, in order; a key without one is no setting of a group."""
    return dict.fromkeys(key.partition(".")[0] for key in keys if "." in key)


def _keys_that_may_differ(stem: str, configurations: Sequence[FlatConfiguration]) -> list[str]:
    """Keys with that beginning, in the order of the configurations, but for what all share."""
    bases = {id(own.base): own.base for own in configurations}
    keys = dict.fromkeys(key for base in bases.values() for key in base if key.startswith(stem))
    changed = dict.fromkeys(
        key for own in configurations for key in own.changes if key.startswith(stem)
    )
    return [
        key
        for key in keys | changed
        if key in changed or len({base.get(key) for base in bases.values()}) > 1
    ]


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
#: Of the runs whose words :func:`of_log_head` knows.
RUN_SCHEMA = "trms.run/1"
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


def gather(
    paths: Sequence[Path],
    of_folder: Callable[[Path], tuple[list[ComparisonRun], list[tuple[str, str]]]] | None = None,
) -> RunCollection:
    """Read every run in files and folders, however deep.

    ``of_folder``: what reads a folder, and tells what is left out of it; by default each file of it
    is opened. Raises RecordingError if a path does not exist, a file is no log and no score, or
    there is no run at all.
    """
    runs: list[ComparisonRun] = []
    left_out: list[tuple[str, str]] = []
    places: set[str] = set()
    for path in paths:
        if not path.exists():
            raise absent(path, "file or folder")
        with not_as_written(str(path)):
            if path.is_file():
                path_runs = [_of_file(path)]
            else:
                path_runs, passed_over = (of_folder or runs_in_folder)(path)
                left_out += passed_over
        for run in path_runs:
            place = os.path.realpath(run.path) if len(paths) > 1 else run.path
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


def runs_in_folder(root: Path) -> tuple[list[ComparisonRun], list[tuple[str, str]]]:
    """The runs in a folder, however deep, and the files that are left out with the reason."""
    runs, left_out = [], []
    for folder, folders, files in os.walk(root):
        folders.sort()
        try:
            with not_as_written(folder):
                run = of_run_folder(Path(folder), set(files))
        except RecordingError as error:
            left_out.append((error.where or folder, error.problem))
            continue
        if run is not None:
            runs.append(run)
        for name in sorted(files):  # logs by other names, as a user files them
            if name.endswith(".mcap") and name != LOG:
                try:
                    with not_as_written(str(Path(folder, name))):
                        runs.append(of_log(Path(folder, name)))
                except RecordingError as error:
                    left_out.append((str(Path(folder, name)), error.problem))
    return runs, left_out


def of_run_folder(folder: Path, files: set[str]) -> ComparisonRun | None:
    """The run that a folder with these files holds; None where it holds none.

    Raises RecordingError if it cannot be read.
    """
    status = _document(folder / STATUS) if STATUS in files else {}
    if LOG in files:
        try:
            return _with_status(of_log(folder / LOG), status)
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
        return of_log(path)
    document = _document(path)
    if document.get("schema") != SCORE_SCHEMA:
        raise RecordingError(
            "this is no score of a run", where=str(path), remedy="give logs, or folders of runs"
        )
    beside = path.with_name(LOG)
    if RUN_KEY not in document and beside.is_file():
        return of_log(beside)
    return _of_score(document, path)


def of_log(path: Path) -> ComparisonRun:
    """The run of a log, its configuration among what is read.

    Raises RecordingError if it cannot be read, or is no run of the loop.
    """
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


def of_log_head(head: LogHead) -> ComparisonRun | None:
    """A run by its log's words, without its score and configuration; None where they do not do.

    They do for a run that ended, was scored and names its options. The samples' checksums are not
    looked at. A status beside the log counts as in :func:`gather`.
    """
    run = head.run
    options = json_or_none(run.get(CHOICES_KEY))
    if not head.finished or run.get("schema") != RUN_SCHEMA or not isinstance(options, Mapping):
        return None
    outcome = run.get("outcome", "died")
    state = _ENDINGS.get(outcome, State.DONE)
    if not options or outcome == "died" or (state is State.DONE and not head.score):
        return None
    path = head.path
    failures = part(head.score, "solver").get("failures")
    non_finite = 0
    if failures != 0:  # a command that is not finite is one of the fall-backs
        from trms_cli.recordings.log_reader import read_log

        non_finite = _faults(read_log(path, ("/event",)))
    made = ComparisonRun(
        path=str(path.parent if path.name == LOG else path),
        coordinates=_as_text(named_files(options, head.config))
        | {"seed": str(run.get("seed", ""))},
        state=state,
        message="" if state is State.DONE else outcome,
        non_finite=non_finite,
    )
    beside = path.with_name(STATUS)
    return _with_status(made, _document(beside) if beside.is_file() else {})


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
