"""A library of force terms, each with the effect that it would speak for, and a model with some.

The terms are what a person who knows rigs of this kind would try on each equation of motion. What
remembers (a lag of a command, a warming drive, a cable that slips) has a state with a typical
time or width. Sensors have no term: a force says nothing of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise

import casadi as ca
import numpy as np

from experiments.gap.baselines.restoring_force import Motion
from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import compile_function
from trms_cli.effects.effect import Effect, EffectContext
from trms_cli.models.model import Model, Signal, names
from trms_cli.models.parameters import Parameter

#: s, s and rad: of a command's lag, of a drive's warming, of a cable's slip.
_LAG, _WARMING, _WIDTH = 0.04, 30.0, 0.15
_TIMES = (_LAG, _LAG, _WARMING, _WARMING, 1.0)
#: rad/s and rad/s: rates of an axis and speeds of a rotor below which the sign is softened, the
#: width of a Stribeck peak.
_AXIS_AT_REST, _ROTOR_AT_REST, _STRIBECK = 0.01, 2.0, 0.03
#: V, half the width of a dead zone; m, arm and reach of the ground's effect.
_DEAD, _ARM, _GROUND = 0.1, 0.24, 0.1
#: rad/s, of a rotor in the middle of its range.
_CRUISE = 200.0


@dataclass(frozen=True)
class Term:
    """One column of the library."""

    location: str  #: The equation's disturbance
    name: str
    effects: tuple[str, ...]  #: What it speaks for; more than one where no force tells them apart


@dataclass(frozen=True)
class Memory(Effect):
    """States that terms need, without any effect on the model."""

    def parameters(self) -> tuple[Parameter, ...]:
        return ()

    def check(self, model: Model) -> None:
        pass

    def states(self) -> tuple[Signal, ...]:
        of_rotors = [f"{kind}_{i}" for kind in ("lagged", "warmth") for i in range(2)]
        return tuple(Signal(name, "1") for name in (*of_rotors, "slip"))

    def derivative(self, at: EffectContext) -> ca.SX:
        return (self._followed(at) - at.own) / ca.DM(_TIMES) + self._slipped(at)

    def after(self, at: EffectContext, step: float) -> ca.SX:
        """The states a step (s) later, the motion as it is."""
        decay = ca.DM([float(np.exp(-step / t)) for t in _TIMES])
        return self._followed(at) + decay * (at.own - self._followed(at)) + step * self._slipped(at)

    def _followed(self, at: EffectContext) -> ca.SX:
        """What the states would come to: commands, loads; the slip by itself stays."""
        u = [at.u[i] if i < at.u.shape[0] else ca.SX(0) for i in range(2)]
        limits = [*at.model.input_limits.values(), 1.0, 1.0]
        return ca.vertcat(*u, *((u[i] / limits[i]) ** 2 for i in range(2)), at.own[4])

    def _slipped(self, at: EffectContext) -> ca.SX:
        slip = at.own[4]
        rate = at.rate("yaw") if "yaw" in at.model.axes else ca.SX(0)
        sliding = 0.5 + 0.5 * ca.sign(rate * slip)
        return ca.vertcat(ca.SX.zeros(4), rate / _WIDTH * (1 - ca.fabs(slip) * sliding))


def library(at: EffectContext) -> Iterator[tuple[Term, ca.SX]]:
    """Terms with their expressions, as far as the model has what they are about."""
    places = names(at.model.disturbances)
    for axis in at.model.axes:
        if f"{axis}_moment" in places:
            for term, value in _of_axis(at, axis):
                yield Term(f"{axis}_moment", term[0], term[1]), value
    for i, rotor in enumerate(at.model.rotors):
        if f"{rotor}_motor" in places and rotor in at.model.rotor_speeds:
            for term, value in _of_rotor(at, rotor, i):
                yield Term(f"{rotor}_motor", term[0], term[1]), value


_Entry = tuple[tuple[str, tuple[str, ...]], ca.SX]


def _of_axis(at: EffectContext, axis: str) -> Iterator[_Entry]:
    rate, angle = at.rate(axis), at.angle(axis)
    sign = ca.tanh(rate / _AXIS_AT_REST)
    yield ("sign(rate)", (f"{axis}_coulomb_friction",)), sign
    peak = sign * ca.exp(-((rate / _STRIBECK) ** 2))
    yield ("sign(rate) near rest", (f"{axis}_stribeck_friction",)), peak
    yield ("rate |rate|", (f"{axis}_quadratic_damping",)), rate * ca.fabs(rate)
    own, other = ("main", "tail") if axis == "pitch" else ("tail", "main")
    if axis == "pitch":
        yield ("cos(angle)", ("pitch_mass_imbalance",)), ca.cos(angle)
        yield ("sin(angle)", ("pitch_mass_imbalance",)), ca.sin(angle)
    else:
        yield ("angle", ("yaw_cable_stiffness",)), angle
        yield ("angle^3", ("yaw_cable_stiffness",)), angle**3
        yield ("slipping spring", ("yaw_cable_hysteresis",)), at.own[4]
    if {"pitch", "yaw"} <= set(at.model.axes) and "main" in at.model.rotor_speeds:
        crossed = at.rate("yaw" if axis == "pitch" else "pitch") * at.speed("main")
        yield ("w_main × other rate", ("gyroscopic_coupling",)), crossed * ca.sin(at.angle("pitch"))
    lever = at.cosine_of_pitch() if axis == "yaw" else ca.SX(1)
    if own in at.model.rotor_speeds:
        w = at.speed(own)
        thrust = w * ca.fabs(w) * lever
        bent = thrust * ca.log(ca.fmax(ca.fabs(w), 1.0) / _CRUISE)
        yield (f"w_{own} |w_{own}| ln|w_{own}|", (f"{own}_thrust_curve",)), bent
        yield (f"w_{own}² on one side", (f"{own}_thrust_curve",)), ca.fmin(thrust, 0)
        yield (f"rate × |w_{own}|", (f"{own}_inflow",)), rate * ca.fabs(w)
        if own == "main" and axis == "pitch":
            near = ca.exp(-_ARM * (1 + ca.sin(angle)) / _GROUND)
            yield ("thrust near the table", ("ground_effect",)), ca.fmax(thrust, 0) * near
    if other in at.model.rotor_speeds:
        w = at.speed(other)
        reaction = f"{other}_reaction_on_{axis}"
        yield (f"w_{other} |w_{other}|", (reaction,)), w * ca.fabs(w) * lever
        yield (f"dw_{other}/dt", (reaction,)), at.spin_up(other) * lever


def _of_rotor(at: EffectContext, rotor: str, i: int) -> Iterator[_Entry]:
    w, u = at.speed(rotor), at.u[i]
    late = u - at.own[i]
    yield ("u − lagged u", (f"{rotor}_input_delay", f"{rotor}_actuator_lag")), late
    yield ("sat(u)", (f"{rotor}_dead_zone",)), ca.fmin(ca.fmax(u, -_DEAD), _DEAD)
    yield ("u × warmth", (f"{rotor}_supply_derating",)), u * at.own[2 + i]
    yield ("sign(w)", (f"{rotor}_rotor_friction",)), ca.tanh(w / _ROTOR_AT_REST)


@dataclass(frozen=True)
class AddedForces(Memory):
    """Some terms of the library with their coefficients, as an effect of a model."""

    #: In the unit of the equation's disturbance
    coefficients: Mapping[Term, float] = field(default_factory=dict)

    def __hash__(self) -> int:
        return id(self)

    def disturbance(self, at: EffectContext) -> ca.SX:
        force = ca.SX.zeros(at.model.n_w)
        places = names(at.model.disturbances)
        for term, value in library(at):
            if term in self.coefficients:
                force[places.index(term.location)] += self.coefficients[term] * value
        return force


def columns(model: Model, trajectory: Motion) -> tuple[tuple[Term, ...], FloatArray]:
    """The library's terms along a motion, (n, number of terms)."""
    terms, function, memory = _functions(model, trajectory.step)
    along = _remembered(model, trajectory, memory)
    n = len(trajectory.x)
    parameters = np.repeat(model.parameters.values[:, None], n, axis=1)
    disturbances = np.zeros((model.n_w, n))
    values = function.map(n)(along.T, trajectory.x.T, trajectory.u.T, parameters, disturbances)
    return terms, np.array(ca.DM(values).full()).T


@lru_cache(maxsize=8)
def _functions(model: Model, step: float) -> tuple[tuple[Term, ...], ca.Function, ca.Function]:
    """The terms, their values at a sample, and the memory one sample later."""
    x, u, p, w = model.symbols()
    memory = Memory()
    own = ca.SX.sym("own", len(memory.states()))
    at = EffectContext(model, x, u, p, w, own, {})
    terms, values = zip(*library(at), strict=True)
    after = memory.after(at, step)
    return (
        tuple(terms),
        compile_function(
            ca.Function("library", [own, x, u, p, w], [ca.densify(ca.vertcat(*values))])
        ),
        compile_function(ca.Function("memory", [own, x, u, p, w], [ca.densify(after)])),
    )


def _remembered(model: Model, trajectory: Motion, step: ca.Function) -> FloatArray:
    """The memory along a motion, from rest at the first command of each recording."""
    edges = [*trajectory.breaks.tolist(), len(trajectory.x)]
    parts = []
    for a, b in pairwise(edges):
        n = b - a
        start = np.zeros(5)
        start[: min(2, trajectory.u.shape[1])] = trajectory.u[a, :2]
        p = np.repeat(model.parameters.values[:, None], n, axis=1)
        chain = step.mapaccum(n)
        after = chain(start, trajectory.x[a:b].T, trajectory.u[a:b].T, p, np.zeros((model.n_w, n)))
        after = np.array(ca.DM(after).full()).T
        parts.append(np.vstack([start, after[:-1]]))
    return np.concatenate(parts)
