"""Dry friction of an axis as a law: Coulomb, Stribeck, and its describing function."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.stribeck_friction import StribeckFriction
from trms_cli.models.model import Model
from trms_cli.stability.subject import effects_of

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FrictionLaw:
    """``F(Ω) = F_c (1 + e exp(−(Ω/v_s)²))``; Coulomb friction for e = 0."""

    torque: float  #: F_c, N m
    excess: float = 0.0  #: e = F_s/F_c − 1
    velocity: float = 1.0  #: v_s, rad/s

    @property
    def breakaway(self) -> float:
        """F_s, N m."""
        return self.torque * (1.0 + self.excess)

    def moment(self, speed: npt.ArrayLike) -> FloatArray:
        """F(|Ω|), N m, not negative."""
        ratio = np.asarray(speed, dtype=float) / self.velocity
        return np.asarray(self.torque * (1.0 + self.excess * np.exp(-(ratio**2))))

    def scaled(self, factor: float) -> FrictionLaw:
        """With all torques times a factor."""
        return replace(self, torque=factor * self.torque)

    def describing(self, amplitude: npt.ArrayLike) -> FloatArray:
        """N(A) for a sine of the rate without a stop, N m s/rad."""
        from scipy.special import dawsn

        A = np.asarray(amplitude, dtype=float)
        share = dawsn(A / self.velocity) * self.velocity / A
        return np.asarray(4.0 * self.torque / (np.pi * A) * (1.0 + self.excess * share))


@dataclass(frozen=True)
class Friction:
    """The dry friction of an axis among a model's effects."""

    effect: str  #: Its name
    axis: str
    law: FrictionLaw


def frictions_of(model: Model) -> tuple[Friction, ...]:
    """Dry friction among a model's effects, with the sizes that are in force."""
    found = []
    for name, effect in effects_of(model):
        if isinstance(effect, CoulombFriction | StribeckFriction):
            sizes = {
                parameter.name.rsplit(".", 1)[-1]: parameter.value
                for parameter in model.parameters
                if parameter.name.startswith(f"{name}.")
            }
            found.append(Friction(name, effect.axis, FrictionLaw(**sizes)))
    return tuple(found)
