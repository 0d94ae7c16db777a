"""Windows of a recording simulated with a model, and how the outputs depend on its parameters.

The loop over samples is C around the model's compiled step, so that a second of a rig at 50 Hz
takes microseconds. Sensitivities are exact: with the slopes A = ∂f/∂x and P = ∂f/∂θ of one
integration step,

    X⁺ = A X + [0 P]        X = ∂x/∂(x₀, θ),  at the start [I 0]
    ∂y/∂(x₀, θ) = C X + [0 D]

which is the derivative of the discretised model itself, not an approximation of the continuous
one's. Without a compiler the same functions run in CasADi's virtual machine, one call a sample.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.compilation import BufferedFunction, compiled_library
from trms_cli.core.errors import ModelError
from trms_cli.core.process_cache import call_memoised
from trms_cli.core.threads import SYMBOLS
from trms_cli.models.discretisation import DiscreteModel, Method, discretise
from trms_cli.models.model import Model, Signal
from trms_cli.models.scales import scales_of

#: s. Longest integration step unless another is asked for, and its share of the time of a model
#: of one's own: a lag acts by its mean over a step, which fine sensors tell from the lag itself.
LONGEST_STEP, _SHARE_OF_TIME = 0.02, 1 / 40
#: Fewer samples than this are not worth a second thread.
_WORTH_A_THREAD = 2000


def longest_step(model: Model) -> float:
    """s, of the integration of a model."""
    if model.bench_sizes or model.sample_time is not None:
        return LONGEST_STEP
    return min(LONGEST_STEP, _SHARE_OF_TIME * scales_of(model.without_effects()).time)


class SimulatedWindows(NamedTuple):
    """Outputs of windows, one after another."""

    y: FloatArray  #: (N, n_y) array; at every sample of every window, N the sum of their lengths
    ends: FloatArray  #: (m, n_x) array; states one sample after the last of each window


class Sensitive(NamedTuple):
    """Outputs of windows with their slopes."""

    y: FloatArray  #: As of :class:`SimulatedWindows`
    ends: FloatArray  #: As of :class:`SimulatedWindows`
    #: (N, n_y, n_x + n_f) array; in the window's own start first, in the free parameters then
    dy: FloatArray
    dends: FloatArray  #: (m, n_x, n_x + n_f) array


class Rollout:
    """A model over windows of commands that are constant between samples.

    Raises ModelError for a free parameter that the model does not have, or a step that it cannot
    make.

    ``sample_time``: s, of the commands and the outputs. ``free``: parameters in which
    :meth:`sensitivities` differentiates. ``substeps``: integration steps a sample; None: as many as
    keep them to :func:`longest_step`, and one for a model that has only a step. ``jobs``: threads
    among which windows are divided. ``states``: the model's, followed by its memory.
    """

    @SYMBOLS
    def __init__(
        self,
        model: Model,
        sample_time: float,
        *,
        free: Sequence[str] = (),
        substeps: int | None = None,
        method: Method = "auto",
        jobs: int = 1,
    ) -> None:
        for name in free:
            if name not in model.parameters:
                raise ModelError(
                    f"model {model.name!r} has no parameter {name!r}",
                    where="free",
                    remedy=f"it has: {', '.join(model.parameters.names)}",
                )
        if substeps is None:
            stepped = model.sample_time is not None
            substeps = 1 if stepped else int(np.ceil(sample_time / longest_step(model) - 1e-9))
        self.model, self.sample_time, self.free, self.jobs = model, sample_time, tuple(free), jobs
        # The slopes of one integration step are short code; those of several grow with each.
        # Only what remembers past commands or readings has to see the sample as a whole.
        remembers = model.memory(sample_time) or model.sensor_memory(sample_time)
        whole = bool(remembers) or model.sample_time is not None
        self._repeats = 1 if whole else substeps
        self._discrete = discretise(
            model, sample_time / self._repeats, substeps // self._repeats, method, sensors=True
        )
        self.states: tuple[Signal, ...] = self._discrete.states
        self._plain = _Loop(call_memoised(_functions, self._discrete), self._sizes())
        self._sloped: _Loop | None = None
        self._making = Lock()

    @property
    def n_x(self) -> int:
        return len(self.states)

    @property
    def n_free(self) -> int:
        """Number of states that commands do not determine: the model's, and its sensors' memory."""
        return self.model.n_x + self._discrete.n_sensors

    def initial(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """A full state from the model's own at the beginning of a recording.

        Its memory is as after a long time at the command, but for what begins cold.
        """
        full = self._discrete.initial(x, u)
        full[[state.begins_cold for state in self.states]] = 0.0
        return full

    def outputs(
        self,
        commands: FloatArray,
        first: npt.ArrayLike,
        count: npt.ArrayLike,
        starts: FloatArray,
        p: FloatArray | None = None,
    ) -> SimulatedWindows:
        """Simulate windows.

        ``commands``: (n, n_u); of the whole recording. ``first``, ``count``: (m,)s of int; first
        sample and number of samples of each window. ``starts``: (m, n_x); states at each first
        sample. ``p``: (n_p,) or None; values of all the model's parameters; None: the model's own.
        """
        call = self._call(commands, first, count, starts, p)
        y = np.empty((call.rows, self.model.n_y))
        ends = np.empty((len(call.count), self.n_x))
        self._share(call, self._plain, self._outputs_of, (y, ends))
        return SimulatedWindows(y, ends)

    def carried(
        self, commands: FloatArray, at: IntArray, states: FloatArray, p: FloatArray
    ) -> FloatArray:
        """States at some samples of one simulation through all of them, (m, n_x).

        ``at``: (m,) array; ascending. ``states``: (m, n_x) array; what is put right at each, NaN
        where the model carries on from the sample before; the first has none. ``p``: (n_p,) array.
        A component that diverges stays as it was.
        """
        after = np.ascontiguousarray(states, dtype=float).copy()
        if self._plain.library is not None:
            call = self._call(commands, at, np.ones(len(at)), after, p)
            pointers = map(_pointer, (call.first, call.commands, after, call.p))
            self._plain.library.trms_carry(ctypes.c_longlong(len(at)), *pointers)
            return after
        for j, (begin, end) in enumerate(pairwise(at.tolist())):
            now = after[j]
            if end > begin:
                now = self.outputs(commands, [begin], [end - begin], now[None], p).ends[0]
                now = np.where(np.isfinite(now), now, after[j])
            after[j + 1] = np.where(np.isnan(after[j + 1]), now, after[j + 1])
        return after

    def sensitivities(
        self,
        commands: FloatArray,
        first: npt.ArrayLike,
        count: npt.ArrayLike,
        starts: FloatArray,
        p: FloatArray | None = None,
    ) -> Sensitive:
        """Simulate windows with the slopes in their starts and in the free parameters.

        Parameters are those of :meth:`outputs`.
        """
        call = self._call(commands, first, count, starts, p)
        m, columns = len(call.count), self.n_x + len(self.free)
        y, ends = np.empty((call.rows, self.model.n_y)), np.empty((m, self.n_x))
        dy = np.empty((call.rows, self.model.n_y, columns))
        dends = np.empty((m, self.n_x, columns))
        self._share(call, self._with_slopes(), self._sensitivities_of, (y, ends, dy, dends))
        return Sensitive(y, ends, dy, dends)

    def _call(
        self,
        commands: FloatArray,
        first: npt.ArrayLike,
        count: npt.ArrayLike,
        starts: FloatArray,
        p: FloatArray | None,
    ) -> _Call:
        begin = np.ascontiguousarray(first, dtype=np.int64)
        lengths = np.ascontiguousarray(count, dtype=np.int64)
        parameter_values = self.model.parameters.values if p is None else p
        call = _Call(
            np.ascontiguousarray(commands, dtype=float),
            begin,
            lengths,
            np.ascontiguousarray(starts, dtype=float),
            np.ascontiguousarray(parameter_values, dtype=float),
        )
        m = len(begin)
        shapes = {
            "commands": (call.commands.shape[1:], (self.model.n_u,)),
            "count": (lengths.shape, (m,)),
            "starts": (call.starts.shape, (m, self.n_x)),
            "p": (call.p.shape, (len(self.model.parameters),)),
        }
        for name, (shape, expected_shape) in shapes.items():
            if shape != expected_shape:
                raise ValueError(f"{name} has shape {shape}, and {expected_shape} is needed")
        if m and (begin.min() < 0 or lengths.min() < 1 or (begin + lengths).max() > len(commands)):
            raise ValueError("a window lies outside the commands")
        return call

    def _with_slopes(self) -> _Loop:
        """The loop of :meth:`sensitivities`, made when it is first wanted.

        Of dozens of hypotheses that are simulated a few are searched.
        """
        with self._making:
            if self._sloped is None:
                with SYMBOLS:
                    functions = call_memoised(_sloped_functions, self._discrete, self.free)
                    self._sloped = _Loop(functions, {**self._sizes(), "NF": len(self.free)})
            return self._sloped

    def _sizes(self) -> dict[str, int]:
        sizes = {"NX": self.n_x, "NU": self.model.n_u, "NY": self.model.n_y}
        return {**sizes, "SUBSTEPS": self._repeats}

    def _share(self, call: _Call, loop: _Loop, work: Any, results: tuple[FloatArray, ...]) -> None:
        """Divide the windows among the threads; each writes its own part of the results."""
        m = len(call.count)
        jobs = min(self.jobs, m, max(1, call.rows // _WORTH_A_THREAD))
        if loop.library is None or jobs == 1:
            with nullcontext() if loop.library is not None else loop.one_at_a_time:
                work(loop, call, results)
            return
        offsets = np.concatenate([[0], np.cumsum(call.count)])
        cuts = np.searchsorted(offsets, np.linspace(0, call.rows, jobs + 1)[1:-1])
        edges = [0, *cuts.tolist(), m]

        def piece(a: int, b: int) -> None:
            rows = slice(offsets[a], offsets[b])
            # by sample and by window in turn: y, ends and, with slopes, dy, dends
            parts = (r[rows] if i % 2 == 0 else r[a:b] for i, r in enumerate(results))
            work(loop, call.part(a, b), tuple(parts))

        ranges = [(a, b) for a, b in pairwise(edges) if b > a]
        with ThreadPoolExecutor(len(ranges)) as pool:
            list(pool.map(lambda edge: piece(*edge), ranges))

    def _outputs_of(self, loop: _Loop, call: _Call, results: tuple[FloatArray, ...]) -> None:
        if loop.library is not None:
            loop.library.trms_rollout(*call.pointers(), *map(_pointer, results))
            return
        y, ends = results
        step, measure = loop.buffered
        for j, k, row, x, u in call.samples():
            y[row] = measure.evaluate(x, u, call.p)[0]
            for _ in range(self._repeats):
                x[:] = step.evaluate(x, u, call.p)[0]
            if k == call.count[j] - 1:
                ends[j] = x

    def _sensitivities_of(self, loop: _Loop, call: _Call, results: tuple[FloatArray, ...]) -> None:
        if loop.library is not None:
            loop.library.trms_sensitivities(*call.pointers(), *map(_pointer, results))
            return
        y, ends, dy, dends = results
        step, measure = loop.buffered
        n, f, n_y = self.n_x, len(self.free), self.model.n_y
        now = np.empty((n, n + f))
        for j, k, row, x, u in call.samples():
            if k == 0:
                now[:] = np.eye(n, n + f)
            value, c, d = measure.evaluate(x, u, call.p)
            y[row] = value
            dy[row] = c.reshape(n_y, n) @ now
            dy[row][:, n:] += d.reshape(n_y, f)
            for _ in range(self._repeats):
                after, a, b = step.evaluate(x, u, call.p)
                now = a.reshape(n, n) @ now
                now[:, n:] += b.reshape(n, f)
                x[:] = after
            if k == call.count[j] - 1:
                ends[j], dends[j] = x, now


class _Loop:
    """A loop over samples around a step and a measurement, in C where there is a compiler.

    ``sizes``: what the C source counts, by the names of its macros.
    """

    def __init__(self, functions: Sequence[ca.Function], sizes: Mapping[str, int]) -> None:
        work = {
            f"SZ_{kind}": max(getattr(f, f"sz_{kind.lower()}")() for f in functions)
            for kind in ("ARG", "RES", "IW", "W")
        }
        macros = "".join(f"#define {name} {size}\n" for name, size in {**sizes, **work}.items())
        source = Path(__file__).with_name("rollout_driver.c").read_text(encoding="utf-8")
        self.library = compiled_library(functions, macros + source)
        if self.library is None:
            self.buffered = [BufferedFunction(f, compile=False) for f in functions]
        #: Those have one set of arrays for whoever calls, several searching threads included.
        self.one_at_a_time = Lock()


@dataclass(frozen=True)
class _Call:
    """Checked arguments of a simulation."""

    commands: FloatArray
    first: IntArray
    count: IntArray
    starts: FloatArray
    p: FloatArray

    @property
    def rows(self) -> int:
        return int(self.count.sum())

    def part(self, a: int, b: int) -> _Call:
        windows = {name: getattr(self, name)[a:b] for name in ("first", "count", "starts")}
        return replace(self, **windows)

    def pointers(self) -> tuple[Any, ...]:
        arrays = (self.first, self.count, self.commands, self.starts, self.p)
        return (ctypes.c_longlong(len(self.count)), *map(_pointer, arrays))

    def samples(self) -> Any:
        """Window, sample, row of the results, state (to be advanced in place), command."""
        row = 0
        for j, (first, count) in enumerate(zip(self.first, self.count, strict=True)):
            x = self.starts[j].copy()
            for k in range(count):
                yield j, k, row, x, self.commands[first + k]
                row += 1


def _pointer(array: npt.NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _functions(discrete: DiscreteModel) -> list[ca.Function]:
    """Step and measurement, without disturbances."""
    x, u, p, after, y = _equations(discrete)
    return [
        ca.Function("rollout_step", [x, u, p], ca.cse([after])),
        ca.Function("rollout_measure", [x, u, p], ca.cse([y])),
    ]


def _sloped_functions(discrete: DiscreteModel, free: Sequence[str]) -> list[ca.Function]:
    """The same with their slopes in the state and in the free parameters."""
    x, u, p, after, y = _equations(discrete)
    columns = [discrete.model.parameters.names.index(name) for name in free]

    def sloped(name: str, of: ca.SX) -> ca.Function:
        in_p = ca.jacobian(of, p)[:, columns] if columns else ca.SX.zeros(of.shape[0], 0)
        slopes = [ca.densify(ca.jacobian(of, x)), ca.densify(in_p)]
        return ca.Function(name, [x, u, p], ca.cse([of, *slopes]))

    return [sloped("rollout_step_slopes", after), sloped("rollout_measure_slopes", y)]


def _equations(discrete: DiscreteModel) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
    """Symbols x, u, p; the next state and the outputs."""
    x, u, p, _ = discrete.symbols()
    after = discrete.step(x, u, p, ca.SX.zeros(discrete.model.n_w))
    return x, u, p, ca.densify(after), ca.densify(discrete.measurement(x, u, p))
