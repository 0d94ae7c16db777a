"""How far the states of a model move: the scale on which their deviations compare."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import DiscreteModel

FloatArray = npt.NDArray[np.float64]


def typical_sizes(discrete: DiscreteModel) -> FloatArray:
    """How far each state of a model moves within seconds under full inputs, shape (n_x,).

    From rest, each input is held at either limit; the largest excursion counts. It makes one
    terminal price serve angles (rad) and rotor speeds (hundreds of rad/s) alike.
    """
    model = discrete.model
    step = BufferedFunction(discrete.step)
    sizes = np.full(model.n_x, 1e-3)
    lower, upper = model.input_bounds()
    for i in range(model.n_u):
        for bound in (lower[i], upper[i]):
            u = np.zeros(model.n_u)
            u[i] = bound
            start = discrete.initial(model.rest(), np.zeros(model.n_u))
            x = start.copy()
            for _ in range(max(1, round(2.0 / discrete.step_length))):
                x[:] = step.evaluate(x, u, model.parameters.values, np.zeros(model.n_w))[0]
                if not np.isfinite(x).all():
                    break
                sizes = np.maximum(sizes, np.abs(x - start)[: model.n_x])
    return sizes
