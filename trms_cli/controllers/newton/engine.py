"""The Newton MPC's engine: its C, compiled once for a structure, called sample by sample.

A structure is what the source depends on: the model's equations, the control period, the horizon
with its blocks, which states are weighed and limited. Parameters, weights, limits and prices are
settings, handed over when a run begins. What ``trms export-controller`` writes is the same source
with the settings inside.
"""

from __future__ import annotations

import ctypes
import functools
import inspect
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Prediction, Status
from trms_cli.controllers.fallback import NOT_FINITE, end_of_run
from trms_cli.controllers.newton import source
from trms_cli.controllers.newton.problem import NewtonProblem
from trms_cli.controllers.newton.state import NO_REGION, target_words
from trms_cli.core import c_source
from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.compilation import build_library, compiler, is_built
from trms_cli.core.invocation import remark_wait

#: Of the engine; the compiler keeps every operation as it is written.
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared")
STATUS = (Status.OK, Status.BUDGET, Status.RELAXED, Status.FAILED)  # in the order of mpc_status
FALLBACKS = ("", "shifted_plan", "hold", "steady_input", "stop")  # in the order of mpc_fallback
REASONS = (  # in the order of mpc_reason
    "",
    NOT_FINITE,
    "the predicted trajectory is not finite",
    "the quadratic program has no solution",
)
#: Numbers that a step says of itself, in the order of driver.c.
_WORDS = 13
_NAME = "newton_engine"
_TEMPLATES = ("newton_mpc.h", *source.PARTS, "driver.c")
#: For programs that call the source from outside: the time, where there is such a clock.
CLOCK = """\
#define _POSIX_C_SOURCE 200809L
#include <time.h>
#ifdef CLOCK_MONOTONIC
static double mpc_clock(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}
#define MPC_CLOCK mpc_clock
#endif
"""
_Pointer = ctypes.POINTER(ctypes.c_double)
_log = logging.getLogger(__name__)


class EngineLibrary:
    """Compiled C of a controller with its driver.

    ``path``: of the shared library. ``prefix``: of its names. Sizes are those of driver.c.
    ``period``: of the controller, s.
    """

    def __init__(self, path: Path, prefix: str) -> None:
        self._library, self._prefix = ctypes.CDLL(str(path)), prefix
        sizes, bytes_of = (ctypes.c_int * 8)(), (ctypes.c_size_t * 2)()
        offsets, period = (ctypes.c_size_t * 5)(), (ctypes.c_double * 1)()
        self.function("drive_sizes")(sizes)
        self.function("drive_structs")(bytes_of, period)
        self.function("drive_views")(offsets)
        self.n_x, self.n_u, self.n_w, self.n_r, self.preview, *rest = sizes
        self.n_periods, self.n_blocks, self.n_full = rest
        self.context_bytes, self.settings_bytes = bytes_of
        self.offsets, self.period = tuple(offsets), period[0]

    def function(self, name: str, result: Any = None) -> Any:
        """A function of the source, by its name without prefix."""
        function = getattr(self._library, f"{self._prefix}_{name}")
        function.restype = result
        return function


class EngineContext:
    """A controller's memory in C, and the arrays that it reads and writes.

    ``settings``: what C keeps of them; None for those inside the source. ``plan``: (n_blocks, n_u);
    inputs, V. ``full``: (n_full,); present state and memory of the input path. ``trajectory``:
    (N, n_full); states that the plan leads to. ``target_x``, ``target_u``: the steady state.
    """

    def __init__(
        self, library: EngineLibrary, first_command: FloatArray, settings: bytes | None = None
    ) -> None:
        if settings is not None and len(settings) != library.settings_bytes:
            raise ValueError(f"{len(settings)} bytes of settings, not {library.settings_bytes}")
        n_x, n_u, n_w = library.n_x, library.n_u, library.n_w
        memory = np.zeros(-(-library.context_bytes // 8))
        self._x, self._w, self._before = np.zeros(n_x), np.zeros(n_w), np.zeros(n_u)
        self._reference = np.zeros((library.preview + 1, library.n_r))
        self._u, self._words = np.zeros(n_u), np.zeros(_WORDS)
        first = np.ascontiguousarray(first_command, dtype=np.float64)
        library.function("drive_begin")(_pointer(memory), settings, _pointer(first))

        def view(offset: int, *shape: int) -> FloatArray:
            start = offset // 8
            return memory[start : start + math.prod(shape)].reshape(shape)

        plan, full, trajectory, x, u = library.offsets
        self.plan = view(plan, library.n_blocks, n_u)
        self.full = view(full, library.n_full)
        self.trajectory = view(trajectory, library.n_periods, library.n_full)
        self.target_x, self.target_u = view(x, n_x), view(u, n_u)
        arrays = (memory, self._x, self._w, self._reference, self._before, self._u, self._words)
        # The arrays live as long as the call that is bound to them.
        self._arrays = arrays
        step = library.function("drive_step", ctypes.c_int)
        self._call: Callable[[], int] = functools.partial(step, *map(_pointer, arrays))

    def step(self, sample: ControlSample) -> Command:
        """The command from now to the next control period; without a prediction."""
        estimate = sample.estimate
        self._x[:], self._w[:] = estimate.x, estimate.disturbance
        self._reference[...], self._before[:] = sample.reference, sample.previous_command
        status = STATUS[self._call()]
        values = self._words.tolist()
        acting, reason, iterations, objective, violation, terminal = values[:6]
        kkt, is_projected, is_held, linearise_time, qp_time, _, has_no_region = values[6:]
        fallback = FALLBACKS[int(acting)]
        if status is Status.FAILED:
            words = [REASONS[int(reason)]]
            words += [f"{fallback.replace('_', ' ')} acts"] if fallback != "stop" else []
        else:
            words = [status.meaning] if status is Status.RELAXED else []
            words += target_words(is_held=bool(is_held), is_projected=bool(is_projected))
            words += [NO_REGION] if has_no_region else []
        return Command(
            self._u.copy(),
            status,
            int(iterations),
            objective,
            violation if math.isnan(terminal) else max(violation, terminal),
            kkt,
            linearise_time,
            qp_time,
            fallback=fallback,
            message="; ".join(words),
            out_of_reach=bool(is_projected),
            terminal_residual=terminal,
        )

    def prediction(self, period: float, blocks: IntArray) -> Prediction:
        """The plan and the trajectory that it leads to.

        ``period``: s. ``blocks``: (N,); block of each control period.
        """
        n_x = len(self._x)
        states = np.vstack([self.full[:n_x], self.trajectory[:, :n_x]])
        inputs = self.plan[blocks]
        time = np.arange(len(states), dtype=np.float64) * period
        return Prediction(time, states, np.vstack([inputs, inputs[-1]]))


@dataclass(frozen=True)
class NewtonEngine:
    """What a run keeps: the problem, and its controller in C."""

    problem: NewtonProblem
    context: EngineContext

    @classmethod
    def of(cls, problem: NewtonProblem, setup: ControlSetup, preview: int) -> NewtonEngine | None:
        """A fresh controller, compiled where it has not been yet; None without a compiler.

        ``preview``: control periods that the reference is known ahead.
        """
        path = _built(problem, preview)
        if path is None:
            return None
        content = c_source.struct_content(source.settings(problem))
        return cls(problem, EngineContext(_library(path), setup.first_command, content))

    def step(self, sample: ControlSample, *, want_prediction: bool) -> Command:
        """One sample: target, Newton iterations, command.

        Raises SimulationError for a sample without a solution under the fall-back ``stop``.
        """
        command = self.context.step(sample)
        if command.fallback == "stop":
            raise end_of_run(self.problem.name, command.message)
        if want_prediction and command.status is not Status.FAILED:
            horizon = self.problem.horizon
            command.prediction = self.context.prediction(
                horizon.discrete.step_length, horizon.blocks
            )
        return command


@functools.lru_cache(maxsize=32)
def _library(path: Path) -> EngineLibrary:
    return EngineLibrary(path, "mpc")


def _built(problem: NewtonProblem, preview: int) -> Path | None:
    """The library in the cache, compiled if need be; None where that cannot be done."""

    def write(folder: Path) -> Path:
        c = source.newton_source(problem, preview, "mpc", problem.name, with_values=False)
        (folder / "mpc.h").write_text(c.header, encoding="utf-8")
        file = folder / f"{_NAME}.c"
        file.write_text(CLOCK + c.source + source.template("driver.c"), encoding="utf-8")
        return file

    content = _content(problem, preview)
    is_new, begin = not is_built(_NAME, content, FLAGS), perf_counter()
    if is_new and compiler() is not None:
        remark_wait(
            f"note   {problem.name} is compiled for this model and horizon, once: some seconds"
        )
    library = build_library(_NAME, content, FLAGS, write)
    if is_new and library is not None:
        spent = perf_counter() - begin
        _log.info("%s: compiled for this structure in %.1f s", problem.name, spent)
    return library


def _content(problem: NewtonProblem, preview: int) -> tuple[str, ...]:
    """All that the source follows from."""
    fields = [(field.declaration, field.comment) for field in source.settings(problem)]
    return (
        *(function.serialize() for function in source.functions_of(problem).values()),
        repr(source.sizes_of(problem, preview)),
        source.tables(problem),
        repr(fields),
        repr(problem.discrete.step_length),
        CLOCK,
        *map(inspect.getsource, (c_source, source)),
        *map(source.template, _TEMPLATES),
    )


def _pointer(array: FloatArray) -> Any:
    return array.ctypes.data_as(_Pointer)
