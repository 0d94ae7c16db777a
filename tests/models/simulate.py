"""A model stepped through commands, in CasADi's virtual machine: no compiler, no cache."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model


def simulate(
    model: Model,
    command: Callable[[float], list[float]],
    seconds: float,
    step: float = 0.01,
    substeps: int = 1,
    start: dict[str, float] | None = None,
) -> dict[str, np.ndarray]:
    """States by name at all times, from rest or from ``start``."""
    advance = BufferedFunction(discretise(model, step, substeps).step, compile=False)
    x = model.rest()
    for name, value in (start or {}).items():
        x[model.state_index(name)] = value
    rows = [x.copy()]
    for k in range(round(seconds / step)):
        u, p, w = command(k * step), model.parameters.values, np.zeros(model.n_w)
        rows.append(advance.evaluate(rows[-1], u, p, w)[0].copy())
    return dict(zip(model.state_names, np.array(rows).T, strict=True))
