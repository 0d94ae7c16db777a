"""From a continuous model to a discrete step and its derivatives.

Explicit models use the classical Runge–Kutta step of order four; stiff ones (armature currents
as states) a linearly implicit one. Both take several equal substeps inside a step, over which the
command is constant.

The linearly implicit step is RODAS3 (Sandu et al. 1997, Atmospheric Environment 31): order three,
L-stable, four stages, one Jacobian and one factorisation a substep. L-stability matters: a merely
A-stable step (ROS3P was tried) lets the currents ring for many steps before they follow the rotor.

A model that has only a step of its own length is taken a whole number of times. Such a step may be
a large network: the repetitions call one function, and their slopes follow by the chain rule, so
that the generated code does not grow with their number.

Linear systems in them are solved by a symbolic Gaussian elimination that uses the zeros of the
matrix. CasADi's symbolic QR fills them: on the 8-state model it doubles the operations of a step
and quadruples those of its derivatives.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ModelError
from trms_cli.core.process_cache import call_memoised
from trms_cli.models.model import FloatArray, Model, Signal
from trms_cli.models.tangents import Tangent, TangentMap

#: A first-order lag settles to the last bit within 40 time constants; none is that slow.
_MOST_STEPS_TO_SETTLE = 100_000

Method = Literal["auto", "rk4", "rodas3"]
#: Of vectors, with or without slopes.
Derivative = Callable[[Any], Any]


def factorise_matrix(matrix: ca.SX) -> Callable[[ca.SX], ca.SX]:
    """Factorise once, solve many times: a function ``b → matrix⁻¹ b``.

    ``matrix``: square. There is no pivoting: every leading block must be regular, as it is for the
    ``I/(γh) − ∂f/∂x`` of a linearly implicit step.
    """
    n = matrix.shape[0]
    structure = matrix.sparsity()
    rows: list[dict[int, ca.SX]] = [
        {j: matrix[i, j] for j in range(n) if structure.has_nz(i, j)} for i in range(n)
    ]
    for k in range(n):
        for i in range(k + 1, n):
            if k not in rows[i]:
                continue
            rows[i][k] /= rows[k][k]
            for j in range(k + 1, n):
                if j in rows[k]:
                    rows[i][j] = rows[i].get(j, ca.SX(0)) - rows[i][k] * rows[k][j]

    def solve(b: ca.SX) -> ca.SX:
        x = [b[i] for i in range(n)]
        for i in range(n):
            for j in range(i):
                if j in rows[i]:
                    x[i] -= rows[i][j] * x[j]
        for i in reversed(range(n)):
            for j in range(i + 1, n):
                if j in rows[i]:
                    x[i] -= rows[i][j] * x[j]
            x[i] /= rows[i][i]
        return ca.vertcat(*x)

    return solve


@dataclass(frozen=True)
class DiscreteModel:
    """A model over one step of fixed length: ``x⁺ = step(x, u, p, w)``."""

    model: Model
    step_length: float  #: s
    #: The model's states, the sensors' memory if asked for, and the memory of the input path (past
    #: commands of a delay, for instance)
    states: tuple[Signal, ...]
    step: ca.Function  #: ``(x, u, p, w) → x⁺``
    measurement: ca.Function  #: ``(x, u, p) → y``
    #: Steps, one after the other, that make up ``step``; a single one for a model with a derivative
    parts: tuple[ca.Function, ...]
    n_sensors: int = 0  #: entries of the sensors' memory, which follow the model's states
    runge_kutta_steps: int = 0  #: equal ones that make up ``step``; 0 for another kind of step

    @property
    def n_x(self) -> int:
        return len(self.states)

    def linearised(self) -> ca.Function:
        """``(x, u, p, w) → x⁺, ∂x⁺/∂x, ∂x⁺/∂u, ∂x⁺/∂p, ∂x⁺/∂w``.

        Meant for one or two substeps: each one multiplies the size of the generated code.
        """
        x, u, p, w = self.symbols()
        after = self.step(x, u, p, w)
        slopes = [ca.densify(ca.jacobian(after, v)) for v in (x, u, p, w)]
        return ca.Function(
            "linearised",
            [x, u, p, w],
            ca.cse([after, *slopes]),
            ["x", "u", "p", "w"],
            ["x_next", "A", "B", "P", "G"],
        )

    def slopes(self, name: str = "slopes") -> ca.Function:
        """``(x, u, p, w) → x⁺, ∂x⁺/∂x, ∂x⁺/∂u``, the slopes dense."""
        if self.runge_kutta_steps:
            return call_memoised(_explicit_slopes, self, name)
        if len(self.parts) == 1:
            x, u, p, w = self.symbols()
            after = self.step(x, u, p, w)
            results = [after, *(ca.densify(ca.jacobian(after, v)) for v in (x, u))]
            return ca.Function(name, [x, u, p, w], ca.cse(results))
        return self._chained(name)

    def _chained(self, name: str) -> ca.Function:
        """The slopes of several parts, each of which is generated once."""
        sizes = (self.n_x, self.model.n_u, len(self.model.parameters), self.model.n_w)
        x, u, p, w = (ca.MX.sym(v, n) for v, n in zip("xupw", sizes, strict=True))
        in_x, in_u, state = ca.MX(ca.DM.eye(self.n_x)), ca.MX(self.n_x, self.model.n_u), x
        single: dict[int, ca.Function] = {}
        for part in self.parts:
            key = id(part)
            if key not in single:
                at = self.symbols()
                after = part(*at)
                results = [after, *(ca.jacobian(after, v) for v in at[:2])]
                single[key] = ca.Function(f"part_{len(single)}", list(at), ca.cse(results))
            state, a, b = single[key](state, u, p, w)
            in_x, in_u = a @ in_x, a @ in_u + b
        return ca.Function(name, [x, u, p, w], [state, ca.densify(in_x), ca.densify(in_u)])

    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Fresh symbols (x, u, p, w), with the memory in x."""
        x, u, p, w = (ca.SX.sym(v, self.step.size1_in(i)) for i, v in enumerate("xupw"))
        return x, u, p, w

    def initial(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """A full state from the continuous one, its memory as after a long time at ``u``."""
        sensors = self.model.n_x
        n = sensors + self.n_sensors
        full = np.zeros(self.n_x)
        full[:sensors] = x
        p, w = self.model.parameters.values, np.zeros(self.model.n_w)
        if self.n_x > n:
            step = BufferedFunction(self.step)
            _settle(full[n:], lambda: step.evaluate(full, u, p, w)[0][n:])
        if self.n_sensors:
            showing = BufferedFunction(self._sensors_at_rest(), compile=False)
            memory = full[sensors:n]
            _settle(memory, lambda: showing.evaluate(memory, full[:sensors], u, p)[0])
        return full

    def _sensors_at_rest(self) -> ca.Function:
        """``(memory, x, u, p) → memory``, one step of the sensors over a state that stays."""
        x, u, p, _ = self.model.symbols()
        memory = ca.SX.sym("memory", self.n_sensors)
        after = self.model.sensor_path(memory, x, x, u, p, (0.0, 1.0), self.step_length)
        return ca.Function("sensors", [memory, x, u, p], [ca.densify(after)])


#: Steps after which a memory that has not settled is taken to where it tends.
_PATIENCE = 200
#: Share of its pace that a memory keeps at most after such a jump.
_NEARER = 0.01


def _settle(memory: np.ndarray, following: Callable[[], np.ndarray]) -> None:
    """Repeat a step of a memory, in place, until it changes no bit."""
    for k in range(1, _MOST_STEPS_TO_SETTLE + 1):
        after = following()
        settled = np.array_equal(after, memory)
        memory[:] = after
        if settled:
            break
        if k >= _PATIENCE and k % 10 == 0:
            _jump(memory, following)


def _jump(memory: np.ndarray, following: Callable[[], np.ndarray]) -> None:
    """One step of Newton's method towards the memory that its step leaves as it is.

    What forgets over half a minute takes tens of thousands of steps to settle by itself. Where the
    step has no single memory that stays, nothing is changed.
    """
    here = memory.copy()
    pace = following() - here
    slopes = np.empty((len(here), len(here)))
    for i in range(len(here)):
        by = 1e-4 * max(abs(here[i]), 1.0)
        memory[:] = here
        memory[i] += by
        slopes[:, i] = (following() - here - pace) / by
    memory[:] = here
    try:
        there = here + np.linalg.solve(np.eye(len(here)) - slopes, pace)
    except np.linalg.LinAlgError:
        return
    memory[:] = there
    residual = np.abs(following() - there).max()
    if not residual <= _NEARER * np.abs(pace).max():
        memory[:] = here


def discretise(
    model: Model,
    step_length: float,
    substeps: int = 1,
    method: Method = "auto",
    *,
    sensors: bool = False,
) -> DiscreteModel:
    """Discretise a model with the command and the disturbances constant over the step.

    Raises ModelError for a step that is not positive or fewer than one substep, and for one that is
    no whole multiple of the sample time of a model that only steps (which has no use for substeps).

    ``step_length``: s. ``substeps``: equal integration steps inside it. ``method``: ``auto`` takes
    the L-stable step for a stiff model. ``sensors``: whether what the sensors remember is part of
    the state, as whatever simulates or estimates measurements needs; without it they show what they
    would at rest.
    """
    if not (step_length > 0 and substeps >= 1):
        raise ModelError(
            f"cannot discretise with step {step_length!r} s and {substeps!r} substeps",
            remedy="the step is positive and there is at least one substep",
        )
    # The equations are shared between equal models; the model is the caller's own.
    discrete = call_memoised(_discretised, model, step_length, substeps, method, sensors)
    return replace(discrete, model=model)


def _discretised(
    model: Model, step_length: float, substeps: int, method: Method, sensors: bool
) -> DiscreteModel:
    if model.sample_time is not None:
        return _repeated(model, step_length, sensors)
    if method == "auto":
        method = "rodas3" if model.stiff else "rk4"
    layout = _Layout(model, step_length, sensors)
    _, u, p, w = model.symbols()
    full = ca.SX.sym("x", len(layout.states))
    start = (*layout.split(full), u)
    parts = _after_substeps(layout, substeps, method, start, (p, w), _applied)
    # The equations name the same sine or square many times over; sharing them halves the work.
    (after,) = ca.cse([ca.vertcat(*parts)])
    step = ca.Function("step", [full, u, p, w], [after], ["x", "u", "p", "w"], ["x_next"])
    discrete = layout.discrete(step, (step,))
    return replace(discrete, runge_kutta_steps=substeps if method == "rk4" else 0)


@dataclass(frozen=True)
class _Layout:
    """Where states, sensors' memory and input path's memory stand in the full state."""

    model: Model
    step_length: float
    sensors: bool

    @property
    def n_sensors(self) -> int:
        return len(self._sensor_memory)

    @property
    def states(self) -> tuple[Signal, ...]:
        return (*self.model.states, *self._sensor_memory, *self.model.memory(self.step_length))

    @property
    def _sensor_memory(self) -> tuple[Signal, ...]:
        return self.model.sensor_memory(self.step_length) if self.sensors else ()

    def split(self, full: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        n = self.model.n_x
        end = n + self.n_sensors
        # Two indices: a slice that leaves nothing of one element would keep a row of width one.
        return full[:n, 0], full[n:end, 0], full[end:, 0]

    def discrete(self, step: ca.Function, parts: tuple[ca.Function, ...]) -> DiscreteModel:
        """The discrete model of a step, with the measurement that belongs to it."""
        model = self.model
        _, u, p, _ = model.symbols()
        full = ca.SX.sym("x", len(self.states))
        x, sensor_states, _ = self.split(full)
        if self.sensors:
            y = model.reading(sensor_states, x, u, p, self.step_length)
        else:
            y = model.measurement(x, u, p)
        measurement = ca.Function("measurement", [full, u, p], [y], ["x", "u", "p"], ["y"])
        return DiscreteModel(
            model, self.step_length, self.states, step, measurement, parts, self.n_sensors
        )


def _applied(_: str, compute: Callable[..., tuple[ca.SX, ...]], *at: ca.SX) -> tuple[ca.SX, ...]:
    return compute(*at)


def _after_substeps(
    layout: _Layout,
    substeps: int,
    method: Method,
    start: tuple[Any, Any, Any, Any],
    constants: tuple[ca.SX, ca.SX],
    apply: Callable[..., tuple[Any, ...]],
) -> tuple[Any, Any, Any]:
    """State, sensors' memory and input path's memory after a step.

    ``start``: the same before it, and the command; vectors, with or without slopes. ``constants``:
    parameters and disturbances. ``apply``: takes a function of vectors to them, by its name.
    """
    model, step_length = layout.model, layout.step_length
    x, sensors, memory, u = start
    p, w = constants
    integrate = {"rk4": _rk4, "rodas3": _rodas3}[method]
    h = step_length / substeps
    at, v = ca.SX.sym("at", model.n_x), ca.SX.sym("v", model.n_u)
    # Stated once, and inlined at each stage: to state them again takes ten times as long.
    dynamics = ca.Function("dynamics", [at, v, p, w], [model.dynamics(at, v, p, w)])

    def flow(z: ca.SX, command: ca.SX) -> tuple[ca.SX]:
        return (dynamics(z, command, p, w),)

    def impulse(z: ca.SX, command: ca.SX) -> tuple[ca.SX]:
        return (model.impulse(z, command, p, w, h),)

    for k in range(substeps):
        window = (k / substeps, (k + 1) / substeps)

        def path(m: ca.SX, command: ca.SX, window: Any = window) -> tuple[ca.SX, ca.SX]:
            return model.input_path(m, command, p, window, step_length)

        def show(
            m: ca.SX, old: ca.SX, new: ca.SX, command: ca.SX, window: Any = window
        ) -> tuple[ca.SX]:
            return (model.sensor_path(m, old, new, command, p, window, step_length),)

        arriving, memory = apply(f"path {k}", path, memory, u)
        before = x
        x = integrate(lambda z, a=arriving: apply("flow", flow, z, a)[0], x, h)  # type: ignore[misc]
        (x,) = apply("impulse", impulse, x, arriving)
        if layout.n_sensors:
            (sensors,) = apply(f"show {k}", show, sensors, before, x, arriving)
    return x, sensors, memory


def _explicit_slopes(discrete: DiscreteModel, name: str) -> ca.Function:
    """Slopes of a step of Runge and Kutta, stage by stage."""
    layout = _Layout(discrete.model, discrete.step_length, discrete.n_sensors > 0)
    full, u, p, w = discrete.symbols()
    n_x, n_u = full.numel(), u.numel()
    in_full, in_u = ca.SX.eye(n_x + n_u)[:n_x, :], ca.SX.eye(n_x + n_u)[n_x:, :]
    x, sensors, memory = layout.split(full)
    first, end = x.numel(), n_x - memory.numel()
    start = (
        Tangent(x, in_full[:first, :]),
        Tangent(sensors, in_full[first:end, :]),
        Tangent(memory, in_full[end:, :]),
        Tangent(u, in_u),
    )
    parts = _after_substeps(
        layout, discrete.runge_kutta_steps, "rk4", start, (p, w), TangentMap([p, w])
    )
    after = ca.vertcat(*(part.value for part in parts))
    slopes = ca.vertcat(*(part.slopes for part in parts))
    results = [after, ca.densify(slopes[:, :n_x]), ca.densify(slopes[:, n_x:])]
    return ca.Function(name, [full, u, p, w], ca.cse(results))


def _repeated(model: Model, step_length: float, sensors: bool) -> DiscreteModel:
    """A model's own step, as many times as the step asked for takes."""
    count = repetitions(model, step_length)
    layout = _Layout(model, step_length, sensors)
    states = layout.states
    parts: list[ca.Function] = []
    for k in range(count):
        if parts and len(states) == model.n_x:
            parts.append(parts[0])  # without memory they are all equal
            continue
        _, u, p, w = model.symbols()
        full = ca.SX.sym("x", len(states))
        x, sensor_states, memory = layout.split(full)
        window = (k / count, (k + 1) / count)
        arriving, memory = model.input_path(memory, u, p, window, step_length)
        following = model.transition(x, arriving, p, w)
        if layout.n_sensors:
            sensor_states = model.sensor_path(
                sensor_states, x, following, arriving, p, window, step_length
            )
        after = ca.vertcat(following, sensor_states, memory)
        name = "step" if count == 1 else f"step_{k}"
        parts.append(ca.Function(name, [full, u, p, w], ca.cse([after])))
    step = parts[0] if count == 1 else _composed(parts)
    return layout.discrete(step, tuple(parts))


def _composed(parts: list[ca.Function]) -> ca.Function:
    x, u, p, w = (ca.MX.sym(name, parts[0].size1_in(i)) for i, name in enumerate("xupw"))
    after = x
    for part in parts:
        after = part(after, u, p, w)
    return ca.Function("step", [x, u, p, w], [after], ["x", "u", "p", "w"], ["x_next"])


def repetitions(model: Model, step_length: float) -> int:
    """How many steps of a model that only steps make up a longer one.

    Raises ModelError if no whole number does.
    """
    assert model.sample_time is not None
    own = model.sample_time
    count = round(step_length / own)
    if count < 1 or abs(count * own - step_length) > 1e-9 * step_length:
        raise ModelError(
            f"model {model.name!r} steps by {own:g} s, and {step_length:g} s is no whole multiple "
            "of that",
            where="model",
            remedy=f"set sim.sample_time and controller.sample_time to {own:g} s times a whole "
            f"number (sim.sample_time={own:g} controller.sample_time={5 * own:g}), or train a "
            "network at the sample time that is wanted",
        )
    return count


def _rk4(f: Derivative, x: Any, h: float) -> Any:
    k1 = f(x)
    k2 = f(x + h / 2 * k1)
    k3 = f(x + h / 2 * k2)
    k4 = f(x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def _rodas3(f: Derivative, x: ca.SX, h: float) -> ca.SX:
    """Coefficients in the form that avoids products with the Jacobian.

    ``(1/(γh) − J) U_i = f(x + Σ a_ij U_j) + Σ c_ij/h U_j``, ``x⁺ = x + Σ m_i U_i``; a_21 = 0, so
    that the first two stages share one evaluation.
    """
    gamma = 0.5
    at = ca.SX.sym("at", x.shape[0])
    slope = ca.jacobian(f(at), at)
    slope = ca.substitute(slope, at, x)
    solve = factorise_matrix(ca.SX(ca.DM.eye(x.shape[0])) / (gamma * h) - slope)
    now = f(x)
    stage_1 = solve(now)
    stage_2 = solve(now + 4.0 / h * stage_1)
    stage_3 = solve(f(x + 2.0 * stage_1) + (stage_1 - stage_2) / h)
    stage_4 = solve(f(x + 2.0 * stage_1 + stage_3) + (stage_1 - stage_2 - 8.0 / 3.0 * stage_3) / h)
    return x + 2.0 * stage_1 + stage_3 + stage_4


def noise_of_states(model: Model, parameters: FloatArray, step: float) -> FloatArray:
    """Standard deviations of what noise adds to each state in a step (s), shape (n_x,).

    ``parameters``: (n_p,) array; values of the model's parameters, SI. ``step``: s.
    """
    added = BufferedFunction(call_memoised(_noise_function, model, step), compile=False)
    return added.evaluate(parameters)[0].copy()


def _noise_function(model: Model, step: float) -> ca.Function:
    """``p`` → standard deviations, (n_x, 1)."""
    _, _, p, _ = model.symbols()
    return ca.Function("added", [p], [ca.densify(model.noise_sd(p, step))])
