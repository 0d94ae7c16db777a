"""Method ``arx``: a linear difference equation by least squares.

    y_i(k) = Σ_l Σ_j f_ij,l y_j(k−l) + Σ_m Σ_j g_ij,m u_j(k−m) + e_i(k)     l = 1…n_a, m = d…d+n_b−1

with white e, in deviations from the operating point. The coefficients of each output follow from
least squares, their covariance is σ² (ΦᵀΦ)⁻¹. The estimate is consistent only where the
equation's error is white: noise on the measured outputs, as an encoder's rounding, draws the
coefficients of fast recordings towards a model that is damped too much.

Source: L. Ljung (1999), "System Identification: Theory for the User", 2nd ed., §4.2, §7.3, §9.3.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, ClassVar

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.identification.linear.linear_data import (
    LinearData,
    Regression,
    regression,
    require_rows,
)
from trms_cli.identification.linear.linear_fit import (
    LinearEstimate,
    LinearMethod,
    Orders,
    choices,
    least_squares,
)


@dataclass(frozen=True, kw_only=True)
class DifferenceEquation(LinearMethod):
    """What ARX and ARMAX share: the orders of a difference equation, and its terms."""

    output_order: Orders = (1, 2, 3, 4, 6, 8)  #: n_a, past outputs
    input_order: Orders = (1, 2, 4)  #: n_b, past commands
    dead_time: Orders = 1  #: d, samples from a command to its first effect; 1: the next sample
    #: Whether the past of every output enters each equation; else only that of its own
    coupled: bool = True

    def candidates(self, data: LinearData) -> list[dict[str, int]]:
        keys = ("output_order", "input_order", "dead_time")
        values = [choices(getattr(self, key), f"method.{key}") for key in keys]
        return [dict(zip(keys, orders, strict=True)) for orders in product(*values)]

    def look_back(self, orders: Mapping[str, int]) -> int:
        return max(orders["output_order"], input_lags(orders))

    def terms(self, data: LinearData, orders: Mapping[str, int], output: int) -> IntArray:
        """Columns of (past outputs, past commands) that the equation of an output has."""
        n_a, n_m = orders["output_order"], input_lags(orders)
        past = np.arange(n_a * data.n_y)
        if not self.coupled:
            past = past[past % data.n_y == output]
        before = data.n_u * (orders["dead_time"] - 1)
        commands = n_a * data.n_y + np.arange(before, n_m * data.n_u)
        return np.concatenate([past, commands])

    def rows(
        self, data: LinearData, orders: Mapping[str, int], first: int | None
    ) -> tuple[Regression, FloatArray]:
        """The regression and its columns (n, n_phi), past outputs before past commands.

        Raises RecordingError if there are too few samples.
        """
        equation = regression(data, orders["output_order"], input_lags(orders), first)
        columns = np.hstack([equation.past, equation.commands])
        require_rows(data, len(equation), len(self.terms(data, orders, 0)))
        return equation, columns


def input_lags(orders: Mapping[str, int]) -> int:
    """The longest lag of a command."""
    return orders["input_order"] + orders["dead_time"] - 1


def equation_matrices(
    data: LinearData, orders: Mapping[str, int], theta: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """F (n_a, n_y, n_y) and G (n_m, n_y, n_u) of coefficients (n_y, n_phi), zero where none is."""
    n_a, n_m = orders["output_order"], input_lags(orders)
    split = n_a * data.n_y
    F = theta[:, :split].reshape(data.n_y, n_a, data.n_y).transpose(1, 0, 2)
    G = theta[:, split:].reshape(data.n_y, n_m, data.n_u).transpose(1, 0, 2)
    return F, G


def coefficient_table(
    data: LinearData,
    orders: Mapping[str, int],
    output: int,
    terms: IntArray,
    theta: FloatArray,
    covariance: FloatArray,
) -> dict[str, Any]:
    """The coefficients of an output's equation and their standard deviations, in own units."""
    n_a, n_m = orders["output_order"], input_lags(orders)
    labels = [f"{y}(k-{lag})" for lag in range(1, n_a + 1) for y in data.outputs]
    labels += [f"{u}(k-{lag})" for lag in range(1, n_m + 1) for u in data.inputs]
    scales = np.concatenate([np.tile(data.output_sd, n_a), np.tile(data.input_sd, n_m)])
    deviation = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    unit = data.output_sd[output] / scales[terms]
    return {
        labels[term]: {"value": float(value * size), "sd": float(sd * size)}
        for term, value, sd, size in zip(terms, theta, deviation, unit, strict=False)
    }


@dataclass(frozen=True, kw_only=True)
class Arx(DifferenceEquation):
    """ARX: a difference equation of past outputs and commands, by least squares."""

    name: ClassVar[str] = "arx"

    def estimate(
        self, data: LinearData, orders: Mapping[str, int], first: int | None = None
    ) -> LinearEstimate:
        equation, columns = self.rows(data, orders, first)
        theta = np.zeros((data.n_y, columns.shape[1]))
        coefficients = {}
        count = 0
        for output, name in enumerate(data.outputs):
            terms = self.terms(data, orders, output)
            own, covariance = least_squares(columns[:, terms], equation.y[:, output])
            theta[output, terms] = own
            count += len(terms)
            coefficients[name] = coefficient_table(data, orders, output, terms, own, covariance)
        residuals = equation.y - columns @ theta.T
        matrices = equation_matrices(data, orders, theta)
        return LinearEstimate(
            orders=dict(orders),
            state_space=data.lagged_state_space(*matrices, residuals.std(axis=0)),
            residuals=residuals,
            parameters=count,
            coefficients=coefficients,
        )
