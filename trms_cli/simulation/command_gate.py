"""The gate that each command passes: within the limits, finite, and told where it was not."""

from __future__ import annotations

import math

import numpy as np

from trms_cli.controllers.controller import Command
from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import SimulationError
from trms_cli.plants.envelope import Tell


class CommandGate:
    """Cuts commands to the limits, holds what is not finite, and tells when either begins or ends.

    ``limits``: (n_u,) each; lower and upper, V. ``tell``: takes kind, source, sentence and value
    (V) of an event.
    """

    def __init__(
        self, inputs: tuple[str, ...], limits: tuple[FloatArray, FloatArray], tell: Tell
    ) -> None:
        self._inputs, self._tell = inputs, tell
        self._lower, self._upper = (bound.tolist() for bound in limits)
        self._saturated: set[str] = set()
        self._not_finite: set[str] = set()

    @property
    def holds(self) -> bool:
        """Whether the last command had a value that is no number, and an older one is applied."""
        return bool(self._not_finite)

    def applied(self, command: Command, previous: FloatArray) -> FloatArray:
        """The command (n_u,) as applied after ``previous``, V.

        Raises SimulationError for what is no command at all: it is a mistake in the controller's
        code.
        """
        if not isinstance(command, Command):
            raise _no_command(f"step returned {command!r}, not a Command")
        try:
            request = np.asarray(command.u, dtype=float)
        except (TypeError, ValueError):
            raise _no_command(f"command is {command.u!r}, no array of numbers") from None
        if request.shape != previous.shape:
            raise _no_command(f"command has shape {request.shape}, the rig takes {previous.shape}")
        values = request.tolist()
        is_usual = not (self._saturated or self._not_finite)
        for low, value, high in zip(self._lower, values, self._upper, strict=True):
            is_usual = is_usual and low < value < high  # false for what is not a number
        if is_usual:
            return request.copy()  # nothing to cut, nothing to tell
        applied = previous.copy()
        for i, value in enumerate(values):
            name, finite = self._inputs[i], math.isfinite(value)
            if finite:
                applied[i] = min(max(value, self._lower[i]), self._upper[i])
            saturated = finite and not self._lower[i] < value < self._upper[i]
            if saturated != (name in self._saturated):
                self._saturated ^= {name}
                words = "reached its limit" if saturated else "left its limit"
                kind = "saturation_begin" if saturated else "saturation_end"
                self._tell(kind, name, f"{name} {words} (value in V)", value)
            if finite == (name in self._not_finite):
                self._not_finite ^= {name}
                words = "is finite again" if finite else "is not finite; the last command is held"
                kind = "fault_end" if finite else "fault"
                self._tell(kind, "controller", f"{name} {words}", value)
        return applied


def _no_command(what: str) -> SimulationError:
    return SimulationError(
        f"the controller's {what}",
        where="controller",
        remedy="step returns Command(u): one value (V) for each of the model's inputs, in their "
        "order",
    )
