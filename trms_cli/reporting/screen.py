"""Findings on a terminal: the answer, its figures and tables, what limits it, what to type next.

A table never loses a figure: where it is too wide, heads and names are folded first, and then its
columns are parted into tables below one another, each with the names of its rows.
"""

import os
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from shutil import get_terminal_size
from typing import IO

from trms_cli.core import wording
from trms_cli.core.findings import (
    Cell,
    Column,
    Datum,
    Findings,
    Measure,
    NextCommand,
    Remarks,
    Table,
    plain,
    table,
)
from trms_cli.core.printable import printable

_COLOURS = {"good": "green", "bad": "red", "doubtful": "yellow", "best": "green", "": ""}
#: What stands behind a judged cell where colours are lost.
_SIGNS = {"best": " ★"}
#: What stands before a judged sentence.
_POINTS = {"good": "✓", "bad": "✗", "doubtful": "?", "best": "★", "": "·"}
#: Columns of a file or a pipe, and of a terminal that is wider.
WIDTH = 100
#: Rows of a table on the screen; page and document have them all.
_MOST_ROWS = 16
#: Narrowest that a column of names is folded to.
_NARROWEST = 12
_GAP = 2
_LABEL = 11
#: Letters of a reason that stands behind its line.
_LONGEST_WHY = 60
#: A number as it is written, with its sign, its exponent and what belongs to it: never broken.
_NUMBER = re.compile(r"[-+−±]*\d+(?:[.,]\d+)*(?:e[-+−]?\d+)?[j%°]?")
#: Of the answer to a job of a sweep.
_SENTENCES_OF_A_JOB = 4


#: Numbers of the styles in an escape sequence (ECMA-48).
_CODES = {
    "bold": "1",
    "dim": "2",
    "italic": "3",
    "red": "31",
    "green": "32",
    "yellow": "33",
    "cyan": "36",
}
#: A line: parts of text, each with the words of its style.
Line = Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Terminal:
    """Where findings are printed. Not by rich, whose import would take longer than a short run."""

    file: IO[str]
    width: int = WIDTH  #: Letters of a line
    colour: bool = False

    def print(self, line: Line = ()) -> None:
        """Print one line."""
        painted = (self._painted(text, style) for text, style in line if text)
        self.file.write("".join(painted) + "\n")

    def _painted(self, text: str, style: str) -> str:
        if not (style and self.colour):
            return text
        return f"\033[{';'.join(_CODES[word] for word in style.split())}m{text}\033[0m"


def terminal(stream: IO[str] | None = None) -> Terminal:
    """As wide as the terminal, at most :data:`WIDTH`; that wide for a file."""
    stream = stream or sys.stdout
    is_terminal = stream.isatty()
    width = get_terminal_size().columns if is_terminal or "COLUMNS" in os.environ else WIDTH
    plain_only = os.environ.get("NO_COLOR") or os.environ.get("TERM") in ("dumb", "unknown")
    return Terminal(stream, min(width, WIDTH), is_terminal and not plain_only)


def show(
    findings: Findings,
    command: str,
    subject: str = "",
    *,
    stream: IO[str] | None = None,
    rows: int = _MOST_ROWS,
) -> None:
    """Print findings.

    `command`: the first word of the first line; empty where that line stands already. `subject`:
    what was studied: ``newtonian with pitch_coulomb_friction, under pid``. `rows`: of each table,
    at most; the documents have them all.
    """
    out = terminal(stream)
    title = " · ".join(part for part in (findings.title, subject) if part)
    lead = list(findings.lead)
    # findings without a title have their answer in the first line
    if command:
        _say_labelled(out, command, title or _plain(lead.pop(0)))
    _say(out)
    for sentence in lead:
        _say(out, _plain(sentence), "bold")
    if lead:
        _say(out)
    if findings.measures:
        show_table(out, measures_table(findings.measures), rows)
    for block in findings.blocks:
        if isinstance(block, Table) and block.on_screen and block.rows:
            show_table(out, block, rows)
        elif isinstance(block, Remarks) and block.on_screen and block.items:
            show_remarks(out, block.items)
    for warning in findings.warnings:
        _say(out, f"! {_plain(warning)}", "yellow")
    if findings.warnings:
        _say(out)
    for name, text in findings.facts.items():
        _say_labelled(out, name, text)
    for name, path in findings.files.items():
        print(f"{name:<{_LABEL}}{path}", file=out.file)
    show_next(findings.next, out.file)


def say(head: str, text: str) -> None:
    """Print a line behind its head, on standard output."""
    print(f"{f'{head} ':<{_LABEL}}{text}")


def show_remarks(out: Terminal, items: Sequence[str | Datum]) -> None:
    """Print sentences, each behind the sign of its judgement."""
    for item in items:
        datum = item if isinstance(item, Datum) else Datum(item)
        style, sign = _COLOURS[datum.judgement], _POINTS[datum.judgement]
        for line in fold(_plain(str(datum.value)), out.width - 2, " ").split("\n"):
            out.print([(sign, style), (f" {line}", "")])
            sign = " "
    _say(out)


def show_job(findings: Findings, job: int, overrides: Sequence[str]) -> None:
    """A few lines for a job of a sweep: its number, what it was given, the answer."""
    first, *more = findings.lead[:_SENTENCES_OF_A_JOB] or [""]
    print(f"{job:>4}  {' '.join(overrides)}  {_plain(first)}")
    for sentence in more:
        print(f"      {_plain(sentence)}")


def show_next(commands: Sequence[NextCommand], stream: IO[str] | None = None) -> None:
    """What to type next; never folded, so that a line can be copied."""
    if not commands:
        return
    stream = stream or sys.stdout
    print(file=stream)
    for number, command in enumerate(commands):
        head = "next" if number == 0 else ""
        why = _plain(command.why)
        if len(why) > _LONGEST_WHY:  # above its line, folded
            for line in fold(why, WIDTH - _LABEL, " ").split("\n"):
                print(f"{head:<{_LABEL}}# {line}", file=stream)
                head = ""
            why = ""
        print(f"{head:<{_LABEL}}{command.text}{f'    # {why}' if why else ''}", file=stream)


def measures_table(measures: Sequence[Measure]) -> Table:
    """The figures that come first as a table."""
    columns = [
        Column("", "label"),
        Column("", lambda measure: Datum(measure.value, measure.judgement)),
        Column("", lambda measure: wording.unit(measure.unit)),
        Column("", "note"),
    ]
    return table(measures, columns)


def show_table(out: Terminal, table: Table, rows: int = _MOST_ROWS) -> None:
    """Print a table, folded and parted to the width of the console."""
    texts = [[_text(cell) for cell in row] for row in table.rows[:rows]]
    for number, part in enumerate(split_columns(table.columns, texts, table.heads, out.width)):
        if number:
            _say(out)
        for line in _lines(table, texts, part):
            out.print(line)
    if table.caption:
        _say(out, _plain(table.caption), "dim italic")
    more = len(table.rows) - rows
    if more > 0:
        _say(out, f"… {wording.count(more, 'more row')} in the document and on the page", "dim")
    _say(out)


def split_columns(
    columns: Sequence[str], rows: Sequence[Sequence[str]], heads: int, width: int
) -> list[dict[int, int]]:
    """Which columns stand in which part of a table: for each part the width of each, by its number.

    `columns`, `rows`: as text. `heads`: columns on the left that each part repeats. `width`:
    letters that a part may take.
    """
    cells = [[row[i] for row in rows] for i in range(len(columns))]
    whole = [
        max(map(_longest_line, [head, *own])) for head, own in zip(columns, cells, strict=True)
    ]
    if _total_width(whole) <= width:
        return [dict(enumerate(whole))]
    # heads fold at their spaces, names anywhere; figures never
    folded = [
        max(_longest_word(head), *map(_least, own), 1)
        for head, own in zip(columns, cells, strict=True)
    ]
    if _total_width(folded) <= width:
        return [dict(enumerate(_grow_widths(folded, whole, width)))]
    head_columns = list(range(min(heads, len(columns))))
    head_width = _total_width([folded[i] for i in head_columns])
    parts: list[list[int]] = [[]]
    for i in range(len(head_columns), len(columns)):
        part_width = _total_width([folded[j] for j in [*head_columns, *parts[-1], i]])
        if part_width > width and parts[-1]:
            parts.append([])
        parts[-1].append(i)
    result = []
    for part in parts:
        indices = [*head_columns, *part]
        room = max(width, head_width)
        grown = _grow_widths([folded[i] for i in indices], [whole[i] for i in indices], room)
        result.append(dict(zip(indices, grown, strict=True)))
    return result


def fold(text: str, width: int, signs: str = " /_,=.:·-") -> str:
    """Text in lines of at most `width`, broken after one of the signs, else anywhere.

    A number that fits a line is not broken.
    """
    lines = []
    for line in text.split("\n"):
        while len(line) > width:
            within = {at for number in _NUMBER.finditer(line) for at in range(*number.span())[1:]}
            cuts = [at for at in range(2, width + 1) if at not in within]
            after_sign = [at for at in cuts if line[at - 1] in signs]
            cut = (after_sign or cuts or [width])[-1]
            lines.append(line[:cut].rstrip())
            line = line[cut:].lstrip()
        lines.append(line)
    return "\n".join(lines)


def _lines(table: Table, rows: Sequence[Sequence[str]], part: dict[int, int]) -> list[Line]:
    """Head, rule and rows of one part, each column as wide as it was given."""
    numeric = {i: all(_is_number(row[i]) for row in table.rows) for i in part}

    def line_block(texts: Sequence[str], styles: Sequence[str], *, at_foot: bool) -> list[Line]:
        signs = " " if at_foot else " /_,=.:·-"
        folded = [fold(texts[i], width, signs).split("\n") for i, width in part.items()]
        height = max(map(len, folded))
        lines: list[Line] = []
        for k in range(height):
            line: list[tuple[str, str]] = []
            for (i, width), own, style in zip(part.items(), folded, styles, strict=True):
                at = k - (height - len(own)) if at_foot else k
                text = own[at] if 0 <= at < len(own) else ""
                line.append((" " * _GAP if line else "", ""))
                line.append((text.rjust(width) if numeric[i] else text.ljust(width), style))
            while line and not line[-1][0].strip():
                line.pop()
            if line:
                line[-1] = line[-1][0].rstrip(), line[-1][1]
            lines.append(line)
        return lines

    lines: list[Line] = []
    if any(table.columns):
        styles = ["bold cyan" if i < table.heads else "bold" for i in part]
        lines += line_block(table.columns, styles, at_foot=True)
        lines.append([("─" * _total_width(list(part.values())), "dim")])
    for row, texts in zip(table.rows, rows, strict=False):
        judgements = [cell.judgement if isinstance(cell, Datum) else "" for cell in row]
        lines += line_block(texts, [_COLOURS[judgements[i]] for i in part], at_foot=False)
    return lines


def _text(cell: Cell) -> str:
    if isinstance(cell, Datum):
        return printable(wording.cell(cell.value, cell.sd)) + _SIGNS.get(cell.judgement, "")
    return printable(wording.cell(cell))


def _is_number(cell: Cell) -> bool:
    return isinstance(plain(cell), int | float | None)


def _least(text: str) -> int:
    """Figures stay on one line; names may be folded to a few letters, but for numbers in them."""
    if len(text) <= _NARROWEST or re.fullmatch(r"[^A-Za-z]*", _NUMBER.sub("", text)):
        return len(text)
    return max(_NARROWEST, max(map(len, _NUMBER.findall(text)), default=0))


def _longest_line(text: str) -> int:
    return max(map(len, text.split("\n")))


def _longest_word(text: str) -> int:
    return min(max(map(len, text.split()), default=0), _NARROWEST)


def _total_width(widths: Sequence[int]) -> int:
    return sum(widths) + _GAP * max(len(widths) - 1, 0)


def _grow_widths(least: Sequence[int], most: Sequence[int], width: int) -> list[int]:
    """Widths from the least towards the most, the narrowest share of its wish first."""
    widths = list(least)
    room = width - _total_width(widths)
    while room > 0:
        hungry = [i for i in range(len(widths)) if widths[i] < most[i]]
        if not hungry:
            break
        widths[min(hungry, key=lambda i: widths[i] / most[i])] += 1
        room -= 1
    return widths


def _plain(text: str) -> str:
    """Without the marks of a page: ``**bold**`` and ```code```."""
    return printable(re.sub(r"\*\*(.+?)\*\*|`(.+?)`", lambda m: m[1] or m[2], text))


def _say(out: Terminal, text: str = "", style: str = "") -> None:
    for line in fold(text, out.width, " ").split("\n"):
        out.print([(line, style)])


def _say_labelled(out: Terminal, label: str, text: str) -> None:
    """Text behind its label, and what is folded under it."""
    for number, line in enumerate(fold(text, out.width - _LABEL, " ").split("\n")):
        out.print([(f"{'' if number else label:<{_LABEL}}", ""), (line, "")])
