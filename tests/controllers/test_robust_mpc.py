"""Robust MPC in the loop on the nonlinear plant: online and looked up."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from trms_cli.controllers.controller import ControlSample, Status
from trms_cli.controllers.robust_mpc import RobustMpc
from trms_cli.controllers.robust_mpc_offline import Family, RobustMpcOffline, RobustMpcOfflineState
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.feedback_manual import FeedbackManual
from trms_cli.models.newtonian import Newtonian

from .closed_loop_case import close_loop, constant, sample_of, setup_of, state_with

WEIGHTS: dict[str, Any] = {
    "state_weights": {"alpha_v": 1.2, "alpha_h": 1.0},
    "rate_weights": {"alpha_v": 0.73, "alpha_h": 0.36},
    "input_weights": {"u_v": 0.05, "u_h": 0.02},
}
ONLINE = partial(RobustMpc, **WEIGHTS)
OFFLINE = RobustMpcOffline(
    **WEIGHTS,
    widest={"alpha_v": 0.5, "alpha_h": 1.0},
    targets={"alpha_v": 0.3, "alpha_h": 0.5},
    principal_components=3,
)
BOTH = Newtonian()
STILL = constant(0.0, 0.0)
STARTS = [(1.2, 0.65), (-0.65, -0.35), (-1.27, -0.47), (0.64, 0.43)]


def sample_at(x: np.ndarray) -> ControlSample:
    return sample_of(BOTH, [0.0, 0.0], x)


def started(yaw: float, pitch: float) -> np.ndarray:
    return state_with(BOTH, alpha_h=yaw, alpha_v=pitch)


@pytest.fixture(scope="module")
def offline() -> RobustMpcOfflineState:
    return OFFLINE.init(setup_of(BOTH))


class TestOnline:
    def test_a_start_from_rest_is_regulated(self) -> None:
        controller = ONLINE(redesign_below=0.8)
        ran = close_loop(controller, BOTH, STILL, 7.0, x0=started(-0.65, -0.35))
        assert np.all(np.abs(ran.angles[-15:]) < [0.02, 0.05])
        assert sum(command.status is Status.FAILED for command in ran.commands) <= 3

    def test_a_known_torque_leaves_no_error(self) -> None:
        ran = close_loop(
            OFFLINE, BOTH, constant(0.1, 0.3), 25.0,
            torque=lambda time: [0.004, 0.003, 0.0, 0.0], known=True,
        )  # fmt: skip
        assert np.all(np.abs(ran.errors[-1]) < [2e-3, 5e-3])

    def test_a_certified_law_acts_and_is_printed(self) -> None:
        state = ONLINE().init(setup_of(BOTH))
        target = state.regulation.aim_at(np.zeros(2)).steady.x
        near = target.copy()
        near[BOTH.state_index("alpha_h")] += 0.2
        command = ONLINE().step(state, sample_at(near), want_prediction=False)
        assert command.status is Status.OK and command.objective > 0
        assert state.law is not None
        held = state.law.certificate
        assert held.stable and held.constrained and "decrease holds" in str(held)

    def test_the_last_law_acts_where_none_is_found(self, monkeypatch) -> None:
        controller = ONLINE()
        state = controller.init(setup_of(BOTH))
        x = state.regulation.aim_at(np.zeros(2)).steady.x + 0.0
        x[BOTH.state_index("alpha_h")] += 0.2
        sample = sample_at(x)
        first = controller.step(state, sample, want_prediction=False)
        monkeypatch.setattr(state.inequalities, "solve", lambda task: None)
        again = controller.step(state, sample, want_prediction=False)
        assert again.status is Status.FAILED and again.fallback == "last_law"
        np.testing.assert_allclose(again.u, first.u)
        state.law = None
        third = controller.step(state, sample, want_prediction=False)
        assert third.fallback == "steady_input" and np.isfinite(third.u).all()

    def test_a_law_whose_certificate_fails_does_not_act(self, monkeypatch) -> None:
        controller = ONLINE()
        state = controller.init(setup_of(BOTH))
        solve = state.inequalities.solve

        def spoilt(task):
            solution = solve(task)
            return replace(solution, K=-10 * solution.K)

        monkeypatch.setattr(state.inequalities, "solve", spoilt)
        x = state.regulation.aim_at(np.zeros(2)).steady.x.copy()
        x[BOTH.state_index("alpha_v")] += 0.2
        command = controller.step(state, sample_at(x), want_prediction=False)
        assert command.status is Status.FAILED and state.law is None
        assert "certificate" in command.message

    def test_a_model_without_a_law_is_refused(self) -> None:
        """Its Coulomb friction has coefficients without bound near rest."""
        with pytest.raises(ConfigurationError, match="no law"):
            ONLINE().init(setup_of(FeedbackManual()))

    @pytest.mark.slow
    @pytest.mark.parametrize("start", STARTS)
    def test_the_four_starts(self, start: tuple[float, float]) -> None:
        ran = close_loop(ONLINE(), BOTH, STILL, 14.0, x0=started(*start))
        assert np.abs(ran.angles[-20:]).max() < 0.03

    @pytest.mark.slow
    def test_a_matrix_for_each_vertex(self) -> None:
        controller = ONLINE(lyapunov="parameter_dependent")
        ran = close_loop(controller, BOTH, STILL, 8.0, x0=started(-0.65, -0.35))
        assert np.abs(ran.angles[-10:]).max() < 0.05


class TestOffline:
    @pytest.mark.parametrize("start", STARTS)
    def test_the_four_starts(self, start: tuple[float, float]) -> None:
        ran = close_loop(OFFLINE, BOTH, STILL, 16.0, x0=started(*start))
        assert np.abs(ran.angles[-20:]).max() < 0.03
        assert {c.status for c in ran.commands} <= {Status.OK, Status.RELAXED}
        assert ran.commands[-1].status is Status.OK

    def test_ellipsoids_lie_within_each_other(self, offline: RobustMpcOfflineState) -> None:
        inverses = offline.family.inverses
        assert len(inverses) >= 8
        for outer, inner in itertools.pairwise(inverses):
            assert np.linalg.eigvalsh(inner - outer).min() > -1e-6 * np.abs(inner).max()

    def test_a_lookup_finds_the_smallest_ellipsoid(self, offline: RobustMpcOfflineState) -> None:
        family = offline.family
        random = np.random.default_rng(2)
        for _ in range(200):
            z = random.normal(size=6) * 10 ** random.uniform(-3, 0)
            _, ring, level = family.gain(z)
            holds = [i for i, P in enumerate(family.inverses) if z @ P @ z <= 1]
            assert ring == (holds[-1] if holds else -1)
            assert level == pytest.approx(z @ family.inverses[max(ring, 0)] @ z)

    def test_at_a_border_the_law_is_that_of_the_border(
        self, offline: RobustMpcOfflineState
    ) -> None:
        family = offline.family
        z = np.random.default_rng(0).normal(size=6)
        blended = np.flatnonzero(family.blends)
        assert blended.size
        for ring in blended:
            P = family.inverses[ring]
            at = z / np.sqrt(z @ P @ z) * (1 - 1e-9)
            K, found, _ = family.gain(at)
            assert found == ring
            np.testing.assert_allclose(K, family.gains[ring], rtol=1e-5, atol=1e-5)
            P = family.inverses[ring + 1]
            just_outside = z / np.sqrt(z @ P @ z) * (1 + 1e-9)
            K, found, _ = family.gain(just_outside)
            if found == ring:
                np.testing.assert_allclose(K, family.gains[ring + 1], rtol=1e-4, atol=1e-4)

    def test_in_its_ellipsoids_the_level_falls_on_the_nonlinear_plant(self) -> None:
        controller = OFFLINE
        setup = setup_of(BOTH)
        state = controller.init(setup)
        aim = state.regulation.aim_at(np.zeros(2))
        random = np.random.default_rng(5)
        for _ in range(4):
            z = random.normal(size=6)
            z *= 0.5 / np.sqrt(z @ state.family.inverses[0] @ z)
            x0 = _state_at(state, aim.target.z + z * state.regulation.scale_z)
            ran = close_loop(controller, BOTH, STILL, 4.0, x0=x0)
            rings, outer = [], []
            for x in ran.states:
                z = state.regulation.deviation(x, aim.target)
                rings.append(state.family.gain(z)[1])
                outer.append(float(z @ state.family.inverses[0] @ z))
            assert rings[0] >= 0 and max(outer) <= 1.0  # never leaves the outermost
            assert rings[-1] > rings[0]

    def test_less_room_for_the_inputs_shrinks_the_ellipsoids(self, offline) -> None:
        family: Family = offline.family
        assert family.share(family.input_bounds) == 1.0
        assert family.share(family.input_bounds * np.array([0.5, 1.0])) == pytest.approx(0.5)

    def test_a_step_is_fast(self, offline: RobustMpcOfflineState) -> None:
        from time import process_time

        sample = sample_at(started(0.3, 0.1))
        times = []
        for k in range(300):
            sample.estimate.disturbance = np.array([1e-7 * k, 0.0, 0.0, 0.0])
            begin = process_time()
            OFFLINE.step(offline, sample, want_prediction=False)
            times.append(process_time() - begin)
        assert np.median(times) < 200e-6  # 100 µs on a quiet machine


def _state_at(state: RobustMpcOfflineState, z: np.ndarray) -> np.ndarray:
    """x of coordinates, by Newton's method on the forward map."""
    coordinates = state.regulation.coordinates
    x = state.regulation.aim_at(np.zeros(2)).steady.x.copy()
    x[0] = coordinates.speed_of(z[:1])[0]
    for _ in range(20):
        error = coordinates.forward(x) - z
        error[0] = 0.0
        x -= error
    np.testing.assert_allclose(coordinates.forward(x), z, atol=1e-6 * np.abs(z).max())
    return x
