"""The compiled engine: the same answers as NumPy's; settings, failures, no compiler."""

import logging
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from trms_cli.controllers.controller import Command, ControlSample, Status
from trms_cli.controllers.linear_mpc import LinearMpc, LinearMpcState
from trms_cli.controllers.newton.engine import NewtonEngine
from trms_cli.controllers.newton.state import NewtonMpcState
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.controllers.qp.riccati import Riccati
from trms_cli.core.compilation import BufferedFunction, compiler
from trms_cli.core.errors import SimulationError
from trms_cli.core.qp import Daqp
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.discretisation import discretise
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian

from .closed_loop_case import sample_of, setup_of, state_with

needs_compiler = pytest.mark.skipif(compiler() is None, reason="needs a C compiler")
#: V; what is left is rounding.
EQUAL = 1e-7
MODEL = Newtonian()
DELAYED = extend_model(MODEL, {"delay": InputDelay(rotor="tail", delay=0.15)})
HORIZONTAL = Newtonian(freedom="horizontal")
QUASI: dict[str, Any] = {"terminal": "quasi_infinite"}


Law = NewtonMpc | LinearMpc


def pair(mpc: Law, model: Model) -> tuple[NewtonEngine, NewtonMpcState]:
    engine = mpc.init(setup_of(model, mpc.sample_time))
    assert isinstance(engine, NewtonEngine)
    state = replace(mpc, qp=Daqp()).init(setup_of(model, mpc.sample_time))
    assert isinstance(state, NewtonMpcState)
    return engine, state


def both(mpc: Law, model: Model, seconds: float = 12.0) -> list[tuple[Command, Command]]:
    """Commands of engine and NumPy on the same samples of a loop that the engine closes."""
    engine, state = pair(mpc, model)
    discrete = discretise(model, mpc.sample_time, 5)
    step, u = BufferedFunction(discrete.step), np.zeros(model.n_u)
    full, answers = discrete.initial(model.rest(), u), []
    levels = np.array([[0.3, 0.5], [-0.3, -0.2], [0.05, 0.0]])[:, : len(model.controlled)]
    for k in range(round(seconds / mpc.sample_time)):
        ahead = (k + np.arange(mpc.preview_horizon + 1)) * mpc.sample_time
        reference = levels[(ahead / 4.0).astype(int) % len(levels)]
        x, w = full[: model.n_x].copy(), np.full(model.n_w, 1e-3 * (k // 40))
        sample = ControlSample(0.0, reference, Estimate(x, 0 * x, w, 0 * w), u)
        ours = engine.step(sample, want_prediction=True)
        theirs = state.step(sample, want_prediction=True)
        answers.append((ours, theirs))
        u = ours.u
        full = step.evaluate(full, u, model.parameters.values, w)[0].copy()
    return answers


@needs_compiler
@pytest.mark.parametrize(
    ("mpc", "model"),
    [
        pytest.param(NewtonMpc(), MODEL, id="default"),
        pytest.param(NewtonMpc(**QUASI), MODEL, id="region"),
        pytest.param(
            NewtonMpc(
                **QUASI, input_rate_limits={"u_v": 6.0}, soft_limits={"alpha_v": (-0.9, 0.4)}
            ),
            MODEL,
            id="region-limits",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            NewtonMpc(**QUASI, max_iterations=1), DELAYED, id="region-delay", marks=pytest.mark.slow
        ),
        pytest.param(NewtonMpc(terminal="none"), HORIZONTAL, id="none"),
        pytest.param(
            NewtonMpc(preview_horizon=6, disturbance_compensation=False), MODEL, id="preview"
        ),
        pytest.param(LinearMpc(), MODEL, id="linear"),
        pytest.param(
            LinearMpc(
                linearisation="target",
                input_rate_limits={"u_h": 6.0},
                soft_limits={"alpha_h": (-0.3, 0.1)},
                prediction_horizon=12,
                move_blocks=(1, 1, 2, 4, 4),
            ),
            HORIZONTAL,
            id="linear-target-limits",
        ),
        pytest.param(
            LinearMpc(linearisation="fixed", terminal="none", preview_horizon=6),
            HORIZONTAL,
            id="linear-fixed-preview",
        ),
        pytest.param(LinearMpc(), DELAYED, id="linear-delay", marks=pytest.mark.slow),
        pytest.param(
            LinearMpc(input_rate_limits={"u_v": 6.0}, soft_limits={"alpha_v": (-0.9, 0.2)}),
            MODEL,
            id="linear-limits",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_it_answers_as_numpy_does(mpc: Law, model: Model) -> None:
    for ours, theirs in both(mpc, model):
        assert np.abs(ours.u - theirs.u).max() <= EQUAL
        assert (ours.status, ours.iterations) == (theirs.status, theirs.iterations)
        assert (ours.message, ours.out_of_reach) == (theirs.message, theirs.out_of_reach)
        for name in ("objective", "slack", "terminal_residual"):
            expected = pytest.approx(getattr(theirs, name), rel=1e-6, abs=1e-8, nan_ok=True)
            assert getattr(ours, name) == expected
        assert ours.prediction is not None and theirs.prediction is not None
        for name in ("time", "states", "inputs"):
            shown, expected = (getattr(a.prediction, name) for a in (ours, theirs))
            np.testing.assert_allclose(shown, expected, rtol=1e-6, atol=1e-5)
        assert 0.0 < ours.linearise_time < 1.0 and 0.0 < ours.qp_time < 1.0


@needs_compiler
def test_a_plan_that_sees_no_way_starts_anew_in_c_too() -> None:
    """From rest, with a plan at rest, to a new reference: the tail rotor has no thrust slope."""
    mpc = NewtonMpc(terminal="none", forecast_horizon=0, move_weights={"u_h": 0.2})
    engine, state = pair(mpc, HORIZONTAL)
    for goal in (0.0, 0.0, 0.4):
        sample = sample_of(HORIZONTAL, [goal])
        ours = engine.step(sample, want_prediction=False)
        theirs = state.step(sample, want_prediction=False)
        assert ours.u == pytest.approx(theirs.u, abs=EQUAL)
        assert ours.iterations == theirs.iterations
    assert abs(ours.u[0]) > 0.1


@needs_compiler
def test_tunings_of_one_structure_share_what_is_compiled(caplog: pytest.LogCaptureFixture) -> None:
    """Weights, limits, prices and parameters are settings; none of them is compiled in."""
    rig = Newtonian(parameters={"k_fvp": 1.4e-5, "l_cb": 0.265, "k_chp": 0.02})
    heavy = NewtonMpc(move_weights={"u_v": 0.3, "u_h": 0.4}, terminal_linear=50.0, fallback="hold")
    NewtonMpc().init(setup_of(MODEL))
    with caplog.at_level(logging.INFO):
        first, second = heavy.init(setup_of(rig)), NewtonMpc().init(setup_of(MODEL))
    assert not [record for record in caplog.records if "compiled" in record.message]
    sample = sample_of(rig, [0.2, 0.4])
    a, b = (e.step(sample, want_prediction=False).u for e in (first, second))
    assert np.abs(a - b).max() > 1e-3
    alone = NewtonMpcState(heavy, setup_of(rig)).step(sample, want_prediction=False)
    assert a == pytest.approx(alone.u, abs=EQUAL)


@pytest.mark.slow
@needs_compiler
def test_the_first_use_says_how_long_it_took(tmp_path, monkeypatch, caplog) -> None:
    monkeypatch.setenv("TRMS_CACHE", str(tmp_path))
    with caplog.at_level(logging.INFO):
        NewtonMpc(prediction_horizon=4).init(setup_of(MODEL))
        NewtonMpc(prediction_horizon=4).init(setup_of(MODEL))
    assert len([r for r in caplog.records if "newton_mpc: compiled" in r.getMessage()]) == 1


@needs_compiler
@pytest.mark.parametrize("law", [NewtonMpc, LinearMpc])
@pytest.mark.parametrize("policy", ["shifted_plan", "hold", "steady_input"])
def test_it_falls_back_as_numpy_does(policy: Any, law: Any) -> None:
    engine, state = pair(law(fallback=policy), MODEL)
    good = sample_of(MODEL, [0.2, 0.4])
    bad = sample_of(MODEL, [0.2, np.nan])
    for sample in (bad, good, good, bad):
        ours = engine.step(sample, want_prediction=True)
        theirs = state.step(sample, want_prediction=True)
        assert ours.u == pytest.approx(theirs.u, abs=EQUAL)
        assert (ours.status, ours.fallback, ours.message) == (
            theirs.status,
            theirs.fallback,
            theirs.message,
        )
    assert ours.status is Status.FAILED and ours.prediction is None


@needs_compiler
@pytest.mark.parametrize("law", [NewtonMpc, LinearMpc])
def test_stop_ends_the_run(law: Any) -> None:
    engine, _ = pair(law(fallback="stop"), MODEL)
    engine.step(sample_of(MODEL, [0.2, 0.4]), want_prediction=False)
    with pytest.raises(SimulationError, match=f"(?s){engine.problem.name}.*not finite"):
        engine.step(sample_of(MODEL, [0.2, np.nan]), want_prediction=False)


@needs_compiler
@pytest.mark.parametrize("way", ["current", "target"])
def test_a_linear_model_without_effect_of_an_input_is_replaced_in_c_too(way: Any) -> None:
    """At yaw 0 the tail rotor of the target stands still: the operating point stands in."""
    engine, state = pair(LinearMpc(linearisation=way), HORIZONTAL)
    assert isinstance(state, LinearMpcState)
    for goal in (0.0, 0.4, 0.0):
        sample = sample_of(HORIZONTAL, [goal], state_with(HORIZONTAL, alpha_h=0.2))
        ours = engine.step(sample, want_prediction=False)
        theirs = state.step(sample, want_prediction=False)
        assert ours.u == pytest.approx(theirs.u, abs=EQUAL)
        A = state.newton.horizon.arguments["p"][: state.problem.A.size]
        is_operating = np.array_equal(A, state.problem.A.ravel())
        assert is_operating == (way == "current" or goal == 0.0)


@pytest.mark.parametrize(
    ("law", "kind"), [(NewtonMpc, NewtonMpcState), (LinearMpc, LinearMpcState)]
)
def test_without_a_compiler_and_with_another_solver_numpy_acts(law, kind, monkeypatch) -> None:
    assert isinstance(law(qp=Daqp()).init(setup_of(MODEL)), kind)
    monkeypatch.setattr("trms_cli.core.compilation.compiler", lambda: None)
    state = law().init(setup_of(MODEL))
    assert isinstance(state, kind)
    other = replace(law(), qp=Daqp()).init(setup_of(MODEL))
    sample = sample_of(MODEL, [0.2, 0.4])
    commands = [s.step(sample, want_prediction=False).u for s in (state, other)]
    assert (commands[0] == commands[1]).all()


@needs_compiler
def test_iterations_end_where_the_next_would_move_no_input_by_a_tenth_of_the_tolerance() -> None:
    laws = NewtonMpc(max_iterations=50), NewtonMpc(tolerance=1e-9, max_iterations=50)
    engines = [law.init(setup_of(MODEL, law.sample_time)) for law in laws]
    step, u = BufferedFunction(discretise(MODEL, laws[0].sample_time, 5).step), np.zeros(2)
    x, draw = MODEL.rest(), np.random.default_rng(0)
    iterations, apart = [], []
    for _ in range(100):
        w = 1e-4 * draw.standard_normal(MODEL.n_w)
        sample = ControlSample(0.0, np.array([[0.2, 0.3]]), Estimate(x, 0 * x, w, 0 * w), u)
        near, exact = (
            law.step(engine, sample, want_prediction=False)
            for law, engine in zip(laws, engines, strict=True)
        )
        apart.append(np.abs(near.u - exact.u).max())
        iterations.append((near.iterations, exact.iterations))
        u = near.u
        x = step.evaluate(x, u, MODEL.parameters.values, np.zeros(MODEL.n_w))[0].copy()
    settled = slice(30, None)  # before, iterations shrink too slowly for that to be told
    assert np.median(iterations[settled], axis=0).tolist() == [2, 4]
    assert max(apart[settled]) < 0.1 * laws[0].tolerance


@pytest.mark.parametrize("qp", [pytest.param(Riccati(), marks=needs_compiler), Daqp()])
def test_a_plan_against_its_bounds_teaches_nothing_about_the_convergence_later(qp: Any) -> None:
    short: dict[str, Any] = {"terminal": "none", "prediction_horizon": 4, "move_blocks": [1] * 4}
    law = NewtonMpc(qp=qp, max_iterations=20, **short)
    exact_law = replace(law, tolerance=1e-9, max_iterations=50)
    engine, exact = (each.init(setup_of(MODEL, each.sample_time)) for each in (law, exact_law))
    step = BufferedFunction(discretise(MODEL, law.sample_time, 5).step)
    x, u = MODEL.rest(), np.zeros(2)
    for k in range(20):
        # far away first: the plan lies against its bounds, and a second step moves nothing at all
        sample = sample_of(MODEL, [30.0, 30.0] if k < 3 else [0.2, 0.3], x, u)
        near = law.step(engine, sample, want_prediction=False)
        answer = exact_law.step(exact, sample, want_prediction=False)
        assert near.u == pytest.approx(answer.u, abs=10 * law.tolerance)
        assert k != 3 or 1 < near.iterations < answer.iterations
        u = near.u
        x = step.evaluate(x, u, MODEL.parameters.values, np.zeros(MODEL.n_w))[0].copy()
