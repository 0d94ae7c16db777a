"""Foxglove's messages, as far as logs hold them, and the JSON schema of each.

A viewer knows by a schema's name that a message is a scene, a transform or a log line. Names,
fields and numbers are those of Foxglove's documentation, *Foxglove schemas*; a test holds them
against the schemas of the published package ``foxglove-sdk``.
"""

from enum import IntEnum
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import msgspec
import orjson
from msgspec import Meta, Struct, inspect

from trms_cli.recordings.topics import EncodedTopic

Count = Annotated[int, Meta(ge=0)]
Nanoseconds = Annotated[int, Meta(ge=0, le=999_999_999)]


class Timestamp(Struct):
    """Since 1970."""

    sec: Count
    nsec: Nanoseconds


class Duration(Struct):
    """A span; of no length: without an end."""

    sec: int = 0
    nsec: Nanoseconds = 0


class Vector3(Struct):
    """In metres."""

    x: float
    y: float
    z: float


class Point3(Vector3):
    """In metres."""


class Quaternion(Struct):
    """A rotation."""

    x: float
    y: float
    z: float
    w: float


class Color(Struct):
    """Shares of red, green, blue and opacity, from 0 to 1."""

    r: float
    g: float
    b: float
    a: float


class Pose(Struct):
    """Of a body in its frame."""

    position: Vector3
    orientation: Quaternion


class FrameTransform(Struct):
    """Where a frame stands in its parent."""

    timestamp: Timestamp
    parent_frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion


class FrameTransforms(Struct):
    """Several of them at a time."""

    transforms: list[FrameTransform]


class LogLevel(IntEnum):
    """How grave a line is."""

    UNKNOWN, DEBUG, INFO, WARNING, ERROR, FATAL = range(6)


class Log(Struct):
    """A line of the log panel."""

    timestamp: Timestamp
    level: LogLevel
    message: str
    name: str  #: Who says it
    file: str = ""
    line: Count = 0


class KeyValuePair(Struct):
    """A fact that goes along with an entity."""

    key: str
    value: str


class ArrowPrimitive(Struct):
    """An arrow along x."""

    pose: Pose
    shaft_length: float
    shaft_diameter: float
    head_length: float
    head_diameter: float
    color: Color


class CubePrimitive(Struct):
    """A box."""

    pose: Pose
    size: Vector3
    color: Color


class SpherePrimitive(CubePrimitive):
    """An ellipsoid."""


class CylinderPrimitive(Struct):
    """A cylinder or a cone along z."""

    pose: Pose
    size: Vector3
    bottom_scale: float
    top_scale: float
    color: Color


class LineType(IntEnum):
    """How points make lines."""

    LINE_STRIP, LINE_LOOP, LINE_LIST = range(3)


class LinePrimitive(Struct):
    """Lines of one thickness."""

    type: LineType
    pose: Pose
    thickness: float
    scale_invariant: bool
    points: list[Point3]
    color: Color
    colors: list[Color] = []  #: By point, instead of one
    indices: list[Count] = []  #: Of points, instead of their order


class TriangleListPrimitive(Struct):
    """A surface."""

    pose: Pose
    points: list[Point3]
    color: Color
    colors: list[Color]
    indices: list[Count]


class TextPrimitive(Struct):
    """A label."""

    pose: Pose
    billboard: bool
    font_size: float
    scale_invariant: bool
    color: Color
    text: str


class ModelPrimitive(Struct):
    """A body from a file."""

    pose: Pose
    scale: Vector3
    color: Color
    override_color: bool
    url: str
    media_type: str
    data: bytes


class SceneEntity(Struct):
    """A body, made of parts."""

    timestamp: Timestamp
    frame_id: str
    id: str
    lifetime: Duration = msgspec.field(default_factory=Duration)
    frame_locked: bool = True
    metadata: list[KeyValuePair] = []
    arrows: list[ArrowPrimitive] = []
    cubes: list[CubePrimitive] = []
    spheres: list[SpherePrimitive] = []
    cylinders: list[CylinderPrimitive] = []
    lines: list[LinePrimitive] = []
    triangles: list[TriangleListPrimitive] = []
    texts: list[TextPrimitive] = []
    models: list[ModelPrimitive] = []


class SceneEntityDeletionType(IntEnum):
    """Which entities go."""

    MATCHING_ID, ALL = range(2)


class SceneEntityDeletion(Struct):
    """Takes entities out of the scene."""

    timestamp: Timestamp
    type: SceneEntityDeletionType
    id: str


class SceneUpdate(Struct):
    """What changes in the scene."""

    deletions: list[SceneEntityDeletion]
    entities: list[SceneEntity]


#: Foxglove knows these two by their titles, not by their fields.
_TITLES: dict[type, str] = {Timestamp: "time", Duration: "duration"}


@cache
def schema_text(message: type[Struct]) -> bytes:
    """The JSON schema of a message; what is nested stands in its place, as viewers want it."""
    return orjson.dumps(_schema(inspect.type_info(message)))


def _schema(kind: inspect.Type) -> dict[str, Any]:
    match kind:
        case inspect.StructType(cls=cls, fields=fields):
            return {
                "title": _TITLES.get(cls, f"foxglove.{cls.__name__}"),
                "type": "object",
                "properties": {field.encode_name: _schema(field.type) for field in fields},
                "required": [field.encode_name for field in fields],
            }
        case inspect.EnumType(cls=cls):
            values = [{"title": member.name, "const": member.value} for member in cls]
            return {"title": f"foxglove.{cls.__name__}", "oneOf": values}
        case inspect.ListType(item_type=item):
            return {"type": "array", "items": _schema(item)}
        case inspect.IntType(ge=least, le=largest):
            limits = {"minimum": least, "maximum": largest}
            return {"type": "integer"} | {k: v for k, v in limits.items() if v is not None}
        case inspect.BytesType():
            return {"type": "string", "contentEncoding": "base64"}
    plain = {inspect.FloatType: "number", inspect.StrType: "string", inspect.BoolType: "boolean"}
    return {"type": plain[type(kind)]}


TRANSFORMS, BODIES, ARROWS, LOG_LINES = "/tf", "/scene", "/scene/commands", "/log"
#: All that the viewer alone reads.
SCENE_TOPICS = (TRANSFORMS, BODIES, ARROWS, LOG_LINES)
_MESSAGES: dict[str, type[Struct]] = {
    TRANSFORMS: FrameTransforms,
    BODIES: SceneUpdate,
    ARROWS: SceneUpdate,
    LOG_LINES: Log,
}


def encoded_topics() -> list[EncodedTopic]:
    """The viewer's topics: frames, bodies, arrows of the commands, events as log lines."""
    return [
        EncodedTopic(topic, f"foxglove.{message.__name__}", schema_text(message))
        for topic, message in _MESSAGES.items()
    ]


def layout() -> bytes:
    """A layout for these topics and the run's own, to be imported into Foxglove."""
    return Path(__file__).with_name("layout.json").read_bytes()
