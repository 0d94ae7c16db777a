"""The discretised step, of equations and of models that only step: order, derivatives."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ModelError
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.discrete import SteppedModel, copied_states, root_of
from trms_cli.models.discretisation import Method, discretise, factorise_matrix
from trms_cli.models.driven_model import DrivenModel
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.rest import rest_equations

from .network_case import rig_like
from .simulate import rates

COMMAND = [1.8, 0.9]


def exact(model: Model, x: np.ndarray, seconds: float) -> np.ndarray:
    """SciPy's stiff integrator on the model's own equations."""
    solved = solve_ivp(
        lambda _, z: rates(model, z, COMMAND), (0.0, seconds), x, "Radau", rtol=1e-10, atol=1e-12
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
    model = Newtonian(currents=currents)
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


def at_random(model, seed=1):
    """A point (x, u, p, w) within the range of the networks."""
    rng = np.random.default_rng(seed)
    scale = np.array([100.0 if s.unit == "rad/s" else 0.5 for s in model.states])
    x = rng.normal(size=model.n_x) * scale
    return x, rng.normal(size=model.n_u), model.parameters.values, rng.normal(size=model.n_w) * 0.1


class TestLongerSteps:
    @pytest.mark.parametrize("count", [1, 2, 5])
    def test_are_the_steps_one_after_the_other(self, count):
        model = rig_like((1, 3), (1, 2))
        x, u, p, w = at_random(model)
        step = BufferedFunction(discretise(model, count * 0.02).step, compile=False)
        expected = x
        for _ in range(count):
            expected = rates(model, expected, u, w)
        np.testing.assert_array_equal(step.evaluate(x, u, p, w)[0], expected)

    def test_have_the_slopes_of_the_composition(self):
        model = rig_like((1, 3), (1, 2))
        discrete = discretise(model, 0.1)
        point = at_random(model)
        at = discrete.symbols()
        after = discrete.step(*at)
        direct = ca.Function("direct", list(at), [after, *(ca.jacobian(after, v) for v in at[:2])])
        for found, expected in zip(discrete.slopes()(*point), direct(*point), strict=True):
            np.testing.assert_allclose(np.array(found), np.array(expected), rtol=1e-10, atol=1e-12)

    def test_do_not_lengthen_the_generated_code(self):
        """The network stands once in the function, however often a control period takes it."""
        model = rig_like()
        once = discretise(model, 0.02).step.n_instructions()
        assert discretise(model, 0.5).step.n_instructions() < once

    def test_take_a_delay_of_the_command_with_them(self):
        model = extend_model(rig_like(), {"late": InputDelay(rotor="main", delay=0.04)})
        u, p, w = np.array([1.0, -0.5]), model.parameters.values, np.zeros(model.n_w)
        ends = []
        for step_length in (0.02, 0.1):
            discrete = discretise(model, step_length)
            step = BufferedFunction(discrete.step, compile=False)
            full = discrete.initial(model.rest(), np.zeros(2))
            for _ in range(round(0.2 / step_length)):
                full = step.evaluate(full, u, p, w)[0].copy()
            ends.append(full[: model.n_x])
        np.testing.assert_allclose(ends[0], ends[1], rtol=1e-12, atol=1e-14)
        undelayed = BufferedFunction(discretise(rig_like(), 0.2).step, compile=False)
        free = undelayed.evaluate(model.rest(), u, [], w)[0]
        assert np.abs(free - ends[0]).max() > 1.0  # rad/s: the delay is there

    @pytest.mark.parametrize("step_length", [0.01, 0.03, 0.05, 0.0200001])
    def test_are_whole_ones(self, step_length):
        with pytest.raises(ModelError) as error:
            discretise(rig_like(), step_length)
        assert "0.02 s" in error.value.problem
        assert "sim.sample_time" in error.value.remedy
        assert "controller.sample_time" in error.value.remedy


class TestCopies:
    def test_are_the_delayed_outputs_and_inputs(self):
        model = rig_like((1, 3), (1, 2))
        names = {"x": model.state_names, "u": ("u_v", "u_h")}
        copies = {
            model.state_names[i]: names[kind][j] for i, (kind, j) in copied_states(model).items()
        }
        assert copies["alpha_v_lag1"] == "alpha_v"
        assert copies["omega_h_lag2"] == "omega_h_lag1"
        assert copies["u_v_lag1"] == "u_v"
        assert len(copies) == model.n_x - 4
        assert root_of(copied_states(model), model.state_index("alpha_h_lag2")) == ("x", 1)
        # where there is a derivative there are none
        assert copied_states(Newtonian()) == {}

    def test_in_a_ring_stand_for_themselves(self):
        class Ring(SteppedModel):
            def __init__(self):
                like = rig_like()
                for name in ("inputs", "outputs", "disturbances", "parameters"):
                    setattr(self, name, getattr(like, name))
                self.name, self.states, self.sample_time = "ring", like.states[:3], 0.1

            def transition(self, x, u, p, w):
                return ca.vertcat(x[1], x[0], x[2])

            def measurement(self, x, u, p):
                return x

        model = Ring()
        assert set(copied_states(model)) == {0, 1}
        assert rest_equations(model).unknowns == (0, 1, 2)


class TestRest:
    def test_is_of_the_outputs_what_a_step_does_not_change(self):
        model = rig_like((1, 3), (1, 2))
        equations = rest_equations(model)
        assert [model.state_names[i] for i in equations.unknowns] == [s.name for s in model.outputs]
        s, u = model.rest()[:4] + np.array([0.1, 0.0, 3.0, 0.0]), np.array([0.3, -0.2])
        x = np.array(equations.state(s, u))[:, 0]
        w = np.zeros(4)
        change = (rates(model, x, u, w) - x) / 0.02
        residual = np.array(equations.residual(s, u, [], w))[:, 0]
        np.testing.assert_allclose(change[:4], residual, rtol=1e-9, atol=1e-12)
        assert np.all(change[4:] == 0)
        assert np.abs(residual).max() > 1e-3

    def test_of_a_model_with_a_derivative_is_where_that_vanishes(self):
        model = Newtonian()
        equations = rest_equations(model)
        x, u, p, w = at_random(model)
        residual = np.array(equations.residual(x, u, p, w)).ravel()
        np.testing.assert_array_equal(residual, rates(model, x, u, w))
        assert equations.unknowns == tuple(range(model.n_x))


def test_what_a_model_is_not_is_refused():
    model, continuous = rig_like(), Newtonian()
    with pytest.raises(ModelError, match=r"no derivative.*newtonian"):
        model.dynamics(*model.symbols())
    with pytest.raises(ModelError, match="discretise"):
        continuous.transition(*continuous.symbols())
    with pytest.raises(ModelError, match=r"only steps.*model@plant\.model=newtonian"):
        extend_model(model, {"rub": CoulombFriction(axis="yaw", torque=0.01)})


def test_driven_by_measured_rotor_speeds_it_still_steps():
    model = rig_like((1, 2))
    driven = DrivenModel(model, ("omega_v", "omega_h"))
    x, u, _, w = at_random(model)
    kept = [i for i in range(model.n_x) if i not in (2, 3)]
    after = rates(driven, x[kept], np.concatenate([u, x[[2, 3]]]), w)
    np.testing.assert_array_equal(after, rates(model, x, u, w)[kept])
    sources = copied_states(driven)
    assert sources[driven.state_index("omega_v_lag1")] == ("u", 2)
