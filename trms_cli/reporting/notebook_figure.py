"""A figure that a notebook shows by itself, in the style of the project, and small."""

from __future__ import annotations

import io
from typing import cast

from matplotlib.figure import Figure

from trms_cli.reporting.style import house_style

#: Dots per inch: sharp enough beside text, and small enough to be kept in a notebook.
_DPI = 72
#: Of a picture's palette: curves on white need no more.
_COLOURS = 96


class NotebookFigure(Figure):
    """A figure without a window; as the value of a cell it is its picture."""

    def _repr_png_(self) -> bytes:
        with house_style():
            content = io.BytesIO()
            self.savefig(content, dpi=_DPI, format="png")
        return small_png(content.getvalue())


def shown(figure: Figure) -> NotebookFigure:
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
    image.quantize(_COLOURS, dither=Image.Dither.NONE).save(content, "PNG", optimize=True)
    return content.getvalue()
