"""Simulations that show what an effect does, seen substep by substep."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import extended
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian

FloatArray = npt.NDArray[np.float64]

STEP = 0.02  # s
SUBSTEPS = 4
#: Momentum state and inertia of an axis, by its angle.
_OF_AXIS = {"alpha_v": ("S_v", "inertia_pitch"), "alpha_h": ("S_h", "inertia_yaw")}


@dataclass(frozen=True, kw_only=True)
class Run:
    """One simulation: times (n + 1,), states by name, commands (n, 2) and what reached the motors.

    Attributes
    ----------
    time, command, arriving : FloatArray
        s; V, held over each step; V, mean of each substep.
    states : dict of str to FloatArray
    torque : dict of str to FloatArray
        Torque that the effect added, by the axis' angle, mean of each substep, N m.
    """

    time: FloatArray
    command: FloatArray
    arriving: FloatArray
    states: dict[str, FloatArray]
    torque: dict[str, FloatArray]


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A simulation that shows an effect.

    Attributes
    ----------
    effect : str
        Canonical name; the option's own sizes unless ``sizes`` has others.
    command : callable
        Times (n,) to commands (n, 2), V.
    duration : float
        s.
    start : dict of str to float
        States that do not begin at rest.
    """

    effect: str
    command: Callable[[FloatArray], FloatArray]
    duration: float
    sizes: dict[str, float] = field(default_factory=dict)
    start: dict[str, float] = field(default_factory=dict)


def library_effect(name: str, sizes: dict[str, float] | None = None) -> Effect:
    """An effect of the library by its name, with other sizes if given."""
    import yaml

    text = (config_folder() / "effect" / f"{name}.yaml").read_text(encoding="utf-8")
    effect = build(yaml.safe_load(text)[name] | (sizes or {}), f"effect.{name}")
    assert isinstance(effect, Effect)
    return effect


def simulate(scene: Scene, effects: dict[str, Effect]) -> Run:
    """Run a scene, and tell on the way what the effects did."""
    base = Newtonian()
    model = extended(base, effects)
    time: FloatArray = STEP * np.arange(round(scene.duration / STEP) + 1, dtype=np.float64)
    command = scene.command(time[:-1])
    # Each substep is a step of its own here, so that torque and arriving command can be seen.
    paths, memory = _input_paths(model)
    small = STEP / SUBSTEPS
    forward = BufferedFunction(discretise(_WithoutPath(model), small).step)
    beneath = BufferedFunction(discretise(base, small).step)
    inertia = _inertias(base)
    x = model.rest()
    for name, value in scene.start.items():
        x[model.state_index(name)] = value
    p, w = model.parameters.values, np.zeros(model.n_w)
    states, arriving = [x.copy()], []
    torque: dict[str, list[float]] = {angle: [] for angle in _OF_AXIS}
    for u in command:
        for path in paths:
            reached, memory = (np.array(v) for v in path.evaluate(memory, u, p))
            free = beneath.evaluate(x[: base.n_x], reached, p[: len(base.parameters)], w)[0].copy()
            x = forward.evaluate(x, reached, p, w)[0].copy()
            arriving.append(reached)
            inertias = np.asarray(inertia(x[: base.n_x], p[: len(base.parameters)])).ravel()
            for value, (angle, (momentum, _)) in zip(inertias, _OF_AXIS.items(), strict=True):
                row = base.state_index(momentum)
                torque[angle].append(float(value * (x[row] - free[row]) / small))
        states.append(x.copy())
    return Run(
        time=time,
        command=command,
        arriving=np.array(arriving),
        states=dict(zip(model.state_names, np.array(states).T, strict=True)),
        torque={angle: np.array(values) for angle, values in torque.items()},
    )


class _WithoutPath(Model):
    """A model whose motors take their input as it is."""

    def __init__(self, model: Model) -> None:
        self.__dict__.update(model.__dict__)
        self._model = model

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        return self._model.dynamics(x, u, p, w)

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        return self._model.measurement(x, u, p)

    def rest(self) -> FloatArray:
        return self._model.rest()

    def impulse(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX, duration: float) -> ca.SX:
        return self._model.impulse(x, u, p, w, duration)


def _input_paths(model: Model) -> tuple[list[BufferedFunction], FloatArray]:
    """A function per substep: ``(memory, u, p) → what reaches the motors, memory``."""
    _, u, p, _ = model.symbols()
    memory = ca.SX.sym("m", len(model.memory(STEP)))
    functions = []
    for k in range(SUBSTEPS):
        window = (k / SUBSTEPS, (k + 1) / SUBSTEPS)
        outcome = list(model.input_path(memory, u, p, window, STEP))
        function = ca.Function(f"path_{k}", [memory, u, p], outcome)
        functions.append(BufferedFunction(function, compile=False))
    return functions, np.zeros(len(model.memory(STEP)))


def _inertias(model: Model) -> ca.Function:
    x, u, p, _ = model.symbols()
    known = model.quantities(x, u, p)
    values = ca.vertcat(*(known[inertia] for _, inertia in _OF_AXIS.values()))
    return ca.Function("inertias", [x, p], [ca.substitute(values, u, ca.SX.zeros(model.n_u))])
