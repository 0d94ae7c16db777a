"""A rig simple enough for closed forms, simulation by compiled steps, the library as shipped."""

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
import yaml
from scipy.integrate import solve_ivp

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.effects.extended_model import extend_model
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model, RigAxis, RigRotor, Signal
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.parameters import Parameter, ParameterSet

#: Sizes that are zero when the effect is absent, where it is not its first alone; the others are
#: shapes.
SIZES = {
    "cable_stiffness": ["stiffness", "cubic"],
    "thrust_curve": ["exponent", "reverse"],
    "rotor_reaction": ["drag", "inertia"],
}
NAMES = sorted(path.stem for path in (config_folder() / "effect").glob("*.yaml"))


class Turntable(Model):
    """Independent axes driven by torques: ``J α̈ = u − b α̇ + w`` for pitch and yaw alike."""

    def __init__(self, *, inertia: float = 0.05, damping: float = 0.0) -> None:
        self.name = "turntable"
        self.states = tuple(
            Signal(name, unit)
            for axis in "vh"
            for name, unit in ((f"alpha_{axis}", "rad"), (f"rate_{axis}", "rad/s"))
        )
        self.inputs = (Signal("u_v", "N*m"), Signal("u_h", "N*m"))
        self.outputs = (self.states[0], self.states[2])
        self.disturbances = (Signal("pitch_moment", "N*m"), Signal("yaw_moment", "N*m"))
        self.parameters = ParameterSet(
            [Parameter("J", inertia, "kg*m^2"), Parameter("b", damping, "N*m*s")]
        )
        self.controlled = ("alpha_v", "alpha_h")
        self.input_limits = {"u_v": 2.5, "u_h": 2.5}
        self.stops = {}
        self.axes = {
            "pitch": RigAxis("alpha_v", "pitch_moment"),
            "yaw": RigAxis("alpha_h", "yaw_moment"),
        }
        self.rotors = {"main": RigRotor("u_v", axis="pitch"), "tail": RigRotor("u_h", axis="yaw")}

    def dynamics(self, x, u, p, w):
        return ca.vertcat(
            x[1], (u[0] - p[1] * x[1] + w[0]) / p[0], x[3], (u[1] - p[1] * x[3] + w[1]) / p[0]
        )

    def measurement(self, x, u, p):
        return ca.vertcat(x[0], x[2])


def _node(name: str) -> dict:
    text = (config_folder() / "effect" / f"{name}.yaml").read_text(encoding="utf-8")
    return yaml.safe_load(text)[name]


def _effect(name: str, **sizes):
    return build(_node(name) | sizes, name)


def _kind(name: str) -> str:
    """What an effect is, as its section and figure are called: without its axis or rotor."""
    if "_reaction_on_" in name:
        return "rotor_reaction"
    part, rest = name.split("_", 1)
    return rest if part in ("pitch", "yaw", "main", "tail") else name


def _absent(name: str):
    first = _effect(name).parameters()[0].name
    return _effect(name, **dict.fromkeys(SIZES.get(_kind(name), [first]), 0.0))


def _simulate(model, inputs, step=0.02, substeps=4, start=None, w=None, compile=False):
    """States (n + 1, n_x), memory included, under inputs (n, n_u) held over each step.

    By CasADi's virtual machine, as a compiler would take longer than the steps do.
    """
    inputs = np.asarray(inputs, dtype=float)
    discrete = discretise(model, step, substeps, sensors=True)
    function = BufferedFunction(discrete.step, compile=compile)
    p = model.parameters.values
    w = np.zeros(model.n_w) if w is None else w
    x = np.zeros((len(inputs) + 1, discrete.n_x))
    x[0, : model.n_x] = model.rest()
    if start is not None:
        x[0, : len(start)] = start
    for k, u in enumerate(inputs):
        x[k + 1] = function.evaluate(x[k], u, p, w)[0]
    return x


def _readings(model, states, inputs, step=0.02):
    """What the sensors read at each of the states of :func:`_simulate`, (n + 1, n_y)."""
    function = discretise(model, step, 1, sensors=True).measurement
    u = np.vstack([np.asarray(inputs, dtype=float), inputs[-1]])
    p = model.parameters.values
    return np.asarray(function(np.asarray(states).T, u.T, p)).T


def _rich_input(samples: int) -> np.ndarray:
    """Slow sines, steps and noise over the whole range, both signs, both rotors."""
    t = np.arange(samples) * 0.02
    noise = np.random.default_rng(1).normal(size=(samples, 2))
    u_v = 1.2 * np.sin(0.7 * t) + 0.8 * np.sign(np.sin(2.1 * t)) + 0.3 * noise[:, 0]
    u_h = np.sin(1.3 * t) + 0.5 * noise[:, 1]
    return np.column_stack([u_v, u_h]).clip(-2.5, 2.5)


def _exactly(slope, start, samples, event=None):
    """Another code's solution of y' = slope(t, y) at each sample, (samples + 1, n).

    With ``event``, a function of (t, y): the time and the state at which it is zero instead.
    """
    seconds = samples * 0.02
    if event is not None:
        event.terminal = True
    times = None if event is not None else np.arange(samples + 1) * 0.02
    found = solve_ivp(
        slope, (0, seconds), start, t_eval=times, events=event, rtol=1e-10, atol=1e-12
    )
    return found.y.T if event is None else (found.t_events[0][0], found.y[:, -1])


def _right_hand_side(model):
    """``f(x, u, w)`` in NumPy."""
    at = model.symbols()
    function = ca.Function("f", list(at), [model.dynamics(*at)])
    p = model.parameters.values
    return lambda x, u, w: np.asarray(function(x, u, p, w)).ravel()


def _accelerations(model):
    """``(x, u, w)`` → those of pitch and yaw, rad/s², without torques where none are given."""
    at = model.symbols()
    f = model.dynamics(*at)
    rates = f[[model.state_index("alpha_v"), model.state_index("alpha_h")]]
    function = ca.Function("a", list(at), [ca.jtimes(rates, at[0], f)])
    p, still = model.parameters.values, np.zeros(model.n_w)
    return lambda x, u, w=still: np.asarray(function(x, u, p, w)).ravel()


def _quantities(model, x):
    """What a model names at a state without commands, by name."""
    at = model.symbols()[:3]
    known = model.quantities(*at)
    values = ca.Function("q", list(at), list(known.values()))(
        x, np.zeros(model.n_u), model.parameters.values
    )
    return {name: float(value) for name, value in zip(known, values, strict=True)}


@pytest.fixture(scope="session")
def rig() -> SimpleNamespace:
    return SimpleNamespace(
        names=NAMES,
        node=_node,
        effect=_effect,
        absent=_absent,
        kind=_kind,
        simulate=_simulate,
        readings=_readings,
        rich_input=_rich_input,
        exactly=_exactly,
        right_hand_side=_right_hand_side,
        accelerations=_accelerations,
        quantities=_quantities,
        turntable=Turntable,
        newtonian=Newtonian,
        extended=extend_model,
    )


def pytest_generate_tests(metafunc) -> None:
    if "effect_name" in metafunc.fixturenames:
        metafunc.parametrize("effect_name", NAMES)
