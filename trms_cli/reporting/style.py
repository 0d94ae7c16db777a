"""The look that all figures share: colours, axes, legends; nothing here knows what is drawn."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

LABELS = {
    "alpha_v": "pitch",
    "alpha_h": "yaw",
    "omega_v": "main rotor",
    "omega_h": "tail rotor",
    "u_v": "main rotor",
    "u_h": "tail rotor",
}
INK, GREY, PALE = "#222222", "#777777", "#dddddd"
#: Told apart by colour-blind readers too (Okabe & Ito).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
ALARM = "#c1272d"
DPI = 110
#: Longest line drawn with every sample; a longer one is thinned, which no eye sees.
MOST_POINTS = 20_000


def dress(panel: Axes) -> None:
    """A quiet frame: a pale grid, no upper and right edge."""
    panel.grid(color=PALE, lw=0.5)
    panel.set_axisbelow(True)
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        panel.spines[side].set_color(GREY)
    panel.tick_params(colors=GREY, labelcolor=INK, length=3)


def legend_above(panel: Axes) -> None:
    """A legend above the panel, where it hides nothing."""
    panel.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 0.985),
        ncols=6,
        frameon=False,
        fontsize=8,
        handlelength=1.6,
        columnspacing=1.2,
        borderaxespad=0.0,
        borderpad=0.1,
    )


def thinned(time: Any, values: Any) -> tuple[np.ndarray, np.ndarray]:
    """Every k-th sample, so that no more than :data:`MOST_POINTS` (twice) are drawn."""
    step = max(1, len(time) // MOST_POINTS)
    return np.asarray(time, dtype=float)[::step], np.asarray(values, dtype=float)[::step]
