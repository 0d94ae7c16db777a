"""Recordings that the gap watch is calibrated and judged on.

Rigs are those of the blind benchmark (:mod:`experiments.gap.blind.rig`: another code than the
models, with drawn noise, quanta, wandering drives and laws), driven in open loop by a rich
excitation or in closed loop by a controller that knows no model.

- *steady*: nothing changes; parameters scatter by a third of the priors' standard deviations, as
  those of rigs with an effect do, so that the model is about as good as one that was fitted;
- *offset*: nothing changes; parameters are drawn from the whole priors: the model does not fit;
- *onset*: an effect of medium size (a gap twice the floor) begins within the recording.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.gap.blind.cases import Case, plan
from experiments.gap.blind.recording import Recording, Timing, record

FloatArray = npt.NDArray[np.float64]

SAMPLE_TIME = 0.02  #: s
#: Share of the priors' standard deviation by which parameters of a rig scatter.
_SCATTER = 1 / 3
#: Rigs that are simulated at once, and the cases that they are drawn among.
_AT_ONCE, _DRAWN = 400, 12_000


@dataclass(frozen=True)
class Watched:
    """One rig and what it did."""

    kind: str  #: ``steady``, ``offset`` or ``onset``
    drive: str  #: ``rich`` or ``closed_loop``
    effect: str  #: What begins; empty for nothing
    severity: str
    onset: float  #: s; NaN where nothing begins
    locations: tuple[str, ...]  #: Where it acts
    recording: Recording


def cases_of(kind: str, count: int, seed: int, duration: float, severity: str) -> list[Case]:
    """So many rigs of a kind, every other one in closed loop."""
    source = {"steady": "offset", "offset": "offset", "onset": "onset"}[kind]
    drawn = [case for case in plan("development", seed, _DRAWN) if case.kind == source]
    if kind == "onset":
        drawn = [case for case in drawn if severity in case.severity.values()]
    cases = []
    for number, case in enumerate(drawn[:count]):
        if kind == "steady":
            scattered = {name: round(_SCATTER * by, 4) for name, by in case.parameters.items()}
            case = replace(case, parameters=scattered)
        share = duration / case.duration
        cases.append(
            replace(
                case,
                drive="closed_loop" if number % 2 else "rich",
                channels="four",
                duration=duration,
                onset={effect: round(time * share, 2) for effect, time in case.onset.items()},
            )
        )
    if len(cases) < count:
        raise ValueError(f"{len(cases)} cases of kind {kind!r} are drawn, and {count} asked for")
    return cases


def make(
    folder: Path, kind: str, count: int, seed: int, duration: float, severity: str = "medium"
) -> Path:
    """Simulate what a folder does not hold yet."""
    folder.mkdir(parents=True, exist_ok=True)
    cases = cases_of(kind, count, seed, duration, severity)
    for begin in range(0, count, _AT_ONCE):
        end = min(begin + _AT_ONCE, count)
        path = folder / f"{kind}-{severity}-{seed}-{duration:g}s-{begin}-{end}.npz"
        if path.is_file():
            continue
        driven, recordings = record(cases[begin:end], Timing(duration=duration), seed + begin)
        _write(path, kind, driven, recordings)
    return folder


def _write(path: Path, kind: str, cases: Sequence[Case], recordings: Sequence[Recording]) -> None:
    arrays: dict[str, Any] = {
        "time": recordings[0].time,
        "commands": np.stack([r.commands for r in recordings]),
        "measured": np.stack([r.measured for r in recordings]),
        "kind": np.array(kind),
        "cases": np.array([json.dumps(asdict(case)) for case in cases]),
    }
    scratch = path.with_suffix(".part.npz")
    np.savez_compressed(scratch, **arrays)
    scratch.replace(path)


def read(folder: Path, kind: str) -> Iterator[Watched]:
    """All recordings of a kind in a folder."""
    for path in sorted(folder.glob(f"{kind}-*.npz")):
        if path.name.endswith(".part.npz"):
            continue
        with np.load(path) as content:
            arrays = {name: content[name] for name in ("time", "commands", "measured", "cases")}
        for i, text in enumerate(arrays["cases"].tolist()):
            case = json.loads(text)
            effect, time = next(iter(case["onset"].items()), ("", np.nan))
            yield Watched(
                kind=kind,
                drive=case["drive"],
                effect=effect,
                severity=case["severity"].get(effect, ""),
                onset=float(time),
                locations=tuple(case["locations"]),
                recording=Recording(arrays["time"], arrays["commands"][i], arrays["measured"][i]),
            )
