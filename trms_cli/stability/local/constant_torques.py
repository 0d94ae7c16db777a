"""Sets of sensors that are worth a comparison.

Which constant torques some sensors tell, and how well.

A constant torque is a state without a rate beside the others, ``ẋ = A x + e d, ḋ = 0``. What the
sensors see of (A, C) at all is found first: the span of Cᵀ under the resolvent ``(A − μI)⁻ᵀ``,
which has the same invariant subspaces as A and no fast modes that would swamp the slow ones. In
that quotient the torque is observable if and only if ``[A e; C 0]`` has full column rank; several
torques are told at once as far as the rank goes (Davison & Smith 1971, Automatica 7).

The error is that of the best linear estimate from readings with white noise over a time, the
initial state known to ten motions worth speaking of (1 rad, 1 rad/s) and the torque not at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.models.model import Model, names
from trms_cli.stability.local.access import Scales, observability_gramian
from trms_cli.stability.local.linear import Matrices


def sensor_sets(
    model: Model, given: Sequence[Sequence[str]] | None, where: str = "study.sensors"
) -> tuple[tuple[str, ...], ...]:
    """The sets asked for, or the usual ones.

    The usual ones are everything, the angles with each tachometer, the angles alone, and each
    sensor alone.

    Raises ConfigurationError for a name that the model does not measure, and for an empty set.
    """
    known = names(model.outputs)
    if given is not None:
        for one in given:
            for name in one:
                if name not in known:
                    raise ConfigurationError(
                        f"{name!r} is not measured", where=where, remedy=nearest(name, known)
                    )
            if not one:
                raise ConfigurationError(
                    "an empty set of sensors given",
                    where=where,
                    remedy="give names, as 'study.sensors=[[alpha_v,alpha_h],[alpha_v]]'",
                )
        return tuple(tuple(dict.fromkeys(one)) for one in given)
    angles = tuple(signal.name for signal in model.outputs if signal.unit == "rad")
    others = [name for name in known if name not in angles]
    sets = [known, *((*angles, name) for name in others), angles, *((name,) for name in known)]
    return tuple(dict.fromkeys(one for one in sets if one))


def set_words(model: Model, sensors: Sequence[str]) -> str:
    """``all``, ``angles``, ``angles, omega_v``, ``alpha_v``."""
    known = names(model.outputs)
    if len(sensors) == len(known) and len(known) > 1:
        return "all"
    angles = tuple(signal.name for signal in model.outputs if signal.unit == "rad")
    if len(angles) > 1 and set(angles) <= set(sensors):
        return ", ".join(["angles", *(name for name in sensors if name not in angles)])
    return ", ".join(sensors)


#: Directions that are this small beside the others are none.
_RANK = 1e-6
#: 1/s: where the resolvent is taken, beside what a rig's eigenvalues are likely to be.
_SHIFT = 0.7391
#: Standard deviation of the initial state in motions worth speaking of.
_PRIOR = 10.0


@dataclass(frozen=True)
class TorqueEstimate:
    """Whether sensors tell a constant torque."""

    name: str  #: Of the disturbance
    seen: bool  #: If it is the only one
    #: Standard deviation of its estimate after each of the times asked for, in its unit; None where
    #: it is not seen
    errors: tuple[float | None, ...]


@dataclass(frozen=True)
class TorqueEstimates:
    """All constant torques by one set of sensors."""

    torques: tuple[TorqueEstimate, ...]
    together: int  #: How many of them can be told at once


def torque_estimates(
    matrices: Matrices,
    scales: Scales,
    outputs: list[int],
    names: tuple[str, ...],
    durations: tuple[float, ...],
    reading_time: float,
) -> TorqueEstimates:
    """Which constant torques some sensors, by their positions, tell.

    Torques by their names are columns of ``matrices.e``; errors are after each of the durations (s)
    of readings ``reading_time`` (s) apart; a model that steps is read at each step.
    """
    step = matrices.sample_time
    a = matrices.a * scales.x[None, :] / scales.x[:, None]
    e = matrices.e / scales.x[:, None]
    c = (matrices.c * scales.x[None, :] / scales.y[:, None])[outputs]
    steady = a if step is None else a - np.eye(len(a))
    basis = _seen_basis(steady, c)
    own_a, own_c, own_e = basis.T @ steady @ basis, c @ basis, basis.T @ e
    sizes = np.abs(own_e).max(axis=0, initial=0.0)
    acts = sizes > _RANK * np.abs(e).max(axis=0, initial=0.0)
    found = []
    for j, name in enumerate(names):
        seen = bool(acts[j]) and _rank(own_a, own_e[:, [j]], own_c) == len(own_a) + 1
        errors = tuple(
            _error(a, e[:, [j]], c, duration, step, reading_time) if seen else None
            for duration in durations
        )
        found.append(TorqueEstimate(name, seen, errors))
    together = _rank(own_a, own_e[:, acts], own_c) - len(own_a) if acts.any() else 0
    return TorqueEstimates(tuple(found), together)


def _error(
    a: FloatArray,
    column: FloatArray,
    c: FloatArray,
    duration: float,
    step: float | None,
    reading_time: float,
) -> float | None:
    """Standard deviation of the torque's estimate."""
    n = len(a)
    size = float(np.abs(column).max())
    joint = np.block(
        [[a, column / size], [np.zeros((1, n)), np.eye(1) * (0.0 if step is None else 1.0)]]
    )
    read = np.hstack([c, np.zeros((len(c), 1))])
    information = observability_gramian(joint, read, duration, step)
    # Readings add up as an integral over the time between two of them; a step is a reading.
    information = information / reading_time if step is None else information * step
    information[np.arange(n), np.arange(n)] += _PRIOR**-2
    # The information that is left of the torque when the state is estimated with it.
    known = information[:n, :n]
    cross = information[:n, n]
    left = float(information[n, n] - cross @ np.linalg.solve(known, cross))
    if left <= 1e-12 * information[n, n]:
        return None
    return float(1.0 / (np.sqrt(left) * size))


def _seen_basis(a: FloatArray, c: FloatArray) -> FloatArray:
    """Orthonormal basis of what C sees of A, (n, k)."""
    n = len(a)
    resolvent = np.linalg.inv(a - _SHIFT * np.eye(n)).T
    basis = np.zeros((n, 0))
    fresh = c.T
    for _ in range(n):
        added = []
        for column in fresh.T:
            size = float(np.linalg.norm(column))
            if size == 0.0:
                continue
            rest = column / size
            for _ in range(2):  # twice is enough: Gram–Schmidt loses digits once
                rest = rest - basis @ (basis.T @ rest)
            left = float(np.linalg.norm(rest))
            if left > _RANK:
                added.append(rest / left)
                basis = np.hstack([basis, (rest / left)[:, None]])
        if not added:
            break
        fresh = resolvent @ np.array(added).T
    return basis


def _rank(a: FloatArray, e: FloatArray, c: FloatArray) -> int:
    """Rank of [A e; C 0], its rows and columns brought to one size."""
    whole = np.block([[a, e], [c, np.zeros((len(c), e.shape[1]))]])
    for axis in (1, 0, 1, 0):
        size = np.abs(whole).max(axis=axis, keepdims=True)
        whole = whole / np.where(size > 0, size, 1.0)
    return int(np.linalg.matrix_rank(whole, tol=_RANK))
