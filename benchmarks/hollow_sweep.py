"""A sweep of many recorded runs made without simulating them: their words, and no samples.

A few runs are made as they are; of each, copies with another seed and other figures are written
into the folders of the other points: log (its records but for the samples), ``score.json``,
``status.json`` and the claim of the attempt. What lists, compares and reports runs reads nothing
else of them.

    python -m benchmarks.hollow_sweep FOLDER COUNT
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trms_cli.recordings.chunk_writer import ChunkWriter
from trms_cli.recordings.log_head import read_log_head
from trms_cli.recordings.topics import (
    CONFIG_ATTACHMENT,
    EVENT_TOPIC,
    RUN_METADATA,
    SCORE_METADATA,
)
from trms_cli.runs.entry import LOG_NAME, STATUS_NAME
from trms_cli.runs.run_folder import SCORE_NAME
from trms_cli.sweeps.record import Record, RunFolder
from trms_cli.sweeps.space import SweepPoint

#: Two entrants under two references; the seeds make up the number.
CHOICES = {"controller": ("pid", "lqr"), "ref": ("square", "sine")}
#: One run in so many failed.
FAILED_EVERY = 97
_SPREAD = 0.2  # standard deviation of the logarithm of figures


def hollow_sweep(folder: Path, count: int) -> int:
    """Write a sweep of at least `count` runs into a new folder; the number of its runs.

    One run in :data:`FAILED_EVERY` failed before it had a log.
    """
    from trms_cli.commands.run import perform
    from trms_cli.library.tasks.sweep import make_sweep

    kinds = len(CHOICES["controller"]) * len(CHOICES["ref"])
    seeds = -(-count // kinds)
    typed = [f"{key}={','.join(values)}" for key, values in CHOICES.items()]
    real = folder.with_name(f"{folder.name}-real")
    common = ["sim.duration=2", "launcher.workers=0"]
    made = make_sweep([*typed, "seed=0,1", *common, f"out={real}"], "run", perform)
    templates = {_kind(p.overrides): _template(real / str(p.number)) for p in made.points}
    plan = Record(real).document()
    words = [w if not w.startswith("seed=") else f"seed=range({seeds})" for w in plan["overrides"]]
    choices = [
        c | {"values": [str(seed) for seed in range(seeds)]} if c["key"] == "seed" else c
        for c in plan["space"]["choices"]
    ]
    plan |= {
        "overrides": words,
        "space": plan["space"] | {"choices": choices},
        "total": kinds * seeds,
        "command": f"trms run -m {' '.join(words)}",
    }
    folder.mkdir(parents=True)
    plan["counts"] = dict.fromkeys(("done", "failed", "lost", "interrupted"), 0)
    generator = np.random.default_rng(0)
    points = list(_points(made.points, seeds))
    for point in points:
        has_failed = point.number % FAILED_EVERY == FAILED_EVERY - 1
        plan["counts"]["failed" if has_failed else "done"] += 1
        scale = float(np.exp(_SPREAD * generator.standard_normal()))
        _write_run(folder, point, templates[_kind(point.overrides)], scale, failed=has_failed)
    Record(folder).append(points)
    (folder / "sweep.json").write_text(json.dumps(plan, indent=1))
    return len(points)


def _kind(overrides: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(word for word in overrides if word.partition("=")[0] in CHOICES)


def _points(first: tuple[SweepPoint, ...], seeds: int) -> Iterator[SweepPoint]:
    """As a grid proposes them: the seed runs fastest."""
    number = 0
    for point in first:
        if point.values["seed"] != "0":
            continue
        for seed in range(seeds):
            overrides = tuple(_seeded(word, seed) for word in point.overrides)
            yield SweepPoint(number, overrides, {**point.values, "seed": str(seed)})
            number += 1


def _seeded(word: str, seed: int) -> str:
    return f"seed={seed}" if word.startswith("seed=") else word


@dataclass(frozen=True)
class _Template:
    """The words of a run that was made."""

    run: Mapping[str, str]
    score: Mapping[str, Any]
    config: str
    status: Mapping[str, Any]


def _template(folder: Path) -> _Template:
    head = read_log_head(folder / LOG_NAME)
    assert head.score is not None
    status = json.loads((folder / STATUS_NAME).read_bytes())
    return _Template(head.run, head.score, head.config, status)


def _write_run(
    sweep: Path, point: SweepPoint, template: _Template, scale: float, *, failed: bool
) -> None:
    run = RunFolder(sweep, point.number)
    run.path.mkdir()
    (run.path / ".attempt-1").write_text('{"host": "hollow", "pid": 1, "born": ""}')
    status = {**template.status, "job": point.number, "overrides": list(point.overrides)}
    if failed:
        for key in ("figures", "objective", "told"):
            del status[key]
        error = {"problem": f"no rest at {scale:.4f} V", "where": "controller", "remedy": ""}
        status |= {"state": "failed", "exit_code": 1, "error": error}
    else:
        status["objective"] = scale * float(status["objective"])
        status["figures"] = _scaled(status["figures"], scale)
        status["told"] = f"{point.number}  {' '.join(point.overrides)}"
        score = {**template.score, "channels": _scaled(template.score["channels"], scale)}
        log = run.path / LOG_NAME
        score["log"] = str(log)
        (run.path / SCORE_NAME).write_text(json.dumps(score))
        _write_log(log, point, template, score)
    run.write(status)


def _write_log(log: Path, point: SweepPoint, template: _Template, score: Mapping[str, Any]) -> None:
    seed = str(point.values["seed"])
    overrides = json.dumps(list(point.overrides))
    words = {**template.run, "seed": seed, "overrides": overrides}
    config = _lines_with(template.config, {"seed: ": seed, "out: ": str(log.parent)})
    with log.open("wb") as stream:
        writer = ChunkWriter(stream, "trms hollow")
        writer.add_metadata(RUN_METADATA, words)
        writer.add_attachment(CONFIG_ATTACHMENT, "application/yaml", config.encode(), 0)
        schema = json.dumps(EVENT_TOPIC.json_schema()).encode()
        writer.add_channel(EVENT_TOPIC.name, EVENT_TOPIC.schema_name, schema)
        writer.add_metadata(RUN_METADATA, words)
        texts = {key: json.dumps(value) for key, value in score.items()}
        writer.add_metadata(SCORE_METADATA, texts)
        writer.finish()


def _lines_with(config: str, values: Mapping[str, str]) -> str:
    """A configuration with other values of keys at its top."""
    lines = config.splitlines()
    for i, line in enumerate(lines):
        for stem, value in values.items():
            if line.startswith(stem):
                lines[i] = stem + value
    return "\n".join(lines) + "\n"


def _scaled(values: Mapping[str, Any], scale: float) -> dict[str, Any]:
    """All numbers that are no whole ones, times a factor."""
    return {
        key: _scaled(value, scale)
        if isinstance(value, Mapping)
        else value * scale
        if isinstance(value, float)
        else value
        for key, value in values.items()
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.hollow_sweep")
    parser.add_argument("folder", type=Path)
    parser.add_argument("count", type=int)
    arguments = parser.parse_args()
    sys.stdout.write(f"{hollow_sweep(arguments.folder.resolve(), arguments.count)} runs\n")
