"""A panel of estimated torques: what the observer needs besides its model to follow the rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from trms_cli.reporting.style import COLOURS, PALE, legend_above, signal_place, thinned

#: Ending of a torque's name by where it acts.
_ENDINGS = {"axes": "_moment", "rotors": "_motor"}
#: Share of the samples that may lie beyond each edge of a panel.
_BEYOND = 0.005


def estimated_torques(estimate: Mapping[str, Any]) -> dict[str, list[str]]:
    """Names of the torques that are estimated at all, by where they act (axes, rotors).

    Parameters
    ----------
    estimate : dict of str to (n,) array
        Columns of the topic /estimate.
    """
    found: dict[str, list[str]] = {}
    for place, ending in _ENDINGS.items():
        names = [
            name
            for name in estimate
            if name.endswith(ending)
            and np.any(np.asarray(estimate.get(f"sd_{name}", 0.0), dtype=float) > 0)
        ]
        if names:
            found[place] = names
    return found


def draw_torques(
    panel: Axes, times: Any, estimate: Mapping[str, Any], names: Sequence[str]
) -> None:
    """Draw torques (N m, shown in mN m) with light bands of two standard deviations.

    The panel reaches as far as most of the lines and of their bands do: neither an observer that
    finds its feet nor the uncertainty of one torque hides the others.
    """
    reach: list[tuple[float, float]] = []
    settled = len(times) // 20
    for number, name in enumerate(names):
        colour = COLOURS[signal_place(name, number) % len(COLOURS)]
        time, values = thinned(times, 1e3 * np.asarray(estimate[name], dtype=float))
        _, band = thinned(times, 2e3 * np.asarray(estimate[f"sd_{name}"], dtype=float))
        panel.fill_between(
            time, values - band, values + band, color=colour, alpha=0.12, lw=0, zorder=1
        )
        panel.plot(
            time, values, color=colour, lw=0.9, alpha=0.9, zorder=3, label=name.replace("_", " ")
        )
        reach.append(_reach(values[settled:], band[settled:]))
    panel.axhline(0.0, color=PALE, lw=0.8, zorder=0)
    if not names:
        return
    low, high = min(r[0] for r in reach), max(r[1] for r in reach)
    margin = 0.08 * (high - low) or 0.05
    panel.set_ylim(low - margin, high + margin)
    legend_above(panel)


def _reach(values: Any, band: Any) -> tuple[float, float]:
    """From where to where most of a line and of its band goes."""
    finite = np.isfinite(values) & np.isfinite(band)
    if not finite.any():
        return 0.0, 0.0
    values, typical = values[finite], float(np.median(band[finite]))
    low, high = np.quantile(values, (_BEYOND, 1 - _BEYOND))
    middle = float(np.median(values))
    return min(float(low), middle - typical, 0.0), max(float(high), middle + typical, 0.0)
