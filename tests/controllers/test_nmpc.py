"""nmpc: the problem of newton_mpc, its optimum, a limit and a cap."""

from dataclasses import fields, replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from trms_cli.composition.composer import compose
from trms_cli.controllers.controller import Status
from trms_cli.controllers.newton.state import NewtonMpcState
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.controllers.nmpc import Nmpc
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.steady_state import SteadyState

from .closed_loop_case import close_loop, constant, sample_of, setup_of

BOTH = Newtonian()
#: Small enough to be quick without compiled derivatives.
SHORT = {"prediction_horizon": 24, "move_blocks": (1, 1, 1, 1, 2, 2, 4, 4, 8)}
LIMITED: dict[str, Any] = {
    "input_weights": {"u_v": 0.01, "u_h": 0.02},
    "input_rate_limits": {"u_v": 5.0},
    "soft_limits": {"alpha_v": (-0.5, 0.25)},
}
SOLVERS = ["ipopt", "fatrop"]


def quick(**keys: Any) -> Nmpc:
    return Nmpc(**{**SHORT, "machine_code": False, **keys})


@pytest.mark.parametrize("keys", [{}, LIMITED, {"terminal": "none"}], ids=["plain", "all", "free"])
def test_the_objective_is_the_merit_of_newton_mpc(keys: dict[str, Any]) -> None:
    """At any inputs, with the states that they lead to, and there all rows of g hold."""
    state = quick(**keys).init(setup_of(BOTH))
    w = np.array([0.002, -0.003, 0.0, 0.0])
    state.shared.begin_sample(sample_of(BOTH, [0.3, 0.5], w=w))
    ocp, horizon = state.ocp, state.shared.newton.horizon
    functions = ca.Function("nlp", [ocp.nlp["x"], ocp.nlp["p"]], [ocp.nlp["f"], ocp.nlp["g"]])
    rng = np.random.default_rng(3)
    for _ in range(5):
        moves = rng.uniform(-0.4, 0.4, state.shared.newton.plan.shape)  # within the rate limit
        plan = np.clip(np.cumsum(moves, axis=1), -2.5, 2.5)
        merit = state.shared.newton.merit(plan)
        unknowns = ocp.guess(horizon.evaluate.outputs[0], plan)
        np.testing.assert_array_equal(ocp.plan(unknowns), plan)
        f, g = functions(unknowns, ocp.parameters())
        assert float(f) == pytest.approx(merit, rel=1e-10)
        g = np.array(g).ravel()
        assert np.all(g >= ocp.g_lower - 1e-9) and np.all(g <= ocp.g_upper + 1e-9)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("keys", [{}, LIMITED], ids=["plain", "limits"])
@pytest.mark.parametrize("model", [BOTH, Lagrangian()], ids=["newtonian", "lagrangian"])
def test_it_finds_the_optimum_of_newton_mpc(solver: str, keys: Any, model: Model) -> None:
    """Both converged on the same sample: objective within 0.5 %, and much closer where smooth."""
    law = quick(solver=solver, **keys)
    newton = replace(law.problem(), max_iterations=200, tolerance=1e-8)
    start = SteadyState(model).solve(np.array([0.0, 0.3]))  # both rotors turn
    sample = sample_of(model, [0.15, 0.4], start.x, start.u)
    ours, theirs = law.init(setup_of(model)), NewtonMpcState(newton, setup_of(model))
    answer = law.step(ours, sample, want_prediction=True)
    other = newton.step(theirs, sample, want_prediction=True)
    assert answer.status in (Status.OK, Status.RELAXED)
    newton = ours.shared.newton
    merits = [newton.merit(newton.plan), newton.merit(theirs.newton.plan)]
    assert merits[0] == pytest.approx(merits[1], rel=5e-3)
    assert merits[0] <= merits[1] * (1 + 1e-6)
    np.testing.assert_allclose(answer.u, other.u, atol=0.02)
    assert answer.prediction is not None and other.prediction is not None
    np.testing.assert_allclose(answer.prediction.time, other.prediction.time)
    np.testing.assert_allclose(answer.prediction.states[0], start.x)


def test_machine_code_gives_the_answer_of_the_virtual_machine() -> None:
    answers = []
    for machine_code in (True, False):
        law = quick(machine_code=machine_code)
        state = law.init(setup_of(BOTH))
        answers.append(law.step(state, sample_of(BOTH, [0.3, 0.5]), want_prediction=False))
    np.testing.assert_allclose(answers[0].u, answers[1].u, atol=1e-6)


def test_a_soft_limit_is_kept_where_it_can_be_and_preview_moves_before_the_step() -> None:
    ceiling = 0.2
    law = quick(soft_limits={"alpha_v": (-0.7, ceiling)})
    ran = close_loop(law, BOTH, constant(0.3, 0.5), 6.0)
    angle = ran.states[:, BOTH.state_index("alpha_v")]
    assert angle.max() < ceiling + 5e-3
    assert angle[-1] > ceiling - 0.02
    ahead, blind = quick(preview_horizon=10), quick()
    start, moved = SteadyState(BOTH).solve(np.array([0.0, 0.3])), []
    for law in (ahead, blind):
        sample = sample_of(BOTH, [0.0, 0.3], start.x, start.u)
        known = law.preview(setup_of(BOTH)) + 1
        sample.reference = np.tile([0.0, 0.3], (known, 1))
        sample.reference[5:] = [0.2, 0.3]
        answer = law.step(law.init(setup_of(BOTH)), sample, want_prediction=False)
        moved.append(abs(answer.u - start.u).max())
    assert moved[0] > 0.01 > moved[1]


def test_a_cap_on_iterations_never_makes_a_plan_worse() -> None:
    law = quick(max_iterations=2)
    state = law.init(setup_of(BOTH))
    sample = sample_of(BOTH, [0.3, 0.5])
    answer = law.step(state, sample, want_prediction=False)
    assert answer.status in (Status.BUDGET, Status.RELAXED, Status.FAILED)
    fresh = law.init(setup_of(BOTH))
    fresh.shared.begin_sample(sample)
    start = fresh.shared.newton.merit(fresh.shared.newton.plan)
    assert state.shared.newton.merit(state.shared.newton.plan) <= start
    assert answer.status is not Status.FAILED or answer.fallback == "shifted_plan"


def test_its_defaults_are_those_of_newton_mpc_but_a_terminal_region_has_no_counterpart() -> None:
    """The classes' and the files': whoever compares the two compares the solvers."""
    ours, theirs = (
        build(dict(compose([f"controller={name}"]).config["controller"]))
        for name in ("nmpc", "newton_mpc")
    )
    assert replace(ours.problem(), qp=theirs.qp) == replace(theirs, max_iterations=10)
    # The file also names the weights that are zero.
    assert replace(Nmpc(), input_weights=ours.input_weights) == ours
    assert not any(ours.input_weights.values())
    shared = {f.name for f in fields(NewtonMpc)} & {f.name for f in fields(Nmpc)}
    apart = {f.name for f in fields(NewtonMpc)} - shared
    assert apart == {"qp", "terminal_weight", "terminal_decay", "contraction"}
    with pytest.raises(ConfigurationError, match="no counterpart"):
        Nmpc.of(NewtonMpc(terminal="quasi_infinite"))
