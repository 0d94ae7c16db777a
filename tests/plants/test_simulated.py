"""The simulated rig: its own parameters, sensors, disturbances and stops."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from trms_cli.core.errors import ConfigurationError, SimulationError
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.discretisation import discretise
from trms_cli.models.newtonian import Newtonian, geometry
from trms_cli.plants.disturbance import ScheduledDisturbance
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.sensors import Sensors
from trms_cli.plants.simulated import SimulatedRig
from trms_cli.references.step import Step

SETUP = PlantSetup(sample_time=0.02, samples=1000, seed=1)


def run(command: list[float], setup: PlantSetup = SETUP, **rig: Any) -> dict[str, Any]:
    """States and measurements of a run at a constant command."""
    plant = SimulatedRig(**({"model": Newtonian()} | rig)).init(setup)
    u, states, measured = np.array(command), [], []
    for _ in range(setup.samples):
        measured.append(plant.measure())
        states.append(plant.state.copy())
        plant.advance(u)
    x = np.array(states)
    return {
        "plant": plant,
        "y": np.array(measured),
        **{signal.name: x[:, i] for i, signal in enumerate(plant.states)},
    }


def test_perfect_sensors_show_the_state_and_its_integration_has_converged() -> None:
    coarse = run([1.9, 0.8])
    assert np.array_equal(coarse["y"][:, 0], coarse["alpha_v"])
    assert np.array_equal(coarse["y"][:, 3], coarse["omega_h"])
    fine = run([1.9, 0.8], integration_step=0.0005)
    assert coarse["alpha_v"] == pytest.approx(fine["alpha_v"], abs=1e-7)
    assert coarse["alpha_h"] == pytest.approx(fine["alpha_h"], abs=1e-7)


def test_noise_and_quanta_are_as_declared() -> None:
    sensors = Sensors(noise_sd={"omega_v": 2.0}, quantum={"alpha_v": 0.01})
    ran = run([1.2, 0.0], sensors=sensors)
    noise = ran["y"][:, 2] - ran["omega_v"]
    assert noise.std() == pytest.approx(2.0, rel=0.1)
    assert np.abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 0.12
    assert np.abs(ran["y"][:, 0] - ran["alpha_v"]).max() <= 0.005 + 1e-12
    assert np.abs(ran["y"][:, 0] / 0.01 - np.round(ran["y"][:, 0] / 0.01)).max() < 1e-9
    assert np.array_equal(ran["y"][:, 1], ran["alpha_h"])
    assert ran["plant"].noise_sd["alpha_v"] == pytest.approx(0.01 / 12**0.5)


def test_seed_decides_the_noise_and_nothing_else_does() -> None:
    sensors = Sensors(noise_sd={"omega_v": 1.0})
    once, again, other = (
        run([1.0, 0.0], replace(SETUP, seed=seed), sensors=sensors) for seed in (1, 1, 2)
    )
    assert np.array_equal(once["y"], again["y"])
    assert not np.array_equal(once["y"], other["y"])
    assert np.array_equal(once["alpha_v"], other["alpha_v"])


def test_lost_samples_are_missing_as_a_whole_and_channels_that_are_not_chosen() -> None:
    lost = np.isnan(run([1.0, 0.0], sensors=Sensors(loss_probability=0.2))["y"])
    assert lost.all(axis=1).mean() == pytest.approx(0.2, abs=0.05)
    assert np.array_equal(lost.any(axis=1), lost.all(axis=1))
    ran = run([1.5, 0.5], sensors=Sensors(channels=("alpha_h", "alpha_v")))
    assert np.array_equal(ran["y"], np.column_stack([ran["alpha_h"], ran["alpha_v"]]))


def test_true_parameters_are_the_rigs_own() -> None:
    model = Newtonian()
    weaker = run([1.4, 0.0], parameters={"k_fvp": 1.2e-5})
    nominal = run([1.4, 0.0], model=model)
    assert weaker["alpha_v"][-1] < nominal["alpha_v"][-1] - 0.1
    assert model.parameters["k_fvp"].value == 1.62e-5


def test_draw_from_the_priors_repeats_and_yields_to_given_values() -> None:
    rig = SimulatedRig(model=Newtonian(), prior_seed=4, parameters={"k_g": 0.05})
    values = rig.init(SETUP).parameters
    again = rig.init(SETUP).parameters
    assert np.array_equal(values.values, again.values)
    assert values["k_g"].value == 0.05
    assert values["k_fvp"].value != 1.62e-5
    assert values["g"].value == 9.81


def test_effects_and_stops_are_parameters_too() -> None:
    free = run(
        [1.0, 0.6],
        effects={"yaw_coulomb_friction": CoulombFriction(axis="yaw", torque=0.01)},
        parameters={"yaw_coulomb_friction.torque": 0.0},
    )
    assert np.array_equal(free["alpha_h"], run([1.0, 0.6])["alpha_h"])


def test_mechanical_stop_ends_the_travel_without_rebound_and_lets_go() -> None:
    model, start = Newtonian(freedom="horizontal"), {"alpha_h": 2.7, "S_h": 1.5}
    plant = SimulatedRig(model=model, initial=start).init(SETUP)
    angles = []
    for k in range(900):
        angles.append(float(plant.state[2]))
        plant.advance(np.array([2.5 if k < 300 else -2.5]))
    assert max(angles) <= model.stops["alpha_h"]
    assert angles[200] == model.stops["alpha_h"]
    assert np.ptp(angles[50:300]) < 1e-9
    assert angles[-1] < 1.0
    free = run([2.5], model=model, initial=start, mechanical_stops=False)
    assert free["alpha_h"].max() > 3.0


def test_external_torque_acts_on_its_equation_from_its_time_on() -> None:
    push = ScheduledDisturbance(
        equation="yaw_moment", torque=Step(amplitude=0.01, start=5.0), known=True
    )
    pushed = run([1.4, 0.0], disturbances={"push": push})
    free = run([1.4, 0.0])
    assert np.array_equal(pushed["alpha_h"][:251], free["alpha_h"][:251])
    # One sample after the push nothing but the torque has acted on the difference.
    g = geometry({p.name: p.value for p in Newtonian().parameters})
    pitch = free["alpha_v"][250]
    inertia = g["D"] * np.cos(pitch) ** 2 + g["E"] * np.sin(pitch) ** 2 + g["F"]
    gained = (pushed["S_h"] - free["S_h"])[251]
    assert gained == pytest.approx(0.01 * 0.02 / inertia, rel=0.01)
    known = pushed["plant"].known_disturbances["yaw_moment"]
    assert known[249] == 0.0 and known[250] == 0.01
    assert np.abs(pushed["alpha_v"] - free["alpha_v"]).max() < 0.02


def test_commands_before_time_zero_fill_the_memory() -> None:
    rig = SimulatedRig(
        model=Newtonian(),
        effects={"delay": InputDelay(rotor="main", delay=0.1)},
        first_command={"u_v": 1.4},
    )
    plant = rig.init(SETUP)
    before = plant.state[3]
    plant.advance(np.array([0.0, 0.0]))
    # The earlier 1.4 V still arrive: J_mr ω̇ = kφ k_uv u / R from rest.
    p = {parameter.name: parameter.value for parameter in rig.model.parameters}
    gained = p["kphi"] * p["k_uv"] * 1.4 / p["R"] / p["J_mr"] * 0.02
    assert plant.state[3] - before == pytest.approx(gained, rel=0.02)


def test_eight_state_rig_agrees_with_the_six_state_one() -> None:
    full = run([1.7, 0.5], model=Newtonian(currents="dynamic"))
    plain = run([1.7, 0.5])
    assert full["alpha_v"] == pytest.approx(plain["alpha_v"], abs=2e-4)
    assert full["alpha_h"] == pytest.approx(plain["alpha_h"], abs=2e-4)


def test_a_state_that_is_not_finite_stops_the_run() -> None:
    with pytest.raises(SimulationError, match="no longer finite"):
        run([0.0, 0.0], initial={"omega_v": 1e200}, mechanical_stops=False)


@pytest.mark.parametrize(
    ("arguments", "where", "remedy"),
    [
        ({"parameters": {"k_fpv": 1.0}}, "parameters.k_fpv", "k_fvp"),
        ({"initial": {"alpha_x": 1.0}}, "initial.alpha_x", "alpha_v"),
        ({"initial": {"alpha_h": 3.5}}, "initial.alpha_h", "stops"),
        ({"parameters": {"J_tr": -1.0}}, "parameters.J_tr", "at least 1e-09"),
        ({"parameters": {"k_ov": -1.0}}, "parameters.k_ov", "at least 0"),
        ({"first_command": {"u": 1.0}}, "first_command.u", "u_v"),
        ({"sensors": Sensors(channels=("alpha",))}, "sensors.channels", "alpha_v"),
        ({"sensors": Sensors(channels=())}, "sensors.channels", "alpha_v"),
        (
            {"disturbances": {"a": ScheduledDisturbance(equation="yaw", torque=Step(amplitude=1))}},
            "disturbances.a.equation",
            "yaw_moment",
        ),
    ],
)
def test_mistakes_are_reported_by_key(arguments: dict[str, Any], where: str, remedy: str) -> None:
    with pytest.raises(ConfigurationError) as raised:
        SimulatedRig(model=Newtonian(), **arguments).init(SETUP)
    assert where in raised.value.where
    assert remedy in raised.value.remedy


def test_one_step_equals_the_models_own() -> None:
    model = Newtonian()
    plant = SimulatedRig(model=model).init(SETUP)
    plant.advance(np.array([1.0, 0.5]))
    step = discretise(model, 0.02, 4).step
    expected = step(model.rest(), [1.0, 0.5], model.parameters.values, np.zeros(4))
    assert plant.state == pytest.approx(np.array(expected).ravel(), rel=1e-12)
