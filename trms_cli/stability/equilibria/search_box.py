"""The box in which equilibria are looked for."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.core.plugins import nearest
from trms_cli.models.model import Model, names
from trms_cli.stability.equilibria.rest_system import RestSystem
from trms_cli.stability.intervals.interval import Interval

FloatArray = npt.NDArray[np.float64]


#: rad, just within ±π/2: with the beam upright the yaw of some models answers to nothing at all.
UPRIGHT = 1.57
#: Random states and inputs at which an equation is tried.
_TRIED = 4


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
    ModelError
        If with the beam upright, within the bounds, an equation holds for whatever else.
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
        low, high = asked[signal.name] if signal.name in asked else usual_bounds(model, signal.name)
        lower.append(float(low))
        upper.append(float(high))
    box = Interval.of(lower, upper)
    _require_yaw(system, box, where)
    width = np.where(np.isfinite(box.width), box.width, np.nan)
    rest = np.array([100.0 if signal.unit == "rad/s" else 1.0 for signal in system.unknowns])
    return box, np.where(np.isnan(width), rest, np.minimum(0.5 * width, 10.0))


def _require_yaw(system: RestSystem, box: Interval, where: str) -> None:
    """Nothing upright in the box where an equation of rest then holds for whatever else.

    Raises ModelError.
    """
    model = system.model
    pitch = model.axes["pitch"].angle if "pitch" in model.axes else ""
    if pitch not in names(system.unknowns):
        return
    index = names(system.unknowns).index(pitch)
    p, random = model.parameters.values, np.random.default_rng(0)
    for upright in (-0.5 * math.pi, 0.5 * math.pi):
        if not box.lower[index] < upright < box.upper[index]:
            continue
        z = random.uniform(-1.0, 1.0, (system.n, _TRIED))
        v = random.uniform(-1.0, 1.0, (len(system.given), _TRIED))
        usual = np.abs(np.array(system.residual(z, v, p))).max(axis=1)
        z[index] = upright
        there = np.abs(np.array(system.residual(z, v, p))).max(axis=1)
        if np.any((usual > 0) & (there <= 1e-12 * usual)):
            raise ModelError(
                f"the equations of model {model.name!r} are singular in the box: with the beam "
                f"upright ({pitch} = {upright:.4g} rad) nothing turns it in yaw",
                where=f"{where}.{pitch}",
                remedy=f"stay within ±{UPRIGHT} rad, as {where}.{pitch}=[-{UPRIGHT},{UPRIGHT}]",
            )


def usual_bounds(model: Model, name: str) -> tuple[float, float]:
    """Bounds of an unknown that nothing is asked of."""
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
