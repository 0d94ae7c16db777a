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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.gap.blind.cases import Case, Drive, plan
from experiments.gap.blind.recording import Recording, Timing, at_stops, record

FloatArray = npt.NDArray[np.float64]

SAMPLE_TIME = 0.02  #: s
#: Share of the priors' standard deviation by which parameters of a rig scatter.
_SCATTER = 1 / 3
#: Of effects that begin.
_SEVERITY = "medium"
#: Share of the usual excitation: fewer rigs come near a stop.
_LESS = 0.85
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


def cases_of(kind: str, count: int, seed: int) -> list[Case]:
    """So many rigs of a kind, every other one in closed loop."""
    source = {"steady": "offset", "offset": "offset", "onset": "onset"}[kind]
    drawn = [case for case in plan("development", seed, _DRAWN) if case.kind == source]
    if kind == "onset":
        drawn = [case for case in drawn if _SEVERITY in case.severity.values()]
    if len(drawn) < count:
        raise ValueError(f"{len(drawn)} cases of kind {kind!r} are drawn, and {count} asked for")
    cases = []
    for number, case in enumerate(drawn[:count]):
        parameters = case.parameters
        if kind == "steady":
            parameters = {name: round(_SCATTER * by, 4) for name, by in parameters.items()}
        drive: Drive = "closed_loop" if number % 2 else "rich"
        amplitude = round(_LESS * case.amplitude, 4)
        cases.append(
            replace(case, parameters=parameters, drive=drive, channels="four", amplitude=amplitude)
        )
    return cases


def make(folder: Path, sets: Mapping[str, tuple[int, int]], duration: float) -> None:
    """Simulate what a folder does not hold yet; rigs that come near a stop are left out.

    ``sets``: by kind a seed and a number of rigs.
    """
    folder.mkdir(parents=True, exist_ok=True)
    kinds = [kind for kind, (_, count) in sets.items() for _ in range(count)]
    cases = [case for kind, (seed, count) in sets.items() for case in cases_of(kind, count, seed)]
    cases = [_as_long_as(case, duration) for case in cases]
    seed = next(iter(sets.values()))[0]
    for begin in range(0, len(cases), _AT_ONCE):
        path = folder / f"rigs-{begin}-{min(begin + _AT_ONCE, len(cases))}.npz"
        if path.is_file():
            continue
        part = cases[begin : begin + _AT_ONCE]
        driven, recordings = record(part, Timing(duration=duration), seed + begin, tries=1)
        inside = [i for i, recording in enumerate(recordings) if not at_stops(recording)]
        _write(
            path,
            [kinds[begin + i] for i in inside],
            [driven[i] for i in inside],
            [recordings[i] for i in inside],
        )


def _as_long_as(case: Case, duration: float) -> Case:
    """What begins within a recording does so at the same share of it."""
    share = duration / case.duration
    onset = {effect: round(time * share, 2) for effect, time in case.onset.items()}
    return replace(case, duration=duration, onset=onset)


def _write(
    path: Path, kinds: Sequence[str], cases: Sequence[Case], recordings: Sequence[Recording]
) -> None:
    arrays: dict[str, Any] = {
        "time": recordings[0].time,
        "commands": np.stack([r.commands for r in recordings]),
        "measured": np.stack([r.measured for r in recordings]),
        "kinds": np.array(kinds),
        "cases": np.array([json.dumps(asdict(case)) for case in cases]),
    }
    scratch = path.with_name(f"part-{path.name}")
    np.savez_compressed(scratch, **arrays)
    scratch.replace(path)


def read(folder: Path) -> Iterator[Watched]:
    """All recordings in a folder."""
    for path in sorted(folder.glob("rigs-*.npz")):
        with np.load(path) as content:
            arrays = {name: content[name] for name in content.files}
        for i, text in enumerate(arrays["cases"].tolist()):
            case = json.loads(text)
            effect, time = next(iter(case["onset"].items()), ("", np.nan))
            yield Watched(
                kind=str(arrays["kinds"][i]),
                drive=case["drive"],
                effect=effect,
                severity=case["severity"].get(effect, ""),
                onset=float(time),
                locations=tuple(case["locations"]),
                recording=Recording(arrays["time"], arrays["commands"][i], arrays["measured"][i]),
            )
