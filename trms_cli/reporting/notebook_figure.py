"""A figure that a notebook shows by itself, in the style of the project."""

from __future__ import annotations

import io

from matplotlib.figure import Figure

from trms_cli.reporting.style import house_style

#: Dots per inch: sharp enough beside text, and small enough to be kept in a notebook.
_DPI = 72


class NotebookFigure(Figure):
    """A figure without a window; as the value of a cell it is its picture."""

    def _repr_png_(self) -> bytes:
        with house_style():
            content = io.BytesIO()
            self.savefig(content, dpi=_DPI, format="png")
        return content.getvalue()
