"""The Python reference: what authors of plugins implement, and what notebooks call.

A page a subject, made by autodoc from the docstrings. The functions of the library are those that
``trms_cli`` exports.
"""

from __future__ import annotations

import importlib
import inspect
from dataclasses import dataclass
from types import ModuleType

from .pages import plain, table, toctree


@dataclass(frozen=True)
class Subject:
    """A page: its title, what it is for, and the modules whose public classes it documents."""

    title: str
    about: str
    modules: tuple[str, ...]


SUBJECTS: dict[str, Subject] = {
    "model": Subject(
        "Model",
        "What a controller and an observer believe: signals, parameters, equations.",
        ("trms_cli.models.model", "trms_cli.models.parameters"),
    ),
    "effect": Subject(
        "Effect",
        "What a rig has and a model leaves out: a function from a model to a richer model.",
        ("trms_cli.effects.effect",),
    ),
    "controller": Subject(
        "Controller",
        "From references and an estimate to a command.",
        ("trms_cli.controllers.controller",),
    ),
    "observer": Subject(
        "Observer",
        "From measurements and commands to an estimate of the state.",
        ("trms_cli.observers.observer",),
    ),
    "reference": Subject(
        "Reference",
        "What the outputs are to follow: a signal per axis.",
        ("trms_cli.references.signal", "trms_cli.references.trajectory"),
    ),
    "plant": Subject(
        "Plant",
        "What takes commands and gives measurements: a simulated rig, a recording, hardware.",
        ("trms_cli.plants.plant",),
    ),
    "method": Subject(
        "Fit method",
        "What fits parameters or a network to recordings.",
        ("trms_cli.identification.problem",),
    ),
    "study": Subject(
        "Study",
        "A question to a model or a loop.",
        ("trms_cli.stability.study", "trms_cli.core.findings", "trms_cli.stability.subject"),
    ),
    "errors": Subject(
        "Errors",
        "What went wrong, where, and what to do.",
        ("trms_cli.core.errors",),
    ),
}


#: The functions of the library in the order of the table in docs/library.md.
FUNCTIONS = (
    "run", "sweep", "compare", "runs", "score", "identify", "validate", "diagnose", "stability",
    "excite", "report", "plot", "read_log", "load", "options", "build",
)  # fmt: skip
#: Members of results that serve the program itself.
INTERNAL = ("DOCUMENT", "FILES", "PAGE", "headline", "file_for")


def library_names() -> list[str]:
    """What ``trms_cli`` itself exports: functions as in docs/library.md, results, errors last."""
    import trms_cli

    names = [name for name in getattr(trms_cli, "__all__", []) if not name.startswith("_")]
    return sorted(names, key=lambda name: (_kind_of(getattr(trms_cli, name)), _rank(name)))


def _kind_of(thing: object) -> int:
    """Functions, then results, then errors and warnings."""
    if not inspect.isclass(thing):
        return 0
    return 2 if issubclass(thing, BaseException) else 1


def _rank(name: str) -> int:
    return FUNCTIONS.index(name) if name in FUNCTIONS else len(FUNCTIONS)


def pages() -> dict[str, str]:
    """A page a subject, in reStructuredText, which autodoc needs."""
    found = {f"{name}.rst": _subject(subject) for name, subject in SUBJECTS.items()}
    if library_names():
        found["library.rst"] = _library()
    return found


def listing() -> str:
    """The table of subjects, and the navigation to them."""
    rows = [
        [f"[{subject.title}](python/{name}.rst)", plain(subject.about)]
        for name, subject in SUBJECTS.items()
    ]
    names = [f"python/{name}" for name in SUBJECTS]
    if library_names():
        rows.insert(0, ["[Library](python/library.rst)", "What `from trms_cli import …` gives."])
        names.insert(0, "python/library")
    return f"\n{table(['subject', 'what it is'], rows)}{toctree(names, depth=1)}"


def _subject(subject: Subject) -> str:
    parts = [_title(subject.title, "="), subject.about]
    for name in subject.modules:
        module = importlib.import_module(name)
        parts += [_title(name, "-"), f".. automodule:: {name}\n   :no-index:"]
        parts += [_class(name, member) for member in _public_classes(module)]
    return "\n\n".join(parts) + "\n"


def _library() -> str:
    import trms_cli

    parts = [_title("Library", "="), "What ``from trms_cli import …`` gives, with plain arguments."]
    for name in library_names():
        thing = getattr(trms_cli, name)
        if inspect.isclass(thing):
            hidden = f"\n   :exclude-members: {', '.join(INTERNAL)}"
            parts.append(_class("trms_cli", name) + hidden)
        elif callable(thing):
            parts.append(f".. autofunction:: trms_cli.{name}")
    return "\n\n".join(parts) + "\n"


def _class(module: str, name: str) -> str:
    return f".. autoclass:: {module}.{name}\n   :members:\n   :show-inheritance:"


def _public_classes(module: ModuleType) -> list[str]:
    """Classes that a module defines and does not hide, in its order."""
    own = [
        (inspect.getsourcelines(thing)[1], name)
        for name, thing in vars(module).items()
        if inspect.isclass(thing) and thing.__module__ == module.__name__ and name[0] != "_"
    ]
    return [name for _, name in sorted(own)]


def _title(text: str, line: str) -> str:
    return f"{text}\n{line * len(text)}"


#: Stands for the first colon of a property's sentence, whose beginning napoleon takes for a type.
_COLON = "\ue000"


def hide_colon(app: object, what: str, name: str, thing: object, opts: object, lines: list[str]):
    """Before napoleon."""
    if what in ("property", "attribute", "data") and lines:
        lines[0] = lines[0].replace(":", _COLON)


def show_colon(app: object, what: str, name: str, thing: object, opts: object, lines: list[str]):
    """After napoleon."""
    lines[:] = [line.replace(_COLON, ":") for line in lines]
