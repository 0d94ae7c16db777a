"""Symbolic elimination equals a numerical solve, and keeps the zeros it can."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from trms_cli.models.discretisation import factorised


@pytest.mark.parametrize("density", [0.2, 0.5, 1.0])
def test_solves_diagonally_dominant_systems(density: float) -> None:
    generator = np.random.default_rng(3)
    values = generator.standard_normal((7, 7)) * (generator.random((7, 7)) < density)
    np.fill_diagonal(values, 10.0)
    pattern = ca.DM(ca.sparsify(ca.DM(values))).sparsity()
    matrix, right = ca.SX.sym("matrix", pattern), ca.SX.sym("right", 7)
    solve = ca.Function("solve", [matrix, right], [factorised(matrix)(right)])
    b = generator.standard_normal(7)
    found = np.array(solve(ca.sparsify(ca.DM(values)), b)).ravel()
    assert found == pytest.approx(np.linalg.solve(values, b), rel=1e-12)


def test_a_triangular_matrix_costs_no_fill_in() -> None:
    matrix = ca.SX.sym("matrix", ca.Sparsity.lower(6))
    right = ca.SX.sym("right", 6)
    solve = ca.Function("solve", [matrix, right], [factorised(matrix)(right)])
    # One division a row, one product and one difference an entry below the diagonal, and as many
    # in the factorisation at the most.
    assert solve.n_nodes() < 120
