"""``trms watch``: a run or a sweep as it goes on, or a finished run once more."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.commands.plain_options import PlainOptions
from trms_cli.core.errors import EXIT_OK, EXIT_WORSE, ConfigurationError, RecordingError
from trms_cli.core.invocation import program

if TYPE_CHECKING:
    from trms_cli.runs.follower import RunFollower
    from trms_cli.sweeps.outcome import SweepFollower

SUMMARY = "a run or a sweep as it goes on, or a finished run replayed"

HELP = """\
usage: trms watch [LOG|FOLDER] [--speed N] [--from T] [--span T] [--once] [--plain]
       trms watch --gap [LOG|FOLDER] [--json]

Shows a run while it goes on: reference, angle and estimate of each axis, errors, commands and
their limits, the solver's time against its deadline, what the supervisor says, and what happens.
It only reads the log. A run that has ended is shown once more, as fast as it was.

  LOG|FOLDER   a log, the folder of a run, or that of a sweep; of any other folder the latest run
               in it that is going on, else the latest one. Without it: the working folder.
  --speed N    replay N times as fast as the run's own time (1)
  --from T     replay from T seconds on
  --span T     seconds that the curves show (20)
  --once       print what there is now, and end
  --plain      without Unicode
  --gap        compare the rig with the log's own model in place of the picture, as fast as it can
               be read: what has changed, since when, by how much (docs/gap-watch.md)
  --json       with --gap: what there was to say as JSON, once the log has ended

keys
  q  quit      space  pause      left, right  5 s back, forward      home  to the beginning
  + -  twice, half the speed of a replay       end  to the latest sample; follows a run that goes on

  Into a file or a pipe it writes one line a second instead.

exit code
  0; 1 if the run or the sweep that was watched to its end did not end well

examples
  trms watch                                   in a second terminal, while `trms run` is running
  trms watch outputs/2026-11-22/sweep          how far a sweep is, its best and its failed jobs
  trms watch outputs/…/run.mcap --speed 4      a finished run, four times as fast
  trms watch run.mcap --once --from 30         one picture, of 30 s
  trms watch --gap run.mcap                    since when is the rig not what its model says?
"""


def main(argv: list[str]) -> int:
    """Run the command; return the exit code."""
    arguments = _parse_arguments(argv)
    from trms_cli.sweeps.outcome import SweepFollower

    what = _target(arguments.what)
    if arguments.gap:
        return _watch_gap(what, arguments)
    if what.is_dir():
        for option, value in (("--speed", arguments.speed), ("--from", arguments.begin)):
            if value is not None:
                raise ConfigurationError(
                    "this is the folder of a sweep, which is not replayed",
                    where=option,
                    remedy=f"name one of its runs: {what}/0",
                )
        return _watch_sweep(SweepFollower(what), arguments)
    return _watch_run(what, arguments)


def _parse_arguments(argv: list[str]) -> Any:
    options = PlainOptions("trms watch", HELP)
    options.add_argument("what", nargs="?", type=Path, metavar="LOG|FOLDER")
    options.add_argument("--speed", type=float)
    options.add_argument("--from", type=float, dest="begin")
    options.add_argument("--span", type=float, default=20.0)
    options.add_flags("--once", "--plain", "--gap", "--json")
    arguments = options.parse_args(argv)
    if arguments.json and not arguments.gap:
        raise ConfigurationError(
            "only what --gap has to say is there as JSON",
            where="--json",
            remedy=f"{program()} watch --gap LOG --json; of a run: {program()} score LOG --json",
        )
    for name, value, low in (("--speed", arguments.speed, 0.0), ("--span", arguments.span, 0.0)):
        if value is not None and not low < value < 1e6:
            raise ConfigurationError(f"{value:g} given", where=name, remedy="a number above 0")
    if arguments.begin is not None and not 0.0 <= arguments.begin < math.inf:
        raise ConfigurationError(
            f"{arguments.begin:g} given", where="--from", remedy="seconds of the run, from 0 on"
        )
    return arguments


def _target(what: Path | None) -> Path:
    """The log, or the folder of the sweep, that is meant."""
    from trms_cli.runs.query import latest_run
    from trms_cli.runs.run_folder import log_of
    from trms_cli.sweeps.outcome import is_sweep, sweep_of

    folder = Path() if what is None else what.expanduser()
    if what is not None and not folder.is_dir():
        return folder  # a file, or nothing: who opens it tells
    if what is not None:
        log = log_of(folder)
        if log != folder:
            return log
        if is_sweep(folder):
            return folder
    latest = latest_run(folder)
    if latest is None:
        raise RecordingError(
            "there is no run in it" if what is not None else "there is no run under this folder",
            where=str(folder.absolute()),
            remedy=f"start one: {program()} run; or name its log: {program()} watch LOG",
        )
    sweep = sweep_of(latest.log) if latest.running else None
    return latest.log if sweep is None else sweep


def _watch_run(log: Path, arguments: Any) -> int:
    from trms_cli.commands.watch.frame import Player
    from trms_cli.commands.watch.screen import show, show_once
    from trms_cli.runs.follower import RunFollower

    run = RunFollower(log)
    try:
        _begin(run, log, arguments.begin)
        replay = arguments.begin is not None or arguments.speed is not None
        if arguments.once:
            replay = arguments.begin is not None
            run.look_until(math.inf if not replay else math.nextafter(arguments.begin, math.inf))
        live = not replay and (arguments.once or run.going_on)
        player = Player(
            run,
            live=live,
            speed=arguments.speed or 1.0,
            begin=arguments.begin or 0.0,
            span=arguments.span,
            plain=_plain(arguments),
        )
        if arguments.once:
            show_once(player)
            return EXIT_OK
        show(player)
    finally:
        run.close()
    return (
        EXIT_OK if not live or run.state in ("completed", "running", "unfinished") else EXIT_WORSE
    )


def _watch_gap(log: Path, arguments: Any) -> int:
    from trms_cli.commands.watch.gap import show_gap
    from trms_cli.library.tasks.gap_watch import GapReplay

    if log.is_dir():
        raise ConfigurationError(
            "this is the folder of a sweep", where="--gap", remedy=f"name one of its runs: {log}/0"
        )
    replay = GapReplay(log)
    try:
        show_gap(replay, as_json=arguments.json, plain=_plain(arguments))
    finally:
        replay.close()
    return EXIT_OK


def _begin(run: RunFollower, log: Path, begin: float | None) -> None:
    """Read the first samples; tell what cannot be shown at all."""
    while run.look() and run.latest <= 0.0:
        pass
    if run.state == "died" and log.stat().st_size == 0:
        raise RecordingError("the file is empty", where=str(log), remedy="repeat the run")
    if begin is not None and begin > 0.0:
        run.look_until(begin)
        if run.latest < begin and run.has_ended:
            raise ConfigurationError(
                f"{begin:g} s given; the run ends at {run.latest:g} s",
                where="--from",
                remedy="a time before that",
            )


def _watch_sweep(sweep: SweepFollower, arguments: Any) -> int:
    from trms_cli.commands.watch.screen import show, show_once
    from trms_cli.commands.watch.sweep import SweepPlayer

    player = SweepPlayer(sweep, plain=_plain(arguments))
    if arguments.once:
        show_once(player)
        return EXIT_OK
    show(player)
    now = player.now
    return EXIT_WORSE if now.has_ended and (now.failures or now.stopped) else EXIT_OK


def _plain(arguments: Any) -> bool:
    from trms_cli.commands.watch.screen import is_plain

    return bool(arguments.plain) or is_plain()
