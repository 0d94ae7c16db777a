"""What a person sees of a diagnosis: what is diagnosed, then the verdict on one screen."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from trms_cli.commands.diagnose_request import Asked
from trms_cli.composition.composer import Composition
from trms_cli.core.invocation import program
from trms_cli.gap.diagnosis import Cause, Diagnosis, Gap, horizon_key
from trms_cli.reporting.diagnosis_words import (
    cause_words,
    interval_words,
    percent,
    size_words,
)

#: Causes, places and warnings that are printed; the report has all.
_MOST_CAUSES, _MOST_PLACES, _MOST_WARNINGS = 5, 3, 4
#: Probability and share below which a line says nothing.
_LEAST = 0.01
#: s, of the table of gaps.
_TOLD_HORIZON = 2.0
_BAR = 10  # letters of a probability of 1
#: Verdicts after which the missing force itself is described.
_UNNAMED = ("none_of_these", "undecided")
#: Angles are told in mrad.
_SHOWN = {"rad": ("mrad", 1e3)}


class DiagnoseScreen:
    """Words on standard output; in a sweep one line a job.

    Parameters
    ----------
    composition : Composition
    asked : Asked
    folder : Path
    """

    def __init__(self, composition: Composition, asked: Asked, folder: Path) -> None:
        self._composition, self._asked, self._folder = composition, asked, folder
        self._quiet = composition.job is not None

    def beginning(self) -> Iterator[str]:
        """What is diagnosed, and what was found in the recordings."""
        problem, suspects = self._asked.problem, self._asked.suspects
        words = [problem.model_name]
        if self._composition.config.get("effect"):
            words.append(f"with {', '.join(self._composition.config['effect'])}")
        words += [f"{len(suspects.effects)} suspects", f"effort {problem.effort}"]
        yield f"diagnose   {' · '.join(words)}"
        for dataset in problem.datasets:
            channels = ", ".join(signal.name for signal in dataset.outputs)
            yield (
                f"on         {dataset.source}  {dataset.duration:g} s at "
                f"{1 / dataset.sample_time:g} Hz  {channels}"
            )
        for remark in self._asked.remarks:
            yield f"note       {remark}"
        warnings = problem.warnings
        for warning in warnings[:_MOST_WARNINGS]:
            yield f"warning    {warning}"
        if len(warnings) > _MOST_WARNINGS:
            yield f"           and {len(warnings) - _MOST_WARNINGS} more: see the report"

    def say_begin(self) -> None:
        """The same, printed."""
        if self._quiet:
            return
        for line in self.beginning():
            print(line)
        sys.stdout.flush()

    def say_stopped(self) -> None:
        """How to go on."""
        if not self._quiet:
            words = f"{program()} diagnose resume={shlex.quote(str(self._folder))}"
            sys.stderr.write(f"stopped; finished stages are kept: {words}\n")

    def say_finished(
        self, diagnosis: Diagnosis, corrected: Path, page: Path | None, seconds: float
    ) -> None:
        """The verdict, what it rests on, the files, and what to do next."""
        if self._quiet:
            what = " ".join(self._composition.overrides)
            print(f"{self._composition.job:>4}  {what}  {diagnosis.sentence}")
            return
        console = _console()
        console.print()
        console.print(diagnosis.sentence, style="bold", highlight=False, markup=False)
        console.print()
        for head, text in _told(diagnosis):
            _print_folded(console, head, text)
        _print_gap(console, diagnosis)
        experiment = diagnosis.next_experiment
        if experiment is not None:
            _print_folded(console, "next", experiment.why)
            print(f"           {experiment.command}")
            print()
        print(f"time       {seconds:.1f} s")
        print(f"figures    {corrected.with_name('diagnosis.json')}")
        print(f"model      {corrected}")
        if page is not None:
            print(f"report     {page}")


def _print_folded(console: Any, head: str, text: str) -> None:
    """A line whose further ones stand under its text."""
    from rich.table import Table
    from rich.text import Text

    grid = Table.grid(padding=(0, 1))
    grid.add_column(width=10, no_wrap=True, style="bold")
    grid.add_column()
    grid.add_row(head, Text(text))
    console.print(grid, highlight=False)


def _told(diagnosis: Diagnosis) -> Iterator[tuple[str, str]]:
    """Causes, places, and what else there is to say, each line with its head."""
    head = "causes"
    for cause in diagnosis.causes[:_MOST_CAUSES]:
        if cause.probability < _LEAST:
            break
        yield head, f"{percent(cause.probability):>5}  {_bar(cause.probability)}  {_cause(cause)}"
        head = ""
    for group in diagnosis.confusable:
        yield "confusable", f"{', '.join(group)}: these recordings do not tell them apart"
    head = "where"
    for place in diagnosis.where[:_MOST_PLACES]:
        if place.share < _LEAST:
            break
        regions = [r for r in diagnosis.region if r.location == place.location]
        words = "".join(f"; {percent(r.share)} of it where {r.condition}" for r in regions[:1])
        yield (
            head,
            f"{place.location.replace('_', ' ')}: {percent(place.share)} of the gap "
            f"({interval_words(place.ci95)}){words}",
        )
        head = ""
    head = "missing"
    for line in diagnosis.description if diagnosis.verdict in _UNNAMED else ():
        yield head, line
        head = ""
    if diagnosis.worse:
        yield "worse", f"{', '.join(diagnosis.worse)}: the correction does not help there"
    if diagnosis.not_testable:
        names = ", ".join(item.effect for item in diagnosis.not_testable)
        few = len(diagnosis.not_testable) <= 3
        yield "untested", names if few else f"{len(diagnosis.not_testable)} effects: see the report"


def _bar(share: float) -> str:
    return ("█" * round(_BAR * share)).ljust(_BAR, "·")


def _cause(cause: Cause) -> str:
    """A cause in words, with its sizes."""
    names = cause_words(cause.effects)
    sizes = size_words(cause.parameters)
    return f"{names}  ({sizes})" if sizes else names


def told_horizon(gap: Mapping[str, Mapping[str, Gap]]) -> str | None:
    """The horizon that stands for all: 2 s, or the longest that there is below."""
    known = sorted({float(h) for rows in gap.values() for h in rows})
    if not known:
        return None
    return horizon_key(max((h for h in known if h <= _TOLD_HORIZON), default=known[0]))


def _print_gap(console: Any, diagnosis: Diagnosis) -> None:
    """A row a channel: the gap raw, refitted, corrected, its floor, and what was closed."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    told = told_horizon(diagnosis.gap)
    if told is None:
        return
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1))
    table.add_column(f"RMS over {float(told):g} s", header_style="bold", no_wrap=True)
    for name in ("before", "refitted", "corrected", "floor", "gap closed"):
        table.add_column(name, justify="right", no_wrap=True)
    for channel, rows in diagnosis.gap.items():
        row = next((r for h, r in rows.items() if horizon_key(h) == told), None)
        if row is None:
            continue
        unit, scale = _SHOWN.get(row.unit, (row.unit, 1.0))
        figures = (row.raw, row.refit, row.corrected, row.floor)
        shown = [f"{value * scale:.3g}" for value in figures]
        table.add_row(f"{channel} [dim]\\[{unit}][/dim]", *shown, _closed(diagnosis, channel, told))
    if "all" in diagnosis.shrink:
        table.add_row("all channels", "", "", "", "", _closed(diagnosis, "all", told))
    console.print(table)


def _closed(diagnosis: Diagnosis, channel: str, told: str) -> str:
    rows = diagnosis.shrink.get(channel, {})
    shrink = next((s for h, s in rows.items() if horizon_key(h) == told), None)
    if shrink is None or shrink.fraction is None:
        return "–"
    interval = ""
    if shrink.ci95 is not None:
        interval = f" ({100 * shrink.ci95[0]:.0f}–{100 * shrink.ci95[1]:.0f})"
    return f"{percent(shrink.fraction)}{interval}"


def _console() -> Any:
    from rich.console import Console

    # in a notebook too by way of standard output, where whoever calls from Python hears it
    return Console(force_jupyter=False)
