"""The exported Newton MPC against Python's, sample by sample in closed loops; exported filters over
a noisy rig with missing samples and outliers.
"""

import ctypes
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.subjects.exported import rounding_difference
from trms_cli.code_generation.export import check_exportable, example_rows
from trms_cli.code_generation.observer_source import ObserverSource, observer_source
from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Status
from trms_cli.controllers.newton.source import newton_source
from trms_cli.controllers.newton.state import NewtonMpcState
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.controllers.qp.osqp import Osqp
from trms_cli.core.compilation import BufferedFunction, compiler
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.cable_hysteresis import CableHysteresis
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.effects.sensor_delay import SensorDelay
from trms_cli.models.discretisation import discretise
from trms_cli.models.estimate import Estimate
from trms_cli.models.newtonian import Newtonian
from trms_cli.observers.ekf import Ekf
from trms_cli.observers.kalman import Kalman
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.ukf import Ukf
from trms_cli.references.square import Square
from trms_cli.references.trajectory import ReferenceTrajectory

from .closed_loop_case import SAMPLE_TIME, sample_of, setup_of

pytestmark = pytest.mark.skipif(compiler() is None, reason="needs a C compiler")

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-Wpedantic", "-Wconversion")
PERIOD = 0.1
#: V, and states' units, relative to sizes of about 1 rad and 100 rad/s; what is left is rounding.
EQUAL = 1e-7
STATUS = [Status.OK, Status.BUDGET, Status.RELAXED, Status.FAILED]
FALLBACKS = ["", "shifted_plan", "hold", "steady_input", "stop"]
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
    problem, preview = controller.problem(setup), controller.preview(setup)
    source = newton_source(problem, preview, "rig", "under test", observer)
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
) -> list[tuple[Command, Command]]:
    """Python's commands drive a finely integrated rig; the exported controller answers the same.

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
    exported, state = Exported(library, model.n_u), NewtonMpcState(controller, setup)
    discrete = discretise(model, period, 1 if model.sample_time else 5)
    step, p = BufferedFunction(discrete.step), model.parameters.values
    u, draw = setup.first_command.copy(), np.random.default_rng(7)
    full = discrete.initial(model.rest(), u)
    found, lower, upper = [], *model.input_bounds()
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
        assert (said.u >= lower).all() and (said.u <= upper).all()
        assert np.abs(said.u - command.u).max() <= EQUAL
        found.append((command, said))
        u = command.u
        pushing = np.zeros(model.n_w) if torque is None else contiguous(torque(k * period))
        full = step.evaluate(full, u, p, pushing)[0].copy()
    return found


SHORT = {"prediction_horizon": 20, "move_blocks": (1,) * 20}
ONE = {**SHORT, "max_iterations": 1}
LIMITED: dict[str, Any] = {
    **SHORT,
    "input_rate_limits": {"u_v": 3.0, "u_h": 5.0},
    "soft_limits": {"alpha_v": (-0.3, 0.25)},
    "preview_horizon": 6,
    "input_weights": {"u_v": 0.05},
}


def squares(time: float) -> tuple[float, float]:
    return (0.3, 0.5) if time % 16 < 8 else (-0.3, -0.5)


def sines(time: float) -> tuple[float, float]:
    return 0.3 * np.sin(0.3 * time), 0.8 * np.sin(0.2 * time + 1)


def levels(time: float) -> tuple[float, float]:
    draw = np.random.default_rng(int(time / 3.7))
    return draw.uniform(-0.8, 0.8), draw.uniform(-1.5, 1.5)


def beyond(time: float) -> tuple[float, float]:
    return (1.2, 3.0) if time % 16 < 8 else (-1.4, -3.0)


def wandering(k: int) -> np.ndarray:
    return 1e-3 * np.random.default_rng(k).standard_normal(4)


def made(name: str, optimise: str = "-O1", **options: Any) -> Any:
    """A fixture: the library of a controller, the controller itself, its setup."""

    @pytest.fixture(scope="module", name=name)
    def built(tmp_path_factory: Any) -> tuple[Any, ...]:
        controller, setup = NewtonMpc(**options), setup_of(Newtonian())
        return (
            build(tmp_path_factory.mktemp(name), controller, setup, optimise=optimise),
            controller,
            setup,
        )

    return built


one = made("one", "-O2", **ONE)
converged = made("converged")  # the default tuning
limited = made("limited", **LIMITED)
unconstrained = made("unconstrained", **SHORT, terminal="none", fallback="hold")


@pytest.mark.parametrize("reference", [squares, sines, levels])
def test_one_iteration(one, reference):
    found = compare(*one, reference, 200, estimated=wandering, noise=1e-3)
    assert Status.BUDGET in {said.status for _, said in found}


@pytest.mark.parametrize("reference", [squares, sines, levels, beyond])
def test_iterated_to_convergence(converged, reference):
    found = compare(*converged, reference, 100, estimated=wandering)
    assert Status.OK in {said.status for _, said in found}
    for command, said in found:
        assert (said.status, said.iterations) == (command.status, command.iterations)
        assert said.objective == pytest.approx(command.objective, rel=1e-9, abs=1e-12)
        assert said.out_of_reach == command.out_of_reach
    assert any(said.out_of_reach for _, said in found) == (reference is beyond)


def test_a_torque_on_the_rig_that_the_observer_tells(converged):
    def push(time):
        return (0.02 if 3 < time < 9 else 0.0, 0.01 if time > 6 else 0.0, 0.0, 0.0)

    compare(*converged, squares, 100, torque=push, estimated=lambda k: push(k * PERIOD))


def test_rates_a_limit_and_a_preview(limited):
    _, controller, _ = limited
    found = compare(*limited, levels, 200)
    u = np.array([command.u for command, _ in found])
    moves = np.abs(np.diff(u, axis=0)).max(axis=0) / PERIOD
    assert moves == pytest.approx(list(controller.input_rate_limits.values()), rel=1e-6)


@pytest.mark.slow
def test_where_rounding_decides_it_is_as_near_as_python_to_itself(tmp_path):
    # The limit on the rotor contradicts the end of the horizon: near convergence the line search
    # goes by the last bits of an exact penalty.
    controller = NewtonMpc(soft_limits={"omega_h": (-120.0, 120.0)})
    setup = setup_of(Newtonian())
    reference = ReferenceTrajectory(
        alpha_v=Square(amplitude=0.3, frequency=0.025),
        alpha_h=Square(amplitude=1.2, frequency=0.025),
    )
    rows = example_rows(controller, setup, reference, 400)
    itself = rounding_difference(controller, setup, rows)
    exported = Exported(build(tmp_path, controller, setup), 2)
    worst = 0.0
    for row in rows:
        x, w, r, u, chosen = np.split(row, np.cumsum([6, 4, 2, 2]))
        worst = max(worst, float(np.abs(exported.step(x, w, r, u).u - chosen).max()))
    assert worst <= max(EQUAL, 10 * itself)


@pytest.mark.slow
def test_a_terminal_region_is_designed_where_it_runs(tmp_path):
    controller, setup = NewtonMpc(**SHORT, terminal="quasi_infinite"), setup_of(Newtonian())
    compare(build(tmp_path, controller, setup), controller, setup, sines, 100)


@pytest.mark.slow
def test_without_a_terminal_constraint(unconstrained):
    compare(*unconstrained, levels, 100, estimated=wandering)


@pytest.mark.parametrize(
    "model",
    [
        pytest.param(Newtonian(freedom="vertical"), id="vertical"),
        pytest.param(Newtonian(freedom="horizontal"), id="horizontal", marks=pytest.mark.slow),
        pytest.param(
            extend_model(Newtonian(), {"d": InputDelay(rotor="main", delay=0.13)}), id="delay"
        ),
        pytest.param(
            extend_model(Newtonian(), {"h": CableHysteresis(axis="yaw", torque=0.005, width=0.15)}),
            id="path_memory",
        ),
    ],
)
def test_other_models(tmp_path, model):
    controller, setup = NewtonMpc(**SHORT), setup_of(model)
    library = build(tmp_path, controller, setup)
    compare(library, controller, setup, lambda time: squares(time)[: len(model.controlled)], 100)


@pytest.mark.parametrize("spoilt", ["estimate", "torques", "reference"])
def test_what_is_not_finite_meets_the_declared_fall_back(one, spoilt):
    def spoil(k, x, w, r):
        if k % 7 == 5:
            {"estimate": x, "torques": w, "reference": r[0]}[spoilt][k % 2] = (np.nan, np.inf)[
                k % 2
            ]

    found = compare(*one, levels, 80, spoil=spoil)
    for k, (command, said) in enumerate(found):
        assert (said.status is Status.FAILED) == (k % 7 == 5)
        assert said.fallback == command.fallback


@pytest.mark.parametrize("size", [1e3, 1e30, 1e200, 1.7e308])
def test_nothing_makes_it_leave_the_limits_and_it_comes_back(converged, size):
    library, _, setup = converged
    exported, draw = Exported(library, 2), np.random.default_rng(3)
    lower, upper = setup.model.input_bounds()
    for k in range(40):
        x, w, r = (size * draw.uniform(-1, 1, n) for n in (6, 4, 2))
        before = draw.uniform(-3, 3, 2) if k % 5 else np.array([np.nan, np.inf])
        said = exported.step(x, w if k % 2 else 0 * w, r if k % 3 else 0 * r, before)
        assert np.isfinite(said.u).all()
        assert (said.u >= lower).all() and (said.u <= upper).all()
    x, u = setup.model.rest(), np.zeros(2)
    for _ in range(60):
        said = exported.step(x, np.zeros(4), [x[5], x[2]], u)
        u = said.u
    assert said.status in (Status.OK, Status.BUDGET)


def test_two_contexts_share_nothing_and_one_may_be_moved_in_memory(one):
    library, _, setup = one
    x = setup.model.rest()
    alone, first, second = (Exported(library, 2) for _ in range(3))
    u, v = np.zeros(2), np.zeros(2)
    for k in range(20):
        expected = alone.step(x, np.zeros(4), squares(k * PERIOD), u).u
        said = first.step(x, np.zeros(4), squares(k * PERIOD), u).u
        v = second.step(x + 0.1, wandering(k), levels(k), v).u
        assert (said == expected).all()
        u = expected
    here, there, u = Exported(library, 2), Exported(library, 2), np.zeros(2)
    for k in range(10):
        u = here.step(x, wandering(k), squares(k), u).u
    ctypes.memmove(there.context, here.context, len(here.context))
    for k in range(10, 20):
        u, moved = (c.step(x, wandering(k), squares(k), u).u for c in (here, there))
        assert (u == moved).all()


def test_settings_that_are_changed_between_steps_count(one):
    """The iterations of a controller that was exported with one, set to ten."""
    library, _, setup = one
    many = NewtonMpc(**{**ONE, "max_iterations": 10})
    state, exported = NewtonMpcState(many, setup), Exported(library, 2)
    library.shim_allow_iterations(exported.context, 10)
    x, u, w = setup.model.rest(), np.zeros(2), np.zeros(4)
    for k in range(5):
        r = squares(8 * k)
        said = exported.step(x, w, contiguous([r]), u)
        command = many.step(state, sample_of(setup.model, r, x, u), want_prediction=False)
        assert np.abs(said.u - command.u).max() <= EQUAL
        assert said.iterations == command.iterations
        u = command.u


def test_it_needs_nothing_but_libm(one):
    """No allocation, no input or output: what is undefined in the object file."""
    library, *_ = one
    object_file = str(library._name).replace("rig.so", "rig.o")
    listed = subprocess.run(["nm", object_file], capture_output=True, text=True, check=True).stdout
    undefined = {line.split()[-1] for line in listed.splitlines() if " U " in line}
    allowed = {"memcpy", "memset", "memmove", "memcmp", "_GLOBAL_OFFSET_TABLE_"}
    mathematics = {"sin", "cos", "sincos", "sqrt", "fmax", "fmin", "exp", "pow", "atan", "tanh"} | {
        "log",
        "nearbyint",
    }
    assert undefined <= allowed | mathematics
    written = [line.split()[-1] for line in listed.splitlines() if re.search(r" [bBD] ", line)]
    assert written == []
    exported = {line.split()[-1] for line in listed.splitlines() if " T " in line}
    assert exported == {"rig_init", "rig_init_at", "rig_step"}


@pytest.mark.parametrize(
    ("options", "where"),
    [
        ({"qp": Osqp()}, "controller.qp"),
    ],
)
def test_what_has_no_c_is_refused_by_name(options, where):
    with pytest.raises(ConfigurationError) as caught:
        check_exportable(NewtonMpc(**options))
    assert caught.value.where == where


CHANNELS = {"alpha_v": 5e-4, "alpha_h": 5e-4, "omega_v": 1.6, "omega_h": 1.6}


class Filter:
    """A context of an exported filter named ``rig``."""

    def __init__(self, library: ctypes.CDLL, setup: ObserverSetup) -> None:
        library.shim_observer_size.restype = ctypes.c_size_t
        self.library = library
        self.context = ctypes.create_string_buffer(library.shim_observer_size())
        model = setup.model
        self.x, self.w = np.zeros(model.n_x), np.zeros(model.n_w)
        first = [np.ascontiguousarray(v) for v in (setup.first_measurement, setup.first_command)]
        library.rig_observer_init(self.context, *map(pointer, first))

    @property
    def mean(self) -> np.ndarray:
        return np.frombuffer(self.context, dtype=float, count=len(self.x))

    def step(self, u: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.library.rig_observe(
            self.context, pointer(u), pointer(y), None, pointer(self.x), pointer(self.w)
        )
        return self.x, self.w


def compiled(folder: Any, observer: Any, model: Any, channels: tuple[str, ...]) -> tuple[Any, ...]:
    """The setup with a first measurement off rest, and the compiled filter."""
    first = np.array([{"alpha_v": -0.4, "omega_v": 60.0}.get(name, 0.1) for name in channels])
    setup = ObserverSetup(
        model, SAMPLE_TIME, channels, {name: CHANNELS[name] for name in channels}, first,
        np.full(model.n_u, 0.3),
    )  # fmt: skip
    control = setup_of(model, 5 * SAMPLE_TIME, setup.first_command)
    short = NewtonMpc(prediction_horizon=4)
    return setup, build(folder, short, control, observer_source(observer, setup))


def rig(setup: ObserverSetup, samples: int) -> Any:
    """Commands and noisy measurements with gaps, outliers and a channel that jumps."""
    model = setup.model
    discrete = discretise(model, SAMPLE_TIME, sensors=True)
    draw, u = np.random.default_rng(1), setup.first_command.copy()
    full = discrete.initial(model.rest(), u)
    p, sd = model.parameters.values, np.array([CHANNELS[name] for name in setup.outputs])
    rows = [[s.name for s in model.outputs].index(name) for name in setup.outputs]
    for k in range(samples):
        y = np.asarray(discrete.measurement(full, u, p)).ravel()[rows]
        y = y + sd * draw.standard_normal(len(y))
        if k % 50 == 7:
            y[k % len(y)] = np.nan
        if 120 < k < 140:
            y[:] = np.nan
        if k % 90 == 11:
            y[-1] += 80 * sd[-1]
        if 200 < k < 300:
            y[0] += 0.5
        yield u.copy(), y
        if k % 5 == 0:
            u = np.clip(u + 0.05 * draw.standard_normal(len(u)), -0.6, 0.6)
        full = np.asarray(discrete.step(full, u, p, np.zeros(model.n_w))).ravel()


def agree(setup: ObserverSetup, observer: Any, library: ctypes.CDLL, samples: int) -> None:
    exported, state = Filter(library, setup), observer.init(setup)
    n_x = setup.model.n_x
    assert np.abs(exported.mean - state.prior_mean[:n_x]).max() <= 1e-7
    scale = np.maximum(1.0, np.abs(state.prior_mean[:n_x]))
    rejected = 0
    for u, y in rig(setup, samples):
        estimate = observer.step(state, u, y, None)
        x, w = exported.step(u, y)
        assert np.isfinite(x).all() and np.isfinite(w).all()
        assert (np.abs(x - estimate.x) / scale).max() <= EQUAL
        assert np.abs(w - estimate.disturbance).max() <= EQUAL
        rejected += int(estimate.rejected.sum())
    assert rejected > 0


@pytest.mark.parametrize(
    ("observer", "channels"),
    [
        pytest.param(Ukf(), tuple(CHANNELS), id="ukf"),
        pytest.param(Ukf(), ("alpha_v", "alpha_h"), id="ukf-angles", marks=pytest.mark.slow),
        pytest.param(Ekf(), tuple(CHANNELS), id="ekf", marks=pytest.mark.slow),
        pytest.param(Kalman(), tuple(CHANNELS), id="kalman", marks=pytest.mark.slow),
    ],
)
def test_filters(tmp_path, observer, channels):
    setup, library = compiled(tmp_path, observer, Newtonian(), channels)
    agree(setup, observer, library, 400)


def test_a_delay_of_the_input_is_remembered_and_an_estimate_always_finite(tmp_path):
    model = extend_model(Newtonian(freedom="vertical"), {"d": InputDelay(rotor="main", delay=0.05)})
    setup, library = compiled(tmp_path, Ukf(), model, ("alpha_v", "omega_v"))
    agree(setup, Ukf(), library, 400)
    model = Newtonian(freedom="vertical")
    setup, library = compiled(tmp_path, Ukf(gate=None), model, ("alpha_v", "omega_v"))
    u = setup.first_command
    for value in (np.inf, 1e300, -1.7e308):
        exported = Filter(library, setup)
        for k in range(40):
            y = np.array([value if k % 3 == 0 else -0.5, value if k % 4 == 0 else 1.0])
            x, w = exported.step(u, y)
            assert np.isfinite(x).all() and np.isfinite(w).all()


def test_sensors_with_memory_are_refused(tmp_path):
    model = extend_model(Newtonian(), {"s": SensorDelay(axis="pitch", delay=0.05)})
    with pytest.raises(ConfigurationError, match="whose sensors remember"):
        compiled(tmp_path, Ukf(), model, tuple(CHANNELS))
