"""How large an effect has to be for a gap of 1.3, 2 or 4 times the floor, measured.

The gap is what a refit of the nominal parameters within their priors leaves in free runs of 10 s,
the floor what it leaves on rigs without an effect, whose nuisances are others each time. Their
ratio is the root mean square of those of the four channels. Of a small effect the squares add, so
``√(ratio² − 1)`` grows as the size does; between measured sizes it is interpolated in logarithms.

``python -m experiments.gap.blind.severity`` measures again at the sizes of ``severity.json`` beside
this module, corrects them, and writes it (about ten minutes); without the file it begins at the
reference sizes. With names of effects behind it those alone are measured, and added to the points
that are known of them.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.gap.blind.drivers import OpenLoop, rich_excitation
from experiments.gap.blind.nominal import nominal
from experiments.gap.blind.rig import RigRecordings, Rigs
from experiments.gap.blind.truths import TRUTHS

FloatArray = npt.NDArray[np.float64]

FILE = Path(__file__).with_name("severity.json")
#: Gap after the refit over the floor.
LEVELS: Mapping[str, float] = {"weak": 1.3, "medium": 2.0, "strong": 4.0}
#: No effect grows beyond so many times its typical size: rigs remain rigs.
LARGEST = 3.0
#: A level counts as reached where the gap beyond the floor comes so near to it.
NEAR = 0.75
_DURATION, _SAMPLE, _SETTLING, _SEED, _AMPLITUDE = 60.0, 0.02, 10.0, 20, 0.8
#: Rigs without effect whose mean is the floor.
_NULLS = 8


@cache
def table() -> Mapping[str, Any]:
    """The content of the file: ``{effect: {level: {"factor", "ratio"}}}``."""
    effects: Mapping[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))["effects"]
    return effects


def levels_reached(effect: str) -> tuple[str, ...]:
    """The levels that an effect reaches without growing beyond reason."""
    levels = table()[effect]
    return tuple(
        level
        for level, ratio in LEVELS.items()
        if beyond(levels[level]["ratio"]) > NEAR * beyond(ratio)
    )


def beyond(ratio: float) -> float:
    """The gap beyond the floor, in floors."""
    return float(np.sqrt(max(ratio**2 - 1, 0.0)))


def factor_of(effect: str, level: str) -> float:
    """By how much the reference size has to be multiplied."""
    return float(table()[effect][level]["factor"])


def interpolate_levels(factors: FloatArray, ratios: FloatArray) -> dict[str, dict[str, float]]:
    """Factor and ratio by level from what was measured.

    ``factors``, ``ratios``: (k,) arrays; multiples of the reference size, and the gap over the
    floor at each.
    """
    order = np.argsort(factors)
    size = np.log(factors[order])
    # what lies within 5 % of the floor is the floor's own scatter
    gap = np.log(np.sqrt(np.maximum(ratios[order] ** 2 - 1, 1.05**2 - 1)))
    # a larger size makes no smaller gap: scatter is halved between what is before and after
    gap = (np.maximum.accumulate(gap) + np.minimum.accumulate(gap[::-1])[::-1]) / 2
    levels = {}
    for level, ratio in LEVELS.items():
        target = 0.5 * np.log(ratio**2 - 1)
        at = _crossing(size, gap, target)
        at = min(at, np.log(LARGEST))
        reach = np.interp(at, size, gap) + min(at - size[0], 0) + max(at - size[-1], 0)
        levels[level] = {
            "factor": float(f"{np.exp(at):.4g}"),
            "ratio": float(f"{np.sqrt(1 + np.exp(2 * reach)):.4g}"),
        }
    return levels


def _crossing(size: FloatArray, gap: FloatArray, target: float) -> float:
    """Where the gap comes to what is wanted; beyond the ends it grows as the size."""
    if target <= gap[0]:
        return float(size[0] + target - gap[0])
    for i in range(len(size) - 1):
        if gap[i] <= target <= gap[i + 1] and gap[i + 1] > gap[i]:
            share = (target - gap[i]) / (gap[i + 1] - gap[i])
            return float(size[i] + share * (size[i + 1] - size[i]))
    return float(size[-1] + target - gap[-1])


def measure(effects: Sequence[str], file_entries: Mapping[str, Any]) -> dict[str, Any]:
    """Measure effects; progress goes to the error stream.

    ``file_entries``: entries of the file whose measured points count as well.
    """
    points = {e: [tuple(p) for p in file_entries.get(e, {}).get("measured", [])] for e in effects}
    factors = {e: _begin(e) for e in effects}
    for _ in range(1 if FILE.is_file() else 2):
        trials = [(e, f) for e in effects for f in factors[e]]
        for (effect, factor), ratio in zip(trials, _ratios(trials), strict=True):
            points[effect].append((factor, float(f"{ratio:.4g}")))
        factors = {e: sorted({lv["factor"] for lv in _levels(points[e]).values()}) for e in effects}
    new_entries: dict[str, Any] = {}
    for effect in effects:
        new_entries[effect] = {
            level: {**values, "sizes": TRUTHS[effect].sized(values["factor"])}
            for level, values in _levels(points[effect]).items()
        }
        new_entries[effect]["measured"] = sorted(points[effect])
    return new_entries


def _levels(points: Sequence[tuple[float, float]]) -> dict[str, dict[str, float]]:
    return interpolate_levels(np.array([f for f, _ in points]), np.array([r for _, r in points]))


def _begin(effect: str) -> list[float]:
    """The sizes to try first: those of the file, else the reference."""
    if not FILE.is_file() or effect not in table():
        return [1.0]
    return sorted({factor_of(effect, level) for level in LEVELS})


def _ratios(trials: Sequence[tuple[str, float]]) -> list[float]:
    """Gap over floor of each (effect, factor)."""
    from experiments.gap.blind.refit import dataset_of, refit
    from trms_cli.models.newtonian import Newtonian

    model = Newtonian()
    run = _recorded(trials)
    residual_rms, start_time = [], time.perf_counter()
    for i in range(_NULLS + len(trials)):
        recording = dataset_of(model, run.time, run.commands[i], run.measured[i])
        residual_rms.append(refit(model, recording).rms)
        floor = np.sqrt(np.mean(np.square(residual_rms[:_NULLS]), axis=0))
        name = trials[i - _NULLS] if i >= _NULLS else "nothing"
        spent = time.perf_counter() - start_time
        _say(
            f"{i + 1:4d} of {len(run.commands)}, {spent:4.0f} s  {name}  {residual_rms[-1] / floor}"
        )
    return [float(np.sqrt(np.mean((r / floor) ** 2))) for r in residual_rms[_NULLS:]]


def _recorded(trials: Sequence[tuple[str, float]]) -> RigRecordings:
    """Rigs without effect first, then one for each, all with the same commands."""
    n = _NULLS + len(trials)
    sizes: dict[str, FloatArray] = {}
    for i, (effect, factor) in enumerate(trials, start=_NULLS):
        for name, value in TRUTHS[effect].sized(factor).items():
            sizes.setdefault(f"{effect}.{name}", np.zeros(n))[i] = value
    samples = round(_DURATION / _SAMPLE)
    table_ = rich_excitation([_SEED], samples, _SAMPLE, amplitude=_AMPLITUDE)
    driver = OpenLoop(np.repeat(table_, n, axis=0))
    constants = {name: np.full(n, value) for name, value in nominal().items()}
    return Rigs(constants, sizes, seed=_SEED).run(driver, _DURATION, _SAMPLE, _SETTLING)


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


def main(names: Sequence[str]) -> None:
    """Measure all effects anew, or some on top of what is known of them; write."""
    file_entries = dict(table()) if names else {}
    named_entries = {name: file_entries[name] for name in names if name in file_entries}
    entries = file_entries | measure(list(names) or list(TRUTHS), named_entries)
    document = {
        "schema": "trms.blind.severity/1",
        "levels": dict(LEVELS),
        "how": "python -m experiments.gap.blind.severity",
        "effects": {name: entries[name] for name in TRUTHS if name in entries},
    }
    FILE.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
