"""Method ``armax``: a linear difference equation whose error is a moving average.

    y_i(k) = Σ_l Σ_j f_ij,l y_j(k−l) + Σ_m Σ_j g_ij,m u_j(k−m) + e_i(k) + Σ_l c_i,l e_i(k−l)

with white e: the equation of ARX with a model of its noise, so that noise on the measured outputs
no longer draws the coefficients. The residuals one step ahead

    e = (y − φᵀθ)/C(q),     ∂e/∂θ = −φ/C(q),     ∂e/∂c_l = −e(k−l)/C(q)

have their squares minimised by Gauss–Newton with Levenberg's damping, output by output; the
covariance is σ² (JᵀJ)⁻¹. The search begins from a long ARX model whose residuals stand for e
(Hannan & Rissanen 1982, Biometrika 69). Each stretch of a recording begins with e = 0.

Source: L. Ljung (1999), "System Identification: Theory for the User", 2nd ed., §7.2, §10.2, §10.3.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.linear.arx import (
    DifferenceEquation,
    coefficient_table,
    equation_matrices,
)
from trms_cli.identification.linear.linear_data import LinearData
from trms_cli.identification.linear.linear_fit import (
    LinearEstimate,
    Order,
    Orders,
    noise_covariance,
)

#: Of the search: steps, relative fall of the sum of squares that ends it, damping.
_ITERATIONS, _ENOUGH = 60, 1e-9
_FIRST_DAMPING, _MOST_DAMPING = 1e-4, 1e8
#: Roots of C stay inside this radius, so that what is not known of the past is forgotten.
_LARGEST_ROOT = 0.999
#: The long ARX model that begins has so many times the order.
_LONGER = 3


@dataclass(frozen=True, kw_only=True)
class Armax(DifferenceEquation):
    """ARMAX: ARX with a moving average of the noise, by prediction errors."""

    name: ClassVar[str] = "armax"
    output_order: Orders = (1, 2, 3, 4)  #: n_a, past outputs
    noise_order: Order = 2  #: n_c, past errors in each equation

    def estimate(
        self, data: LinearData, orders: Mapping[str, int], first: int | None = None
    ) -> LinearEstimate:
        equation, columns = self.rows(data, orders, first)
        theta = np.zeros((data.n_y, columns.shape[1]))
        residuals = np.empty_like(equation.y)
        coefficients, iterations, count = {}, {}, 0
        for output, name in enumerate(data.outputs):
            terms = self.terms(data, orders, output)
            fitted = _fit_equation(
                equation.y[:, output], columns[:, terms], self.noise_order, equation.runs
            )
            theta[output, terms] = fitted.theta
            residuals[:, output] = fitted.residual
            count += len(terms) + self.noise_order
            coefficients[name] = coefficient_table(
                data, orders, output, terms, fitted.theta, fitted.covariance
            )
            deviation = np.sqrt(np.diag(fitted.covariance))[len(terms) :]
            for lag, (value, sd) in enumerate(zip(fitted.noise, deviation, strict=True), start=1):
                coefficients[name][f"e(k-{lag})"] = {"value": float(value), "sd": float(sd)}
            iterations[name] = fitted.iterations
        matrices = equation_matrices(data, orders, theta)
        return LinearEstimate(
            orders={**orders, "noise_order": self.noise_order},
            state_space=data.lagged_state_space(*matrices, residuals.std(axis=0)),
            residuals=residuals,
            parameters=count,
            coefficients=coefficients,
            details={"iterations": iterations},
        )


@dataclass(frozen=True)
class _Equation:
    """A fitted equation of one output."""

    theta: FloatArray  #: (p,), of its terms
    noise: FloatArray  #: (n_c,), of the past errors
    residual: FloatArray  #: (n,), one step ahead
    covariance: FloatArray  #: (p + n_c, p + n_c)
    iterations: int


def _fit_equation(
    y: FloatArray, columns: FloatArray, order: int, runs: Sequence[slice]
) -> _Equation:
    theta, noise = _start(y, columns, order, runs)
    residual, slopes = _residual(y, columns, theta, noise, runs)
    cost, damping, p = float(residual @ residual), _FIRST_DAMPING, len(theta)
    iterations, before = 0, np.inf
    while iterations < _ITERATIONS and before - cost > _ENOUGH * cost:
        iterations += 1
        curvature, slope = slopes.T @ slopes, slopes.T @ residual
        before = cost
        while damping < _MOST_DAMPING:
            damped = curvature + damping * np.diag(np.diag(curvature) + 1e-12 * np.trace(curvature))
            move = np.linalg.solve(damped, slope)
            new_theta, new_noise = theta - move[:p], _inside(noise - move[p:])
            new_residual, new_slopes = _residual(y, columns, new_theta, new_noise, runs)
            new_cost = float(new_residual @ new_residual)
            if np.isfinite(new_cost) and new_cost < cost:
                theta, noise, residual, slopes = new_theta, new_noise, new_residual, new_slopes
                cost, damping = new_cost, damping / 10.0
                break
            damping *= 10.0
    return _Equation(theta, noise, residual, noise_covariance(slopes, residual), iterations)


def _start(
    y: FloatArray, columns: FloatArray, order: int, runs: Sequence[slice]
) -> tuple[FloatArray, FloatArray]:
    """Coefficients by least squares on past residuals of a longer model."""
    lags = _LONGER * order
    longer = np.hstack([columns, *(_delayed(y, lag, runs)[:, None] for lag in range(1, lags + 1))])
    first, *_ = np.linalg.lstsq(longer, y, rcond=None)
    error = y - longer @ first
    past = np.column_stack([_delayed(error, lag, runs) for lag in range(1, order + 1)])
    both = np.asarray(np.linalg.lstsq(np.hstack([columns, past]), y, rcond=None)[0], np.float64)
    p = columns.shape[1]
    return both[:p], _inside(both[p:])


def _residual(
    y: FloatArray,
    columns: FloatArray,
    theta: FloatArray,
    noise: FloatArray,
    runs: Sequence[slice],
) -> tuple[FloatArray, FloatArray]:
    """Residuals one step ahead (n,), and their slopes ∂e/∂(θ, c), (n, p + n_c)."""
    from scipy.signal import lfilter

    polynomial = np.concatenate([[1.0], noise])
    error, slopes = y - columns @ theta, np.empty((len(y), len(theta) + len(noise)))
    with np.errstate(over="ignore", invalid="ignore"):
        for run in runs:
            error[run] = lfilter([1.0], polynomial, error[run])
        past = [_delayed(error, lag, runs)[:, None] for lag in range(1, len(noise) + 1)]
        both = np.hstack([columns, *past])
        for run in runs:
            slopes[run] = -lfilter([1.0], polynomial, both[run], axis=0)
    return error, slopes


def _delayed(values: FloatArray, lag: int, runs: Sequence[slice]) -> FloatArray:
    """Values (n,) so many rows earlier, 0 before the beginning of each run."""
    result = np.zeros_like(values)
    for run in runs:
        part = values[run]
        result[run][lag:] = part[:-lag] if lag < len(part) else part[:0]
    return result


def _inside(noise: FloatArray) -> FloatArray:
    """The moving average with the same spectrum whose roots lie inside the unit circle.

    A root outside is reflected; one near the circle is drawn inside.
    """
    roots = np.roots(np.concatenate([[1.0], noise]))
    size = np.maximum(np.abs(roots), np.finfo(float).eps)
    inside = np.minimum(np.minimum(size, 1.0 / size), _LARGEST_ROOT)
    roots = roots * (inside / size)
    full = np.zeros(len(noise) + 1)
    polynomial = np.real(np.poly(roots)) if len(roots) else np.ones(1)
    full[: len(polynomial)] = polynomial  # np.roots drops trailing zeros: roots at 0
    return full[1:]
