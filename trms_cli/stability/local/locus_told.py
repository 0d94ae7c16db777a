"""A root locus in sections: the eigenvalues over what is varied, and why they move."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from trms_cli.core.chart import Axis
from trms_cli.core.findings import Judged, Section, Table
from trms_cli.stability.local.charts import over_range, plane
from trms_cli.stability.local.crossings import Crossing
from trms_cli.stability.local.map import StabilityMap
from trms_cli.stability.local.sweep import Path, Sweep
from trms_cli.stability.local.told import (
    amount_words,
    crossing_data,
    crossing_name,
    exchange_words,
    finite,
    range_table,
    sweep_data,
)
from trms_cli.stability.local.tracks import Track
from trms_cli.stability.local.why import (
    Reason,
    moves,
    reason_data,
    reason_words,
    share_chart,
    share_table,
)


def held_words(path: Path) -> str:
    """``at alpha_v = 0.4 rad``: what is held besides what is varied."""
    model = path.model
    held = [amount_words(model, name, v) for name, v in path.at.items() if name != path.over]
    if not held and path.kind == "angle":
        held = [amount_words(model, name, 0.0) for name in model.controlled if name != path.over]
        return f"at {', '.join(held)}" if held else "held by its command"
    return f"at {', '.join(held)}" if held else "at rest without command"


def still_words(path: Path) -> str:
    """Where nothing moves."""
    return f"Over this range {path.over} moves no growth rate, but for rounding."


def locus_section(
    path: Path, sweep: Sweep, tracks: tuple[Track, ...], found: tuple[Crossing, ...]
) -> Section:
    """The crossings, the table over the range and the figures."""
    text = [
        f"The operating point is solved anew for each {path.over}; crossings are located by "
        "Brent's method on the real part of the tracked eigenvalue."
    ]
    text += [f"The range ends early: {why}." for why in (sweep.low, sweep.high) if why]
    text += exchange_words(path, sweep, tracks)
    if len(sweep.places) < 2:
        return Section(f"Eigenvalues over {path.over}", text)
    unit = f" {path.unit}" if path.unit else ""
    ends = (f"{sweep.values[0]:.3g}{unit}", f"{sweep.values[-1]:.3g}{unit}")
    k = int(np.argmin(np.abs(sweep.values - path.began)))
    rows = [
        (
            crossing_name(path.model, tracks, c),
            float(f"{c.value:.6g}"),
            float(f"{c.frequency:.4g}"),
            float(f"{c.frequency / (2 * math.pi):.4g}"),
            "jump at a switch" if c.jumps else ("Hopf" if c.frequency else "at zero"),
            Judged("above" if c.unstable_above else "below", "bad"),
        )
        for c in found
    ]
    head = f"{path.over} [{path.unit}]" if path.unit else path.over
    blocks: list[Any] = []
    if rows:
        columns = ("mode", head, "ω [rad/s]", "f [Hz]", "kind", "unstable")
        blocks.append(Table(columns, rows, "Crossings of the imaginary axis."))
    blocks.append(range_table(path, sweep, tracks))
    blocks.append(
        plane(
            "root_locus",
            tracks,
            k,
            path.over,
            ends,
            found,
            f"Eigenvalues as {path.over} goes from {ends[0]} to {ends[1]}, {held_words(path)}; "
            f"discs: {path.over} = {sweep.values[k]:.4g}{unit}.",
        )
    )
    blocks.append(
        over_range(
            "root_locus_range",
            sweep.values,
            Axis(path.over, path.unit),
            tracks,
            path.began,
            f"Damping and frequency over {path.over}, {held_words(path)}.",
        )
    )
    return Section(f"Eigenvalues over {path.over}", text, blocks)


def why_section(
    path: Path,
    sweep: Sweep,
    found: tuple[Crossing, ...],
    reasons: list[Reason],
    tracks: tuple[Track, ...],
) -> Section:
    """The shares of dλ/dp at each crossing."""
    text = [
        "dλ/dp = wᵀ (dA/dp) v / (wᵀv), entry by entry of A: each entry is a physical equation "
        "(row) by what it depends on (column). dA/dp is exact and follows the operating point.",
        "A loop is a cycle of the signal flow graph of sI − A through the entry with the largest "
        "share, taken at s = λ: the strongest is told.",
    ]
    blocks: list[Any] = []
    for why in reasons:
        text += reason_words(path, why)
        if moves(why.sensitivity):
            blocks.append(share_table(path, why))
    if not reasons:
        text.append(still_words(path))
    if reasons and len(sweep.places) > 2:
        first = reasons[0]
        member = found[0].track if found else None
        if member is None:
            member = next(t.members[0] for t in tracks if t.name == first.mode)
        chart = share_chart("root_locus_why", path, sweep, member, first.mode)
        blocks += [] if chart is None else [chart]
    return Section("Why", text, blocks)


def results_of(
    path: Path,
    sweep: Sweep,
    tracks: tuple[Track, ...],
    found: tuple[Crossing, ...],
    reasons: list[Reason],
    sides: Mapping[str, list[float]],
    against: str | None,
    mapped: StabilityMap | None,
    at_ends: list[dict[str, Any]],
) -> dict[str, Any]:
    """The study as JSON data."""
    results: dict[str, Any] = {
        "held": {name: float(v) for name, v in path.at.items() if name != path.over},
        "locus": sweep_data(path, sweep, tracks),
        "crossings": [crossing_data(c, crossing_name(path.model, tracks, c)) for c in found],
        "crossings_by_side": {side: [float(v) for v in values] for side, values in sides.items()},
        "why": [reason_data(path, why) for why in reasons],
    }
    if mapped is not None:
        results["map"] = {
            "against": against,
            "over_values": [float(v) for v in mapped.over],
            "against_values": [float(v) for v in mapped.against],
            "largest_growth_1_s": [[finite(float(v)) for v in row] for row in mapped.growth],
            "boundary": [[float(a), float(b)] for a, b in mapped.boundary],
            "along_against": at_ends,
        }
    return results
