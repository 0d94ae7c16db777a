"""A controller in closed loop with its own model, sample by sample, its solver looked into."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
import numpy.typing as npt

from trms_cli.controllers.controller import ControlSample, ControlSetup
from trms_cli.controllers.newton.state import NewtonMpcState
from trms_cli.controllers.newton.step import NewtonResult
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import discretise
from trms_cli.models.estimate import Estimate
from trms_cli.models.newtonian import Newtonian

FloatArray = npt.NDArray[np.float64]

MODEL = Newtonian()
#: Rates by name: their angle, and the state that is chosen to give them.
RATES = {"rate_v": ("alpha_v", "S_v"), "rate_h": ("alpha_h", "S_h")}


@dataclass
class Record:
    """A run; one row a control sample, ``x`` one more."""

    x: FloatArray  #: (n + 1, n_x) and (n, n_u)
    u: FloatArray  #: (n + 1, n_x) and (n, n_u)
    #: ``objective``, ``stage``, ``residual``, ``shifted``, ``last_move``: (n,) arrays; J of the
    #: plan, the stage cost that was paid, the terminal residual of the plan, that of the last plan
    #: shifted in time before any iteration, and what a move from the plan's end to the steady-state
    #: input costs
    objective: FloatArray
    stage: FloatArray
    residual: FloatArray
    shifted: FloatArray
    last_move: FloatArray
    iterations: FloatArray  #: (n,) array
    converged: npt.NDArray[np.bool_]  #: (n,) bool array
    seconds: FloatArray  #: (n,) array; of a sample's computation, s


@dataclass
class Loop:
    """A Newton MPC and a rig that is the model, integrated in ``substeps`` a control period.

    With one substep the rig does exactly what is predicted.
    """

    mpc: NewtonMpc
    substeps: int = 1
    state: NewtonMpcState = field(init=False)

    def __post_init__(self) -> None:
        period = self.mpc.sample_time
        self._step = BufferedFunction(discretise(MODEL, period, self.substeps).step)
        self.state = NewtonMpcState(self.mpc, ControlSetup(MODEL, period, np.zeros(MODEL.n_u)))

    def begin(self, x: FloatArray, goal: FloatArray, u_before: FloatArray) -> None:
        """Target and first plan of a sample: the last plan shifted in time."""
        zeros, no_torque = np.zeros(MODEL.n_x), np.zeros(MODEL.n_w)
        estimate = Estimate(x.copy(), zeros, no_torque, no_torque)
        self.state.begin_sample(ControlSample(0.0, goal[None, :], estimate, u_before))

    def solve(self) -> NewtonResult:
        """Newton iterations as the controller makes them."""
        mpc, state = self.mpc, self.state
        return state.newton.solve(mpc.max_iterations, mpc.tolerance, state.other_start)

    def residual(self) -> float:
        """Terminal residual of the present plan: scaled, or how far out of the region it ends."""
        horizon = self.state.newton.horizon
        horizon.arguments["z"][:] = self.state.newton.plan
        horizon.evaluate()
        terminal = horizon.evaluate.outputs[1]
        if not horizon.n_terminal:
            return 0.0
        return float(max(0.0, terminal[0]) if horizon.has_region else np.abs(terminal).max())

    def after(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """The rig one control period later."""
        return np.array(self._step.evaluate(x, u, MODEL.parameters.values, np.zeros(MODEL.n_w))[0])

    def stage_cost(
        self, x: FloatArray, after: FloatArray, u: FloatArray, before: FloatArray
    ) -> float:
        """What the objective of a sample takes for its first period."""
        mpc, target = self.mpc, self.state.target
        assert target is not None
        total = 0.0
        for name, weight in mpc.state_weights.items():
            i = MODEL.state_index(name)
            total += weight * (after[i] - target.x[i]) ** 2
        for name, weight in mpc.rate_weights.items():
            i = MODEL.state_index(name)
            total += weight * ((after[i] - x[i]) / mpc.sample_time) ** 2
        for j, signal in enumerate(MODEL.inputs):
            total += mpc.input_weights.get(signal.name, 0.0) * (u[j] - target.u[j]) ** 2
            total += mpc.move_weights.get(signal.name, 0.0) * (u[j] - before[j]) ** 2
        return float(total)

    def _last_move(self) -> float:
        target, plan = self.state.target, self.state.newton.plan
        assert target is not None
        weights = [self.mpc.move_weights.get(signal.name, 0.0) for signal in MODEL.inputs]
        return float(np.dot(weights, (target.u - plan[:, -1]) ** 2))

    def run(self, x: FloatArray, goals: FloatArray, u_before: FloatArray) -> Record:
        """Follow goals, shape (n, n_r), from a state; the command before acts on the moves."""
        n = len(goals)
        states, inputs = [x.copy()], []
        rows = {
            key: np.full(n, np.nan)
            for key in (
                *("objective", "stage", "residual", "shifted"),
                *("last_move", "iterations", "seconds"),
            )
        }
        converged = np.zeros(n, dtype=bool)
        before = u_before.copy()
        for k, goal in enumerate(goals):
            begin = perf_counter()
            self.begin(x, goal, before)
            prepared = perf_counter() - begin
            if k:
                rows["shifted"][k] = self.residual()
            else:  # what was planned in an earlier run is forgotten
                assert self.state.target is not None
                self.state.newton.plan[:] = self.state.target.u[:, None]
                self.state.other_start = None
            begin = perf_counter()
            outcome = self.solve()
            rows["seconds"][k] = prepared + perf_counter() - begin
            u = self.state.newton.plan[:, 0].copy()
            after = self.after(x, u)
            rows["objective"][k] = outcome.objective
            rows["residual"][k] = outcome.terminal_residual
            rows["iterations"][k] = outcome.iterations
            rows["stage"][k] = self.stage_cost(x, after, u, before)
            rows["last_move"][k] = self._last_move()
            converged[k] = outcome.converged
            states.append(after)
            inputs.append(u)
            x, before = after, u
            if not np.isfinite(after).all():
                break
        return Record(np.array(states), np.array(inputs), converged=converged, **rows)


def state_at(target: FloatArray, offsets: Mapping[str, float]) -> FloatArray:
    """The target's state with angles, rotor speeds and rates (``rate_v``, ``rate_h``) moved.

    A rate is that of the angle; the angular momentum S that goes with it depends on the other
    states. Rates that are not named are zero.
    """
    x = target.copy()
    for name, offset in offsets.items():
        if name not in RATES:
            x[MODEL.state_index(name)] += offset
    for _, momentum in RATES.values():
        x[MODEL.state_index(momentum)] = 0.0
    drift = _RATE.evaluate(x, np.zeros(MODEL.n_u), MODEL.parameters.values, np.zeros(MODEL.n_w))[0]
    for name, (angle, momentum) in RATES.items():
        x[MODEL.state_index(momentum)] = offsets.get(name, 0.0) - drift[MODEL.state_index(angle)]
    return x


def _rates() -> BufferedFunction:
    import casadi as ca

    at = MODEL.symbols()
    return BufferedFunction(ca.Function("rates", list(at), [ca.densify(MODEL.dynamics(*at))]))


_RATE = _rates()
