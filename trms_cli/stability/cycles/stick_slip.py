"""Stick and slip of one axis in the loop of a PID: the linear loop, and the map of hunting.

The loop around a rig is linear, in continuous time, with the friction's moment open. The law of
:mod:`trms_cli.controllers.pid` is a linear difference equation while no limit is met and the
reference stands still. With θ the angle's deviation and c = [I, D₋, θ₋, v_f₋] for each axis

    D = a D₋ − d (θ − θ₋)                          v = −k_p θ + I + D
    v_f = (1 − s) v + s v_f₋                       m = v_f + λ (v − v_f)
    I⁺ = I − k_i T θ                               δu = φ'(m) m

φ' is the slope of the rotor's inverse curve. The bilinear map z = (1 + sT/2)/(1 − sT/2) turns it
into differential equations that agree with it up to (ωT)²/12; the hold is

    (1 − e^{−sT})/(sT) ≈ 1/(1 + sT/2 + s²T²/12)

(its Padé approximant). Together with the linearised rig:

    ż = A z + b τ,   Ω = r z        τ: the moment of friction on the axis, Ω: the axis' rate

so that stick-slip can be reckoned with matrices, without the clock, from event to event.

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

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.controllers.controller import ControlSetup
from trms_cli.controllers.pid import AxisState, Pid
from trms_cli.core.arrays import ComplexArray, FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.stribeck_friction import StribeckFriction
from trms_cli.models.dry_friction import moment_index
from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.subject import LoopParts, effects_of


@dataclass(frozen=True)
class FrictionLoop:
    """A linear loop with one axis' friction outside of it: ``ż = A z + b τ``, ``Ω = r z``."""

    A: FloatArray  #: (n, n) array
    b: FloatArray  #: (n,) array; by the friction's moment, per N m
    rate: FloatArray  #: (n,) array; r
    angle: FloatArray  #: (n,) array; row of the angle's deviation, rad

    @property
    def mobility(self) -> float:
        """r b: acceleration by a moment on the axis, 1/(kg m²)."""
        return float(self.rate @ self.b)

    @property
    def holding(self) -> FloatArray:
        """Row of the moment of friction that keeps the axis at rest, N m."""
        return -(self.rate @ self.A) / self.mobility

    @property
    def stuck(self) -> FloatArray:
        """A while the axis is held, (n, n)."""
        return self.A + np.outer(self.b, self.holding)

    def response(self, omega: FloatArray) -> ComplexArray:
        """G(jω): rate by the friction's moment, (rad/s)/(N m)."""
        n = len(self.b)
        resolvent = 1j * np.asarray(omega)[:, None, None] * np.eye(n) - self.A
        right = np.broadcast_to(self.b[:, None].astype(complex), (len(omega), n, 1))
        return np.asarray(np.linalg.solve(resolvent, right)[..., 0] @ self.rate)

    def stable(self) -> bool:
        """Whether the loop without friction is."""
        return bool(np.linalg.eigvals(self.A).real.max() < 0)


def law_matrices(axis: AxisState) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """The law of an axis, ``c⁺ = F c + g θ``, ``m = h c + d θ``, at its samples."""
    kp, ki = axis.gains.kp, axis.gains.ki
    share = axis.derivative_gain
    # Rows of D, v, v_f and m over [I, D₋, θ₋, v_f₋ | θ].
    derivative = np.array([0.0, axis.keep, share, 0.0, -share])
    v = derivative + np.array([1.0, 0.0, 0.0, 0.0, -kp])
    lagged = (1.0 - axis.slow) * v + axis.slow * np.array([0.0, 0.0, 0.0, 1.0, 0.0])
    moment = lagged + axis.lead * (v - lagged)
    integral = np.array([1.0, 0.0, 0.0, 0.0, -ki * axis.step])
    last = np.array([0.0, 0.0, 0.0, 0.0, 1.0])
    rows = np.array([integral, derivative, last, lagged])
    return rows[:, :4], rows[:, 4], moment[:4], float(moment[4])


def in_continuous_time(
    law: tuple[FloatArray, FloatArray, FloatArray, float], step: float
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """A law's matrices by the bilinear map."""
    F, g, h, d = law
    one, scale = np.eye(len(F)), 2.0 / np.sqrt(step)
    inverse = np.linalg.inv(F + one)
    whole = 2.0 / step * (F - one) @ inverse
    return whole, scale * inverse @ g, scale * h @ inverse, float(d - h @ inverse @ g)


def friction_loop(
    model: Model, loop: LoopParts, pid: Pid, point: OperatingPoint, axis: str
) -> FrictionLoop:
    """The loop of a PID around a rig at a point, with the friction of an axis open.

    The rig's friction as an impulse is no part of what is linearised.
    """
    period = pid.sample_time or loop.sample_time
    laws = pid.init(ControlSetup(loop.model, period, point.u)).axes
    field, rest = VectorField(model), np.zeros(model.n_w)
    A, B, _, W = map(np.array, field.slopes(point.x, point.u, field.parameters, rest))
    n, states = model.n_x, 6
    total = n + states * len(laws)
    whole = np.zeros((total, total))
    whole[:n, :n] = A
    row = model.state_index(model.axes[axis].angle)
    for i, law in enumerate(laws):
        F, g, h, d = in_continuous_time(law_matrices(law), period)
        slope = law.curve.slope(law.torque_of.at(float(point.u[law.channel])))
        c = slice(n + states * i, n + states * i + 4)
        first, second = n + states * i + 4, n + states * i + 5
        theta = model.state_index(loop.model.state_names[law.state])
        whole[c, c] = F
        whole[c, theta] = g
        # y'' T²/12 + y' T/2 + y = δu
        whole[first, second] = 1.0
        gain = 12.0 / period**2
        whole[second, first], whole[second, second] = -gain, -gain * period / 2.0
        whole[second, c] = gain * slope * h
        whole[second, theta] += gain * slope * d
        whole[:n, first] = B[:, law.channel]
    b, rate, angle = np.zeros(total), np.zeros(total), np.zeros(total)
    b[:n] = W[:, moment_index(model, axis)]
    rate[:n] = A[row]
    angle[row] = 1.0
    return FrictionLoop(whole, b, rate, angle)


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
    frictions = []
    for name, effect in effects_of(model):
        if isinstance(effect, CoulombFriction | StribeckFriction):
            sizes = {
                parameter.name.rsplit(".", 1)[-1]: parameter.value
                for parameter in model.parameters
                if parameter.name.startswith(f"{name}.")
            }
            frictions.append(Friction(name, effect.axis, FrictionLaw(**sizes)))
    return tuple(frictions)


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
    """Events of a loop with friction."""

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
    def _sticking(self) -> tuple[FloatArray, list[FloatArray]]:
        """Transitions of a stick by the fine step, and by the coarse one, its half, quarter…"""
        from scipy.linalg import expm

        halves = [expm(self.loop.stuck * (_COARSE / 2.0**k)) for k in range(_BISECTIONS + 1)]
        return expm(self.loop.stuck * _FINE), halves

    def stick(self, z: FloatArray) -> tuple[FloatArray, float] | None:
        """State at the next break-away and the time until then; None if it does not come."""
        fine, (coarse, *halves) = self._sticking
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
        for k, transition in enumerate(halves, start=1):
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
        step = self._slipping(z, direction)
        now, after, rate = step.inputs[0], *step.outputs
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

    def _slipping(self, z: FloatArray, direction: float) -> BufferedFunction:
        """The step of a slip that begins at a state."""
        step, law = self._step, self.law
        step.inputs[0][:] = z
        step.inputs[1][:] = direction
        step.inputs[2][:] = _SLIP_STEP
        step.inputs[3][:] = [law.torque, law.excess, law.velocity]
        return step

    def trace(self, half: Slip) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Time from break-away (s), angle (rad) and rate (rad/s) along a slip."""
        step = self._slipping(half.broken, half.direction)
        now, after = step.inputs[0], step.outputs[0]
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
        slipped = None if held is None else self.slip(held[0])
        if held is None or slipped is None:
            return None
        (broken, stick), (end, slip, direction) = held, slipped
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
                # Peak to peak: within a slip the angle moves one way.
                swing = abs(float(self.loop.angle @ (half.end - half.start)))
                return Cycle(half, values[order].astype(complex), swing)
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
