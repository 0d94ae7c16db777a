"""A command called from Python: composed, done without a word, and the process left as it was."""

from __future__ import annotations

import io
import shlex
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import fields, is_dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from trms_cli.core.errors import EXIT_INTERRUPTED, EXIT_TERMINATED, ConfigurationError
from trms_cli.library.arguments import Arguments

if TYPE_CHECKING:
    from trms_cli.commands.execution import Outcome
    from trms_cli.composition.composer import Composition

#: One call at a time: a composition and the standard streams are the process's own.
_TURN = threading.RLock()
#: Letters of an object's label in tables and titles.
_LONGEST_LABEL = 48
#: Where an object goes besides the place that it is given to.
_ALSO = {"effect": "plant.effects", "fault": "plant.faults"}


class TrmsNote(UserWarning):
    """What a command remarks: a package that differs, a picture that could not be drawn."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, or a notebook's stop button: what was done until then is kept.

    Parameters
    ----------
    folder : Path
        Holds it; ``trms_cli.load(folder)`` reads it.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(f"what was done until then is in {folder}")
        self.folder = folder


class Heard:
    """What a command printed."""

    def __init__(self) -> None:
        self.out: list[str] = []
        self.err: list[str] = []

    @property
    def text(self) -> str:
        """What stands on standard output."""
        return "".join(self.out)

    def warn(self) -> None:
        """Notes on standard error, as warnings of whoever called."""
        for line in "".join(self.err).splitlines():
            note = line.strip()
            if note:
                warnings.warn(note, TrmsNote, stacklevel=4)


class _Ear(io.TextIOBase):
    """A standard stream that hears what one thread writes; all else goes where it always went."""

    def __init__(self, beneath: TextIO, heard: list[str], show: bool) -> None:
        self._beneath, self._heard, self._show = beneath, heard, show
        self._thread = threading.get_ident()

    def write(self, text: str) -> int:
        own = threading.get_ident() == self._thread
        if own:
            self._heard.append(text)
        if self._show or not own:
            self._beneath.write(text)
        return len(text)

    def flush(self) -> None:
        self._beneath.flush()

    def isatty(self) -> bool:
        return self._show and self._beneath.isatty()

    def writable(self) -> bool:
        return True

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return getattr(self._beneath, "encoding", None) or "utf-8"


@contextmanager
def called(words: str, objects: Sequence[Any] = (), *, verbose: bool = False) -> Iterator[Heard]:
    """Inside, a command may do as on the command line; afterwards the process is as it was.

    Parameters
    ----------
    words : str
        What the records of what is written say of the call.
    objects : sequence
        Those that the call was given.
    verbose : bool
        Whether what is printed is shown.
    """
    from trms_cli.composition.given_object import given
    from trms_cli.core.invocation import called_as

    heard = Heard()
    with _TURN:
        streams, path = (sys.stdout, sys.stderr), list(sys.path)
        sys.stdout = _Ear(streams[0], heard.out, verbose)
        sys.stderr = _Ear(streams[1], heard.err, verbose)
        try:
            with called_as(words), given(objects):
                yield heard
        finally:
            sys.stdout, sys.stderr = streams
            sys.path[:] = path


def perform(
    command: str,
    asked: Arguments,
    task: Callable[[Composition], Outcome],
    *,
    verbose: bool,
) -> tuple[Path, str]:
    """Compose what is asked for and do it.

    Parameters
    ----------
    command : str
        Its name, which is also that of its configuration.

    Returns
    -------
    folder : Path
    text : str
        What the command prints.

    Raises
    ------
    Interrupted
        If it was stopped, and has left something.
    """
    from trms_cli.composition.composer import compose

    objects = list(asked.objects.values())
    with called(words_of(command, asked), objects, verbose=verbose) as heard:
        outcome = task(with_objects(compose(asked.argv, command), asked.objects))
    return finished(outcome, heard, verbose=verbose)


def finished(outcome: Outcome, heard: Heard, *, verbose: bool) -> tuple[Path, str]:
    """The folder of an outcome, and what was printed."""
    assert outcome.folder is not None
    if outcome.exit_code in (EXIT_INTERRUPTED, EXIT_TERMINATED):
        raise Interrupted(outcome.folder)
    if not verbose:
        heard.warn()
    return outcome.folder, heard.text


def with_objects(composition: Composition, objects: Mapping[str, Any]) -> Composition:
    """The composition with objects at their places, in its choices by what they are.

    Raises
    ------
    ConfigurationError
        If there is no such place.
    """
    from trms_cli.composition.given_object import node_of

    if not objects:
        return composition
    config, choices = deepcopy(composition.config), dict(composition.choices)
    for number, (place, plugin) in enumerate(objects.items()):
        node = node_of(number, plugin)
        for spot in _places(place, composition):
            _put(config, spot, node)
        group, *inside = place.split(".")
        if not inside:
            choices[group] = label_of(plugin)
        elif isinstance(choices.get(group), list):
            choices[group] = [*choices[group], ".".join(inside)]
    return replace(composition, config=config, choices=choices)


def _places(place: str, composition: Composition) -> Iterator[str]:
    """A place, and those that follow it: the rig's model is that of the controller."""
    yield place
    config, (group, _, rest) = composition.config, place.partition(".")
    plant = config.get("plant")
    if not isinstance(plant, Mapping):
        return
    if place == "model" and not composition.choices.get("model@plant.model"):
        yield "plant.model"
    if group in _ALSO and rest and _ALSO[group].partition(".")[2] in plant:
        yield f"{_ALSO[group]}.{rest}"


def _put(config: dict[str, Any], place: str, node: Any) -> None:
    *path, last = place.split(".")
    inner: Any = config
    for name in path:
        inner = inner.get(name) if isinstance(inner, dict) else None
    if not isinstance(inner, dict):
        raise ConfigurationError(
            "an object is given, and there is no such place",
            where=place,
            remedy=f"top-level places: {', '.join(config)}",
        )
    inner[last] = node


def words_of(command: str, asked: Arguments) -> str:
    """A call in words: as it would be typed, or in Python where it has objects."""
    from trms_cli.composition.given_object import words_of as said

    if not asked.objects:
        return shlex.join(["trms", command, *asked.argv])
    words = [*map(repr, asked.words), *(f"{p}={said(o)}" for p, o in asked.objects.items())]
    return f"Python: {command}({', '.join(words)})"


def label_of(plugin: Any) -> str:
    """What tells an object from others of its class: its fields that are not as by default."""
    from trms_cli.composition.given_object import words_of as said

    name = type(plugin).__name__
    if not is_dataclass(plugin):
        whole = said(plugin)
        return whole if len(whole) <= _LONGEST_LABEL and not whole.startswith("<") else name
    changed = [
        f"{f.name}={value!r}"
        for f in fields(plugin)
        if f.repr and not _same(value := getattr(plugin, f.name), f.default)
    ]
    label = f"{name}({', '.join(changed)})" if changed else name
    if len(label) <= _LONGEST_LABEL and "\n" not in label:
        return label
    return f"{name} #{sha256(said(plugin).encode()).hexdigest()[:6]}"


def _same(one: Any, other: Any) -> bool:
    try:
        return bool(one == other)
    except (TypeError, ValueError):  # arrays
        return False
