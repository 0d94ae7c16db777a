"""What a study found: sentences, tables and charts, all of them as data.

The screen, the page, the figures and the JSON document are made of the same findings, so that no
two of them can differ.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from trms_cli.core.chart import Chart

#: A judgement on a cell: coloured where there is colour, told by the text too.
Judgement = Literal["good", "bad", "doubtful", ""]
Value = str | float | int | None


@dataclass(frozen=True)
class Judged:
    """A value with a judgement on it."""

    value: Value  #: what is shown
    judgement: Judgement = ""  #: how it is coloured


@dataclass(frozen=True)
class Table:
    """A table."""

    columns: Sequence[str]  #: Heads with units: ``α_v [rad]``
    #: Text, numbers, None for what does not exist, or :class:`Judged`
    rows: Sequence[Sequence[Value | Judged]]
    caption: str = ""
    heads: int = 1  #: Columns on the left that name the row
    #: Whether the terminal shows it; the page and the document always have it
    on_screen: bool = True


@dataclass(frozen=True)
class Section:
    """A part of the findings."""

    heading: str
    text: Sequence[str] = ()  #: Paragraphs: the method, what the figures mean, what they do not
    blocks: Sequence[Table | Chart] = ()  #: In order


@dataclass(frozen=True)
class Findings:
    """What a study found."""

    title: str  #: ``Equilibria``
    #: What a colleague would say of it: the answer first, a sentence each, figures with units
    lead: Sequence[str]
    sections: Sequence[Section]
    #: The figures of the study as JSON data (SI units; plain lists, dicts, numbers, text), which a
    #: program reads: keys are part of the study's contract. Numbers must be finite or None.
    results: Mapping[str, Any]
    warnings: Sequence[str] = field(default_factory=tuple)  #: What limits the answer

    @property
    def charts(self) -> tuple[Chart, ...]:
        """All figures, in order."""
        blocks = (block for section in self.sections for block in section.blocks)
        return tuple(block for block in blocks if isinstance(block, Chart))

    @property
    def tables(self) -> tuple[Table, ...]:
        """All tables, in order."""
        blocks = (block for section in self.sections for block in section.blocks)
        return tuple(block for block in blocks if isinstance(block, Table))
