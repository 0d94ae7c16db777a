"""The loop of the PID around a rig, linear, in continuous time, with the friction's moment open.

The law of :mod:`trms_cli.controllers.pid` is a linear difference equation while no limit is met and
the reference stands still. With θ the angle's deviation and c = [I, D₋, θ₋, v_f₋] for each axis

    D = a D₋ − d (θ − θ₋)                          v = −k_p θ + I + D
    v_f = (1 − s) v + s v_f₋                       m = v_f + λ (v − v_f)
    I⁺ = I − k_i T θ                               δu = φ'(m) m

φ' is the slope of the rotor's inverse curve. The bilinear map z = (1 + sT/2)/(1 − sT/2) turns it
into differential equations that agree with it up to (ωT)²/12; the hold is

    (1 − e^{−sT})/(sT) ≈ 1/(1 + sT/2 + s²T²/12)

(its Padé approximant). Together with the linearised rig:

    ż = A z + b τ,   Ω = r z        τ: the moment of friction on the axis, Ω: the axis' rate

so that stick-slip can be reckoned with matrices, without the clock.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from trms_cli.controllers.controller import ControlSetup
from trms_cli.controllers.pid import AxisState, Pid
from trms_cli.core.arrays import ComplexArray, FloatArray
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
    inverse = np.linalg.inv(F + np.eye(len(F)))
    scale = 2.0 / np.sqrt(step)
    return (
        2.0 / step * (F - np.eye(len(F))) @ inverse,
        scale * inverse @ g,
        scale * h @ inverse,
        float(d - h @ inverse @ g),
    )


def friction_loop(
    model: Model, loop: LoopParts, pid: Pid, point: OperatingPoint, axis: str
) -> FrictionLoop:
    """The loop of a PID around a rig at a point, with the friction of an axis open.

    Parameters
    ----------
    model : Model
        The rig; its friction as an impulse is no part of what is linearised.
    loop : LoopParts
        The controller's model and the sample time.
    axis : str
        ``pitch`` or ``yaw``.
    """
    period = pid.sample_time or loop.sample_time
    laws = pid.init(ControlSetup(loop.model, period, point.u)).axes
    field = VectorField(model)
    parts = [
        np.array(m) for m in field.slopes(point.x, point.u, field.parameters, np.zeros(model.n_w))
    ]
    A, B, _, W = parts
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
