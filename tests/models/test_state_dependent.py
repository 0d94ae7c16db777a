"""The state-dependent form: exact, the Jacobian at the origin, first order in the step."""

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from trms_cli.core.errors import ModelError
from trms_cli.models.discretisation import discretise
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.observers.state_dependent_ekf import StateDependentForm, state_dependent

from .simulate import rates

MODELS: dict[str, Model] = {
    "newtonian": Newtonian(),
    "newtonian_full": Newtonian(currents="dynamic"),
    "vertical": Newtonian(freedom="vertical"),
    "horizontal": Newtonian(freedom="horizontal"),
    "lagrangian": Lagrangian(),
}
#: Nodes with which the integrals are exact to rounding over the rig's travel, and the degree at
#: which the series of a rate along a ray has ended.
NODES, DEGREE = 12, 40
SIZES = {"i": 1.0, "omega_h": 300.0, "omega_v": 250.0, "S": 2.0, "alpha_h": 1.5, "alpha_v": 0.8}


def scale(model: Model) -> np.ndarray:
    return np.array(
        [SIZES.get(name, SIZES.get(name.partition("_")[0], 1.0)) for name in model.state_names]
    )


FORMS = {name: state_dependent(model) for name, model in MODELS.items()}
EXACT = {name: state_dependent(model, nodes=NODES) for name, model in MODELS.items()}


def ray_error(along: Callable[[float], np.ndarray], nodes: int) -> np.ndarray:
    """What Gauss–Legendre may miss of the slope's integral over a ray, by row.

    With Σ a_k T_k the slope's Chebyshev series, the sum is exact below degree 2·nodes, and takes
    a T_k beyond for at most 1 where it integrates to at most 1/(k² − 1).
    """
    places = np.polynomial.chebyshev.chebpts1(DEGREE + 1)
    values = np.array([along((1.0 + place) / 2.0) for place in places])
    series = np.polynomial.chebyshev.chebfit(places, values, DEGREE)
    missed = 2.0 * np.abs(np.polynomial.chebyshev.chebder(series))[2 * nodes :]
    k = 2.0 * nodes + np.arange(len(missed))
    return (1.0 + 1.0 / (k**2 - 1.0)) @ missed


def residual(form: StateDependentForm, x: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
    """What the form leaves of the model's derivative at a point without torques, (n_x,)."""
    A, B, _, f0 = (np.asarray(part) for part in form.coefficients(x, u, p))
    of_form = f0[:, 0] + A @ (x - form.origin_x) + B @ (u - form.origin_u)
    return rates(form.model, x, u) - of_form


@pytest.mark.parametrize("name", MODELS)
@settings(max_examples=30)
@given(fractions=st.lists(st.floats(-1.0, 1.0), min_size=10, max_size=10))
@example([-0.29, -0.44, 0.86, 1.0, 0.02, 1.0, 0.84, -0.13, 0.0, 0.0])
@example([-0.71, -0.23, 0.84, 0.97, -0.95, 1.0, 0.81, -0.4, 0.0, 0.0])
def test_the_form_is_the_model_wherever_the_rotors_start_at_rest(name, fractions):
    model, form, p = MODELS[name], FORMS[name], MODELS[name].parameters.values
    x = scale(model) * fractions[: model.n_x]
    u = 2.5 * np.array(fractions[model.n_x : model.n_x + model.n_u])
    largest = 1.0 + np.abs(rates(model, x, u)).max()
    assert np.abs(residual(EXACT[name], x, u, p)).max() <= 1e-10 * largest
    x_0, u_0 = form.origin_x, form.origin_u
    error = ray_error(lambda part: rates(model, x_0 + part * (x - x_0), u_0), 6)
    error += ray_error(lambda part: rates(model, x, u_0 + part * (u - u_0)), 6)
    assert np.all(np.abs(residual(form, x, u, p)) <= error + 1e-12 * largest)


def test_at_the_origin_it_is_the_jacobian():
    model = MODELS["newtonian"]
    x_0, u_0 = model.rest() + 0.1, np.array([0.7, -0.3])
    form = state_dependent(model, x_0, u_0)
    x, u, p, w = model.symbols()
    f = model.dynamics(x, u, p, w)
    slopes = ca.Function("slopes", [x, u, p, w], [ca.jacobian(f, v) for v in (x, u, w)])
    expected = slopes(x_0, u_0, model.parameters.values, np.zeros(model.n_w))
    found = form.coefficients(x_0, u_0, model.parameters.values)
    for given_part, wanted in zip(found, expected, strict=False):
        np.testing.assert_allclose(given_part, ca.densify(wanted), rtol=1e-9, atol=1e-9)


def test_a_ray_through_a_kink_leaves_a_small_residual_that_is_told():
    model = MODELS["newtonian"]
    x_0 = model.rest()
    x_0[model.state_index("omega_h")] = 100.0
    form = state_dependent(model, x_0)
    beyond = x_0.copy()
    beyond[model.state_index("omega_h")] = -80.0
    p = model.parameters.values
    left = residual(form, beyond, np.zeros(2), p)
    rows = [model.state_index(name) for name in ("omega_h", "S_h")]
    whole = rates(model, beyond)
    assert np.abs(left[rows]).max() > 0
    assert np.all(np.abs(left[rows]) < 0.05 * np.abs(whole[rows]))


@pytest.mark.parametrize("name", ["newtonian", "lagrangian"])
def test_a_step_converges_to_the_integrator_with_second_order_local_error(name):
    model = MODELS[name]
    form, p, w = FORMS[name], model.parameters.values, np.zeros(model.n_w)
    x = model.rest() + 0.2 * scale(model)
    u = np.array([1.6, -0.8])
    errors = []
    for step_length in (0.04, 0.02, 0.01):
        Phi, gamma_u, _, c = (np.asarray(v) for v in form.discrete(step_length)(x, u, p))
        after = form.origin_x + Phi @ (x - form.origin_x) + gamma_u @ u + c[:, 0]
        exact = np.asarray(discretise(model, step_length, 8).step(x, u, p, w))[:, 0]
        errors.append(np.abs((after - exact) / scale(model)).max())
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.25)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.25)


def test_a_stiff_model_settles_its_currents_in_a_step():
    model = MODELS["newtonian_full"]
    form, p = FORMS["newtonian_full"], model.parameters.values
    x = model.rest()
    x[model.state_index("i_v")] = 5.0
    after = x
    for _ in range(3):
        Phi, gamma_u, _, c = (
            np.asarray(v) for v in form.discrete(0.02)(after, np.array([1.0, 0.0]), p)
        )
        after = form.origin_x + Phi @ (after - form.origin_x) + gamma_u @ [1.0, 0.0] + c[:, 0]
    settled = np.asarray(
        discretise(model, 0.06, 12).step(x, np.array([1.0, 0.0]), p, np.zeros(model.n_w))
    )
    i = model.state_index("i_v")
    assert after[i] == pytest.approx(settled[i, 0], rel=0.02)


def test_what_cannot_be_is_refused():
    model = MODELS["newtonian"]
    with pytest.raises(ModelError, match="origin"):
        state_dependent(model, np.zeros(3))
    with pytest.raises(ModelError, match="step"):
        state_dependent(model).discrete(0.0)
