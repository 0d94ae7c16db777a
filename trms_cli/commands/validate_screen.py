"""What a person sees of a validation: the verdict, tables and files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.identification.validation.verdict import (
    Remark,
    lead_of,
    remarks_on,
    remarks_on_comparison,
)

if TYPE_CHECKING:
    from trms_cli.commands.validate_request import Asked
    from trms_cli.composition.composer import Composition

_MARKS = {"good": ("✓", "green"), "bad": ("✗", "red"), "doubtful": ("?", "yellow"), "": ("·", "")}


class ValidateScreen:
    """The figures, on standard output.

    Parameters
    ----------
    composition : Composition
    asked : Asked
    """

    def __init__(self, composition: Composition, asked: Asked) -> None:
        self._composition, self._asked = composition, asked

    def say_finished(
        self, document: Mapping[str, Any], path: Path, page: Path | None, spent: float
    ) -> None:
        """The verdict, the figures in short, and the files; one line for a job of a sweep."""
        if self._composition.job is not None:
            what = " ".join(self._composition.overrides)
            print(f"{self._composition.job:>4}  {what}  {_in_short(document)}")
            return
        console = _console()
        recordings = document["recordings"]
        models = list(document["models"]) if "models" in document else [document["model"]]
        console.print(f"validate   {', '.join(models)}", highlight=False, markup=False)
        for recording in recordings:
            console.print(
                f"on         {recording['file']}  {recording['duration_s']:g} s at "
                f"{1 / recording['sample_time_s']:g} Hz",
                highlight=False,
                markup=False,
                soft_wrap=True,
            )
        for note in document["notes"]:
            console.print(f"note       {note}", highlight=False, markup=False, soft_wrap=True)
        for issue in self._asked.admission.warnings:
            console.print(f"warning    {issue}", highlight=False, markup=False, soft_wrap=True)
        console.print()
        for sentence in lead_of(document):
            console.print(sentence, style="bold", highlight=False, markup=False)
        console.print()
        if "models" in document:
            _print_ranking(console, document)
            for remark in remarks_on_comparison(document):
                _print_remark(console, remark)
            console.print()
        for name in models:
            of = document["models"][name] if "models" in document else document
            _print_errors(console, of)
        if "models" not in document:
            for remark in remarks_on(document):
                _print_remark(console, remark)
            console.print()
        print(f"time       {spent:.1f} s")
        print(f"figures    {path}")
        if page is not None:
            print(f"page       {page}")


def _print_errors(console: Any, document: Mapping[str, Any]) -> None:
    """A row a channel and one beneath of predicting no change; columns of horizons."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    channels = document["by_horizon"]
    horizons = list(next(iter(channels.values())))
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1))
    table.add_column(document["model"], header_style="bold cyan", no_wrap=True)
    for head in ("1 step", *(f"{float(h):g} s" for h in horizons), "fit %", "tests"):
        table.add_column(head, justify="right", no_wrap=True)
    for channel, rows in channels.items():
        step, last = document["one_step"][channel], rows[horizons[-1]]
        found = [t for t in document["residual_tests"]["tests"] if t["channel"] == channel]
        failed = sum(test["failed"] for test in found)
        unit, scale = document["units"][channel], 1.0
        if unit == "rad":
            unit, scale = "mrad", 1e3
        table.add_row(
            f"{channel} [dim]\\[{unit}][/dim]",
            *(
                _number(value, scale)
                for value in (step["rms"], *(rows[h]["rms"] for h in horizons))
            ),
            "–" if last["fit_percent"] is None else f"{last['fit_percent']:.0f}",
            f"[red]{failed}/{len(found)}[/red]" if failed else f"0/{len(found)}",
        )
        naive = [step["unchanged_rms"], *(rows[h]["unchanged_rms"] for h in horizons)]
        table.add_row("  no change", *(_number(value, scale) for value in naive), style="dim")
    console.print(table)
    words = f"RMS; fit over {float(horizons[-1]):g} s; residual tests that fail"
    console.print(f"  {words}", style="dim", highlight=False)
    console.print()


def _print_ranking(console: Any, document: Mapping[str, Any]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("rank", header_style="bold cyan", no_wrap=True)
    for column in ("error over no change", "95 % interval"):
        table.add_column(column, justify="right", no_wrap=True)
    for rank, row in enumerate(document["ranking"], 1):
        interval = "–"
        if row["ci95"][0] is not None:
            interval = f"{_number(row['ci95'][0])} to {_number(row['ci95'][1])}"
        table.add_row(f"{rank} {row['model']}", _number(row["relative_error"]), interval)
    console.print(table)


def _print_remark(console: Any, remark: Remark) -> None:
    from rich.markup import escape

    sign, colour = _MARKS[remark.judgement]
    head = f"[{colour}]{sign}[/{colour}]" if colour else sign
    text = escape(remark.text)
    while "**" in text:  # the page's bold, in the terminal's words
        text = text.replace("**", "[bold]", 1).replace("**", "[/bold]", 1)
    console.print(f"{head} {text}", highlight=False)


def _number(value: float | None, scale: float = 1.0) -> str:
    if value is None:
        return "–"
    value *= scale
    if value != 0 and not 1e-3 <= abs(value) < 1e5:
        return f"{value:.1e}"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def _in_short(document: Mapping[str, Any]) -> str:
    rows = document["by_horizon"]
    last = list(next(iter(rows.values())))[-1]
    parts = [
        f"{channel} {_number(row[last]['rms'])} {document['units'][channel]}"
        for channel, row in rows.items()
    ]
    return f"RMS over {float(last):g} s {', '.join(parts)}"


def _console() -> Any:
    from rich.console import Console

    # in a notebook too by way of standard output, where whoever calls from Python hears it
    return Console(force_jupyter=False)
