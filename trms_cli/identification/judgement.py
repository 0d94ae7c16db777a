"""How far a model strays from recordings when it runs alone over windows.

Each window starts from a state that was estimated from the seconds before it, so that nothing of
the window has been seen. ``trms validate`` asks more of a model; this is the figure that a fit is
told by.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.identification.dataset import Dataset
from trms_cli.identification.greybox.starts import estimated_starts
from trms_cli.identification.validation.metrics import fit_percent, largest, rms
from trms_cli.identification.validation.window_start import fitted_starts
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model, Signal, index_of, names
from trms_cli.models.parameters import ParameterSet
from trms_cli.simulation.rollout import Rollout

FloatArray = npt.NDArray[np.float64]

#: s before a window from which its start is estimated.
HISTORY = 2.0
#: s; which parameters act does not depend on it.
_ANY_STEP = 0.01


@dataclass(frozen=True)
class Judged:
    """A model's free runs over one recording."""

    dataset: Dataset
    #: (n, n_y) array; in the order of the recording's outputs; NaN before the first window and
    #: after the last, infinite where the simulation overflowed
    simulated: FloatArray
    window: npt.NDArray[np.int64]  #: (m,) array of int; first sample of each window

    @property
    def errors(self) -> FloatArray:
        """Measured minus simulated, (n, n_y)."""
        errors: FloatArray = self.dataset.measurements - self.simulated
        return errors


def with_values(model: Model, values: Mapping[str, float]) -> Model:
    """The same model with other values of some parameters, also in the models beneath it."""
    changed = copy.copy(model)
    beneath = getattr(model, "base", None)
    if isinstance(beneath, Model):
        changed.base = with_values(beneath, values)  # type: ignore[attr-defined]
    changed.parameters = ParameterSet(
        (
            replace(parameter, value=float(values.get(parameter.name, parameter.value)))
            for parameter in model.parameters
        ),
        model.parameters.name,
    )
    return changed


def acting_parameters(model: Model) -> set[str]:
    """Names of the parameters on which the model's step or its outputs depend at all.

    A locked axis or a prescribed rotor leaves others without any part in the equations.
    """
    discrete = discretise(model, model.sample_time or _ANY_STEP, 1)
    found = set[str]()
    for function in (discrete.step, discrete.measurement):
        columns = function.jac_sparsity(0, function.index_in("p")).get_triplet()[1]
        found |= {model.parameters.names[column] for column in columns}
    return found


def judged(
    model: Model, datasets: Sequence[Dataset], length: float, *, jobs: int = 1
) -> list[Judged]:
    """Free runs over windows end to end.

    Parameters
    ----------
    model : Model
        With the values to be judged.
    datasets : sequence of Dataset
        A recording that is too short for any window is left out.
    length : float
        s.
    """
    found = []
    rollouts: dict[float, Rollout] = {}
    for dataset in datasets:
        step = dataset.sample_time
        rollout = rollouts.setdefault(step, Rollout(model, step, jobs=jobs))
        history = max(2, round(HISTORY / step))
        if len(dataset) < 2 * history:
            continue
        first, count = dataset.part(history, len(dataset)).windows(length)
        first = first + history
        before = np.full(len(first), history)
        prior = estimated_starts(rollout, dataset, first - history, model.parameters.values)
        with np.errstate(all="ignore"):
            _, starts = fitted_starts(
                model, rollout, dataset, first - history, before, prior.states[:, : model.n_x]
            )
            y = rollout.outputs(dataset.commands, first, count, starts).y
        simulated = np.full(dataset.measurements.shape, np.nan)
        columns = [index_of(model.outputs, s.name, "an output") for s in dataset.outputs]
        samples = np.concatenate([np.arange(a, a + c) for a, c in zip(first, count, strict=True)])
        simulated[samples] = np.where(np.isfinite(y[:, columns]), y[:, columns], np.inf)
        found.append(Judged(dataset, simulated, first))
    return found


def outputs_of(runs: Sequence[Judged]) -> tuple[Signal, ...]:
    """All outputs that any of the recordings measures, in their order."""
    found: dict[str, Signal] = {}
    for run in runs:
        found |= {signal.name: signal for signal in run.dataset.outputs}
    return tuple(found.values())


def figures(runs: Sequence[Judged]) -> dict[str, dict[str, Any]]:
    """RMS error, largest error and fit of each output over all recordings.

    Returns
    -------
    dict
        By output: ``rmse`` and ``max_abs_error`` in its unit, ``fit_percent``, ``unit``; None for
        a figure that does not exist. A simulation that overflowed has none.
    """
    table: dict[str, dict[str, Any]] = {}
    for signal in outputs_of(runs):
        errors, measured = [], []
        for run in runs:
            if signal.name in names(run.dataset.outputs):
                column = index_of(run.dataset.outputs, signal.name, "an output")
                errors.append(run.errors[:, column])
                measured.append(run.dataset.measurements[:, column])
        e, y = np.concatenate(errors), np.concatenate(measured)
        table[signal.name] = {
            "rmse": _plain(rms(e)),
            "max_abs_error": _plain(largest(e)),
            "fit_percent": _plain(fit_percent(e, y)),
            "unit": signal.unit,
        }
    return table


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
