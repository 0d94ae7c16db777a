"""``trms export``: a run's MCAP log as CSV, Parquet or MAT, or with a 3D view for Foxglove."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.commands.plain_options import PlainOptions
from trms_cli.core.printable import print_json
from trms_cli.runs.run_folder import log_of

if TYPE_CHECKING:
    from trms_cli.recordings.log_reader import LoggedRun

SUMMARY = "turn an MCAP log into CSV, Parquet or MAT; add the 3D view for Foxglove"

FORMATS = ("csv", "parquet", "mat", "foxglove")
#: Seconds between two poses of an added 3D view: more than a screen shows smoothly.
_POSE_EVERY = 0.04

HELP = """\
usage: trms export LOG [--format csv|parquet|mat|foxglove] [--out FILE] [--force] [--json]
       trms export --layout FILE [--force]

Writes a run's log for programs that read no MCAP, or again as MCAP with the 3D view of the rig,
which imported recordings and older logs lack. The log of a run that died is written as
far as it goes. The file appears when it is whole; nothing is overwritten unless told so.

  LOG            an MCAP log of trms, or the folder of a run
  --format NAME  csv      inputs, outputs and references on the sample grid, as `trms import`
                          and `plant=replay` read it
                 parquet  one wide table of all topics, a row per sample time, columns
                          topic.field, units in the fields' metadata; events as lists
                 mat      a struct per topic, units beside the values
                 foxglove the same log with the rig's body, its poses and the commands as
                          arrows, for Foxglove's 3D panel (a MCAP file again)
                 (default: what the ending of --out tells, else csv)
  --out FILE     where to write (default: beside LOG, with the format's ending;
                 run.foxglove.mcap)
  --layout FILE  write the layout for Foxglove: 3D view, plots, modes, events
  --force        replace FILE if it exists
  --json         print what was written as JSON

examples
  trms export outputs/2025-01-31/run.mcap
  trms export run.mcap --format parquet
  trms export run.mcap --out for_matlab.mat --force
  trms export imported.mcap --format foxglove --layout trms.json
"""


def main(argv: list[str]) -> int:
    """Run the command; return the exit code."""
    options = PlainOptions("trms export", HELP)
    options.add_argument("log", type=Path, nargs="?")
    options.add_argument("--format", choices=FORMATS)
    options.add_argument("--out", type=Path)
    options.add_argument("--layout", type=Path)
    options.add_flags("--force", "--json")
    arguments = options.parse_args(argv)
    if arguments.log is None and arguments.layout is None:
        options.error("the following arguments are required: LOG")
    if arguments.layout is not None:
        _write_layout(arguments.layout, force=arguments.force)
        if arguments.log is None:
            if arguments.json:
                print(json.dumps({"schema": "trms.export/1", "layout": str(arguments.layout)}))
            else:
                print(f"layout: {arguments.layout} (in Foxglove: Layout, Import from file)")
            return 0
    arguments.log = log_of(arguments.log)
    format_ = arguments.format or _format_of(arguments.out)
    ending = "foxglove.mcap" if format_ == "foxglove" else format_
    out = arguments.out or arguments.log.with_suffix(f".{ending}")

    from trms_cli.recordings.export import export_log
    from trms_cli.recordings.log_reader import read_log

    log = read_log(arguments.log)
    poses = None
    if format_ == "foxglove":
        poses = _add_scene(log, out, force=arguments.force)
    else:
        export_log(log, out, format_, force=arguments.force)

    topics = {name: len(table) for name, table in log.tables.items() if len(table)}
    if arguments.json:
        document: dict[str, Any] = {
            "schema": "trms.export/1",
            "log": str(arguments.log),
            "complete": log.complete,
            "problems": list(log.problems),
            "format": format_,
            "file": str(out),
            "duration_s": log.duration_s,
            "topics": topics,
        }
        if poses is not None:
            document["poses"] = poses
        if arguments.layout is not None:
            document["layout"] = str(arguments.layout)
        print_json(document)
        return 0
    for problem in log.problems:
        print(f"note: {arguments.log}: {problem}")
    messages = ", ".join(f"{count} of {name}" for name, count in topics.items())
    print(f"{arguments.log}: {log.duration_s:.6g} s; messages: {messages}")
    print(f"{format_}: {out}" + ("" if poses is None else f" ({poses} poses)"))
    if arguments.layout is not None:
        print(f"layout: {arguments.layout} (in Foxglove: Layout, Import from file)")
    elif poses is not None:
        print("layout: trms export --layout trms.json writes one for Foxglove")
    return 0


def _add_scene(log: LoggedRun, out: Path, *, force: bool) -> int:
    """Write the log with a 3D view; the number of poses."""
    from trms_cli.library.tasks.scene import scene_of_log
    from trms_cli.recordings.foxglove.scene_log import write_with_scene

    scene = scene_of_log(log)
    every = scene.every(_POSE_EVERY)
    return write_with_scene(log, scene.encoder, scene.sources, every, out, force=force)


def _write_layout(path: Path, *, force: bool) -> None:
    from trms_cli.core.whole_file import whole_file
    from trms_cli.recordings.foxglove.types import layout

    with whole_file(path, force=force) as temporary:
        temporary.write_bytes(layout())


def _format_of(out: Path | None) -> str:
    ending = out.suffix.lower().lstrip(".") if out else ""
    if ending == "mcap":
        return "foxglove"
    return ending if ending in FORMATS else "csv"
