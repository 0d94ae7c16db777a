"""What is promised goes away slowly: it says what takes its place, and is gone in a major version.

What is typed is renamed by an entry of :data:`RENAMED`. A name of a module is deprecated by a
``__getattr__`` of that module::

    def __getattr__(name: str) -> Any:
        return deprecated_name(__name__, name, {"Axis": ("RigAxis", RigAxis)})

The rule stands in ``docs/versions.md``.
"""

import re
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TextIO

from trms_cli import __version__
from trms_cli.core.errors import ConfigurationError

_MAJOR = int(__version__.split(".")[0])
_OVERRIDE = re.compile(r"([+~]*)([\w./]+)(@[\w.]+)?(?:=(.*))?", re.DOTALL)


class TrmsDeprecationWarning(DeprecationWarning):
    """Something of this program that will go away with the next major version."""


class Renamed(NamedTuple):
    """What takes the place of a former name, and until when that one works."""

    present: str
    #: The first major version that refuses the former name, and says the present one
    gone_with: int


#: Former names as they are typed: ``trms COMMAND``, ``trms COMMAND --OPTION``, ``SOME.KEY`` and
#: ``GROUP=OPTION``. An entry stays when its version has come: it then says what to type instead.
RENAMED: dict[str, Renamed] = {}


def warn_of(what: str, instead: str, gone_with: int = _MAJOR + 1) -> None:
    """Warn a caller of the caller: ``what`` is deprecated, ``instead`` takes its place."""
    message = f"{what} is deprecated and goes away with trms {gone_with}.0: use {instead}"
    warnings.warn(message, TrmsDeprecationWarning, stacklevel=4)


def deprecated_name(module: str, name: str, names: Mapping[str, tuple[str, Any]]) -> Any:
    """The value of a module's former name, with a warning.

    ``names``: the present name and the value by the former one. Raises AttributeError, as modules
    do, for a name that never was.
    """
    if name not in names:
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    present, value = names[name]
    warn_of(f"{module}.{name}", f"{module}.{present}")
    return value


def present_words(words: Sequence[str]) -> list[str]:
    """A command and its options (``OPTION=VALUE`` too) under the names that they have now."""
    command, *rest = words
    command = _present(f"trms {command}").removeprefix("trms ")
    present = []
    for word in rest:
        name, equals, value = word.partition("=")
        option = f"trms {command} --{name.removeprefix('--')}"
        if option in RENAMED and (equals or word.startswith("--")):
            name = f"--{_present(option).rpartition('--')[2]}"
        present.append(f"{name}{equals}{value}")
    return [command, *present]


def present_override(text: str) -> str:
    """An override under the names that its key and its options have now."""
    match = _OVERRIDE.fullmatch(text)
    if not RENAMED or match is None:
        return text
    prefix, key, place, value = match.groups()
    key = _present(key)
    if value is not None:
        named = re.compile(r"[\w.-]+")
        value = named.sub(lambda m: _present(f"{key}={m[0]}").rpartition("=")[2], value)
    return f"{prefix}{key}{place or ''}{'' if value is None else f'={value}'}"


def _present(name: str) -> str:
    """The name that one has now; a former one warns, or is refused from its version on."""
    if name not in RENAMED:
        return name
    present, gone_with = RENAMED[name]
    if gone_with <= _MAJOR:
        raise ConfigurationError(
            f"{name} went away with trms {gone_with}.0", where=name, remedy=f"use {present}"
        )
    warn_of(name, present, gone_with)
    return present


def show_on(stream: TextIO) -> None:
    """Show such warnings to whoever types commands: a line each, once; others as ever."""
    others = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
        if issubclass(category, TrmsDeprecationWarning):
            stream.write(f"note   {message}\n")
        else:
            others(message, category, *rest, **more)

    warnings.filterwarnings("once", category=TrmsDeprecationWarning)
    warnings.showwarning = show
