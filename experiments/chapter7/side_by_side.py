"""Loops that are closed side by side on rigs that are integrated together.

The rigs of the blind sets cost some 0.7 ms for each ms that they move, one or twenty of them. So
each loop is `Loop.run` as it is, in a thread of its own, which waits where it has given its command
until all have; one thread alone runs at a time, in a fixed order, so that nothing depends on the
machine.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.chapter7.blind_rig import BlindRig, BlindRun, RigsSideBySide
from trms_cli.plants.plant import PlantSetup
from trms_cli.simulation.closed_loop import Experiment

FloatArray = npt.NDArray[np.float64]


def run_side_by_side(
    experiments: Sequence[Experiment], work: Callable[[int, Experiment], Any]
) -> list[Any]:
    """Let ``work(i, experiment)`` close each loop once; what it returns, or what it raised.

    ``experiments``: with a :class:`BlindRig` as plant each, and one sample time.
    """
    rigs = [e.plant for e in experiments]
    assert all(isinstance(rig, BlindRig) for rig in rigs)
    setups = [PlantSetup(e.sample_time, e.samples, e.seed) for e in experiments]
    together = RigsSideBySide(rigs, setups)  # type: ignore[arg-type]
    members = [
        _Member(_WaitingRig(rig, together, i), e, i)  # type: ignore[arg-type]
        for i, (rig, e) in enumerate(zip(rigs, experiments, strict=True))
    ]
    for member in members:
        member.start(work)
    waiting = members
    while waiting := [member for member in waiting if member.go_on()]:
        together.advance()
    return [member.result for member in members]


@dataclass(frozen=True, kw_only=True)
class _Turn:
    """Who may run: the loop's thread or the one that lets the rigs move."""

    mine: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    theirs: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))

    def give_back(self) -> None:
        """Of the loop's thread: wait until all others have given their commands."""
        self.theirs.release()
        self.mine.acquire()


class _WaitingRig:
    """A place among rigs that move together, as a plant."""

    def __init__(self, rig: BlindRig, together: RigsSideBySide, place: int) -> None:
        self.rig, self.turn = rig, _Turn()
        self.landing, self.envelope = rig.landing, rig.envelope
        self._together, self._place = together, place

    def init(self, setup: PlantSetup) -> _WaitingRun:
        """The rig at time zero."""
        return _WaitingRun(self.rig, setup, self._together, self._place, self.turn)


class _WaitingRun(BlindRun):
    """A rig that moves when all of them do."""

    def __init__(
        self, rig: BlindRig, setup: PlantSetup, rigs: RigsSideBySide, place: int, turn: _Turn
    ) -> None:
        super().__init__(rig, setup, rigs, place)
        self._turn = turn

    def advance(self, command: FloatArray) -> None:
        self.command(command)
        self._turn.give_back()


class _Member:
    """A loop and its thread."""

    def __init__(self, plant: _WaitingRig, experiment: Experiment, place: int) -> None:
        self._turn, self._place = plant.turn, place
        self._experiment = replace(experiment, plant=plant)
        self.over = False
        self.result: Any = None  #: Of the work, or the exception that it raised

    def start(self, work: Callable[[int, Experiment], Any]) -> None:
        """Begin a thread that waits for its turn."""

        def run() -> None:
            self._turn.mine.acquire()
            try:
                self.result = work(self._place, self._experiment)
            except BaseException as error:  # told by whoever asks for the result
                self.result = error
            self.over = True
            self._turn.theirs.release()

        threading.Thread(target=run, daemon=True).start()

    def go_on(self) -> bool:
        """Let the loop run up to its next command; whether there is one."""
        self._turn.mine.release()
        self._turn.theirs.acquire()
        return not self.over
