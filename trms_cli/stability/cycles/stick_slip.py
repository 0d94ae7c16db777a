"""Hunting of one axis in the loop of a PID: the linear loop, its event map, and one harmonic.

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

For a rate Ω = A sin ωt without a stop, the first harmonic of the moment of friction is N(A) Ω with

    Coulomb     N = 4 F_c/(π A)
    Stribeck    N = 4 F_c/(π A) (1 + e (v_s/A) D(A/v_s))         D: Dawson's integral

since ``∫₀^{π/2} exp(−a² sin²θ) sin θ dθ = D(a)/a``. Both are real: with G(jω) the rate by the
friction's moment, a cycle needs G(jω) = −1/N(A), a crossing of the negative real axis, and an axis
that never stops. Hunting is not of that kind.

An axis that sticks has no rate of that form. There, the moment that the loop puts on the axis is
taken for a sine instead, T = X sin ωt, and the axis with its inertia and its friction,
``J Ω̇ + friction = T``, answers with stops; M(X, ω) is the first harmonic of its rate over that of T
(a sinusoidal-input describing function, by simulation of the block; Gelb & Vander Velde 1968,
"Multiple-Input Describing Functions", ch. 2; with friction Armstrong-Hélouvry & Amin 1996,
Automatica 32). The rest of the loop is T = −Z Ω, Z = 1/G − jωJ, and the balance

    Z(jω) = −1/M(X, ω).

Of hunting it is a rough picture: the moment on an axis that sticks is a ramp, no sine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.controllers.controller import ControlSetup
from trms_cli.controllers.pid import Pid
from trms_cli.controllers.pid_law import AxisLaw
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
    def stick_matrix(self) -> FloatArray:
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


def law_matrices(axis: AxisLaw) -> tuple[FloatArray, FloatArray, FloatArray, float]:
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
    multipliers: ComplexArray
    swing: float  #: Peak to peak of the angle, rad

    @property
    def period(self) -> float:
        """s."""
        return 2.0 * (self.half.stick + self.half.slip)

    @property
    def stuck_share(self) -> float:
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

        halves = [expm(self.loop.stick_matrix * (_COARSE / 2.0**k)) for k in range(_BISECTIONS + 1)]
        return expm(self.loop.stick_matrix * _FINE), halves

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
        breakaway = self.stick(z)
        slipped = None if breakaway is None else self.slip(breakaway[0])
        if breakaway is None or slipped is None:
            return None
        (broken, stick), (end, slip, direction) = breakaway, slipped
        return Slip(z, broken, end, stick, slip, direction)

    def ramp(self, error: float) -> FloatArray:
        """State at break-away after a long stick at an angle's deviation (rad).

        Everything but the integral has settled to its ramp.
        """
        loop, matrix = self.loop, self.loop.stick_matrix
        size = 1.0 / np.maximum(np.abs(matrix @ matrix).max(axis=1), 1e-12)
        rows = np.vstack([size[:, None] * (matrix @ matrix), loop.rate, loop.angle, loop.holding])
        targets = np.zeros(len(rows))
        targets[-2:] = error, np.sign(error) * self.law.breakaway
        return np.asarray(np.linalg.lstsq(rows, targets, rcond=1e-13)[0])

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
                trial_image = self._mirrored(trial)
                if trial_image is not None and (
                    np.abs((trial_image - trial) / scale).max() < np.abs(miss / scale).max()
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


#: Errors at a stick at which the map is looked at, over what F_s moves; see :func:`errors_of`.
_LEAST, _MOST, _COUNT = 1e-3, 4.0, 28
#: Iterations of the map before Newton's method.
_ITERATIONS = 12
#: Relative change of the swing at which they end.
_SETTLED = 1e-4


@dataclass(frozen=True)
class HuntingPrediction:
    """What the linear loop says."""

    #: (n,) arrays; The map: the error at a stick, and that at the next one with its sign turned
    #: (positive: the slip crossed the reference), rad
    errors: FloatArray
    following: FloatArray  #: (n,) arrays; NaN where a slip does not end
    cycle: Cycle | None  #: The hunting cycle
    #: rad: a stick at a smaller error leads to rest, at a larger one to the cycle
    threshold: float | None
    #: The same map for Coulomb friction alone is linear: its factor. Below 1 in size: no hunting.
    coulomb: float


def errors_of(loop: FrictionLoop, law: FrictionLaw, count: int = _COUNT) -> FloatArray:
    """Errors that are worth a look: around the one that friction's moment holds off, rad.

    The angle that F_s moves without the integral is its measure: the static stiffness of what is
    left is taken at the frequency where the loop is stiffest against the friction.
    """
    omega = np.geomspace(1e-2, 1e2, 400)
    yielding = float((np.abs(loop.response(omega)) / omega).max())
    return np.geomspace(_LEAST, _MOST, count) * law.breakaway * yielding


def predict(events: StickSlip, count: int = _COUNT) -> HuntingPrediction:
    """The map, its threshold, and the stable cycle."""
    errors = errors_of(events.loop, events.law, count)
    following = _following(events, errors)
    grows = np.flatnonzero(np.nan_to_num(following / errors, nan=0.0) > 1.0)
    middle = errors[len(errors) // 2 : len(errors) // 2 + 1]
    alone = events.with_law(replace(events.law, excess=0.0))
    coulomb = -float(_following(alone, middle)[0] / middle[0])
    if not grows.size:
        return HuntingPrediction(errors, following, None, None, coulomb)
    threshold = _threshold(events, errors, int(grows[0]))
    cycle = _cycle(events, float(errors[grows[-1]]))
    if threshold is not None:
        # Points close to the threshold, where the map jumps, and a gap in between.
        near = threshold * np.array([0.8, 0.9, 0.96, 0.99, 0.998, 1.002, 1.01, 1.05, 1.12])
        errors = np.concatenate([errors, near, [threshold]])
        following = np.concatenate([following, _following(events, near), [np.nan]])
        order = np.argsort(errors, kind="stable")
        errors, following = errors[order], following[order]
    return HuntingPrediction(errors, following, cycle, threshold, coulomb)


def _following(events: StickSlip, errors: FloatArray) -> FloatArray:
    """The map at several errors: the next one's mirror image; NaN where a slip does not end."""
    after = [events.next_error(float(error)) for error in errors]
    return np.array([np.nan if error is None else -error for error in after])


def _threshold(events: StickSlip, errors: FloatArray, first: int) -> float | None:
    """Where the map begins to grow, by bisection."""
    if first == 0:
        return None
    low, high = float(errors[first - 1]), float(errors[first])
    for _ in range(14):
        middle = float(np.sqrt(low * high))
        following = events.next_error(middle)
        if following is not None and -following > middle:
            high = middle
        else:
            low = middle
    return high


def _cycle(events: StickSlip, error: float) -> Cycle | None:
    z = events.settled(error)
    if z is None:
        return None
    for _ in range(_ITERATIONS):
        half = events.half(z)
        if half is None:
            return None
        z = -half.end
    if abs(float(events.loop.angle @ z)) < 1e-7:
        return None
    return events.cycle(z)


def swings(events: StickSlip, laws: Sequence[FrictionLaw]) -> FloatArray:
    """Predicted swing for several frictions, rad; NaN where the loop does not hunt."""
    return np.array([_swing(events.with_law(law)) for law in laws])


def _swing(events: StickSlip) -> float:
    """By iterating the map; no multipliers."""
    errors = errors_of(events.loop, events.law, 14)
    grows = np.flatnonzero(_following(events, errors) > errors)
    if not grows.size:
        return float("nan")
    z = events.settled(float(errors[grows[-1]]))
    travel = float("nan")
    for _ in range(_ITERATIONS):
        half = None if z is None else events.half(z)
        if half is None:
            return float("nan")
        before, travel = travel, abs(float(events.loop.angle @ (half.end - half.start)))
        if abs(travel - before) < _SETTLED * travel:
            break
        z = -half.end
    return travel if travel > 1e-6 else float("nan")


@dataclass(frozen=True)
class Harmonics:
    """What one harmonic says."""

    omega: FloatArray  #: (n,) array; rad/s
    response: ComplexArray  #: (n,) complex array; G(jω)
    #: Amplitude (rad/s) and frequency (rad/s) of a cycle that never sticks
    sliding: tuple[float, float] | None
    balance: Balance | None  #: Of an axis that sticks
    impedance: ComplexArray  #: (n,) complex array; Z(jω)
    #: (k,) complex array; −1/M(X, ω*) over X at the balance's frequency (empty without one)
    inverse: ComplexArray


def harmonics(loop: FrictionLoop, law: FrictionLaw) -> Harmonics:
    """Describing functions of the friction with this loop."""
    omega = np.geomspace(0.02, 60.0, 1200)
    one = HarmonicBalance(loop, law)
    balance = one.solved()
    inverse = np.zeros(0, dtype=complex)
    if balance is not None:
        over = max(balance.moment - law.breakaway, 1e-6 * law.breakaway)
        moments = law.breakaway + over * np.geomspace(0.3, 300.0, 60)
        ratios = np.array([one.answer(float(X), balance.omega).ratio for X in moments])
        inverse = -1.0 / ratios[np.abs(ratios) > 1e-9]
    response, sliding = loop.response(omega), sliding_cycle(loop, law, omega)
    return Harmonics(omega, response, sliding, balance, one.impedance(omega), inverse)


#: Steps of a period; periods until the block's answer repeats itself.
_OF_A_PERIOD, _REPEATED = 1000, 4
#: Grid on which a first guess is sought: moments over F_s, rad/s.
_MOMENTS, _OMEGAS = np.array([1.02, 1.1, 1.3, 1.7, 2.5]), np.geomspace(0.1, 4.0, 12)
#: Largest |1 + Z M| of a solution, and its largest distance to the grid: further down in frequency
#: the axis just sticks, and the balance is met better and better without ever being a cycle.
_BALANCED, _SLOWEST = 1e-3, 0.15


@dataclass(frozen=True)
class AxisResponse:
    """What an axis with friction does under a sine of the moment."""

    ratio: complex  #: M: first harmonic of the rate over the moment, (rad/s)/(N m)
    swing: float  #: Peak to peak of the angle, rad
    stuck_share: float  #: Share of the period at rest


@dataclass(frozen=True)
class Balance:
    """A solution of the harmonic balance."""

    moment: float  #: X, N m
    omega: float  #: rad/s
    swing: float  #: Peak to peak of the angle, rad
    stuck_share: float  #: Share of the period

    @property
    def period(self) -> float:
        """s."""
        return 2.0 * np.pi / self.omega


@dataclass(frozen=True)
class HarmonicBalance:
    """One harmonic of the moment on an axis that sticks."""

    loop: FrictionLoop
    law: FrictionLaw

    @cached_property
    def _step(self) -> BufferedFunction:
        """``(Ω, push, [F_c h/J, e, v_s]) → Ω⁺``: Moreau's time stepping, as the simulation's."""
        rate, push, sizes = ca.SX.sym("rate"), ca.SX.sym("push"), ca.SX.sym("sizes", 3)
        free = rate + push
        mean = (rate + free) / 2
        after = free
        for _ in range(3):
            most = sizes[0] * (1 + sizes[1] * ca.exp(-((mean / sizes[2]) ** 2)))
            after = free - ca.fmin(ca.fmax(free, -most), most)
            mean = (rate + after) / 2
        return BufferedFunction(ca.Function("sticking_axis", [rate, push, sizes], [after]))

    def answer(self, moment: float, omega: float) -> AxisResponse:
        """The axis under ``moment · sin(omega t)``."""
        h, inertia = 2.0 * np.pi / omega / _OF_A_PERIOD, 1.0 / self.loop.mobility
        middles = 2.0 * np.pi * (np.arange(_OF_A_PERIOD) + 0.5) / _OF_A_PERIOD
        pushes = (moment * np.sin(middles) * h / inertia).tolist()
        step = self._step
        rate, push, sizes = step.inputs
        after = step.outputs[0]
        sizes[:] = [self.law.torque * h / inertia, self.law.excess, self.law.velocity]
        rate[0] = 0.0
        rates = np.empty(_OF_A_PERIOD)
        for _ in range(_REPEATED):
            for k, value in enumerate(pushes):
                push[0] = value
                step()
                rate[0] = rates[k] = after[0]
        ends = 2.0 * np.pi * (np.arange(_OF_A_PERIOD) + 1.0) / _OF_A_PERIOD
        first = 2j / _OF_A_PERIOD * np.sum(rates * np.exp(-1j * ends))
        swing = float(np.ptp(np.cumsum(rates - rates.mean()) * h))
        return AxisResponse(complex(first / moment), swing, float(np.mean(rates == 0.0)))

    def impedance(self, omega: npt.ArrayLike) -> ComplexArray:
        """Z(jω): the moment that the loop puts on the axis against its rate, N m s/rad."""
        at = np.atleast_1d(np.asarray(omega, dtype=float))
        return np.asarray(1.0 / self.loop.response(at) - 1j * at / self.loop.mobility)

    def misfit(self, moment: float, omega: float) -> complex:
        """1 + Z M."""
        return 1.0 + complex(self.impedance(omega)[0]) * self.answer(moment, omega).ratio

    def solved(self) -> Balance | None:
        """The harmonic balance; None where it has no solution."""
        from scipy.optimize import root

        limit = self.law.breakaway
        grid = [
            (abs(self.misfit(limit * share, float(omega))), limit * share, float(omega))
            for omega in _OMEGAS
            for share in _MOMENTS.tolist()
        ]

        def equations(v: FloatArray) -> list[float]:
            error = self.misfit(limit * float(np.exp(v[0])), float(np.exp(v[1])))
            return [error.real, error.imag]

        for _, moment, omega in sorted(grid)[:4]:
            start = [np.log(moment / limit), np.log(omega)]
            solution = root(equations, start, options={"eps": 1e-3, "maxfev": 60, "xtol": 1e-6})
            moment, omega = limit * float(np.exp(solution.x[0])), float(np.exp(solution.x[1]))
            if not _SLOWEST < omega < 100.0:
                continue
            if abs(self.misfit(moment, omega)) < _BALANCED:
                response = self.answer(moment, omega)
                return Balance(moment, omega, response.swing, response.stuck_share)
        return None


def sliding_cycle(
    loop: FrictionLoop, law: FrictionLaw, omega: FloatArray
) -> tuple[float, float] | None:
    """(A, ω) of a cycle without a stop, by G(jω) = −1/N(A); None where there is none.

    A crossing of the negative real axis at −1/N(A) for some amplitude: N falls from infinity to
    zero, so that every crossing is a solution.
    """
    from scipy.optimize import brentq

    G = loop.response(omega)
    turns = np.flatnonzero((np.diff(np.sign(G.imag)) != 0) & (G.real[:-1] < 0))
    if not turns.size:
        return None
    k = int(turns[-1])

    def at(w: float) -> complex:
        return complex(loop.response(np.array([w]))[0])

    w = float(brentq(lambda w: at(w).imag, omega[k], omega[k + 1]))
    target = -1.0 / at(w).real
    amplitude = brentq(lambda a: float(law.describing(a)) - target, 1e-9, 1e6)
    return float(amplitude), w
