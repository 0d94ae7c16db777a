"""What is said of a filter that cannot be used: what, at which character, and what to type."""

from __future__ import annotations

from trms_cli.core.errors import ConfigurationError

_SHOWN = 64  # characters of a filter on one line


class FilterError(ConfigurationError):
    """A filter of runs cannot be used.

    Parameters
    ----------
    problem : str
    filter : str
        The whole of it.
    position : int
        Character at which the trouble begins, from 0.
    remedy : str
    """

    def __init__(self, problem: str, filter: str, position: int, remedy: str = "") -> None:
        super().__init__(problem, where=_pointed(filter, position), remedy=remedy)
        #: Character at which the trouble begins, from 0.
        self.position = position


def _pointed(filter: str, position: int) -> str:
    """The part of the filter around a position, with a mark under it."""
    position = min(max(position, 0), len(filter))
    begin = max(0, min(position - _SHOWN // 2, len(filter) - _SHOWN))
    part = filter[begin : begin + _SHOWN]
    head, tail = "…" if begin else "", "…" if begin + _SHOWN < len(filter) else ""
    printable = "".join(c if c.isprintable() else " " for c in part)
    mark = " " * (position - begin + len(head)) + "^"
    return f"the filter, character {position + 1}\n  {head}{printable}{tail}\n  {mark}"
