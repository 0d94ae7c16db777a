"""Encodes a scene and its poses as Foxglove's messages, in JSON.

A run writes thousands of poses, so that their text is laid out once and only numbers are put into
it. The bodies stand in one message at the beginning; commands are arrows of a topic of their own,
because a viewer that jumps within a recording shows each topic's last message before that time.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from msgspec import Struct, to_builtins

from trms_cli.core import scene as rig
from trms_cli.recordings.foxglove import types as foxglove

#: Yaw and pitch of the rig ("") and of its ghosts, rad.
Attitudes = Mapping[str, tuple[float, float]]

_CORNERS = 48  # of a ring
_GHOST_OPACITY = {"reference": 0.35, "estimate": 0.9}
_GHOST_WIDTH = 0.8
#: Shares of an arrow: its head's length at most, and diameters over its reach.
_HEAD, _SHAFT_WIDTH, _HEAD_WIDTH = 0.25, 0.06, 0.14
_SECOND = 1_000_000_000  # ns
#: Levels of a log line, by beginnings of an event's kind; what is not here is plain information.
_LEVELS = {
    "fault_removed": foxglove.LogLevel.INFO,
    "fault_end": foxglove.LogLevel.INFO,
    "fault": foxglove.LogLevel.ERROR,
    "solver": foxglove.LogLevel.WARNING,
    "landing_begin": foxglove.LogLevel.ERROR,
    "degraded_begin": foxglove.LogLevel.WARNING,
    "outlier": foxglove.LogLevel.WARNING,
    "gap": foxglove.LogLevel.WARNING,
}


class SceneEncoder:
    """Messages of one rig.

    ``ghosts``: of :data:`~trms_cli.core.scene.GHOSTS`, those that the run has. ``about``: a
    sentence that goes along with the bodies.
    """

    def __init__(
        self, scene: rig.Scene, ghosts: Sequence[str] = rig.GHOSTS, about: str = ""
    ) -> None:
        self.scene = scene
        self.ghosts = tuple(ghosts)
        self._about = about
        self._rig = (
            _transform(rig.BASE, rig.YAW, f'"x":0,"y":0,"z":{scene.height!r}')
            + ","
            + _transform(rig.YAW, rig.BEAM, f'"x":0,"y":{scene.offset!r},"z":0')
        )
        where = f'"x":%.7g,"y":%.7g,"z":{scene.height!r}'
        self._ghosts = {
            f"{ghost}_": _transform(rig.BASE, f"{ghost}_{rig.BEAM}", where) for ghost in self.ghosts
        }
        self._arrows = [
            (_arrow_text(arrow, 1.0), _arrow_text(arrow, -1.0), arrow.reach)
            for arrow in scene.arrows
        ]
        # one entity, with places for its time and, at its end, for its arrows
        empty = foxglove.SceneEntity(foxglove.Timestamp(0, 0), rig.BEAM, "commands")
        entity = _encoded(foxglove.SceneUpdate([], [empty]))
        timed = entity.replace(_stamp_text(0), "%s", 1).replace('"arrows":[],', "")
        self._commands = timed.removesuffix("}]}") + ',"arrows":[%s]}]}'

    def bodies(self, time_ns: int) -> bytes:
        """All parts of the rig and of its ghosts, to be written once (foxglove.SceneUpdate)."""
        parts = self.scene.parts
        entities = [
            _entity(time_ns, frame, frame, [p for p in parts if p.frame == frame], self._about)
            for frame in (rig.BASE, rig.YAW, rig.BEAM)
        ]
        for ghost in self.ghosts:
            frame = f"{ghost}_{rig.BEAM}"
            shape = [_pointer(parts)] if ghost == "estimate" else _inside(parts)
            entities.append(_entity(time_ns, frame, ghost, shape, "", ghost))
        return _encoded(foxglove.SceneUpdate([], entities)).encode()

    def transforms(self, time_ns: int, attitudes: Attitudes) -> bytes:
        """The frames at one time (foxglove.FrameTransforms).

        ``attitudes``: yaw and pitch (rad) of the rig ("") and of ghosts, by prefix
        (``reference_``); what is absent stays where it was.
        """
        stamp, offset = _stamp_text(time_ns), self.scene.offset
        texts = []
        for prefix, (yaw, pitch) in attitudes.items():
            if prefix:
                where = (-offset * math.sin(yaw), offset * math.cos(yaw)) if offset else (0.0, 0.0)
                texts.append(self._ghosts[prefix] % (stamp, *where, *rig.attitude(yaw, pitch)))
            else:
                turned, raised = rig.yaw_rotation(yaw), rig.pitch_rotation(pitch)
                texts.append(self._rig % (stamp, *turned, stamp, *raised))
        return ('{"transforms":[' + ",".join(texts) + "]}").encode()

    def commands(self, time_ns: int, shares: Sequence[float]) -> bytes:
        """Arrows of the commands (foxglove.SceneUpdate).

        ``shares``: each command over its limit, in the order of the scene's arrows; NaN for none.
        """
        texts = []
        for (forth, back, reach), share in zip(self._arrows, shares, strict=True):
            length = reach * min(abs(share), 1.0)
            if not length > 0:  # nor where it is not a number
                continue
            head = min(_HEAD * reach, length)
            texts.append((forth if share > 0 else back) % (length - head, head))
        return (self._commands % (_stamp_text(time_ns), ",".join(texts))).encode()


def log_line(time_ns: int, kind: str, source: str, message: str) -> bytes:
    """An event as a line of Foxglove's log panel (foxglove.Log)."""
    levels = (level for start, level in _LEVELS.items() if kind.startswith(start))
    level = next(levels, foxglove.LogLevel.INFO)
    text = f"{kind}: {message}" if message else kind
    return _encoded(foxglove.Log(_stamp(time_ns), level, text, source)).encode()


def _transform(parent: str, child: str, where: str) -> str:
    """Text of a transform with places for its time and for the four numbers of its rotation."""
    return (
        f'{{"timestamp":%s,"parent_frame_id":"{parent}","child_frame_id":"{child}",'
        f'"translation":{{{where}}},"rotation":{{"x":%.7g,"y":%.7g,"z":%.7g,"w":%.7g}}}}'
    )


def _entity(
    time_ns: int,
    frame: str,
    name: str,
    parts: Sequence[rig.Cylinder | rig.Ring],
    about: str = "",
    ghost: str = "",
) -> foxglove.SceneEntity:
    return foxglove.SceneEntity(
        _stamp(time_ns),
        frame,
        name,
        metadata=[foxglove.KeyValuePair("about", about)] if about else [],
        cylinders=[_cylinder(part, ghost) for part in parts if isinstance(part, rig.Cylinder)],
        lines=[_ring(part, ghost) for part in parts if isinstance(part, rig.Ring)],
    )


def _inside(parts: Sequence[rig.Cylinder | rig.Ring]) -> list[rig.Cylinder | rig.Ring]:
    """The beam a little thinner: hidden in the rig's own while both agree, and not through it."""
    return [
        replace(part, thickness=_GHOST_WIDTH * part.thickness)
        if isinstance(part, rig.Ring)
        else replace(part, radius=_GHOST_WIDTH * part.radius, length=0.98 * part.length)
        for part in parts
        if part.frame == rig.BEAM
    ]


def _pointer(parts: Sequence[rig.Cylinder | rig.Ring]) -> rig.Cylinder:
    """A thin rod along the beam that stands out at both ends: an estimate is hardly ever off."""
    rings = [part for part in parts if isinstance(part, rig.Ring)]
    ends = [part.centre[0] + sign * 1.3 * part.radius for part in rings for sign in (-1, 1)]
    low, high = min(ends), max(ends)
    return rig.Cylinder(
        "estimate",
        rig.BEAM,
        (0.5 * (low + high), 0.0, 0.0),
        (1.0, 0.0, 0.0),
        high - low,
        0.4 * min(part.thickness for part in rings),
        "estimate",
    )


def _cylinder(part: rig.Cylinder, ghost: str) -> foxglove.CylinderPrimitive:
    return foxglove.CylinderPrimitive(
        _pose(part.centre, rig.rotation_onto(part.axis)),
        foxglove.Vector3(2 * part.radius, 2 * part.radius, part.length),
        bottom_scale=1.0,
        top_scale=1.0,
        color=_colour(part.tone, part.opacity, ghost),
    )


def _ring(part: rig.Ring, ghost: str) -> foxglove.LinePrimitive:
    turns = [2 * math.pi * i / _CORNERS for i in range(_CORNERS)]
    corners = [(part.radius * math.cos(t), part.radius * math.sin(t)) for t in turns]
    return foxglove.LinePrimitive(
        foxglove.LineType.LINE_LOOP,
        _pose(part.centre, rig.rotation_onto(part.axis)),
        part.thickness,
        scale_invariant=False,
        points=[foxglove.Point3(round(x, 6), round(y, 6), 0.0) for x, y in corners],
        color=_colour(part.tone, part.opacity, ghost),
    )


def _arrow_text(arrow: rig.Arrow, sign: float) -> str:
    """Text of an arrow with places for the lengths of its shaft and of its head."""
    ax, ay, az = (sign * part for part in arrow.axis)
    # An arrow lies along x: laid along z first, it is then turned like everything else.
    pose = _pose(arrow.foot, _x_onto((ax, ay, az)))
    widths = f'"shaft_diameter":{_SHAFT_WIDTH * arrow.reach!r}'
    head = f'"head_diameter":{_HEAD_WIDTH * arrow.reach!r}'
    return (
        f'{{"pose":{_encoded(pose)},"shaft_length":%.6g,{widths},"head_length":%.6g,{head},'
        f'"color":{_encoded(_colour(arrow.tone, 0.9))}}}'
    )


def _x_onto(axis: rig.Vector) -> rig.Quaternion:
    """The shortest rotation that takes x onto a unit vector."""
    x, y, z = axis
    if x < -1 + 1e-9:
        return (0.0, 0.0, 1.0, 0.0)
    half = math.sqrt(0.5 * (1 + x))
    return (0.0, -z / (2 * half), y / (2 * half), half)


def _colour(tone: str, opacity: float, ghost: str = "") -> foxglove.Color:
    if ghost:
        tone, opacity = ghost, opacity * _GHOST_OPACITY[ghost]
    red, green, blue = rig.TONES[tone]
    return foxglove.Color(red, green, blue, opacity)


def _pose(at: rig.Vector, turned: rig.Quaternion) -> foxglove.Pose:
    return foxglove.Pose(foxglove.Vector3(*at), foxglove.Quaternion(*turned))


def _stamp(time_ns: int) -> foxglove.Timestamp:
    return foxglove.Timestamp(time_ns // _SECOND, time_ns % _SECOND)


def _stamp_text(time_ns: int) -> str:
    return f'{{"sec":{time_ns // _SECOND},"nsec":{time_ns % _SECOND}}}'


def _encoded(message: Struct) -> str:
    content = to_builtins(message)
    return json.dumps(content, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
