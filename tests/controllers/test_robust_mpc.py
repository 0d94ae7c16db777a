"""Robust MPC in the loop on the nonlinear plant: online and looked up. Its coordinates, demands of
thrust and polytopes, against the nonlinear step itself. Its inequalities and their certificate, on
small random polytopes.
"""

import functools
import itertools
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

from experiments.chapter8.judgement import are_inside, decrease_on, independent_cube, remainder
from trms_cli.controllers.controller import ControlSample, Status
from trms_cli.controllers.robust.lmi import (
    Inequalities,
    LmiSolution,
    Lyapunov,
    Task,
    certify,
)
from trms_cli.controllers.robust.polytope import box
from trms_cli.controllers.robust.regulation import Regulation, RegulationDesign
from trms_cli.controllers.robust_mpc import RobustMpc
from trms_cli.controllers.robust_mpc_offline import Family, RobustMpcOffline, RobustMpcOfflineState
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.feedback_manual import FeedbackManual
from trms_cli.models.model import Model
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


def started(yaw: float, pitch: float) -> np.ndarray:
    return state_with(BOTH, alpha_h=yaw, alpha_v=pitch)


def beside_target(state: Any, angle: str) -> ControlSample:
    """At rest at the target, but for an angle of 0.2 rad."""
    x = state.regulation.aim_at(np.zeros(2)).steady.x.copy()
    x[BOTH.state_index(angle)] += 0.2
    return sample_of(BOTH, [0.0, 0.0], x)


@pytest.fixture(scope="module")
def offline() -> RobustMpcOfflineState:
    return OFFLINE.init(setup_of(BOTH))


class TestOnline:
    @pytest.mark.slow
    def test_a_start_from_rest_is_regulated_and_a_known_torque_leaves_no_error(self) -> None:
        controller = ONLINE(redesign_below=0.8)
        ran = close_loop(controller, BOTH, STILL, 7.0, x0=started(-0.65, -0.35))
        assert np.all(np.abs(ran.angles[-15:]) < [0.02, 0.05])
        assert sum(command.status is Status.FAILED for command in ran.commands) <= 3
        ran = close_loop(
            OFFLINE, BOTH, constant(0.1, 0.3), 25.0,
            torque=lambda time: [0.004, 0.003, 0.0, 0.0], known=True,
        )  # fmt: skip
        assert np.all(np.abs(ran.errors[-1]) < [2e-3, 5e-3])

    def test_a_certified_law_acts_and_the_last_one_where_none_is_found(self, monkeypatch) -> None:
        controller = ONLINE()
        state = controller.init(setup_of(BOTH))
        sample = beside_target(state, "alpha_h")
        first = controller.step(state, sample, want_prediction=False)
        assert first.status is Status.OK and first.objective > 0
        assert state.law is not None
        held = state.law.certificate
        assert held.stable and held.constrained and "decrease holds" in str(held)
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
        sample = beside_target(state, "alpha_v")
        command = controller.step(state, sample, want_prediction=False)
        assert command.status is Status.FAILED and state.law is None
        assert "certificate" in command.message

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

    def test_ellipsoids_lie_within_each_other_and_the_smallest_is_found(
        self, offline: RobustMpcOfflineState
    ) -> None:
        family: Family = offline.family
        inverses = family.inverses
        assert len(inverses) >= 8
        for outer, inner in itertools.pairwise(inverses):
            assert np.linalg.eigvalsh(inner - outer).min() > -1e-6 * np.abs(inner).max()
        random = np.random.default_rng(2)
        for _ in range(200):
            z = random.normal(size=6) * 10 ** random.uniform(-3, 0)
            _, ring, level = family.gain(z)
            holds = [i for i, P in enumerate(family.inverses) if z @ P @ z <= 1]
            assert ring == (holds[-1] if holds else -1)
            assert level == pytest.approx(z @ family.inverses[max(ring, 0)] @ z)
        # Less room for the inputs shrinks them.
        assert family.share(family.input_bounds) == 1.0
        assert family.share(family.input_bounds * np.array([0.5, 1.0])) == pytest.approx(0.5)

    def test_at_a_border_the_law_is_that_of_the_border(self, offline) -> None:
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

    def test_a_step_is_fast(self, offline: RobustMpcOfflineState) -> None:
        from time import process_time

        sample = sample_of(BOTH, [0.0, 0.0], started(0.3, 0.1))
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


def regulation_of(model: Model = BOTH, **design: object) -> Regulation:
    return Regulation(RegulationDesign(**design), setup_of(model))


@pytest.fixture(scope="module")
def regulation() -> Regulation:
    return regulation_of()


class TestCoordinates:
    def test_the_step_is_the_models_own_and_a_target_stays(self, regulation: Regulation) -> None:
        coordinates = regulation.coordinates
        step = BufferedFunction(coordinates.step)
        plain = BufferedFunction(coordinates.discrete.step)
        w = np.array([0.002, -0.001, 1e-4, -1e-4])
        width = np.tile([200.0, 1.0, 0.9], 2)  # of speed, momentum and angle of either axis
        for x in width * np.random.default_rng(0).uniform(-1, 1, (20, 6)):
            z = coordinates.forward(x)
            v = np.array([1.3, 0.8 * z[0] + 3000.0])
            u = coordinates.command(x, v, w)
            after = plain.evaluate(x, u, BOTH.parameters.values, w)[0]
            assert coordinates.psi_of(after[:1])[0] == pytest.approx(v[1], abs=0.5)
            found = step.evaluate(z, v, w)[0]
            np.testing.assert_allclose(found, coordinates.forward(after), rtol=1e-5, atol=1e-6)
        for reference in ([0.0, 0.0], [0.3, -0.5], [-0.4, 1.0]):
            target = regulation.aim_at(np.array(reference)).target
            after = step.evaluate(target.z, target.v, target.w)[0]
            np.testing.assert_allclose(after, target.z, rtol=1e-6, atol=1e-5)

    def test_the_yaw_is_driven_where_its_rotor_stands_still(self, regulation: Regulation) -> None:
        """In the speed the gain vanishes at standstill; in the thrust it does not."""
        small = regulation.angles(np.full(2, 0.05))
        gains = {}
        for key, one in (("thrust", regulation), ("speed", regulation_of(thrust_inputs=()))):
            aim = one.aim_at(np.zeros(2))
            region = one.region_of(aim.target, np.abs(small) + 0.02)
            coefficients = one.coefficients.over(aim.target, region)
            row = one.coordinates.names.index("dalpha_h")
            gains[key] = coefficients[:, row, 0] / np.abs(coefficients[:, row, 0]).max()
        assert gains["thrust"].min() > 0.6
        assert gains["speed"].min() < 0.1

    def test_fast_states_are_left_out_and_one_axis_suffices(self) -> None:
        full = regulation_of(Newtonian(currents="dynamic"))
        assert full.n == 6 and not any(name.startswith("i_") for name in full.coordinates.names)
        for freedom in ("vertical", "horizontal"):
            one = regulation_of(Newtonian(freedom=freedom))
            assert (one.n, one.m) == (3, 1)
            assert bool(one.demands) == (freedom == "horizontal")

    def test_memory_unknown_names_and_a_model_without_a_law_are_refused(self) -> None:
        with pytest.raises(ConfigurationError, match="memory"):
            regulation_of(extend_model(BOTH, {"late": InputDelay(rotor="main", delay=0.1)}))
        with pytest.raises(ConfigurationError, match="u_x"):
            regulation_of(thrust_inputs=("u_x",))
        with pytest.raises(ConfigurationError, match="alpha_x"):
            regulation_of(state_weights={"alpha_x": 1.0})
        # Its Coulomb friction has coefficients without bound near rest.
        with pytest.raises(ConfigurationError, match="no law"):
            ONLINE().init(setup_of(FeedbackManual()))


class TestDemand:
    def test_every_demand_within_its_bound_is_within_the_limits(self, regulation) -> None:
        (demand,) = regulation.demands
        random = np.random.default_rng(1)
        reach = regulation.coordinates.speed_of(np.array([demand.largest]))[0]
        largest = 0.0
        for psi_s in (0.0, 15_000.0, -15_000.0):
            bound = demand.bound(psi_s)
            assert 0 < bound <= demand.scale
            for omega in random.uniform(-0.99, 0.99, 60) * reach:
                x = BOTH.rest()
                x[0] = omega
                psi = regulation.coordinates.psi_of(np.array([omega]))[0]
                for nu in (-bound, bound):
                    v = np.array([0.0, psi_s + demand.pole * (psi - psi_s) + nu])
                    u = regulation.coordinates.command(x, v, np.zeros(4))[1]
                    largest = max(largest, abs(u))
        assert largest <= 2.5 * 1.001
        assert largest > 2.0  # the bound is not idle


class TestPolytope:
    def test_coefficients_give_the_step_exactly(self, regulation: Regulation) -> None:
        aim = regulation.aim_at(np.array([0.1, 0.4]))
        region = regulation.region_of(aim.target, np.full(6, 0.4))
        cube = independent_cube(400, 8, seed=3)
        residual = regulation.coefficients.residual(aim.target, region, cube)
        assert np.median(np.abs(residual)) < 1e-4
        # Rays that cross a standing tail rotor leave something, in yaw and pitch, where
        # the speed has next to no slope in the thrust.
        assert np.abs(residual).max() < 0.02
        across = np.abs(residual).max(axis=1) > 1e-3
        assert across.any()

    def test_other_points_are_inside_and_a_smaller_region_has_a_smaller_polytope(
        self, regulation: Regulation
    ) -> None:
        aim = regulation.aim_at(np.zeros(2))
        region = regulation.region_of(aim.target, np.full(6, 0.4))
        coefficients = regulation.coefficients.over(aim.target, region)
        others = regulation.coefficients.over(aim.target, region, independent_cube(4000, 8, seed=4))
        for components in (2, 3):
            polytope = box(coefficients, components, 0.05)
            assert polytope.vertices == 2**components
            assert are_inside(polytope, others).mean() > 0.99
        tighter = [remainder(box(coefficients, k, 0.05), others).max() for k in (1, 3, 5)]
        assert tighter == sorted(tighter, reverse=True)
        flat = np.concatenate([polytope.A, polytope.B], axis=2)
        assert remainder(polytope, flat).max() < 1e-9  # its own vertices
        spreads = []
        for size in (1.0, 0.3, 0.1):
            region = regulation.region_of(aim.target, np.full(6, size))
            spreads.append(np.ptp(regulation.coefficients.over(aim.target, region), axis=0).max())
        assert spreads == sorted(spreads, reverse=True)
        assert spreads[-1] < 0.6 * spreads[0]


N, M = 2, 1
FREE = np.full(N, np.inf)


@functools.cache
def inequalities(
    vertices: int, lyapunov: Lyapunov = "common", *, soft: bool = True
) -> Inequalities:
    return Inequalities(N, M, N, vertices, (0,), lyapunov=lyapunov, soft=soft)


def task_of(seed: int, vertices: int, spread: float, growth: float = 1.05) -> Task:
    """A polytope around a model whose largest pole is ``growth``; always drivable."""
    random = np.random.default_rng(seed)
    A = random.normal(size=(N, N))
    A *= growth / np.abs(np.linalg.eigvals(A)).max()
    B = np.array([[0.3], [1.0]]) + 0.2 * random.normal(size=(N, M))
    return Task(
        A + spread * random.normal(size=(vertices, N, N)),
        B + spread * random.normal(size=(vertices, N, M)),
        np.eye(N),
        np.array([0.5]),
        random.normal(size=(1, N)),
        np.array([1e3]),
        FREE,
    )


def vertex_after(task: Task, K: np.ndarray, z: np.ndarray) -> np.ndarray:
    """All successors of z, (L, n)."""
    return (task.A + task.B @ K) @ z


seeds = st.integers(0, 10_000)
few = settings(max_examples=12, deadline=None, derandomize=True)


@given(seeds)
@few
def test_one_model_without_limits_is_the_linear_quadratic_regulator(seed: int) -> None:
    task = task_of(seed, 1, 0.0)
    solution = inequalities(1).solve(task)
    assert solution is not None
    A, B, R = task.A[0], task.B[0], np.diag(task.R)
    P = solve_discrete_are(A, B, task.C.T @ task.C, R)
    K = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    z = task.z[0]
    assert solution.gamma == pytest.approx(z @ P @ z, rel=2e-3)
    # One state fixes the gain in its own direction only.
    np.testing.assert_allclose(solution.K @ z, K @ z, rtol=0.02, atol=0.02 * np.linalg.norm(z))


@given(seeds, st.sampled_from(["common", "parameter_dependent"]))
@few
def test_a_solution_is_certified_and_a_worse_gain_is_not(seed: int, lyapunov: Lyapunov) -> None:
    task = task_of(seed, 2, 0.05, growth=0.98)
    solution = inequalities(2, lyapunov).solve(task)
    assume(solution is not None)  # a few have no common matrix at all
    held = certify(task, solution)
    assert held.stable and held.constrained and held.contraction < 1
    assert held.gamma == pytest.approx(held.claimed, rel=1e-2)
    assert "decrease holds" in str(held)
    spoilt = certify(task, replace(solution, K=solution.K + 3.0))
    assert not spoilt.stable and "FAILS" in str(spoilt)
    claimed = certify(task, replace(solution, gamma=0.6 * solution.gamma))
    assert not claimed.stable and claimed.residuals.min() < -1e-3


@given(seeds, st.sampled_from(["common", "parameter_dependent"]))
@few
def test_the_cost_to_go_falls_whatever_the_model_does(seed: int, lyapunov: Lyapunov) -> None:
    task = task_of(seed, 3, 0.05)
    solution = inequalities(3, lyapunov).solve(task)
    assume(solution is not None)  # a few have no common matrix at all
    P = solution.gamma * np.linalg.inv(solution.Q)
    own = np.arange(3) % len(P)
    stage = task.C.T @ task.C + solution.K.T * task.R @ solution.K
    random = np.random.default_rng(seed)
    for greedy in (True, False):
        z, j, spent = task.z[0], 0, 0.0
        for _ in range(40):
            now, cost = z @ P[own[j]] @ z, z @ stage @ z
            after = vertex_after(task, solution.K, z)[j]
            values = [after @ P[own[next_j]] @ after for next_j in range(3)]
            j = int(np.argmax(values)) if greedy else int(random.integers(3))
            assert values[j] <= now - cost + 1e-4 * (now + 1e-12)
            spent += cost
            z = after
        assert spent <= solution.gamma * 1.001
    # A model anywhere within the polytope, with the common matrix.
    if len(P) == 1:
        z = task.z[0]
        for _ in range(20):
            weights = random.dirichlet(np.ones(3))
            after = weights @ vertex_after(task, solution.K, z)
            assert after @ P[0] @ after <= z @ P[0] @ z - z @ stage @ z + 1e-4 * (z @ P[0] @ z)
            z = after


@given(seeds)
@few
def test_limits_are_kept_under_the_worst_switching(seed: int) -> None:
    free = task_of(seed, 2, 0.03, growth=0.98)
    unlimited = inequalities(2).solve(free)
    assert unlimited is not None
    z = free.z[0]
    largest = 0.7 * abs(float((unlimited.K @ z)[0]))
    bounds = np.array([max(largest, 1e-3)])
    task = replace(
        free, input_bounds=bounds, state_bounds=np.array([1.5 * np.abs(z).max() + 0.5, np.inf])
    )
    solution = inequalities(2).solve(task)
    assert solution is not None
    held = certify(task, solution)
    if not held.constrained:
        assert solution.slack > 1e-5  # said by the solver too
        return
    assert solution.gamma >= unlimited.gamma * (1 - 1e-3)
    P = np.linalg.inv(solution.Q[0])
    for _ in range(60):
        assert abs(float((solution.K @ z)[0])) <= bounds[0] * 1.001
        assert abs(z[0]) <= task.state_bounds[0] * 1.001
        after = vertex_after(task, solution.K, z)
        z = after[int(np.argmax(np.einsum("ka,ab,kb->k", after, P, after)))]


@given(seeds, st.floats(0.02, 0.15))
@few
def test_own_lyapunov_matrices_are_never_more_conservative(seed: int, spread: float) -> None:
    task = task_of(seed, 2, spread, growth=0.95)
    common, own = (inequalities(2, kind).solve(task) for kind in ("common", "parameter_dependent"))
    if common is None or not certify(task, common).stable:
        return
    assert own is not None
    assert own.gamma <= common.gamma * (1 + 1e-3)


def test_own_lyapunov_matrices_can_be_less_conservative() -> None:
    gains = []
    for seed in range(12):
        task = task_of(seed, 2, 0.25, growth=0.9)
        common, own = (
            inequalities(2, kind).solve(task) for kind in ("common", "parameter_dependent")
        )
        if common is not None and own is not None and certify(task, common).stable:
            gains.append(own.gamma / common.gamma)
    assert min(gains) < 0.99


def test_limits_that_cannot_be_kept_show_and_what_nothing_stabilises_is_not_certified() -> None:
    task = replace(task_of(3, 2, 0.02, growth=1.3), input_bounds=np.array([0.01]))
    solution = inequalities(2).solve(task)
    assert solution is not None and solution.slack > 0.1
    held = certify(task, solution)
    assert not held.constrained and held.inputs.max() > 1.05
    assert "NOT kept" in str(held)
    assert inequalities(2, soft=False).solve(task) is None
    task = task_of(0, 2, 0.0)
    A = np.diag([1.5, 0.5])[None].repeat(2, axis=0)
    hopeless = replace(task, A=A, B=np.array([[[1.0], [0.0]], [[-1.0], [0.0]]]))
    solution = inequalities(2).solve(hopeless)
    assert solution is None or not certify(hopeless, solution).stable


def test_the_problem_is_parametrised_once_and_its_decrease_is_that_of_the_certificate() -> None:
    for lyapunov in ("common", "parameter_dependent"):
        assert inequalities(2, lyapunov).problem.is_dcp(dpp=True)
    task = task_of(5, 2, 0.03)
    large, small = (inequalities(2).solve(replace(task, z=s * task.z)) for s in (1.0, 1e-3))
    assert large is not None and small is not None
    assert small.gamma == pytest.approx(1e-6 * large.gamma, rel=1e-3)
    np.testing.assert_allclose(small.K, large.K, rtol=0.05, atol=0.02)
    task = task_of(7, 3, 0.05)
    solution = inequalities(3).solve(task)
    assert isinstance(solution, LmiSolution)
    contraction, slack = decrease_on(np.concatenate([task.A, task.B], axis=2), solution, task)
    held = certify(task, solution)
    assert contraction.max() == pytest.approx(held.contraction)
    np.testing.assert_allclose(slack, held.residuals[:, 0], atol=1e-9)
