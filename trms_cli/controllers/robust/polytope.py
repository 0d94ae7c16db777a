"""The polytope of the state-dependent coefficients.

Around a steady state (z_s, v_s) the step is, by the mean-value form of Hadamard's lemma,

    z⁺ − z_s = A (z − z_s) + B (v − v_s)      [A B] = ∫₀¹ ∂F/∂(z, v) (z_s + σ Δz, v_s + σ Δv) dσ

exactly: the state-dependent coefficients of the discrete step itself, not of its derivative. They
are sampled over a region, in typical sizes, and spread along their K principal components, whose
box, a little widened, is the polytope:

    [A B] ∈ conv{ M₀ + Σ θ_k M_k :  θ_k ∈ {θ_k⁻, θ_k⁺} }        2^K vertices

What the other components do is left out; ``experiments/chapter8`` says how much that is, and
whether a law minds.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from trms_cli.controllers.robust.coordinates import Coordinates, ThrustDemand
from trms_cli.core.arrays import FloatArray, gauss_legendre
from trms_cli.core.compilation import BufferedFunction

_BATCH = 128
_NODES = 4
#: Low-discrepancy points of a cube this much larger, cut to the region, fall on its faces too.
_OVERSIZE = 1.2


@dataclass(frozen=True)
class RegulationTarget:
    """A steady state in the coordinates of the regulation."""

    z: FloatArray  #: (n,) array
    v: FloatArray  #: (m,) array
    w: FloatArray  #: (n_w,) array; the torques under which it is one, N m


@dataclass(frozen=True)
class StateBox:
    """A box in z."""

    lower: FloatArray  #: (n,) arrays
    upper: FloatArray  #: (n,) arrays

    def contains(self, other: StateBox, tolerance: FloatArray | float = 0.0) -> bool:
        """Whether another box lies within."""
        return bool(
            np.all(other.lower >= self.lower - tolerance)
            and np.all(other.upper <= self.upper + tolerance)
        )

    def within(self, other: StateBox) -> StateBox:
        """What two boxes share; a side that would vanish is kept as a point."""
        lower = np.clip(self.lower, other.lower, other.upper)
        upper = np.clip(self.upper, other.lower, other.upper)
        return StateBox(lower, upper)


@dataclass(frozen=True)
class Polytope:
    """Vertices of the coefficients, in units of the scales."""

    A: FloatArray  #: (L, n, n) array
    B: FloatArray  #: (L, n, m) array
    centre: FloatArray  #: (n, n + m) array; middle of the sampled coefficients
    directions: FloatArray  #: (K, n (n + m)) array; M_k: orthonormal, each as a row
    lower: FloatArray  #: (K,) arrays; θ_k⁻ and θ_k⁺
    upper: FloatArray  #: (K,) arrays; θ_k⁻ and θ_k⁺

    @property
    def vertices(self) -> int:
        return len(self.A)


def box(coefficients: FloatArray, components: int, margin: float) -> Polytope:
    """The box of the samples' principal components.

    ``coefficients``: (N, n, n + m). ``components``: K; there are 2^K vertices. ``margin``: share by
    which each side is longer than the samples reach.
    """
    N, n, columns = coefficients.shape
    centre = (coefficients.min(axis=0) + coefficients.max(axis=0)) / 2
    apart = (coefficients - centre).reshape(N, -1)
    vectors = np.linalg.eigh(apart.T @ apart)[1]
    directions = np.ascontiguousarray(vectors[:, ::-1][:, :components].T)
    theta = apart @ directions.T
    middle, half = (theta.max(axis=0) + theta.min(axis=0)) / 2, np.ptp(theta, axis=0) / 2
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=components)))
    corners = middle + (1.0 + margin) * half * signs.reshape(2**components, components)
    vertices = centre + (corners @ directions).reshape(-1, n, columns)
    return Polytope(
        np.ascontiguousarray(vertices[:, :, :n]),
        np.ascontiguousarray(vertices[:, :, n:]),
        centre,
        directions,
        middle - (1.0 + margin) * half,
        middle + (1.0 + margin) * half,
    )


class Coefficients:
    """Samples the coefficients around a target.

    ``demands``: of the rotors regulated by thrust: their ν is the input in place of ψ⁺.
    ``scale_z``: (n,). ``scale_v``: (m,); units in which the coefficients are given. ``points``:
    samples of the region. ``band``: distance of ψ from its target, (rad/s)², below which the
    coefficients at that distance are taken: nearer, the slope of a rotor's speed in its thrust has
    no bound, while the speed itself, which is all that the beam feels of it, has.
    """

    def __init__(
        self,
        coordinates: Coordinates,
        demands: tuple[ThrustDemand, ...],
        scale_z: FloatArray,
        scale_v: FloatArray,
        points: int,
        band: float,
    ) -> None:
        self.coordinates, self.demands = coordinates, demands
        self._scale_z, self._scale_v = scale_z, scale_v
        self._step = BufferedFunction(coordinates.step.map(_BATCH))
        self._places, self._weights = gauss_legendre(_NODES)
        self._band = band
        self._cube = _cube(points, coordinates.n + coordinates.m)
        self._limits = coordinates.model.input_bounds()

    def over(
        self, target: RegulationTarget, region: StateBox, cube: FloatArray | None = None
    ) -> FloatArray:
        """Coefficients (N, n, n + m) over a region, in units of the scales.

        Commands are anywhere within their limits, demands of thrust anywhere within their bounds.

        ``cube``: (N, n + m) array; points of [−1, 1]^(n + m) to take in place of the usual ones.
        """
        cube = self._cube if cube is None else cube
        z, v = self._points(target, region, cube)
        total = np.zeros((len(z), self.coordinates.n, self.coordinates.n + self.coordinates.m))
        for place, weight in zip(self._places, self._weights, strict=True):
            total += weight * self._slopes(
                target.z + place * (z - target.z), target.v + place * (v - target.v), target.w
            )
        return self._scaled(total)

    def residual(self, target: RegulationTarget, region: StateBox, cube: FloatArray) -> FloatArray:
        """What the coefficients leave of the step itself, (N, n), in units of the scale of z."""
        n = self.coordinates.n
        z, v = self._points(target, region, cube)
        after = np.concatenate([self._after(a, b, target.w) for a, b in _batches(z, v)])
        coefficients = self.over(target, region, cube)
        dz = (z - target.z) / self._scale_z
        dv = v - target.v
        for demand in self.demands:
            rotor = demand.rotor
            dv[:, rotor.input] -= demand.pole * (z - target.z)[:, rotor.coordinate]
        dv = dv / self._scale_v
        explained = np.einsum("kij,kj->ki", coefficients, np.concatenate([dz, dv], axis=1))
        return np.asarray((after - target.z) / self._scale_z - explained)[:, :n]

    def _points(
        self, target: RegulationTarget, region: StateBox, cube: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        n = self.coordinates.n
        middle, half = (region.lower + region.upper) / 2, (region.upper - region.lower) / 2
        z = middle + half * cube[:, :n]
        lower, upper = self._limits
        v = (lower + upper) / 2 + (upper - lower) / 2 * cube[:, n:]
        for demand in self.demands:
            rotor = demand.rotor
            psi_s = target.z[rotor.coordinate]
            away = z[:, rotor.coordinate] - psi_s
            away = np.where(away < 0, -1.0, 1.0) * np.maximum(np.abs(away), self._band)
            psi = z[:, rotor.coordinate] = psi_s + away
            bound = max(demand.bound(float(psi_s)), 0.0)
            v[:, rotor.input] = (
                psi_s + demand.pole * (psi - psi_s) + bound * cube[:, n + rotor.input]
            )
        return z, v

    def _after(self, z: FloatArray, v: FloatArray, w: FloatArray) -> FloatArray:
        self._evaluate(z, v, w)
        return np.array(self._step.outputs[0][:, : len(z)].T)

    def _evaluate(self, z: FloatArray, v: FloatArray, w: FloatArray) -> None:
        at_z, at_v, at_w = self._step.inputs
        at_z[:, : len(z)] = z.T
        at_v[:, : len(v)] = v.T
        at_w[:] = w[:, None]
        self._step()

    def _slopes(self, z: FloatArray, v: FloatArray, w: FloatArray) -> FloatArray:
        n, columns = self.coordinates.n, self.coordinates.n + self.coordinates.m
        parts = []
        for a, b in _batches(z, v):
            self._evaluate(a, b, w)
            whole = self._step.outputs[1].reshape((n, columns, _BATCH), order="F")
            parts.append(whole[:, :, : len(a)].transpose(2, 0, 1).copy())
        return np.concatenate(parts)

    def _scaled(self, coefficients: FloatArray) -> FloatArray:
        n = self.coordinates.n
        for demand in self.demands:
            rotor = demand.rotor
            coefficients[:, :, rotor.coordinate] += (
                demand.pole * coefficients[:, :, n + rotor.input]
            )
        scale = np.concatenate([self._scale_z, self._scale_v])
        return np.asarray(coefficients * scale / self._scale_z[:, None])


def _cube(points: int, dimensions: int) -> FloatArray:
    """Low-discrepancy points of [−1, 1]^d (Roberts' additive sequence), faces included."""
    root = 2.0
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / (dimensions + 1))
    steps = root ** -np.arange(1.0, dimensions + 1.0)
    unit = (0.5 + np.arange(1, points + 1)[:, None] * steps) % 1.0
    return np.clip(_OVERSIZE * (2.0 * unit - 1.0), -1.0, 1.0)


def _batches(z: FloatArray, v: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    return [(z[k : k + _BATCH], v[k : k + _BATCH]) for k in range(0, len(z), _BATCH)]
