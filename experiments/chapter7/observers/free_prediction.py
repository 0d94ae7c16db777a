"""Free prediction from an estimate: what a filter is worth to who plans with its state.

At every so many seconds of a recording the model starts in the filter's estimate and goes on alone,
with the commands that were recorded and the estimated torques held; what it says of a measured
channel a horizon later is set beside what was measured there. One sample ahead a filter is judged
by how it weighs its sensors; seconds ahead by whether its momenta and torques are right.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model, names

FloatArray = npt.NDArray[np.float64]


def free_errors(
    model: Model,
    sample_time: float,
    series: Mapping[str, FloatArray],
    channels: Sequence[str],
    horizons: Sequence[float],
    every: float,
    begin: float = 0.0,
) -> dict[str, dict[str, float]]:
    """RMSE at each horizon by measured channel that is a state of the model.

    Parameters
    ----------
    sample_time, every, begin : float
        s; of the recording, between two starts, and before the first one.
    series : mapping of str to (n,) array
        By name: estimated states and torques (``pitch_moment``, …) as they are, commands, and
        measurements as ``y_<channel>``.
    horizons : sequence of float
        s.
    """
    import casadi as ca

    discrete = discretise(model, sample_time)
    steps = [round(horizon / sample_time) for horizon in horizons]
    n = len(next(iter(series.values())))
    first = np.arange(
        round(begin / sample_time), n - max(steps), max(1, round(every / sample_time))
    )
    x = np.stack([series[name] for name in model.state_names])[:, first]
    commands = np.stack([series[name] for name in names(model.inputs)])
    torques = [series.get(name, np.zeros(n)) for name in names(model.disturbances)]
    w = np.stack(torques)[:, first] if torques else np.zeros((0, len(first)))
    z = np.stack([discrete.initial(x[:, i], commands[:, k]) for i, k in enumerate(first)], axis=1)
    step = discrete.step.map(len(first))
    p = ca.repmat(ca.DM(model.parameters.values), 1, len(first))
    squares: dict[str, dict[str, float]] = {
        name: {} for name in channels if name in model.state_names
    }
    for k in range(1, max(steps) + 1):
        z = np.array(step(z, commands[:, first + k - 1], p, w))
        for horizon, of in zip(horizons, steps, strict=True):
            if of != k:
                continue
            for name, errors in squares.items():
                gap = z[model.state_index(name)] - series[f"y_{name}"][first + k]
                errors[f"{horizon:g}"] = float(np.sqrt(np.nanmean(gap**2)))
    return squares
