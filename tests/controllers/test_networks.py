"""Controllers on black-box models: exact derivatives, true steady states, no offset."""

from dataclasses import replace

import numpy as np
import pytest

from tests.models.network_case import rig_like
from trms_cli.controllers.lqr import Lqr
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import discretise
from trms_cli.models.narx_file import Narx
from trms_cli.models.network import NarxStructure, Network
from trms_cli.models.steady_state import SteadyState

from .closed_loop_case import (
    DoubleMass,
    close_loop,
    constant,
    matrices,
    plan_slopes,
    sample_of,
    setup_of,
)

MPC = NewtonMpc(prediction_horizon=12, move_blocks=(1, 1, 2, 3, 5))


@pytest.fixture(autouse=True)
def interpreted(monkeypatch):
    """Without the C compiler: a network is evaluated a few thousand times here."""
    monkeypatch.setattr("trms_cli.core.compilation.compiler", lambda: None)


class TestSteadyState:
    @pytest.mark.parametrize("lags", [((1, 2), (1,)), ((1, 3), (1, 2))], ids=str)
    @pytest.mark.parametrize("push", [np.zeros(4), np.array([0.2, -0.1, 20.0, -10.0])], ids=str)
    def test_is_a_fixed_point_of_the_step_at_the_reference(self, lags, push):
        model = rig_like(*lags)
        target = SteadyState(model).solve(np.array([0.3, -0.2]), push)
        assert target.converged and not target.projected
        step = BufferedFunction(discretise(model, 0.02).step, compile=False)
        after = step.evaluate(target.x, target.u, [], push)[0]
        np.testing.assert_allclose(after, target.x, rtol=0, atol=1e-8)
        np.testing.assert_allclose(target.x[:2], [0.3, -0.2], rtol=0, atol=1e-6)
        assert target.x.shape == (model.n_x,)

    def test_out_of_reach_is_projected_to_the_bound(self):
        model = rig_like()
        target = SteadyState(model).solve(np.array([1.0, -2.5]), np.array([-3.5, 0.0, 0.0, 0.0]))
        assert target.converged and target.projected
        assert target.u[0] == 2.5
        assert target.x[0] < 0.9


class TestPrediction:
    def test_is_the_network_evaluated_sample_by_sample_with_the_slopes_of_its_differences(self):
        horizon = MPC.problem(setup_of(rig_like(bend=0.4))).horizon
        rng = np.random.default_rng(5)
        point = horizon.arguments
        point["x0"][:] = horizon.model.rest() + 0.05
        point["z"][:] = rng.uniform(-1, 1, point["z"].shape)
        point["r"][:] = rng.uniform(-0.3, 0.3, point["r"].shape)
        point["x_s"][:] = horizon.model.rest()
        horizon.evaluate()
        trajectory = horizon.evaluate.outputs[0]
        x = point["x0"].copy()
        arrangement, network = horizon.model.structure.arrangement(), horizon.model.network
        for k, block in enumerate(horizon.blocks):
            for _ in range(5):  # of output lags 1, 2 and input lag 1, by NumPy
                phi = arrangement @ np.concatenate([x[:8], point["z"][:, block]])
                x = np.concatenate([x[:4] + network.evaluate(phi[None, :])[0], x[:4]])
            np.testing.assert_allclose(trajectory[:, k], x, rtol=1e-9, atol=1e-10)
        horizon.linearise()
        gradient, slope = horizon.linearise.outputs[5].copy(), horizon.linearise.outputs[7].copy()
        *terminal, objective = plan_slopes(horizon, 1e-5)
        np.testing.assert_allclose(slope, terminal, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(gradient, objective, rtol=1e-6, atol=1e-7)


class TestNewtonMpc:
    def test_leaves_no_offset_and_knows_a_constant_push(self):
        ran = close_loop(MPC, rig_like(), constant(0.25, -0.3), 12.0)
        np.testing.assert_allclose(ran.errors[-10:], 0, atol=2e-3)
        assert ran.commands[-1].status.label == "ok"
        push = {"torque": lambda t: [0.15, -0.08, 10, 0], "known": True}
        ran = close_loop(MPC, rig_like(), constant(0, 0), 12.0, **push)
        np.testing.assert_allclose(ran.errors[-10:], 0, atol=2e-3)


def linear_narx(model: DoubleMass, step: float) -> Narx:
    """The NARX form of a linear model of four states and two outputs, exact by its observability.

    With y = C x: x(k) follows from y(k), y(k − 1) and u(k − 1), and so does y(k + 1).
    """
    A, B = matrices(discretise(model, step).step, model)
    C = np.eye(4)[[0, 2]]
    # (y(k), y(k−1)) in terms of x(k−1), u(k−1)
    seen, driven = np.vstack([C @ A, C]), np.vstack([C @ B, np.zeros((2, 2))])
    back = np.linalg.inv(seen)
    ahead = C @ A @ A @ back  # y(k+1) from (y(k), y(k−1)) …
    by_last = C @ A @ B - ahead @ driven  # … and from u(k−1)
    weights = {"W1": np.hstack([ahead, C @ B, by_last]), "b1": np.zeros(2)}
    made = NarxStructure(
        ("p1", "p2"), ("f1", "f2"), ("m", "m"), ("N", "N"), (1, 2), (1, 2), step, False, False
    )
    network = Network("mlp", weights, np.zeros(8), np.ones(8), np.zeros(2), np.ones(2))
    return Narx(made, network, limits={"f1": 100.0, "f2": 100.0})


def test_a_linear_network_gives_the_regulator_of_the_linear_model():
    """Two descriptions of one linear system: the same gains on the same history, the same loop."""
    rig = DoubleMass()
    model = linear_narx(rig, 0.02)
    law = Lqr(
        operating_point={},
        output_weights={"p1": 50.0, "p2": 80.0},
        rate_weights={"p1": 3.0, "p2": 2.0},
        integral_weights={"p1": 5.0, "p2": 5.0},
        input_weights={"f1": 1.0, "f2": 2.0},
    )
    level = np.array([0.4, -0.3])
    start = np.array([0.1, 0.0, -0.2, 0.0])
    known = close_loop(law, rig, constant(*level), 6.0, x0=start).inputs

    # the same loop with the network as the model, its past kept beside the rig
    A, B = matrices(discretise(rig, 0.02).step, rig)
    before = np.linalg.solve(A, start)  # one sample ago, without a command
    x_rig, past, u = start.copy(), before[[0, 2]], np.zeros(2)
    state = law.init(setup_of(model, 0.02))
    found = []
    for _ in range(len(known)):
        x = np.concatenate([x_rig[[0, 2]], past, u])
        past = x_rig[[0, 2]]
        u = law.step(state, sample_of(model, level, x, u), want_prediction=False).u
        found.append(u)
        x_rig = A @ x_rig + B @ u
    np.testing.assert_allclose(found, known, rtol=0, atol=2e-5 * np.abs(known).max())
    assert np.abs(known[0] - known[-1]).max() > 1.0


def test_rate_weights_damp_a_network():
    """The rate is the difference quotient over a control period, whatever the model's states."""
    model = rig_like()
    peaks = []
    for weight in (0.0, 5.0):
        mpc = replace(MPC, rate_weights={"alpha_v": weight, "alpha_h": weight}, terminal="none")
        ran = close_loop(mpc, model, constant(0.3, 0.3), 3.0)
        peaks.append(np.abs(np.diff(ran.states[:, 1])).max())
    assert peaks[1] < 0.8 * peaks[0]
