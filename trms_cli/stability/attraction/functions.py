"""Functions V of the deviation, as weighted sums of basis functions, with their rates.

The basis is made of the squares and products of the deviations, on request of the higher monomials
up to degree four, and of the integrals of the model's own nonlinear rates along one axis,

    W_ij(y) = ∫₀^{y_j} [f_i(x̄ + s e_j) − f_i(x̄)] ds

(Lur'e and Postnikov's idea: a potential energy is such an integral). The integral is taken by
Gauss's rule with few nodes; the sum, not the integral, *is* the basis function, and its slopes are
its own: nothing that is proved of V rests on the quadrature.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.stability.attraction.system import ReducedSystem, operations

_NODES = 6
#: What an expression with a kink or a jump holds.
_SWITCHES = {
    *(ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_IF_ELSE_ZERO),
    *(ca.OP_SIGN, ca.OP_FABS, ca.OP_FMIN, ca.OP_FMAX, ca.OP_FLOOR, ca.OP_CEIL),
}


@dataclass(frozen=True)
class Basis:
    """Basis functions of y."""

    system: ReducedSystem
    names: tuple[str, ...]  #: ``alpha_v·S_v``, ``∫S_v' d alpha_v``; of each function
    values: ca.Function  #: ``y → b``, (k, 1)

    @cached_property
    def rates(self) -> ca.Function:
        """``y → ḃ`` along the motions, (k, 1)."""
        y = ca.SX.sym("y", self.system.n)
        f = self.system.function(y, ca.DM.zeros(self.system.model.n_x))
        return ca.Function("rates", [y], [ca.jacobian(self.values(y), y) @ f])

    def at(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """b and ḃ at many deviations (m, n), each (m, k)."""
        return np.array(self.values(y.T)).T, np.array(self.rates(y.T)).T


@dataclass(frozen=True)
class LyapunovCandidate:
    """V = weights · b."""

    basis: Basis
    weights: FloatArray  #: (k,) array

    @property
    def system(self) -> ReducedSystem:
        return self.basis.system

    @cached_property
    def function(self) -> ca.Function:
        """``y → V``."""
        y = ca.SX.sym("y", self.system.n)
        value = ca.dot(ca.SX(ca.DM(self.weights)), self.basis.values(y))
        return ca.Function("V", [y], [value])

    @cached_property
    def both(self) -> ca.Function:
        """``(y, e) → V, V̇``."""
        y, e = self.system.symbols()
        value = self.function(y)
        rate = ca.jacobian(value, y) @ self.system.function(y, e)
        return ca.Function("both", [y, e], [value, rate])

    @cached_property
    def hessian(self) -> ca.Function:
        """``(y, e) → ∂²V/∂y²``, dense; e is not used."""
        y, e = self.system.symbols()
        return ca.Function("hessian", [y, e], [ca.densify(ca.hessian(self.function(y), y)[0])])

    @cached_property
    def P(self) -> FloatArray:
        """Half the second derivative at the equilibrium: V ≈ yᵀPy near it, (n, n)."""
        zero = np.zeros(self.system.n)
        return 0.5 * np.array(self.hessian(zero, np.zeros(self.system.model.n_x)))

    def at(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """V and V̇ at many deviations (m, n), each (m,)."""
        value, rate = self.both(y.T, np.zeros(self.system.model.n_x))
        return np.array(value).ravel(), np.array(rate).ravel()

    def values(self, y: FloatArray) -> FloatArray:
        """V at many deviations (m, n), (m,)."""
        return np.array(self.function(y.T)).ravel()


def quadratic(system: ReducedSystem, P: FloatArray) -> LyapunovCandidate:
    """V = yᵀPy."""
    basis = basis_of(system)
    weights = [P[i, j] * (1.0 if i == j else 2.0) for i, j in _pairs(system.n)]
    return LyapunovCandidate(basis, np.array(weights))


def basis_of(system: ReducedSystem, degree: int = 2, *, integrals: bool = False) -> Basis:
    """Monomials of degrees 2 to ``degree`` (at most 4), and on request the integrals of the rates.

    Integrals are those of rates that are curved along an axis, and smooth.
    """
    y = ca.SX.sym("y", system.n)
    found: list[ca.SX] = []
    labels: list[str] = []
    for size in range(2, degree + 1):
        for group in itertools.combinations_with_replacement(range(system.n), size):
            term = ca.SX(1)
            for i in group:
                term *= y[i]
            found.append(term)
            labels.append(_power(system.names, group))
    if integrals:
        for i, j in _curved_pairs(system):
            found.append(_integral(system, y, i, j))
            labels.append(f"∫{system.names[i]}' d{system.names[j]}")
    return Basis(system, tuple(labels), ca.Function("basis", [y], [ca.vertcat(*found)]))


def _pairs(n: int) -> list[tuple[int, int]]:
    return list(itertools.combinations_with_replacement(range(n), 2))


def _power(names: Sequence[str], group: tuple[int, ...]) -> str:
    parts = []
    for i in dict.fromkeys(group):
        count = group.count(i)
        parts.append(names[i] + ("" if count == 1 else "²³⁴"[count - 2]))
    return "·".join(parts)


def _curved_pairs(system: ReducedSystem) -> list[tuple[int, int]]:
    """(i, j) where ∂f_i/∂y_j depends on y_j, smoothly: along which axis a rate is curved."""
    y, e = system.symbols()
    slopes = system.slopes(y, e)
    found = []
    for i, j in itertools.product(range(system.n), repeat=2):
        slope = ca.Function("slope", [y, e], [slopes[i, j]])
        # A rate with a kink would give V, summed at nodes, slopes that jump.
        if ca.jacobian_sparsity(slopes[i, j], y[j]).nnz() and not operations(slope) & _SWITCHES:
            found.append((i, j))
    return found


def _integral(system: ReducedSystem, y: ca.SX, i: int, j: int) -> ca.SX:
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    zero = ca.DM.zeros(system.model.n_x)
    at_rest = system.function(ca.DM.zeros(system.n), zero)[i]
    total = ca.SX(0)
    for node, weight in zip(nodes, weights, strict=True):
        along = ca.SX.zeros(system.n)
        along[j] = 0.5 * (1.0 + node) * y[j]
        total += 0.5 * weight * (system.function(along, zero)[i] - ca.SX(at_rest))
    return total * y[j]
