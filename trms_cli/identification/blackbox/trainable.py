"""Networks with free weights: values, exact slopes in weights and regressors, starting weights.

All weights stand in one vector θ; normalised regressors z come in and normalised outputs go out.
What a trained network computes is stated by :class:`trms_cli.models.network.Network`; a test
holds the two together.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import ClassVar, Protocol

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.models.network import Activation, Kind, activated


class TrainableNetwork(Protocol):
    """What losses and training ask of a network; n samples at once, P weights."""

    @property
    def kind(self) -> Kind: ...
    @property
    def n_regressors(self) -> int: ...
    @property
    def n_outputs(self) -> int: ...
    @property
    def n_parameters(self) -> int: ...

    def values(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Outputs, ``(P,), (n, n_z) -> (n, n_out)``."""

    def slopes(self, theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Outputs (n, n_out), their slopes in θ (n, n_out, P) and in z (n, n_out, n_z)."""

    def pulled_back(
        self, theta: FloatArray, z: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Slopes of ``Σ weight · output`` (weight (n, n_out)) in θ (P,) and in z (n, n_z)."""

    def weights(self, theta: FloatArray) -> dict[str, FloatArray]:
        """The weights by the names that a stored network has."""


#: Slope of each activation by what the unit gives, a.
_ACTIVATION_SLOPES: dict[Activation, Callable[[FloatArray], FloatArray]] = {
    "tanh": lambda a: 1.0 - a**2,
    "logistic": lambda a: a * (1.0 - a),
    "softplus": lambda a: -np.expm1(-a),
    "linear": np.ones_like,
}


@dataclass(frozen=True)
class Mlp:
    """Perceptron with hidden layers of one activation and a linear output layer."""

    n_regressors: int
    n_outputs: int
    hidden: tuple[int, ...]  #: Units of each hidden layer
    direct: bool = False  #: A direct linear part from the regressor to the output
    activation: Activation = "tanh"  #: Of the hidden layers

    kind: ClassVar[Kind] = "mlp"

    @cached_property
    def _layout(self) -> dict[str, tuple[slice, tuple[int, ...]]]:
        """Place in θ and shape of each block of weights."""
        sizes = (self.n_regressors, *self.hidden, self.n_outputs)
        shapes: dict[str, tuple[int, ...]] = {}
        for layer, (before, after) in enumerate(pairwise(sizes), start=1):
            shapes |= {f"W{layer}": (after, before), f"b{layer}": (after,)}
        if self.direct:
            shapes["A"] = (self.n_outputs, self.n_regressors)
        return layout_of(shapes)

    @property
    def n_parameters(self) -> int:
        return max(place.stop for place, _ in self._layout.values())

    def weights(self, theta: FloatArray) -> dict[str, FloatArray]:
        return {name: theta[at].reshape(shape) for name, (at, shape) in self._layout.items()}

    def start(self, generator: np.random.Generator) -> FloatArray:
        """Random weights after Nguyen & Widrow (1990), (P,).

        Each hidden unit's active region is spread over the box |z| ≤ 2; the output layer starts
        small, the direct part at zero. A logistic unit is a tanh of half its sum, so its weights
        are twice as large.
        """
        steep = 2.0 if self.activation == "logistic" else 1.0
        theta = np.zeros(self.n_parameters)
        sizes = (self.n_regressors, *self.hidden)
        w = self.weights(theta)  # views
        for layer, (before, after) in enumerate(pairwise(sizes), start=1):
            reach = 0.7 * steep * after ** (1.0 / before)
            weights = generator.uniform(-1.0, 1.0, (after, before))
            weights *= reach / np.linalg.norm(weights, axis=1, keepdims=True)
            w[f"W{layer}"][...] = weights / (2.0 if layer == 1 else 1.0)
            w[f"b{layer}"][...] = generator.uniform(-reach, reach, after)
        last = len(sizes)
        scale = 0.5 / np.sqrt(sizes[-1])
        w[f"W{last}"][...] = generator.uniform(-scale, scale, (self.n_outputs, sizes[-1]))
        return theta

    def values(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        w = self.weights(theta)
        return self._output(w, z, self._activations(w, z))

    def slopes(self, theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        w = self.weights(theta)
        active = self._activations(w, z)
        n, n_out = len(z), self.n_outputs
        jacobian = np.zeros((n, n_out, self.n_parameters))
        last = len(self.hidden) + 1
        for o in range(n_out):
            h = active[-1].shape[1]
            first = self._layout[f"W{last}"][0].start + o * h
            jacobian[:, o, first : first + h] = active[-1]
            jacobian[:, o, self._layout[f"b{last}"][0].start + o] = 1.0
        back = np.broadcast_to(w[f"W{last}"], (n, *w[f"W{last}"].shape))
        for layer in range(last - 1, 0, -1):
            back = back * _ACTIVATION_SLOPES[self.activation](active[layer])[:, None, :]
            outer = back[:, :, :, None] * active[layer - 1][:, None, None, :]
            jacobian[:, :, self._layout[f"W{layer}"][0]] = outer.reshape(n, n_out, -1)
            jacobian[:, :, self._layout[f"b{layer}"][0]] = back
            back = back @ w[f"W{layer}"]
        if self.direct:
            for o in range(n_out):
                first = self._layout["A"][0].start + o * self.n_regressors
                jacobian[:, o, first : first + self.n_regressors] = z
            back = back + w["A"]
        return self._output(w, z, active), jacobian, back

    def pulled_back(
        self, theta: FloatArray, z: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        w = self.weights(theta)
        active = self._activations(w, z)
        result = np.empty_like(theta)
        slope = self.weights(result)  # views
        back = weight
        for layer in range(len(self.hidden) + 1, 0, -1):
            slope[f"W{layer}"][...] = back.T @ active[layer - 1]
            slope[f"b{layer}"][...] = back.sum(axis=0)
            back = back @ w[f"W{layer}"]
            if layer > 1:
                back = back * _ACTIVATION_SLOPES[self.activation](active[layer - 1])
        if self.direct:
            slope["A"][...] = weight.T @ z
            back = back + weight @ w["A"]
        return result, back

    def _activations(self, w: dict[str, FloatArray], z: FloatArray) -> list[FloatArray]:
        active = [z]
        for layer in range(1, len(self.hidden) + 1):
            sums = active[-1] @ w[f"W{layer}"].T + w[f"b{layer}"]
            active.append(activated(self.activation, sums))
        return active

    def _output(
        self, w: dict[str, FloatArray], z: FloatArray, active: list[FloatArray]
    ) -> FloatArray:
        last = len(self.hidden) + 1
        result = active[-1] @ w[f"W{last}"].T + w[f"b{last}"]
        return result + z @ w["A"].T if self.direct else result


def layout_of(shapes: dict[str, tuple[int, ...]]) -> dict[str, tuple[slice, tuple[int, ...]]]:
    """Place in one vector and shape of named blocks, one after another."""
    layout, first = {}, 0
    for name, shape in shapes.items():
        size = int(np.prod(shape))
        layout[name] = (slice(first, first + size), shape)
        first += size
    return layout
