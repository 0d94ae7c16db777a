"""A case on a rig in another process: ``trms rig serve`` on one side, ``plant=udp`` on the other.

The rig moves by its own clock, and its frames cross the system's network stack: what came out is
of this run alone. The loop sees measured angles; what was true stays with the rig.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from experiments.chapter7.runs import Outcome, close_loop, experiment_for, outcome_of
from experiments.chapter7.study import CONFIGS, HERE, Job
from trms_cli.core.errors import TrmsError

_STEP = 0.005  #: s, in which the served rig is stepped
#: s that the loop and the rig wait for each other: on a busy machine the rig lives slower than the
#: clock, a step at a time between two answers, and either may be held up
_PATIENCE = 2.0
_BEFORE = 60.0  #: s, for which it also waits: the loop compiles, connects and lands meanwhile
_OF_THE_RIG = ("plant", "disturbance@plant")


def run_over_the_wire(job: Job, last: float) -> Outcome:
    """Close the loop of a case in real time; never raises but on Ctrl-C."""
    rig, loop = split(job.overrides)
    duration = next(float(w.partition("=")[2]) for w in loop if w.startswith("sim.duration="))
    try:
        with served_rig(rig, duration + _BEFORE) as address:
            waits = ("lost_after", "reply_timeout", "watchdog")
            patience = [f"plant.{name}={_PATIENCE}" for name in waits]
            words = [*address, "plant.arm=true", *patience, *loop]
            return outcome_of(job, close_loop(experiment_for(words)), last)
    except Exception as error:  # a failing run must not hide the others
        return Outcome(job, problem=f"{type(error).__name__}: {error}")


def split(overrides: Sequence[str]) -> tuple[list[str], list[str]]:
    """Overrides of the rig, and those of the loop."""
    rig = [word for word in overrides if re.split(r"[.=]", word.lstrip("+"))[0] in _OF_THE_RIG]
    return rig, [word for word in overrides if word not in rig]


@contextmanager
def served_rig(overrides: Sequence[str], duration: float) -> Iterator[list[str]]:
    """A rig in a process of its own for a time (s); how ``trms run`` calls it.

    Raises TrmsError where it does not come up.
    """
    command = [sys.executable, "-m", "trms_cli", "rig", "serve", "--config-dir", str(CONFIGS)]
    command += ["--allow", "experiments", *overrides, "port=0", f"step={_STEP}"]
    command += [f"watchdog={_PATIENCE}"]
    process = subprocess.Popen(
        [*command, f"duration={duration}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"PYTHONPATH": str(HERE.parents[1])},
    )
    assert process.stdout is not None
    try:
        words = ""
        for line in process.stdout:
            words += line
            if "plant.port=" in line:
                break
        else:
            raise TrmsError("the rig did not come up", where="trms rig serve", remedy=words)
        yield line.split(" run ")[1].split()
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
