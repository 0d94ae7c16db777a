"""Rotors alone: the motor's equations, its curves, its step response in closed form."""

import casadi as ca
import numpy as np
import pytest

from trms_cli.models.newtonian import Newtonian
from trms_cli.models.single_rotor import SingleRotor
from trms_cli.models.steady_state import SteadyState

from .simulate import simulate


@pytest.mark.parametrize(("rotor", "axis"), [("main", "v"), ("tail", "h")])
@pytest.mark.parametrize("currents", ["quasi_static", "dynamic"])
def test_it_turns_as_on_the_rig(rotor, axis, currents):
    # No motion of the beam acts back on a rotor.
    alone = simulate(SingleRotor(rotor=rotor, currents=currents), lambda t: [1.3], 3.0, 0.02, 4)
    rig = simulate(Newtonian(currents=currents), lambda t: [1.3, 1.3], 3.0, 0.02, 4)
    assert alone[f"omega_{axis}"] == pytest.approx(rig[f"omega_{axis}"], rel=1e-9)


@pytest.mark.parametrize("command", [1.5, -1.5])
def test_a_step_follows_the_closed_form(command):
    # J ω̇ = a u − b ω − k ω² from rest: ω = ω_∞ tanh-like, by the roots of the quadratic.
    model = SingleRotor(rotor="main")
    p = {q.name: q.value for q in model.parameters}
    sign, k = np.sign(command), p["k_tvp"] if command > 0 else p["k_tvn"]
    a = p["kphi"] * p["k_uv"] / p["R"] * abs(command)
    b = p["kphi"] ** 2 / p["R"] + p["B_mr"]
    root = np.sqrt(b * b + 4 * a * k)
    top, bottom = (root - b) / (2 * k), (-root - b) / (2 * k)
    t = np.arange(401) * 0.01
    share = np.exp(-root / p["J_mr"] * t)
    omega = top * bottom * (share - 1) / (top * share - bottom)
    found = simulate(model, lambda t: [command], 4.0)["omega_v"]
    assert found == pytest.approx(sign * omega, abs=1e-5)


def test_thrust_is_measured_on_request():
    cell = SingleRotor(rotor="tail", load_cell=True)
    assert [s.name for s in cell.outputs] == ["omega_h", "thrust_h"]
    x, u, p, _ = cell.symbols()
    y = ca.Function("y", [x, u, p], [cell.measurement(x, u, p)])
    c = {q.name: q.value for q in cell.parameters}
    for omega, k in ((300.0, c["k_fhp"]), (-300.0, c["k_fhn"])):
        found = np.array(y(omega, 0.0, cell.parameters.values)).ravel()
        assert found == pytest.approx([omega, k * omega * abs(omega)])


def test_a_speed_is_held_by_its_command():
    target = SteadyState(SingleRotor(rotor="main")).solve(np.array([196.3]))
    assert target.converged and not target.projected
    assert target.u[0] == pytest.approx(1.413, abs=1e-3)
    beyond = SteadyState(SingleRotor(rotor="main")).solve(np.array([900.0]))
    assert beyond.projected and beyond.u[0] == pytest.approx(2.5)
