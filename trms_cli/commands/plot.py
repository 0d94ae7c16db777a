"""``trms plot``: figures of logs for papers, slides and pages."""

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from trms_cli.commands.plain_options import PlainOptions
from trms_cli.core.errors import EXIT_OK, ConfigurationError, RecordingError
from trms_cli.core.invocation import program
from trms_cli.core.printable import print_json
from trms_cli.library.tasks.scene import scene_of_log
from trms_cli.recordings.foxglove.scene_log import scene_messages
from trms_cli.recordings.foxglove.types import ARROWS, BODIES, TRANSFORMS
from trms_cli.recordings.log_reader import LoggedRun, read_log
from trms_cli.runs.run_folder import LOG_NAME, log_of

SUMMARY = "figures of logs for a paper, slides or a page: PNG, SVG, PDF"

HELP = """\
usage: trms plot LOG… [--what KIND,KIND…] [--format png|svg|pdf] [--out FILE|FOLDER]

Draws logs: one is drawn with its reference and estimate, several are laid over each other and
named by what they differ in. Units stand on the axes, letters have the size they are printed
with, colours can be told apart by everybody and curves also without colour. The same logs give
the same bytes; nothing is overwritten unless told so.

  LOG              MCAP logs of trms, or folders of runs
  --what KINDS     tracking    what was asked and what the rig did
                   errors      reference minus what the rig did
                   inputs      the commands as applied
                   rates       how fast the axes and the rotors turn
                   estimate    estimated minus true, with two standard deviations;
                               innovations where nobody knows the truth
                   phase       rate over angle
                   prediction  what the controller foretold, over what came
                   solver      time of each step against its deadline, iterations
                   torques     torques that the observer estimates
                   comparison  scores beside each other (several logs)
                   scene       the rig in space (one log; --from: the moment; GIF: the motion)
                   (default: tracking,inputs)
  --format NAME    png, svg, pdf (default: what the ending of --out tells, else pdf); gif for
                   scene alone
  --out PLACE      a file: all kinds in one figure. A folder: one file a kind. (default: one
                   file beside LOG; with several logs, in the working directory)
  --width SIZE     89mm (a column), 183mm (a page; default), 12cm, 120x80mm (with the height)
  --style NAME     paper (default): 7.5 points; screen: 9; slides: 16
  --from S --to S  what is drawn of the run, s
  --title TEXT     over the figure
  --names A,B,…    names of the logs, in their order
  --dpi N          dots per inch of a PNG (default: 300; 110 with --style screen)
  --svg-text       letters of an SVG as text instead of outlines
  --force          replace files that exist
  --json           print what was written, and what could not be drawn, as JSON

examples
  trms plot outputs/…/run.mcap
  trms plot run.mcap --what tracking,errors,inputs --width 89mm --out figure2.pdf
  trms plot pid lqr newton_mpc --what tracking,comparison --format svg
  trms plot run.mcap --what prediction --from 8 --to 16 --style slides --format png
  trms plot run.mcap --what scene --from 9.5 --out pose.png
"""

SCENE = "scene"
#: Options by the arguments of what draws.
_TYPED = {
    "what": "--what",
    "start, end": "--from, --to",
    "width": "--width",
    "names": "--names",
    "style": "--style",
    "logs": "LOG",
}


def main(argv: list[str]) -> int:
    """Run the command; return the exit code."""
    arguments = _options(argv)
    try:
        return _main(arguments)
    except ConfigurationError as error:
        # What draws names its arguments; at a terminal they are options.
        error.where = _TYPED.get(error.where, error.where)
        if error.where == "--what" and SCENE not in error.remedy:
            error.remedy += f", {SCENE}"
        raise


def _main(arguments: Any) -> int:
    paths = [_log_of(path) for path in arguments.logs]
    kinds = [word.strip() for word in arguments.what.split(",") if word.strip()]
    if SCENE in kinds:
        if kinds != [SCENE] or len(paths) > 1:
            raise ConfigurationError(
                "a scene is a figure of its own, of one log",
                where="--what",
                remedy="trms plot LOG --what scene",
            )
        return plot_scene(read_log(paths[0]), arguments)
    files, absent = _plot([read_log(path) for path in paths], kinds, arguments)
    if arguments.json:
        document = {
            "schema": "trms.plot/1",
            "logs": [str(path) for path in paths],
            "files": [str(path) for path in files],
            "absent": absent,
        }
        print_json(document)
        return EXIT_OK
    for kind, reason in absent.items():
        print(f"no {kind}: {reason}")
    for path in files:
        print(path)
    return EXIT_OK


def _log_of(path: Path) -> Path:
    """The log that is meant; raises RecordingError for a folder that is not a run's."""
    log = log_of(path)
    if not log.is_dir():
        return log
    below = sorted(each for each in path.glob(f"*/{LOG_NAME}"))
    if below:
        some = " ".join(shlex.quote(str(each.parent)) for each in below[:2])
        raise RecordingError(
            f"it is the folder of {len(below)} runs, and a plot is of logs",
            where=str(path),
            remedy=f"name the runs: {program()} plot {some}; or draw all of them on a page: "
            f"{program()} report {shlex.quote(str(path))}",
        )
    raise RecordingError(
        f"there is no {LOG_NAME} in this folder",
        where=str(path),
        remedy=f"name a log or the folder of a run; {program()} runs lists them",
    )


def _options(argv: Sequence[str]) -> Any:
    options = PlainOptions("trms plot", HELP)
    options.add_argument("logs", type=Path, nargs="+", metavar="LOG")
    options.add_argument("--what", default="tracking,inputs")
    options.add_argument("--format", choices=("png", "svg", "pdf", "gif"))
    options.add_argument("--out", type=Path)
    options.add_argument("--width")
    options.add_argument("--style", choices=("paper", "slides", "screen"), default="paper")
    options.add_argument("--from", dest="start", type=float)
    options.add_argument("--to", dest="end", type=float)
    options.add_argument("--title", default="")
    options.add_argument("--names")
    options.add_argument("--dpi", type=float)
    options.add_flags("--svg-text", "--force", "--json")
    arguments = options.parse_args(argv)
    if arguments.dpi is not None and not 30 <= arguments.dpi <= 1200:
        options.error("--dpi takes 30 to 1200")
    if arguments.dpi is None:
        arguments.dpi = 110 if arguments.style == "screen" else 300
    return arguments


def _plot(
    logs: Sequence[LoggedRun], kinds: Sequence[str], arguments: Any
) -> tuple[list[Path], dict[str, str]]:
    """Draw; the files, and why what of the kinds was left out."""
    from trms_cli.reporting.plot import absences, plot
    from trms_cli.reporting.style import FORMATS, figure_bytes, house_style

    names = arguments.names.split(",") if arguments.names else None
    choose: Any = {
        "width": arguments.width,
        "style": arguments.style,
        "start": arguments.start,
        "end": arguments.end,
        "title": arguments.title,
        "names": names,
    }
    format_ = arguments.format or ending_of(arguments.out) or "pdf"
    if format_ not in FORMATS:
        raise ConfigurationError(
            f"a plot over time is no {format_}",
            where="--format",
            remedy=f"one of {', '.join(FORMATS)}",
        )
    absent = absences(logs, kinds, start=arguments.start, end=arguments.end)
    there = [kind for kind in kinds if kind not in absent]
    one_file = arguments.out is None or bool(ending_of(arguments.out))
    groups = [there or kinds] if one_file else [[kind] for kind in there or kinds]
    # All are drawn before the first is written: nothing is left half done by what cannot be drawn.
    files = []
    for group in groups:
        figure = plot(logs, group, **choose)
        with house_style(arguments.style, svg_text=arguments.svg_text):
            content = figure_bytes(figure, format_, arguments.dpi)
        files.append((_place(logs, group, format_, arguments.out), content))
    write_all(files, force=arguments.force)
    return [path for path, _ in files], absent


def write_all(files: Sequence[tuple[Path, bytes]], *, force: bool) -> None:
    """Write files, each whole or not at all, and none if one of them exists already."""
    from trms_cli.core.whole_file import refuse_overwrite, whole_file

    for path, _ in files:
        if not force:
            refuse_overwrite(path, "give another name with --out, or --force to replace it")
    for path, content in files:
        with whole_file(path, force=force) as temporary:
            temporary.write_bytes(content)


def ending_of(out: Path | None) -> str:
    """The format that a file's name asks for; empty for a folder's.

    Raises ConfigurationError for an ending that is no format.
    """
    if out is None or out.is_dir() or not out.suffix:
        return ""
    ending = out.suffix.lower().lstrip(".")
    if ending not in ("png", "svg", "pdf", "gif"):
        raise ConfigurationError(
            f"a figure is no {out.suffix}", where="--out", remedy="end in .png, .svg or .pdf"
        )
    return ending


def _place(logs: Sequence[LoggedRun], kinds: Sequence[str], format_: str, out: Path | None) -> Path:
    if out is not None and ending_of(out):
        return out
    name = f"{'-'.join(kinds)}.{format_}"
    if out is not None:
        return out / name
    if len(logs) > 1:
        return Path(name)
    return logs[0].path.with_name(f"{logs[0].path.stem}-{name}")


#: Of a GIF: seconds between its frames, and how many there are at most (beyond, it runs faster).
_PAUSE, _MOST_FRAMES = 0.1, 150


def plot_scene(log: LoggedRun, arguments: Any) -> int:
    """Draw, write and tell; the exit code.

    Raises ConfigurationError for options that a scene does not have, RecordingError for a log
    without an angle, or a file that exists.
    """
    from trms_cli.reporting.plot import size_of
    from trms_cli.reporting.scene_picture import animate_scene, draw_scene
    from trms_cli.reporting.style import figure_bytes, house_style

    format_: Any = arguments.format or ending_of(arguments.out) or "png"
    if arguments.names:
        raise ConfigurationError("a scene has one log", where="--names", remedy="leave it out")
    out = arguments.out
    if out is None or not ending_of(out):
        folder = log.path.parent if out is None else out
        out = folder / f"{log.path.stem}-scene.{format_}"
    bodies, shots = shots_of(log, arguments.start, arguments.end, moving=format_ == "gif")
    speed = 1.0
    if format_ == "gif":
        content = animate_scene(bodies, shots, pause=_PAUSE)
        if len(shots) > 1:
            speed = (shots[-1].time - shots[0].time) / ((len(shots) - 1) * _PAUSE)
    else:
        width, _ = size_of(arguments.width or "120mm", arguments.style)
        figure = draw_scene(
            bodies, shots[0], width=width, style=arguments.style, title=arguments.title
        )
        with house_style(arguments.style, svg_text=arguments.svg_text):
            content = figure_bytes(figure, format_, arguments.dpi)
    write_all([(out, content)], force=arguments.force)
    if arguments.json:
        document = {
            "schema": "trms.plot/1",
            "logs": [str(log.path)],
            "files": [str(out)],
            "absent": {},
            "frames": len(shots),
            "speed": round(speed, 3),
        }
        print_json(document)
        return EXIT_OK
    print(out if abs(speed - 1) < 0.05 else f"{out} ({speed:.3g} times as fast as the run)")
    return EXIT_OK


def shots_of(
    log: LoggedRun, start: float | None, end: float | None, *, moving: bool
) -> tuple[dict[str, Any], Sequence[Any]]:
    """The bodies, and moments of a log as its messages tell them, between `start` and `end` (s).

    `moving`: many moments; else the one at the start, without it the middle of the log.
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
        shot_times = [min(times, key=lambda time_ns: abs(time_ns - at))]
    else:
        shot_times = [time_ns for time_ns in times if low <= time_ns <= high]
    if not shot_times or not times[0] <= low <= times[-1]:
        raise ConfigurationError(
            "the log has no sample there",
            where="--from, --to",
            remedy=f"it goes from {times[0] / 1e9:g} to {times[-1] / 1e9:g} s",
        )
    shot_times = shot_times[:: -(-len(shot_times) // _MOST_FRAMES)]
    return bodies, [
        Shot(time / 1e9, json.loads(transforms[time]), json.loads(commands[time]))
        for time in shot_times
    ]
