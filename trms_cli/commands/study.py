"""What the commands that study something share: do it, show it, say how to go on."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from trms_cli.composition.composer import Composition, Outcome
from trms_cli.core.errors import EXIT_TERMINATED, Terminated
from trms_cli.library.tasks.task import Done, Interrupted, Listener, Screen


def study(command: str, composition: Composition, task: Callable[..., Done], **how: Any) -> Outcome:
    """Do what a configuration asks for, and show it; in a sweep a few lines a job.

    Parameters
    ----------
    task : callable
        Takes the composition, a listener, and `how`.
    """
    in_sweep = composition.job is not None
    listener = Listener(command) if in_sweep else Screen(command)
    try:
        done = task(composition, listener, **how)
    except Interrupted as stopped:
        if not in_sweep:
            sys.stderr.write(f"stopped; finished stages are kept: {stopped.how}\n")
        if stopped.exit_code == EXIT_TERMINATED:
            raise Terminated from None
        raise KeyboardInterrupt from None
    if composition.job is not None:
        from trms_cli.reporting.screen import show_job

        show_job(done.findings, composition.job, composition.overrides)
    else:
        listener.done(done)
    return Outcome(done.exit_code, done.objective, done.folder)
