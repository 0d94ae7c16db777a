"""The topics of a log that Foxglove's own panels show, with Foxglove's own schemas, and a layout.

The schemas travel in the log as they are published (``schemas/LICENSE`` tells from where), because
Foxglove knows by a schema's name that a message is a scene, a transform or a log line.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

from trms_cli.recordings.topics import EncodedTopic

TRANSFORMS, BODIES, ARROWS, LOG_LINES = "/tf", "/scene", "/scene/commands", "/log"
#: All that the viewer alone reads.
SCENE_TOPICS = (TRANSFORMS, BODIES, ARROWS, LOG_LINES)
_SCHEMAS = {
    TRANSFORMS: "FrameTransforms",
    BODIES: "SceneUpdate",
    ARROWS: "SceneUpdate",
    LOG_LINES: "Log",
}


def encoded_topics() -> list[EncodedTopic]:
    """The viewer's topics: frames, bodies, arrows of the commands, events as log lines."""
    return [
        EncodedTopic(topic, f"foxglove.{schema}", schema_text(schema))
        for topic, schema in _SCHEMAS.items()
    ]


@cache
def schema_text(name: str) -> bytes:
    """The published JSON schema of a message: ``SceneUpdate``."""
    return Path(__file__).with_name("schemas").joinpath(f"{name}.json").read_bytes().rstrip()


def layout() -> bytes:
    """A layout for these topics and the run's own, to be imported into Foxglove."""
    return Path(__file__).with_name("layout.json").read_bytes()
