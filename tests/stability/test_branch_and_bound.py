"""Proofs over boxes: true claims are proved, false ones refuted, hard ones left open."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.stability.intervals.branch_and_bound import prove_negative


def of(expression: ca.SX, *symbols: ca.SX) -> ca.Function:
    return ca.Function("f", list(symbols), [expression])


X = ca.SX.sym("x", 2)


def test_a_true_claim_is_proved_up_to_its_edge() -> None:
    f = of(X[0] ** 2 + X[1] ** 2 - 2.001, X)
    proof = prove_negative(f, [-1.0, -1.0], [1.0, 1.0])
    assert proof.holds and len(proof.left.lower) == 0 and proof.point is None


def test_a_false_claim_gives_a_state_where_it_fails() -> None:
    f = of(X[0] ** 2 + X[1] ** 2 - 1.99, X)
    proof = prove_negative(f, [-1.0, -1.0], [1.0, 1.0])
    assert proof.status == "counterexample"
    assert proof.point is not None and proof.value is not None
    assert float(f(proof.point)) >= 0.0
    assert proof.value == pytest.approx(float(f(proof.point)), abs=1e-12)


def test_the_budget_ends_the_search_and_tells_what_is_left() -> None:
    f = of(2 * X[0] * X[1] - X[0] ** 2 - X[1] ** 2 - 1e-9, X)
    proof = prove_negative(f, [-1.0, -1.0], [1.0, 1.0], budget=300)
    assert proof.status == "undecided" and proof.examined <= 300
    assert len(proof.left.lower) > 0
    # The claim is hard along the diagonal: what is left lies near it.
    middle = proof.left.middle
    assert np.all(np.abs(middle[:, 0] - middle[:, 1]) < 0.5)


def test_all_rows_must_be_negative_and_given_values_are_used() -> None:
    c = ca.SX.sym("c")
    f = of(ca.vertcat(X[0] - c, X[1] - 2 * c), X, c)
    assert prove_negative(f, [0.0, 0.0], [1.0, 1.5], given=[1.01]).holds
    assert not prove_negative(f, [0.0, 0.0], [1.0, 2.5], given=[1.01]).holds


def test_a_jump_is_not_smoothed_away() -> None:
    # Its derivative is zero everywhere: the mean value form alone would call it negative.
    f = of(ca.sign(X[0] - 0.4) - 0.5, X)
    assert prove_negative(f, [0.0, 0.0], [1.0, 1.0]).status == "counterexample"


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-2, 2), min_size=3, max_size=3), st.floats(-1.0, 1.0))
def test_proofs_and_counterexamples_agree_with_a_dense_search(
    coefficients: list[float], offset: float
) -> None:
    a, b, c = coefficients
    expression = a * ca.sin(3 * X[0]) * X[1] + b * X[0] * ca.fabs(X[0]) + c * X[1] ** 3 + offset
    f = of(expression, X)
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41)), -1).reshape(-1, 2)
    largest = float(np.array(f(grid.T)).max())
    proof = prove_negative(f, [-1.0, -1.0], [1.0, 1.0], budget=20_000)
    if largest >= 0.0:
        assert not proof.holds
    elif proof.status == "counterexample":
        assert proof.point is not None and float(f(proof.point)) >= 0.0
    if largest < -0.05:
        assert proof.holds or proof.status == "counterexample"
