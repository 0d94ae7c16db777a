"""The discretised step: order of accuracy, stability, derivatives."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ModelError
from trms_cli.models.discretisation import Method, discretise, factorise_matrix
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian

from .simulate import rates

COMMAND = [1.8, 0.9]


def exact(model: Model, x: np.ndarray, seconds: float) -> np.ndarray:
    """SciPy's stiff integrator on the model's own equations."""
    solved = solve_ivp(
        lambda _, z: rates(model, z, COMMAND),
        (0.0, seconds),
        x,
        method="Radau",
        rtol=1e-10,
        atol=1e-12,
    )
    return solved.y[:, -1]


def moving_state(model: Model) -> np.ndarray:
    # Both rotors turn: at ω = 0 the thrust has a kink that lowers the order of any method.
    x = model.rest()
    for name, value in {"omega_v": 120.0, "omega_h": 60.0, "S_v": 0.1, "S_h": 0.2}.items():
        x[model.state_index(name)] = value
    x[model.state_index("alpha_h")] = 0.3
    return x


@pytest.mark.parametrize(("method", "order"), [("rk4", 4), ("rodas3", 3)])
def test_order_of_accuracy(method: Method, order: int) -> None:
    model = Newtonian()
    x = moving_state(model)
    reference = exact(model, x, 0.4)
    errors = []
    for substeps in (2, 4, 8):
        step = BufferedFunction(discretise(model, 0.4, substeps, method).step)
        after = step.evaluate(x, COMMAND, model.parameters.values, np.zeros(4))[0]
        errors.append(np.abs(after - reference).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders[-1] == pytest.approx(order, abs=0.4)


def test_stiff_currents_are_integrated_far_above_their_time_constant() -> None:
    model = Newtonian(currents="dynamic")
    x = moving_state(model)
    x[model.state_index("i_v")] = 0.5
    reference = exact(model, x, 0.1)
    step = BufferedFunction(discretise(model, 0.1, 5).step)  # 20 ms; the current's is 0.1 ms
    after = step.evaluate(x, COMMAND, model.parameters.values, np.zeros(4))[0]
    angles = [model.state_index("alpha_v"), model.state_index("alpha_h")]
    assert after[angles] == pytest.approx(reference[angles], abs=2e-5)
    assert np.abs(after - reference).max() < 0.05
    # An explicit method would fail there.
    step = BufferedFunction(discretise(model, 0.1, 5, "rk4").step)
    after = step.evaluate(x, COMMAND, model.parameters.values, np.zeros(4))[0]
    assert not np.abs(after).max() < 1e6


@pytest.mark.parametrize("currents", ["quasi_static", "dynamic"])
def test_derivatives_are_those_of_the_step(currents: str) -> None:
    model = Newtonian(currents=currents)  # type: ignore[arg-type]
    discrete = discretise(model, 0.05, 2)
    arguments = [
        moving_state(model),
        np.array(COMMAND),
        model.parameters.values,
        np.array([0.002, -0.003, 1e-4, -1e-4]),
    ]
    after, *matrices = (
        np.array(out, ndmin=2)
        for out in BufferedFunction(discrete.linearised()).evaluate(*arguments)
    )
    assert after.ravel() == pytest.approx(np.array(discrete.step(*arguments)).ravel())
    generator = np.random.default_rng(0)
    for i, matrix in enumerate(matrices):
        direction = generator.standard_normal(arguments[i].shape) * (
            np.abs(arguments[i]) * 1e-5 + 1e-9
        )
        shifted = [
            [a + s * direction if j == i else a for j, a in enumerate(arguments)] for s in (1, -1)
        ]
        plus, minus = (np.array(discrete.step(*s)).ravel() for s in shifted)
        change = (plus - minus) / 2
        tolerance = 1e-5 * np.abs(change).max() + 1e-13
        assert matrix @ direction == pytest.approx(change, abs=tolerance)


def test_measurement_picks_the_declared_channels() -> None:
    model = Newtonian()
    x = moving_state(model)
    y = discretise(model, 0.1).measurement(x, COMMAND, model.parameters.values)
    assert np.array(y).ravel().tolist() == [x[5], x[2], x[3], x[0]]


@pytest.mark.parametrize(("step", "substeps"), [(0.0, 1), (-0.1, 1), (0.1, 0), (float("nan"), 1)])
def test_impossible_steps_are_refused(step: float, substeps: int) -> None:
    with pytest.raises(ModelError, match="cannot discretise"):
        discretise(Newtonian(), step, substeps)


@pytest.mark.parametrize("density", [0.2, 0.5, 1.0])
def test_solves_diagonally_dominant_systems(density: float) -> None:
    generator = np.random.default_rng(3)
    values = generator.standard_normal((7, 7)) * (generator.random((7, 7)) < density)
    np.fill_diagonal(values, 10.0)
    pattern = ca.DM(ca.sparsify(ca.DM(values))).sparsity()
    matrix, right = ca.SX.sym("matrix", pattern), ca.SX.sym("right", 7)
    solve = ca.Function("solve", [matrix, right], [factorise_matrix(matrix)(right)])
    b = generator.standard_normal(7)
    found = np.array(solve(ca.sparsify(ca.DM(values)), b)).ravel()
    assert found == pytest.approx(np.linalg.solve(values, b), rel=1e-12)


def test_a_triangular_matrix_costs_no_fill_in() -> None:
    matrix = ca.SX.sym("matrix", ca.Sparsity.lower(6))
    right = ca.SX.sym("right", 6)
    solve = ca.Function("solve", [matrix, right], [factorise_matrix(matrix)(right)])
    # One division a row, one product and one difference an entry below the diagonal, and as many
    # in the factorisation at the most.
    assert solve.n_nodes() < 120
