"""Samples of a closed loop under the Python controller, for the exported one to be held against."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trms_cli.controllers.controller import ControlSample, ControlSetup
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import discretise
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import names
from trms_cli.references.trajectory import ReferenceTrajectory

FloatArray = npt.NDArray[np.float64]

#: N m, of the torques that stand for a filter's: no two are equal, as in a real loop.
_TORQUE_SD = 1e-4
_LONGEST_SUBSTEP = 0.02  # s


def example_rows(
    controller: NewtonMpc, setup: ControlSetup, reference: ReferenceTrajectory, samples: int
) -> FloatArray:
    """A closed loop with the model itself as the rig.

    Returns
    -------
    (samples, n) array
        Estimate, torques, references, last command, and the command that was chosen.
    """
    model, period = setup.model, setup.sample_time
    preview = controller.preview(setup)
    times = np.arange(samples + preview, dtype=np.float64) * period
    references = reference.restricted_to(model.controlled).sample(times)
    substeps = 1 if model.sample_time else max(1, int(np.ceil(period / _LONGEST_SUBSTEP)))
    discrete = discretise(model, period, substeps)
    step, p = BufferedFunction(discrete.step), model.parameters.values
    state = controller.init(setup)
    draw = np.random.default_rng(0)
    u, still = setup.first_command.copy(), np.zeros(model.n_w)
    full, rows = discrete.initial(model.rest(), u), []
    for k in range(samples):
        x = full[: model.n_x].copy()
        w = _TORQUE_SD * draw.standard_normal(model.n_w)
        seen = references[k : k + preview + 1]
        sample = ControlSample(k * period, seen, Estimate(x, 0 * x, w, 0 * w), u)
        chosen = controller.step(state, sample, want_prediction=False).u
        rows.append(np.concatenate([x, w, seen.ravel(), u, chosen]))
        u = chosen
        full = step.evaluate(full, u, p, still)[0].copy()
    return np.array(rows)


def rounding_difference(controller: NewtonMpc, setup: ControlSetup, rows: FloatArray) -> float:
    """How far the Python controller is from itself when estimates change in their last bit, V.

    No other implementation can be expected to be nearer.

    Parameters
    ----------
    rows : (samples, n) array
        From :func:`example_rows`.
    """
    model, state = setup.model, controller.init(setup)
    preview = controller.preview(setup)
    sizes = [model.n_x, model.n_w, len(model.controlled) * (preview + 1), model.n_u]
    draw, largest = np.random.default_rng(0), 0.0
    for k, row in enumerate(rows):
        x, w, r, u, chosen = np.split(row, np.cumsum(sizes))
        x = np.nextafter(x, draw.choice([-np.inf, np.inf], len(x)))
        seen = r.reshape(preview + 1, -1)
        sample = ControlSample(k * setup.sample_time, seen, Estimate(x, 0 * x, w, 0 * w), u)
        command = controller.step(state, sample, want_prediction=False)
        largest = max(largest, float(np.abs(command.u - chosen).max()))
    return largest


def example_csv(rows: FloatArray, setup: ControlSetup, preview: int) -> str:
    """The rows with a heading; every number reads back to the same bits."""
    model = setup.model
    columns = [
        *model.state_names,
        *(f"w_{name}" for name in names(model.disturbances)),
        *(f"r_{name}[{k}]" for k in range(preview + 1) for name in model.controlled),
        *(f"previous_{name}" for name in names(model.inputs)),
        *names(model.inputs),
    ]
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    return "# " + ",".join(columns) + "\n" + "\n".join(lines) + "\n"
