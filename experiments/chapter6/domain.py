"""From which initial states the terminal constraint can be met, and whether the loop needs it.

The constraint is met where some plan within the inputs' bounds leads there in N periods. The set
of such states is found point by point by the controller's own iteration with a dear terminal
constraint, from several starts: the steady-state input, the plan found for the next shorter
horizon with the local law (or the steady-state input) going on, and the plans of neighbours on the
grid. What is found is feasible; what is not found may be feasible all the same, so that the sets
are inner ones.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from experiments.chapter6.rig import FloatArray, Loop, state_at
from experiments.chapter6.study import Domain, Mode, draw_states

BoolArray = npt.NDArray[np.bool_]
#: Samples at the end of a loop over which it must have arrived.
_AT_REST = 5


@dataclass
class FeasibleStates:
    """Feasible states of one set of points."""

    states: list[FloatArray]  #: list of (n_x,) arrays
    #: By terminal constraint and horizon, one entry a state
    feasible: dict[tuple[str, int], BoolArray] = field(default_factory=dict)
    #: The same as found from the steady-state input alone, as the controller begins
    alone: dict[tuple[str, int], BoolArray] = field(default_factory=dict)


@dataclass(frozen=True)
class Arrivals:
    """Closed loops from states of the box."""

    terminal: str
    horizon: int
    #: Share of these states whose first plan meets the terminal constraint; NaN without one
    feasible: float
    arrived: float  #: Share of the loops that come to rest at the target
    cost: float  #: Mean of what the loops cost, in the objective's unit


class _Finder:
    """Looks for a plan that meets the terminal constraint."""

    def __init__(self, study: Domain, terminal: str, horizon: int) -> None:
        mode = Mode(terminal=terminal, horizon=horizon)
        linear, quadratic = study.prices
        self._loop = Loop(mode.controller(terminal_linear=linear, terminal_quadratic=quadratic))
        self._study, self._goal, self.horizon = study, np.array(study.goal), horizon
        self.target = self._loop.state.steady_state.solve(self._goal)

    def steady(self) -> FloatArray:
        """The steady-state input over the horizon."""
        return np.repeat(self.target.u[:, None], self.horizon, axis=1)

    def find(self, x: FloatArray, start: FloatArray) -> FloatArray | None:
        """A plan (n_u, N) from a start, or None."""
        loop, newton = self._loop, None
        loop.begin(x, self._goal, self.target.u)
        newton = loop.state.newton
        newton.plan[:] = start
        if loop.residual() <= self._study.feasible:
            return start
        for _ in range(self._study.iterations):
            outcome = newton.solve(1, 1e-7)
            if outcome.failed:
                return None
            if outcome.terminal_residual <= self._study.feasible:
                return newton.plan.copy()
            if outcome.stalled or outcome.converged:
                return None
        return None

    def longer(self, x: FloatArray, plan: FloatArray, horizon: int) -> FloatArray:
        """A plan that goes on by the local law, or by the steady-state input."""
        regions, u_s = self._loop.state.regions, self.target.u
        region = regions.region if regions is not None else None
        for u in plan.T:
            x = self._loop.after(x, u)
        inputs = list(plan.T)
        while len(inputs) < horizon:
            u = u_s
            if region is not None:
                xi = np.concatenate([x - self.target.x, inputs[-1] - u_s])
                newton = self._loop.state.newton
                u = np.clip(u_s + region.gain @ xi, newton.lower, newton.upper)
            x = self._loop.after(x, u)
            inputs.append(u)
        return np.array(inputs).T


def find_all(
    study: Domain, states: list[FloatArray], sides: tuple[int, int] | None = None
) -> FeasibleStates:
    """Feasibility of states; those of a grid (``sides``, row by row) have neighbours."""
    feasible_states = FeasibleStates(states)
    for terminal in study.terminals:
        shorter: list[FloatArray | None] = [None] * len(states)
        before: _Finder | None = None
        for horizon in study.horizons:
            finder = _Finder(study, terminal, horizon)
            plans = [finder.find(x, finder.steady()) for x in states]
            alone = np.array([plan is not None for plan in plans])
            for i, (x, plan) in enumerate(zip(states, shorter, strict=True)):
                if plans[i] is None and plan is not None and before is not None:
                    plans[i] = finder.find(x, before.longer(x, plan, horizon))
            if sides is not None:
                _spread(finder, states, plans, sides)
            feasible_states.alone[terminal, horizon] = alone
            feasible_states.feasible[terminal, horizon] = np.array(
                [plan is not None for plan in plans]
            )
            shorter, before = plans, finder
    return feasible_states


def _spread(
    finder: _Finder,
    states: list[FloatArray],
    plans: list[FloatArray | None],
    sides: tuple[int, int],
) -> None:
    """Try the plans of neighbours where none was found, as long as that finds any."""
    rows, columns = sides
    attempts: set[tuple[int, int]] = set()
    fresh = True
    while fresh:
        fresh = False
        for i in range(len(states)):
            if plans[i] is not None:
                continue
            row, column = divmod(i, columns)
            for r, c in (
                (row - 1, column),
                (row + 1, column),
                (row, column - 1),
                (row, column + 1),
            ):
                j = r * columns + c
                if not (0 <= r < rows and 0 <= c < columns) or (i, j) in attempts:
                    continue
                plan = plans[j]
                if plan is None:
                    continue
                attempts.add((i, j))
                plans[i] = finder.find(states[i], plan)
                if plans[i] is not None:
                    fresh = True
                    break


def slice_axes(study: Domain, name: str) -> tuple[tuple[str, FloatArray], tuple[str, FloatArray]]:
    """Offsets along both axes of a slice, by name."""
    (first, width), (second, height) = study.slices[name].items()
    n = study.grid
    return (first, np.linspace(-width, width, n)), (second, np.linspace(-height, height, n))


def study_slice(study: Domain, name: str) -> FeasibleStates:
    """Feasibility over a slice through the target; rows along the second axis."""
    target = _Finder(study, study.terminals[0], study.horizons[0]).target
    (first, xs), (second, ys) = slice_axes(study, name)
    states = [state_at(target.x, {first: x, second: y}) for y in ys for x in xs]
    return find_all(study, states, (len(ys), len(xs)))


def study_box(study: Domain, seed: int) -> FeasibleStates:
    """Feasibility of states drawn from the box."""
    target = _Finder(study, study.terminals[0], study.horizons[0]).target
    return find_all(study, draw_states(target.x, study.box, study.box_states, seed))


def study_loops(study: Domain, seed: int) -> list[Arrivals]:
    """Closed loops from the first states of the box, with the controller's own settings."""
    loops, goal, rows = study.loops, np.array(study.goal), []
    goals = np.tile(goal, (loops.samples, 1))
    for terminal in loops.terminals:
        for horizon in loops.horizons:
            loop = Loop(Mode(terminal=terminal, horizon=horizon).controller())
            target = loop.state.steady_state.solve(goal)
            feasible, arrived, cost = [], [], []
            for x in draw_states(target.x, study.box, loops.states, seed):
                record = loop.run(x, goals, target.u)
                ends = record.x[-_AT_REST:] - target.x
                rates = np.diff(record.x[-_AT_REST:], axis=0) / loop.mpc.sample_time
                off = max(np.abs(ends[:, [2, 5]]).max(), np.abs(rates[:, [2, 5]]).max())
                arrived.append(bool(off <= loops.arrived))
                feasible.append(record.residual[0] <= study.feasible)
                cost.append(float(np.nansum(record.stage)))
            feasible_share = float("nan") if terminal == "none" else float(np.mean(feasible))
            rows.append(
                Arrivals(
                    terminal, horizon, feasible_share, float(np.mean(arrived)), float(np.mean(cost))
                )
            )
    return rows
