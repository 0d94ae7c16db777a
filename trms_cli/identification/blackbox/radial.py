"""Radial networks with free weights: radial basis functions and wavelets.

With q = ‖z − c‖²/d², e = exp(−q/2) and m the dimension of z,

    rbf      g = e                 ∂g/∂q = −e/2
    wavelet  g = (m − q) e         ∂g/∂q = −e − (m − q) e/2

and ∂q/∂z = 2 (z − c)/d² = −∂q/∂c, ∂q/∂log d = −2 q. The widths are free as their logarithms, so
that no step of a training can turn one negative.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from trms_cli.identification.blackbox.trainable import FloatArray, layout_of


@dataclass(frozen=True)
class Radial:
    """Radial units beside a direct linear part."""

    kind: Literal["rbf", "wavelet"]
    n_regressors: int
    n_outputs: int
    n_units: int

    @cached_property
    def _layout(self) -> dict[str, tuple[slice, tuple[int, ...]]]:
        return layout_of(
            {
                "centres": (self.n_units, self.n_regressors),
                "widths": (self.n_units,),
                "W": (self.n_outputs, self.n_units),
                "A": (self.n_outputs, self.n_regressors),
                "b": (self.n_outputs,),
            }
        )

    @property
    def n_parameters(self) -> int:
        return self._layout["b"][0].stop

    def named(self, theta: FloatArray) -> dict[str, FloatArray]:
        w = self._blocks(theta)
        return w | {"widths": np.exp(w["widths"])}

    def joined(self, weights: dict[str, FloatArray]) -> FloatArray:
        """The vector θ of named weights (widths as they are, not as logarithms)."""
        blocks = weights | {"widths": np.log(weights["widths"])}
        return np.concatenate([np.ravel(blocks[name]) for name in self._layout])

    def units(self, centres: FloatArray, widths: FloatArray, z: FloatArray) -> FloatArray:
        """Activations of radial units, ``(n_c, m), (n_c,), (n, m) -> (n, n_c)``."""
        return self._profile(_squares(z, centres) / widths**2)[0]

    def values(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        w = self.named(theta)
        return self.units(w["centres"], w["widths"], z) @ w["W"].T + z @ w["A"].T + w["b"]

    def slopes(self, theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        w = self.named(theta)
        n, n_out = len(z), self.n_outputs
        q = _squares(z, w["centres"]) / w["widths"] ** 2
        g, dg = self._profile(q)
        offset = (z[:, None, :] - w["centres"]) / (w["widths"] ** 2)[:, None]  # (n, n_c, m)
        by_q = w["W"][None] * dg[:, None, :]  # ∂y/∂q: (n, n_out, n_c)
        jacobian = np.zeros((n, n_out, self.n_parameters))
        at = {name: place for name, (place, _) in self._layout.items()}
        centres = -2.0 * by_q[:, :, :, None] * offset[:, None, :, :]
        jacobian[:, :, at["centres"]] = centres.reshape(n, n_out, -1)
        jacobian[:, :, at["widths"]] = -2.0 * by_q * q[:, None, :]
        for o in range(n_out):
            first = at["W"].start + o * self.n_units
            jacobian[:, o, first : first + self.n_units] = g
            first = at["A"].start + o * self.n_regressors
            jacobian[:, o, first : first + self.n_regressors] = z
            jacobian[:, o, at["b"].start + o] = 1.0
        by_z = 2.0 * np.matmul(by_q, offset) + w["A"]
        return g @ w["W"].T + z @ w["A"].T + w["b"], jacobian, by_z

    def pulled_back(
        self, theta: FloatArray, z: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        w = self.named(theta)
        q = _squares(z, w["centres"]) / w["widths"] ** 2
        g, dg = self._profile(q)
        by_q = (weight @ w["W"]) * dg  # (n, n_c)
        result = np.empty_like(theta)
        slope = self._blocks(result)  # views
        scale = (2.0 / w["widths"] ** 2)[:, None]
        slope["centres"][...] = scale * (by_q.sum(axis=0)[:, None] * w["centres"] - by_q.T @ z)
        slope["widths"][...] = -2.0 * np.sum(by_q * q, axis=0)
        slope["W"][...] = weight.T @ g
        slope["A"][...] = weight.T @ z
        slope["b"][...] = weight.sum(axis=0)
        scaled = by_q * (2.0 / w["widths"] ** 2)
        by_z = z * scaled.sum(axis=1, keepdims=True) - scaled @ w["centres"] + weight @ w["A"]
        return result, by_z

    def _blocks(self, theta: FloatArray) -> dict[str, FloatArray]:
        return {name: theta[at].reshape(shape) for name, (at, shape) in self._layout.items()}

    def _profile(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The radial profile and its slope in q."""
        bell = np.exp(-0.5 * q)
        if self.kind == "rbf":
            return bell, -0.5 * bell
        hat = (self.n_regressors - q) * bell
        return hat, -bell - 0.5 * hat


def _squares(z: FloatArray, centres: FloatArray) -> FloatArray:
    """Squared distances by one matrix product, ``(n, m), (n_c, m) -> (n, n_c)``."""
    inner = z @ centres.T
    squares = (z**2).sum(axis=1)[:, None] + (centres**2).sum(axis=1) - 2.0 * inner
    return np.asarray(np.maximum(squares, 0.0))
