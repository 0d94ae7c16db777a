"""How much thrust may be asked for so that every command stays within its limits.

For a rotor regulated by ψ (see :mod:`trms_cli.controllers.robust.coordinates`) the commands within
their limits reach, in a period, the ψ⁺ between ψ_lo(ψ) and ψ_hi(ψ), both increasing. With the
demand ψ⁺ = ψ_s + λ (ψ − ψ_s) + ν it is enough that

    |ν| ≤ min( min_ψ ψ_hi(ψ) − λ ψ − (1 − λ) ψ_s,   min_ψ λ ψ − ψ_lo(ψ) + (1 − λ) ψ_s )

over all ψ that the rotor reaches at all: a bound that does not depend on the state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.controllers.robust.coordinates import Coordinates, Rotor
from trms_cli.core.compilation import BufferedFunction

FloatArray = npt.NDArray[np.float64]

_SPEEDS = 401
_SPIN_UP = 20.0  # s, of a rotor under a full command: to its steady speed


@dataclass(frozen=True)
class ThrustDemand:
    """The bound of one rotor."""

    rotor: Rotor
    pole: float  #: λ
    #: ``above``, ``below``: min ψ_hi(ψ) − λψ and min λψ − ψ_lo(ψ), (rad/s)²
    above: float
    below: float
    largest: float  #: Largest |ψ| that the rotor reaches, (rad/s)²

    def bound(self, psi_s: float) -> float:
        """Largest |ν| at a steady ψ_s, (rad/s)²; negative where even ν = 0 asks too much."""
        moved = (1.0 - self.pole) * psi_s
        return min(self.above - moved, self.below + moved)

    @property
    def scale(self) -> float:
        """The bound at ψ_s = 0, (rad/s)²."""
        return self.bound(0.0)


def thrust_demand(coordinates: Coordinates, rotor: Rotor, pole: float) -> ThrustDemand:
    """The bound of a rotor, from the model's step at evenly spaced speeds."""
    model = coordinates.model
    step = BufferedFunction(coordinates.discrete.step)
    p, w = model.parameters.values, np.zeros(model.n_w)
    lower, upper = model.input_bounds()

    def after(speed: float, command: float) -> float:
        x, u = model.rest(), np.zeros(model.n_u)
        x[rotor.state], u[rotor.input] = speed, command
        return float(step.evaluate(x, u, p, w)[0][rotor.state])

    ends = []
    for limit in (lower[rotor.input], upper[rotor.input]):
        speed = 0.0
        for _ in range(round(_SPIN_UP / coordinates.period)):
            speed = after(speed, limit)
        ends.append(speed)
    speeds = np.linspace(min(ends), max(ends), _SPEEDS)
    psi = coordinates.psi_of(speeds)
    high, low = (
        coordinates.psi_of(np.array([after(speed, limit) for speed in speeds]))
        for limit in (upper[rotor.input], lower[rotor.input])
    )
    return ThrustDemand(
        rotor,
        pole,
        float((high - pole * psi).min()),
        float((pole * psi - low).min()),
        float(np.abs(psi).max()),
    )
