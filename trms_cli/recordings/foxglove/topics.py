"""The topics of a log that Foxglove's own panels show, and a layout."""

from __future__ import annotations

from pathlib import Path

from msgspec import Struct

from trms_cli.recordings.foxglove.types import FrameTransforms, Log, SceneUpdate, schema_text
from trms_cli.recordings.topics import EncodedTopic

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
