"""Parts as somebody writes them in a notebook."""

from dataclasses import dataclass

import numpy as np

from trms_cli.controllers.controller import Command


@dataclass(frozen=True)
class Steady:
    """A command that does not change."""

    volts: tuple[float, float] = (1.0, 0.2)
    sample_time: float | None = None

    def preview(self, setup):
        return 0

    def init(self, setup):
        return None

    def step(self, state, sample, *, want_prediction):
        return Command(np.array(self.volts))


@dataclass(frozen=True)
class Raising(Steady):
    """One that has a mistake in it, or that somebody ends by Ctrl-C."""

    error: type[BaseException] = ZeroDivisionError

    def step(self, state, sample, *, want_prediction):
        if sample.time >= 0.5:
            raise self.error("mine")
        return super().step(state, sample, want_prediction=want_prediction)
