"""A linear discrete-time model about an operating point, as data.

    x(k+1) − x₀ = A (x(k) − x₀) + B (u(k) − u₀) + E w(k) + v(k)      y(k) = the first n_y states

``x₀`` and ``u₀`` are the operating point: the mean of the recordings, if nothing else was chosen.
Outputs stand first in the state under their own names and in their own units, so that a reference
for an angle is one for a state. A command acts from the next sample on: there is no feed-through.

``w`` has an acceleration for each output, which is zero unless an observer estimates it; ``v`` is
the noise of the states that was estimated with the model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from trms_cli.core.errors import ModelError
from trms_cli.models.model import FloatArray
from trms_cli.models.network import from_plain_data

_SIGNALS = ("outputs", "inputs", "states")


@dataclass(frozen=True, eq=False)
class DiscreteStateSpace:
    """Matrices and operating point, with the names of all signals.

    Raises ModelError for shapes that do not fit and figures that are not finite.
    """

    outputs: tuple[str, ...]  #: Names; the first states
    inputs: tuple[str, ...]  #: Names
    states: tuple[str, ...]  #: Names of the states after the outputs
    output_units: tuple[str, ...]
    input_units: tuple[str, ...]
    state_units: tuple[str, ...]
    sample_time: float  #: s
    operating_state: FloatArray  #: (n,), x₀ in the states' units
    operating_input: FloatArray  #: (n_u,), u₀ in the inputs' units
    A: FloatArray  #: (n, n)
    B: FloatArray  #: (n, n_u)
    E: FloatArray  #: (n, n_y), by which accelerations of the outputs act
    noise_sd: FloatArray  #: (n,), standard deviation of v in a step, in the states' units

    def __post_init__(self) -> None:
        for kind in _SIGNALS:
            units = f"{kind[:-1]}_units"
            for key in (kind, units):
                object.__setattr__(self, key, tuple(map(str, getattr(self, key))))
            if len(getattr(self, units)) != len(getattr(self, kind)):
                raise ModelError(
                    f"{len(getattr(self, units))} units of {len(getattr(self, kind))} {kind}",
                    where=units,
                    remedy="give one unit for each",
                )
        all_names = (*self.outputs, *self.states)
        if not self.outputs or not self.inputs or len(set(all_names)) < len(all_names):
            raise ModelError(
                f"states {', '.join(all_names)} and inputs {', '.join(self.inputs)}",
                where="outputs",
                remedy="there is at least one output and one input, and no name occurs twice",
            )
        is_number = isinstance(self.sample_time, int | float)
        if not (is_number and 0 < self.sample_time < np.inf):
            raise ModelError(
                f"{self.sample_time!r} given", where="sample_time", remedy="a positive time in s"
            )
        n, n_u = len(all_names), len(self.inputs)
        shapes = {"operating_state": (n,), "operating_input": (n_u,), "A": (n, n), "B": (n, n_u)}
        shapes |= {"E": (n, len(self.outputs)), "noise_sd": (n,)}
        for key, shape in shapes.items():
            object.__setattr__(self, key, _array(getattr(self, key), shape, key))

    @property
    def n_x(self) -> int:
        return len(self.operating_state)

    @property
    def n_y(self) -> int:
        return len(self.outputs)

    @property
    def poles(self) -> FloatArray:
        """Eigenvalues of A, largest modulus first, complex."""
        values = np.linalg.eigvals(self.A)
        return np.asarray(values[np.argsort(-np.abs(values), kind="stable")])

    @property
    def spectral_radius(self) -> float:
        """Largest modulus of a pole; below 1 the free run stays bounded."""
        return float(np.abs(self.poles[0]))

    def static_gain(self) -> FloatArray:
        """Change of the outputs at rest by a unit of each input, (n_y, n_u); NaN at a pole of 1."""
        try:
            gain = np.linalg.solve(np.eye(self.n_x) - self.A, self.B)
        except np.linalg.LinAlgError:
            gain = np.full(self.B.shape, np.nan)
        return np.asarray(gain[: self.n_y])

    def simulate(self, start: FloatArray, inputs: FloatArray) -> FloatArray:
        """Outputs of a free run from a state (n,) under commands (m, n_u), (m, n_y).

        Not finite after a divergence.
        """
        drive = (inputs - self.operating_input) @ self.B.T
        deviations = np.empty((len(inputs), self.n_x))
        state = np.asarray(start) - self.operating_state
        with np.errstate(over="ignore", invalid="ignore"):
            for k, push in enumerate(drive):
                deviations[k] = state
                state = self.A @ state + push
        return np.asarray((deviations + self.operating_state)[:, : self.n_y])

    def start_from(self, outputs: FloatArray, inputs: FloatArray) -> FloatArray:
        """The state at the first of some samples that explains them best, (n,).

        ``outputs``: (m, n_y), NaN where missing. ``inputs``: (m, n_u). Where the samples leave a
        direction open, it is as at the operating point; the size of a state is taken for that of
        its output's scatter.
        """
        forced = self.simulate(self.operating_state, inputs)
        rows, power = [], np.eye(self.n_x)[: self.n_y]
        for _ in range(len(outputs)):
            rows.append(power)
            power = power @ self.A
        there = np.isfinite(outputs)
        scale = np.where(there.any(axis=0), np.nanstd(outputs, axis=0), 1.0)
        scale = np.where(scale > 0, scale, 1.0)
        system = np.stack(rows) / scale[:, None]
        error = (outputs - forced) / scale
        deviation, *_ = np.linalg.lstsq(system[there], error[there], rcond=1e-8)
        return np.asarray(self.operating_state + deviation)

    def to_data(self) -> dict[str, Any]:
        """Plain data for a YAML file; read back, every bit is there."""
        data: dict[str, Any] = {}
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, tuple):
                value = list(value)
            data[item.name] = value.tolist() if isinstance(value, np.ndarray) else value
        return data

    @classmethod
    def from_data(cls, data: Mapping[str, Any], where: str = "state_space") -> DiscreteStateSpace:
        """The state space of :meth:`to_data`.

        Raises ModelError for a key that is missing or unknown, and for figures that do not fit; it
        names the key.
        """
        return from_plain_data(cls, data, where, "write it as fitted")


def _array(value: Any, shape: Sequence[int], where: str) -> FloatArray:
    try:
        result = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ModelError("not an array of numbers", where=where, remedy="fit again") from None
    if result.shape != tuple(shape) or not np.all(np.isfinite(result)):
        problem = "not finite" if result.shape == tuple(shape) else f"shape {result.shape}"
        raise ModelError(problem, where=where, remedy=f"finite numbers of shape {tuple(shape)}")
    result.setflags(write=False)
    return result
