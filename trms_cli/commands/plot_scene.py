"""``trms plot LOG --what scene``: the rig in space at a moment, or its motion as a GIF."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any

from trms_cli.commands.scene_of_log import scene_of_log
from trms_cli.core.errors import EXIT_OK, ConfigurationError
from trms_cli.recordings.foxglove.added_scene import scene_messages
from trms_cli.recordings.foxglove.topics import ARROWS, BODIES, TRANSFORMS
from trms_cli.recordings.log_reader import LoggedRun

#: Of a GIF: seconds between its frames, and how many there are at most (beyond, it runs faster).
_PAUSE, _MOST_FRAMES = 0.1, 150


def plot_scene(log: LoggedRun, given: Any) -> int:
    """Draw, write and tell; the exit code.

    Raises
    ------
    ConfigurationError
        For options that a scene does not have.
    RecordingError
        For a log without an angle, or a file that exists.
    """
    from trms_cli.commands.plot import ending_of, write_all
    from trms_cli.reporting.plot import size_of
    from trms_cli.reporting.scene_picture import animated, draw_scene
    from trms_cli.reporting.style import figure_bytes, house_style

    format_: Any = given.format or ending_of(given.out) or "png"
    if given.names:
        raise ConfigurationError("a scene has one log", where="--names", remedy="leave it out")
    out = given.out
    if out is None or not ending_of(out):
        folder = log.path.parent if out is None else out
        out = folder / f"{log.path.stem}-scene.{format_}"
    bodies, shots = shots_of(log, given.start, given.end, moving=format_ == "gif")
    speed = 1.0
    if format_ == "gif":
        content = animated(bodies, shots, pause=_PAUSE)
        if len(shots) > 1:
            speed = (shots[-1].time - shots[0].time) / ((len(shots) - 1) * _PAUSE)
    else:
        width, _ = size_of(given.width or "120mm", given.style)
        figure = draw_scene(bodies, shots[0], width=width, style=given.style, title=given.title)
        with house_style(given.style, svg_text=given.svg_text):
            content = figure_bytes(figure, format_, given.dpi)
    write_all([(out, content)], force=given.force)
    if given.json:
        document = {
            "schema": "trms.plot/1",
            "logs": [str(log.path)],
            "files": [str(out)],
            "absent": {},
            "frames": len(shots),
            "speed": round(speed, 3),
        }
        json.dump(document, sys.stdout, indent=2, ensure_ascii=False)
        sys.stdout.write("\n")
        return EXIT_OK
    print(out if abs(speed - 1) < 0.05 else f"{out} ({speed:.3g} times as fast as the run)")
    return EXIT_OK


def shots_of(
    log: LoggedRun, start: float | None, end: float | None, *, moving: bool
) -> tuple[dict[str, Any], Sequence[Any]]:
    """The bodies, and moments of a log as its messages tell them.

    Parameters
    ----------
    log : LoggedRun
    start, end : float, optional
        The window, s; the whole log by default, and for a still its middle.
    moving : bool
        Many moments, or the one at the start.
    """
    from trms_cli.reporting.scene_picture import Shot

    scene = scene_of_log(log)
    every = scene.every(_PAUSE if moving else 0.0)
    bodies: dict[str, Any] = {}
    transforms: dict[int, bytes] = {}
    commands: dict[int, bytes] = {}
    for topic, time_ns, data in scene_messages(log, scene.encoder, scene.sources, every):
        if topic == BODIES:
            bodies = json.loads(data)
        elif topic == TRANSFORMS:
            transforms[time_ns] = data
        elif topic == ARROWS:
            commands[time_ns] = data
    times = sorted(transforms)
    if not times:
        raise ConfigurationError("the log has no sample", where=str(log.path), remedy="repeat it")
    low = times[0] if start is None else round(start * 1e9)
    high = times[-1] if end is None else round(end * 1e9)
    if not moving:
        at = (times[0] + times[-1]) // 2 if start is None else low
        chosen = [min(times, key=lambda time_ns: abs(time_ns - at))]
    else:
        chosen = [time_ns for time_ns in times if low <= time_ns <= high]
    if not chosen or not times[0] <= low <= times[-1]:
        raise ConfigurationError(
            "the log has no sample there",
            where="--from, --to",
            remedy=f"it goes from {times[0] / 1e9:g} to {times[-1] / 1e9:g} s",
        )
    chosen = chosen[:: -(-len(chosen) // _MOST_FRAMES)]
    return bodies, [
        Shot(time / 1e9, json.loads(transforms[time]), json.loads(commands[time]))
        for time in chosen
    ]
