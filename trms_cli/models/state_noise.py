"""What noise adds to the states of a model in a step, as a number for each state."""

from __future__ import annotations

import casadi as ca

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.process_cache import kept
from trms_cli.models.model import FloatArray, Model


def noise_of_states(model: Model, parameters: FloatArray, step: float) -> FloatArray:
    """Standard deviations of what noise adds to each state in a step (s), shape (n_x,).

    ``parameters``: (n_p,) array; values of the model's parameters, SI. ``step``: s.
    """
    added = BufferedFunction(kept(_noise_function, model, step), compile=False)
    return added.evaluate(parameters)[0].copy()


def _noise_function(model: Model, step: float) -> ca.Function:
    """``p`` → standard deviations, (n_x, 1)."""
    _, _, p, _ = model.symbols()
    return ca.Function("added", [p], [ca.densify(model.noise_sd(p, step))])
