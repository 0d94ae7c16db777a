"""The equations of rest as numbers, over the unknowns and one input that is varied.

``y = (z, λ)`` are the unknowns z of :class:`RestSystem` and the varied input λ; all lengths are in
units of what counts of each.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.stability.equilibria.rest_system import RestSystem
from trms_cli.stability.intervals.interval import Interval
from trms_cli.stability.local.modes import Verdict

FloatArray = npt.NDArray[np.float64]

#: Of a Newton step, in units of what counts: converged.
TOLERANCE = 1e-11
_ITERATIONS = 30


@dataclass(frozen=True)
class EquilibriumPoint:
    """A point of a curve, complete."""

    x: FloatArray  #: (n_x,), (n_u,)
    u: FloatArray  #: (n_x,), (n_u,)
    #: (n_x,) complex array; of ∂f/∂x there, rightmost first
    eigenvalues: npt.NDArray[np.complex128]
    unstable: int  #: How many of them grow
    verdict: Verdict  #: ``marginal`` where none grows and one neither grows nor dies out


class CurveEquations:
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
        self.system, self.n, self.varied = system, system.n, varied
        self.lower = np.append(box.lower, bounds[0])
        self.upper = np.append(box.upper, bounds[1])
        self.scale = np.append(scale, 0.5 * (bounds[1] - bounds[0]))
        y = ca.SX.sym("y", self.n + 1)
        given = ca.SX(ca.DM(v))
        given[varied] = y[self.n]
        p = ca.DM(system.model.parameters.values)
        g = system.residual(y[: self.n], given, p)
        slopes = ca.densify(ca.jacobian(g, y))
        self._function = ca.Function("curve", [y], [g, slopes])
        self._point = ca.Function("point", [y], list(system.point(y[: self.n], given, p)))
        null, reference = ca.SX.sym("null", self.n), ca.SX.sym("reference", self.n)
        flat = ca.vertcat(g, slopes[:, : self.n] @ null, ca.dot(reference, null) - 1.0)
        both = ca.vertcat(y, null)
        jacobian = ca.densify(ca.jacobian(flat, both))
        self._fold = ca.Function("fold", [both, reference], [flat, jacobian])

    def residual(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """g, (n,), and its slopes in y, (n, n + 1)."""
        g, slopes = self._function(y)
        return np.array(g)[:, 0], np.array(slopes)

    def point(self, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """x, u and what reaches the motors."""
        x, u, reached = self._point(y)
        return np.array(x)[:, 0], np.array(u)[:, 0], np.array(reached)[:, 0]

    def tangent(self, y: FloatArray, before: FloatArray | None = None) -> FloatArray:
        """Direction of the curve in scaled units, of length 1, (n + 1,); on in its direction."""
        slopes = self.residual(y)[1] * self.scale
        size = np.abs(slopes).max(axis=1, keepdims=True)
        direction = np.linalg.svd(slopes / np.where(size > 0, size, 1.0))[2][-1]
        if before is not None and direction @ before < 0:
            direction = -direction
        return np.asarray(direction)

    def corrected(self, guess: FloatArray, along: FloatArray) -> FloatArray | None:
        """The point of a curve in the plane through a guess, (n + 1,), across a direction."""
        y = guess.copy()
        for _ in range(_ITERATIONS):
            g, slopes = self.residual(y)
            matrix = np.vstack([slopes * self.scale, along])
            right = np.append(g, along @ ((y - guess) / self.scale))
            size = np.abs(matrix).max(axis=1)
            if not np.all(np.isfinite(matrix)) or not np.all(np.isfinite(right)):
                return None
            size = np.where(size > 0, size, 1.0)
            step = np.linalg.lstsq(matrix / size[:, None], right / size, rcond=1e-14)[0]
            y = y - step * self.scale
            if np.abs(step).max() <= TOLERANCE:
                return y if self._small(y) else None
        return None

    def pinned(self, guess: FloatArray, index: int, value: float) -> FloatArray | None:
        """The point with one coordinate given, from a guess near it."""
        along = np.zeros(self.n + 1)
        along[index] = 1.0
        start = guess.copy()
        start[index] = value
        found = self.corrected(start, along)
        if found is not None:
            found[index] = value
        return found

    def _small(self, y: FloatArray) -> bool:
        g, slopes = self.residual(y)
        size = (np.abs(slopes) * self.scale).max(axis=1)
        return bool(np.all(np.abs(g) <= 1e-7 * np.where(size > 0, size, 1.0)))

    def fold(self, near: FloatArray) -> FloatArray | None:
        """A fold from a point near it: where the slopes in z have a null vector.

        Newton's method on the system of Moore & Spence (1980, SIAM J. Numer. Anal. 17)::

            g(z, λ) = 0        g_z(z, λ) φ = 0        φ₀ᵀφ = 1
        """
        direction = self._weakest(near)[1]
        null, reference = direction * self.scale[:-1], direction / self.scale[:-1]
        both = np.concatenate([near, null])
        for _ in range(_ITERATIONS):
            value, jacobian = (np.array(part) for part in self._fold(both, reference))
            if not (np.all(np.isfinite(value)) and np.all(np.isfinite(jacobian))):
                return None
            units = np.concatenate([self.scale, np.abs(null).max() * np.ones(self.n)])
            matrix = jacobian * units
            size = np.abs(matrix).max(axis=1)
            size = np.where(size > 0, size, 1.0)
            step = np.linalg.lstsq(matrix / size[:, None], value[:, 0] / size, rcond=1e-14)[0]
            both = both - step * units
            if np.abs(step).max() <= 1e-10:
                y = both[: self.n + 1]
                close = np.abs((y - near) / self.scale).max() < 0.2
                flat = self._weakest(y)[0] < 1e-8
                return y if close and flat and self._small(y) else None
        return None

    def _weakest(self, y: FloatArray) -> tuple[float, FloatArray]:
        """Least singular value of the slopes in z, and its direction.

        Rows are of size one with their slope in λ, which is what is left of them at a fold.
        """
        slopes = self.residual(y)[1] * self.scale
        size = np.abs(slopes).max(axis=1, keepdims=True)
        scaled = slopes / np.where(size > 0, size, 1.0)
        _, values, directions = np.linalg.svd(scaled[:, : self.n])
        return float(values[-1]), directions[-1]

    def inside(self, y: FloatArray) -> bool:
        """Whether a point is within the box and the range, to rounding."""
        slack = 1e-9 * self.scale
        return bool(np.all(y >= self.lower - slack) and np.all(y <= self.upper + slack))
