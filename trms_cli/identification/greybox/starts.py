"""Where the windows of a recording start, estimated from the data before anything is fitted.

Measured states are read off a polynomial through the samples around the start; the momenta follow
from the angles' rates by the model's own kinematics. States that are not measured (a rotor without
tacho, a hysteresis) and the memory of the input path are simulated from the beginning of the
recording, with the measured states put right at every window. A fit takes these starts as its
first guess, and as the centre of a wide prior that settles what a window says nothing about.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model
from trms_cli.models.rest import resting_state
from trms_cli.models.state_kinds import Kind, kinds_of_states
from trms_cli.simulation.rollout import Rollout

#: s, to either side of a start: the samples that its estimate uses.
_REACH = 0.2
#: Samples to either side at least.
_FEWEST = 4
#: How far a start may lie from its estimate, as a standard deviation: wide against any estimate's
#: error and narrow against the range of the state. An axis moves through radians at radians a
#: second; rotors reach hundreds of rad/s, the currents some ampere, a hysteresis ±1.
_SPREAD: dict[Kind, float] = {
    "angle": 0.1,
    "momentum": 0.5,
    "rotor": 20.0,
    "current": 0.5,
    "other": 0.5,
    "past": 0.1,
}


class Starts(NamedTuple):
    """Starts of windows."""

    states: FloatArray  #: (m, n) array; the model's states, then its memory
    #: (m, n - n_x, n_f) array; of the memory in the free parameters, exact; the commands before the
    #: window made it
    memory_slopes: FloatArray


def spreads(model: Model) -> FloatArray:
    """Standard deviation of the prior of each state at a window's start, shape (n_x,)."""
    return np.array([_SPREAD[kind] for kind in kinds_of_states(model)])


class StartEstimator:
    """Estimates the starts of windows of one recording, for any parameters.

    ``rollout``: of the model, at the recording's sample time. ``first``: (m,) array; first samples
    of the windows, ascending.
    """

    def __init__(self, rollout: Rollout, dataset: Dataset, first: IntArray) -> None:
        model = rollout.model
        self._rollout, self._commands, self._first = rollout, dataset.commands, first
        self._columns = [i for i, s in enumerate(dataset.outputs) if s.name in model.state_names]
        self._rows = np.array(
            [model.state_index(dataset.outputs[i].name) for i in self._columns], dtype=int
        )
        self._values, self._rates = _polynomials(dataset, first)
        self._kinematics = _Kinematics(model, {model.state_names[i] for i in self._rows})
        seen = {s.name: float(v) for s, v in zip(dataset.outputs, self._values[0], strict=True)}
        command = dataset.commands[0]
        self._opening = rollout.initial(resting_state(model, seen, command), command)

    def at(self, p: FloatArray) -> Starts:
        """The starts with all parameters at ``p``, shape (n_p,)."""
        rollout, model = self._rollout, self._rollout.model
        n = model.n_x
        state, slopes = self._opening, np.zeros((rollout.n_x - n, len(rollout.free)))
        states, memories, at = [], [], 0
        for j, sample in enumerate(self._first):
            if sample > at:
                state, slopes = _carried(rollout, self._commands, (at, sample), state, slopes, p)
                at = int(sample)
            state = state.copy()
            known = np.isfinite(self._values[j, self._columns])
            columns, rows = np.array(self._columns, dtype=int)[known], self._rows[known]
            state[rows] = self._values[j, columns]
            moving = {
                model.state_names[row]: float(self._rates[j, column])
                for row, column in zip(rows, columns, strict=True)
            }
            state[:n] = self._kinematics.with_rates(state[:n], self._commands[sample], moving, p)
            states.append(state)
            memories.append(slopes)
        return Starts(np.array(states), np.array(memories))


def estimated_starts(rollout: Rollout, dataset: Dataset, first: IntArray, p: FloatArray) -> Starts:
    """Starts of windows of one recording, for one set of parameters."""
    return StartEstimator(rollout, dataset, first).at(p)


def _carried(
    rollout: Rollout,
    commands: FloatArray,
    span: tuple[int, int],
    state: FloatArray,
    slopes: FloatArray,
    p: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """State and slopes of the memory after a stretch; a state that diverges stays where it was."""
    n = rollout.model.n_x
    window = ([span[0]], [span[1] - span[0]])
    if rollout.n_x > n:
        after = rollout.sensitivities(commands, *window, state[None], p)
        x, n_all = after.ends[0], rollout.n_x
        slopes = after.dends[0, n:, n:n_all] @ slopes + after.dends[0, n:, n_all:]
    else:
        x = rollout.outputs(commands, *window, state[None], p).ends[0]
    return np.where(np.isfinite(x), x, state), slopes


def _polynomials(dataset: Dataset, first: IntArray) -> tuple[FloatArray, FloatArray]:
    """Value and rate of each output at some samples, each (m, n_y); NaN where nothing is near."""
    reach = max(_FEWEST, round(_REACH / dataset.sample_time))
    n_y = dataset.measurements.shape[1]
    values, rates = np.full((len(first), n_y), np.nan), np.full((len(first), n_y), np.nan)
    for j, sample in enumerate(first):
        low, high = max(0, sample - reach), min(len(dataset), sample + reach + 1)
        t = (np.arange(low, high) - sample) * dataset.sample_time
        for i in range(n_y):
            y = dataset.measurements[low:high, i]
            here = np.isfinite(y)
            if np.count_nonzero(here) < 3:
                continue
            basis = np.vander(t[here] / (reach * dataset.sample_time), 3, increasing=True)
            fit, *_ = np.linalg.lstsq(basis, y[here], rcond=None)
            values[j, i], rates[j, i] = fit[0], fit[1] / (reach * dataset.sample_time)
    return values, rates


class _Kinematics:
    """Momenta from the rates of the angles."""

    def __init__(self, model: Model, measured: set[str]) -> None:
        kinds = kinds_of_states(model)
        self._model = model
        self._angles = [i for i, kind in enumerate(kinds) if kind == "angle"]
        self._momenta = [
            i
            for i, kind in enumerate(kinds)
            if kind == "momentum" and model.state_names[i] not in measured
        ]
        if model.sample_time is None and self._angles and self._momenta:
            x, u, q, w = model.symbols()
            rate = model.dynamics(x, u, q, w)[self._angles]
            slope = ca.densify(ca.jacobian(rate, x))
            self._rate = ca.Function("rate", [x, u, q, w], [rate, slope])
        else:
            self._momenta = []

    def with_rates(
        self, x: FloatArray, u: FloatArray, rates: dict[str, float], p: FloatArray
    ) -> FloatArray:
        """The state with the momenta at which the measured angles change as they do."""
        names_ = [self._model.state_names[i] for i in self._angles]
        rows = [k for k, name in enumerate(names_) if name in rates]
        if not rows or not self._momenta:
            return x
        wanted = np.array([rates[names_[k]] for k in rows])
        now, slope = (np.array(v) for v in self._rate(x, u, p, np.zeros(self._model.n_w)))
        # The rates are linear in the momenta.
        change, *_ = np.linalg.lstsq(
            slope[np.ix_(rows, self._momenta)], wanted - now[rows, 0], rcond=None
        )
        after = x.copy()
        after[self._momenta] += change
        return after
