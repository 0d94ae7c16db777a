"""Coulomb friction of a rotor: the speed that is left, the stop, no creep."""

import numpy as np
import pytest

from trms_cli.effects.rotor_friction import RotorFriction


def friction(torque, rotor="tail"):
    return {"friction": RotorFriction(rotor=rotor, torque=torque)}


def held_torque(model, voltage):
    """Torque of the tail's motor at rest, N m."""
    c = {p.name: p.value for p in model.parameters}
    return c["kphi"] * c["k_uh"] * voltage / c["R"]


@pytest.mark.parametrize("currents", ["quasi_static", "dynamic"])
def test_a_rotor_stands_until_the_motor_is_stronger(rig, currents):
    base = rig.newtonian(currents=currents)
    row = base.state_index("omega_h")
    u = np.tile([0.0, 0.06], (300, 1))
    torque = held_torque(base, 0.06)
    held = rig.simulate(rig.extended(base, friction(torque * 1.01)), u)
    moved = rig.simulate(rig.extended(base, friction(torque * 0.9)), u)
    assert np.abs(held[:, row]).max() < 1e-9
    assert moved[-1, row] > 0.1


@pytest.mark.parametrize("direction", [1, -1])
def test_the_steady_speed_is_that_of_the_balance_of_torques(rig, direction):
    base = rig.newtonian()
    c = {p.name: p.value for p in base.parameters}
    voltage, torque = direction * 0.8, 0.001
    drag = c["k_thp"] if direction > 0 else c["k_thn"]
    # kφ (k_u u − kφ ω)/R − B ω − k ω² − F_c = 0
    linear = c["kphi"] ** 2 / c["R"] + c["B_tr"]
    speed = np.roots([drag, linear, torque - held_torque(base, abs(voltage))]).max()
    x = rig.simulate(rig.extended(base, friction(torque)), np.tile([0, voltage], (1500, 1)))
    assert x[-1, base.state_index("omega_h")] == pytest.approx(direction * speed, rel=1e-6)


@pytest.mark.parametrize("rotor", ["main", "tail"])
def test_it_stops_for_good_after_a_finite_time(rig, rotor):
    base = rig.newtonian()
    row = base.state_index({"main": "omega_v", "tail": "omega_h"}[rotor])
    start = base.rest()
    start[row] = 60.0
    x = rig.simulate(rig.extended(base, friction(0.002, rotor)), np.zeros((1000, 2)), start=start)[
        :, row
    ]
    assert np.all(np.diff(x) < 1e-12)
    stopped = int(np.argmax(x < 1e-9))
    assert 0 < stopped * 0.02 < 5.2  # without drag: J ω/F_c = 5.2 s for the main rotor
    assert np.abs(x[stopped + 1 :]).max() < 1e-12


def test_stiff_and_quasi_static_currents_agree(rig):
    u = rig.rich_input(300)
    names = ("omega_h", "alpha_h", "omega_v", "alpha_v")
    runs = []
    for currents in ("quasi_static", "dynamic"):
        base = rig.newtonian(currents=currents)
        model = rig.extended(base, friction(0.001) | {"main": friction(0.001, "main")["friction"]})
        x = rig.simulate(model, u, substeps=8)
        runs.append(x[:, [model.state_index(name) for name in names]])
    scale = np.abs(runs[0]).max(axis=0)
    assert (np.abs(runs[0] - runs[1]) / scale).max() < 5e-3


def test_a_zero_crossing_command_tells_it_from_a_dead_zone(rig):
    """A dead zone lets the rotor coast; friction goes on braking it."""
    base = rig.newtonian()
    row = base.state_index("omega_h")
    u = np.zeros((200, 2))
    u[:100, 1] = 0.8
    torque = 0.0012
    width = torque / held_torque(base, 1.0)
    rubbed = rig.simulate(rig.extended(base, friction(torque)), u)[:, row]
    dead = rig.simulate(rig.extended(base, {"d": rig.effect("tail_dead_zone", width=width)}), u)[
        :, row
    ]
    assert rubbed[100] == pytest.approx(dead[100], rel=1e-3)  # equal while the command stands
    assert rubbed[150] < 0.9 * dead[150]
