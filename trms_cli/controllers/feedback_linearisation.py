"""Feedback linearisation of the beam by virtual moments, with the rotors in an inner loop.

For each axis, with the reference r̃ behind three equal lags, e = r̃ − α, and the acceleration a
that the model expects of the present moments,

    v = d²r̃/dt² + (1/λ) d³r̃/dt³ + k_d ė + k_p e + I       acceleration asked for
    m = arm F(ω) + M⁻¹ (v − a − ȧ/λ)                        virtual moments
    ω_m = F⁻¹(m / arm)                                      within what full commands hold
    ω̇ = λ (ω_m − ω)                                        rotor loop, by the inverse of its motor
    I⁺ = I + T k_i e                                        held while a command is at its limit

so that the moment follows the one asked for with the rotor loop's lag 1/λ, and the error obeys

    s⁴ + λ s³ + λ k_d s² + λ k_p s + λ k_i = Π (s + p_i)

whose rates p_i are chosen: they give λ and the gains. ȧ is the rate of the acceleration but for the
rotors' part, so that neither gravity nor damping enters the error. Where a rotor is at its fastest,
I takes back what the moments cannot give (back-calculation). The third derivative of r̃ is cut so
that what is fed forward stays within the rotors' thrust.

Full linearisation to the input would divide by dF/dω, which is zero at ω = 0. A cascade with the
inverse of the thrust curve does not: it is exact for small steps around any speed but zero, and
close to it otherwise. The reaction K ω̇ of a rotor that changes its speed is left to the feedback:
to cancel it through the other rotor makes that one's reaction come back on the first, and the
commands chatter.

Sources: Isidori, "Nonlinear Control Systems", 1995, ch. 5; for the virtual moments of rotor rigs
Mahony, Kumar & Corke 2012 (IEEE Robotics & Automation Magazine 19).

What the law asks of a model is symbolic, for any rotor rig. The angles' rates are rows of the
model, α̇ = f_α(x). Along the motion

    α̈ = a(x, u, w) + K(x) ω̇        a = Σ ∂f_α/∂x_i ẋ_i over all states but the rotors'

with K ω̇ the reaction of rotors that change their speed, which a leaves out. A moment on an axis
enters a by the mobility M = ∂a/∂w (the inverse inertia, coupled where the model has it), and a
rotor gives m = arm · F(ω). The law chooses m, thus ω = F⁻¹(m/arm), thus the command that lets the
rotor get there: F(ω), going as ω|ω|, is inverted and never differentiated, so that a rotor that
stands still is no singularity.

Armature currents that are states follow the command at once: they are put at their rest.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from trms_cli.controllers.controller import (
    Command,
    ControlSample,
    ControlSetup,
    Delay,
    PresentReference,
)
from trms_cli.controllers.fallback import NOT_FINITE, are_finite, hold_command
from trms_cli.controllers.pid_feed_forward import ROTOR_OF_AXIS, PiecewiseLinear
from trms_cli.controllers.reference_forecast import ReferenceForecast
from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.core.ranges import Positive
from trms_cli.models.model import Model, names
from trms_cli.models.steady_state import SteadyState, Target

#: Part of the largest thrust that a reference may ask for; the rest is left to the feedback.
_FOR_REFERENCE = 0.9
_LAGS = 3  # on the reference
#: Below this part of the largest speed the inverse of the thrust has a finite slope.
_STANDING = 0.06
#: Largest acceleration of an axis by another's rotor, as a share of its own rotor's.
_LARGEST_SHARE = 0.3
_POINTS = 200  # of the inverse, on either side
_DOUBLINGS, _HALVINGS = 40, 60  # to find the speed that a full command holds
#: Newton iterations for the command of an acceleration; one is enough for a straight interface.
_ITERATIONS = 4


@dataclass(frozen=True)
class AxisPart:
    """One axis with its rotor; all by position."""

    name: str  #: ``pitch`` or ``yaw``
    state: int  #: Of the angle in x
    reference: int  #: Of the angle among the references
    rotor: int  #: Of the rotor's speed in x
    channel: int  #: Of the rotor's input in u
    speed: PiecewiseLinear  #: Speed by thrust, rad/s by N, up to the speeds that full commands hold
    thrust: PiecewiseLinear  #: Its inverse


@dataclass(frozen=True)
class VirtualMoments:
    """Compiled functions of a model's axes; n_a axes, in the order of ``axes``."""

    axes: tuple[AxisPart, ...]
    #: (x, u, w) → rates α̇ (n_a,), a (n_a,), its rate but for the rotors' part (n_a,), M (n_a,
    #: n_a), arms (n_a,), thrusts (n_a,)
    motion: BufferedFunction
    #: (x, u, w, ω̇ wanted (n_a,)) → u within its limits (n_u,), ω̇ with it (n_a,)
    command: BufferedFunction


def virtual_moments(model: Model) -> VirtualMoments:
    """The axes of a model.

    Raises ConfigurationError for a model without derivative, without a thrust that follows from a
    rotor's speed, whose rotors drive each other's axis, or that controls something else than the
    angles of its axes.
    """
    if model.sample_time is not None:
        raise _refusal(model, "has no derivative")
    x, u, _, w = model.symbols()
    p = ca.DM(model.parameters.values)
    quantities = model.quantities(x, u, p)
    axes = [name for name, axis in model.axes.items() if axis.angle in model.controlled]
    if not axes or len(axes) != len(model.controlled):
        raise _refusal(model, "controls something else than the angles of its axes")
    turning, rotors, arms, thrusts = [], [], [], []
    for name in axes:
        rotor = model.rotor_of(name)
        thrust, arm = (quantities.get(f"{what}_{rotor}") for what in ("thrust", "arm"))
        if thrust is None or arm is None or rotor is None:
            raise _refusal(model, f"says nothing of a thrust that moves {name}")
        on = np.flatnonzero(np.array(ca.DM(ca.jacobian(thrust, x).sparsity()).full()))
        if len(on) != 1:
            raise _refusal(model, f"has no single rotor speed that the thrust on {name} follows")
        turning.append(rotor)
        rotors.append(int(on[0]))
        thrusts.append(thrust)
        arms.append(arm)
    angles = [model.state_index(model.axes[name].angle) for name in axes]
    moments = [names(model.disturbances).index(model.axes[name].moment) for name in axes]
    channels = [names(model.inputs).index(model.rotors[rotor].input) for rotor in turning]

    f = model.dynamics(x, u, p, w)
    rate = f[angles]
    others = [i for i in range(model.n_x) if i not in rotors]
    along = f[others]
    a = ca.jtimes(rate, x[others], along) if others else rate
    change = ca.jtimes(a, x[others], along)
    motion = ca.Function(
        "motion",
        [x, u, w],
        ca.cse(
            [
                rate,
                a,
                change,
                ca.densify(ca.jacobian(a, w[moments])),
                ca.vertcat(*arms),
                ca.vertcat(*thrusts),
            ]
        ),
    )
    spin = _spin(model, f, x, u, rotors, channels)
    spinning = ca.Function("spin", [x, u, w], [spin])
    parts = []
    for i, name in enumerate(axes):
        of_speed = ca.Function("thrust", [x], [thrusts[i]])
        speed = _inverse(model, spinning, of_speed, rotors[i], channels[i], i)
        if speed is None:
            raise _refusal(model, f"has a thrust on {name} that does not rise with the speed")
        parts.append(
            AxisPart(
                name,
                angles[i],
                model.controlled.index(model.axes[name].angle),
                rotors[i],
                channels[i],
                speed,
                speed.inverse(),
            )
        )
    _require_own_axis(model, ca.Function("acceleration", [x, u, w], [a]), parts)
    return VirtualMoments(
        tuple(parts),
        BufferedFunction(motion),
        BufferedFunction(_commanding(model, spinning, channels)),
    )


def _require_own_axis(model: Model, acceleration: ca.Function, parts: list[AxisPart]) -> None:
    """Refuse a rig whose rotors drive each other's axis: the moments here are one a rotor."""
    u, w = np.zeros(model.n_u), np.zeros(model.n_w)
    still = np.array(acceleration(np.zeros(model.n_x), u, w)).ravel()
    responses = []
    for part in parts:
        x = np.zeros(model.n_x)
        x[part.rotor] = part.speed.y[-1]
        responses.append(np.abs(np.array(acceleration(x, u, w)).ravel() - still))
    for j, part in enumerate(parts):
        for i, other in enumerate(parts):
            if i != j and responses[j][i] > _LARGEST_SHARE * responses[i][i]:
                raise _refusal(model, f"drives {other.name} by the rotor of {part.name} as well")


def _refusal(model: Model, why: str) -> ConfigurationError:
    return ConfigurationError(
        f"model {model.name!r} {why}: its moments cannot be inverted axis by axis",
        where="controller",
        remedy="choose a model of a rotor rig (newtonian, lagrangian, tras), or another "
        "controller (controller=newton_mpc)",
    )


def _spin(
    model: Model, f: ca.SX, x: ca.SX, u: ca.SX, rotors: list[int], channels: list[int]
) -> ca.SX:
    """ω̇ of the rotors by the command, the currents between them at rest."""

    def depends(on: ca.SX, value: ca.SX) -> list[int]:
        return np.flatnonzero(
            np.array(ca.DM(ca.jacobian(value, on).sparsity()).full()).any(0)
        ).tolist()

    spin = f[rotors]
    fast = [
        i for i in depends(x, spin) if i not in rotors and set(depends(u, f[i])) & set(channels)
    ]
    if not fast:
        return spin
    currents, rates = x[fast], f[fast]
    at_rest = currents - ca.solve(ca.densify(ca.jacobian(rates, currents)), rates)
    return ca.substitute(spin, currents, at_rest)


def _commanding(model: Model, spinning: ca.Function, channels: list[int]) -> ca.Function:
    """The command that accelerates the rotors as wanted, each by its own input."""
    x, u, _, w = model.symbols()
    demand = ca.SX.sym("wanted", len(channels))
    lower, upper = model.input_bounds()
    at = ca.SX.sym("u", model.n_u)
    full = ca.SX.sym("x", model.n_x)
    push = ca.SX.sym("w", model.n_w)
    spin = spinning(full, at, push)
    slope = ca.diag(ca.jacobian(spin, at[channels]))
    step = ca.Function("step", [full, at, push], [spin, slope])
    reach = [
        (spinning(x, ca.DM(upper), w) - spinning(x, ca.DM(lower), w))[i]
        / float(upper[channel] - lower[channel])
        for i, channel in enumerate(channels)
    ]
    command = u
    for _ in range(_ITERATIONS):
        spin_now, slope_now = step(x, command, w)
        # Where the interface is flat, its mean slope finds the way out.
        slope_now = ca.fmax(slope_now, 1e-2 * ca.vertcat(*reach))
        values = [command[i] for i in range(model.n_u)]
        for i, channel in enumerate(channels):
            values[channel] = command[channel] + (demand[i] - spin_now[i]) / slope_now[i]
        command = ca.fmin(ca.fmax(ca.vertcat(*values), lower), upper)
    return ca.Function("command", [x, u, w, demand], ca.cse([command, spinning(x, command, w)]))


def _inverse(
    model: Model, spinning: ca.Function, thrust: ca.Function, rotor: int, channel: int, i: int
) -> PiecewiseLinear | None:
    """Speed by thrust between the speeds that the input's limits hold; None if it does not rise."""
    ends = []
    for bound in model.input_bounds():
        u = np.zeros(model.n_u)
        u[channel] = bound[channel]

        def accelerates(speed: float, u: FloatArray = u) -> float:
            x = np.zeros(model.n_x)
            x[rotor] = speed
            return float(spinning(x, u, np.zeros(model.n_w))[i])

        side = 1.0 if bound[channel] > 0 else -1.0
        far = 1.0
        for _ in range(_DOUBLINGS):
            if not accelerates(side * far) * side > 0:
                break
            far *= 2.0
        low, high = 0.0, far
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            low, high = (middle, high) if accelerates(side * middle) * side > 0 else (low, middle)
        ends.append(side * low)
    least, most = ends
    if not (least < 0 < most):
        return None
    share = np.linspace(_STANDING, 1.0, _POINTS)
    speeds = np.concatenate([least * share[::-1], most * share])
    x = np.zeros((model.n_x, len(speeds)))
    x[rotor] = speeds
    forces = np.array(thrust.map(len(speeds))(x)).ravel()
    if not np.all(np.diff(forces) > 0):
        return None
    return PiecewiseLinear(forces.tolist(), speeds.tolist())


def gains_of(rates: tuple[float, ...]) -> tuple[float, float, float, float]:
    """λ, k_d, k_p and k_i that put the poles of the error at −rates, 1/s."""
    _, c3, c2, c1, c0 = np.poly(-np.array(rates)).tolist()
    return c3, c2 / c3, c1 / c3, c0 / c3


@dataclass
class FeedbackLinearisationState:
    """The model's parts, and what is remembered."""

    parts: VirtualMoments
    steady: SteadyState  #: What references can be held
    gains: FloatArray  #: (4, n_a) array; λ, k_d, k_p, k_i
    guide: FloatArray  #: (n_a, 3) array; r̃ and its two derivatives, rad, rad/s, rad/s²
    integral: FloatArray  #: (n_a,) array; I, rad/s²
    lags: FloatArray  #: (n_a,) array; 1 over each of the reference's lags, 1/s
    forecast: ReferenceForecast
    delays: list[int]  #: Of the lags of each axis, in periods; 0 without forecast
    lower: FloatArray  #: Of the inputs, (n_u,), V
    upper: FloatArray  #: (n_u,), V
    period: float  #: T, s
    has_started: bool = False  #: Whether there was a sample yet
    target: Target | None = None  #: The steady state of the present reference

    def reachable(self, reference: FloatArray, goal: FloatArray) -> FloatArray:
        """What the axes are to go for (n_a,): as wanted, or the closest that can be held."""
        if self.target is None or self.target.reference != tuple(reference.tolist()):
            target = self.steady.solve(reference, None, self.target)
            if target.converged:
                self.target = target
        if self.target is None or not self.target.projected:
            return goal
        return self.target.reference_reached[[axis.reference for axis in self.parts.axes]]


@dataclass(frozen=True, kw_only=True)
class FeedbackLinearisation(PresentReference):
    """Feedback linearisation with rotor loops."""

    poles: Mapping[str, tuple[Positive, Positive, Positive, Positive]] = field(
        default_factory=lambda: {"pitch": (3.0, 3.0, 3.0, 0.7), "yaw": (3.0, 3.0, 3.0, 0.7)}
    )  #: Rates p_1 … p_4 of each axis' error, 1/s; their sum is the rotor loop's
    reference_lag: Mapping[str, Positive] = field(
        default_factory=lambda: {"pitch": 0.35, "yaw": 0.25}
    )  #: Each of three lags on the reference of an axis, s
    #: Whether a reference that has been a ramp or a sine is carried on by the delay of its lags
    #: (:mod:`trms_cli.controllers.reference_forecast`), so that they cost no time
    forecast: bool = True
    #: Whether the observer's disturbance is part of the model's acceleration
    use_disturbance: bool = True
    #: How fast the integral takes back what a rotor at its fastest cannot give, s
    tracking_time: Positive = 0.5
    sample_time: Positive | None = None  #: Control period, s; None takes every sample
    delay: Delay = "none"

    def __post_init__(self) -> None:
        for key, values in (("poles", self.poles), ("reference_lag", self.reference_lag)):
            for name in values:
                require_known(name, ROTOR_OF_AXIS, f"{name!r} is not an axis", key)
            for name in ROTOR_OF_AXIS:
                if name not in values:
                    raise ConfigurationError(
                        f"nothing given for {name}", where=f"{key}.{name}", remedy="give both axes"
                    )

    def init(self, setup: ControlSetup) -> FeedbackLinearisationState:
        parts = virtual_moments(setup.model)
        lower, upper = setup.model.input_bounds()
        n = len(parts.axes)
        lags = [self.reference_lag[axis.name] for axis in parts.axes]
        T = setup.sample_time
        delays = [round(_LAGS * lag / T) if self.forecast else 0 for lag in lags]
        return FeedbackLinearisationState(
            parts,
            SteadyState(setup.model),
            np.array([gains_of(self.poles[axis.name]) for axis in parts.axes]).T,
            np.zeros((n, 3)),
            np.zeros(n),
            1.0 / np.array(lags),
            ReferenceForecast(max(delays), len(setup.model.controlled)),
            delays,
            lower,
            upper,
            setup.sample_time,
        )

    def step(
        self, state: FeedbackLinearisationState, sample: ControlSample, *, want_prediction: bool
    ) -> Command:
        x, previous = sample.estimate.x, sample.previous_command
        reference = sample.reference[0]
        if not are_finite(x, sample.estimate.disturbance, reference):
            return hold_command(previous, NOT_FINITE)
        w = sample.estimate.disturbance * float(self.use_disturbance)
        axes = state.parts.axes
        rate, a, change, mobility, arms, thrusts = state.parts.motion.evaluate(x, previous, w)
        mobility = mobility.reshape(len(axes), len(axes))  # of a single axis it comes as a vector
        moments = arms * thrusts
        angles = x[[axis.state for axis in axes]]
        if not state.has_started:
            state.has_started = True
            state.guide[:, 0] = angles
        ahead = state.forecast.update(reference)
        goal = np.array(
            [
                ahead[min(delay, len(ahead) - 1), axis.reference]
                for axis, delay in zip(axes, state.delays, strict=True)
            ]
        )
        reachable = state.reachable(reference, goal)
        ends = np.array([(axis.speed.x[0], axis.speed.x[-1]) for axis in axes]).T
        reach = a + np.diag(mobility) * (_FOR_REFERENCE * arms * ends - moments)
        jerk = _guided(state, reachable, reach)
        r, r_rate, r_acceleration = state.guide.T
        rotor, kd, kp, ki = state.gains
        error = r - angles
        v = r_acceleration + jerk / rotor + kd * (r_rate - rate) + kp * error + state.integral
        try:
            demand = (moments + np.linalg.solve(mobility, v - a - change / rotor)) / arms
        except np.linalg.LinAlgError:
            return hold_command(previous, "the moments have no influence on the axes here")
        if not math.isfinite(float(demand.sum()) + float(jerk.sum())):
            return hold_command(previous, "the model's moments are not finite at this estimate")
        forces = np.clip(demand, *ends)
        speeds = [axis.speed.at(f) for axis, f in zip(axes, forces.tolist(), strict=True)]
        now = x[[axis.rotor for axis in axes]]
        u = state.parts.command.evaluate(x, previous, w, rotor * (speeds - now))[0].copy()
        lacking = mobility @ (arms * (forces - demand))
        if not math.isfinite(float(u.sum()) + float(lacking.sum())):
            return hold_command(previous, "the model's moments are not finite at this estimate")
        largest = np.abs(np.diag(mobility) * arms * (ends[1] - ends[0]))
        self._integrate(state, u, ki * error, lacking, largest)
        _advance(state, jerk)
        projected = state.target is not None and state.target.projected
        words = "the reference is out of reach; the closest is the target" if projected else ""
        return Command(u, message=words, out_of_reach=projected)

    def _integrate(
        self,
        state: FeedbackLinearisationState,
        u: FloatArray,
        slope: FloatArray,
        lacking: FloatArray,
        largest: FloatArray,
    ) -> None:
        """The integral of the error, what the rotors cannot give taken back.

        Never more than the rotors can give at all, so that one wild estimate does no lasting harm.
        """
        for i, axis in enumerate(state.parts.axes):
            limited = not state.lower[axis.channel] < u[axis.channel] < state.upper[axis.channel]
            if lacking[i] != 0.0:
                state.integral[i] += state.period * (slope[i] + lacking[i] / self.tracking_time)
            elif not limited:
                state.integral[i] += state.period * slope[i]
        np.clip(state.integral, -largest, largest, out=state.integral)


def _advance(state: FeedbackLinearisationState, jerk: FloatArray) -> None:
    """The reference's filter, one period on."""
    T, guide = state.period, state.guide
    guide[:, 2] += T * jerk
    guide[:, 1] += T * guide[:, 2]
    guide[:, 0] += T * guide[:, 1]


def _guided(
    state: FeedbackLinearisationState, reference: FloatArray, reach: FloatArray
) -> FloatArray:
    """d³r̃/dt³, cut so that the acceleration fed forward (2, n_a) is within reach."""
    f, rotor = state.lags, state.gains[0]
    r, rate, acceleration = state.guide.T
    jerk = f * (f * (f * (reference - r) - 3 * rate) - 3 * acceleration)
    # Whatever the rig does now, to come to rest is never forbidden.
    least, most = np.minimum(reach.min(axis=0), 0.0), np.maximum(reach.max(axis=0), 0.0)
    return np.clip(jerk, (least - acceleration) * rotor, (most - acceleration) * rotor)
