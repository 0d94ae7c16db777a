"""What a model says of its axes to a law that asks for moments: symbolic, for any rotor rig.

The angles' rates are rows of the model, α̇ = f_α(x). Along the motion

    α̈ = a(x, u, w) + K(x) ω̇        a = Σ ∂f_α/∂x_i ẋ_i over all states but the rotors'

with K ω̇ the reaction of rotors that change their speed, which a leaves out. A moment on an axis
enters a by the mobility M = ∂a/∂w (the inverse inertia, coupled where the model has it), and a
rotor gives m = arm · F(ω). The law chooses m, thus ω = F⁻¹(m/arm), thus the command that lets the
rotor get there: F(ω), going as ω|ω|, is inverted and never differentiated, so that a rotor that
stands still is no singularity.

Armature currents that are states follow the command at once: they are put at their rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.controllers.pid_feed_forward import Table
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.model import Model, names

FloatArray = npt.NDArray[np.float64]

ROTOR_OF_AXIS = {"pitch": "main", "yaw": "tail"}
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
    state: int  #: Of the angle in x, and of its reference
    reference: int  #: Of the angle in x, and of its reference
    rotor: int  #: Of the rotor's speed in x
    channel: int  #: Of the rotor's input in u
    speed: Table  #: Speed by thrust, rad/s by N, up to the speeds that full commands hold
    thrust: Table  #: Its inverse


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
    rotors, arms, thrusts = [], [], []
    for name in axes:
        rotor = ROTOR_OF_AXIS.get(name, "")
        thrust, arm = (quantities.get(f"{what}_{rotor}") for what in ("thrust", "arm"))
        if thrust is None or arm is None or rotor not in model.rotors:
            raise _refusal(model, f"says nothing of a thrust that moves {name}")
        on = np.flatnonzero(np.array(ca.DM(ca.jacobian(thrust, x).sparsity()).full()))
        if len(on) != 1:
            raise _refusal(model, f"has no single rotor speed that the thrust on {name} follows")
        rotors.append(int(on[0]))
        thrusts.append(thrust)
        arms.append(arm)
    angles = [model.state_index(model.axes[name].angle) for name in axes]
    moments = [names(model.disturbances).index(model.axes[name].moment) for name in axes]
    channels = [names(model.inputs).index(model.rotors[ROTOR_OF_AXIS[name]]) for name in axes]

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
    moved = []
    for part in parts:
        x = np.zeros(model.n_x)
        x[part.rotor] = part.speed.y[-1]
        moved.append(np.abs(np.array(acceleration(x, u, w)).ravel() - still))
    for j, part in enumerate(parts):
        for i, other in enumerate(parts):
            if i != j and moved[j][i] > _LARGEST_SHARE * moved[i][i]:
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
    wanted = ca.SX.sym("wanted", len(channels))
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
    chosen = u
    for _ in range(_ITERATIONS):
        spin_now, slope_now = step(x, chosen, w)
        # Where the interface is flat, its mean slope finds the way out.
        slope_now = ca.fmax(slope_now, 1e-2 * ca.vertcat(*reach))
        values = [chosen[i] for i in range(model.n_u)]
        for i, channel in enumerate(channels):
            values[channel] = chosen[channel] + (wanted[i] - spin_now[i]) / slope_now[i]
        chosen = ca.fmin(ca.fmax(ca.vertcat(*values), lower), upper)
    return ca.Function("command", [x, u, w, wanted], ca.cse([chosen, spinning(x, chosen, w)]))


def _inverse(
    model: Model, spinning: ca.Function, thrust: ca.Function, rotor: int, channel: int, i: int
) -> Table | None:
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
    return Table(forces.tolist(), speeds.tolist())
