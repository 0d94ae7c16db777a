"""The nominal model refitted to a recording within its priors: what is left is the gap."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from experiments.gap.blind.rig import PITCH_QUANTUM, SPEED_NOISE, SPEED_QUANTUM, YAW_QUANTUM
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.greybox.map_fit import MapSettings, fit_from
from trms_cli.identification.greybox.windows import Windows
from trms_cli.identification.problem import PRIORS, FitProblem, free_parameters
from trms_cli.models.model import Model, names

FloatArray = npt.NDArray[np.float64]

#: What each sensor adds at least: its quantum's share, and the tachos' noise.
NOISE_SD = {
    "alpha_v": PITCH_QUANTUM / np.sqrt(12),
    "alpha_h": YAW_QUANTUM / np.sqrt(12),
    "omega_v": float(np.hypot(SPEED_NOISE, SPEED_QUANTUM / np.sqrt(12))),
    "omega_h": float(np.hypot(SPEED_NOISE, SPEED_QUANTUM / np.sqrt(12))),
}
_ITERATIONS = 40


class Refit(NamedTuple):
    """The nominal model at its best."""

    values: Mapping[str, float]  #: The free parameters
    #: (n_y,) array; root mean square of what is left in each output, over windows with free starts
    rms: FloatArray


def dataset_of(
    model: Model,
    time: FloatArray,
    commands: FloatArray,
    measured: FloatArray,
    name: str = "blind",
    *,
    noise_sd: Mapping[str, float] = NOISE_SD,
) -> Dataset:
    """A recording as fits take it.

    Parameters
    ----------
    time : (k,) array
    commands : (k, n_u) array
    measured : (k, n_y) array, or fewer columns
        As many of the model's outputs, in its order, as there are columns.
    noise_sd : dict of str to float
        Of each of them, in its unit.
    """
    outputs = tuple(model.outputs)[: measured.shape[1]]
    return Dataset(
        name=name,
        source=name,
        sha256="",
        sample_time=float(time[1] - time[0]),
        time=time,
        inputs=tuple(model.inputs),
        outputs=outputs,
        commands=np.ascontiguousarray(commands),
        measurements=np.ascontiguousarray(measured),
        noise_sd=np.array([noise_sd[name] for name in names(outputs)]),
    )


def refit(model: Model, recording: Dataset, window_length: float = 10.0) -> Refit:
    """Fit the model's parameters within their priors, from one start, in windows of some s."""
    free = free_parameters(model.parameters, [PRIORS])
    problem = FitProblem(
        model=model, datasets=(recording,), free=free, window_length=window_length, jobs=1
    )
    windows = Windows(problem)
    solution = fit_from(windows, problem.starts, MapSettings(iterations=_ITERATIONS))
    theta = solution.point.theta
    residuals = windows.residuals(problem.all_values(theta), solution.point.starts)
    count = windows.measured.sum(axis=(0, 1))
    rms: FloatArray = np.sqrt((residuals.r**2).sum(axis=(0, 1)) / count)
    values = dict(zip(problem.names, theta.tolist(), strict=True))
    return Refit(values, rms)
