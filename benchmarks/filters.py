"""Observers on the rig's model, and filterpy's filters on the same model and noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.setups import experiment
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import names
from trms_cli.observers.observer import ObserverSetup
from trms_cli.plants.plant import PlantSetup

_SAMPLE_TIME = 0.02
_EQUATIONS = ("pitch_moment", "yaw_moment")


def filter_setup(name: str) -> tuple[ObserverSetup, Any, np.ndarray, np.ndarray]:
    """A setup of 6 states and 2 torques, the observer, a measurement and a command."""
    loop_setup = experiment(
        "controller=newton_mpc",
        "ref=square",
        f"observer={name}",
        f"observer.disturbances=[{','.join(_EQUATIONS)}]",
        f"sim.sample_time={_SAMPLE_TIME}",
    )
    plant = loop_setup.plant.init(PlantSetup(_SAMPLE_TIME, 2, 0))
    outputs = tuple(signal.name for signal in plant.outputs)
    setup = ObserverSetup(
        loop_setup.model,
        _SAMPLE_TIME,
        outputs,
        plant.noise_sd,
        plant.measure(),
        plant.first_command,
    )
    return setup, loop_setup.observer, plant.measure().copy(), np.array([1.0, 0.1])


class _Model:
    """The model with its torques as filterpy's filters call it, compiled as ours is."""

    def __init__(self, setup: ObserverSetup, u: np.ndarray) -> None:
        model = setup.model
        discrete = discretise(model, setup.sample_time, 1)
        self._advance = BufferedFunction(discrete.step)
        self._sense = BufferedFunction(discrete.measurement)
        self._slopes = BufferedFunction(discrete.linearised())
        for function in (self._advance, self._sense, self._slopes):
            function.inputs[1][:] = u
            function.inputs[2][:] = model.parameters.values
        self._rows = [names(model.disturbances).index(name) for name in _EQUATIONS]
        self.n_x, self.n = model.n_x, model.n_x + len(_EQUATIONS)
        self.start = np.concatenate([model.rest(), np.zeros(len(_EQUATIONS))])
        self.H = np.eye(self.n)[[model.state_index(name) for name in setup.outputs]]
        self._F = np.eye(self.n)

    def fx(self, z: np.ndarray, dt: float) -> np.ndarray:
        self._advance.inputs[0][:] = z[: self.n_x]
        self._advance.inputs[3][self._rows] = z[self.n_x :]
        self._advance()
        return np.concatenate([self._advance.outputs[0], z[self.n_x :]])

    def hx(self, z: np.ndarray) -> np.ndarray:
        self._sense.inputs[0][:] = z[: self.n_x]
        self._sense()
        return self._sense.outputs[0].copy()

    def slope(self, z: np.ndarray) -> np.ndarray:
        self._slopes.inputs[0][:] = z[: self.n_x]
        self._slopes.inputs[3][self._rows] = z[self.n_x :]
        self._slopes()
        self._F[: self.n_x, : self.n_x] = self._slopes.outputs[1]
        self._F[: self.n_x, self.n_x :] = self._slopes.outputs[4][:, self._rows]
        return self._F


def _configure(peer: Any, model: _Model, setup: ObserverSetup) -> None:
    peer.x, peer.P = model.start.copy(), np.diag(np.full(model.n, 1e-2))
    peer.Q = np.diag(np.full(model.n, 1e-4))
    peer.R = np.diag([setup.noise_sd[name] ** 2 for name in setup.outputs])


def _ukf(setup: ObserverSetup, y: np.ndarray, u: np.ndarray) -> Callable[[], None]:
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    model = _Model(setup, u)
    points = MerweScaledSigmaPoints(model.n, alpha=1.0, beta=2.0, kappa=0.0)
    peer = UnscentedKalmanFilter(model.n, len(y), setup.sample_time, model.hx, model.fx, points)
    _configure(peer, model, setup)

    def step() -> None:
        peer.predict()
        peer.update(y)

    return step


def _ekf(setup: ObserverSetup, y: np.ndarray, u: np.ndarray) -> Callable[[], None]:
    from filterpy.kalman import ExtendedKalmanFilter

    model = _Model(setup, u)
    peer = ExtendedKalmanFilter(model.n, len(y))
    _configure(peer, model, setup)

    def step() -> None:
        # its own prediction of the mean is linear: the model's step stands in
        peer.F = model.slope(peer.x)
        peer.x = model.fx(peer.x, 0.0)
        peer.P = peer.F @ peer.P @ peer.F.T + peer.Q
        peer.update(y, lambda z: model.H, model.hx)

    return step


def _kalman(setup: ObserverSetup, y: np.ndarray, u: np.ndarray) -> Callable[[], None]:
    from filterpy.kalman import KalmanFilter

    model = _Model(setup, u)
    peer = KalmanFilter(model.n, len(y), len(u))
    _configure(peer, model, setup)
    peer.F, peer.H = model.slope(model.start).copy(), model.H
    peer.B = np.zeros((model.n, len(u)))

    def step() -> None:
        peer.predict(u)
        peer.update(y)

    return step


#: By observer: a step of filterpy's filter of the same kind.
PEERS: dict[str, Callable[[ObserverSetup, np.ndarray, np.ndarray], Callable[[], None]]] = {
    "ukf": _ukf,
    "ekf": _ekf,
    "kalman": _kalman,
}
