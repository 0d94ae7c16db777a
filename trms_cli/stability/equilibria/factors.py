"""Factors that are nowhere zero, taken off an equation.

A row ``cos α · h`` is zero where h is, as long as the beam is not upright; a row ``h / J`` where h
is. Without the factor the row may no longer depend on the angle at all, and its block falls apart
into smaller ones. What was taken off is checked to have no zero by whoever relies on it.
"""

from __future__ import annotations

import casadi as ca


def without_factors(row: ca.SX, variables: ca.SX) -> tuple[ca.SX, list[ca.SX]]:
    """A row without cosines and constants as factors, without its divisor; and what they were.

    Parameters
    ----------
    row : scalar
    variables : (m, 1)
        Symbols that are no parameters.
    """
    taken: list[ca.SX] = []
    while True:
        if row.is_op(ca.OP_NEG):
            row = row.dep(0)
        elif row.is_op(ca.OP_DIV):
            taken.append(row.dep(1))
            row = row.dep(0)
        elif row.is_op(ca.OP_MUL):
            first, second = row.dep(0), row.dep(1)
            if _is_factor(first, variables):
                taken.append(first)
                row = second
            elif _is_factor(second, variables):
                taken.append(second)
                row = first
            else:
                return row, taken
        else:
            return row, taken


def _is_factor(expression: ca.SX, variables: ca.SX) -> bool:
    return expression.is_op(ca.OP_COS) or not ca.depends_on(expression, variables)
