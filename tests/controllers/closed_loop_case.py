"""Control samples made by hand, a closed loop without sensors, logs or configuration, and a small
linear model for tests against textbook solutions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import block_diag, solve_discrete_are

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import discretise
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model, RigAxis, RigRotor, Signal
from trms_cli.models.parameters import Parameter, ParameterSet

#: Of controllers that take the period of the loop, s.
SAMPLE_TIME = 0.02
#: Half a period of the default squares, s.
LEVEL_TIME = 20.0
LEVEL = {"alpha_v": 0.3, "alpha_h": 0.5}
#: Times (n,) to references (n, n_r).
Reference = Callable[[np.ndarray], np.ndarray]


def setup_of(model: Model, period: float = 0.1, u: np.ndarray | None = None) -> ControlSetup:
    return ControlSetup(model, period, np.zeros(model.n_u) if u is None else u)


def sample_of(
    model: Model,
    reference: Any,
    x: np.ndarray | None = None,
    u: np.ndarray | None = None,
    w: np.ndarray | None = None,
) -> ControlSample:
    """A certain estimate, at rest and undisturbed unless told otherwise."""
    x = model.rest() if x is None else x
    w = np.zeros(model.n_w) if w is None else w
    estimate = Estimate(x, np.zeros_like(x), w, np.zeros_like(w))
    before = np.zeros(model.n_u) if u is None else u
    return ControlSample(0.0, np.array([reference], dtype=float), estimate, before)


def state_with(model: Model, **values: float) -> np.ndarray:
    """The rest but for some states."""
    x = model.rest()
    for name, value in values.items():
        x[model.state_index(name)] = value
    return x


def constant(*values: float) -> Reference:
    return lambda times: np.tile(values, (len(times), 1))


def squares(model: Model, half_period: float = LEVEL_TIME) -> Reference:
    """±0.3 rad in pitch and ±0.5 rad in yaw."""
    level = np.array([LEVEL[name] for name in model.controlled])

    def reference(times: np.ndarray) -> np.ndarray:
        sign = np.where(np.mod(times / (2 * half_period), 1.0) < 0.5, 1.0, -1.0)
        return sign[:, None] * level

    return reference


@dataclass
class Ran:
    """A closed loop's trajectories, one row a control period."""

    model: Model
    period: float
    states: np.ndarray
    inputs: np.ndarray
    references: np.ndarray
    commands: list[Command]

    @property
    def angles(self) -> np.ndarray:
        """Of what is controlled, (n, n_r)."""
        return self.states[:, [self.model.state_index(name) for name in self.model.controlled]]

    @property
    def errors(self) -> np.ndarray:
        return self.angles - self.references

    def error(self, angle: str) -> np.ndarray:
        return self.errors[:, self.model.controlled.index(angle)]

    def at(self, time: float) -> int:
        """The row at a time, s."""
        return round(time / self.period)

    def levels(self, angle: str) -> list[np.ndarray]:
        """Errors towards the new level on each level after the first, overshoot positive."""
        n = self.at(LEVEL_TIME)
        signed = self.error(angle) * np.sign(self.references)[:, self.model.controlled.index(angle)]
        return [signed[k : k + n] for k in range(n, len(signed) - n + 1, n)]


def close_loop(
    controller: Any,
    model: Model,
    reference: Reference,
    seconds: float,
    *,
    rig: Model | None = None,
    x0: np.ndarray | None = None,
    torque: Callable[[float], Any] | None = None,
    known: bool = False,
) -> Ran:
    """Around the true state of a rig, which is the model unless another is given.

    ``torque`` maps a time to w (n_w,), which the estimate tells only if it is ``known``.
    """
    rig = rig or model
    period = controller.sample_time or SAMPLE_TIME
    setup = setup_of(model, period)
    preview, state = controller.preview(setup), controller.init(setup)
    discrete = discretise(rig, period, 1 if rig.sample_time else max(1, round(period / 0.02) * 2))
    step, p, u = BufferedFunction(discrete.step), rig.parameters.values, np.zeros(model.n_u)
    x = discrete.initial(rig.rest() if x0 is None else x0, u)
    lower, upper = model.input_bounds()
    rows, commands, still = [], [], np.zeros(rig.n_w)
    for k in range(round(seconds / period)):
        w = still if torque is None else np.asarray(torque(k * period))
        told, full = (w if known else np.zeros(model.n_w)), x[: rig.n_x].copy()
        estimate = Estimate(full[: model.n_x], np.zeros(model.n_x), told, np.zeros_like(told))
        r = reference((k + np.arange(preview + 1)) * period)
        command = controller.step(
            state, ControlSample(k * period, r, estimate, u), want_prediction=k == 0
        )
        u = command.u
        assert np.all(u >= lower) and np.all(u <= upper)
        rows.append((full, u.copy(), r[0].copy()))
        commands.append(command)
        x = step.evaluate(x, u, p, w)[0].copy()
    return Ran(model, period, *(np.array(column) for column in zip(*rows, strict=True)), commands)


class DoubleMass(Model):
    """Two coupled, damped masses with a force on each: ẋ = A x + B (u + w)."""

    def __init__(self, limit: float = 100.0) -> None:
        self.name = "double_mass"
        self.states = tuple(Signal(name, "m") for name in ("p1", "v1", "p2", "v2"))
        self.inputs = (Signal("f1", "N"), Signal("f2", "N"))
        self.outputs = (self.states[0], self.states[2])
        self.disturbances = (Signal("push_1", "N"), Signal("push_2", "N"))
        self.parameters = ParameterSet([Parameter("k", 2.0, "N/m"), Parameter("d", 0.4, "N*s/m")])
        self.controlled = ("p1", "p2")
        self.input_limits = {"f1": limit, "f2": limit}
        self.stops: dict[str, float] = {}
        self.axes: dict[str, RigAxis] = {}
        self.rotors: dict[str, RigRotor] = {}

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        k, d = p[0], p[1]
        spring = k * (x[2] - x[0])
        return ca.vertcat(
            x[1], spring - k * x[0] - d * x[1] + u[0] + w[0], x[3], -spring - d * x[3] + u[1] + w[1]
        )

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        return x[[0, 2]]


def matrices(discrete_step: ca.Function, model: Model) -> tuple[np.ndarray, np.ndarray]:
    """A and B of a discretised linear model."""
    x, u, p, w = model.symbols()
    after = discrete_step(x, u, p, w)
    slopes = ca.Function("slopes", [x, u, p, w], [ca.jacobian(after, x), ca.jacobian(after, u)])
    a, b = slopes(
        np.zeros(model.n_x), np.zeros(model.n_u), model.parameters.values, np.zeros(model.n_w)
    )
    return np.array(a), np.array(b)


def regulator(
    A: np.ndarray, B: np.ndarray, states: Any, rates: Any, inputs: Any, moves: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Gain on (x, last u) and cost to go of an infinite horizon, by weights of each kind.

    The last input is a state of its own; the cost of x⁺ is one of x and u.
    """
    n, m = B.shape
    after = np.hstack([A, B])
    moved = after - np.eye(n, n + m)
    joint = after.T @ np.diag(states) @ after + moved.T @ np.diag(rates) @ moved
    s = np.diag(moves)
    Q, R = block_diag(joint[:n, :n], s), joint[n:, n:] + np.diag(inputs) + s
    S = np.vstack([joint[:n, n:], -s])
    A, B = block_diag(A, np.zeros((m, m))), np.vstack([B, np.eye(m)])
    P = solve_discrete_are(A, B, Q, R, s=S)
    return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A + S.T), P


def plan_slopes(horizon: Any, step: float) -> np.ndarray:
    """Central differences of the terminal rows and the objective over the plan, (rows + 1, n_z)."""
    plan = horizon.arguments["z"]
    middle, columns = plan.copy(), []
    for away in step * np.eye(plan.size):
        ends = []
        for sign in (1.0, -1.0):
            plan[:] = middle + sign * away.reshape(plan.shape, order="F")
            horizon.evaluate()
            _, terminal, objective, *_ = horizon.evaluate.outputs
            ends.append(np.append(terminal, objective))
        columns.append((ends[0] - ends[1]) / (2 * step))
    plan[:] = middle
    return np.array(columns).T
