"""Laws of another form: what each departure does to the moments on an axis."""

import casadi as ca
import numpy as np
import pytest

from tests.gap.recorded import effect
from trms_cli.effects.effect import Effect, EffectContext
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.model_form import _own_laws
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.models.tras import Tras

MODEL = Newtonian()
STATE = {"S_v": 0.03, "S_h": -0.02, "alpha_v": 0.3, "alpha_h": 0.8, "omega_v": 150.0}
COMMANDS = np.array([0.6, -0.4])
NONE = {"damping": 0.0, "thrust": 0.0, "spring": 0.0, "inertia": 0.0}


def at_the_state(model: Model, wanted) -> np.ndarray:
    """What a function of an effect's context gives at one state."""
    x, u, p, w = model.symbols()
    here = EffectContext(model, x, u, p, w, ca.SX.zeros(0), {})
    state = model.rest()
    for name, value in (STATE | {"omega_h": -90.0}).items():
        state[model.state_index(name)] = value
    f = ca.Function("f", [x, u, p, w], [ca.vertcat(*wanted(here))])
    return f(state, COMMANDS, model.parameters.values, np.zeros(model.n_w)).full().ravel()


def moments(effects: dict[str, Effect] | None = None) -> np.ndarray:
    """All moments on pitch and yaw, N m, each over the nominal model's mobility."""
    model = extend_model(MODEL, effects or {})
    acceleration = at_the_state(model, lambda at: [at.accelerations("pitch", "yaw")[0]])
    mobility = at_the_state(MODEL, lambda at: [ca.diag(at.accelerations("pitch", "yaw")[1])])
    return acceleration / mobility


def changed(axis: str, **sizes: float) -> float:
    """By how much a departure changes the moment on its axis, N m."""
    name = f"{axis}_model_form"
    row = ["pitch", "yaw"].index(axis)
    change = moments({name: effect(name, **(NONE | sizes))}) - moments()
    assert change[1 - row] == pytest.approx(0.0, abs=1e-12)
    return float(change[row])


@pytest.mark.parametrize("axis", ["pitch", "yaw"])
def test_each_departure_changes_its_own_axis_alone(axis):
    assert changed(axis) == 0.0
    for size in NONE:
        assert abs(changed(axis, **{size: 0.1})) > 1e-5


@pytest.mark.parametrize("axis", ["pitch", "yaw"])
def test_more_inertia_divides_all_moments(axis):
    plain = moments()[["pitch", "yaw"].index(axis)]
    assert plain + changed(axis, inertia=0.2) == pytest.approx(plain / 1.2, rel=1e-9)


@pytest.mark.parametrize(("axis", "rotor"), [("pitch", "main"), ("yaw", "tail")])
def test_another_exponent_of_thrust_is_that_of_the_thrust_curve(axis, rotor):
    curve = effect(f"{rotor}_thrust_curve", exponent=0.08, reverse=0.0)
    row = ["pitch", "yaw"].index(axis)
    wanted = (moments({"curve": curve}) - moments())[row]
    assert changed(axis, thrust=0.08) == pytest.approx(wanted, rel=1e-3)


def test_a_spring_that_hardens_and_damping_of_another_power():
    known = {p.name: p.value for p in MODEL.parameters}
    spring = -known["k_chp"] * 0.1 * STATE["alpha_h"] ** 3
    assert changed("yaw", spring=0.1) == pytest.approx(spring, rel=1e-9)
    (rate,) = at_the_state(MODEL, lambda at: [at.rate("yaw")])
    damping = -known["k_oh"] * rate * (abs(rate / 0.3) ** -0.15 - 1)
    assert changed("yaw", damping=-0.15) == pytest.approx(damping, rel=1e-3)


@pytest.mark.parametrize("model", [Newtonian(), Tras(), QuanserAero(), Lagrangian()])
def test_damping_is_what_the_model_has_with_the_beam_at_rest(model):
    """In motion the moment on yaw goes with the rate of pitch, too, which is no damping."""
    x, u, p, w = model.symbols()
    here = EffectContext(model, x, u, p, w, ca.SX.zeros(0), {})
    for axis in ("pitch", "yaw"):
        laws = ca.Function("laws", [x, u, p, w], list(_own_laws(here, axis))[1:])
        found = []
        for rate in (-0.5, 0.0, 0.5):
            state = model.rest()
            state[model.state_index("alpha_v")] = 0.3
            state[model.state_index("S_v")] = state[model.state_index("S_h")] = rate
            found.append(laws(state, np.zeros(model.n_u), model.parameters.values, np.zeros(4)))
        assert float(found[1][0]) < 0
        for one in found:
            assert np.array(one) == pytest.approx(np.array(found[1]), rel=1e-9, abs=1e-12)
