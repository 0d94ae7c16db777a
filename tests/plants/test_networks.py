"""A network in the place of the rig: where it starts, where it stops, what it refuses."""

import numpy as np
import pytest

from tests.models.network_case import rig_like
from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.discretisation import discretise
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.sensors import Sensors
from trms_cli.plants.simulated import SimulatedRig


@pytest.fixture(autouse=True)
def interpreted(monkeypatch):
    """Without the C compiler: a network is evaluated a few hundred times here."""
    monkeypatch.setattr("trms_cli.core.compilation.compiler", lambda: None)


def started(**settings):
    model = settings.pop("model", None) or rig_like((1, 3), (1, 2))
    sensors = Sensors(noise_sd={}, quantum={})
    return SimulatedRig(model=model, sensors=sensors, **settings).init(PlantSetup(0.02, 500, 0))


def test_runs_as_its_own_steps():
    run, model = started(), rig_like((1, 3), (1, 2))
    step = discretise(model, 0.02).step
    x = model.rest()
    for k in range(50):
        np.testing.assert_allclose(run.state, x, rtol=1e-12, atol=1e-12)
        u = np.array([np.sin(0.2 * k), 0.5])
        x = np.array(step(x, u, [], np.zeros(4)))[:, 0]
        run.advance(u)


def test_starts_where_it_is_put_at_rest_or_in_motion():
    run = started(initial={"alpha_v": 0.3}, first_command={"u_v": 0.7})
    state = dict(zip((s.name for s in run.states), run.state, strict=True))
    assert state["alpha_v"] == state["alpha_v_lag1"] == state["alpha_v_lag2"] == 0.3
    assert state["u_v_lag1"] == 0.7
    run = started(initial={"alpha_v": 0.3, "alpha_v_lag1": 0.2})
    state = dict(zip((s.name for s in run.states), run.state, strict=True))
    assert (state["alpha_v"], state["alpha_v_lag1"]) == (0.3, 0.2)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_is_held_by_the_stops_and_leaves_them(side):
    run = started()
    angles = []
    for k in range(500):
        run.advance(np.array([side * (2.5 if k < 300 else -2.5), 0.0]))
        angles.append(run.state[0] * side)
    assert max(angles) == 1.05
    assert angles[299] == 1.05
    assert angles[-1] < 0.9
    free = started(mechanical_stops=False)
    for _ in range(300):
        free.advance(np.array([side * 2.5, 0.0]))
    assert free.state[0] * side > 1.2


def test_has_no_rate_at_a_stop():
    """What it remembers of the angle is at the stop too: it does not go on by what it was."""
    run = started(model=rig_like(bend=0.0))
    for _ in range(300):
        run.advance(np.array([2.5, 0.0]))
    names = [s.name for s in run.states]
    assert run.state[names.index("alpha_v_lag1")] == run.state[0] == 1.05
    run.advance(np.array([-2.5, 0.0]))
    assert 0 <= 1.05 - run.state[0] < 1e-3


def test_takes_a_delay_of_its_command():
    late = started(effects={"late": InputDelay(rotor="main", delay=0.1)})
    for _ in range(5):
        late.advance(np.array([2.0, 0.0]))
        assert late.state[0] == pytest.approx(rig_like((1, 3), (1, 2)).rest()[0], abs=1e-9)
    for _ in range(20):
        late.advance(np.array([2.0, 0.0]))
    assert late.state[0] > rig_like((1, 3), (1, 2)).rest()[0] + 0.01


def test_refuses_friction_a_draw_from_priors_and_another_sample_time():
    with pytest.raises(ModelError, match=r"model@plant\.model=newtonian"):
        started(effects={"rub": CoulombFriction(axis="yaw", torque=0.01)})
    with pytest.raises(ConfigurationError) as error:
        started(prior_seed=3)
    assert error.value.where == "prior_seed"
    with pytest.raises(ModelError, match=r"sim\.sample_time"):
        SimulatedRig(model=rig_like()).init(PlantSetup(0.05, 10, 0))
