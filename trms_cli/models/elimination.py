"""Symbolic Gaussian elimination that uses the zeros of a matrix.

CasADi's symbolic QR fills them: on the 8-state model it doubles the operations of a step and
quadruples those of its derivatives.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca


def factorised(matrix: ca.SX) -> Callable[[ca.SX], ca.SX]:
    """Factorise once, solve many times: a function ``b → matrix⁻¹ b``.

    Parameters
    ----------
    matrix : casadi.SX
        Square. There is no pivoting: every leading block must be regular, as it is for the
        ``I/(γh) − ∂f/∂x`` of a linearly implicit step.
    """
    n = matrix.shape[0]
    structure = matrix.sparsity()
    rows: list[dict[int, ca.SX]] = [
        {j: matrix[i, j] for j in range(n) if structure.has_nz(i, j)} for i in range(n)
    ]
    for k in range(n):
        for i in range(k + 1, n):
            if k not in rows[i]:
                continue
            rows[i][k] /= rows[k][k]
            for j in range(k + 1, n):
                if j in rows[k]:
                    rows[i][j] = rows[i].get(j, ca.SX(0)) - rows[i][k] * rows[k][j]

    def solve(b: ca.SX) -> ca.SX:
        x = [b[i] for i in range(n)]
        for i in range(n):
            for j in range(i):
                if j in rows[i]:
                    x[i] -= rows[i][j] * x[j]
        for i in reversed(range(n)):
            for j in range(i + 1, n):
                if j in rows[i]:
                    x[i] -= rows[i][j] * x[j]
            x[i] /= rows[i][i]
        return ca.vertcat(*x)

    return solve
