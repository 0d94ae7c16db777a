"""How a rig is brought to rest: the safe command, how fast it is approached, how long it lasts.

One landing serves every end: that of a run, Ctrl-C, a failure, an envelope that was left. It needs
neither model nor estimate, for one of them may be what has failed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.core.ranges import NotNegative, Positive

_RATE = 1.0  # V/s
#: Share of an input's limit that the ramp covers in a second on rigs that have no rotors: what the
#: rate is of 2.5 V.
_SHARE = 0.4
#: Commands that a rig of both axes has.
ROTOR_COMMANDS = ("u_v", "u_h")


@dataclass(frozen=True, kw_only=True)
class Landing:
    """Where the command goes when a rig is to rest, and how."""

    #: V, the safe command by input; 0 where none is given
    command: Mapping[str, float] = field(default_factory=dict)
    #: V/s, of the ramp to the safe command, and of that into a run; as it stands here, of an input
    #: of another rig the same share of its limit
    rate: Positive = _RATE
    hold: NotNegative = 0.0  #: s, for which the safe command is held before the rig is let go
    #: Whether every run ends with it; a simulated rig needs none
    after_run: bool = True

    def samples(self, farthest: float, sample_time: float) -> int:
        """Most samples that it takes from a command so far (V) from the safe one."""
        ramp = math.ceil(farthest / (self.rate * sample_time) - 1e-9)
        return ramp + round(self.hold / sample_time) + 1

    def rates(self, inputs: Sequence[str], limits: tuple[FloatArray, FloatArray]) -> FloatArray:
        """Of the ramp of each input, per second, (n_u,), in its unit."""
        largest = np.maximum(*np.abs(limits))
        own = np.where(np.isfinite(largest) & (largest > 0), _SHARE * largest, self.rate)
        is_usual = [self.rate != _RATE or name in ROTOR_COMMANDS for name in inputs]
        return np.where(is_usual, self.rate, own)

    def init(
        self,
        inputs: Sequence[str],
        limits: tuple[FloatArray, FloatArray],
        sample_time: float,
    ) -> LandingRamp:
        """Ready to land a rig with these inputs; ``limits``: lower and upper, (n_u,) each, V.

        Raises ConfigurationError for an input that the rig does not have, or a command beyond its
        limit.
        """
        safe = np.zeros(len(inputs))
        for name, value in self.command.items():
            where = f"landing.command.{name}"
            if name not in ROTOR_COMMANDS:  # a rig of one axis lands the input that it has
                require_known(name, inputs, f"the rig has no input {name!r}", where)
            if name in inputs:
                safe[inputs.index(name)] = value
        for name, value, low, high in zip(inputs, safe, *limits, strict=True):
            if not low <= value <= high:
                raise ConfigurationError(
                    f"{value:g} given" if name in self.command else f"0 V, and {name} has limits",
                    where=f"landing.command.{name}",
                    remedy=f"a safe command from {low:g} to {high:g} V",
                )
        step = self.rates(inputs, limits) * sample_time
        return LandingRamp(safe, step, round(self.hold / sample_time))


@dataclass(frozen=True)
class LandingRamp:
    """A landing in samples."""

    safe: FloatArray  #: The safe command (n_u,), V
    step: FloatArray  #: Largest change of each command in one sample, (n_u,), V
    hold_samples: int  #: For which the safe command is held once it is reached

    def toward(self, goal: FloatArray, u: FloatArray) -> FloatArray:
        """The command (n_u,) one sample after ``u`` on the way to a goal (n_u,), V."""
        return np.asarray(u + np.clip(goal - u, -self.step, self.step))

    def next(self, u: FloatArray) -> FloatArray:
        """The command (n_u,) one sample after ``u`` on the way to the safe one, V."""
        return self.toward(self.safe, u)


def landing_of(plant: object) -> Landing:
    """A rig's landing; one that says nothing of it lands at the end of every run, at 1 V/s."""
    landing = getattr(plant, "landing", None)
    return landing if isinstance(landing, Landing) else Landing()
