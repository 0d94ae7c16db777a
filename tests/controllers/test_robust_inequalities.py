"""The inequalities of robust MPC and their certificate, on small random polytopes."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

from experiments.chapter8.judgement import decrease_on
from trms_cli.controllers.robust.lmi import (
    Inequalities,
    LmiSolution,
    Lyapunov,
    Task,
    certify,
)

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


def test_the_problem_is_parametrised_once_and_the_size_of_the_state_does_not_matter() -> None:
    for lyapunov in ("common", "parameter_dependent"):
        assert inequalities(2, lyapunov).problem.is_dcp(dpp=True)
    task = task_of(5, 2, 0.03)
    large, small = (inequalities(2).solve(replace(task, z=s * task.z)) for s in (1.0, 1e-3))
    assert large is not None and small is not None
    assert small.gamma == pytest.approx(1e-6 * large.gamma, rel=1e-3)
    np.testing.assert_allclose(small.K, large.K, rtol=0.05, atol=0.02)


def test_decrease_elsewhere_is_that_of_the_certificate_at_the_vertices() -> None:
    task = task_of(7, 3, 0.05)
    solution = inequalities(3).solve(task)
    assert isinstance(solution, LmiSolution)
    contraction, slack = decrease_on(np.concatenate([task.A, task.B], axis=2), solution, task)
    held = certify(task, solution)
    assert contraction.max() == pytest.approx(held.contraction)
    np.testing.assert_allclose(slack, held.residuals[:, 0], atol=1e-9)
