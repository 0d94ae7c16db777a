"""``trms rig``: a simulated rig behind a wire, and a look at a real one."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest

if TYPE_CHECKING:
    from trms_cli.composition.composer import Task

SUMMARY = "serve a simulated rig in real time, or check a real one"

HELP = """\
usage: trms rig serve [effect=NAME] [fault=NAME] [KEY=VALUE]…

`serve` lets a simulated rig move in real time, in a process of its own, and answers the frames of
docs/rig-frames.md as a real rig's computer does: over UDP, or over a pseudo-terminal. It lands by
itself where no command comes. It ends with its time, or with Ctrl-C.

examples
  trms rig serve                                        on port 47800 of this machine
  trms run plant=udp plant.arm=true controller=pid      drives it, in another terminal
  trms rig serve effect=yaw_coulomb_friction seed=3     a rig with an effect
  trms rig serve wire.latency=0.004 wire.loss=0.01      a poor network
  trms rig serve wire.pulled_at=20                      a cable that is pulled after 20 s
  trms rig serve serial=true                            a serial line; it tells its name

options
  --cfg job          print the keys with their values and stop
  --config-dir DIR   a folder with option files of your own, searched first (may be repeated)
  --allow PACKAGE    let classes of your own package run in this call (for good: trms allow)
"""

#: Its words, and the module of the task that does each.
_TASKS = {"serve": "trms_cli.library.tasks.serve"}


def main(argv: Sequence[str]) -> int:
    """Do what is asked for."""
    from trms_cli.commands.execution import execute

    word, *rest = argv or ["nothing"]
    if word not in _TASKS:
        raise ConfigurationError(
            f"{word!r} given" if argv else "nothing given",
            where="trms rig",
            remedy=f"{nearest(word, _TASKS)}; more by trms rig --help",
        )
    task: Task = import_module(_TASKS[word]).perform
    return execute(rest, f"rig_{word}", task)
