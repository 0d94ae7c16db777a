"""The life of a rig around a run: connect, check, arm, ramp in; land, disarm, close.

Whatever ends a run, the rig is landed, and closed exactly once. A plant may do without any of the
calls; a simulated one needs none of them.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError, SimulationError
from trms_cli.plants.landing import LandingRamp
from trms_cli.simulation.pace import Pace

#: What a plant's run has to have; see :class:`trms_cli.plants.plant.PlantRun`.
_NEEDED = (
    "inputs",
    "outputs",
    "states",
    "noise_sd",
    "first_command",
    "input_limits",
    "known_disturbances",
    "state",
    "measure",
    "advance",
)
#: Takes the command (n_u,) and the reading (n_y,) of a sample outside the run itself.
Sample = Callable[[FloatArray, FloatArray], None]
#: Takes what is about to happen; whether a person agrees.
Confirm = Callable[[str], bool]


class RigLanded(SimulationError):
    """A run that ended with a landing before its time."""


def check_run(run: Any) -> None:
    """See that a plant's run has what the loop needs.

    Raises ConfigurationError with the file and line of its class.
    """
    missing = [name for name in _NEEDED if not hasattr(run, name)]
    if missing:
        raise ConfigurationError(
            f"the plant's run {type(run).__qualname__} has no {', '.join(missing)}",
            where=_place(type(run)),
            remedy=f"a run of a plant has {', '.join(_NEEDED)} (docs/writing-a-plugin.md, A plant)",
        )


def check_reading(run: Any, reading: Any) -> FloatArray:
    """A plant's first reading as an array (n_y,).

    Raises ConfigurationError with the file and line of its ``measure`` for what is none.
    """
    channels = [signal.name for signal in run.outputs]
    try:
        y = np.asarray(reading, dtype=float)
    except (TypeError, ValueError):
        y = np.empty(0)
    if reading is None or y.shape != (len(channels),):
        raise ConfigurationError(
            f"the plant's measure() returned {_short(reading)}",
            where=_place(type(run).measure),
            remedy=f"an array of {len(channels)} numbers, in this order: {', '.join(channels)}; "
            "NaN where there is no sample",
        )
    return y


class RigLife:
    """A plant's run, with what leads to it and away from it.

    ``pace``: the deadlines that a real rig's commands keep; None where nothing waits.
    """

    def __init__(self, run: Any, landing: LandingRamp, pace: Pace | None) -> None:
        self._run, self._landing, self._pace = run, landing, pace
        self._is_connected = self._is_closed = False

    def connect(self) -> None:
        """Open the rig."""
        try:
            self._call("connect")
        except BaseException:
            self._is_closed = True
            self._call("close", "failed")
            raise
        self._is_connected = True

    def start(self, first_command: FloatArray, sample: Sample, confirm: Confirm | None) -> None:
        """Check, arm, and ramp from the safe command to the first one.

        Raises ConfigurationError where a person has to confirm and does not.
        """
        self._call("check")
        question = getattr(self._run, "confirmation", "")
        if question and not (confirm is not None and confirm(question)):
            raise ConfigurationError(
                "the rig was not armed: nobody confirmed",
                where="plant.arm",
                remedy="answer y on the terminal, or plant.arm=true where nobody is to be asked",
            )
        self._call("arm")
        u = self._landing.safe.copy()
        if self._pace is not None:
            self._pace.begin()
            for command in self._ramp(u, first_command):
                self._one(command, sample)

    def land(self, u: FloatArray, sample: Sample, stop: Callable[[], bool]) -> None:
        """Ramp from a command (n_u,) to the safe one and hold it; at once where ``stop`` says so.

        A rig that no longer answers gets its commands all the same.
        """
        safe = self._landing.safe
        for command in [*self._ramp(u, safe), *[safe] * self._landing.hold_samples]:
            if stop():
                break
            with suppress(Exception):  # the next command matters more than this one's failure
                self._one(command, sample)
        self._run.advance(safe.copy())

    def close(self, reason: str) -> None:
        """Disarm and close; a second call does nothing.

        Raises what the rig says where it cannot be disarmed, but not where the run failed before:
        that comes first.
        """
        if self._is_closed or not self._is_connected:
            return
        self._is_closed = True
        try:
            with suppress(*(() if reason == "completed" else (Exception,))):
                self._call("disarm")
        finally:
            self._call("close", reason)

    def _ramp(self, u: FloatArray, goal: FloatArray) -> Sequence[FloatArray]:
        commands = []
        while not np.array_equal(u, goal):
            u = self._landing.toward(goal, u)
            commands.append(u)
        return commands

    def _one(self, u: FloatArray, sample: Sample) -> None:
        """One sample outside the run: the command goes out whatever the reading is."""
        if self._pace is not None:
            self._pace.step()
        try:
            y = self._run.measure()
        except Exception:
            y = np.full(len(self._run.outputs), np.nan)
        self._run.advance(u.copy())
        sample(u, y)

    def _call(self, name: str, *arguments: Any) -> None:
        method = getattr(self._run, name, None)
        if method is not None:
            method(*arguments)


def _place(what: Any) -> str:
    """File and line of a class or function."""
    try:
        line = inspect.getsourcelines(what)[1]
        return f"{inspect.getsourcefile(what)}:{line}"
    except (OSError, TypeError):
        return f"{getattr(what, '__module__', '')}.{getattr(what, '__qualname__', what)}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}…"
