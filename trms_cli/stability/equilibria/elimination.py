"""States that follow exactly from others, taken out of the equations of rest.

A state that stands in an equation linearly, with a factor that depends on parameters alone (a
current by Ohm's law, the momenta S by the rates), is expressed by the others and substituted. It
is an identity of real numbers, so that nothing is lost or gained, and what cancels then vanishes:
without rates no gyroscopic or Coriolis term is left.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import casadi as ca
import numpy as np


@dataclass(frozen=True)
class Eliminated:
    """Equations after elimination."""

    rows: list[ca.SX]  #: What must be zero, one expression each
    kept: list[int]  #: Positions of the symbols that are left as unknowns
    state: ca.SX  #: All symbols by those that are left, (n, 1)


def eliminated(
    f: ca.SX, x: ca.SX, others: ca.SX, p: ca.SX, values: ca.DM, keep: Collection[int]
) -> Eliminated:
    """Solve linear equations of ``f(x, others, p) = 0`` for symbols of x, one after the other.

    Parameters
    ----------
    f : (n, 1)
    x : (n, 1)
        Symbols.
    others : (m, 1)
        Symbols that a factor must not depend on either.
    p, values : (n_p, 1)
        Parameters and their values: a factor that is zero there cannot be divided by.
    keep : collection of int
        Positions in x that are to stay unknowns.
    """
    rows = ca.vertsplit(ca.cse(f))
    state, left = x, [j for j in range(x.numel()) if j not in keep]
    variables = ca.vertcat(x, others)
    while True:
        found = _linear(rows, x, variables, p, values, left)
        if found is None:
            break
        i, j, factor = found
        rest = ca.substitute(rows[i], x[j], ca.SX(0))
        # A division by one would stay in the expression, and keep it from cancelling.
        value = rest if factor.is_minus_one() else -rest if factor.is_one() else -rest / factor
        rows = [row for k, row in enumerate(rows) if k != i]
        whole = ca.cse(ca.substitute(ca.vertcat(state, *rows), x[j], value))
        state, rows = whole[: x.numel()], ca.vertsplit(whole[x.numel() :]) if rows else []
        left.remove(j)
    kept = [j for j in range(x.numel()) if j in keep or j in left]
    # A row that has become identically zero asks for nothing.
    rows = [row for row in rows if not (row.is_constant() and float(row) == 0.0)]
    return Eliminated(rows, kept, state)


def _linear(
    rows: list[ca.SX], x: ca.SX, variables: ca.SX, p: ca.SX, values: ca.DM, left: list[int]
) -> tuple[int, int, ca.SX] | None:
    """Row, symbol and factor of a linear occurrence, in a row of as few symbols as there is.

    A factor of one comes first: ``S`` by the rate, and not a rotor's speed by ``S``.
    """
    if not rows or not left:
        return None
    slopes = ca.cse(ca.jacobian(ca.vertcat(*rows), x))
    filled = np.array(ca.DM(slopes.sparsity(), 1).full(), dtype=bool)
    for i in np.argsort(filled.sum(axis=1), kind="stable"):
        candidates = [j for j in left if filled[i, j]]
        for j in sorted(candidates, key=lambda j: not _is_unit(slopes[int(i), j])):
            factor = slopes[int(i), j]
            if ca.depends_on(factor, variables):
                continue
            size = float(ca.evalf(ca.substitute(factor, p, values))) if p.numel() else float(factor)
            if np.isfinite(size) and size != 0.0:
                return int(i), j, factor
    return None


def _is_unit(factor: ca.SX) -> bool:
    return bool(factor.is_one() or factor.is_minus_one())
