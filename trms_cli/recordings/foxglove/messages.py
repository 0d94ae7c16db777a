"""Encodes a scene and its poses as Foxglove's messages, in JSON.

A run writes thousands of poses, so that their text is laid out once and only numbers are put into
it. The bodies stand in one message at the beginning; commands are arrows of a topic of their own,
because a viewer that jumps within a recording shows each topic's last message before that time.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from trms_cli.core.scene import (
    BASE,
    BEAM,
    GHOSTS,
    TONES,
    YAW,
    Arrow,
    Cylinder,
    Quaternion,
    Ring,
    Scene,
    Vector,
    attitude,
    pitch_rotation,
    rotation_onto,
    yaw_rotation,
)

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
    "fault_removed": 2,
    "fault_end": 2,
    "fault": 4,
    "solver": 3,
    "landing_begin": 4,
    "degraded_begin": 3,
    "outlier": 3,
    "gap": 3,
}
#: What an entity of arrows has besides them.
_ENTITY = (
    f'"frame_id":"{BEAM}","id":"commands","lifetime":{{"sec":0,"nsec":0}},"frame_locked":true,'
    '"metadata":[],"cubes":[],"spheres":[],"cylinders":[],"lines":[],"triangles":[],"texts":[],'
    '"models":[]'
)


class SceneEncoder:
    """Messages of one rig.

    Parameters
    ----------
    scene : Scene
    ghosts : sequence of str
        Of :data:`~trms_cli.core.scene.GHOSTS`: those that the run has.
    about : str
        A sentence that goes along with the bodies.
    """

    def __init__(self, scene: Scene, ghosts: Sequence[str] = GHOSTS, about: str = "") -> None:
        self.scene = scene
        self.ghosts = tuple(ghosts)
        self._about = about
        self._rig = (
            _transform(BASE, YAW, f'"x":0,"y":0,"z":{scene.height!r}')
            + ","
            + _transform(YAW, BEAM, f'"x":0,"y":{scene.offset!r},"z":0')
        )
        where = f'"x":%.7g,"y":%.7g,"z":{scene.height!r}'
        self._ghosts = {
            f"{ghost}_": _transform(BASE, f"{ghost}_{BEAM}", where) for ghost in self.ghosts
        }
        self._arrows = [
            (_arrow_text(arrow, 1.0), _arrow_text(arrow, -1.0), arrow.reach)
            for arrow in scene.arrows
        ]

    def bodies(self, time_ns: int) -> bytes:
        """All parts of the rig and of its ghosts, to be written once (foxglove.SceneUpdate)."""
        parts = self.scene.parts
        entities = [
            _entity(time_ns, frame, frame, [p for p in parts if p.frame == frame], self._about)
            for frame in (BASE, YAW, BEAM)
        ]
        for ghost in self.ghosts:
            frame = f"{ghost}_{BEAM}"
            shape = [_pointer(parts)] if ghost == "estimate" else _inside(parts)
            entities.append(_entity(time_ns, frame, ghost, shape, "", ghost))
        return _encoded({"deletions": [], "entities": entities})

    def transforms(self, time_ns: int, attitudes: Attitudes) -> bytes:
        """The frames at one time (foxglove.FrameTransforms).

        Parameters
        ----------
        time_ns : int
        attitudes : dict of str to (float, float)
            Yaw and pitch (rad) of the rig ("") and of ghosts, by prefix (``reference_``); what is
            absent stays where it was.
        """
        stamp, offset = _stamp_text(time_ns), self.scene.offset
        texts = []
        for prefix, (yaw, pitch) in attitudes.items():
            if prefix:
                where = (-offset * math.sin(yaw), offset * math.cos(yaw)) if offset else (0.0, 0.0)
                texts.append(self._ghosts[prefix] % (stamp, *where, *attitude(yaw, pitch)))
            else:
                turned, raised = yaw_rotation(yaw), pitch_rotation(pitch)
                texts.append(self._rig % (stamp, *turned, stamp, *raised))
        return ('{"transforms":[' + ",".join(texts) + "]}").encode()

    def commands(self, time_ns: int, shares: Sequence[float]) -> bytes:
        """Arrows of the commands (foxglove.SceneUpdate).

        Parameters
        ----------
        time_ns : int
        shares : sequence of float
            Each command over its limit, in the order of the scene's arrows; NaN for none.
        """
        texts = []
        for (forth, back, reach), share in zip(self._arrows, shares, strict=True):
            length = reach * min(abs(share), 1.0)
            if not length > 0:  # nor where it is not a number
                continue
            head = min(_HEAD * reach, length)
            texts.append((forth if share > 0 else back) % (length - head, head))
        return (
            f'{{"deletions":[],"entities":[{{"timestamp":{_stamp_text(time_ns)},{_ENTITY},'
            f'"arrows":[{",".join(texts)}]}}]}}'
        ).encode()


def log_line(time_ns: int, kind: str, source: str, message: str) -> bytes:
    """An event as a line of Foxglove's log panel (foxglove.Log)."""
    level = next((n for start, n in _LEVELS.items() if kind.startswith(start)), 2)
    return _encoded(
        {
            "timestamp": _stamp(time_ns),
            "level": level,
            "message": f"{kind}: {message}" if message else kind,
            "name": source,
            "file": "",
            "line": 0,
        }
    )


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
    parts: Sequence[Cylinder | Ring],
    about: str = "",
    ghost: str = "",
) -> dict[str, Any]:
    cylinders = [_cylinder(part, ghost) for part in parts if isinstance(part, Cylinder)]
    lines = [_ring(part, ghost) for part in parts if isinstance(part, Ring)]
    return {
        "timestamp": _stamp(time_ns),
        "frame_id": frame,
        "id": name,
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": True,
        "metadata": [{"key": "about", "value": about}] if about else [],
        "arrows": [],
        "cubes": [],
        "spheres": [],
        "cylinders": cylinders,
        "lines": lines,
        "triangles": [],
        "texts": [],
        "models": [],
    }


def _inside(parts: Sequence[Cylinder | Ring]) -> list[Cylinder | Ring]:
    """The beam a little thinner: hidden in the rig's own while both agree, and not through it."""
    return [
        replace(part, thickness=_GHOST_WIDTH * part.thickness)
        if isinstance(part, Ring)
        else replace(part, radius=_GHOST_WIDTH * part.radius, length=0.98 * part.length)
        for part in parts
        if part.frame == BEAM
    ]


def _pointer(parts: Sequence[Cylinder | Ring]) -> Cylinder:
    """A thin rod along the beam that stands out at both ends: an estimate is hardly ever off."""
    rings = [part for part in parts if isinstance(part, Ring)]
    ends = [part.centre[0] + sign * 1.3 * part.radius for part in rings for sign in (-1, 1)]
    low, high = min(ends), max(ends)
    return Cylinder(
        "estimate", BEAM, (0.5 * (low + high), 0.0, 0.0), (1.0, 0.0, 0.0), high - low,
        0.4 * min(part.thickness for part in rings), "estimate",
    )  # fmt: skip


def _cylinder(part: Cylinder, ghost: str) -> dict[str, Any]:
    return {
        "pose": _pose(part.centre, rotation_onto(part.axis)),
        "size": _xyz((2 * part.radius, 2 * part.radius, part.length)),
        "bottom_scale": 1.0,
        "top_scale": 1.0,
        "color": _colour(part.tone, part.opacity, ghost),
    }


def _ring(part: Ring, ghost: str) -> dict[str, Any]:
    turns = [2 * math.pi * i / _CORNERS for i in range(_CORNERS)]
    corners = [(part.radius * math.cos(t), part.radius * math.sin(t), 0.0) for t in turns]
    return {
        "type": 1,  # closed
        "pose": _pose(part.centre, rotation_onto(part.axis)),
        "thickness": part.thickness,
        "scale_invariant": False,
        "points": [_xyz((round(x, 6), round(y, 6), z)) for x, y, z in corners],
        "color": _colour(part.tone, part.opacity, ghost),
        "colors": [],
        "indices": [],
    }


def _arrow_text(arrow: Arrow, sign: float) -> str:
    """Text of an arrow with places for the lengths of its shaft and of its head."""
    ax, ay, az = (sign * part for part in arrow.axis)
    # An arrow lies along x: laid along z first, it is then turned like everything else.
    pose = _pose(arrow.foot, _x_onto((ax, ay, az)))
    widths = f'"shaft_diameter":{_SHAFT_WIDTH * arrow.reach!r}'
    head = f'"head_diameter":{_HEAD_WIDTH * arrow.reach!r}'
    colour = json.dumps(_colour(arrow.tone, 0.9), separators=(",", ":"))
    text = json.dumps(pose, separators=(",", ":"))
    return (
        f'{{"pose":{text},"shaft_length":%.6g,{widths},"head_length":%.6g,{head},"color":{colour}}}'
    )


def _x_onto(axis: Vector) -> Quaternion:
    """The shortest rotation that takes x onto a unit vector."""
    x, y, z = axis
    if x < -1 + 1e-9:
        return (0.0, 0.0, 1.0, 0.0)
    half = math.sqrt(0.5 * (1 + x))
    return (0.0, -z / (2 * half), y / (2 * half), half)


def _colour(tone: str, opacity: float, ghost: str = "") -> dict[str, float]:
    if ghost:
        tone, opacity = ghost, opacity * _GHOST_OPACITY[ghost]
    red, green, blue = TONES[tone]
    return {"r": red, "g": green, "b": blue, "a": opacity}


def _pose(at: Vector, turned: Quaternion) -> dict[str, Any]:
    x, y, z, w = turned
    return {"position": _xyz(at), "orientation": {"x": x, "y": y, "z": z, "w": w}}


def _xyz(vector: Vector) -> dict[str, float]:
    x, y, z = vector
    return {"x": x, "y": y, "z": z}


def _stamp(time_ns: int) -> dict[str, int]:
    return {"sec": time_ns // _SECOND, "nsec": time_ns % _SECOND}


def _stamp_text(time_ns: int) -> str:
    return f'{{"sec":{time_ns // _SECOND},"nsec":{time_ns % _SECOND}}}'


def _encoded(message: Mapping[str, Any]) -> bytes:
    return json.dumps(message, separators=(",", ":"), allow_nan=False, ensure_ascii=False).encode()
