"""What the commands that compose share: do it, show it, say how to go on."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from trms_cli.composition.composer import Composition, Outcome
from trms_cli.core.errors import EXIT_TERMINATED, Terminated
from trms_cli.library.tasks.task import Done, Interrupted, Screen, as_job


def study(command: str, composition: Composition, task: Callable[..., Done], **how: Any) -> Outcome:
    """Let `task` do what a configuration asks for, and show it; in a sweep a few lines a job."""
    if composition.job is not None:
        return as_job(composition, task, **how)
    screen = Screen(command)
    try:
        done = task(composition, screen, **how)
    except Interrupted as stopped:
        if stopped.words:
            sys.stderr.write(stopped.words)
            return Outcome(stopped.exit_code, folder=stopped.folder)
        sys.stderr.write(f"stopped; finished stages are kept: {stopped.how}\n")
        if stopped.exit_code == EXIT_TERMINATED:
            raise Terminated from None
        raise KeyboardInterrupt from None
    screen.done(done)
    return Outcome(done.exit_code, done.objective, done.folder)
