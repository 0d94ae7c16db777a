"""The Newtonian model against the published check values and against physics."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian, geometry

# Equilibria at constant command of the main rotor: u_v → ω_v [rad/s], α_v [rad].
EQUILIBRIA = {
    -1.0: (-165.4, -0.898),
    -0.5: (-104.8, -0.730),
    0.2: (52.5, -0.578),
    0.4: (86.7, -0.506),
    0.6: (114.1, -0.422),
    0.8: (137.6, -0.330),
    1.0: (158.5, -0.231),
    1.2: (177.6, -0.124),
    1.6: (211.6, 0.121),
    1.8: (227.1, 0.271),
    2.0: (241.8, 0.458),
}
# Yaw at α_v = 0: u_h → α_h [rad].
YAW = {0.2: 0.10, 0.5: 0.50, 1.0: 1.56, -0.5: -0.85}


def settle(model: Model, command: list[float], seconds: float = 250.0) -> dict[str, float]:
    """State after a long time at a constant command."""
    step = BufferedFunction(discretise(model, 0.05, 10).step)
    x = model.rest()
    for _ in range(round(seconds / 0.05)):
        x = step.evaluate(x, command, model.parameters.values, np.zeros(model.n_w))[0].copy()
    return dict(zip(model.state_names, x.tolist(), strict=True))


def slopes(model: Model, x: np.ndarray, u: list[float]) -> np.ndarray:
    """∂f/∂x at a point."""
    at = model.symbols()
    jacobian = ca.Function("jacobian", list(at), [ca.jacobian(model.dynamics(*at), at[0])])
    return np.array(jacobian(x, u, model.parameters.values, np.zeros(model.n_w)))


@pytest.mark.parametrize(("u_v", "expected"), EQUILIBRIA.items())
def test_equilibria_of_the_main_rotor(u_v: float, expected: tuple[float, float]) -> None:
    found = settle(Newtonian(freedom="vertical"), [u_v])
    assert found["omega_v"] == pytest.approx(expected[0], abs=0.06)
    assert found["alpha_v"] == pytest.approx(expected[1], abs=6e-4)


@pytest.mark.parametrize(("u_h", "expected"), YAW.items())
def test_equilibria_of_yaw_with_the_beam_level(u_h: float, expected: float) -> None:
    found = settle(Newtonian(freedom="horizontal"), [u_h])
    assert found["alpha_h"] == pytest.approx(expected, abs=6e-3)


def test_pitch_at_rest_and_hover() -> None:
    assert settle(Newtonian(), [0.0, 0.0])["alpha_v"] == pytest.approx(-0.619, abs=6e-4)
    hover = settle(Newtonian(currents="dynamic"), [1.413, 0.0])
    assert hover["alpha_v"] == pytest.approx(0.0, abs=5e-4)
    assert hover["omega_v"] == pytest.approx(196.3, abs=0.06)
    assert hover["i_v"] == pytest.approx(1.01, abs=0.006)
    thrust = Newtonian().parameters["k_fvp"].value * hover["omega_v"] ** 2
    assert thrust == pytest.approx(0.624, abs=6e-4)


def test_gravity_moment_has_the_published_size_and_phase() -> None:
    model = Newtonian()
    g = geometry({p.name: p.value for p in model.parameters})
    moment = model.parameters["g"].value * np.hypot(g["A"] - g["B"], g["C"])
    assert moment == pytest.approx(0.2646, abs=6e-5)
    assert np.arctan2(g["B"] - g["A"], g["C"]) == pytest.approx(0.6194, abs=6e-5)


def test_there_is_no_pitch_equilibrium_above_the_fold() -> None:
    # The largest moment of gravity is G = 0.2646 N m; beyond 2.23 V the thrust's is larger.
    model = Newtonian(freedom="vertical")
    arm, thrust = model.parameters["l_m"].value, model.parameters["k_fvp"].value

    def moment(u_v: float) -> float:
        return arm * thrust * settle(model, [u_v], 60.0)["omega_v"] ** 2

    assert moment(2.22) < 0.2646 < moment(2.24)


# The published values are for yaw 0, where the stiffness of the cable has a kink: they belong to
# the mean of its two slopes.
RAHIDEH = {
    "rest": (0.0, [-1.687, -0.208 + 0.509j, -0.047 + 2.028j]),
    "hover": (1.413, [-1.687, -1.471, -0.151 + 0.444j, -0.047 + 1.830j]),
}


@pytest.mark.parametrize("name", RAHIDEH)
def test_eigenvalues_with_the_thesis_parameters(name: str) -> None:
    u_v, expected = RAHIDEH[name]
    base = Newtonian(parameter_set="rahideh").parameters
    mean = (base["k_chp"].value + base["k_chn"].value) / 2
    model = Newtonian(parameter_set="rahideh", parameters={"k_chp": mean, "k_chn": mean})
    state = settle(model, [u_v, 0.0])
    state["alpha_h"] = 0.0
    x = np.array([state[name] for name in model.state_names])
    found = np.linalg.eigvals(slopes(model, x, [u_v, 0.0]))
    for value in expected:
        assert np.abs(found - value).min() < 2e-3


def test_main_rotor_at_rest_decays_with_back_emf_and_bearing_alone() -> None:
    # model.md prints −0.328 here; the exact slope at ω = 0, where the drag has none, is
    # −(kφ²/R + B_mr)/J_mr = −0.3200.
    model = Newtonian(parameter_set="rahideh")
    found = np.linalg.eigvals(slopes(model, model.rest(), [0.0, 0.0]))
    p = model.parameters
    exact = -(p["kphi"].value ** 2 / p["R"].value + p["B_mr"].value) / p["J_mr"].value
    assert np.abs(found - exact).min() < 1e-9
    assert exact == pytest.approx(-0.3200, abs=5e-5)


def test_thesis_gain_makes_pitch_unstable_above_the_published_angle() -> None:
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
    pair = max(np.linalg.eigvals(slopes(model, x, [u_v, 0.0])), key=lambda value: value.real)
    assert pair.real == pytest.approx(0.023, abs=2e-3)
    assert abs(pair.imag) == pytest.approx(1.270, abs=4e-3)


def test_currents_as_states_hardly_matter() -> None:
    # 4 s with a step on both inputs; the angles stay within 1e-4 rad.
    def angles(model: Model) -> np.ndarray:
        step = BufferedFunction(discretise(model, 0.02, 8).step)
        x, rows = model.rest(), []
        for _ in range(200):
            u = [1.6, 0.6]
            x = step.evaluate(x, u, model.parameters.values, np.zeros(model.n_w))[0].copy()
            rows.append(x[[model.state_index("alpha_v"), model.state_index("alpha_h")]])
        return np.array(rows)

    difference = angles(Newtonian(currents="dynamic")) - angles(Newtonian())
    assert 0 < np.abs(difference).max() < 1e-4


def test_linearised_yaw_is_uncontrollable_with_the_tail_rotor_at_rest() -> None:
    model = Newtonian(freedom="horizontal")
    at = model.symbols()
    f = model.dynamics(*at)
    slope = ca.Function("slopes", list(at), [ca.jacobian(f, at[0]), ca.jacobian(f, at[1])])

    def rank(omega_h: float) -> int:
        a, b = slope([omega_h, 0.0, 0.0], [0.0], model.parameters.values, np.zeros(model.n_w))
        a, b = np.array(a), np.array(b)
        controllability = np.hstack([b, a @ b, a @ a @ b])
        return int(np.linalg.matrix_rank(controllability, tol=1e-9))

    assert rank(0.0) == 1
    assert rank(50.0) == 3


def test_free_pitch_without_friction_conserves_energy() -> None:
    still = {"k_ov": 0.0, "k_t": 0.0}
    model = Newtonian(freedom="vertical", parameters=still)
    g = geometry({p.name: p.value for p in model.parameters})
    gravity = model.parameters["g"].value

    def energy(x: np.ndarray) -> float:
        state = dict(zip(model.state_names, x, strict=True))
        kinetic = 0.5 * g["J_v"] * state["S_v"] ** 2
        sine, cosine = np.sin(state["alpha_v"]), np.cos(state["alpha_v"])
        return kinetic - gravity * ((g["A"] - g["B"]) * sine + g["C"] * cosine)

    step = BufferedFunction(discretise(model, 0.02, 4).step)
    x = model.rest()
    x[model.state_index("alpha_v")] = 0.4
    before = energy(x)
    for _ in range(1000):
        x = step.evaluate(x, [0.0], model.parameters.values, np.zeros(model.n_w))[0].copy()
    assert energy(x) == pytest.approx(before, rel=1e-8)


@pytest.mark.parametrize("freedom", ["vertical", "horizontal"])
def test_one_axis_is_the_whole_model_with_the_other_locked(freedom: str) -> None:
    one, both = Newtonian(freedom=freedom), Newtonian()  # type: ignore[arg-type]
    generator = np.random.default_rng(1)
    at_one, at_both = one.symbols(), both.symbols()
    f_one = ca.Function("one", list(at_one), [one.dynamics(*at_one)])
    f_both = ca.Function("both", list(at_both), [both.dynamics(*at_both)])
    x = generator.uniform(-0.3, 0.3, one.n_x)
    full = np.zeros(both.n_x)
    for name, value in zip(one.state_names, x, strict=True):
        full[both.state_index(name)] = value
    command = [1.0, 0.0] if freedom == "vertical" else [0.0, 1.0]
    found = np.array(f_one(x, [1.0], one.parameters.values, np.zeros(one.n_w))).ravel()
    whole = np.array(f_both(full, command, both.parameters.values, np.zeros(4))).ravel()
    expected = [whole[both.state_index(name)] for name in one.state_names]
    assert found == pytest.approx(expected, rel=1e-9)


def test_unknown_parameter_names_the_nearest() -> None:
    with pytest.raises(ConfigurationError, match="k_fpv") as raised:
        Newtonian(parameters={"k_fpv": 1e-5})
    assert "k_fvp" in raised.value.remedy


def test_unknown_set_names_the_sets() -> None:
    with pytest.raises(ConfigurationError) as raised:
        Newtonian(parameter_set="bensch")
    assert "bench" in raised.value.remedy


def test_draws_from_the_priors_repeat_and_keep_known_constants() -> None:
    parameters = Newtonian().parameters
    once, again, other = parameters.drawn(7), parameters.drawn(7), parameters.drawn(8)
    assert np.array_equal(once.values, again.values)
    assert not np.array_equal(once.values, other.values)
    assert once["g"].value == parameters["g"].value
    relative = np.array(
        [parameters.drawn(seed)["k_fvp"].value / parameters["k_fvp"].value for seed in range(400)]
    )
    assert relative.std() == pytest.approx(0.06, rel=0.15)
