"""An exported controller as a loaded library, and a closed loop that drives it beside Python's."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from trms_cli.code_generation.newton_source import newton_source
from trms_cli.code_generation.observer_source import ObserverSource
from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Status
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.core.compilation import BufferedFunction, compiler
from trms_cli.models.discretisation import discretise
from trms_cli.models.estimate import Estimate

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
PERIOD = 0.1
STATUS = [Status.OK, Status.BUDGET, Status.RELAXED, Status.FAILED]
FALLBACKS = ["", "shifted_plan", "hold", "steady_input"]
_POINTER = ctypes.POINTER(ctypes.c_double)

#: What a test wants to know of the structs, as plain arrays, and to change in them.
_SHIM = """
#include "rig.h"
#include <stddef.h>
size_t shim_size(void) { return sizeof(rig_ctx); }
void shim_allow_iterations(rig_ctx *c, int most) { c->settings.max_iterations = most; }
int shim_step(rig_ctx *c, const double *x, const double *w, const double *r, const double *before,
              double *u, double *out) {
    rig_info i;
    int status = rig_step(c, x, w, r, before, u, &i);
    out[0] = i.fallback; out[1] = i.iterations; out[2] = i.objective; out[3] = i.target_projected;
    return status;
}
"""
_OBSERVER_SHIM = "size_t shim_observer_size(void) { return sizeof(rig_observer); }\n"


def pointer(array: np.ndarray) -> Any:
    return array.ctypes.data_as(_POINTER)


def contiguous(values: Any) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=float)


class Exported:
    """A context of a compiled controller named ``rig``."""

    def __init__(self, library: ctypes.CDLL, n_u: int) -> None:
        self.library, self._n_u = library, n_u
        library.shim_size.restype = ctypes.c_size_t
        self.context = ctypes.create_string_buffer(library.shim_size())
        library.rig_init(self.context)

    def step(self, x: Any, w: Any, reference: Any, before: Any) -> Command:
        given = [contiguous(value) for value in (x, w, reference, before)]
        u, out = np.full(self._n_u, np.nan), np.zeros(4)
        status = self.library.shim_step(
            self.context, *map(pointer, given), pointer(u), pointer(out)
        )
        return Command(
            u,
            STATUS[status],
            fallback=FALLBACKS[int(out[0])],
            iterations=int(out[1]),
            objective=out[2],
            out_of_reach=bool(out[3]),
        )


def build(
    folder: Path,
    controller: NewtonMpc,
    setup: ControlSetup,
    observer: ObserverSource | None = None,
    optimise: str = "-O1",
) -> ctypes.CDLL:
    """Write, compile with every warning an error, and load."""
    source = newton_source(controller, setup, "rig", "under test", observer)
    (folder / "rig.c").write_text(source.source)
    (folder / "rig.h").write_text(source.header)
    (folder / "shim.c").write_text(_SHIM + (_OBSERVER_SHIM if observer else ""))
    program = compiler()
    assert program is not None
    for command in (
        [*STRICT, optimise, "-fPIC", "-c", "rig.c"],
        ["-fPIC", "-shared", "-o", "rig.so", "rig.o", "shim.c", "-lm"],
    ):
        done = subprocess.run([program, *command], cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[:3000]
    return ctypes.CDLL(str(folder / "rig.so"))


@dataclass
class Compared:
    """Both controllers over a closed loop with equal inputs."""

    differences: list[float] = field(default_factory=list)
    python: list[Command] = field(default_factory=list)
    exported: list[Command] = field(default_factory=list)

    @property
    def worst(self) -> float:
        """Largest difference of a command, V."""
        return max(self.differences)

    def statuses(self) -> set[Status]:
        return {said.status for said in self.exported}


def compare(
    library: ctypes.CDLL,
    controller: NewtonMpc,
    setup: ControlSetup,
    reference: Callable[[float], Any],
    samples: int,
    *,
    torque: Callable[[float], Any] | None = None,
    estimated: Callable[[int], Any] | None = None,
    noise: float = 0.0,
    spoil: Callable[[int, np.ndarray, np.ndarray, np.ndarray], None] | None = None,
) -> Compared:
    """Python's commands drive a finely integrated rig; the exported controller sees the same.

    Parameters
    ----------
    torque, estimated : callable, optional
        On the rig at a time (s), and as an observer would tell at a sample; (n_w,).
    noise : float
        Of the estimate, in the states' units.
    spoil : callable, optional
        Changes sample k's estimate, torques and references in place.
    """
    model, period = setup.model, setup.sample_time
    exported, state = Exported(library, model.n_u), controller.init(setup)
    discrete = discretise(model, period, 1 if model.sample_time else 5)
    step, p = BufferedFunction(discrete.step), model.parameters.values
    u, draw = setup.first_command.copy(), np.random.default_rng(7)
    full = discrete.initial(model.rest(), u)
    found, lower, upper = Compared(), *model.input_bounds()
    for k in range(samples):
        ahead = range(controller.preview_horizon + 1)
        r = contiguous([reference((k + i) * period) for i in ahead])
        x = full[: model.n_x] + noise * draw.standard_normal(model.n_x)
        w = contiguous(np.zeros(model.n_w) if estimated is None else estimated(k))
        if spoil is not None:
            spoil(k, x, w, r)
        said = exported.step(x, w, r, u)
        sample = ControlSample(k * period, r, Estimate(x, np.zeros_like(x), w, np.zeros_like(w)), u)
        command = controller.step(state, sample, want_prediction=False)
        assert np.isfinite(said.u).all()
        assert (said.u >= lower).all() and (said.u <= upper).all()
        found.differences.append(float(np.abs(said.u - command.u).max()))
        found.python.append(command)
        found.exported.append(said)
        u = command.u
        pushing = np.zeros(model.n_w) if torque is None else contiguous(torque(k * period))
        full = step.evaluate(full, u, p, pushing)[0].copy()
    return found
