"""One look for every figure of the program: colours, line styles, type, grid, size on disk.

It has three variants: ``screen`` for pages and pictures beside a run, ``paper`` for a printed
column (7 to 8 points at the width at which it is printed), ``slides`` for a projector. Nothing but
this module changes matplotlib's settings, and nothing but this module names a colour; a test over
all that draws holds both.

Figures are made with matplotlib's objects and the Agg canvas. ``pyplot`` is never imported: it
costs 0.4 s, keeps figures alive and asks for a display.
"""

import io
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, cast

import numpy as np
from matplotlib import rc_context, rcParams
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
#: Of what was measured, behind what is held against it; of empty ground.
MEASURED, GROUND, PAPER = "#aaaaaa", "#e4e4e4", "#ffffff"
#: Of a family of curves, from the first to the last; and of what there is little of, or some.
SHADES = ("#c6dbef", "#9ecae1", "#4292c6", "#08519c")
LITTLE, SOME = "#f4f4f4", "#f5d9c6"
#: Of limits, faults and missed deadlines.
ALARM = "#c1272d"

#: pixels per inch of a PNG: sharp on a page of normal width, small on disk.
DPI = 110
#: Of a picture's palette: curves on white need no more.
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
    # Letters as letters of an embedded font in PDF, as outlines in SVG; equal figures, equal bytes.
    "pdf.fonttype": 42,
    "ps.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "trms",
    "path.simplify": True,
}

Variant = Literal["screen", "paper", "slides"]
#: What the variants change; sizes in points.
_VARIANTS: dict[Variant, Any] = {
    "screen": {},
    "paper": {
        "font.size": 7.5,
        "axes.titlesize": 7.5,
        "axes.labelsize": 7.5,
        "legend.fontsize": 7.0,
        "xtick.labelsize": 7.0,
        "ytick.labelsize": 7.0,
        "axes.linewidth": 0.6,
        "lines.linewidth": 0.9,
        "grid.linewidth": 0.4,
        "xtick.major.size": 2.2,
        "ytick.major.size": 2.2,
        "xtick.major.width": 0.6,
        "ytick.major.width": 0.6,
        "xtick.major.pad": 2.0,
        "ytick.major.pad": 2.0,
        "axes.labelpad": 2.0,
    },
    "slides": {
        "font.size": 16.0,
        "axes.titlesize": 16.0,
        "legend.fontsize": 15.0,
        "axes.linewidth": 1.2,
        "lines.linewidth": 2.4,
        "grid.linewidth": 0.8,
        "xtick.major.size": 5.0,
        "ytick.major.size": 5.0,
    },
}
VARIANTS: tuple[Variant, ...] = tuple(_VARIANTS)


@contextmanager
def house_style(variant: Variant = "screen", *, svg_text: bool = False) -> Iterator[None]:
    """The look of the house, for all that is drawn and saved inside.

    `svg_text`: letters of an SVG as text, which can be edited where the font is installed; as
    outlines otherwise, which look alike everywhere.
    """
    fonts: Any = {"svg.fonttype": "none"} if svg_text else {}
    with rc_context({**_SETTINGS, **_VARIANTS[variant], **fonts}):
        yield


def letter_size(variant: Variant) -> float:
    """Size of the letters of a variant, points."""
    size: float = _VARIANTS[variant].get("font.size", _SETTINGS["font.size"])
    return size


def line_scale() -> float:
    """How much thicker lines are in the present variant than on a screen."""
    scale: float = rcParams["lines.linewidth"] / _SETTINGS["lines.linewidth"]
    return scale


def new_figure(width: float, height: float) -> Figure:
    """An empty figure (inches) whose panels arrange themselves."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def thin_every(time: Any, values: Any) -> tuple[np.ndarray, np.ndarray]:
    """Every k-th sample, so that no more than :data:`MOST_POINTS` (twice) are drawn."""
    step = max(1, len(time) // MOST_POINTS)
    return np.asarray(time, dtype=float)[::step], np.asarray(values, dtype=float)[::step]


def legend_above(panel: Axes, columns: int = 6, **entries: Any) -> None:
    """The legend over the panel, where it hides nothing."""
    panel.legend(
        **entries,
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

    buffer = io.BytesIO(save_figure(figure, dpi=DPI, format="png"))
    # A third of the bytes at no loss that an eye sees: figures of this program have few colours.
    picture = Image.open(buffer).convert("RGB").quantize(colours)
    content = io.BytesIO()
    picture.save(content, format="png", optimize=True)
    replace_whole(path, content.getvalue())


FigureFormat = Literal["png", "svg", "pdf"]
FORMATS: tuple[FigureFormat, ...] = ("png", "svg", "pdf")


def figure_bytes(figure: Figure, format: FigureFormat, dpi: float = 300.0) -> bytes:
    """A figure as a file's content; equal figures give equal bytes.

    Call it under the :func:`house_style` that the figure was drawn with: the fonts of PDF and SVG
    are settings of saving.
    """
    # What names a moment or a build of a library is left out.
    metadata: dict[str, dict[str, Any]] = {
        "png": {"Software": None},
        "svg": {"Date": None, "Creator": None},
        "pdf": {"CreationDate": None, "ModDate": None, "Creator": None, "Producer": None},
    }
    return save_figure(figure, format=format, dpi=dpi, metadata=metadata[format])


def save_figure(figure: Figure, **how: Any) -> bytes:
    """What ``Figure.savefig`` writes; what matplotlib warns of a size is told in our words."""
    content = io.BytesIO()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        figure.savefig(content, **how)
    for warning in caught:
        if "constrained_layout not applied" not in str(warning.message):
            warnings.warn_explicit(
                warning.message, warning.category, warning.filename, warning.lineno
            )
    if any("constrained_layout not applied" in str(warning.message) for warning in caught):
        width, height = (25.4 * side for side in figure.get_size_inches())
        sys.stderr.write(
            f"note   the panels do not fit into {width:.0f} x {height:.0f} mm: "
            "give a larger figure, or fewer panels\n"
        )
    return content.getvalue()


#: Dots per inch: sharp enough beside text, and small enough to be kept in a notebook.
_DPI = 72


class NotebookFigure(Figure):
    """A figure without a window; as the value of a cell it is its picture."""

    def _repr_png_(self) -> bytes:
        with house_style():
            content = io.BytesIO()
            self.savefig(content, dpi=_DPI, format="png")
        return small_png(content.getvalue())


def figure_for_notebook(figure: Figure) -> NotebookFigure:
    """A figure of another function as one that a notebook shows."""
    figure.__class__ = NotebookFigure
    return cast(NotebookFigure, figure)


def small_png(png: bytes, *, width: int | None = None) -> bytes:
    """A picture with a palette, no wider than `width` (pixels)."""
    from PIL import Image

    with Image.open(io.BytesIO(png)) as opened:
        image = opened.convert("RGB")
    if width is not None and image.width > width:
        height = round(image.height * width / image.width)
        image = image.resize((width, height), Image.Resampling.LANCZOS)
    content = io.BytesIO()
    image.quantize(_COLOURS_OF_A_PNG, dither=Image.Dither.NONE).save(content, "PNG", optimize=True)
    return content.getvalue()
