"""``trms run --from LOG``: a run again, from what its log says of it."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.composition.catalogue import read_groups, read_primary
from trms_cli.composition.checks import DeclaredKeys
from trms_cli.composition.composer import Composition, compose
from trms_cli.composition.given_object import refuse_objects
from trms_cli.composition.on_top import OnTop, differing_words, on_top
from trms_cli.composition.overrides import parse
from trms_cli.composition.plain_values import value_at
from trms_cli.core.data_file import not_as_written
from trms_cli.core.errors import ConfigurationError, RecordingError, TrmsError
from trms_cli.core.invocation import note, program
from trms_cli.core.plugins import TARGET, locate
from trms_cli.core.wording import listing

if TYPE_CHECKING:
    from trms_cli.recordings.log_reader import LoggedRun

#: What a run is given for itself: a repetition writes elsewhere, and each time a person arms a real
#: rig.
_OWN_KEYS = ("out", "plant.arm")
#: Overrides that are told to be left out; of more their number.
_MOST_DROPPED = 4
_NEWER = "note   newer than that run, and at their default: {}"


def repetition(log: Path, argv: Sequence[str], primary: str) -> list[str] | Composition:
    """The experiment of a log, with the overrides of `argv` on top.

    What was typed then and what is typed now are composed together, so that an override means
    what it always means, but that the rig stays the one of the log under another model and that
    values of options that are replaced go with them (:mod:`trms_cli.composition.on_top`): these
    words are given back. That needs option files that say what they said: where they have changed
    since, the log's own configuration still runs, and is given back, but nothing can be laid on
    top.
    """
    then = _then(log, primary)
    run, own = then.run, [word for word in argv if _is_own(word)]
    _tell_what_differs(run)
    has_more = len(own) != len(argv)
    if then.composition is not None and (has_more or not then.new_keys):
        if then.new_keys:
            note(_NEWER.format(", ".join(then.new_keys)))
        layers = on_top(then.composition, then.typed, argv, primary, played=_is_open(run))
        _tell_what_goes(run, then.composition, layers, argv)
        return [*then.places, *layers.words, *argv]
    if has_more:
        raise ConfigurationError(
            f"option files have changed since that run, so {' '.join(argv)} cannot be laid on it: "
            f"{then.changed}",
            where=str(log),
            remedy=f"repeat it as it was: {program()} run --from {shlex.quote(str(log))}\n"
            f"or run anew: {program()} run {shlex.join([*then.typed, *argv])}",
        )
    note(f"note   option files have changed since; the log's own count ({then.changed})")
    return _as_logged(run, _completed(then.logged, primary), own, then.folders)


@dataclass(frozen=True)
class LoggedLoop:
    """The log of a closed loop that something can be laid on: its rig can be driven again."""

    path: Path
    choices: Mapping[str, Any]  #: The option in each group
    inputs: tuple[str, ...]  #: Of the rig, by name
    typed: tuple[str, ...]  #: Overrides, but for its folder
    seed: int


def loop_of(path: Path, primary: str = "run") -> LoggedLoop | None:
    """The closed loop that a recording is the log of; None for any other recording.

    None too for what has no rig to be driven (a recording that was replayed), and for a log that
    nothing can be laid on.
    """
    from trms_cli.library.tasks.replay import is_replay

    try:
        then = _then(path, primary, topics=("/command",))
        if then.composition is None or is_replay(then.composition.config):
            return None
        inputs = tuple(then.run.table("/command").columns)
    except TrmsError:
        return None
    seed = then.composition.config["seed"]
    return LoggedLoop(path, then.composition.choices, inputs, then.typed, seed)


@dataclass(frozen=True)
class _Then:
    """The run of a log, and what it is composed to today."""

    run: LoggedRun
    logged: dict[str, Any]  #: Its configuration
    typed: tuple[str, ...]  #: Overrides, but for its folder
    folders: tuple[Path, ...]  #: The user's folders of options
    composition: Composition | None  #: None where that is another run today
    new_keys: tuple[str, ...]  #: That the log did not have yet; they have their default
    changed: str  #: The first keys, where it is another run, or has new ones

    @property
    def places(self) -> list[str]:
        return [f"--config-dir={folder}" for folder in self.folders]


def _then(log: Path, primary: str, topics: Sequence[str] = ()) -> _Then:
    run = _read(log, topics)
    logged = _config(run)
    refuse_objects(logged, "", str(log))
    folders = tuple(Path(folder) for folder in _words(run, "config_dirs"))
    moved = _with_moved_keys(logged)
    typed = tuple(word for word in _words(run, "overrides") if not _is_own(word))
    if moved != logged:
        typed += tuple(differing_words("plant.landing", {}, value_at(moved, "plant.landing")))
    places = [f"--config-dir={folder}" for folder in folders]
    try:
        now = compose([*places, *typed], primary)
    except TrmsError as error:
        changed = f"{error.where}: {error.problem}"
        return _Then(run, logged, typed, folders, None, (), changed)
    keys = list(_differences(moved, now.config, ""))
    changed = ", ".join(keys[:3]) + (f" and {len(keys) - 3} more" if len(keys) > 3 else "")
    new = _new_keys(moved, now.config, keys, typed, primary)
    same = len(new) == len(keys)
    return _Then(run, logged, typed, folders, now if same else None, new, changed)


def _new_keys(
    then: Mapping[str, Any],
    now: Mapping[str, Any],
    keys: Sequence[str],
    typed: Sequence[str],
    primary: str,
) -> tuple[str, ...]:
    """Those of some keys that a log does not have, and the program's own options have by default.

    What a user's option file or an experiment says is none of these.
    """
    if not keys:
        return ()
    groups = read_groups()
    choices = [word for word in typed if parse(word, groups).key in groups]
    declared = DeclaredKeys(read_primary(primary), groups, choices)

    def is_new(key: str) -> bool:
        stem, _, name = key.rpartition(".")
        before, today = value_at(then, stem), value_at(now, key)
        lacks = isinstance(before, Mapping) and name not in before
        return lacks and declared.value(stem) != {} and declared.value(key) == today

    return tuple(key for key in keys if is_new(key))


def _is_open(run: LoggedRun) -> bool:
    """Whether commands were played, and no reference followed."""
    return run.run.get("loop") == "open"


def _tell_what_goes(
    run: LoggedRun, earlier: Composition, layers: OnTop, argv: Sequence[str]
) -> None:
    """Say what was typed for an option that is replaced, and what is followed where nothing was."""
    if layers.dropped:
        words = listing(layers.dropped, most=_MOST_DROPPED)
        note(f"note   left out, as typed for an option that is replaced: {words}")
    target = value_at(layers.config, f"controller.{TARGET}")
    if not _is_open(run) or target is None:
        return
    controller = locate(str(target), "controller")
    heads = [word.lstrip("+").partition("=")[0] for word in argv]
    if getattr(controller, "follows_reference", True) and not any(h == "ref" for h in heads):
        duration = value_at(earlier.config, "sim.duration")
        last = f" for its {duration:g} s" if "sim.duration" not in heads else ""
        name = layers.choices.get("ref")
        note(f"note   the log followed no reference; now ref {name}{last} (ref=… for another)")


def _read(path: Path, topics: Sequence[str] = ()) -> LoggedRun:
    from trms_cli.recordings.log_reader import read_log
    from trms_cli.recordings.run_log import RUN_SCHEMA

    run = read_log(path, topics=topics)
    schema = run.run.get("schema", "")
    if schema != RUN_SCHEMA:
        raise RecordingError(
            f"the log is of the schema {schema or 'unnamed'}, this program repeats {RUN_SCHEMA}",
            where=str(path),
            remedy=f"repeat it with the version that wrote it: {_writer(run)}",
        )
    if not run.config:
        raise RecordingError(
            "the log holds no configuration, so there is nothing to repeat",
            where=str(path),
            remedy="logs of `trms run` hold one; an imported recording is played back by "
            "plant=replay plant.file=FILE",
        )
    return run


def _words(run: LoggedRun, key: str) -> tuple[str, ...]:
    """What was typed then: overrides or folders. An option that a log holds is not followed."""
    with not_as_written(str(run.path), "what was typed for it"):
        words = json.loads(run.run.get(key, "[]"))
        if not isinstance(words, list) or any(str(word).startswith("-") for word in words):
            raise ValueError(f"{key}: {words!r}")
        return tuple(map(str, words))


def _config(run: LoggedRun) -> dict[str, Any]:
    import yaml

    from trms_cli.core.yaml_data import load_yaml

    try:
        config = load_yaml(run.config)
    except yaml.YAMLError as error:
        raise RecordingError(
            f"the log's configuration is not valid YAML: {error}", where=str(run.path)
        ) from None
    if not isinstance(config, dict):
        raise RecordingError("the log's configuration is no mapping", where=str(run.path))
    return {str(key): value for key, value in config.items()}


def _differences(then: Any, now: Any, where: str) -> list[str]:
    if isinstance(then, Mapping) and isinstance(now, Mapping):
        places = []
        for key in {**then, **now}:
            place = f"{where}.{key}" if where else str(key)
            if place in _OWN_KEYS:
                continue
            missing = object()
            places += _differences(then.get(key, missing), now.get(key, missing), place)
        return places
    return [] if then == now and type(then) is type(now) else [where]


def _completed(logged: Mapping[str, Any], primary: str) -> dict[str, Any]:
    """A log's configuration with the parts that this program has and the log's did not yet have.

    They get the default of today, which is told: a key that is new leaves runs as they were,
    or its note in the changelog says otherwise.
    """
    completed, new = _with_moved_keys(logged), []
    for key, default in compose((), primary).config.items():
        if key not in completed:
            completed[key] = default
            new.append(key)
        elif isinstance(default, Mapping) and TARGET not in default:
            present = completed[key]
            if isinstance(present, Mapping):
                missing = {name: value for name, value in default.items() if name not in present}
                completed[key] = {**present, **missing}
                new += [f"{key}.{name}" for name in missing]
    if new:
        note(_NEWER.format(", ".join(new)))
    return completed


def _with_moved_keys(logged: Mapping[str, Any]) -> dict[str, Any]:
    """A log's configuration with the keys that stood elsewhere when it was written."""
    moved = dict(logged)
    supervisor, plant = logged.get("supervisor"), logged.get("plant")
    if isinstance(supervisor, Mapping) and isinstance(plant, Mapping):
        # until 2026-11 the supervisor had the landing, which is the rig's
        names = {"landing_command": "command", "landing_rate": "rate"}
        landing = {new: supervisor[old] for old, new in names.items() if old in supervisor}
        if landing and "landing" not in plant:
            moved["plant"] = {**plant, "landing": {**landing, "after_run": False}}
            moved["supervisor"] = {k: v for k, v in supervisor.items() if k not in names}
    return moved


def _as_logged(
    run: LoggedRun, logged: Mapping[str, Any], own: Sequence[str], folders: Sequence[Path]
) -> Composition:
    from trms_cli.composition.catalogue import make_importable

    make_importable(folders)
    config: dict[str, Any] = {**logged, "out": None}
    if "arm" in (config.get("plant") or {}):
        config["plant"] = {**config["plant"], "arm": "plant.arm=true" in own}
    config |= {key: value for key, _, value in (w.partition("=") for w in own) if key == "out"}
    overrides = _words(run, "overrides")
    choices = {
        key: value
        for key, equals, value in (word.partition("=") for word in overrides)
        if key in config
    }
    groups: dict[str, Any] = {
        key: choices.get(key, "logged") for key, v in config.items() if isinstance(v, dict)
    }
    groups["effect"] = list(config.get("effect") or {})
    return Composition(config, overrides, groups, tuple(folders))


def _mapping(run: LoggedRun, key: str) -> dict[str, Any]:
    return dict(json.loads(run.run.get(key, "{}")))


def _is_own(word: str) -> bool:
    return word.lstrip("+").partition("=")[0] in _OWN_KEYS


def _tell_what_differs(run: LoggedRun) -> None:
    """Say which packages are not those of the log: figures may differ in their last digits."""
    from trms_cli.core.versions import changed_since
    from trms_cli.library.tasks.experiment import VERSIONS_KEY

    with not_as_written(str(run.path)):
        then = {str(name): str(text) for name, text in _mapping(run, VERSIONS_KEY).items()}
    changed = changed_since(then)
    if changed:
        note(f"note   not as it was then: {', '.join(changed)}")


def _writer(run: LoggedRun) -> str:
    with not_as_written(str(run.path)):
        version = _mapping(run, "versions").get("trms", "")
    return f"trms {version}".strip()
