"""Where the rig rests over both inputs at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.models.model import Model
from trms_cli.stability.equilibria.continuation import at_input
from trms_cli.stability.equilibria.curve_equations import CurveEquations
from trms_cli.stability.equilibria.rest_system import rest_system
from trms_cli.stability.equilibria.search_box import bounds_of
from trms_cli.stability.equilibria.stability_of_points import judged
from trms_cli.stability.equilibria.survey import Survey
from trms_cli.stability.local.linear import Linear

FloatArray = npt.NDArray[np.float64]

_POINTS = 41


@dataclass(frozen=True)
class EquilibriumMap:
    """Controlled angles of the stable equilibria over two inputs."""

    first: FloatArray  #: (n,), (m,) arrays; the inputs
    second: FloatArray  #: (n,), (m,) arrays; the inputs
    #: dict of str to (m, n) array; rad; NaN where there is no stable equilibrium in the box
    angles: dict[str, FloatArray]


def equilibrium_map(model: Model, along: Survey, second: str) -> EquilibriumMap | None:
    """From the stable points over one input, by steps of the other; None for other structures.

    Parameters
    ----------
    along : Survey
        Over the first input, with the second given.
    second : str
    """
    over = along.setting.over
    if along.system.free or along.system.released or along.setting.held:
        return None
    system = rest_system(model, {over, second})
    limit = model.input_limits[second]
    start = along.setting.inputs.get(second, 0.0)
    first = np.linspace(*along.setting.bounds, _POINTS)
    others = np.linspace(-limit, limit, _POINTS)
    rows = [model.state_index(name) for name in model.controlled]
    angles = np.full((len(rows), _POINTS, _POINTS), np.nan)
    linear = Linear(model)
    names = [signal.name for signal in system.unknowns]
    box, scale = bounds_of(system, {})
    for column, value in enumerate(first):
        known = [y for one in along.curves for y in at_input(along.equations, one.curve, value)]
        stable = [p for p in (judged(linear, along.equations, y) for y in known) if not p.unstable]
        if not stable:
            continue
        v = np.zeros(len(system.given))
        v[system.given_index(over)] = value
        bounds = (-limit, limit)
        equations = CurveEquations(system, system.given_index(second), v, box, scale, bounds)
        x = stable[0].x
        seed = np.array([*(x[model.state_index(name)] for name in names), start])
        for side in (others[others >= start], others[others < start][::-1]):
            y: FloatArray | None = seed
            for at in side:
                y = equations.pinned(y, equations.n, float(at)) if y is not None else None
                if y is None or not equations.inside(y):
                    break
                here = judged(linear, equations, y)
                if not here.unstable:
                    row = int(np.argmin(np.abs(others - at)))
                    angles[:, row, column] = here.x[rows]
    return EquilibriumMap(first, others, dict(zip(model.controlled, angles, strict=True)))
