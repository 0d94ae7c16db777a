"""The rig's block diagram with a share at each of its places."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from trms_cli.core import wording
from trms_cli.core.chart import DiagramRow, RigDiagram, Share
from trms_cli.models.rig_parts import BEAM, diagram_rows
from trms_cli.reporting.block_diagram import Block, branch, draw_box, wire, word
from trms_cli.reporting.style import GREY, INK, PALE, PALETTE, PAPER, house_style, new_figure

#: Size of a box, and the pitch of columns and rows, in units of the drawing.
_WIDE, _HIGH, _ACROSS = 1.42, 0.86, 1.95
#: Between the middle of all rows and the nearest, and from a row outwards to its tacho.
_ROW, _TACHO = 0.85, 1.28
#: Kinds of places from left to right; those that a rig does not have take no room.
_COLUMNS = ("actuator", "motor", "thrust", "moment", "sensor")
_FULL = PALETTE["vermilion"]
#: Share from which on a box is filled as far as it goes.
_DARKEST = 0.9


@dataclass(frozen=True)
class _Box:
    """A place of the diagram: its centre, the lines of its name, and what it measures, if it is."""

    x: float
    y: float
    title: str
    channel: str = ""


def _boxes(rows: Sequence[DiagramRow]) -> dict[str, _Box]:
    boxes = {}
    columns = [kind for kind in _COLUMNS if any(kind in row.places for row in rows)]
    for k, row in enumerate(rows):
        y = _ROW * (len(rows) - 1 - 2 * k)
        for kind, name in row.places.items():
            if kind in columns:
                shown = row.output if kind == "sensor" else ""
                x = _ACROSS * columns.index(kind)
                boxes[name] = _Box(x, y, name.replace("_", " "), shown)
            elif kind == "tacho":
                out = _TACHO if y > 0 else -_TACHO
                boxes[name] = _Box(_ACROSS * 1.5, y + out, name.replace("_", " "), row.speed)
    return boxes


def diagram(chart: RigDiagram) -> Figure:
    """From the commands to the sensors, each place with its share.

    A place is filled the darker the larger its share; one without has next to nothing. A sensor
    that was not recorded is dashed, and a rotor with its axis of which nothing was is left out.
    """
    every = chart.rows or diagram_rows(BEAM)
    channels = set(chart.channels) or {c for row in every for c in row.channels}
    rows = [row for row in every if channels.intersection(row.channels)] or every
    with house_style():
        shown = {name for row in rows for name in row.places.values()}
        boxes = {name: box for name, box in _boxes(every).items() if name in shown}
        low = min(box.y for box in boxes.values()) - 0.6
        high = max(box.y for box in boxes.values()) + 0.6
        left, right = -1.62, max(box.x for box in boxes.values()) + 1.55
        figure = new_figure(9.2 * (right - left) / (4 * _ACROSS + 3.17), 0.86 * (high - low))
        panel = figure.subplots()
        panel.set_axis_off()
        panel.set_aspect("equal")
        _wires(panel, boxes, rows)
        for name, box in boxes.items():
            _draw(panel, box, chart.shares.get(name), box.channel in channels or not box.channel)
        panel.set_xlim(left, right)
        panel.set_ylim(low, high)
        return figure


def _draw(panel: Axes, box: _Box, place: Share | None, is_recorded: bool) -> None:
    share = 0.0 if place is None else max(0.0, min(1.0, place[0]))
    block = Block(
        box.x,
        box.y,
        box.title,
        wide=_WIDE,
        high=_HIGH,
        fill=_mixed(share / _DARKEST),
        edge=INK if place is not None else GREY,
        dashed=not is_recorded and place is None,
    )
    draw_box(panel, block, line_width=1.8 if share >= 0.5 else 0.9)
    ink = PAPER if share > 0.6 else (INK if place is not None else GREY)
    look: dict[str, Any] = {"ha": "center", "va": "center", "color": ink, "zorder": 4}
    if place is None:
        panel.text(box.x, box.y, box.title, size=8, **look)
        return
    weight = "bold" if share >= 0.1 else "normal"
    panel.text(box.x, box.y + 0.24, box.title, size=8, **look)
    panel.text(box.x, box.y - 0.02, wording.gap_share(place[0]), size=11, weight=weight, **look)
    panel.text(box.x, box.y - 0.28, wording.gap_interval(place[1:]), size=7, **look)


def _mixed(part: float) -> tuple[float, float, float]:
    """From white to the full colour."""
    part = max(0.0, min(1.0, part)) ** 0.8
    full = to_rgb(_FULL)
    return (1 - part * (1 - full[0]), 1 - part * (1 - full[1]), 1 - part * (1 - full[2]))


def _wires(panel: Axes, boxes: Mapping[str, _Box], rows: Sequence[DiagramRow]) -> None:
    for row in rows:
        chain = [boxes[row.places[kind]] for kind in _COLUMNS if kind in row.places]
        y = chain[0].y
        for left, right in pairwise(chain):
            wire(panel, [(left.x + _WIDE / 2, y), (right.x - _WIDE / 2, y)])
        if row.command:
            wire(panel, [(chain[0].x - _WIDE / 2 - 0.42, y), (chain[0].x - _WIDE / 2, y)])
            _signal(panel, chain[0].x - _WIDE / 2 - 0.62, y, row.command)
        end = chain[-1].x + _WIDE / 2
        if row.output:
            wire(panel, [(end, y), (end + 0.42, y)])
            _signal(panel, end + 0.62, y, row.output)
        if "tacho" not in row.places:
            continue
        tacho = boxes[row.places["tacho"]]
        fork = (chain[1].x + chain[2].x) / 2
        inner = tacho.y - _HIGH / 2 if tacho.y > 0 else tacho.y + _HIGH / 2
        branch(panel, (fork, y))
        wire(panel, [(fork, y), (fork, inner)])
        wire(panel, [(tacho.x + _WIDE / 2, tacho.y), (tacho.x + _WIDE / 2 + 0.42, tacho.y)])
        _signal(panel, tacho.x + _WIDE / 2 + 0.64, tacho.y, row.speed)
    moments = [boxes[row.places["moment"]] for row in rows if "moment" in row.places]
    for upper, lower in pairwise(moments):
        x, ends = upper.x, (upper.y - _HIGH / 2, lower.y + _HIGH / 2)
        for side, up in ((-0.16, True), (0.16, False)):
            start, stop = ends if not up else ends[::-1]
            wire(panel, [(x + side, start), (x + side, stop)], colour=PALE)
        text = "cross\ncoupling"
        y = (upper.y + lower.y) / 2
        panel.text(x + 0.3, y, text, ha="left", va="center", color=GREY, size=7)


def _signal(panel: Axes, x: float, y: float, name: str) -> None:
    """A signal at the end of its wire: ``alpha_v`` with letter and index, a word above it."""
    first, _, index = name.partition("_")
    if len(index) == 1:
        word(panel, x, y, f"${first if len(first) == 1 else chr(92) + first}_{index}$")
    else:
        word(panel, x, y + 0.25, name.replace("_", " "))
