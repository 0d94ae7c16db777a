"""What inputs move and sensors see at a point and along a line, gathered for a report."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.models.model import Model, names
from trms_cli.stability.local.gramians import (
    controllability_gramian,
    hankel_values,
    observability_gramian,
    stationary_gramian,
    volts_to_move,
)
from trms_cli.stability.local.linear import Matrices
from trms_cli.stability.local.modes import Mode, modes_of
from trms_cli.stability.local.reach import Reach, controllable, observable
from trms_cli.stability.local.scales import MOTION, Scales
from trms_cli.stability.local.sweep import Path, Sweep

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Gramians:
    """Gramians at a point, states and inputs scaled (a full command is 1, a motion is 1)."""

    #: ``reach``, ``sight``: (n, n) arrays; of controllability and of observability over the finite
    #: time
    reach: FloatArray
    sight: FloatArray
    #: ``reach_forever``, ``sight_forever``: (n, n) arrays or None; of a stable system for ever
    reach_forever: FloatArray | None
    sight_forever: FloatArray | None
    #: (n,) array or None; hankel singular values of a stable system, largest first
    hankel: FloatArray | None
    residual: float | None  #: Largest entry of ``A W + W Aᵀ + B Bᵀ`` relative to that of ``B Bᵀ``


def gramians(matrices: Matrices, scales: Scales, duration: float) -> Gramians:
    """The scaled Gramians of all inputs and all sensors."""
    step = matrices.sample_time
    a = matrices.a * scales.x[None, :] / scales.x[:, None]
    b = matrices.b * scales.u[None, :] / scales.x[:, None]
    c = matrices.c * scales.x[None, :] / scales.y[:, None]
    forever, seen = stationary_gramian(a, b, step), stationary_gramian(a.T, c.T, step)
    hankel, residual = None, None
    if forever is not None and seen is not None:
        hankel = hankel_values(forever, seen)
        drive = b @ b.T
        balance = (
            a @ forever + forever @ a.T + drive
            if step is None
            else a @ forever @ a.T - forever + drive / step
        )
        residual = float(np.abs(balance).max() / np.abs(drive).max())
    return Gramians(
        controllability_gramian(a, b, duration, step),
        observability_gramian(a, c, duration, step),
        forever,
        seen,
        hankel,
        residual,
    )


def volts_table(model: Model, matrices: Matrices, scales: Scales, duration: float) -> FloatArray:
    """Least rms command of each input alone that moves each state by its size, (n_x, n_u)."""
    found = np.empty((model.n_x, model.n_u))
    for j in range(model.n_u):
        b = (matrices.b[:, [j]]) / scales.x[:, None]
        a = matrices.a * scales.x[None, :] / scales.x[:, None]
        gramian = controllability_gramian(a, b, duration, matrices.sample_time)
        for i in range(model.n_x):
            found[i, j] = volts_to_move(gramian, np.eye(model.n_x)[i], 1.0, duration)
    return found


@dataclass(frozen=True)
class ModeAccess:
    """What acts on a mode and sees it."""

    mode: Mode
    by_input: tuple[Reach, ...]  #: Each input alone, then all together
    by_sensors: tuple[Reach, ...]  #: Each set


def mode_access(
    model: Model,
    matrices: Matrices,
    scales: Scales,
    sets: tuple[tuple[str, ...], ...],
    duration: float,
) -> tuple[ModeAccess, ...]:
    """The PBH test of each mode, by each input and each set of sensors."""
    known = list(names(model.outputs))
    inputs = [[j] for j in range(model.n_u)]
    if model.n_u > 1:
        inputs.append(list(range(model.n_u)))
    return tuple(
        ModeAccess(
            mode,
            tuple(controllable(matrices, scales, mode, chosen, duration) for chosen in inputs),
            tuple(
                observable(matrices, scales, mode, [known.index(name) for name in one])
                for one in sets
            ),
        )
        for mode in modes_of(model, matrices).modes
    )


@dataclass(frozen=True)
class ReachAlong:
    """What each input alone moves along a line of operating points."""

    #: (n, n_c, n_u) array; how far each controlled state is moved in the time given by one unit
    #: (rms) of each input, at best; 0 where it is not
    per_volt: FloatArray
    #: (n, n_c, n_u) array; PBH margin of the slowest mode of that state's axis by each input, 1/s
    margin: FloatArray


def reach_along(path: Path, sweep: Sweep, scales: Scales, duration: float) -> ReachAlong:
    """Evaluate a sweep."""
    model = path.model
    rows = [model.state_index(name) for name in model.controlled]
    axis_of = {axis.angle: name for name, axis in model.axes.items()}
    shape = (len(sweep.places), len(rows), model.n_u)
    per_volt, margin = np.zeros(shape), np.full(shape, np.nan)
    for k, place in enumerate(sweep.places):
        matrices = path.linear.matrices(place.point.x, place.point.u, path.side, place.held.p)
        modes = modes_of(model, matrices).modes
        for j in range(model.n_u):
            gramian = controllability_gramian(
                matrices.a, matrices.b[:, [j]], duration, matrices.sample_time
            )
            for i, row in enumerate(rows):
                volts = volts_to_move(gramian, np.eye(model.n_x)[row], MOTION, duration)
                per_volt[k, i, j] = MOTION / volts
                mode = _of_axis(modes, axis_of.get(model.controlled[i], ""), row)
                if mode is not None:
                    margin[k, i, j] = controllable(matrices, scales, mode, [j], duration).margin
    return ReachAlong(per_volt, margin)


def _of_axis(modes: tuple[Mode, ...], axis: str, row: int) -> Mode | None:
    """The mode that a state takes part in most, of those named after its axis if there are any."""
    own = [mode for mode in modes if axis and mode.name.startswith(axis)] or list(modes)
    return max(own, key=lambda mode: mode.participation[row], default=None)
