"""What the laws answer where a solve fails, a number is none, or the configuration is mistaken."""

import math
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from trms_cli.controllers.controller import Status
from trms_cli.controllers.feedback_linearisation import FeedbackLinearisation
from trms_cli.controllers.linear_mpc import LinearMpc
from trms_cli.controllers.lqr import Lqr
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.controllers.nmpc import Nmpc
from trms_cli.controllers.ocp import OcpSolution
from trms_cli.controllers.pid import Pid
from trms_cli.core.errors import ConfigurationError, SimulationError
from trms_cli.core.plugins import build
from trms_cli.core.qp import Daqp, QpResult
from trms_cli.models.newtonian import Newtonian

from .closed_loop_case import SAMPLE_TIME, sample_of, setup_of

BOTH = Newtonian()
BLOCKS = (1, 1, 1, 1, 2, 2, 4, 4, 8)
PREDICTIVE: dict[str, Any] = {
    "newton_mpc": (NewtonMpc, {"prediction_horizon": 20, "max_iterations": 1, "qp": Daqp()}),
    "linear_mpc": (LinearMpc, {"qp": Daqp()}),
    "nmpc": (Nmpc, {"prediction_horizon": 24, "move_blocks": BLOCKS, "machine_code": False}),
}


def spoil(monkeypatch: pytest.MonkeyPatch, state: Any) -> None:
    """No program is solved any more."""

    def unsolved(self: Any, workspace: Any, qp: Any) -> QpResult:
        return QpResult(np.full(len(qp.gradient), np.nan), False, 0, "made to fail")

    def lost(guess: np.ndarray, multipliers: Any = None) -> OcpSolution:
        nothing = np.full_like(guess, np.nan)
        return OcpSolution(nothing, np.nan, False, False, 7, "made to fail", (guess, guess), 0.0)

    monkeypatch.setattr(Daqp, "solve", unsolved)
    if hasattr(state, "solver"):
        monkeypatch.setattr(state.solver, "solve", lost)


@pytest.mark.parametrize("policy", ["shifted_plan", "hold", "steady_input", "stop"])
@pytest.mark.parametrize("name", PREDICTIVE)
def test_a_failed_solve_falls_back_as_declared(name, policy, monkeypatch) -> None:
    kind, options = PREDICTIVE[name]
    law = kind(**options, fallback=policy)
    state = law.init(setup_of(BOTH))
    sample = sample_of(BOTH, [0.3, 0.5], u=np.array([1.0, -1.0]))
    law.step(state, sample, want_prediction=False)
    shared = getattr(state, "shared", state)
    plan = shared.newton.plan.copy()
    with monkeypatch.context() as patch:
        spoil(patch, state)
        if policy == "stop":
            with pytest.raises(SimulationError, match=f"(?s){name}.*made to fail|made to fail"):
                law.step(state, sample, want_prediction=False)
            return
        answer = law.step(state, sample, want_prediction=False)
    assert answer.status is Status.FAILED and answer.fallback == policy
    assert "made to fail" in answer.message
    expected = {
        "shifted_plan": plan[:, 1],
        "hold": sample.previous_command,
        "steady_input": shared.target.u,
    }[policy]
    np.testing.assert_allclose(answer.u, expected, atol=1e-9)
    assert law.step(state, sample, want_prediction=False).status is not Status.FAILED
    if name != "nmpc":
        breaks = Mock(side_effect=RuntimeError("made to fail"))
        monkeypatch.setattr(Daqp, "solve", breaks)
        broken = law.step(state, sample, want_prediction=False)
        assert broken.status is Status.FAILED and np.isfinite(broken.u).all()
        assert "RuntimeError: made to fail" in broken.message


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["state", "reference", "disturbance"])
def test_what_is_not_finite_is_held_and_not_integrated(bad: float, where: str) -> None:
    """An LQR's integral and a PID's, which does not look at disturbances."""
    u, x, r, w = np.array([1.0, 0.2]), BOTH.rest(), np.zeros(2), np.zeros(4)
    good = sample_of(BOTH, r, x.copy(), u)
    {"state": x, "reference": r, "disturbance": w}[where][1] = bad
    for law in (Lqr(), Pid()) if where != "disturbance" else (Lqr(),):
        state = law.init(setup_of(BOTH, SAMPLE_TIME))
        law.step(state, good, want_prediction=False)
        before = memory_of(state)
        command = law.step(state, sample_of(BOTH, r, x, u, w), want_prediction=False)
        assert command.status is Status.FAILED and command.fallback == "hold"
        assert "not finite" in command.message
        np.testing.assert_array_equal(command.u, u)
        np.testing.assert_array_equal(memory_of(state), before)
        assert law.step(state, good, want_prediction=False).status is Status.OK


def memory_of(state: Any) -> np.ndarray:
    return np.array(state.remembered if hasattr(state, "remembered") else state.integral)


NO_SLOPE = {"alpha_v": 0.0, "alpha_h": 0.0}
MISTAKES: list[Any] = [
    (Pid, {"operating_points": [{"alpha_h": 0.0}]}, "operating_points[0]", "uncontrollable"),
    (Pid, {"operating_points": [{"alpha_w": 0.0}]}, "operating_points[0]", "did you mean alpha_"),
    (Pid, {"operating_points": [{"alpha_v": 1.4}]}, "operating_points[0]", "cannot rest"),
    (Pid, {"operating_points": []}, "operating_points", "at least one"),
    (Pid, {"operating_points": [{"alpha_h": 0.0}]}, "operating_points[0]", "alpha_h: 0.5 in it"),
    *((Pid, {k: math.inf}, k, "not infinite") for k in ("reference_lag", "lead_filter")),
    (Pid, {"pitch": {"kp": math.inf, "ki": 1.0}}, "pitch.kp", "not infinite"),
    (
        Pid,
        {"pitch": {"kp": 1.0, "ki": 1.0}, "loops": {"pitch": {"kp": 2.0, "ki": 1.0}}},
        "loops.pitch",
        "given twice",
    ),
    (Pid, {"max_sensitivity": 1.01}, "pitch", "raise max_sensitivity"),
    (Pid, {"pitch": {"kp": 1.0, "kii": 2.0}}, "pitch.kii", "kii"),
    (Pid, {"pitch": {"kp": 0.1, "ki": 0.05}}, "pitch", "larger kd"),
    (Pid, {"pitch": {"kp": 0.1}}, "pitch.ki", "required"),
    (Pid, {"yaw": "manual"}, "yaw", "manual"),
    (Pid, {"smoothness": {"roll": 1.0}}, "smoothness", "pitch"),
    (Lqr, {"operating_point": {"alpha_x": 0.0}}, "operating_point", "did you mean alpha_"),
    (Lqr, {"operating_point": NO_SLOPE}, "operating_point", "uncontrollable"),
    (Lqr, {"operating_point": NO_SLOPE}, "operating_point", "alpha_h=0.5"),
    (Lqr, {"output_weights": {"alpha": 1.0}}, "output_weights", "did you mean alpha_"),
    (Lqr, {"input_weights": {"u_w": 1.0}}, "input_weights", "did you mean u_"),
    (Lqr, {"input_weights": {"u_v": 0.0}}, "input_weights.u_v", ">"),
    (LinearMpc, {"operating_point": {"alpha_h": 0.0}}, "operating_point", "alpha_h"),
    (LinearMpc, {"state_weights": {"S_h": 1.0}}, "state_weights", "no weight"),
    (NewtonMpc, {"input_rate_limits": {"u_x": 5.0}}, "input_rate_limits.u_x", "u_"),
    (NewtonMpc, {"soft_limits": {"alpha_v": (1, -1)}}, "soft_limits.alpha_v", "below the upper"),
    (NewtonMpc, {"soft_limits": {"alpha_w": (-1.0, 1.0)}}, "soft_limits.alpha_w", "alpha_"),
    (NewtonMpc, {"rate_weights": {"omega": 1.0}}, "rate_weights.omega", "has no 'omega'"),
    (NewtonMpc, {"state_weights": {"alpha_w": 1.0}}, "state_weights.alpha_w", "alpha_"),
    (NewtonMpc, {"preview_horizon": 50}, "preview_horizon", "40"),
    *((NewtonMpc, {"move_blocks": b}, "move_blocks", "") for b in ((), (0, 2), (1, -1))),
    (Nmpc, {"prediction_horizon": 5, "preview_horizon": 6}, "preview_horizon", "5"),
    (FeedbackLinearisation, {"poles": {"roll": (3.0, 2.5, 2.0, 0.7)}}, "poles", "axis"),
    (FeedbackLinearisation, {"poles": {"pitch": (3.0, 2.5, 2.0, 0.7)}}, "poles.yaw", "both axes"),
]


@pytest.mark.parametrize(("kind", "options", "where", "words"), MISTAKES)
def test_mistakes_are_reported_by_key(kind: Any, options: Any, where: str, words: str) -> None:
    node = {"_target_": f"{kind.__module__}.{kind.__name__}", **options}
    with pytest.raises(ConfigurationError) as caught:
        build(node, "controller").init(setup_of(BOTH, 0.02 if kind in (Pid, Lqr) else 0.1))
    assert caught.value.where.removeprefix("controller.") == where
    assert words in f"{caught.value.problem} {caught.value.remedy}"
