"""The rig from the side and from above: angles, lengths, masses, thrusts and their signs.

What is drawn is what the models compute with: bodies stand where
:func:`trms_cli.models.rig_bodies.bodies` has them, thrusts point where
:func:`trms_cli.models.rig_shape.rig_shape` lets positive commands push. A test holds the moments
of the drawn forces about the drawn axes to the equations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, Polygon

from experiments.chapter2.simulation import FloatArray
from trms_cli.core.whole_file import replace_whole
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.rig_bodies import Body, bodies
from trms_cli.models.rig_shape import rig_shape
from trms_cli.reporting.style import (
    GREY,
    INK,
    PALE,
    PALETTE,
    PAPER,
    figure_bytes,
    house_style,
    new_figure,
    save_png,
)

#: The attitude of each view, rad: the other angle is zero in it.
PITCH, YAW = 0.35, 0.5
_MAIN, _TAIL, _WEIGHT = PALETTE["blue"], PALETTE["vermilion"], PALETTE["green"]
#: m, of arrows that stand for a thrust.
_THRUST = 0.115


@dataclass(frozen=True)
class Force:
    """A thrust at a positive speed of its rotor, in the room."""

    point: FloatArray  #: (3,) array; m, from where the yaw axis meets the plane of the pitch axis
    direction: FloatArray  #: (3,) array; a unit vector


@dataclass(frozen=True)
class Attitude:
    """The rig at two angles, in the room: x ahead at yaw 0, z up."""

    alpha_v: float  #: rad
    alpha_h: float  #: rad
    parameters: Mapping[str, float]

    @property
    def rotation(self) -> FloatArray:
        """From the beam's frame (along it, along the pitch axis, up) into the room, (3, 3)."""
        cv, sv = np.cos(self.alpha_v), np.sin(self.alpha_v)
        ch, sh = np.cos(self.alpha_h), np.sin(self.alpha_h)
        return np.array([[cv * ch, -sh, -sv * ch], [cv * sh, ch, -sv * sh], [sv, 0.0, cv]])

    @property
    def pivot(self) -> FloatArray:
        """Where the beam crosses the axis of pitch, (3,), m."""
        return self.place((0.0, 0.0, 0.0))

    def place(self, point: tuple[float, float, float]) -> FloatArray:
        """A point of the beam's frame in the room, (3,), m; the beam is ``h`` off the yaw axis."""
        offset = self.rotation[:, 1] * self.parameters["h"]
        return offset + self.rotation @ np.array(point)

    @property
    def masses(self) -> dict[str, tuple[Body, FloatArray]]:
        """The rig's bodies by name, and their centres in the room (m)."""
        return {
            body.name: (
                body,
                # the bodies' third axis points down, and they lie at h already
                self.rotation @ (np.array(body.centre) * np.array([1.0, 1.0, -1.0])),
            )
            for body in bodies(self.parameters)
        }

    @property
    def thrusts(self) -> dict[str, Force]:
        """By command."""
        arms = {"u_v": self.parameters["l_m"], "u_h": -self.parameters["l_t"]}
        return {
            arrow.name: Force(
                self.place((arms[arrow.name], 0.0, 0.0)), self.rotation @ np.array(arrow.axis)
            )
            for arrow in rig_shape(self.parameters).arrows
        }


def attitude(alpha_v: float, alpha_h: float) -> Attitude:
    """The rig of the set ``bench`` at two angles, rad."""
    values = {parameter.name: parameter.value for parameter in Lagrangian().parameters}
    return Attitude(alpha_v, alpha_h, values)


def draw_rig(png: Path, svg: Path | None = None) -> None:
    """Both views, as PNG for the page and as SVG to take along."""
    with house_style():
        page = _page()
        save_png(page, png)
        if svg is not None:
            replace_whole(svg, figure_bytes(page, "svg"))


def _page() -> Figure:
    page = new_figure(11.0, 4.6)
    side, above = page.subplots(1, 2)
    for panel in (side, above):
        panel.set_axis_off()
        panel.set_aspect("equal")
    _side(side, attitude(PITCH, 0.0))
    _above(above, attitude(0.0, YAW))
    return page


def _side(panel: Axes, rig: Attitude) -> None:
    """Seen along the pitch axis: x to the right, z up, yaw at zero."""
    c, axes = rig.parameters, np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

    def at(along: float, up: float = 0.0) -> FloatArray:
        return axes @ rig.place((along, 0.0, up))

    pivot, main, tail = at(0.0), at(c["l_m"]), at(-c["l_t"])
    floor = pivot[1] - 0.46
    _stand(panel, pivot, floor)
    ahead, up = (axes @ rig.rotation[:, k] for k in (0, 2))
    _bar(panel, tail, main)
    _bar(panel, pivot, at(0.0, -c["l_b"]), width=2.2)
    weight = at(0.0, -c["l_cb"])
    corners = [weight + 0.028 * (a * ahead + b * 0.8 * up) for a, b in _SQUARE]
    panel.add_patch(Polygon(corners, facecolor=_WEIGHT, edgecolor=INK, lw=0.8, zorder=4))
    # guards: the main one edge on, the tail one face on
    radius = c["r_ms"]
    guard = [main - radius * ahead, main + radius * ahead]
    panel.plot(*zip(*guard, strict=True), color=_MAIN, lw=7, alpha=0.4, zorder=2)
    panel.add_patch(Circle(tuple(tail), c["r_ts"], fill=False, edgecolor=_TAIL, lw=2.0, zorder=2))
    _motor(panel, main, _MAIN)
    _motor(panel, tail, _TAIL)
    # thrusts and weight
    force = axes @ rig.thrusts["u_v"].direction
    _arrow(panel, main + 0.02 * force, main + (0.02 + _THRUST) * force, _MAIN)
    _text(panel, main + 0.165 * force, "$F_v$, $u_v > 0$", colour=_MAIN)
    _towards(panel, tail, _TAIL)
    _text(panel, tail + np.array([-0.01, -0.135]), "$F_h$ towards you, $u_h > 0$", colour=_TAIL)
    _turning(panel, tail, 0.125, (225.0, 150.0), _TAIL)
    _text(panel, tail + 0.15 * _unit(np.radians(188.0)), r"$\omega_h$", colour=_TAIL)
    _arrow(panel, np.array([0.36, -0.18]), np.array([0.36, -0.31]), GREY)
    _text(panel, np.array([0.385, -0.245]), "$g$", colour=GREY)
    # the angle, from the level
    panel.plot([pivot[0], pivot[0] + 0.5], [pivot[1]] * 2, color=GREY, lw=0.8, ls=(0, (5, 3)))
    _turning(panel, pivot, 0.425, (0.0, np.degrees(rig.alpha_v)), INK)
    _text(panel, pivot + 0.46 * _unit(rig.alpha_v / 2), r"$\alpha_v$", size=11)
    # lengths
    _dimension(panel, pivot, main, 0.06 * up, "$l_m$")
    _dimension(panel, tail, pivot, 0.06 * up, "$l_t$")
    _dimension(panel, main, main + radius * ahead, 0.06 * up, "$r_{ms}$")
    top = tail + c["r_ts"] * _unit(np.radians(-35.0))
    _pointer(panel, tail, top, _THIN)
    _text(panel, (tail + top) / 2 + np.array([-0.008, -0.026]), "$r_{ts}$", size=8.5)
    _dimension(panel, pivot, at(0.0, -c["l_b"]), -0.075 * ahead, "$l_b$")
    _dimension(panel, pivot, weight, 0.075 * ahead, "$l_{cb}$")
    # masses
    _text(panel, at(c["l_m"] * 0.72, -0.04), "$m_m$", size=9)
    _text(panel, at(-c["l_t"] * 0.45, -0.035), "$m_t$", size=9)
    _text(panel, main + np.array([0.06, -0.035]), "$m_{mr}, m_{ms}$", size=9, colour=_MAIN)
    _text(panel, tail + np.array([-0.03, 0.125]), "$m_{tr}, m_{ts}$", size=9, colour=_TAIL)
    _text(panel, at(0.03, -c["l_b"] / 2), "$m_b$", size=9)
    _text(panel, weight + np.array([-0.02, -0.075]), "$m_{cb}$", size=9, colour=_WEIGHT)
    _text(panel, np.array([0.145, -0.024]), "pitch axis", colour=GREY, size=8)
    panel.set_xlim(-0.5, 0.52)
    panel.set_ylim(-0.48, 0.32)
    panel.set_title("from the side: pitch", fontsize=10)


def _above(panel: Axes, rig: Attitude) -> None:
    """Seen from above: x to the right, y up, pitch level."""
    c, axes = rig.parameters, np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])

    def at(along: float, across: float = 0.0) -> FloatArray:
        return axes @ rig.place((along, across, 0.0))

    axis, pivot, main, tail = np.zeros(2), at(0.0), at(c["l_m"]), at(-c["l_t"])
    ahead, left = (axes @ rig.rotation[:, k] for k in (0, 1))
    panel.add_patch(Circle((0.0, 0.0), 0.035, facecolor=PALE, edgecolor=GREY, lw=0.9, zorder=3))
    _text(panel, np.array([0.095, -0.03]), "yaw axis", colour=GREY, size=8)
    panel.plot(0.0, 0.0, marker="+", color=INK, ms=6, zorder=5)
    _bar(panel, axis, pivot, width=2.2)
    _bar(panel, tail, main)
    panel.add_patch(Circle(tuple(main), c["r_ms"], fill=False, edgecolor=_MAIN, lw=2.0, zorder=2))
    guard = [tail - c["r_ts"] * ahead, tail + c["r_ts"] * ahead]
    panel.plot(*zip(*guard, strict=True), color=_TAIL, lw=7, alpha=0.4, zorder=2)
    _motor(panel, main, _MAIN)
    _motor(panel, tail, _TAIL)
    force = axes @ rig.thrusts["u_h"].direction
    _arrow(panel, tail + 0.02 * force, tail + (0.02 + _THRUST) * force, _TAIL)
    _text(panel, tail + 0.165 * force, "$F_h$, $u_h > 0$", colour=_TAIL)
    _towards(panel, main, _MAIN)
    _text(panel, main + np.array([0.0, 0.185]), "$F_v$ towards you, $u_v > 0$", colour=_MAIN)
    _turning(panel, main, 0.125, (60.0, -20.0), _MAIN)
    _text(panel, main + 0.1 * _unit(np.radians(42.0)), r"$\omega_v$", colour=_MAIN)
    # the angle, from where the cable pulls to
    panel.plot([-0.15, 0.46], [0.0, 0.0], color=GREY, lw=0.8, ls=(0, (5, 3)), zorder=1)
    reach = 0.4
    panel.plot(*zip(axis, reach * ahead, strict=True), color=GREY, lw=0.8, ls=(0, (5, 3)), zorder=1)
    _turning(panel, axis, 0.36, (0.0, np.degrees(rig.alpha_h)), INK)
    _text(panel, 0.4 * _unit(rig.alpha_h / 2), r"$\alpha_h$", size=11)
    _turning(panel, axis, 0.1, (-40.0, -125.0), GREY)
    _text(panel, np.array([0.06, -0.14]), r"cable $-k_{ch}\,\alpha_h$", colour=GREY)
    _dimension(panel, pivot, main, 0.09 * left, "$l_m$")
    _dimension(panel, tail, pivot, 0.09 * left, "$l_t$")
    _text(panel, pivot / 2 + np.array([-0.03, 0.0]), "$h$", size=9)
    rim = main + c["r_ms"] * _unit(np.radians(100.0))
    _pointer(panel, main, rim, _THIN)
    _text(panel, (main + rim) / 2 + np.array([0.03, 0.0]), "$r_{ms}$", size=8.5)
    _dimension(panel, tail, tail - c["r_ts"] * ahead, 0.09 * left, "$r_{ts}$")
    panel.set_xlim(-0.5, 0.52)
    panel.set_ylim(-0.36, 0.44)
    panel.set_title("from above: yaw", fontsize=10)


_SQUARE = ((-1, -1), (1, -1), (1, 1), (-1, 1))
_LENGTH: dict[str, Any] = {"color": GREY, "lw": 0.7, "shrinkA": 0, "shrinkB": 0}
_THIN, _BOTH = ({"arrowstyle": style, **_LENGTH} for style in ("-|>", "<|-|>"))


def _unit(angle: float) -> FloatArray:
    return np.array([np.cos(angle), np.sin(angle)])


def _text(panel: Axes, at: FloatArray, words: str, *, colour: str = INK, size: float = 9.5) -> None:
    panel.text(at[0], at[1], words, ha="center", va="center", color=colour, size=size, zorder=6)


def _bar(panel: Axes, one: FloatArray, other: FloatArray, width: float = 3.2) -> None:
    panel.plot(*zip(one, other, strict=True), color=INK, lw=width, zorder=3)


def _motor(panel: Axes, at: FloatArray, colour: str) -> None:
    panel.add_patch(Circle(tuple(at), 0.018, facecolor=colour, edgecolor=INK, lw=0.8, zorder=5))


def _stand(panel: Axes, pivot: FloatArray, floor: float) -> None:
    """Pillar and base, and the pivot on them."""
    x, y = pivot
    pillar = [(x - 0.014, floor), (x + 0.014, floor), (x + 0.014, y), (x - 0.014, y)]
    panel.add_patch(Polygon(pillar, facecolor=PALE, edgecolor="none", zorder=1))
    panel.plot([x - 0.14, x + 0.14], [floor, floor], color=GREY, lw=3.0)
    panel.add_patch(Circle((x, y), 0.016, facecolor=PAPER, edgecolor=INK, lw=1.2, zorder=5))


def _pointer(panel: Axes, foot: FloatArray, tip: FloatArray, look: dict[str, Any]) -> None:
    ends = [(float(x), float(y)) for x, y in (foot, tip)]
    panel.annotate("", xy=ends[1], xytext=ends[0], arrowprops=look, zorder=4)


def _arrow(panel: Axes, foot: FloatArray, tip: FloatArray, colour: str) -> None:
    look = {"arrowstyle": "-|>", "color": colour, "lw": 2.0, "shrinkA": 0, "shrinkB": 0}
    _pointer(panel, foot, tip, {**look, "mutation_scale": 14})


def _towards(panel: Axes, at: FloatArray, colour: str) -> None:
    """An arrow that points at who looks: its tip in a ring."""
    panel.add_patch(Circle(tuple(at), 0.032, facecolor=PAPER, edgecolor=colour, lw=1.6, zorder=5))
    panel.plot(*at, marker="o", ms=4.5, color=colour, zorder=6)


def _turning(
    panel: Axes, centre: FloatArray, radius: float, degrees: tuple[float, float], colour: str
) -> None:
    """An arc with an arrow at its end; counter-clockwise where the second angle is larger."""
    begin, end = degrees
    low, high = sorted(degrees)
    arc = Arc(tuple(centre), 2 * radius, 2 * radius, theta1=low, theta2=high, color=colour, lw=1.3)
    panel.add_patch(arc)
    sense = np.sign(end - begin)
    tip = centre + radius * _unit(np.radians(end))
    before = centre + radius * _unit(np.radians(end - sense * np.degrees(0.02 / radius)))
    look = {"arrowstyle": "-|>", "color": colour, "lw": 1.3, "shrinkA": 0, "shrinkB": 0}
    _pointer(panel, before, tip, look)


def _dimension(
    panel: Axes, one: FloatArray, other: FloatArray, aside: FloatArray, words: str
) -> None:
    """A length, drawn beside what has it."""
    for end in (one, other):
        reach = [end + 0.3 * aside, end + 1.15 * aside]
        panel.plot(*zip(*reach, strict=True), color=GREY, lw=0.5)
    _pointer(panel, one + aside, other + aside, _BOTH)
    _text(panel, (one + other) / 2 + 1.5 * aside, words, size=9.5)
