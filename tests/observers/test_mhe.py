"""The moving-horizon estimator: its bounds, its two ways to solve, and what stands in."""

from __future__ import annotations

import numpy as np
import pytest

from trms_cli.core.qp import Daqp, QpResult
from trms_cli.models.model import names
from trms_cli.models.newtonian import Newtonian
from trms_cli.observers import mhe
from trms_cli.observers.ekf import Ekf
from trms_cli.observers.mhe import Mhe, solve_bounded
from trms_cli.observers.observer import ObserverSetup

from .observed_rigs import NOISE_SD, SAMPLE_TIME, Pendulum, Rig, commands, followed, setup_for


def test_the_two_ways_to_solve_a_step_are_one_problem() -> None:
    """Without active bounds the quadratic program gives the smoother's trajectory."""
    model = Newtonian()
    observer = Mhe(horizon=0.16, within_stops=False)
    state, rig = observer.init(setup_for(model)), Rig(model, names(model.outputs))
    lost = range(25, 29)
    for _ in followed(observer, state, rig, commands(31), lost=lost):
        pass
    state.function()
    rows = np.array([2, 5])
    wide = np.array([10.0, 10.0])
    qp, centre, slopes = solve_bounded(state.inputs, state.outputs, rows, -wide, wide)
    result = Daqp().solve(Daqp().start(), qp)
    assert result.solved
    dense, smooth = centre + (slopes @ result.z).T, state.outputs["smoothed"]
    scale = state.augmented.sd[:, None]
    np.testing.assert_allclose(dense / scale, smooth / scale, rtol=0, atol=1e-7)


def test_bounds_are_kept_and_used() -> None:
    """A torque that is known to push one way only: the estimate knows it too, and is better."""
    model = Pendulum()
    setup = ObserverSetup(
        model, SAMPLE_TIME, ("angle", "speed"), {"angle": 0.02, "speed": 0.1}, np.zeros(2),
        np.zeros(1),
    )  # fmt: skip
    told = {"disturbances": ("moment",)}
    bounds = {"moment": (0.0, 0.01)}
    free, within = Mhe(**told), Mhe(bounds=bounds, **told)
    estimates: dict[bool, np.ndarray] = {}
    for observer in (free, within):
        state, random = observer.init(setup), np.random.default_rng(2)
        rows = []
        for _ in range(300):
            y = np.array([0.02, 0.1]) * random.standard_normal(2)
            rows.append(observer.step(state, np.zeros(1), y, None).disturbance[0])
        estimates[observer is within] = np.array(rows)
        assert (state.bounded > 10) == (observer is within)
        assert state.fallbacks == 0
    assert estimates[False].min() < 0.0
    assert estimates[True].min() >= 0.0
    assert estimates[True].max() <= 0.01
    assert np.std(estimates[True]) < np.std(estimates[False])


def test_a_rig_at_its_stop_is_not_estimated_beyond_it() -> None:
    model = Newtonian(freedom="horizontal")
    stop = model.stops["alpha_h"]
    outputs = names(model.outputs)
    setup = ObserverSetup(
        model, SAMPLE_TIME, outputs, NOISE_SD, np.array([stop, 100.0]), np.array([2.0])
    )
    beyond = {}
    for observer in (Ekf(), Mhe()):
        state, random = observer.init(setup), np.random.default_rng(1)
        angles = []
        for _ in range(100):
            y = np.array([stop, 100.0]) + 5e-4 * random.standard_normal(2)
            angles.append(observer.step(state, np.array([2.0]), y, None).x[-1])
        beyond[type(observer)] = max(angles) - stop
    assert beyond[Ekf] > 1e-4
    assert beyond[Mhe] <= 0.0


def test_the_arrival_filter_stands_in_where_a_problem_is_not_solved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Every program fails: the estimate is the filter's, cut to the bounds, and counted."""
    monkeypatch.setattr(
        mhe.Daqp, "solve", lambda self, workspace, qp: QpResult(qp.gradient, False, 0, "no")
    )
    model = Newtonian()
    observer = Mhe(bounds={"yaw_moment": (0.004, 0.006)})
    state, rig = observer.init(setup_for(model)), Rig(model, names(model.outputs))
    for k, estimate in followed(observer, state, rig, commands(200)):
        assert 0.004 <= estimate.disturbance[1] <= 0.006
        assert np.all(np.isfinite(estimate.x))
        if k > 50:
            assert abs(estimate.x[2] - rig.x[2]) < 0.05
    assert state.fallbacks > 100


def test_it_is_no_worse_than_its_arrival_filter() -> None:
    """Far from where both start, without tachos, where the models bend most."""
    model, channels, errors = Newtonian(), ("alpha_v", "alpha_h"), {}
    for observer in (Ekf(), Mhe(within_stops=False, iterations=2, arrival="ekf")):
        squares = []
        for seed in range(4):
            rig = Rig(model, channels, seed)
            state = observer.init(setup_for(model, channels))
            rig.x = rig.x + np.array([60.0, 0.3, 0.0, -60.0, -0.3, 0.0])
            for k, estimate in followed(observer, state, rig, commands(250)):
                if k >= 20:
                    squares.append((estimate.x - rig.x)[[0, 1, 3, 4]] ** 2)
        errors[type(observer)] = np.sqrt(np.mean(squares, axis=0))
    assert np.all(errors[Mhe] < 1.05 * errors[Ekf])
