"""Linear MPC whose model changes on the way: the bank of several, and what is adapted."""

from typing import Any

import numpy as np
import pytest

from trms_cli.code_generation.export import check_exportable
from trms_cli.controllers.adaptive_linear_mpc import AdaptiveLinearMpc
from trms_cli.controllers.multiple_model_mpc import MultipleModelMpc
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.steady_state import SteadyState

from .closed_loop_case import close_loop, constant, sample_of, setup_of, squares

BOTH = Newtonian()
#: Rotors twice as heavy as is believed.
HEAVY = Newtonian(parameters={name: 2 * BOTH.parameters[name].value for name in ("J_mr", "J_tr")})
LAWS: list[Any] = [MultipleModelMpc(), MultipleModelMpc(weighting="distance"), AdaptiveLinearMpc()]
BANK = [{"alpha_h": yaw} for yaw in (-0.5, 0.5)]


class Kept:
    """A law whose last state can be looked at."""

    def __init__(self, law: Any) -> None:
        self.law, self.state = law, None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.law, name)

    def init(self, setup: Any) -> Any:
        self.state = self.law.init(setup)
        return self.state


@pytest.mark.parametrize("law", LAWS, ids=["bayes", "distance", "adaptive"])
def test_a_known_torque_leaves_no_offset(law: Any) -> None:
    push = np.array([0.004, 0.0, 0.0, 0.0])
    ran = close_loop(
        law, BOTH, constant(0.2, 0.5), 25.0, torque=lambda t: push * (t > 1), known=True
    )
    np.testing.assert_allclose(ran.errors[-1], 0.0, atol=2e-3)


def test_the_nearest_model_of_a_bank_counts_by_distance() -> None:
    law = MultipleModelMpc(bank=BANK, weighting="distance")
    state = law.init(setup_of(BOTH))
    for yaw, nearest in ((0.5, 1), (-0.5, 0), (0.0, None)):
        x = SteadyState(BOTH).solve(np.array([0.0, yaw])).x
        law.step(state, sample_of(BOTH, [0.0, yaw], x), want_prediction=False)
        assert abs(state.weights.sum() - 1.0) < 1e-12
        if nearest is None:
            np.testing.assert_allclose(state.weights, 0.5)
        else:
            assert state.weights[nearest] > 0.95
        # The blend is what the program predicts with.
        n = len(state.A[0])
        A = state.newton.horizon.arguments["p"][: n * n].reshape(n, n)
        np.testing.assert_allclose(A, np.tensordot(state.weights, state.A, 1), atol=1e-12)


def test_the_model_that_predicts_best_has_the_probability_and_another_can_come_back() -> None:
    """At rest on one point of the bank, then on the other."""
    law = MultipleModelMpc(bank=BANK)
    state = law.init(setup_of(BOTH))
    for yaw, right in ((-0.5, 0), (0.5, 1), (-0.5, 0)):
        at = SteadyState(BOTH).solve(np.array([0.0, yaw]))
        for _ in range(10):
            law.step(state, sample_of(BOTH, [0.0, yaw], at.x, at.u), want_prediction=False)
        assert state.weights[right] > 0.9
        assert state.weights.min() >= law.least_probability


@pytest.mark.parametrize(
    ("options", "where"),
    [
        ({"bank": []}, "controller.bank"),
        ({"bank": [{"alpha_h": 0.5}, {"alpha_h": 0.0}]}, "controller.bank[1]"),
        ({"bank": BANK, "least_probability": 0.49, "operating_point": {}}, "controller.oper"),
        ({"bank": BANK * 2, "least_probability": 0.3}, "controller.least_probability"),
    ],
)
def test_a_bank_that_cannot_be_is_refused(options: dict, where: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        MultipleModelMpc(**options).init(setup_of(BOTH))
    assert caught.value.where.startswith(where)


def errors_of(state: Any, ran: Any) -> tuple[float, float]:
    """Root mean square of what the first model and the fit miss of all periods of a run, in
    typical sizes."""
    x, u = ran.states, ran.inputs
    phi = np.hstack([x[:-1] - state._centre, u[:-1] - state._centre_input])
    missed = x[1:] - state._centre - phi @ state._first_model.T
    learnt = np.hstack([phi, np.ones((len(phi), 1))]) @ (state._scale * state.change).T
    size = state._size
    before, after = (
        float(np.sqrt(np.mean((error / size) ** 2))) for error in (missed, missed - learnt)
    )
    return before, after


def test_the_fit_learns_a_rig_that_is_not_the_model_within_its_bounds() -> None:
    law = Kept(AdaptiveLinearMpc())
    ran = close_loop(law, BOTH, squares(BOTH, 5.0), 30.0, rig=HEAVY)
    state: Any = law.state
    before, after = errors_of(state, ran)
    assert after < 0.7 * before
    assert np.abs(state.change).max() <= law.largest_change
    variances = np.einsum("imm->im", state.covariance)
    assert variances.max() <= 1.0 + 1e-12 and variances.min() > 0.0
    assert np.linalg.eigvalsh(state.covariance).min() > -1e-9
    # What the model's structure makes zero stays zero.
    A, B = state._operating
    first = state._first_model
    assert np.all(np.hstack([A, B])[first == 0.0] == 0.0)


def test_nothing_is_learnt_from_what_noise_explains_nor_from_what_no_rig_does() -> None:
    law = AdaptiveLinearMpc()
    state = law.init(setup_of(BOTH))
    level = np.array([0.0, 0.5])
    at = SteadyState(BOTH).solve(level)
    rng = np.random.default_rng(0)
    noise = 0.2 * law.residual_share * state._size
    for k in range(60):
        x = at.x + noise * rng.uniform(-1, 1, size=len(noise))
        law.step(state, sample_of(BOTH, level, x * (1e9 if k == 30 else 1), at.u),
                 want_prediction=False)  # fmt: skip
    assert not state.change.any()


@pytest.mark.parametrize("law", [MultipleModelMpc(), AdaptiveLinearMpc()], ids=["bank", "adaptive"])
def test_the_engine_of_linear_mpc_is_not_exported_in_their_name(law: Any) -> None:
    with pytest.raises(ConfigurationError, match="has no C source"):
        check_exportable(law)
