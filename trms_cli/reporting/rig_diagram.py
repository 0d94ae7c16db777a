"""The rig's block diagram with a share at each of its places."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from trms_cli.core import wording
from trms_cli.core.chart import RigDiagram, Share
from trms_cli.reporting.block_diagram import Block, branch, draw_box, wire, word
from trms_cli.reporting.style import GREY, INK, PALE, PALETTE, PAPER, house_style, new_figure

#: Size of a box, and the pitch of columns and rows, in units of the drawing.
_WIDE, _HIGH, _ACROSS = 1.42, 0.86, 1.95
#: Rows: the main rotor and pitch above, the tail rotor and yaw below; tachos outside of them.
_ROWS = {"main": 0.85, "tail": -0.85}
_TACHO = 1.28
#: The letter that channels of a rotor and its axis end in, and the channel of each sensor.
_SIDES = {"main": "_v", "tail": "_h"}
_CHANNELS = {
    "pitch_sensor": "alpha_v",
    "yaw_sensor": "alpha_h",
    "main_tacho": "omega_v",
    "tail_tacho": "omega_h",
}
_FULL = PALETTE["vermilion"]
#: Share from which on a box is filled as far as it goes.
_DARKEST = 0.9


@dataclass(frozen=True)
class _Box:
    """A place of the diagram: its centre, and the lines of its name."""

    x: float
    y: float
    title: str
    side: str


def _boxes() -> dict[str, _Box]:
    boxes = {}
    for rotor, axis in (("main", "pitch"), ("tail", "yaw")):
        y = _ROWS[rotor]
        chain = (
            (f"{rotor}_actuator", f"{rotor} actuator"),
            (f"{rotor}_motor", f"{rotor} motor"),
            (f"{rotor}_thrust", f"{rotor} thrust"),
            (f"{axis}_moment", f"{axis} moment"),
            (f"{axis}_sensor", f"{axis} sensor"),
        )
        for i, (name, title) in enumerate(chain):
            boxes[name] = _Box(_ACROSS * i, y, title, rotor)
        out = _TACHO if y > 0 else -_TACHO
        boxes[f"{rotor}_tacho"] = _Box(_ACROSS * 1.5, y + out, f"{rotor} tacho", rotor)
    return boxes


def diagram(chart: RigDiagram) -> Figure:
    """From the commands to the sensors, each place with its share.

    A place is filled the darker the larger its share; one without has next to nothing. A sensor
    that was not recorded is dashed, and a rotor with its axis of which nothing was is left out.
    """
    channel_names = set(chart.channels) or set(_CHANNELS.values()) | {"u_v", "u_h"}
    sides = [
        side for side, letter in _SIDES.items() if any(c.endswith(letter) for c in channel_names)
    ]
    with house_style():
        boxes = {name: box for name, box in _boxes().items() if box.side in sides}
        low = min(box.y for box in boxes.values()) - 0.6
        high = max(box.y for box in boxes.values()) + 0.6
        figure = new_figure(9.2, 0.86 * (high - low))
        panel = figure.subplots()
        panel.set_axis_off()
        panel.set_aspect("equal")
        _wires(panel, boxes, sides)
        for name, box in boxes.items():
            is_recorded = _CHANNELS.get(name, "") in channel_names or name not in _CHANNELS
            _draw(panel, box, chart.shares.get(name), is_recorded)
        panel.set_xlim(-1.62, 4 * _ACROSS + 1.55)
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


def _wires(panel: Axes, boxes: Mapping[str, _Box], sides: Sequence[str]) -> None:
    for (rotor, axis), command, angle, speed in (
        (("main", "pitch"), "$u_v$", r"$\alpha_v$", r"$\omega_v$"),
        (("tail", "yaw"), "$u_h$", r"$\alpha_h$", r"$\omega_h$"),
    ):
        if rotor not in sides:
            continue
        chain = [boxes[f"{rotor}_{part}"] for part in ("actuator", "motor", "thrust")]
        chain += [boxes[f"{axis}_{part}"] for part in ("moment", "sensor")]
        y = chain[0].y
        for left, right in pairwise(chain):
            wire(panel, [(left.x + _WIDE / 2, y), (right.x - _WIDE / 2, y)])
        wire(panel, [(chain[0].x - _WIDE / 2 - 0.42, y), (chain[0].x - _WIDE / 2, y)])
        word(panel, chain[0].x - _WIDE / 2 - 0.62, y, command)
        end = chain[-1].x + _WIDE / 2
        wire(panel, [(end, y), (end + 0.42, y)])
        word(panel, end + 0.62, y, angle)
        tacho = boxes[f"{rotor}_tacho"]
        fork = (chain[1].x + chain[2].x) / 2
        inner = tacho.y - _HIGH / 2 if tacho.y > 0 else tacho.y + _HIGH / 2
        branch(panel, (fork, y))
        wire(panel, [(fork, y), (fork, inner)])
        wire(panel, [(tacho.x + _WIDE / 2, tacho.y), (tacho.x + _WIDE / 2 + 0.42, tacho.y)])
        word(panel, tacho.x + _WIDE / 2 + 0.64, tacho.y, speed)
    if len(sides) < 2:
        return
    x = boxes["pitch_moment"].x
    for side, up in ((-0.16, True), (0.16, False)):
        ends = (_ROWS["main"] - _HIGH / 2, _ROWS["tail"] + _HIGH / 2)
        start, stop = ends if not up else ends[::-1]
        wire(panel, [(x + side, start), (x + side, stop)], colour=PALE)
    panel.text(x + 0.3, 0.0, "cross\ncoupling", ha="left", va="center", color=GREY, size=7)
