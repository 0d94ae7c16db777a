"""The gap watch over recordings: what it says, and how high its statistic comes without alarm."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec

from experiments.gap.driver import CHANNELS, NOISE_SD
from experiments.gap.watch.recordings import SAMPLE_TIME, Watched
from trms_cli.gap.watch.gap_watch import GapWatch
from trms_cli.models.newtonian import Newtonian
from trms_cli.observers.observer import ObserverSetup

#: s, over which the largest statistic is kept.
BLOCK = 10.0
_NEVER = 1e12


def evaluate(watched: Watched, config: GapWatch) -> dict[str, Any]:
    """One recording, with the nominal model: alarms, and the largest statistic of each block."""
    y, u = watched.recording.measured, watched.recording.commands
    setup = ObserverSetup(Newtonian(), SAMPLE_TIME, CHANNELS, NOISE_SD, y[0], u[0])
    run = config.init(setup)
    alarms: list[dict[str, Any]] = []
    blocks: list[list[Any]] = []  # since, the largest statistic, its test
    last = run.latest
    for k in range(len(y)):
        alarms += [asdict(alarm) for alarm in run.step(u[max(k - 1, 0)], y[k])]
        if run.latest is last or k * SAMPLE_TIME <= config.learning:
            continue
        last = run.latest
        assert last is not None
        begin = BLOCK * math.floor(k * SAMPLE_TIME / BLOCK)
        if not blocks or blocks[-1][0] != begin:
            blocks.append([begin, 0.0, ""])
        if last.statistic > blocks[-1][1]:
            test = run.tests.tests[last.test]
            blocks[-1][1:] = [round(last.statistic, 3), f"{test.location} {test.form}"]
    return {
        "kind": watched.kind,
        "drive": watched.drive,
        "effect": watched.effect,
        "severity": watched.severity,
        "onset": watched.onset if math.isfinite(watched.onset) else None,
        "locations": list(watched.locations),
        "duration": len(y) * SAMPLE_TIME,
        "alarms": alarms,
        "blocks": blocks,
    }


def evaluate_all(
    recordings: Iterable[Watched],
    config: GapWatch,
    results: Path,
    tell: Callable[[str], None] = lambda words: None,
) -> list[dict[str, Any]]:
    """All recordings; those that stand in the file of results already are not watched again."""
    head = json.dumps({"config": msgspec.to_builtins(config)})
    lines = results.read_text(encoding="utf-8").splitlines() if results.is_file() else []
    if not lines or lines[0] != head:
        lines = [head]
        results.write_text(head + "\n", encoding="utf-8")
    rows: list[dict[str, Any]] = [json.loads(line) for line in lines[1:]]
    with results.open("a", encoding="utf-8") as stream:
        for number, watched in enumerate(recordings):
            if number < len(rows):
                continue
            rows.append(evaluate(watched, config))
            stream.write(json.dumps(rows[-1]) + "\n")
            stream.flush()
            tell(f"{number + 1}: {watched.kind} {watched.effect} {watched.drive}")
    return rows


def without_threshold(config: GapWatch) -> GapWatch:
    """The same, which never raises an alarm of a change."""
    values: Mapping[str, Any] = msgspec.to_builtins(config)
    return GapWatch(**{**values, "threshold": _NEVER})
