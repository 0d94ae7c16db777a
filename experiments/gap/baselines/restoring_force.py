"""The force that a model lacks, sample by sample, from smoothed derivatives of what was measured.

Angles and speeds are differentiated by local polynomials (Savitzky & Golay 1964, Anal. Chem. 36),
momenta follow by the model's own kinematics, and the generalised disturbance that makes the
model's derivative the measured one is solved for (the restoring-force method of Masri & Caughey
1979, J. Appl. Mech. 46). What is not measured is simulated from the beginning of the recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.compilation import compile_function
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.greybox.windows import StartEstimator
from trms_cli.models.model import Model
from trms_cli.models.state_kinds import kinds_of_states
from trms_cli.simulation.rollout import Rollout

#: s, over which a polynomial of the third degree is laid; and the fewest samples of it.
_REACH, _FEWEST, _DEGREE = 0.3, 7, 3
#: s between the samples at which a simulation of what is not measured is put right.
_ANCHORED = 0.2
#: s between the samples of a force.
_THINNED = 0.06


@dataclass(frozen=True)
class Motion:
    """Smoothed motion of a rig, with what a model lacks to follow it."""

    x: FloatArray  #: (n, n_x) array
    u: FloatArray  #: (n, n_u) array; smoothed by the same polynomials
    force: FloatArray  #: (n, n_w) array; in the disturbances' units
    #: (n, n_w, n_f) array; what a unit of each free parameter adds to the force
    of_parameters: FloatArray
    block: IntArray  #: (n,) array of int; blocks of time, for cross-validation
    step: float  #: s between two samples of one recording
    breaks: IntArray  #: (k,) array of int; samples at which a recording begins

    @property
    def independent(self) -> float:
        """How many samples the smoothed force is worth."""
        return len(self.force) / max(1.0, _REACH / self.step)


def motion(model: Model, datasets: Sequence[Dataset], free: Sequence[str], block: float) -> Motion:
    """Of all recordings, one after another; the ends of each, where derivatives are poor, left out.

    ``free``: parameters whose forces are wanted. ``block``: s.
    """
    step = datasets[0].sample_time
    equations, thin = _equations(model, tuple(free)), max(1, round(_THINNED / step))
    parts: list[tuple[npt.NDArray[Any], ...]] = []
    blocks, breaks = 0, []
    for dataset in datasets:
        x, u, derivative, good = _smoothed(model, equations, dataset)
        # Neighbours of a smoothed force say the same.
        rows = np.flatnonzero(good & (np.arange(len(dataset)) % thin == 0))
        x, u = x[rows], u[rows]
        force, slopes = equations.force(x, u, derivative[rows])
        of_block = np.arange(len(dataset)) * step // block + blocks
        blocks = int(of_block[-1]) + 1
        breaks.append(sum(len(p[0]) for p in parts))
        parts.append((x, u, force, slopes, of_block[rows]))
    x, u, force, slopes, of_block = (np.concatenate(a) for a in zip(*parts, strict=True))
    blocks_ = of_block.astype(np.int64)
    return Motion(x, u, force, slopes, blocks_, step * thin, np.array(breaks))


def savgol(values: FloatArray, step: float, order: int) -> FloatArray:
    """A derivative of each column by local polynomials."""
    from scipy.signal import savgol_filter

    reach = max(_FEWEST, round(_REACH / step)) // 2 * 2 + 1
    derivative: FloatArray = savgol_filter(values, reach, _DEGREE, deriv=order, delta=step, axis=0)
    return derivative


def _smoothed(
    model: Model, equations: _Equations, dataset: Dataset
) -> tuple[FloatArray, FloatArray, FloatArray, npt.NDArray[np.bool_]]:
    """States, commands, the states' derivatives, and where these can be believed."""
    n, step = len(dataset), dataset.sample_time
    x = (
        _unmeasured(model, dataset)
        if not equations.has_measured_states(dataset)
        else np.zeros((n, model.n_x))
    )
    derivative = savgol(x, step, 1)
    good = np.ones(n, dtype=bool)
    edge = max(_FEWEST, round(_REACH / step))
    good[:edge] = good[n - edge :] = False
    rates = {}
    for column, signal in zip(dataset.measurements.T, dataset.outputs, strict=True):
        present = np.isfinite(column)
        if signal.name not in model.state_names or not present.any():
            continue
        filled = np.interp(np.arange(n), np.flatnonzero(present), column[present])
        is_gap = np.convolve(~present, np.ones(edge), "same") > 0.5
        good &= ~is_gap
        i = model.state_index(signal.name)
        x[:, i], derivative[:, i] = savgol(filled, step, 0), savgol(filled, step, 1)
        rates[i] = derivative[:, i]
    # A command acts from its sample on: at the sample itself it has changed by half.
    before = np.vstack([dataset.commands[:1], dataset.commands[:-1]])
    u = savgol((before + dataset.commands) / 2, step, 0)
    momentum_states = equations.momenta(x, u, rates)
    derivative[:, momentum_states] = savgol(x[:, momentum_states], step, 1)
    return x, u, derivative, good


def _unmeasured(model: Model, dataset: Dataset) -> FloatArray:
    """States simulated from the beginning, put right by what is measured, (n, n_x)."""
    n = len(dataset)
    rollout = Rollout(model, dataset.sample_time)
    anchors = np.arange(0, n, max(1, round(_ANCHORED / dataset.sample_time)), dtype=np.int64)
    anchor_states = StartEstimator(rollout, dataset, anchors).at(model.parameters.values).states
    columns = [np.interp(np.arange(n), anchors, anchor_states[:, i]) for i in range(model.n_x)]
    return np.stack(columns, axis=1)


@lru_cache(maxsize=8)
def _equations(model: Model, free: tuple[str, ...]) -> _Equations:
    return _Equations(model, free)


class _Equations:
    """A model's equations of motion at many samples at once."""

    def __init__(self, model: Model, free: Sequence[str]) -> None:
        self._model = model
        x, u, p, w = model.symbols()
        f = model.dynamics(x, u, p, w)
        columns = [model.parameters.names.index(name) for name in free]
        pushes = ca.densify(ca.jacobian(f, w))
        of_p = ca.densify(ca.jacobian(f, p)[:, columns]) if columns else ca.SX(model.n_x, 0)
        self._f = compile_function(ca.Function("f", [x, u, p, w], [ca.densify(f), pushes, of_p]))
        kinds = kinds_of_states(model)
        self._angles = [i for i, kind in enumerate(kinds) if kind == "angle"]
        self._momenta = [i for i, kind in enumerate(kinds) if kind == "momentum"]
        rate = f[self._angles]
        slope = ca.densify(ca.jacobian(rate, x)[:, self._momenta])
        self._rate = compile_function(ca.Function("rate", [x, u, p, w], [ca.densify(rate), slope]))

    def has_measured_states(self, dataset: Dataset) -> bool:
        """Whether all states but the momenta are measured, and the angles that give those."""
        measured = {s.name for s in dataset.outputs}
        hidden = [i for i, name in enumerate(self._model.state_names) if name not in measured]
        return set(hidden) <= set(self._momenta)

    def _at(self, function: ca.Function, x: FloatArray, u: FloatArray) -> list[FloatArray]:
        """Results at each sample, (n, rows, columns)."""
        n = len(x)
        p = np.repeat(self._model.parameters.values[:, None], n, axis=1)
        results = function.map(n)(x.T, u.T, p, np.zeros((self._model.n_w, n)))
        shaped = []
        for i, result in enumerate(results):
            rows, columns = function.size_out(i)
            flat = np.array(ca.DM(result).full()).reshape(rows, n, columns)
            shaped.append(np.swapaxes(flat, 0, 1))
        return shaped

    def momenta(self, x: FloatArray, u: FloatArray, rates: dict[int, FloatArray]) -> list[int]:
        """Put in the momenta at which measured angles change as they do; which those are."""
        rows = [k for k, i in enumerate(self._angles) if i in rates]
        if not rows or not self._momenta:
            return []
        rate, slope = self._at(self._rate, x, u)
        rate_errors = np.stack([rates[self._angles[k]] for k in rows], axis=1) - rate[:, rows, 0]
        x[:, self._momenta] += np.einsum("nij,nj->ni", np.linalg.pinv(slope[:, rows]), rate_errors)
        return self._momenta

    def force(
        self, x: FloatArray, u: FloatArray, derivative: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Disturbances (n, n_w), and what parameters add to them (n, n_w, n_f)."""
        f, pushes, of_p = self._at(self._f, x, u)
        inverse = np.linalg.pinv(pushes)
        force = np.einsum("nwi,ni->nw", inverse, derivative - f[:, :, 0])
        return force, np.einsum("nwi,nif->nwf", inverse, of_p)
