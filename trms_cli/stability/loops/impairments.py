"""What goes wrong between a controller and its rig: late commands, wrong gains, dry friction.

Each has one size, of which a given one means that nothing is wrong.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extended
from trms_cli.models.model import Model, names
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.closed_loop import Path

ImpairmentKind = Literal["delay", "gain", "friction"]


class Impairment:
    """One way in which a loop is made worse; larger sizes are worse."""

    key: str  #: ``gain_up_u_v``
    words: str  #: ``gain of u_v too large``
    kind: ImpairmentKind
    unit: str
    none: float = 0.0  #: The size at which nothing is wrong

    def shown(self, size: float) -> float:
        """The size as it is told: a gain of 1/size for one that is too small."""
        return size

    def rig(self, model: Model, size: float) -> Model:
        """The rig that has it."""
        return model

    def path(
        self, model: Model, point: OperatingPoint, sample_time: float, size: float
    ) -> Path | None:
        """What its commands pass; None where they pass as they are."""
        return None


@dataclass
class Delayed:
    """Commands as they were a time ago.

    Between two samples the delayed command has its mean over the sample: the mixture of two
    neighbours, so that any time is possible.
    """

    samples: float  #: The time over the sample time
    before: FloatArray  #: (n_u,) array; in force before the first command
    _past: deque[FloatArray] = field(init=False)
    _share: float = field(init=False)

    def __post_init__(self) -> None:
        whole = int(self.samples)
        self._share = self.samples - whole
        self._past = deque([self.before.copy() for _ in range(whole + 2)], maxlen=whole + 2)

    def __call__(self, k: int, u: FloatArray) -> FloatArray:
        self._past.append(u.copy())
        return np.asarray((1 - self._share) * self._past[1] + self._share * self._past[0])


@dataclass(frozen=True)
class CommandDelay(Impairment):
    """All commands reach the motors late."""

    key = "delay"
    words = "delay of all commands"
    kind = "delay"
    unit = "s"

    def path(
        self, model: Model, point: OperatingPoint, sample_time: float, size: float
    ) -> Path | None:
        return Delayed(size / sample_time, point.u)


@dataclass(frozen=True)
class GainError(Impairment):
    """One command reaches its motor too large, or too small, within its limits."""

    channel: int
    name: str  #: The input
    up: bool  #: Whether too large: a factor of size, else of 1/size
    #: Whether only the command's distance to the point's is changed, as in linear theory
    of_changes: bool = False

    kind = "gain"
    unit = ""
    none = 1.0

    @property
    def key(self) -> str:  # type: ignore[override]
        """``gain_up_u_v``."""
        return f"gain_{'up' if self.up else 'down'}_{self.name}"

    @property
    def words(self) -> str:  # type: ignore[override]
        """``gain of u_v too large``."""
        return f"gain of {self.name} too {'large' if self.up else 'small'}"

    def shown(self, size: float) -> float:
        return size if self.up else 1 / size

    def path(
        self, model: Model, point: OperatingPoint, sample_time: float, size: float
    ) -> Path | None:
        factor = np.ones(model.n_u)
        factor[self.channel] = self.shown(size)
        lower, upper = model.input_bounds()
        around = point.u if self.of_changes else np.zeros(model.n_u)
        # the amplifier behind the wrong gain has the limits that the command has
        return lambda k, u: np.clip(around + factor * (u - around), lower, upper)


@dataclass(frozen=True)
class AxisFriction(Impairment):
    """Coulomb friction of an axis."""

    axis: str

    kind = "friction"
    unit = "N m"

    @property
    def key(self) -> str:  # type: ignore[override]
        """``friction_pitch``."""
        return f"friction_{self.axis}"

    @property
    def words(self) -> str:  # type: ignore[override]
        """``Coulomb friction of pitch``."""
        return f"Coulomb friction of {self.axis}"

    def rig(self, model: Model, size: float) -> Model:
        friction = CoulombFriction(axis=self.axis, torque=size)  # type: ignore[arg-type]
        return extended(model, {f"added_{self.key}": friction})


def impairments_of(model: Model) -> tuple[Impairment, ...]:
    """All that fit a rig; one that only steps cannot gain friction."""
    gains = [
        GainError(channel, name, up)
        for channel, name in enumerate(names(model.inputs))
        for up in (True, False)
    ]
    frictions = [AxisFriction(axis) for axis in model.axes] if model.sample_time is None else []
    return (CommandDelay(), *gains, *frictions)
