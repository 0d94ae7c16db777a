"""A model made linear at an operating point, for designs that need one.

The yaw of the rig is uncontrollable where the tail rotor stands still: its thrust goes as ω|ω|,
with no slope at ω_h = 0. A point to linearise at has ω_h ≠ 0, as at any yaw that the cable pulls
back from; :func:`require_drivable` refuses the others.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.models.discretisation import DiscreteModel, discretise
from trms_cli.models.model import Model
from trms_cli.models.steady_state import SteadyState, Target
from trms_cli.models.vector_field import without_impulses

#: Longest explicit integration step over which the rig's dynamics are smooth, s.
_LONGEST_SUBSTEP = 0.02
#: Least share of the strongest direction that the weakest must have to count as driven.
_LEAST_SHARE = 1e-3
#: Growth rate at which that is judged, 1/s: slow beside the rig, and an axis that nothing pulls
#: back, whose gain at rest has no bound, does not outshine the other.
_ALMOST_STEADY = 0.02


@dataclass(frozen=True)
class LinearModel:
    """``x⁺ = A x + B u``, ``y = C x`` around a steady state, y the controlled angles."""

    discrete: DiscreteModel  #: Its states, memory of the input path included, are those of ``A``
    target: Target  #: The steady state
    A: FloatArray  #: (n, n) array
    B: FloatArray  #: (n, n_u) array
    C: FloatArray  #: (n_r, n) array

    @property
    def step_length(self) -> float:
        return self.discrete.step_length


class Linearisation:
    """Linear models of one model over one step, at any steady state.

    ``step_length``: s. ``steady``: of this model.
    """

    def __init__(self, model: Model, step_length: float, steady: SteadyState) -> None:
        substeps = max(1, int(np.ceil(step_length / _LONGEST_SUBSTEP)))
        self.model = model
        self._steady = steady
        self._discrete = discretise(without_impulses(model), step_length, substeps)
        # Evaluated a few times only: not worth compiling.
        self._slopes = self._discrete.slopes()

    def at(self, angles: Mapping[str, float], where: str) -> LinearModel:
        """The linear model where the rig rests at the given controlled angles.

        Raises ConfigurationError for a name that is no angle, or if the rig cannot rest there.

        ``angles``: rad, by controlled angle; where none is given 0, or of a model with signals of
        its own as at rest. Angles of an axis that this model does not have are ignored. ``where``:
        configuration key of ``angles``, for messages.
        """
        model, discrete = self.model, self._discrete
        angle_names = {"alpha_v", "alpha_h", *model.controlled}
        for name in angles:
            require_known(name, angle_names, f"{name!r} is not a controlled angle", where)
        rest = np.zeros(model.n_x) if model.bench_sizes else model.rest()
        rows = [model.state_index(name) for name in model.controlled]
        reference = np.array(
            [angles.get(n, rest[row]) for n, row in zip(model.controlled, rows, strict=True)]
        )
        target = self._steady.solve(reference)
        if not target.exact:
            units = [model.states[row].unit for row in rows]
            goal, reached = (
                ", ".join(
                    f"{n}={v:.3g} {unit}"
                    for n, v, unit in zip(model.controlled, values, units, strict=True)
                )
                for values in (reference, target.reference_reached)
            )
            raise ConfigurationError(
                f"the rig cannot rest at {goal}",
                where=where,
                remedy=f"the closest that it can: {reached}",
            )
        full = discrete.initial(target.x, target.u)
        _, A, B = (
            np.array(value)
            for value in self._slopes(full, target.u, model.parameters.values, np.zeros(model.n_w))
        )
        C = np.zeros((len(model.controlled), discrete.n_x))
        for row, name in enumerate(model.controlled):
            C[row, model.state_index(name)] = 1.0
        return LinearModel(discrete, target, A, B, C)


def require_drivable(linear: LinearModel, where: str, constant: Sequence[int] = ()) -> None:
    """Refuse an operating point from which some controlled angle cannot be held.

    Two conditions for a linear controller with integral action to exist: the inputs can give every
    combination of controlled angles in steady state (no zero at z = 1), and they move every mode
    that does not decay by itself (Popov, Belevitch and Hautus).

    Raises ConfigurationError with the angle or mode that is not driven, and a point that will do.

    ``constant``: positions of states that are taken to stay where they are.
    """
    model = linear.discrete.model
    names_of_angles = model.controlled
    kept = np.setdiff1d(np.arange(linear.A.shape[0]), constant)
    A, B, C = linear.A[np.ix_(kept, kept)], linear.B[kept], linear.C[:, kept]
    gain = _gain(A, B, C, math.exp(_ALMOST_STEADY * linear.step_length))
    output_directions, strength, _ = np.linalg.svd(gain)
    if strength[-1] < _LEAST_SHARE * strength[0] or not np.all(np.isfinite(gain)):
        weakest = names_of_angles[int(np.argmax(np.abs(output_directions[:, -1])))]
        # One point of a list cannot be typed by itself.
        other = f"{weakest}: 0.5 in it" if where.endswith("]") else f"{where}.{weakest}=0.5"
        raise ConfigurationError(
            f"no input holds {weakest} at this operating point: its mode is uncontrollable "
            "(a rotor that stands still has a thrust without slope)",
            where=where,
            remedy=f"choose one with the rotor turning, as {other}",
        )
    values, left_vectors = np.linalg.eig(A.T)
    scale = 1.0 / np.maximum(np.abs(left_vectors).max(axis=0), 1e-300)
    for value, vector in zip(values, (left_vectors * scale).T, strict=True):
        if abs(value) >= 1.0 and np.abs(vector @ B).max() < 1e-9:
            state = linear.discrete.states[kept[int(np.argmax(np.abs(vector)))]].name
            raise ConfigurationError(
                f"a mode of {state} (z = {value:.4g}) does not decay and no input moves it",
                where=where,
                remedy="choose another operating point, or leave that state out of the model",
            )


def _gain(A: FloatArray, B: FloatArray, C: FloatArray, z: float) -> FloatArray:
    """Of the controlled angles to the inputs at z, rad/V, shape (n_r, n_u)."""
    return np.asarray(C @ np.linalg.solve(z * np.eye(A.shape[0]) - A, B))
