"""Exported filters against Python's over a noisy rig with missing samples and outliers."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import pytest

from trms_cli.code_generation.observer_source import observer_source
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.core.compilation import compiler
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.effects.sensor_delay import SensorDelay
from trms_cli.models.discretisation import discretise
from trms_cli.models.newtonian import Newtonian
from trms_cli.observers.ekf import Ekf
from trms_cli.observers.kalman import Kalman
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.ukf import Ukf

from .closed_loop_case import setup_of
from .exported_controller import build, pointer

pytestmark = pytest.mark.skipif(compiler() is None, reason="needs a C compiler")

PERIOD = 0.02
CHANNELS = {"alpha_v": 5e-4, "alpha_h": 5e-4, "omega_v": 1.6, "omega_h": 1.6}
#: States' units, relative to sizes of about 1 rad and 100 rad/s.
EQUAL = 1e-9


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


def made(folder: Any, observer: Any, model: Any, channels: tuple[str, ...]) -> tuple[Any, ...]:
    """The setup with a first measurement off rest, and the compiled filter."""
    first = np.array([{"alpha_v": -0.4, "omega_v": 60.0}.get(name, 0.1) for name in channels])
    setup = ObserverSetup(
        model, PERIOD, channels, {name: CHANNELS[name] for name in channels}, first,
        np.full(model.n_u, 0.3),
    )  # fmt: skip
    control = setup_of(model, 5 * PERIOD, setup.first_command)
    short = NewtonMpc(prediction_horizon=4)
    return setup, build(folder, short, control, observer_source(observer, setup))


def rig(setup: ObserverSetup, samples: int) -> Any:
    """Commands and noisy measurements with gaps, outliers and a channel that jumps."""
    model = setup.model
    discrete = discretise(model, PERIOD, sensors=True)
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
    setup, library = made(tmp_path, observer, Newtonian(), channels)
    agree(setup, observer, library, 400)


def test_a_delay_of_the_input_is_remembered(tmp_path):
    model = extend_model(Newtonian(freedom="vertical"), {"d": InputDelay(rotor="main", delay=0.05)})
    setup, library = made(tmp_path, Ukf(), model, ("alpha_v", "omega_v"))
    agree(setup, Ukf(), library, 400)


def test_an_estimate_is_always_finite(tmp_path):
    model = Newtonian(freedom="vertical")
    setup, library = made(tmp_path, Ukf(gate=None), model, ("alpha_v", "omega_v"))
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
        made(tmp_path, Ukf(), model, tuple(CHANNELS))
