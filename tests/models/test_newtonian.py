"""The Newtonian model against the published check values and against physics."""

import numpy as np
import pytest

from trms_cli.core.errors import ConfigurationError
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.newtonian import Newtonian, geometry

from .simulate import rates, settle, simulate, slopes, square, travel

# Equilibria at constant command of the main rotor, besides those of the page of the model:
# u_v → ω_v [rad/s], α_v [rad].
EQUILIBRIA = {0.4: (86.7, -0.506), 0.8: (137.6, -0.330), 1.8: (227.1, 0.271)}


@pytest.mark.parametrize(("u_v", "expected"), EQUILIBRIA.items())
def test_equilibria_of_the_main_rotor(u_v, expected):
    found = settle(Newtonian(freedom="vertical"), [u_v])
    assert found["omega_v"] == pytest.approx(expected[0], abs=0.06)
    assert found["alpha_v"] == pytest.approx(expected[1], abs=6e-4)


def test_gravity_moment_has_the_published_size_and_phase():
    model = Newtonian()
    g = geometry({p.name: p.value for p in model.parameters})
    moment = model.parameters["g"].value * np.hypot(g["A"] - g["B"], g["C"])
    assert moment == pytest.approx(0.2646, abs=6e-5)
    assert np.arctan2(g["B"] - g["A"], g["C"]) == pytest.approx(0.6194, abs=6e-5)


def test_main_rotor_at_rest_decays_with_back_emf_and_bearing_alone():
    # model.md prints −0.328 here; the exact slope at ω = 0, where the drag has none, is
    # −(kφ²/R + B_mr)/J_mr = −0.3200.
    model = Newtonian(parameter_set="rahideh")
    found = np.linalg.eigvals(slopes(model, model.rest())[0])
    p = model.parameters
    exact = -(p["kphi"].value ** 2 / p["R"].value + p["B_mr"].value) / p["J_mr"].value
    assert np.abs(found - exact).min() < 1e-9
    assert exact == pytest.approx(-0.3200, abs=5e-5)


def test_thesis_gain_makes_pitch_unstable_above_the_published_angle():
    # The published value is that of the mean of the cable's two slopes.
    base = Newtonian(parameter_set="rahideh").parameters
    mean = (base["k_chp"].value + base["k_chn"].value) / 2
    model = Newtonian(parameter_set="rahideh", parameters={"k_chp": mean, "k_chn": mean})
    p = {parameter.name: parameter.value for parameter in model.parameters}
    g = geometry(p)
    # What holds α_v = 0.4: G sin(α_v + 0.6194) = l_m k_fvp ω_v², and the motor's balance.
    omega = np.sqrt(0.2646 * np.sin(0.4 + 0.6194) / (p["l_m"] * p["k_fvp"]))
    current = (p["B_mr"] * omega + p["k_tvp"] * omega**2) / p["kphi"]
    u_v = (p["R"] * current + p["kphi"] * omega) / p["k_uv"]
    # At rest Ω_h = S_h + k_m ω_v cos α_v / J_h = 0.
    inertia = g["D"] * np.cos(0.4) ** 2 + g["E"] * np.sin(0.4) ** 2 + g["F"]
    state = {"omega_v": omega, "alpha_v": 0.4, "S_h": -p["k_m"] * omega * np.cos(0.4) / inertia}
    x = np.array([state.get(name, 0.0) for name in model.state_names])
    pair = max(np.linalg.eigvals(slopes(model, x, [u_v, 0.0])[0]), key=lambda value: value.real)
    assert pair.real == pytest.approx(0.023, abs=2e-3)
    assert abs(pair.imag) == pytest.approx(1.270, abs=4e-3)


@pytest.mark.parametrize("kind", [Newtonian, Lagrangian])
def test_currents_as_states_hardly_matter(kind):
    # 4 s with steps on both inputs; the angles stay within 1e-4 rad.
    slow, fast = (
        simulate(kind(currents=c), square(1.6, 0.6), 4.0, 0.02, 8)
        for c in ("quasi_static", "dynamic")
    )
    for angle in ("alpha_v", "alpha_h"):
        assert 0 < np.abs(slow[angle] - fast[angle]).max() < 1e-4


def test_free_pitch_without_friction_conserves_energy():
    still = {"k_ov": 0.0, "k_t": 0.0}
    model = Newtonian(freedom="vertical", parameters=still)
    g = geometry({p.name: p.value for p in model.parameters})
    gravity = model.parameters["g"].value

    def energy(x: np.ndarray) -> float:
        state = dict(zip(model.state_names, x, strict=True))
        kinetic = 0.5 * g["J_v"] * state["S_v"] ** 2
        sine, cosine = np.sin(state["alpha_v"]), np.cos(state["alpha_v"])
        return kinetic - gravity * ((g["A"] - g["B"]) * sine + g["C"] * cosine)

    start = model.rest()
    start[model.state_index("alpha_v")] = 0.4
    end = travel(model, start, [0.0], 20.0, 0.02, 4)[-1]
    assert energy(end) == pytest.approx(energy(start), rel=1e-8)


#: No rotor turns the beam; with the beam on the axis no acceleration of one axis turns the other.
APART = {"k_m": 0.0, "k_t": 0.0}


@pytest.mark.parametrize("freedom", ["vertical", "horizontal"])
@pytest.mark.parametrize(
    ("kind", "changed"), [(Newtonian, APART), (Lagrangian, APART | {"h": 0.0})]
)
def test_one_axis_is_the_whole_model_with_the_other_locked(kind, changed, freedom):
    one, both = kind(freedom=freedom, parameters=changed), kind(parameters=changed)
    x = dict(zip(one.state_names, (60.0, 0.3, -0.2), strict=True))
    full = [x.get(name, 0.0) for name in both.state_names]
    command = [1.0, 0.0] if freedom == "vertical" else [0.0, 1.0]
    whole = dict(zip(both.state_names, rates(both, full, command), strict=True))
    expected = [whole[name] for name in one.state_names]
    assert rates(one, list(x.values()), [1.0]) == pytest.approx(expected, rel=1e-9)


def test_unknown_parameters_and_sets_are_told_with_those_there_are():
    with pytest.raises(ConfigurationError, match="k_fpv") as raised:
        Newtonian(parameters={"k_fpv": 1e-5})
    assert "k_fvp" in raised.value.remedy
    with pytest.raises(ConfigurationError) as raised:
        Newtonian(parameter_set="bensch")
    assert "bench" in raised.value.remedy


def test_draws_from_the_priors_repeat_and_keep_known_constants():
    parameters = Newtonian().parameters
    once, again, other = parameters.draw(7), parameters.draw(7), parameters.draw(8)
    assert np.array_equal(once.values, again.values)
    assert not np.array_equal(once.values, other.values)
    assert once["g"].value == parameters["g"].value
    relative = np.array(
        [parameters.draw(seed)["k_fvp"].value / parameters["k_fvp"].value for seed in range(400)]
    )
    assert relative.std() == pytest.approx(0.06, rel=0.15)
