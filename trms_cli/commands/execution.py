"""What the commands that compose share: show the configuration, do it, show it, or sweep."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from trms_cli.composition.composer import Composition, Outcome, Task, compose_request
from trms_cli.composition.overrides import default_words, read_request
from trms_cli.core.errors import EXIT_OK, EXIT_TERMINATED, Termination

if TYPE_CHECKING:
    from trms_cli.library.tasks.task import Done


def help_of_options(noun: str) -> str:
    """The options of all commands that compose, at the end of a command's help."""
    return f"""\
  -m, --multirun     one {noun} for each combination of the values that commas part
  --cfg job          print the composed configuration and stop
  --config-dir DIR   a folder with option files of your own, searched first (may be repeated)
  --allow PACKAGE    let classes of your own package run in this call (for good: trms allow)
"""


def execute(argv: Sequence[str], primary: str, task: Task, *, recorded: bool = False) -> int:
    """Do what `argv` asks: show the configuration, run `task` on it, or sweep.

    `argv`: overrides, and ``--config-dir DIR``, ``--cfg job``, ``-m``. `primary`: ``run`` for
    ``configs/run.yaml``. `task`: a module's function (a launcher may send it to another process)
    that gets a `Composition` and returns the exit code or an `Outcome`. The exit code of a sweep is
    1 when any job failed. `recorded`: whether `argv` says what an earlier command did, so that the
    options of the rig's folder that we are in do not count.
    """
    if not recorded:
        argv = [*default_words(argv, primary), *argv]
    swept = any(word in ("-m", "--multirun") for word in argv)
    request = read_request([word for word in argv if not (swept and word == "--json")], primary)
    if request.multirun:
        if not request.show:
            from trms_cli.commands.sweep import sweep

            return sweep(request, primary, task, as_json="--json" in argv)
        from trms_cli.library.tasks.sweep import first_job

        composition = first_job(request, primary)
    else:
        composition = compose_request(request, primary)
    if request.show:
        sys.stdout.write(composition.yaml)
        return EXIT_OK
    outcome = task(composition)
    return outcome.exit_code if isinstance(outcome, Outcome) else outcome


def study(command: str, composition: Composition, task: Callable[..., Done], **how: Any) -> Outcome:
    """Let `task` do what a configuration asks for, and show it; in a sweep a few lines a job."""
    from trms_cli.library.tasks.task import Interrupted, Screen, as_job

    if composition.job is not None:
        return as_job(composition, task, **how)
    screen = Screen(command)
    try:
        result = task(composition, screen, **how)
    except Interrupted as stopped:
        if stopped.words:
            sys.stderr.write(stopped.words)
            return Outcome(stopped.exit_code, folder=stopped.folder)
        sys.stderr.write(f"stopped; finished stages are kept: {stopped.how}\n")
        if stopped.exit_code == EXIT_TERMINATED:
            raise Termination from None
        raise KeyboardInterrupt from None
    screen.done(result)
    return Outcome(result.exit_code, result.objective, result.folder)
