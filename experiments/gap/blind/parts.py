"""Parts of a blind rig that remember: delays, bristles, slipping springs, oscillators.

All are vectorised over rigs: a size that is zero for a rig makes the part disappear there.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

#: Where the springs of a cable begin to slip, as shares of the width.
_SLIPS = (0.4, 0.8, 1.2, 1.6)


class DelayLine:
    """Values of the last moments, read a delay ago."""

    def __init__(self, delay: FloatArray, longest: float, step: float) -> None:
        self._steps = delay / step
        if delay.max(initial=0.0) > longest:
            raise ValueError(f"a delay of {delay.max()} s exceeds {longest} s")
        self._buffer = np.zeros((int(longest / step) + 2, len(delay)))
        self._newest = 0
        self._rigs = np.arange(len(delay))

    def push(self, value: FloatArray) -> None:
        """Add the newest value of each rig."""
        self._newest = (self._newest + 1) % len(self._buffer)
        self._buffer[self._newest] = value

    def settle(self, value: FloatArray) -> None:
        """As if it had been the same for long."""
        self._buffer[:] = value

    def read(self, undelayed: FloatArray) -> FloatArray:
        """The values a delay ago; where there is no delay, those given."""
        whole = np.floor(self._steps).astype(int)
        share = self._steps - whole
        near = self._buffer[(self._newest - whole) % len(self._buffer), self._rigs]
        far = self._buffer[(self._newest - whole - 1) % len(self._buffer), self._rigs]
        return np.where(self._steps > 0, (1 - share) * near + share * far, undelayed)


class Bristles:
    """LuGre friction: F = σ₀ z + σ₁ ż,  ż = Ω − σ₀|Ω| z/g(Ω),  g = F_c (1 + e exp(−(Ω/v_s)²))."""

    def __init__(self, inertia: FloatArray, bend: float | FloatArray) -> None:
        self._inertia, self._sliding_bend = inertia, bend  # rad at which they slide
        self._bend = np.zeros_like(inertia)
        self.shape(self._bend, self._bend, np.ones_like(inertia))

    def shape(self, torque: FloatArray, excess: FloatArray, velocity: FloatArray) -> None:
        """Set F_c, e and v_s, (n,) each; the bristles stay as bent as they are."""
        self._torque, self._excess, self._velocity = torque, excess, velocity
        self._stiffness = torque / self._sliding_bend
        self._damping = np.sqrt(self._stiffness * self._inertia)

    def torque(self, rate: FloatArray, step: float) -> FloatArray:
        """The friction torque against the rate, N m, after the bristles have bent for a step."""
        if not self._torque.any():
            return np.zeros_like(rate)
        sliding = self._torque * (1 + self._excess * np.exp(-((rate / self._velocity) ** 2)))
        there = np.maximum(self._stiffness, 1e-12)
        end = np.sign(rate) * sliding / there
        speed = np.abs(rate) * there / np.maximum(sliding, 1e-12)
        bend = end + (self._bend - end) * np.exp(-speed * step)
        turning = (bend - self._bend) / step
        self._bend = bend
        return self._stiffness * bend + self._damping * turning


class Slips:
    """Springs in parallel, each of which slips at its own torque."""

    def __init__(self, spread: float | FloatArray = 1.0) -> None:
        self._spread = spread
        self._spring_torques: FloatArray | None = None
        self._angle: FloatArray | None = None

    def shape(self, torque: FloatArray, width: FloatArray) -> None:
        """Set the torque at which all slip and the width of the loop, (n,) each."""
        self._yield = torque / len(_SLIPS)
        where = [s * width * self._spread for s in _SLIPS]
        self._stiffness = [self._yield / np.maximum(at, 1e-3) for at in where]
        if self._spring_torques is None:
            self._spring_torques = np.zeros((len(_SLIPS), len(torque)))

    def torque(self, angle: FloatArray) -> FloatArray:
        """The torque against the travel, N m."""
        assert self._spring_torques is not None
        increment = 0.0 if self._angle is None else angle - self._angle
        self._angle = angle
        for i, stiffness in enumerate(self._stiffness):
            self._spring_torques[i] = np.clip(
                self._spring_torques[i] + stiffness * increment, -self._yield, self._yield
            )
        total: FloatArray = self._spring_torques.sum(axis=0)
        return total


class Oscillator:
    """A lightly damped mass on the moving beam: δ̈ + 2ζω₀δ̇ + ω₀²δ = −α̈, of which a share is seen."""

    def __init__(self, share: FloatArray, frequency: FloatArray, damping: FloatArray) -> None:
        self._share = share
        self._pulsation = 2 * np.pi * np.maximum(frequency, 0.1)
        self._damping = damping
        self._deflection, self._speed = np.zeros_like(share), np.zeros_like(share)

    @property
    def angle_contribution(self) -> FloatArray:
        """What it adds to the angle, rad."""
        return self._share * self._deflection

    def advance(self, acceleration: FloatArray, step: float) -> None:
        """Semi-implicit, which keeps the energy of an undamped one."""
        w = self._pulsation
        restoring = -2 * self._damping * w * self._speed - w**2 * self._deflection
        self._speed = self._speed + step * (restoring - acceleration)
        self._deflection = self._deflection + step * self._speed


class Play:
    """What follows a value loosely: it moves once the play of ± a width is used up."""

    def __init__(self) -> None:
        self._at: FloatArray | None = None

    def follow(self, value: FloatArray, width: FloatArray) -> FloatArray:
        """Where it is after the value has come here, (n,); without width at the value."""
        before = value if self._at is None else self._at
        self._at = np.clip(before, value - width, value + width)
        return self._at
