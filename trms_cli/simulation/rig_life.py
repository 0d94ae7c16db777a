"""The life of a rig around a run: connect, check, arm, ramp in; land, disarm, close.

Whatever ends a run, the rig is landed, and closed exactly once. A plant may do without any of the
calls; a simulated one needs none of them.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError, SimulationError
from trms_cli.core.printable import short_repr
from trms_cli.models.model import Signal
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
_PAGE = "docs/writing-a-plugin.md, A plant"
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
    kind = type(run)
    if run is None or isinstance(run, type):
        raise ConfigurationError(
            f"the plant's init() returned {short_repr(run)}, which is no run of it",
            where="plant",
            remedy=f"an object with {', '.join(_NEEDED)} ({_PAGE})",
        )
    missing = [name for name in _NEEDED if not hasattr(run, name)]
    if missing:
        # a property that is there and has no value: what it says of itself is nearer to the mistake
        own = next((name for name in missing if hasattr(kind, name)), None)
        raise ConfigurationError(
            f"the plant's run {kind.__qualname__} has no {', '.join(missing)}"
            + (f" ({_reason(run, own)})" if own else ""),
            where=_place(kind),
            remedy=f"a run of a plant has {', '.join(_NEEDED)} ({_PAGE})",
        )
    for problem, remedy in _wrong_values(run):
        raise ConfigurationError(
            f"{problem} (the plant's run {kind.__qualname__})", where=_place(kind), remedy=remedy
        )


def _wrong_values(run: Any) -> Iterator[tuple[str, str]]:
    """What is wrong with a run's attributes, and what each has to be."""
    for name in ("inputs", "outputs", "states"):
        signals = getattr(run, name)
        if not isinstance(signals, tuple) or not all(isinstance(s, Signal) for s in signals):
            yield (
                f"{name} is {short_repr(signals)}",
                "a tuple of trms_cli.models.model.Signal: "
                f"{name} = (Signal('alpha_v', 'rad', 'pitch angle'),)",
            )
    inputs = ", ".join(signal.name for signal in run.inputs)
    n_u, n_x, limits = len(run.inputs), len(run.states), run.input_limits
    if not (isinstance(limits, tuple) and [_is_array(x, (n_u,)) for x in limits] == [True, True]):
        yield (
            f"input_limits is {short_repr(limits)}",
            f"two float arrays of shape ({n_u},), lower and upper, V: each a number for {inputs}",
        )
    if not _is_array(run.first_command, (n_u,)):
        yield (
            f"first_command is {short_repr(run.first_command)}",
            f"a float array of shape ({n_u},), V: a number for {inputs}",
        )
    if not _is_array(run.state, (n_x,)):
        yield (
            f"state is {short_repr(run.state)}",
            f"a float array of shape ({n_x},), the order of states; where nobody knows the true "
            "state: states = (), state = np.zeros(0)",
        )
    without_noise = [signal.name for signal in run.outputs if signal.name not in run.noise_sd]
    if without_noise:
        yield (
            f"noise_sd has no {', '.join(without_noise)}",
            "a standard deviation above 0 for each channel of outputs, in its unit",
        )


def check_reading(run: Any, reading: Any) -> FloatArray:
    """A plant's first reading as an array (n_y,).

    Raises ConfigurationError with the file and line of its ``measure`` for what is none.
    """
    channels = [signal.name for signal in run.outputs]
    if not _is_array(reading, (len(channels),)):
        is_array = isinstance(reading, np.ndarray)
        form = f" (shape {reading.shape}, {reading.dtype})" if is_array else ""
        raise ConfigurationError(
            f"the plant's measure() returned {short_repr(reading)}{form}",
            where=_place(type(run).measure),
            remedy=f"a float array of shape ({len(channels)},), in this order: "
            f"{', '.join(channels)}; NaN where there is no sample",
        )
    y: FloatArray = reading
    return y


class RigLife:
    """A plant's run, with what leads to it and away from it.

    ``pace``: the deadlines that a real rig's commands keep; None where nothing waits.
    """

    def __init__(self, run: Any, landing: LandingRamp, pace: Pace | None) -> None:
        self._run, self._landing, self._pace = run, landing, pace
        self._is_connected = self._is_started = self._is_closed = False

    @property
    def safe_command(self) -> FloatArray:
        """What the rig is landed to, (n_u,), V."""
        return self._landing.safe

    def connect(self) -> None:
        """Open the rig."""
        try:
            self._call("connect")
        except BaseException:
            self._is_closed = True
            self._call("close", "failed")
            raise
        self._is_connected = True

    def prepare(self, confirm: Confirm | None) -> None:
        """Check, and ask whether the rig may move; it is not touched so far.

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

    def start(self, first_command: FloatArray, sample: Sample) -> None:
        """Arm, and ramp from the safe command to the first one."""
        self._is_started = True
        self._call("arm")
        u = self._landing.safe.copy()
        if self._pace is not None:
            self._pace.begin()
            for command in self._ramp(u, first_command):
                self._one(command, sample)

    def land(self, u: FloatArray, sample: Sample, stop: Callable[[], bool]) -> None:
        """Ramp from a command (n_u,) to the safe one and hold it; at once where ``stop`` says so.

        A rig that no longer answers gets its commands all the same; one that was never to move
        gets none.
        """
        if not self._is_started:
            return
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
        commands: list[FloatArray] = []
        if not np.all(np.isfinite(u)):
            return commands  # from nowhere leads no ramp
        while not np.array_equal(u, goal):
            u = self._landing.toward(goal, u)
            commands.append(u)
        return commands

    def _one(self, u: FloatArray, sample: Sample) -> None:
        """One sample outside the run: the command goes out whatever the reading is."""
        if self._pace is not None:
            self._pace.step()
        try:
            y = check_reading(self._run, self._run.measure())
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


def _is_array(value: Any, shape: tuple[int, ...]) -> bool:
    return isinstance(value, np.ndarray) and value.shape == shape and value.dtype.kind == "f"


def _reason(run: Any, name: str) -> str:
    """What a property says that has no value."""
    try:
        getattr(run, name)
    except AttributeError as error:
        return f"{name}: {error}"
    return name
