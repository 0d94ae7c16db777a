"""What a command has to tell: sentences, figures, tables, charts and what to type next, as data.

Screen, page, pictures, notebook and JSON document are views of the same findings
(:mod:`trms_cli.reporting`), so that no two of them can differ.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec

from trms_cli.core import chart
from trms_cli.core.chart import Chart, RigDiagram

#: A judgement on a cell: coloured where there is colour, told by the text too.
Judgement = Literal["good", "bad", "doubtful", "best", ""]
Value = str | float | int | None


@dataclass(frozen=True)
class Datum:
    """A value, or a sentence, with a judgement on it and what else is known of it."""

    value: Value  #: What is shown
    judgement: Judgement = ""  #: How it is coloured
    sd: float | None = None  #: Standard deviation, to whose second digit the value is shown
    bar: float | None = None  #: 0 to 1: how much of the cell a bar behind the value fills
    link: str = ""  #: Address of a file that a page leads to, from its folder


Cell = Value | Datum


@dataclass(frozen=True)
class Table:
    """A table."""

    columns: Sequence[str]  #: Heads with units: ``α_v [rad]``
    rows: Sequence[Sequence[Cell]]  #: None for what does not exist
    caption: str = ""
    heads: int = 1  #: Columns on the left that name the row
    on_screen: bool = True  #: Whether the terminal shows it; page and document always have it
    #: What its columns are called in a filter (``rmse_yaw<0.05``), of a table of many rows that the
    #: reader of a page sorts and filters; empty for others
    keys: Sequence[str] = ()
    example: str = ""  #: Such a filter, shown where one is typed


@dataclass(frozen=True)
class Column:
    """A column of a :func:`table`: its head, and how a row's cell is had from an item."""

    head: str  #: With its unit: ``rate [rad/s]``
    cell: str | Callable[[Any], Cell]  #: Name of an attribute or key, or a function of the item


def table(items: Iterable[Any], columns: Sequence[Column], caption: str = "", **how: Any) -> Table:
    """A table with a row an item.

    Parameters
    ----------
    items : iterable
        Objects with attributes, or mappings.
    columns : sequence of Column
    **how
        ``heads``, ``on_screen``: as of :class:`Table`.
    """
    rows = [[_cell(item, column.cell) for column in columns] for item in items]
    return Table([column.head for column in columns], rows, caption, **how)


def _cell(item: Any, cell: str | Callable[[Any], Cell]) -> Cell:
    if callable(cell):
        return cell(item)
    value: Cell = item.get(cell) if isinstance(item, Mapping) else getattr(item, cell)
    return value


@dataclass(frozen=True)
class NextCommand:
    """A line to be typed next."""

    text: str  #: ``trms score first/run.mcap``
    why: str = ""  #: What it is good for


@dataclass(frozen=True)
class Details:
    """Text as it stands (a configuration, a log), folded away where that is possible."""

    summary: str
    text: str


@dataclass(frozen=True)
class Measure:
    """One of the few figures that come first: ``RMSE pitch  0.134 rad``."""

    label: str
    value: Value
    unit: str = ""
    judgement: Judgement = ""
    note: str = ""  #: The condition: ``worst of 4 steps``


@dataclass(frozen=True)
class Remarks:
    """Sentences below one another, each with a judgement where it is ``Datum``."""

    items: Sequence[str | Datum]
    on_screen: bool = True  #: Whether the terminal shows them; a page always does


Block = Table | Chart | RigDiagram | NextCommand | Details | Remarks


@dataclass(frozen=True)
class Section:
    """A part of the findings."""

    heading: str
    text: Sequence[str] = ()  #: Paragraphs: the method, what the figures mean, what they do not
    blocks: Sequence[Block] = ()  #: In order
    folded: bool = False  #: Whether a page shows the heading alone until it is opened


@dataclass(frozen=True)
class Findings:
    """What a command has to tell."""

    title: str  #: ``Equilibria``
    #: What a colleague would say of it: the answer first, a sentence each, figures with units
    lead: Sequence[str]
    sections: Sequence[Section] = ()
    #: The result as JSON data (SI units; plain lists, dicts, numbers, text), which a program reads:
    #: keys are part of the command's contract. Numbers must be finite or None.
    results: Mapping[str, Any] = field(default_factory=dict)
    warnings: Sequence[str] = ()  #: What limits the answer
    measures: Sequence[Measure] = ()  #: The few figures that come first
    facts: Mapping[str, str] = field(default_factory=dict)  #: Circumstances, by name: model, date
    files: Mapping[str, Path] = field(default_factory=dict)  #: What was written, by what it is
    next: Sequence[NextCommand] = ()  #: What to type next
    next_first: bool = False  #: Whether a page tells that before all that limits and proves it

    @property
    def charts(self) -> tuple[Chart, ...]:
        """All figures, in order."""
        return tuple(block for block in self.blocks if isinstance(block, Chart))

    @property
    def tables(self) -> tuple[Table, ...]:
        """All tables, in order."""
        return tuple(block for block in self.blocks if isinstance(block, Table))

    @property
    def blocks(self) -> Iterator[Block]:
        """All that stands in the sections, in order."""
        return (block for section in self.sections for block in section.blocks)


def as_data(findings: Findings) -> dict[str, Any]:
    """Findings as JSON data: answer, limits, results, tables and charts."""
    return {
        "title": findings.title,
        "lead": list(findings.lead),
        "warnings": list(findings.warnings),
        "results": dict(findings.results),
        "tables": [
            {
                "caption": table.caption,
                "columns": list(table.columns),
                "rows": [[plain(cell) for cell in row] for row in table.rows],
            }
            for table in findings.tables
        ],
        "charts": [chart.as_data(one) for one in findings.charts],
    }


def plain(cell: Cell) -> Value:
    """The value of a cell without its judgement."""
    return cell.value if isinstance(cell, Datum) else cell


def round_significant(value: float | None, digits: int = 4) -> float | None:
    """A number to some significant digits, for a cell; None for what is not finite."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.{digits}g}")


def json_data(value: Any) -> Any:
    """A result as JSON data, such as :attr:`Findings.results`.

    Dataclasses become mappings, arrays lists, complex numbers pairs; what is no number (NaN,
    infinity) becomes None.
    """
    return _finite(msgspec.to_builtins(value, enc_hook=_encoded))


def _encoded(value: Any) -> Any:
    if isinstance(value, complex):
        return [value.real, value.imag]
    return value.tolist()


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value
