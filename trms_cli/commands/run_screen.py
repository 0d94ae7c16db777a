"""What a person sees of a run: a progress bar on a terminal, then the score and the files."""

from __future__ import annotations

import os
import re
import shlex
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from time import perf_counter
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TextIO

from trms_cli.core.invocation import program

if TYPE_CHECKING:
    from trms_cli.composition.composer import Composition
    from trms_cli.simulation.closed_loop import Experiment

#: The figures that tell most of a channel: key, label, unit ({} is the channel's).
_TRACKING = (
    ("rmse", "RMSE", "{}"),
    ("overshoot_percent", "overshoot", "%"),
    ("settling_time_s", "settling time", "s"),
    ("steady_state_error", "steady-state error", "{}"),
)
_WORST_OF_STEPS = ("overshoot_percent", "settling_time_s")


class RunScreen:
    """Progress on standard error if that is a terminal; the score on standard output.

    Parameters
    ----------
    composition : Composition
    experiment : Experiment
    log : Path
    """

    #: A run that ends before this needs no bar (s), and none of the time that drawing it takes.
    _PATIENCE = 0.5

    def __init__(self, composition: Composition, experiment: Experiment, log: Path) -> None:
        self._composition, self._experiment, self._log = composition, experiment, log
        self._stream = sys.stderr
        self._bar: Any = None
        self._task: Any = None
        self._visible = self._stream.isatty()
        self._begin = perf_counter()
        self._spent = 0.0

    def __enter__(self) -> Self:
        self._begin = perf_counter()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._spent = perf_counter() - self._begin
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def progress(self, time: float, error: float) -> None:
        """Simulated time (s) and the largest present tracking error (rad)."""
        spent = perf_counter() - self._begin
        if not self._visible or spent < self._PATIENCE:
            return
        if self._bar is None:
            self._bar, self._task = _bar(self._experiment.duration, self._stream)
            self._bar.start()
        speed = f"{time / spent:.0f}× real time"
        self._bar.update(self._task, completed=time, speed=speed, error=f"error {error:.3f} rad")

    def say_interrupted(self, time: float) -> None:
        """Where the log of an interrupted run is."""
        self._stream.write(
            f"\ninterrupted at {time:.2f} s; the log up to there is complete and readable\n"
            f"  log  {self._log}\n"
            f"  try  {program()} score {shlex.quote(str(self._log))}\n"
        )

    def say_finished(self, score: dict[str, Any], picture: Path | None, whole: float) -> None:
        """The score in short, the files, and what to do next; one line for a job of a sweep."""
        if self._composition.job is not None:
            print(self._job_line(score))
            return
        bold = ("\033[1m", "\033[0m") if _has_colour(sys.stdout) else ("", "")
        for line in self._lines(score, picture, whole):
            head = line[:10].rstrip()
            if head and not head.startswith(" "):
                line = f"{bold[0]}{head}{bold[1]}{line[len(head) :]}"
            print(line)

    def _lines(self, score: dict[str, Any], picture: Path | None, whole: float) -> Iterator[str]:
        yield f"run        {self._what()}"
        yield from self._unheard()
        yield ""
        yield from _channel_lines(score["channels"])
        yield from _input_lines(score["inputs"])
        yield from _estimate_lines(score["estimate"])
        yield from _solver_lines(score["solver"])
        yield from _violation_lines(score["constraint_violations"])
        yield from degraded_lines(score["degraded"])
        yield ""
        speed = score["duration_s"] / self._spent if self._spent > 0 else float("inf")
        yield (
            f"time       {score['duration_s']:g} s simulated in {self._spent:.2f} s "
            f"({speed:.0f}× real time), {whole:.2f} s in all"
        )
        yield f"log        {self._log}"
        if picture is not None:
            yield f"picture    {picture}"
        log, trms = shlex.quote(str(self._log)), program()
        yield ""
        yield f"next       {trms} score {log}"
        yield f"           {trms} export {log}"
        yield f"           {trms} run --from {log} {self._another()}"

    def _what(self) -> str:
        e, choices = self._experiment, self._composition.choices
        parts = [str(choices.get("controller"))]
        if getattr(e.controller, "follows_reference", True):
            parts.append(f"ref {choices.get('ref')}")
        parts += [f"{group} {choices.get(group)}" for group in ("observer", "plant")]
        rig = getattr(getattr(e.plant, "model", None), "name", None)
        if rig and (rig != e.model.name or e.model.sample_time is not None):
            parts.append(f"model {e.model.name}, rig {rig}")
        effects = choices.get("effect")
        if effects:
            parts.append(f"effect {', '.join(effects)}")
        faults = choices.get("fault")
        if faults:
            parts.append(f"fault {', '.join(faults)}")
        return f"{' · '.join(parts)} · {e.duration:g} s at {1 / e.sample_time:g} Hz"

    def _unheard(self) -> Iterator[str]:
        """What was asked for and has no part in the run."""
        if getattr(self._experiment.controller, "follows_reference", True):
            return
        heads = (text.lstrip("+~").partition("=")[0] for text in self._composition.overrides)
        asked = [head for head in heads if re.match(r"ref\b|\w+@ref\b", head)]
        if asked:
            name = self._composition.choices.get("controller")
            yield (
                f"note       {name} plays commands and follows no reference; of no effect: "
                f"{', '.join(asked)}"
            )

    def _another(self) -> str:
        """An override that would be interesting next."""
        effects = self._composition.choices.get("effect")
        if self._composition.choices.get("plant") == "simulated" and not effects:
            return "effect=yaw_coulomb_friction"
        if not getattr(self._experiment.controller, "follows_reference", True):
            return "controller=pid"
        return "ref=sine" if self._composition.choices.get("ref") != "sine" else "ref=square"

    def _job_line(self, score: Mapping[str, Any]) -> str:
        figures = [
            f"{name} {_number(channel['rmse'])} {channel['unit']}"
            for name, channel in score["channels"].items()
        ]
        what = " ".join(self._composition.overrides) or self._what()
        return f"{self._composition.job:>4}  {what}  RMSE {', '.join(figures) or '–'}"


def _channel_lines(channels: Mapping[str, Any]) -> Iterator[str]:
    if not channels:
        return
    yield _row("tracking", "", channels)
    units = {channel["unit"] for channel in channels.values()}
    unit = units.pop() if len(units) == 1 else ""
    steps = max(channel["steps"] for channel in channels.values())
    for key, label, of in _TRACKING:
        values = [channel[key] for channel in channels.values()]
        if all(value is None for value in values):
            continue
        note = f"worst of {steps} steps" if key in _WORST_OF_STEPS and steps > 1 else ""
        yield _row(f"  {label}", of.format(unit), map(_number, values), note)
    unsettled = sum(channel["unsettled_steps"] for channel in channels.values())
    if unsettled:
        words = "step had" if unsettled == 1 else "steps had"
        yield f"  {unsettled} {words} not settled when the next one came"


def _input_lines(inputs: Mapping[str, Any]) -> Iterator[str]:
    if not inputs:
        return
    yield _row("inputs", "", inputs)
    yield _row("  effort ∫u²dt", "V² s", (_number(u["effort"]) for u in inputs.values()))
    shares = [u["saturation_share"] for u in inputs.values()]
    if any(share is not None for share in shares):
        percent = (None if share is None else 100 * share for share in shares)
        yield _row("  at a limit", "% of time", map(_number, percent))


def _estimate_lines(estimate: Mapping[str, Any]) -> Iterator[str]:
    parts = []
    errors = {n: v for n, v in estimate["rmse"].items() if n.startswith("alpha") and v}
    if errors:
        parts.append("RMSE " + ", ".join(f"{n} {_number(v)} rad" for n, v in errors.items()))
    if estimate["nees_mean"] is not None:
        expected = _number(estimate["nees_expected"])
        parts.append(f"NEES {_number(estimate['nees_mean'])} ({expected} is consistent)")
    if not errors and estimate["nees_mean"] is None:
        steps = estimate["prediction_rmse"].items()
        figures = ", ".join(f"{n} {_number(v)}" for n, v in steps if v)
        if figures:
            parts.append(f"1-step prediction RMSE {figures}")
    if parts:
        yield f"estimate   {', '.join(parts)}"


def _solver_lines(solver: Mapping[str, Any]) -> Iterator[str]:
    times = solver["time_ms"]
    if times["median"] is None:
        return
    figures = ", ".join(f"{_number(times[key])} {key}" for key in ("median", "p99", "max"))
    troubles = [
        f"{solver[key]} {words if solver[key] != 1 else words.replace('s ', ' ', 1)}"
        for key, words in (("deadline_misses", "deadlines missed"), ("failures", "solves failed"))
        if solver[key]
    ]
    yield f"solver     {figures} ms a step; {', '.join(troubles) or 'no deadline missed'}"


def _violation_lines(violations: Mapping[str, Any]) -> Iterator[str]:
    for name, found in violations.items():
        if found["samples"]:
            worst = f"{_number(found['worst'])} {found['unit']}"
            yield f"limits     {name} beyond its limit on {found['samples']} samples, by {worst}"


def degraded_lines(found: Mapping[str, Any] | None) -> Iterator[str]:
    """How much of the run the loop was not normal, and why; nothing for a normal run."""
    if not found or found["first_s"] is None:
        return
    shares = [f"{_number(100 * share)} % {mode}" for mode, share in found["share"].items() if share]
    reasons = ", ".join(f"{name} {_number(s)} s" for name, s in found["reasons_s"].items())
    yield f"mode       {', '.join(shares)} of the time, first at {found['first_s']:g} s"
    yield f"           {reasons}"


def _row(label: str, unit: str, values: Any, note: str = "") -> str:
    cells = "".join(f"{value:>11}" for value in values)
    return f"{label:<21}{unit:<10}{cells}   {note}".rstrip()


def _number(value: float | int | None) -> str:
    """Three digits; a dash for what does not exist, 0 for what rounding made."""
    if value is None:
        return "–"
    if isinstance(value, int):
        return str(value)
    if abs(value) < 1e-9:
        return "0"
    if not 1e-3 <= abs(value) < 1e5:
        return f"{value:.1e}"
    return f"{value:.3g}"


def _has_colour(stream: TextIO) -> bool:
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return False
    return stream.isatty()


def _bar(duration: float, stream: TextIO) -> tuple[Any, Any]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    bar = Progress(
        TextColumn("{task.completed:.0f} / {task.total:g} s"),
        BarColumn(bar_width=20),
        TextColumn("{task.fields[speed]}"),
        TextColumn("{task.fields[error]}"),
        TimeRemainingColumn(compact=True),
        console=Console(file=stream, force_jupyter=False),
        transient=True,
    )
    return bar, bar.add_task("", total=duration, speed="", error="")
