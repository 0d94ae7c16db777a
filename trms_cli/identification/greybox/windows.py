"""All windows of a problem's recordings, simulated at once, as whitened residuals.

Where they start is estimated from the data before anything is fitted. Measured states are read off
a polynomial through the samples around the start; the momenta follow from the angles' rates by the
model's own kinematics. States that are not measured (a rotor without tacho, a hysteresis), the
memory of the sensors and that of the input path are simulated from the beginning of the recording,
with the measured states put right at every window. A fit takes these starts as its first guess, and
as the centre of a wide prior that settles what a window says nothing about.

The memory of the input path follows from the commands and stays as it is simulated. What sensors
remember (past angles of a delay, a mode that rings) is the past of a motion that the simulation had
left long before the window: it is free, as the states are.
"""

from functools import cached_property
from threading import Lock
from typing import NamedTuple

import casadi as ca
import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray, IntArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.problem import FitProblem
from trms_cli.models.model import Model, names
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

    states: FloatArray  #: (m, n) array; those that are free, then the memory of the input path
    #: (m, n - n_x, n_f) array; of that memory in the free parameters, exact; the commands before
    #: the window made it
    memory_slopes: FloatArray


def spreads(model: Model) -> FloatArray:
    """Standard deviation of the prior of each state at a window's start, shape (n_x,)."""
    return np.array([_SPREAD[kind] for kind in kinds_of_states(model)])


def spread_of_memory(remembered: FloatArray, least: float) -> FloatArray:
    """Standard deviation of the prior of what sensors remember, shape (k,): as large as it is.

    ``remembered``: (m, k) array; at some starts, as simulated. ``least``: no deviation is smaller.
    """
    return np.asarray(np.maximum(np.sqrt(np.mean(remembered**2, axis=0)), least))


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
        first_values = {
            s.name: float(v) for s, v in zip(dataset.outputs, self._values[0], strict=True)
        }
        command = dataset.commands[0]
        self._opening = rollout.initial(resting_state(model, first_values, command), command)
        measured = bool(np.isfinite(self._values[:, self._columns]).all())
        #: Whether all that is put right at the starts follows from the measurements there alone
        self._at_once = (
            measured
            and self._kinematics.follows_from(self._rows)
            and not (rollout.n_x > rollout.n_free and rollout.free)
        )

    def at(self, p: FloatArray) -> Starts:
        """The starts with all parameters at ``p``, shape (n_p,)."""
        rollout, model = self._rollout, self._rollout.model
        n = model.n_x
        if self._at_once:
            return self._all_at_once(p)
        state, slopes = self._opening, np.zeros((rollout.n_x - rollout.n_free, len(rollout.free)))
        states, memories, at = [], [], 0
        for j, sample in enumerate(self._first):
            if sample > at:
                state, slopes = _carried(rollout, self._commands, (at, sample), state, slopes, p)
                at = int(sample)
            state = state.copy()
            is_measured = np.isfinite(self._values[j, self._columns])
            columns, rows = np.array(self._columns, dtype=int)[is_measured], self._rows[is_measured]
            state[rows] = self._values[j, columns]
            moving = {
                model.state_names[row]: float(self._rates[j, column])
                for row, column in zip(rows, columns, strict=True)
            }
            state[:n] = self._kinematics.with_rates(state[:n], self._commands[sample], moving, p)
            states.append(state)
            memories.append(slopes)
        return Starts(np.array(states), np.array(memories))

    def _all_at_once(self, p: FloatArray) -> Starts:
        rollout, n = self._rollout, self._rollout.model.n_x
        m, momenta = len(self._first), self._kinematics.momenta
        states = np.full((m, rollout.n_x), np.nan)
        states[:, self._rows] = self._values[:, self._columns]
        full_states = np.tile(self._opening[:n], (m, 1))
        full_states[:, self._rows] = states[:, self._rows]
        moving = dict(zip(self._rows.tolist(), self._rates[:, self._columns].T, strict=True))
        full_states = self._kinematics.with_all_rates(
            full_states, self._commands[self._first], moving, p
        )
        states[:, momenta] = full_states[:, momenta]
        no_slopes = np.zeros((m, rollout.n_x - rollout.n_free, len(rollout.free)))
        if np.isfinite(states).all():
            return Starts(states, no_slopes)
        at, states = np.append(0, self._first), np.vstack([self._opening, states])
        return Starts(rollout.carried(self._commands, at, states, p)[1:], no_slopes)


def _carried(
    rollout: Rollout,
    commands: FloatArray,
    span: tuple[int, int],
    state: FloatArray,
    slopes: FloatArray,
    p: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """State and slopes of the memory after a stretch; a state that diverges stays where it was."""
    n = rollout.n_free
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
    t = np.arange(-reach, reach + 1)
    at = first[:, None] + t
    inside = (at >= 0) & (at < len(dataset))
    near = dataset.measurements[np.clip(at, 0, len(dataset) - 1)].swapaxes(1, 2)
    measured = np.isfinite(near) & inside[:, None]
    basis = np.vander(t / reach, 3, increasing=True)
    # where every sample is there, which is nearly everywhere, one inverse does for all
    fits = np.where(measured, near, 0.0) @ np.linalg.pinv(basis).T
    for j, i in np.argwhere(~measured.all(axis=2)):
        here = measured[j, i]
        fits[j, i] = np.nan
        if np.count_nonzero(here) >= 3:
            fits[j, i] = np.linalg.lstsq(basis[here], near[j, i, here], rcond=None)[0]
    return fits[..., 0], fits[..., 1] / (reach * dataset.sample_time)


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
            slopes = ca.jacobian(rate, x)
            slope = slopes[:, self._momenta]
            self._depends_on = set(slopes.sparsity().get_triplet()[1])
            # not compiled: it is a few operations, and other ones for every model
            self._function = ca.Function("rate", [x, u, q, w], [rate, slope])
            self._rate = BufferedFunction(self._function, compile=False)
            self._one_at_a_time = Lock()
        else:
            self._momenta = []

    @property
    def momenta(self) -> list[int]:
        """Positions of the momenta that the angles' rates tell."""
        return self._momenta

    def follows_from(self, measured: IntArray) -> bool:
        """Whether the momenta, if there are any, follow from those states and their rates alone."""
        if not self._momenta:
            return True
        if len(self._momenta) != len(self._angles) or not set(self._angles) <= set(measured):
            return False
        return self._depends_on <= {*measured.tolist(), *self._momenta}

    def with_all_rates(
        self, x: FloatArray, u: FloatArray, rates: dict[int, FloatArray], p: FloatArray
    ) -> FloatArray:
        """As :meth:`with_rates`, of states (m, n_x) and commands (m, n_u) that all are known.

        ``rates``: (m,) arrays of the states that are measured.
        """
        if not self._momenta:
            return x
        m, angles = len(x), self._angles
        arguments = np.repeat(p[:, None], m, axis=1), np.zeros((self._model.n_w, m))
        values = self._function.map(m)(x.T, u.T, *arguments)
        now, slope = (np.asarray(ca.DM(value).full()) for value in values)
        slopes = slope.T.reshape(m, len(angles), len(angles)).swapaxes(1, 2)
        gaps = np.array([rates[row] for row in angles]) - now
        after = x.copy()
        after[:, self._momenta] += np.linalg.solve(slopes, gaps.T[..., None])[..., 0]
        return after

    def with_rates(
        self, x: FloatArray, u: FloatArray, rates: dict[str, float], p: FloatArray
    ) -> FloatArray:
        """The state with the momenta at which the measured angles change as they do."""
        names_ = [self._model.state_names[i] for i in self._angles]
        rows = [k for k, name in enumerate(names_) if name in rates]
        if not rows or not self._momenta:
            return x
        goal_rates = np.array([rates[names_[k]] for k in rows])
        with self._one_at_a_time:
            now, slope = (
                np.reshape(value, (len(self._angles), -1))[rows]
                for value in self._rate.evaluate(x, u, p, np.zeros(self._model.n_w))
            )
        # The rates are linear in the momenta.
        change, *_ = np.linalg.lstsq(slope, goal_rates - now[:, 0], rcond=None)
        after = x.copy()
        after[self._momenta] += change
        return after


#: No residual is divided by less than this (in the output's unit).
_LEAST_SD = 1e-9


class Residuals(NamedTuple):
    """Predicted less measured, not yet divided by anything."""

    r: FloatArray  #: (m, c, n_y) array; by window, sample, output; 0 where nothing was measured
    #: (m, c, n_y, n_x + n_f) array or None; slopes in the window's start and in the free parameters
    j: FloatArray | None
    ends: FloatArray  #: (m, n_x) array; states one sample after each window
    dends: FloatArray | None  #: (m, n_x, n_x + n_f) array or None

    @property
    def finite(self) -> bool:
        """Whether the simulation stayed finite in all windows."""
        return bool(np.isfinite(self.r).all())


class Windows:
    """The windows of a problem's recordings, which have one sample time.

    ``with_parameters``: whether slopes in the free parameters are wanted; without them only those
    in the starts are computed, which is what a search without gradients needs. ``rollout``: of the
    problem's model, free parameters and sample time, made before; None: make it. ``unseen``:
    samples at the beginning of each window that are not compared, so that models whose sensors
    remember so many, and models whose sensors do not, are compared on the same samples.
    """

    def __init__(
        self,
        problem: FitProblem,
        *,
        with_parameters: bool = True,
        rollout: Rollout | None = None,
        unseen: int = 0,
    ) -> None:
        self.problem, self.datasets = problem, problem.datasets
        times = {round(dataset.sample_time, 9) for dataset in self.datasets}
        if len(times) > 1:
            raise ConfigurationError(
                f"the recordings have different sample times: {sorted(times)} s",
                where="real",
                remedy="fit those of one sample time together, or resample them",
            )
        model = problem.model
        self.sample_time = self.datasets[0].sample_time
        free = problem.names if with_parameters else ()
        self.rollout = rollout or Rollout(
            model, self.sample_time, free=free, substeps=problem.substeps, jobs=problem.jobs
        )
        length, stride = problem.window_length, problem.window_stride
        if stride is not None:
            stride = min(stride, length)
        #: Weight of a squared residual: below 1 where windows overlap
        self.share = 1.0 if stride is None else stride / length
        self._commands = np.vstack([d.commands for d in self.datasets])
        firsts, counts, self._of_dataset, offset = [], [], [], 0
        for dataset in self.datasets:
            first, count = dataset.windows(length, stride)
            self._of_dataset.append((dataset, first, slice(offset, offset + len(first))))
            firsts.append(first)
            counts.append(count)
            offset += len(first)
        lengths = np.cumsum([0, *(len(d) for d in self.datasets)])
        self.first = np.concatenate([f + o for f, o in zip(firsts, lengths, strict=False)])
        self.count = np.concatenate(counts)
        #: (m,) arrays; of each window: number of its recording, and its first sample in that
        self.recording: IntArray = np.repeat(np.arange(len(firsts)), [len(f) for f in firsts])
        self.first_in_recording: IntArray = np.concatenate(firsts)
        #: (m,) array of bool; whether a window begins where the one before it ends
        self.follows = np.concatenate(
            [[False], self.first[1:] == self.first[:-1] + self.count[:-1]]
        )
        for _, _, rows in self._of_dataset:
            self.follows[rows.start] = False
        self._estimators = [
            StartEstimator(self.rollout, dataset, first) for dataset, first, _ in self._of_dataset
        ]
        self._latest: tuple[FloatArray, list[Starts]] = (np.zeros(0), [])
        #: (m, c) array of bool; which samples belong to a window
        self.inside: BoolArray = np.arange(int(self.count.max()))[None] < self.count[:, None]
        #: Standard deviation of each output's noise as declared, (m, n_y), and what was measured,
        #: (m, c, n_y), NaN where there is nothing to compare
        self.declared, self.target = self._measurements()
        self.target[:, :unseen] = np.nan
        self.measured = np.isfinite(self.target)
        if not self.measured.any():
            raise ConfigurationError(
                "the recordings hold no measured sample", where="real", remedy="look at the files"
            )
        self.spread = self._spread()  #: (n_x,) array; of the prior of the starts

    def __len__(self) -> int:
        return len(self.first)

    @property
    def n_x(self) -> int:
        """Number of states that a window begins with: the model's, and its sensors' memory."""
        return self.rollout.n_free

    def starts(self, p: FloatArray) -> FloatArray:
        """Estimated starts of the windows, shape (m, n_x)."""
        return np.vstack([s[:, : self.n_x] for s, _ in self._estimated(p)])

    def with_memory(self, p: FloatArray, starts: FloatArray) -> FloatArray:
        """Full states (m, n): some starts, and the memory of the input path at them."""
        return self._with_memory(p, starts)[0]

    @cached_property
    def commands(self) -> FloatArray:
        """Commands of all windows, (m, c, n_u), the last repeated past a window's end."""
        k = np.minimum(np.arange(self.inside.shape[1]), self.count[:, None] - 1)
        return np.asarray(self._commands[self.first[:, None] + k])

    def residuals(self, p: FloatArray, starts: FloatArray, *, slopes: bool = False) -> Residuals:
        """Simulate with all parameters ``p`` (n_p,) from ``starts`` (m, n_x)."""
        x, memory_slopes = self._with_memory(p, starts)
        if not slopes:
            y, ends = self.rollout.outputs(self._commands, self.first, self.count, x, p)
            return Residuals(self._compared(y), None, ends[:, : self.n_x], None)
        y, ends, dy, dends = self.rollout.sensitivities(
            self._commands, self.first, self.count, x, p
        )
        j = self._by_window(dy)
        dends = dends[:, : self.n_x]
        j, dends = self._in_model_states(j, dends, memory_slopes)
        return Residuals(self._compared(y), j, ends[:, : self.n_x], dends)

    def opening_residuals(self, p: FloatArray, starts: FloatArray, samples: int) -> FloatArray:
        """``r`` of :meth:`residuals` at the first samples of each window, (m, samples, n_y)."""
        x, _ = self._with_memory(p, starts)
        count = np.minimum(self.count, samples)
        return self._compared(
            self.rollout.outputs(self._commands, self.first, count, x, p).y, samples
        )

    def _compared(self, y: FloatArray, samples: int | None = None) -> FloatArray:
        here = np.s_[:, :samples]
        return np.where(self.measured[here], self._by_window(y, samples) - self.target[here], 0.0)

    def _by_window(self, rows: FloatArray, samples: int | None = None) -> FloatArray:
        """Rows of one window after another as (m, c, …); zero past the end of a short one."""
        inside = self.inside[:, :samples]
        shape = (*inside.shape, *rows.shape[1:])
        if inside.all():
            return rows.reshape(shape)
        values = np.zeros(shape)
        values[inside] = rows
        return values

    def _in_model_states(
        self, j: FloatArray, dends: FloatArray, memory_slopes: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Slopes without those in the input's memory, whose own slopes go to the parameters."""
        n, n_all = self.n_x, self.rollout.n_x
        if memory_slopes is None:
            return j, dends
        through = [
            np.einsum("m...k,mkf->m...f", slopes[..., n:n_all], memory_slopes)
            for slopes in (j, dends)
        ]
        j = np.concatenate([j[..., :n], j[..., n_all:] + through[0]], axis=-1)
        dends = np.concatenate([dends[..., :n], dends[..., n_all:] + through[1]], axis=-1)
        return j, dends

    def _with_memory(
        self, p: FloatArray, starts: FloatArray
    ) -> tuple[FloatArray, FloatArray | None]:
        if self.rollout.n_x == self.n_x:
            return starts, None
        x, slopes = zip(*self._estimated(p), strict=True)
        full = np.vstack(x)
        full[:, : self.n_x] = starts
        return full, np.concatenate(slopes)

    def _estimated(self, p: FloatArray) -> list[Starts]:
        # starts and the input's memory at them are asked for one after the other
        point, starts = self._latest
        if not np.array_equal(point, p):
            starts = [estimator.at(p) for estimator in self._estimators]
            self._latest = (p.copy(), starts)
        return starts

    def _spread(self) -> FloatArray:
        model = self.problem.model
        of_states = spreads(model)
        if self.n_x == model.n_x:
            return of_states
        remembered = self.starts(self.problem.all_values(self.problem.starts))[:, model.n_x :]
        return np.concatenate([of_states, spread_of_memory(remembered, self.declared.min())])

    def _measurements(self) -> tuple[FloatArray, FloatArray]:
        """Declared noise (m, n_y) and measured outputs (m, c, n_y), NaN where there is none."""
        outputs = names(self.problem.model.outputs)
        sd = np.ones((len(self), len(outputs)))
        target = np.full((*self.inside.shape, len(outputs)), np.nan)
        for dataset, first, rows in self._of_dataset:
            columns = [outputs.index(name) for name in names(dataset.outputs)]
            sd[rows, columns] = np.maximum(dataset.noise_sd, _LEAST_SD)
            for j, begin in zip(range(rows.start, rows.stop), first, strict=True):
                n = int(self.count[j])
                target[j, :n, columns] = dataset.measurements[begin : begin + n].T
        return sd, target
