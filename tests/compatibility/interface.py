"""What version 1 promises, a name a line, read off the program: commands, options, keys, documents.

``interface.txt`` beside it holds the names that were promised; ``docs/versions.md`` has the rule
that nothing of them goes away but in a major version. A line is a kind and a name::

    command run
    option run --from
    key run sim.duration
    choice controller=lqr
    key controller=lqr weights
    field trms.score/1 channels.alpha_v.rmse
    topic /command
    field /command u_v
    python trms_cli.run
    python trms_cli.run(controller)

``python -m tests.compatibility.interface`` (``make interface``) adds what is new. What is gone
stops it, unless the major version is another than the one that the file is of.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import inspect
import io
import json
import os
import re
import sys
import tempfile
import typing
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from types import UnionType
from typing import Any
from unittest import mock

import trms_cli
from docs._extensions.laboratory import interface as reference
from trms_cli import cli
from trms_cli.composition.catalogue import first_comment, read_groups, read_primary, read_yaml
from trms_cli.core.deprecation import RENAMED
from trms_cli.core.plugins import TARGET
from trms_cli.core.resources import config_folder

FILE = Path(__file__).with_name("interface.txt")
_HEAD = "# of trms "
_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
#: Groups whose files hold data, or a choice of what other groups have.
_DATA = ("networks", "experiment", "blind")
#: Parts of a diagnosis that its document leaves out.
_NOT_WRITTEN = ("traces", "next_experiment.prediction")

#: What is recorded, fitted and judged for the documents of the commands; each is typed in a folder
#: of its own, and its standard output may be the document.
_TYPED = """
run out=a sim.duration=6 picture=false
run out=b sim.duration=6 picture=false controller=pid ref=sine
run -m out=swept sim.duration=1 seed=1,2 --json
score a/run.mcap --json
score a b --json
score a --write-baseline baseline.json --reason first
score a --baseline baseline.json --json
compare a b --json
compare a b swept --json
runs --in . --json
list --json
list controller --json
list controller pid --json
doctor --json
allow --json
export a --json
import a/run.csv --out recording.mcap --json
plot a --out a.svg --json
report a --json
sweep status swept --json
excite duration=10 rigs=0 picture=false out=excited
run out=recorded controller=open_loop observer=full_state plant.prior_seed=1 sim.duration=20 \
  signal@controller.u_v=multilevel controller.u_v.offset=0.9 signal@controller.u_h=multilevel \
  picture=false
identify real=recorded/run.mcap out=fit picture=false
validate real=recorded/run.mcap out=judged page=false
stability study=equilibria out=rest
export-controller controller=linear_mpc measure=false out=exported
"""


#: Where a person's own runs and permissions stand: none of them is promised.
_PERSONS = ("TRMS_RUNS", "XDG_CONFIG_HOME")


def static_names() -> set[str]:
    """All that can be told without a run."""
    return {*_commands(), *_configuration(), *_python(), *_static_documents()}


def measured_names() -> set[str]:
    """Fields of what commands write, and of the log of a run (half a minute)."""
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.chdir(folder),
        mock.patch.dict(os.environ, {n: str(Path(folder, ".own")) for n in _PERSONS}),
    ):
        return set(_documents())


def promised(file: Path = FILE) -> tuple[str, set[str]]:
    """The version that the names are of, and the names."""
    head, *lines = file.read_text(encoding="utf-8").splitlines()
    return head.removeprefix(_HEAD), {line for line in lines if line}


def gone(names: Collection[str], before: Collection[str]) -> list[str]:
    """What was promised, is not among the names, and does not work on with a warning."""
    return sorted(line for line in set(before) - set(names) if not _is_deprecated(line))


def renew(names: Collection[str], file: Path = FILE) -> list[str]:
    """Add what is new; returns what is gone, and writes nothing then.

    With another major version than that of the file all is written anew.
    """
    before: set[str] = set()
    if file.exists():
        version, lines = promised(file)
        if version.split(".")[0] == trms_cli.__version__.split(".")[0]:
            before = lines
    if lost := gone(names, before):
        return lost
    text = "\n".join([f"{_HEAD}{trms_cli.__version__}", *sorted({*names, *before})])
    file.write_text(text + "\n", encoding="utf-8")
    return []


def _is_deprecated(line: str) -> bool:
    """Whether it still works, with a warning."""
    kind, name = line.split(" ", 1)
    if kind in _TYPED_AS:
        return _TYPED_AS[kind](name) in RENAMED
    if kind != "python":
        return False
    module, _, attribute = name.rpartition(".")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return hasattr(importlib.import_module(module), attribute)
        except ImportError:
            return False


def _key_as_typed(name: str) -> str:
    """``sim.duration`` for ``run sim.duration``, ``controller.x`` for ``controller=pid x``."""
    place, path = name.split(" ", 1)
    group, equals, _ = place.partition("=")
    return f"{group}.{path}" if equals else path


#: How a promised name is typed, by its kind.
_TYPED_AS: dict[str, Callable[[str], str]] = {
    "command": lambda name: f"trms {name}",
    "option": lambda name: f"trms {name}",
    "choice": str,
    "key": _key_as_typed,
}


def _commands() -> Iterator[str]:
    for name in cli.COMMANDS:
        module = cli.load_command(name)
        yield f"command {name}"
        for option in _OPTION.findall(str(module.HELP)):
            yield f"option {name} {option}"
    for option in _OPTION.findall(cli.OPTIONS):
        yield f"option trms {option}"


def _configuration() -> Iterator[str]:
    for file in sorted(config_folder().glob("*.yaml")):
        declared = read_primary(file.stem)
        yield from (f"key {file.stem} {name}" for name in declared.defaults)
        yield from (f"key {file.stem} {path}" for path in _paths(declared.body))
    for group, options in read_groups().items():
        for name, option in options.items():
            assert first_comment(option.file)
            choice = f"{group}={name}"
            yield f"choice {choice}"
            content = read_yaml(option.file)
            if group in _DATA or not isinstance(content, dict):
                continue
            if group == "parameters":
                content = dict.fromkeys(content.get("parameters") or {})
            yield from (f"key {choice} {path}" for path in _paths(content))


def _paths(node: Any, path: str = "") -> Iterator[str]:
    """Dotted keys of a YAML, and the places where it takes an option of another group."""
    if not isinstance(node, Mapping) or not node:
        if path:
            yield path
        return
    for key, value in node.items():
        if key == "defaults":
            words = (w for entry in value if isinstance(entry, dict) for w in entry)
            yield from (word.removeprefix("/") for word in words if "@" in word)
        elif key != TARGET:
            yield from _paths(value, f"{path}.{key}" if path else str(key))


def _python() -> Iterator[str]:
    for name in reference.library_names():
        yield from _members("trms_cli", name)
    for subject in reference.SUBJECTS.values():
        for module in subject.modules:
            for name in reference._public_classes(importlib.import_module(module)):
                yield from _members(module, name)


def _members(module: str, name: str) -> Iterator[str]:
    thing = getattr(importlib.import_module(module), name)
    yield f"python {module}.{name}"
    if not inspect.isclass(thing):
        if callable(thing):
            yield from _parameters(f"{module}.{name}", thing)
        return
    own = {m for c in thing.__mro__ if c.__module__.startswith("trms_cli") for m in vars(c)}
    own |= set(getattr(thing, "__annotations__", ()))
    for member in sorted(own):
        if member[0] == "_" or member in reference.INTERNAL:
            continue
        yield f"python {module}.{name}.{member}"
        value = inspect.getattr_static(thing, member, None)
        value = getattr(value, "__func__", value)
        if inspect.isfunction(value):
            yield from _parameters(f"{module}.{name}.{member}", value)


def _parameters(place: str, function: Any) -> Iterator[str]:
    for parameter in inspect.signature(function).parameters.values():
        if parameter.name not in ("self", "cls") and parameter.name[0] != "_":
            yield f"python {place}({parameter.name})"


def _static_documents() -> Iterator[str]:
    """Documents that are a dataclass, and take minutes to come by."""
    from trms_cli.gap import diagnosis, diagnosis_result, investigation

    for schema, result in (
        (diagnosis.SCHEMA, diagnosis_result.DiagnosisResult),
        (investigation.SCHEMA, investigation.Investigation),
    ):
        paths = (path for path in _fields(result) if not path.startswith(_NOT_WRITTEN))
        yield from (f"field {schema} {path}" for path in paths)


def _fields(cls: type, path: str = "") -> Iterator[str]:
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        if field.name[0] != "_":
            here = f"{path}.{field.name}" if path else field.name
            yield here
            yield from _inner_fields(hints[field.name], here)


def _inner_fields(hint: Any, path: str) -> Iterator[str]:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint) and hint.__module__.startswith("trms_cli"):
        yield from _fields(typing.cast(type, hint), path)
    elif origin in (typing.Union, UnionType):
        for each in arguments:
            yield from _inner_fields(each, path)
    elif origin in (tuple, list) or (isinstance(origin, type) and issubclass(origin, Collection)):
        inner = "*" if isinstance(origin, type) and issubclass(origin, Mapping) else "[]"
        yield from _inner_fields(arguments[-2 if arguments[-1] is ... else -1], f"{path}.{inner}")


def _documents() -> Iterator[str]:
    from trms_cli.recordings.log_reader import read_log
    from trms_cli.recordings.topics import TIMING_TOPIC, landing_topic

    for line in _TYPED.strip().splitlines():
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(io.StringIO()):
            code = cli.main(line.split())
        assert code == 0, f"trms {line}: {code}"
        if "--json" in line:
            yield from _of_document(json.loads(printed.getvalue()))
    for file in sorted(Path().rglob("*.json")):
        content = json.loads(file.read_text(encoding="utf-8"))
        if isinstance(content, dict) and str(content.get("schema", "")).startswith("trms."):
            yield from _of_document(content)
    for name in ("a/run.mcap", "recording.mcap"):
        log = read_log(name)
        for topic, table in log.tables.items():
            yield f"topic {topic}"
            yield from (f"field {topic} {column}" for column in table.columns)
        yield from (f"field trms.run/1 {key}" for key in log.run)
        yield from (f"topic attachment {attachment}" for attachment in log.attachments)
    yield f"topic {landing_topic(()).name}"
    yield f"topic {TIMING_TOPIC.name}"
    yield from (f"field {TIMING_TOPIC.name} {name}" for name in TIMING_TOPIC.field_names)


def _of_document(document: Mapping[str, Any]) -> Iterator[str]:
    schema = document["schema"]
    yield from (f"field {schema} {path}" for path in sorted(set(_keys(document))))


def _keys(node: Any, path: str = "") -> Iterator[str]:
    """Dotted keys of a document; what an item of a list has stands behind ``[]``."""
    if isinstance(node, Mapping):
        for key, value in node.items():
            name = str(key)
            here = f"{path}.{name}" if path else name
            yield here
            if name != "versions":  # of the packages that were there
                yield from _keys(value, here)
    elif isinstance(node, list):
        for item in node:
            yield from _keys(item, f"{path}.[]")


def main() -> int:
    """Renew the file; 1 where something promised is gone."""
    lost = renew({*static_names(), *measured_names()})
    if lost:
        sys.stderr.write(
            "these were promised and are gone; nothing is written:\n"
            + "".join(f"  {line}\n" for line in lost)
            + "Let them work with a warning (trms_cli/core/deprecation.py, docs/versions.md); they "
            "may go in a major version.\n"
        )
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
