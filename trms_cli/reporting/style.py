"""One look for every figure of the program: colours, type, grid, size on disk.

Figures are made with matplotlib's objects and the Agg canvas. ``pyplot`` is never imported: it
costs 0.4 s, keeps figures alive and asks for a display.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from trms_cli.core.whole_file import replace_whole

#: Okabe & Ito (2008): told apart with any common colour blindness.
PALETTE = MappingProxyType(
    {
        "blue": "#0072b2",
        "vermilion": "#d55e00",
        "green": "#009e73",
        "purple": "#cc79a7",
        "orange": "#e69f00",
        "sky": "#56b4e9",
        "yellow": "#f0e442",
    }
)
#: The order in which curves take them.
COLOURS = tuple(PALETTE[name] for name in ("blue", "vermilion", "green", "purple"))
INK, GREY, PALE = "#222222", "#777777", "#dddddd"
#: Of limits, faults and missed deadlines.
ALARM = "#c1272d"

LABELS = MappingProxyType(
    {
        "alpha_v": "pitch",
        "alpha_h": "yaw",
        "omega_v": "main rotor",
        "omega_h": "tail rotor",
        "u_v": "main rotor",
        "u_h": "tail rotor",
    }
)

#: pixels per inch of a PNG: sharp on a page of normal width, small on disk.
DPI = 110
_COLOURS_OF_A_PNG = 96
#: Longest line drawn with every sample; a longer one is thinned, which no eye sees.
MOST_POINTS = 20_000

# matplotlib types its keys as literals, which a plain mapping cannot be.
_SETTINGS: Any = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.labelcolor": INK,
    "axes.edgecolor": GREY,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "axes.formatter.limits": (-4, 5),
    "grid.color": PALE,
    "grid.linewidth": 0.5,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.major.size": 3.0,
    "ytick.major.size": 3.0,
    "lines.linewidth": 1.4,
    "lines.solid_capstyle": "round",
    "legend.frameon": False,
    "legend.fontsize": 8.0,
}


@contextmanager
def house_style() -> Iterator[None]:
    """The look of the house, for all that is drawn and saved inside."""
    with rc_context(_SETTINGS):
        yield


def new_figure(width: float, height: float) -> Figure:
    """An empty figure (inches) whose panels arrange themselves."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def thinned(time: Any, values: Any) -> tuple[np.ndarray, np.ndarray]:
    """Every k-th sample, so that no more than :data:`MOST_POINTS` (twice) are drawn."""
    step = max(1, len(time) // MOST_POINTS)
    return np.asarray(time, dtype=float)[::step], np.asarray(values, dtype=float)[::step]


def legend_above(panel: Axes, columns: int = 6) -> None:
    """The legend over the panel, where it hides nothing."""
    panel.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 0.99),
        ncols=columns,
        frameon=False,
        fontsize=8,
        handlelength=1.6,
        columnspacing=1.2,
        borderaxespad=0.0,
        borderpad=0.15,
    )


def save_png(figure: Figure, path: Path, colours: int = _COLOURS_OF_A_PNG) -> None:
    """Write a PNG of a limited palette, whole or not at all; equal figures give equal bytes."""
    from PIL import Image

    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=DPI, format="png")
    # A third of the bytes at no loss that an eye sees: figures of this program have few colours.
    picture = Image.open(drawn).convert("RGB").quantize(colours)
    content = io.BytesIO()
    picture.save(content, format="png", optimize=True)
    replace_whole(path, content.getvalue())
