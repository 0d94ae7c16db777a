"""Stick and slip of one axis in a linear loop, from event to event: the Poincaré map of hunting.

While the axis sticks its rate is zero and the loop obeys ``ż = A_s z``: the integral ramps, until
the moment that holds the axis reaches the break-away moment F_s. Then it slips, in the direction s
in which it was pushed,

    ż = A z − s b F(|Ω|),   Ω = r z

until its rate is zero again. Sticking is propagated by the matrix exponential, slipping by the
classical Runge–Kutta step, and both events are found to rounding: no clock, no regularised sign.

The map H takes the state at the beginning of a stick to the mirror image of the state at the
beginning of the next one; the loop is odd, so that a fixed point of H is a symmetric cycle of two
sticks and two slips. The eigenvalues of H' are the cycle's multipliers over half a period, those of
(H')² its Floquet multipliers. As everything but the angle settles during a long stick, the map is
nearly one-dimensional: |error| at a stick over |error| at the one before.

After Armstrong-Hélouvry & Amin (1996, Automatica 32), Olsson & Åström (2001, IEEE TCST 9) and
Hensen, van de Molengraft & Steinbuch (2003, IFAC Robotics: hunting appears and vanishes by a fold).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.stability.cycles.friction_loop import FrictionLaw, FrictionLoop

#: s. Steps in which a stick is looked at, first and later; how long one may last.
_FINE, _FINE_UNTIL, _COARSE, LONGEST_STICK = 0.02, 4.0, 0.5, 3000.0
#: s. Step of a slip, and how long one may last.
_SLIP_STEP, LONGEST_SLIP = 0.004, 120.0
#: Halvings that find an event within a step.
_BISECTIONS = 40
_NEWTON = 20
#: Change of the state that counts as none, rad and the loop's other units.
_FIXED = 1e-9


@dataclass(frozen=True)
class Slip:
    """A stick and the slip after it."""

    #: ``start``, ``broken``, ``end``: (n,) arrays; states where the stick begins, where the slip
    #: begins, where it ends
    start: FloatArray
    broken: FloatArray
    end: FloatArray
    stick: float  #: s
    slip: float  #: s
    direction: float  #: ±1, of the slip


@dataclass(frozen=True)
class Cycle:
    """A symmetric hunting cycle."""

    half: Slip  #: One half of it
    #: (n,) complex array; floquet multipliers over the whole period, by falling size
    multipliers: npt.NDArray[np.complex128]
    swing: float  #: Peak to peak of the angle, rad

    @property
    def period(self) -> float:
        """s."""
        return 2.0 * (self.half.stick + self.half.slip)

    @property
    def stuck(self) -> float:
        """Share of the period at rest."""
        return 2.0 * self.half.stick / self.period

    @property
    def stable(self) -> bool:
        return bool(np.abs(self.multipliers).max() < 1.0)


class StickSlip:
    """Events of a loop with friction.

    Parameters
    ----------
    loop : FrictionLoop
    law : FrictionLaw
    """

    def __init__(self, loop: FrictionLoop, law: FrictionLaw) -> None:
        self.loop, self.law = loop, law

    def with_law(self, law: FrictionLaw) -> StickSlip:
        """The same loop with another friction; what is compiled is kept."""
        other = StickSlip(self.loop, law)
        other.__dict__.update({k: v for k, v in self.__dict__.items() if k != "law"})
        return other

    @cached_property
    def _step(self) -> BufferedFunction:
        """``(z, s, h, [F_c, e, v_s], A, b, r) → z⁺, Ω⁺`` of a slip; compiled once for a size."""
        loop, n = self.loop, len(self.loop.b)
        z, s, h, sizes = (ca.SX.sym(v, k) for v, k in (("z", n), ("s", 1), ("h", 1), ("f", 3)))
        A, b, r = ca.SX.sym("A", n, n), ca.SX.sym("b", n), ca.SX.sym("r", n)

        def f(at: ca.SX) -> ca.SX:
            ratio = ca.dot(r, at) / sizes[2]
            moment = sizes[0] * (1 + sizes[1] * ca.exp(-(ratio**2)))
            return A @ at - b * (s * moment)

        k1 = f(z)
        k2 = f(z + h / 2 * k1)
        k3 = f(z + h / 2 * k2)
        k4 = f(z + h * k3)
        after = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        inputs, results = [z, s, h, sizes, A, b, r], [after, ca.dot(r, after)]
        step = BufferedFunction(ca.Function("slip", inputs, results))
        for target, value in zip(step.inputs[4:], (loop.A, loop.b, loop.rate), strict=True):
            target[...] = value
        return step

    @cached_property
    def _sticking(self) -> tuple[FloatArray, FloatArray]:
        """Transitions of a stick by the fine and the coarse step."""
        from scipy.linalg import expm

        return expm(self.loop.stuck * _FINE), expm(self.loop.stuck * _COARSE)

    @cached_property
    def _halves(self) -> list[FloatArray]:
        """Transitions by a half, a quarter… of the coarse step, for bisection."""
        from scipy.linalg import expm

        return [expm(self.loop.stuck * (_COARSE / 2.0**k)) for k in range(1, _BISECTIONS + 1)]

    def stick(self, z: FloatArray) -> tuple[FloatArray, float] | None:
        """State at the next break-away and the time until then; None if it does not come."""
        fine, coarse = self._sticking
        holding, limit = self.loop.holding, self.law.breakaway
        time = 0.0
        while time < LONGEST_STICK:
            step, transition = (_FINE, fine) if time < _FINE_UNTIL else (_COARSE, coarse)
            after = transition @ z
            if abs(float(holding @ after)) >= limit:
                break
            z, time = after, time + step
        else:
            return None
        advanced = 0.0
        for k, transition in enumerate(self._halves, start=1):
            size = _COARSE / 2.0**k
            if advanced + size > step:
                continue
            after = transition @ z
            if abs(float(holding @ after)) < limit:
                z, advanced = after, advanced + size
        return z, time + advanced

    def slip(self, z: FloatArray) -> tuple[FloatArray, float, float] | None:
        """State where the next slip ends, its time and direction; None if it does not end."""
        direction = -float(np.sign(self.loop.holding @ z))
        step, law = self._step, self.law
        step.inputs[1][:] = direction
        step.inputs[2][:] = _SLIP_STEP
        step.inputs[3][:] = [law.torque, law.excess, law.velocity]
        now, after, rate = step.inputs[0], *step.outputs
        now[:] = z
        moving = False
        for k in range(round(LONGEST_SLIP / _SLIP_STEP)):
            step()
            turning = direction * float(rate.item())
            if turning > 0.0:
                moving = True
            elif moving or k > 5:
                break
            now[:] = after
        else:
            return None
        before = now.copy()
        low, high = 0.0, _SLIP_STEP
        for _ in range(_BISECTIONS):
            step.inputs[2][:] = middle = 0.5 * (low + high)
            step()
            if direction * float(rate.item()) > 0.0:
                low = middle
            else:
                high = middle
        now[:] = before
        step.inputs[2][:] = high
        step()
        end = after.copy()
        # To rounding the rate is zero: take off what is left, so that a stick holds it exactly.
        end -= self.loop.b * float(self.loop.rate @ end) / self.loop.mobility
        return end, k * _SLIP_STEP + high, direction

    def trace(self, half: Slip) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Time from break-away (s), angle (rad) and rate (rad/s) along a slip."""
        step, law = self._step, self.law
        now, after = step.inputs[0], step.outputs[0]
        step.inputs[1][:] = half.direction
        step.inputs[2][:] = _SLIP_STEP
        step.inputs[3][:] = [law.torque, law.excess, law.velocity]
        now[:] = half.broken
        states = [half.broken]
        for _ in range(int(half.slip / _SLIP_STEP)):
            step()
            now[:] = after
            states.append(after.copy())
        path = np.array([*states, half.end])
        time = np.append(_SLIP_STEP * np.arange(len(states)), half.slip)
        return time, path @ self.loop.angle, path @ self.loop.rate

    def half(self, z: FloatArray) -> Slip | None:
        """The stick that begins at a state and the slip after it; None if either does not end."""
        held = self.stick(z)
        if held is None:
            return None
        broken, stick = held
        slipped = self.slip(broken)
        if slipped is None:
            return None
        end, slip, direction = slipped
        return Slip(z, broken, end, stick, slip, direction)

    def ramp(self, error: float) -> FloatArray:
        """State at break-away after a long stick at an angle's deviation (rad).

        Everything but the integral has settled to its ramp.
        """
        loop, stuck = self.loop, self.loop.stuck
        size = 1.0 / np.maximum(np.abs(stuck @ stuck).max(axis=1), 1e-12)
        rows = np.vstack([size[:, None] * (stuck @ stuck), loop.rate, loop.angle, loop.holding])
        wanted = np.zeros(len(rows))
        wanted[-2:] = error, np.sign(error) * self.law.breakaway
        return np.asarray(np.linalg.lstsq(rows, wanted, rcond=1e-13)[0])

    def next_error(self, error: float) -> float | None:
        """The deviation where the next stick begins, after a long one at ``error``, rad."""
        slipped = self.slip(self.ramp(error))
        return None if slipped is None else float(self.loop.angle @ slipped[0])

    def settled(self, error: float) -> FloatArray | None:
        """State where a stick begins, for a symmetric cycle with about this deviation, rad."""
        slipped = self.slip(self.ramp(error))
        return None if slipped is None else -slipped[0]

    def cycle(self, z: FloatArray) -> Cycle | None:
        """The symmetric cycle near the beginning of a stick, by Newton's method on H(z) = z."""
        scale = np.maximum(np.abs(z), 1e-6 * np.abs(z).max())
        best: FloatArray = z
        for _ in range(_NEWTON):
            image = self._mirrored(best)
            if image is None:
                return None
            miss = image - best
            slope = self._slope(best, scale)
            if slope is None:
                return None
            if np.abs(miss / scale).max() < _FIXED / 1e-3:
                half = self.half(best)
                assert half is not None
                values = np.linalg.eigvals(slope @ slope)
                order = np.argsort(-np.abs(values))
                return Cycle(half, values[order].astype(complex), self._swing(half))
            change = np.linalg.lstsq(slope - np.eye(len(z)), -miss, rcond=1e-12)[0]
            for halving in range(5):
                trial = best + change / 2.0**halving
                tried = self._mirrored(trial)
                if tried is not None and (
                    np.abs((tried - trial) / scale).max() < np.abs(miss / scale).max()
                ):
                    break
            else:
                return None
            best = trial
        return None

    def _mirrored(self, z: FloatArray) -> FloatArray | None:
        half = self.half(z)
        return None if half is None else -half.end

    def _slope(self, z: FloatArray, scale: FloatArray) -> FloatArray | None:
        """H' by central differences."""
        n = len(z)
        slope = np.empty((n, n))
        for i in range(n):
            away = np.zeros(n)
            away[i] = 1e-5 * scale[i]
            one, other = self._mirrored(z + away), self._mirrored(z - away)
            if one is None or other is None:
                return None
            slope[:, i] = (one - other) / (2.0 * away[i])
        return slope

    def _swing(self, half: Slip) -> float:
        """Peak to peak of the angle: within a slip it moves one way."""
        return abs(float(self.loop.angle @ (half.end - half.start)))
