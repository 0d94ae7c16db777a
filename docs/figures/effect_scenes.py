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
from trms_cli.effects.extended_model import extend_model
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian

FloatArray = npt.NDArray[np.float64]

STEP = 0.02  # s
SUBSTEPS = 4
#: Momentum state and disturbance of an axis by its angle, of a rotor by its speed.
_OF_PART = {
    "alpha_v": ("S_v", "pitch_moment"),
    "alpha_h": ("S_h", "yaw_moment"),
    "omega_v": ("omega_v", "main_motor"),
    "omega_h": ("omega_h", "tail_motor"),
}
_SEED = 1


@dataclass(frozen=True, kw_only=True)
class Run:
    """One simulation: times (n + 1,), states by name, commands (n, 2) and what the motors got."""

    #: ``time``, ``command``, ``arriving``: s; V, held over each step; V, mean of each substep
    time: FloatArray
    command: FloatArray
    arriving: FloatArray
    states: dict[str, FloatArray]
    #: Torque that the effect added, by the axis' angle or the rotor's speed, mean of each substep,
    #: N m
    torque: dict[str, FloatArray]
    readings: dict[str, FloatArray]  #: What the sensors showed at each time, by output
    quantities: dict[str, FloatArray]  #: Physical quantities of the nominal model at each time


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A simulation that shows an effect."""

    effect: str  #: Canonical name; the option's own sizes unless ``sizes`` has others
    command: Callable[[FloatArray], FloatArray]  #: Times (n,) to commands (n, 2), V
    duration: float  #: s
    sizes: dict[str, float] = field(default_factory=dict)
    start: dict[str, float] = field(default_factory=dict)  #: States that do not begin at rest


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
    model = extend_model(base, effects)
    time: FloatArray = STEP * np.arange(round(scene.duration / STEP) + 1, dtype=np.float64)
    command = scene.command(time[:-1])
    # Each substep is a step of its own here, so that torque and arriving command can be seen.
    paths, memory = _input_paths(model)
    small = STEP / SUBSTEPS
    forward = BufferedFunction(discretise(_WithoutPath(model), small).step)
    beneath = BufferedFunction(discretise(base, small).step)
    mobility = BufferedFunction(_mobility(base), compile=False)
    noise = _noise(model, len(command))
    x = model.rest()
    for name, value in scene.start.items():
        x[model.state_index(name)] = value
    p, w = model.parameters.values, np.zeros(model.n_w)
    states, arriving = [x.copy()], []
    start = x.copy()
    torque: dict[str, list[float]] = {part: [] for part in _OF_PART}
    for u, pushed in zip(command, noise, strict=True):
        for path in paths:
            reached, memory = (np.array(v) for v in path.evaluate(memory, u, p))
            free = beneath.evaluate(x[: base.n_x], reached, p[: len(base.parameters)], w)[0].copy()
            x = forward.evaluate(x, reached, p, w)[0].copy()
            arriving.append(reached)
            moved = mobility.evaluate(x[: base.n_x], p[: len(base.parameters)])[0]
            for value, (part, (momentum, _)) in zip(moved, _OF_PART.items(), strict=True):
                row = base.state_index(momentum)
                torque[part].append(float((x[row] - free[row]) / small / value))
        x = x + pushed
        states.append(x.copy())
    return Run(
        time=time,
        command=command,
        arriving=np.array(arriving),
        states=dict(zip(model.state_names, np.array(states).T, strict=True)),
        torque={part: np.array(values) for part, values in torque.items()},
        readings=_readings(model, start, command, noise),
        quantities=_quantities(base, np.array(states)[:, : base.n_x]),
    )


def _noise(model: Model, samples: int) -> FloatArray:
    """What noise adds to the states in each step, (samples, n_x)."""
    p = ca.SX.sym("p", len(model.parameters))
    added = ca.Function("added", [p], [ca.densify(model.noise_sd(p, STEP))])
    sd = np.asarray(added(model.parameters.values)).ravel()
    return sd * np.random.default_rng(_SEED).standard_normal((samples, model.n_x))


def _readings(
    model: Model, start: FloatArray, command: FloatArray, noise: FloatArray
) -> dict[str, FloatArray]:
    """The same run once more, in whole steps, with what the sensors remember."""
    discrete = discretise(model, STEP, SUBSTEPS, sensors=True)
    step, sense = BufferedFunction(discrete.step), BufferedFunction(discrete.measurement)
    x = discrete.initial(start, command[0])
    p, w = model.parameters.values, np.zeros(model.n_w)
    shown = [sense.evaluate(x, command[0], p)[0].copy()]
    for u, pushed in zip(command, noise, strict=True):
        x = step.evaluate(x, u, p, w)[0].copy()
        x[: model.n_x] += pushed
        shown.append(sense.evaluate(x, u, p)[0].copy())
    return dict(zip((s.name for s in model.outputs), np.array(shown).T, strict=True))


def _quantities(model: Model, states: FloatArray) -> dict[str, FloatArray]:
    x, u, p, _ = model.symbols()
    known = model.quantities(x, u, p)
    wanted = {name: known[name] for name in ("thrust_main", "thrust_tail", "arm_main", "arm_tail")}
    function = ca.Function("quantities", [x, u, p], [ca.vertcat(*wanted.values())])
    values = function(states.T, np.zeros((model.n_u, len(states))), model.parameters.values)
    return dict(zip(wanted, np.asarray(values), strict=True))


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


def _mobility(model: Model) -> ca.Function:
    """Acceleration of the momentum of each part by one N m on it."""
    x, u, p, w = model.symbols()
    slope = ca.jacobian(model.dynamics(x, u, p, w), w)
    columns = [signal.name for signal in model.disturbances]
    values = ca.vertcat(
        *(
            slope[model.state_index(momentum), columns.index(disturbance)]
            for momentum, disturbance in _OF_PART.values()
        )
    )
    zero = ca.SX.zeros(model.n_u + model.n_w)
    return ca.Function("mobility", [x, p], [ca.substitute(values, ca.vertcat(u, w), zero)])
