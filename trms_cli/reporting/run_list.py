"""A list of runs that a page of a server lets its reader filter, sort, turn over and compare.

Everything is a link or a form that asks the server for another page: it works without a script,
with the keyboard, and on any number of runs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from trms_cli.core.findings import Cell


@dataclass(frozen=True)
class ColumnChoice:
    """A column of which one value can be chosen."""

    name: str  #: Of the field, and of the column
    label: str
    options: Sequence[tuple[str, int]]  #: Values, and how many runs have each
    chosen: str = ""  #: "" for any


@dataclass(frozen=True)
class ListHead:
    """The head of a column, which sorts by it."""

    text: str
    address: str  #: Of the list sorted by it, or the other way round
    order: str = ""  #: ``ascending``, ``descending``; "" where the list is not sorted by it
    is_number: bool = False


@dataclass(frozen=True)
class ListRow:
    """A run."""

    key: str  #: What chooses it for a comparison
    name: str
    cells: Sequence[Cell]  #: One a head


@dataclass(frozen=True)
class RunList:
    """Runs, and what was asked for."""

    heads: Sequence[ListHead]
    rows: Sequence[ListRow]
    count: str  #: How many these are of how many
    filter: str = ""  #: As it was typed
    problem: str = ""  #: Why that cannot be used, and what to do; "" if it can
    choices: Sequence[ColumnChoice] = ()
    hidden: Sequence[tuple[str, str]] = ()  #: What else the form has to send
    earlier: str = ""  #: Address of the page before; "" for none
    later: str = ""  #: Address of the page after
    most_compared: int = 8
