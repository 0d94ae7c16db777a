"""The box in which equilibria are looked for."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.models.model import Model, names
from trms_cli.stability.equilibria.rest_system import RestSystem
from trms_cli.stability.intervals.interval import Interval

FloatArray = npt.NDArray[np.float64]


#: rad, just within ±π/2: with the beam upright the yaw of some models answers to nothing at all.
UPRIGHT = 1.57


def bounds_of(
    system: RestSystem, asked: Mapping[str, Sequence[float]], where: str = "study.box"
) -> tuple[Interval, FloatArray]:
    """Bounds of the unknowns, (n,) each, and the size of each that counts.

    A pitch reaches to its stop, at least to :data:`UPRIGHT`; another angle to its stop, or a half
    turn; a released input to its limit; all else has no bounds.

    Raises
    ------
    ConfigurationError
        For a name that is no state, or bounds that are none.
    """
    model = system.model
    for name, bounds in asked.items():
        if name not in model.state_names:
            raise ConfigurationError(
                f"{name!r} is no state of model {model.name!r}",
                where=f"{where}.{name}",
                remedy=nearest(name, model.state_names),
            )
        if len(bounds) != 2 or not bounds[0] < bounds[1]:
            raise ConfigurationError(
                f"{list(bounds)} are no bounds",
                where=f"{where}.{name}",
                remedy="give a lower and a higher one, as [-1.57, 1.57]",
            )
    lower, upper = [], []
    for signal in system.unknowns:
        low, high = asked[signal.name] if signal.name in asked else _default(model, signal.name)
        lower.append(float(low))
        upper.append(float(high))
    box = Interval.of(lower, upper)
    width = np.where(np.isfinite(box.width), box.width, np.nan)
    rest = np.array([100.0 if signal.unit == "rad/s" else 1.0 for signal in system.unknowns])
    return box, np.where(np.isnan(width), rest, np.minimum(0.5 * width, 10.0))


def _default(model: Model, name: str) -> tuple[float, float]:
    if name in names(model.inputs):
        limit = model.input_limits[name]
        return -limit, limit
    pitch = model.axes["pitch"].angle if "pitch" in model.axes else ""
    stop = model.stops.get(name, math.inf)
    if name == pitch:
        half = max(stop, UPRIGHT) if math.isfinite(stop) else UPRIGHT
        return -half, half
    if any(axis.angle == name for axis in model.axes.values()):
        half = stop if math.isfinite(stop) else math.pi
        return -half, half
    return -math.inf, math.inf
