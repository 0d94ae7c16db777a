"""Block diagrams: boxes, sums and wires that meet at right angles, in the house style.

A diagram is drawn in units of its own, equal along both axes; who draws one says where its boxes
stand and by which corners its wires go.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch

from trms_cli.reporting.style import GREY, INK, PAPER, new_figure

Point = tuple[float, float]


@dataclass(frozen=True)
class Block:
    """A box, its name above the equation or the words that tell what it does."""

    #: ``x``, ``y``: Of its centre, in units of the diagram
    x: float
    y: float
    title: str
    detail: str = ""  #: Lines under the title
    #: ``wide``, ``high``: In units of the diagram
    wide: float = 1.7
    high: float = 0.95
    fill: Any = PAPER
    edge: Any = INK
    dashed: bool = False

    @property
    def left(self) -> Point:
        """Middle of its left side."""
        return (self.x - self.wide / 2, self.y)

    @property
    def right(self) -> Point:
        """Middle of its right side."""
        return (self.x + self.wide / 2, self.y)

    @property
    def top(self) -> Point:
        """Middle of its upper side."""
        return (self.x, self.y + self.high / 2)

    @property
    def bottom(self) -> Point:
        """Middle of its lower side."""
        return (self.x, self.y - self.high / 2)


@dataclass(frozen=True)
class SummingPoint:
    """A circle in which signals are added; a minus is written beside the wire that brings it."""

    #: ``x``, ``y``, ``radius``: Of the circle, in units of the diagram
    x: float
    y: float
    radius: float = 0.17

    @property
    def left(self) -> Point:
        """Where a wire from the left ends."""
        return (self.x - self.radius, self.y)

    @property
    def right(self) -> Point:
        """Where the sum leaves."""
        return (self.x + self.radius, self.y)

    @property
    def top(self) -> Point:
        """Where a wire from above ends."""
        return (self.x, self.y + self.radius)

    @property
    def bottom(self) -> Point:
        """Where a wire from below ends."""
        return (self.x, self.y - self.radius)


def diagram_panel(width: float, low: Point, high: Point) -> tuple[Figure, Axes]:
    """An empty figure of a width (inches) whose units reach from one corner to the other.

    Call it, and draw, under :func:`trms_cli.reporting.style.house_style`.
    """
    unit = width / (high[0] - low[0])
    figure = new_figure(width, unit * (high[1] - low[1]))
    panel = figure.subplots()
    panel.set_axis_off()
    panel.set_aspect("equal")
    panel.set_xlim(low[0], high[0])
    panel.set_ylim(low[1], high[1])
    return figure, panel


def draw_box(panel: Axes, block: Block, line_width: float = 0.9) -> None:
    """The frame of a block, without words."""
    panel.add_patch(
        FancyBboxPatch(
            (block.x - block.wide / 2, block.y - block.high / 2),
            block.wide,
            block.high,
            boxstyle="round,pad=0,rounding_size=0.09",
            facecolor=block.fill,
            edgecolor=block.edge,
            linewidth=line_width,
            linestyle=(0, (3, 2)) if block.dashed else "-",
            zorder=3,
        )
    )


def draw_block(panel: Axes, block: Block, size: float = 8.0) -> None:
    """A block with its words in its middle; ``size``: points, of the title."""
    draw_box(panel, block)
    look: dict[str, Any] = {"ha": "center", "va": "center", "color": INK, "zorder": 4}
    details = block.detail.splitlines()
    low, high = panel.get_xlim()
    line = 1.5 * size / (72.0 * panel.figure.bbox.width / panel.figure.dpi / (high - low))
    lines = [block.title] * bool(block.title) + details
    for i, text in enumerate(lines):
        y = block.y + line * ((len(lines) - 1) / 2 - i)
        is_title = i == 0 and bool(block.title)
        weight = "bold" if is_title and details else "normal"
        panel.text(block.x, y, text, size=size if is_title else size - 0.5, weight=weight, **look)


def draw_sum(panel: Axes, node: SummingPoint) -> None:
    """A circle, empty: signs stand beside the wires."""
    panel.add_patch(
        Circle((node.x, node.y), node.radius, facecolor=PAPER, edgecolor=INK, lw=0.9, zorder=3)
    )


def wire(panel: Axes, points: Sequence[Point], *, colour: str = GREY, head: bool = True) -> None:
    """A wire by its corners, with an arrow at its end."""
    *way, before, end = points
    if way:
        corners = [*way, before]
        panel.plot(*zip(*corners, strict=True), color=colour, lw=1.1, zorder=2)
    style: dict[str, Any] = {
        "arrowstyle": "-|>" if head else "-",
        "color": colour,
        "lw": 1.1,
        "shrinkA": 0,
        "shrinkB": 0,
    }
    panel.annotate("", xy=end, xytext=before, arrowprops=style, zorder=2)


def branch(panel: Axes, at: Point) -> None:
    """The dot where a wire leaves another."""
    panel.plot([at[0]], [at[1]], marker="o", ms=3.5, color=GREY, zorder=2)


def word(panel: Axes, x: float, y: float, text: str, **look: Any) -> None:
    """A signal's name or a sign, its middle at a point unless told otherwise."""
    usual: dict[str, Any] = {"ha": "center", "va": "center", "color": INK, "size": 10}
    panel.text(x, y, text, **(usual | look))
