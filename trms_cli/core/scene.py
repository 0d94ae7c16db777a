"""A body in space as plain data: parts on frames, and the frames' angles.

A domain says what the body is (:mod:`trms_cli.models.rig_shape`), `recordings` writes it for
viewers, `reporting` draws it. Lengths in m, angles in rad; the axis z points up.

The frames hang on each other as the rig's axes do::

    base ──turns about z by yaw──▶ yaw ──turns about −y by pitch──▶ beam

so that a positive yaw turns x towards y, and a positive pitch lifts what lies at positive x.
A ghost (the reference, the estimate) has the frame of its beam alone, which hangs on ``base``.
"""

import math
from dataclasses import dataclass
from types import MappingProxyType

Vector = tuple[float, float, float]
#: x, y, z, w.
Quaternion = tuple[float, float, float, float]
Colour = tuple[float, float, float]

BASE, YAW, BEAM = "base", "yaw", "beam"
#: Whose frames and parts are drawn beside the rig's own, by the prefix of their names.
GHOSTS = ("reference", "estimate")

#: Colours of parts (red, green, blue from 0 to 1): Okabe & Ito's, and greys.
TONES: MappingProxyType[str, Colour] = MappingProxyType(
    {
        "ink": (0.133, 0.133, 0.133),
        "grey": (0.467, 0.467, 0.467),
        "pale": (0.74, 0.74, 0.74),
        "main": (0.0, 0.447, 0.698),
        "tail": (0.835, 0.369, 0.0),
        "weight": (0.0, 0.62, 0.451),
        "reference": (0.902, 0.624, 0.0),
        "estimate": (0.8, 0.475, 0.655),
    }
)


@dataclass(frozen=True)
class Cylinder:
    """A round bar or a disc."""

    name: str
    frame: str  #: ``base``, ``yaw`` or ``beam``
    #: ``centre``, ``axis``: (3,); its middle (m) and the direction of its axis, a unit vector, in
    #: the frame
    centre: Vector
    axis: Vector
    length: float  #: m
    radius: float  #: m
    tone: str  #: Key of :data:`TONES`
    opacity: float = 1.0  #: 1 hides what is behind


@dataclass(frozen=True)
class Ring:
    """A round wire: a rotor's guard."""

    name: str  #: As of :class:`Cylinder`
    frame: str  #: As of :class:`Cylinder`
    centre: Vector  #: As of :class:`Cylinder`
    axis: Vector  #: As of :class:`Cylinder`
    radius: float  #: Of the ring and of its wire, m
    thickness: float  #: Of the ring and of its wire, m
    tone: str  #: As of :class:`Cylinder`
    opacity: float = 1.0  #: As of :class:`Cylinder`


@dataclass(frozen=True)
class Arrow:
    """An arrow whose length shows a command."""

    name: str  #: Of the command: ``u_v``
    frame: str
    foot: Vector  #: (3,); m, in the frame
    axis: Vector  #: (3,); where the arrow points when the command is positive, a unit vector
    reach: float  #: Its length at the command's limit, m
    tone: str


@dataclass(frozen=True)
class Scene:
    """A rig's body."""

    parts: tuple[Cylinder | Ring, ...]
    arrows: tuple[Arrow, ...]
    height: float  #: Of the axis of pitch above the base, m
    offset: float  #: From the axis of yaw to the beam, along y of the frame ``yaw``, m
    extent: float  #: Half the width of what it fills, m: how far a camera has to stand off
    #: Which lengths the parameters do not give and are therefore drawn by proportion, as a
    #: sentence; empty if none
    assumed: str = ""


def yaw_rotation(yaw: float) -> Quaternion:
    """Of the frame ``yaw`` in ``base``."""
    return (0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw))


def pitch_rotation(pitch: float) -> Quaternion:
    """Of the frame ``beam`` in ``yaw``; a positive pitch lifts the side of positive x."""
    return (0.0, -math.sin(0.5 * pitch), 0.0, math.cos(0.5 * pitch))


def attitude(yaw: float, pitch: float) -> Quaternion:
    """Of the frame ``beam`` in ``base``: the product of the two."""
    _, _, sine, cosine = yaw_rotation(yaw)
    _, up, _, level = pitch_rotation(pitch)
    return (-sine * up, cosine * up, sine * level, cosine * level)


def rotation_onto(axis: Vector) -> Quaternion:
    """The shortest rotation that takes z onto a unit vector: how a round bar is laid along it."""
    x, y, z = axis
    if z < -1 + 1e-9:
        return (1.0, 0.0, 0.0, 0.0)
    half = math.sqrt(0.5 * (1 + z))
    return (-y / (2 * half), x / (2 * half), 0.0, half)
