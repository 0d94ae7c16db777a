"""How a sweep stands, from its folder alone: ``trms.sweep-status/1``."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from trms_cli.core.errors import ConfigurationError
from trms_cli.runs.driving import has_driver
from trms_cli.sweeps.record import Record
from trms_cli.sweeps.status import RunFolder, is_alive, result_of

SCHEMA = "trms.sweep-status/1"
#: A number, or what a message says was given: one cause is not many because values differ.
_GIVEN = re.compile(r"\(given: [^)]*\)|(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?!\w)")
#: Overrides of a run that are shown of it.
MOST_WORDS = 4
_MOST_LINES = 30  # a line for each run of a sweep that has no more


class _Failure(NamedTuple):
    """Runs that failed of one reason."""

    reason: tuple[str, ...]  #: of the first of them
    runs: list[int]
    bad_input: bool  #: to try again cannot help


def outcome_of(folder: Path) -> dict[str, Any]:
    """Counts, failures by their reason, the rate and the best.

    Returns ``counts`` by state, among them ``running`` and ``left`` (proposed, and not begun or
    left by a worker that died); ``failures``: state, problem, where, remedy (of the first of those
    that differ in values only), count, runs and whether what was typed is the reason; ``rate`` in
    runs per second of late; ``best``: the run with the smallest objective; ``told``: what each run
    says of itself, for a sweep of few. Raises RecordingError if there is no sweep.
    """
    record = Record(folder)
    document = record.document()
    points = record.points()
    counts = dict.fromkeys(("done", "failed", "lost", "interrupted", "running", "left"), 0)
    failures: dict[tuple[str, ...], _Failure] = {}
    ends: list[float] = []
    retried = 0
    best: tuple[float, int] | None = None
    shown: Sequence[str] = document["overrides"]
    for point in points:
        run = RunFolder(folder, point.number)
        status = run.status()
        state = _state(run, status)
        counts[state] += 1
        retried += max(0, int(status.get("attempt", 1)) - 1) if status else 0
        if state in ("failed", "lost"):
            reason = _reason(state, status)
            alike = tuple(_GIVEN.sub("…", words) for words in reason)
            failures.setdefault(alike, _Failure(reason, [], _of_input(status)))
            failures[alike].runs.append(point.number)
        result = result_of(status, point.number)
        if state == "done":
            ends.append(_seconds(status.get("end")))
            value = result.objective if result is not None else None
            if value is not None and math.isfinite(value) and (not best or value < best[0]):
                best = value, point.number
    total = document.get("total")
    lines = [_line(folder, point.number, document) for point in points[:_MOST_LINES]]
    if isinstance(total, int):
        counts["left"] += max(0, total - len(points))
    state = document["state"]
    driven = has_driver(folder)
    return {
        "schema": SCHEMA,
        "folder": str(folder),
        "primary": document["primary"],
        "state": "running" if driven else "interrupted" if state == "running" else state,
        "driven": driven,
        "overrides": list(shown),
        "total": total,
        "counts": counts,
        "retried": retried,
        "rate": _rate(ends),
        "failures": [
            dict(zip(("state", "problem", "where", "remedy"), each.reason, strict=True))
            | {"count": len(each.runs), "runs": each.runs, "bad_input": each.bad_input}
            for each in sorted(failures.values(), key=lambda each: -len(each.runs))
        ],
        "best": None
        if best is None
        else {
            "run": best[1],
            "objective": best[0],
            "overrides": [w for w in points[best[1]].overrides if w not in set(shown)],
        },
        "told": [line for line in lines if line] if len(points) <= _MOST_LINES else [],
        "summary": document.get("summary") or {},
    }


def _line(folder: Path, number: int, document: Mapping[str, Any]) -> str:
    """What a run says of itself, without what all runs share, on a line of a screen."""
    status = RunFolder(folder, number).status()
    line = str(status.get("told") or "")
    space = document.get("space")
    fixed = set(space.get("fixed", ()) if isinstance(space, Mapping) else ())
    overrides = [str(word) for word in status.get("overrides", ())]
    own = [word for word in overrides if word not in fixed]
    typed = " ".join(overrides)
    if typed and typed in line:
        return line.replace(typed, few(own), 1)
    for word in fixed:
        line = line.replace(f" {word}", "", 1)
    return line


def few(words: Sequence[str]) -> str:
    """Overrides for reading: the first few, numbers with six digits, long keys by their end.

    What is to be typed again stands in full in ``status.json`` and in ``points.jsonl``.
    """
    if len(words) <= MOST_WORDS:
        return " ".join(map(_readable, words))
    shown = [_readable(word) for word in words[:MOST_WORDS]]
    return f"{' '.join(shown)} … and {len(words) - MOST_WORDS} more"


def _readable(word: str) -> str:
    key, sign, value = word.partition("=")
    try:
        number = float(value)
    except ValueError:
        return word
    short = key.removeprefix("plant.parameters.")
    whole = re.fullmatch(r"[-+]?\d+", value) is not None
    return f"{short}{sign}{value if whole or not math.isfinite(number) else f'{number:.6g}'}"


def _state(run: RunFolder, status: Mapping[str, Any]) -> str:
    if not status:
        return "left"
    if status["state"] == "running":
        holder = run.holder()
        return "left" if holder is not None and is_alive(holder) is False else "running"
    return str(status["state"]) if status["state"] in ("done", "failed", "lost") else "interrupted"


def _reason(state: str, status: Mapping[str, Any]) -> tuple[str, ...]:
    error = status.get("error")
    if not isinstance(error, Mapping):
        code = status.get("exit_code")
        return state, f"it ended with exit code {code}", "", ""
    first = str(error.get("problem", "")).strip().splitlines()
    return (
        state,
        first[0] if first else "no reason given",
        str(error.get("where") or ""),
        str(error.get("remedy") or ""),
    )


def _of_input(status: Mapping[str, Any]) -> bool:
    """Whether the run failed of what was typed."""
    error = status.get("error")
    return isinstance(error, Mapping) and error.get("type") == ConfigurationError.__name__


def _seconds(moment: Any) -> float:
    try:
        return datetime.fromisoformat(moment).timestamp()
    except (TypeError, ValueError):
        return math.nan


def _rate(ends: Sequence[float]) -> float | None:
    """Runs per second over the last that ended; None before three have."""
    times = sorted(each for each in ends if math.isfinite(each))[-200:]
    if len(times) < 3 or times[-1] <= times[0]:
        return None
    return (len(times) - 1) / (times[-1] - times[0])
