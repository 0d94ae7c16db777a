"""The coordinates in which the rig is regulated, and its step in them.

The yaw has no linear gain where the tail rotor stands still: the thrust goes as ω|ω|. In the
coordinate

    ψ = ω √(ω² + ε²)

which is the thrust up to its factor (|ψ − ω|ω|| ≤ ε²/2), the rotor is regulated by asking for the
ψ of the next period: the command that reaches it is found by inverting the model's own step, which
is monotone in the command at every speed, zero included. What is asked for is

    ψ⁺ − ψ_s = λ (ψ − ψ_s) + ν

and ν takes the command's place: it acts on the yaw with a gain that does not vanish. λ is chosen
such that the bound on ν, within which every command stays within its limits at every speed, is as
wide as can be (:class:`ThrustDemand`).

A momentum is replaced by the rate of its angle, so that the start of the main rotor, whose reaction
the momentum of a beam at rest already lacks, does not look like a yaw in motion; not so where that
rate has the speed of a rotor regulated by thrust in it, which has no slope in ψ at ψ = 0. The other
coordinates are the states as they are. States that decay within a small part of the period
(armature currents) are left out.

How much may be asked for: for a rotor regulated by ψ the commands within their limits reach, in a
period, the ψ⁺ between ψ_lo(ψ) and ψ_hi(ψ), both increasing. With the demand ψ⁺ = ψ_s + λ (ψ − ψ_s)
+ ν it is enough that

    |ν| ≤ min( min_ψ ψ_hi(ψ) − λ ψ − (1 − λ) ψ_s,   min_ψ λ ψ − ψ_lo(ψ) + (1 − λ) ψ_s )

over all ψ that the rotor reaches at all: a bound that does not depend on the state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from trms_cli.controllers.newton.problem import typical_sizes
from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.discretisation import DiscreteModel, discretise
from trms_cli.models.model import Model, names

#: Longest explicit integration step over which the rig's dynamics are smooth, s.
_LONGEST_SUBSTEP = 0.05
#: A state whose column of the step's Jacobian, in typical sizes, stays below this is forgotten
#: within the period.
_FORGOTTEN = 2e-3
_NEWTON_ITERATIONS = 4
_MOST_COORDINATES = 8
_SPEEDS = 401
_SPIN_UP = 20.0  # s, of a rotor under a full command: to its steady speed


@dataclass(frozen=True)
class ThrustDemand:
    """The bound of one rotor."""

    rotor: ThrustRotor
    pole: float  #: λ
    #: ``above``, ``below``: min ψ_hi(ψ) − λψ and min λψ − ψ_lo(ψ), (rad/s)²
    above: float
    below: float
    largest: float  #: Largest |ψ| that the rotor reaches, (rad/s)²

    def bound(self, psi_s: float) -> float:
        """Largest |ν| at a steady ψ_s, (rad/s)²; negative where even ν = 0 asks too much."""
        shift = (1.0 - self.pole) * psi_s
        return min(self.above - shift, self.below + shift)

    @property
    def scale(self) -> float:
        """The bound at ψ_s = 0, (rad/s)²."""
        return self.bound(0.0)


def thrust_demand(coordinates: Coordinates, rotor: ThrustRotor, pole: float) -> ThrustDemand:
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


@dataclass(frozen=True)
class ThrustRotor:
    """A rotor that is regulated by its thrust."""

    #: ``input``, ``state``, ``coordinate``: Positions of its command in u, of its speed in x and of
    #: ψ in z
    input: int
    state: int
    coordinate: int


class Coordinates:
    """``z = T(x)``, and ``z⁺ = F(z, v)`` over a control period.

    ``v`` has the command of each rotor, or the ψ of the next period for those regulated by thrust.

    ``period``: s. ``thrust_inputs``: commands whose rotors are regulated by their thrust; those
    that the model does not have are passed over. ``smallest_speed``: ε, rad/s. Raises
    ConfigurationError for a model without a derivative, with memory in its input path, or with more
    coordinates than linear matrix inequalities are solved for in a control period.
    """

    def __init__(
        self, model: Model, period: float, thrust_inputs: Sequence[str], smallest_speed: float
    ) -> None:
        _require_equations(model, period)
        self.model, self.period, self.epsilon = model, period, smallest_speed
        substeps = max(1, int(np.ceil(period / _LONGEST_SUBSTEP)))
        self.discrete = discretise(model, period, substeps)
        sizes = typical_sizes(discretise(model, period, 4 * substeps))
        self.positions = _remembered(self.discrete, sizes)
        self.rotors = self._rotors(thrust_inputs)
        #: Momentum by angle, as positions in x, of the axes whose rate takes the momentum's place.
        self.rates = _rates(model, [rotor.state for rotor in self.rotors])
        if len(self.positions) > _MOST_COORDINATES:
            raise ConfigurationError(
                f"model {model.name!r} has {len(self.positions)} states to regulate; linear matrix "
                f"inequalities of more than {_MOST_COORDINATES} do not fit a control period",
                where="controller",
                remedy="choose newton_mpc, or a model with fewer states for the controller",
            )
        names_of = [model.states[i].name for i in self.positions]
        for angle, momentum in self.rates.items():
            names_of[self.positions.index(momentum)] = f"d{model.states[angle].name}"
        for rotor in self.rotors:
            names_of[rotor.coordinate] = f"psi_{model.states[rotor.state].name}"
        self.names = tuple(names_of)
        self.sizes = sizes[self.positions]
        for rotor in self.rotors:
            self.sizes[rotor.coordinate] = sizes[rotor.state] ** 2
        self._p = model.parameters.values
        x, v, _, w = model.symbols()
        self._forward = BufferedFunction(ca.Function("coordinates", [x], [self._coordinates(x)]))
        self._inverse = BufferedFunction(
            ca.Function("robust_command", [x, v, w], ca.cse([self._commands(x, v, w)]))
        )
        self.step = self._step_function()

    @property
    def n(self) -> int:
        return len(self.positions)

    @property
    def m(self) -> int:
        return self.model.n_u

    def forward(self, x: FloatArray) -> FloatArray:
        """Coordinates (n,) of a state (n_x,)."""
        return self._forward.evaluate(x)[0].copy()

    def demand(self, z: FloatArray, u: FloatArray) -> FloatArray:
        """The v (n_u,) of a steady state with these coordinates and commands."""
        v = u.copy()
        for rotor in self.rotors:
            v[rotor.input] = z[rotor.coordinate]
        return v

    def command(self, x: FloatArray, v: FloatArray, w: FloatArray) -> FloatArray:
        """Commands (n_u,) that reach the demands v from x under the torques w; not yet limited."""
        return self._inverse.evaluate(x, v, w)[0].copy()

    def speed_of(self, psi: FloatArray) -> FloatArray:
        """ω of ψ, rad/s."""
        return np.asarray(_speed(psi, self.epsilon, np.sqrt))

    def psi_of(self, omega: FloatArray) -> FloatArray:
        """ψ of ω, (rad/s)²."""
        return np.asarray(omega * np.sqrt(omega**2 + self.epsilon**2))

    def _rotors(self, thrust_inputs: Sequence[str]) -> tuple[ThrustRotor, ...]:
        model = self.model
        inputs = names(model.inputs)
        rotors = []
        for name in thrust_inputs:
            if name not in ("u_v", "u_h", *inputs):
                raise ConfigurationError(
                    f"{name!r} is no input of model {model.name!r}",
                    where="controller.thrust_inputs",
                    remedy=f"there are: {', '.join(inputs)}",
                )
            if name in inputs:
                speed = f"omega_{name.removeprefix('u_')}"
                # A model without that speed (static rotors, momenta) keeps its command.
                if speed in model.state_names and model.state_index(speed) in self.positions:
                    state = model.state_index(speed)
                    rotors.append(
                        ThrustRotor(inputs.index(name), state, self.positions.index(state))
                    )
        return tuple(rotors)

    def _coordinates(self, x: ca.SX) -> ca.SX:
        z = [x[i] for i in self.positions]
        rates = self._at_rest(x)
        for angle, momentum in self.rates.items():
            z[self.positions.index(momentum)] = rates[angle]
        for rotor in self.rotors:
            omega = x[rotor.state]
            z[rotor.coordinate] = omega * ca.sqrt(omega**2 + self.epsilon**2)
        return ca.vertcat(*z)

    def _at_rest(self, x: ca.SX) -> ca.SX:
        """The derivative without commands and torques, on which the rates do not depend."""
        model = self.model
        u, w = ca.SX.zeros(model.n_u), ca.SX.zeros(model.n_w)
        return model.dynamics(x, u, ca.DM(self._p), w)

    def _states(self, z: ca.SX) -> ca.SX:
        """x of z; what is left out is as at rest, and forgotten within the period."""
        x = [ca.SX(float(value)) for value in self.model.rest()]
        for i, row in enumerate(self.positions):
            x[row] = z[i]
        for rotor in self.rotors:
            x[rotor.state] = _speed(z[rotor.coordinate], self.epsilon, ca.sqrt)
        if not self.rates:
            return ca.vertcat(*x)
        # The rates are affine in the momenta: one linear solve.
        momenta = ca.SX.sym("momenta", len(self.rates))
        for i, row in enumerate(self.rates.values()):
            x[row] = momenta[i]
        derivative = self._at_rest(ca.vertcat(*x))
        rates = ca.vertcat(*(derivative[angle] for angle in self.rates))
        goal_rates = ca.vertcat(*(z[self.positions.index(row)] for row in self.rates.values()))
        zero = ca.SX.zeros(len(self.rates))
        offset, slope = (
            ca.substitute(part, momenta, zero) for part in (rates, ca.jacobian(rates, momenta))
        )
        solved = ca.solve(slope, goal_rates - offset)
        for i, row in enumerate(self.rates.values()):
            x[row] = solved[i]
        return ca.vertcat(*x)

    def _commands(self, x: ca.SX, v: ca.SX, w: ca.SX) -> ca.SX:
        """Newton's method on the step of each rotor's speed, monotone in its command."""
        model = self.model
        u = [v[i] for i in range(model.n_u)]
        at, command, _, torque = model.symbols()
        goal = ca.SX.sym("wanted")
        after = self.discrete.step(at, command, ca.DM(self._p), torque)
        for rotor in self.rotors:
            reached, own = after[rotor.state], command[rotor.input]
            newton = ca.Function(
                "newton",
                [at, command, torque, goal],
                [own - (reached - goal) / ca.jacobian(reached, own)],
            )
            omega = _speed(v[rotor.input], self.epsilon, ca.sqrt)
            u[rotor.input] = ca.SX(0.0)
            for _ in range(_NEWTON_ITERATIONS):
                u[rotor.input] = newton(x, ca.vertcat(*u), w, omega)
        return ca.vertcat(*u)

    def _step_function(self) -> ca.Function:
        """``(z, v, w) → z⁺`` and its Jacobian in (z, v), shapes (n,) and (n, n + n_u)."""
        z = ca.SX.sym("z", self.n)
        _, v, _, w = self.model.symbols()
        x = self._states(z)
        after = self._coordinates(self.discrete.step(x, self._commands(x, v, w), ca.DM(self._p), w))
        slope = ca.densify(ca.jacobian(after, ca.vertcat(z, v)))
        return ca.Function("robust_step", [z, v, w], ca.cse([after, slope]))


def _speed(psi, epsilon: float, root):  # type: ignore[no-untyped-def]
    """ω with ω √(ω² + ε²) = ψ, written so that nothing cancels near zero."""
    return psi / root((epsilon**2 + root(epsilon**4 + 4.0 * psi**2)) / 2.0)


def _require_equations(model: Model, period: float) -> None:
    if model.sample_time is not None:
        raise ConfigurationError(
            f"model {model.name!r} was learnt from samples: it has no equations whose coefficients "
            "could span a polytope",
            where="controller",
            remedy="choose newton_mpc, or a model with equations (model=newtonian)",
        )
    if model.memory(period):
        raise ConfigurationError(
            f"the input path of model {model.name!r} has memory, which robust MPC does not predict",
            where="controller",
            remedy="choose newton_mpc or lqr, or leave the delay out of the controller's model",
        )


def _remembered(discrete: DiscreteModel, sizes: FloatArray) -> list[int]:
    """States that still matter after a period."""
    model = discrete.model
    slopes = BufferedFunction(discrete.slopes("robust_slopes"))
    rest = model.rest()
    weight = np.zeros(model.n_x)
    for share in (0.0, 0.5):
        u = share * model.input_bounds()[1]
        x, w = rest + share * sizes, np.zeros(model.n_w)
        A = slopes.evaluate(x, u, model.parameters.values, w)[1]
        weight = np.maximum(weight, np.abs(A * sizes / sizes[:, None]).max(axis=0))
    return [i for i in range(model.n_x) if weight[i] > _FORGOTTEN]


def _rates(model: Model, thrust_states: Sequence[int]) -> dict[int, int]:
    """Position of the momentum by that of the angle, where the rate is affine in the momentum."""
    x, u, p, w = model.symbols()
    f = model.dynamics(x, u, p, w)
    by_angle: dict[int, int] = {}
    for axis in model.axes.values():
        angle = model.state_index(axis.angle)
        moment = names(model.disturbances).index(axis.moment)
        on = ca.jacobian(f[angle], x).sparsity()
        driven_states = [k for k in range(model.n_x) if not ca.jacobian(f[k], w[moment]).is_zero()]
        momenta = [k for k in driven_states if on.has_nz(0, k) and k != angle]
        others = [k for k in range(model.n_x) if on.has_nz(0, k) and k not in momenta]
        affine = (
            len(momenta) == 1
            and ca.jacobian(ca.jacobian(f[angle], x[momenta[0]]), x[momenta[0]]).is_zero()
        )
        if affine and others and not set(others) & set(thrust_states):
            by_angle[angle] = momenta[0]
    return by_angle
