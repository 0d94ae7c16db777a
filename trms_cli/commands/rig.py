"""``trms rig``: a simulated rig behind a wire, and a look at a real one."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest

if TYPE_CHECKING:
    from trms_cli.composition.composer import Task

SUMMARY = "serve a simulated rig in real time, check a real one, drive one by exported C"

HELP = """\
usage: trms rig serve [effect=NAME] [fault=NAME] [KEY=VALUE]…
       trms rig check [plant=OPTION] [KEY=VALUE]…
       trms rig drive --exported FOLDER [GROUP=OPTION]… [KEY=VALUE]…

`serve` lets a simulated rig move in real time, in a process of its own, and answers the frames of
docs/rig-frames.md as a real rig's computer does: over UDP, or over a pseudo-terminal. It lands by
itself where no command comes. It ends with its time, or with Ctrl-C.

`check` shows what a real rig reads, raw and in SI. On a terminal it goes on to the zero of the
angles, and, with a pulse, to the signs: each rotor turns for a moment, and you say which way the
beam went. It writes a wiring. Without a pulse nothing moves.

`drive` is `trms run plant=udp` with what `trms export-controller` wrote to FOLDER in the place of
controller and observer: its C is compiled, and the run lives, is logged and scored as any other. It
takes what `trms run` takes.

examples
  trms rig serve                                        on port 47800 of this machine
  trms run plant=udp plant.arm=true controller=pid      drives it, in another terminal
  trms rig serve effect=yaw_coulomb_friction seed=3     a rig with an effect
  trms rig serve wire.latency=0.004 wire.loss=0.01      a poor network
  trms rig serve wire.pulled_at=20                      a cable that is pulled after 20 s
  trms rig serve serial=true                            a serial line; it tells its name
  trms rig check plant=udp plant.host=192.168.0.10      what the channels read
  trms rig check plant=udp pulse=0.5 out=lab/configs/wiring/my_rig.yaml
  trms rig check plant=udp zero=true duration=2 out=…   nobody asked: zero is here
  trms rig drive --exported rig_c plant.arm=true        the same rig, driven by exported C
  trms rig drive --exported rig_c plant=simulated       software in the loop, no clock

options
  --cfg job          print the keys with their values and stop
  --config-dir DIR   a folder with option files of your own, searched first (may be repeated)
  --allow PACKAGE    let classes of your own package run in this call (for good: trms allow)
"""

#: Its words, and the module of the task that does each.
_TASKS = {"serve": "trms_cli.library.tasks.serve", "check": "trms_cli.library.tasks.rig_check"}
_WORDS = (*_TASKS, "drive")


def main(argv: Sequence[str]) -> int:
    """Do what is asked for."""
    word, *rest = argv or ["nothing"]
    if word == "drive":
        return _drive(rest)
    if word not in _TASKS:
        raise ConfigurationError(
            f"{word!r} given" if argv else "nothing given",
            where="trms rig",
            remedy=f"{nearest(word, _WORDS)}; more by trms rig --help",
        )
    from trms_cli.commands.execution import execute

    task: Task = import_module(_TASKS[word]).perform
    return execute(rest, f"rig_{word}", task)


def _drive(argv: Sequence[str]) -> int:
    """Run with an exported controller in the place of controller and observer."""
    from trms_cli.commands import run
    from trms_cli.composition.catalogue import take_option
    from trms_cli.library.tasks.drive import run_words

    folders, rest = take_option(argv, "--exported")
    if len(folders) != 1 or not folders[0]:
        raise ConfigurationError(
            "no folder given" if len(folders) < 2 else "given twice",
            where="--exported",
            remedy="write --exported FOLDER, of `trms export-controller newton_mpc out=FOLDER`; "
            "the Python controllers drive by `trms run plant=udp`",
        )
    if {"-m", "--multirun"} & set(rest):
        raise ConfigurationError(
            "an exported controller drives one run at a time", where="-m", remedy="leave it out"
        )
    return run.main(run_words(Path(folders[0]), rest))
