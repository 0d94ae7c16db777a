"""What is promised goes away slowly: it says what takes its place, for a minor version or more.

A name of a module is deprecated by a ``__getattr__`` of that module::

    def __getattr__(name: str) -> Any:
        return deprecated_name(__name__, name, {"Axis": ("RigAxis", RigAxis)})

The rule stands in ``docs/versions.md``.
"""

import warnings
from collections.abc import Mapping
from typing import Any, TextIO


class TrmsDeprecationWarning(DeprecationWarning):
    """Something of this program that will go away with the next major version."""


def warn_of(what: str, instead: str) -> None:
    """Warn a caller of the caller: ``what`` is deprecated, ``instead`` takes its place."""
    message = f"{what} is deprecated and goes away with the next major version: use {instead}"
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
