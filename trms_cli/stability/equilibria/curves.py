"""Curves of equilibria over one input, found from many starts, and the stability of their points.

``y = (z, λ)`` are the unknowns z of :class:`RestSystem` and the varied input λ. On a switch (a
cable that is stiffer to one side) ∂f/∂x is the mean of both sides, which small swings across it
see; :mod:`trms_cli.stability.local.linear` tells why. All studies take the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.stats import qmc

from trms_cli.core.arrays import ComplexArray, FloatArray
from trms_cli.models.continuation import ImplicitCurve
from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.equilibria.rest_system import RestSystem
from trms_cli.stability.intervals.interval import Interval
from trms_cli.stability.local.linear import Linear
from trms_cli.stability.local.modes import Verdict, modes_of_matrix, parts_of

#: 1/s: growth below this is rounding (a free yaw neither grows nor returns).
GROWTH = 1e-7
_SEED = 20260


@dataclass(frozen=True)
class EquilibriumPoint(OperatingPoint):
    """An equilibrium with its stability."""

    eigenvalues: ComplexArray  #: (n_x,) complex array; of ∂f/∂x there, rightmost first
    unstable: int  #: How many of them grow
    verdict: Verdict  #: ``marginal`` where none grows and one neither grows nor dies out


class CurveEquations(ImplicitCurve):
    """``g(z, λ) = 0`` with the other inputs given.

    Parameters
    ----------
    system : RestSystem
    varied : int
        Position of λ in v.
    v : (n_v,) array
        The other inputs, and torques.
    box : Interval
        (n,), of z.
    scale : (n,) array
        Of z.
    bounds : (float, float)
        Of λ.
    """

    def __init__(
        self,
        system: RestSystem,
        varied: int,
        v: FloatArray,
        box: Interval,
        scale: FloatArray,
        bounds: tuple[float, float],
    ) -> None:
        self.system, self.varied = system, varied
        y = ca.SX.sym("y", system.n + 1)
        given = ca.SX(ca.DM(v))
        given[varied] = y[system.n]
        p = ca.DM(system.model.parameters.values)
        super().__init__(
            system.residual(y[: system.n], given, p),
            y,
            system.unknowns,
            np.append(box.lower, bounds[0]),
            np.append(box.upper, bounds[1]),
            np.append(scale, 0.5 * (bounds[1] - bounds[0])),
        )
        self._point = ca.Function("point", [y], list(system.point(y[: system.n], given, p)))

    def point(self, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """x, u and what reaches the motors."""
        x, u, reached = self._point(y)
        return np.array(x)[:, 0], np.array(u)[:, 0], np.array(reached)[:, 0]

    def stability(self, linear: Linear, y: FloatArray) -> EquilibriumPoint:
        """A point of a curve with its eigenvalues; y is (n + 1,)."""
        return equilibrium_point(linear, *self.point(y))

    def starts(self, inputs: FloatArray, count: int) -> list[FloatArray]:
        """Equilibria from many starts, at each of some inputs (m,)."""
        low = np.where(np.isfinite(self.lower), self.lower, -4.0 * self.scale)[:-1]
        high = np.where(np.isfinite(self.upper), self.upper, 4.0 * self.scale)[:-1]
        points: list[FloatArray] = []
        shares = qmc.Sobol(max(self.n, 1), seed=_SEED).random(count)
        for value in inputs:
            for share in shares:
                guess = np.append(low + share[: self.n] * (high - low), value)
                y = self.pinned(guess, self.n, float(value))
                if y is None or not self.inside(y):
                    continue
                if not any(self.same(y, other) for other in points):
                    points.append(y)
        return points


def equilibrium_point(
    linear: Linear, x: FloatArray, u: FloatArray, reached: FloatArray
) -> EquilibriumPoint:
    """An equilibrium with its eigenvalues; ``reached``, (n_u,), is what of u reaches the motors."""
    with np.errstate(invalid="ignore"):
        slopes = linear.a(x, reached)
    if not np.all(np.isfinite(slopes)):
        return EquilibriumPoint(x, u, np.full(len(x), np.nan, dtype=complex), 0, "marginal")
    values = np.linalg.eigvals(slopes).astype(complex)
    values = values[np.argsort(-values.real, kind="stable")]
    verdict = _verdict(linear.model, slopes, values)
    return EquilibriumPoint(x, u, values, int(np.sum(values.real > GROWTH)), verdict)


def _verdict(model: Model, slopes: FloatArray, values: ComplexArray) -> Verdict:
    if np.any(values.real > GROWTH):
        return "unstable"
    staying = int(np.sum(values.real >= -GROWTH))
    if staying > 1:
        # Two on the axis may grow as t: their eigenvectors decide.
        return modes_of_matrix(slopes, parts_of(model)).verdict
    return "marginal" if staying else "stable"
