"""Rigs, setups and loops that the tests of observers share."""

from collections.abc import Callable, Iterator
from typing import Any

import casadi as ca
import numpy as np

from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import discretise
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model, RigAxis, RigRotor, Signal, names
from trms_cli.models.parameters import ParameterSet
from trms_cli.observers.observer import Observer, ObserverSetup

NOISE_SD = {"alpha_v": 5e-4, "alpha_h": 5e-4, "omega_v": 1.6, "omega_h": 1.6}
SAMPLE_TIME = 0.02
TRIM = np.array([1.413, 0.3])


class Pendulum(Model):
    """A linear rig: one axis with a spring and a damper, and a motor with lag."""

    def __init__(self) -> None:
        self.name = "pendulum"
        self.states = (
            Signal("angle", "rad"),
            Signal("momentum", "rad/s"),
            Signal("speed", "rad/s"),
        )
        self.inputs = (Signal("u", "V"),)
        self.outputs = (Signal("angle", "rad"), Signal("speed", "rad/s"))
        self.disturbances = (Signal("moment", "N*m"), Signal("motor", "N*m"))
        self.parameters = ParameterSet([], "pendulum")
        self.controlled = ("angle",)
        self.input_limits = {"u": 1.0}
        self.stops = {"angle": np.inf}
        self.axes = {"swing": RigAxis("angle", "moment")}
        self.rotors = {"motor": RigRotor("u")}

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        return ca.vertcat(
            x[1], -2.0 * x[0] - 0.1 * x[1] + 0.5 * x[2] + 3.0 * w[0], 4.0 * (u - x[2]) + w[1]
        )

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        return ca.vertcat(x[0] + 0.1 * u[0], x[2])


def setup_for(model: Model, outputs: tuple[str, ...] | None = None) -> ObserverSetup:
    outputs = outputs or names(model.outputs)
    return ObserverSetup(
        model,
        SAMPLE_TIME,
        outputs,
        NOISE_SD,
        np.zeros(len(outputs)),
        np.array([TRIM[("u_v", "u_h").index(name)] for name in names(model.inputs)]),
    )


class Rig:
    """The model itself, disturbed as the filter believes it is."""

    def __init__(self, model: Model, outputs: tuple[str, ...], seed: int = 0) -> None:
        self.random = np.random.default_rng(seed)
        self.discrete = discretise(model, SAMPLE_TIME)
        self.step_function = BufferedFunction(self.discrete.step)
        self.rows = [model.state_index(name) for name in outputs]
        self.sd = np.array([NOISE_SD[name] for name in outputs])
        self.p = model.parameters.values
        self.x = self.discrete.initial(model.rest(), np.zeros(model.n_u))

    def measure(self) -> np.ndarray:
        return self.x[self.rows] + self.sd * self.random.standard_normal(len(self.rows))

    def advance(self, u: np.ndarray, torque: Any = 0.0, noise_sd: Any = 0.0) -> None:
        w = np.zeros(self.discrete.model.n_w) + torque
        self.x = self.step_function.evaluate(self.x, u, self.p, w)[0].copy()
        self.x += noise_sd * self.random.standard_normal(self.x.size)


def followed(
    observer: Observer,
    state: Any,
    rig: Rig,
    inputs: np.ndarray,
    torque: Any = 0.0,
    noise_sd: Any = 0.0,
    lost: range = range(0),
    spoil: Callable[[int, np.ndarray], np.ndarray] = lambda k, y: y,
) -> Iterator[tuple[int, Estimate]]:
    """Run rig and observer; at each sample, before the rig moves on, the estimate is yielded."""
    u_before = inputs[0]
    for k, u in enumerate(inputs):
        y = spoil(k, rig.measure())
        if k in lost:
            y[:] = np.nan
        yield k, observer.step(state, u_before, y, None)
        rig.advance(u, torque, noise_sd)
        u_before = u


def commands(samples: int, n_u: int = 2) -> np.ndarray:
    """Around the trim, different on each input, within the limits."""
    t = np.arange(samples) * SAMPLE_TIME
    columns = [TRIM[i % 2] + 0.3 * np.sin((1.3 + 0.7 * i) * t) for i in range(n_u)]
    return np.stack(columns, axis=1)
