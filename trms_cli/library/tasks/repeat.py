"""``trms run --from LOG``: a run again, from what its log says of it."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.composition.composer import Composition, compose
from trms_cli.composition.given_object import refuse_objects
from trms_cli.composition.on_top import OnTop, on_top
from trms_cli.composition.plain_values import value_at
from trms_cli.core.data_file import not_as_written
from trms_cli.core.errors import ConfigurationError, RecordingError, TrmsError
from trms_cli.core.invocation import note, program
from trms_cli.core.plugins import TARGET, locate
from trms_cli.core.wording import listing

if TYPE_CHECKING:
    from trms_cli.recordings.log_reader import LoggedRun

#: What a run is given for itself: a repetition writes elsewhere.
_OWN_KEYS = ("out",)
#: Overrides that are told to be left out; of more their number.
_MOST_DROPPED = 4


def repetition(log: Path, argv: Sequence[str], primary: str) -> list[str] | Composition:
    """The experiment of a log, with the overrides of `argv` on top.

    What was typed then and what is typed now are composed together, so that an override means
    what it always means, but that the rig stays the one of the log under another model and that
    values of options that are replaced go with them (:mod:`trms_cli.composition.on_top`): these
    words are given back. That needs option files that say what they said: where they have changed
    since, the log's own configuration still runs, and is given back, but nothing can be laid on
    top.
    """
    run = _read(log)
    logged = _config(run)
    refuse_objects(logged, "", str(log))
    typed = [word for word in _words(run, "overrides") if not _is_own(word)]
    folders = [Path(folder) for folder in _words(run, "config_dirs")]
    places = [f"--config-dir={folder}" for folder in folders]
    _tell_what_differs(run)
    earlier, changed = _composed_again(logged, [*places, *typed], primary)
    if earlier is not None:
        layers = on_top(earlier, typed, argv, primary, played=_is_open(run))
        _tell_what_goes(run, earlier, layers, argv)
        return [*places, *layers.words, *argv]
    own = [word for word in argv if _is_own(word)]
    if len(own) != len(argv):
        raise ConfigurationError(
            f"option files have changed since that run, so {' '.join(argv)} cannot be laid on it: "
            f"{changed}",
            where=str(log),
            remedy=f"repeat it as it was: {program()} run --from {shlex.quote(str(log))}\n"
            f"or run anew: {program()} run {shlex.join([*typed, *argv])}",
        )
    note(f"note   option files have changed since; the log's own count ({changed})")
    return _as_logged(run, _completed(logged, primary), own, folders)


def is_repeatable(path: Path, primary: str = "run") -> bool:
    """Whether a recording is the log of a closed loop that something can be laid on.

    A replayed recording is none: there is no rig to be driven in it.
    """
    from trms_cli.library.tasks.replay import is_replay

    try:
        run = _read(path)
        logged = _config(run)
        refuse_objects(logged, "", str(path))
        folders = [f"--config-dir={folder}" for folder in _words(run, "config_dirs")]
        typed = [word for word in _words(run, "overrides") if not _is_own(word)]
        earlier, _ = _composed_again(logged, [*folders, *typed], primary)
        return earlier is not None and not is_replay(logged)
    except (TrmsError, KeyError):
        return False


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


def _read(path: Path) -> LoggedRun:
    from trms_cli.recordings.log_reader import read_log
    from trms_cli.recordings.run_log import RUN_SCHEMA

    run = read_log(path, topics=())
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


def _composed_again(
    logged: Mapping[str, Any], argv: Sequence[str], primary: str
) -> tuple[Composition | None, str]:
    """What was typed then, composed today; None, and the first keys, if it is not what it was."""
    try:
        now = compose(argv, primary)
    except TrmsError as error:
        return None, f"{error.where}: {error.problem}"
    keys = list(_differences(logged, now.config, ""))
    if not keys:
        return now, ""
    return None, ", ".join(keys[:3]) + (f" and {len(keys) - 3} more" if len(keys) > 3 else "")


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
        note(f"note   newer than that run, and at their default: {', '.join(new)}")
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
    config = {**logged, "out": None}
    config |= {word.partition("=")[0]: word.partition("=")[2] for word in own}
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
