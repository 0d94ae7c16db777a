"""Controllers that do what a plugin should not, as users might write them: tests copy the file."""

import math
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trms_cli.controllers.controller import Command


class Bare:
    """The least that a controller is: not even a sample time."""

    def preview(self, setup):
        return 0

    def init(self, setup):
        return len(setup.model.inputs)

    def step(self, state, sample, *, want_prediction):
        return Command(np.full(state, 0.1))


@dataclass(frozen=True, kw_only=True)
class Own(Bare):
    how: str = ""
    after: float = 1.0  #: s; when it begins to misbehave
    marker: str = ""  #: file that it waits for where it is held
    sample_time: float | None = None

    def __post_init__(self):
        if self.how == "dies":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.how == "bad":
            raise RuntimeError("no such gain\nand more")

    def init(self, setup):
        if self.how == "refuse":
            raise ValueError("cannot start")
        return super().init(setup)

    def step(self, state, sample, *, want_prediction):
        if self.how == "held":
            while not Path(self.marker).exists():
                time.sleep(0.01)
        elif self.how == "slow":
            time.sleep(0.002)
            with Path("reached.txt").open("a") as file:
                file.write(f"{sample.time!r}\n")
        elif sample.time >= self.after:
            if self.how == "raise":
                raise ZeroDivisionError("a slip of mine")
            if self.how == "garbage":
                return Command(np.full(state, math.nan))
            if self.how == "nothing":
                return None
            if self.how == "words":
                return Command(["up", "down"])
        return super().step(state, sample, want_prediction=want_prediction)


class Unfinished:
    def preview(self, setup):
        return 0

    def init(self, setup):
        return None
