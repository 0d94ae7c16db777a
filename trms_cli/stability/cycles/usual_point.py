"""Where cycles are asked about when nothing else is said."""

from __future__ import annotations

from collections.abc import Mapping

from trms_cli.core.errors import ConfigurationError
from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint, operating_point

#: rad. Yaw is off the place where the cable's stiffness jumps: a cycle that small has no slopes.
_LEVEL = {"alpha_v": 0.0, "alpha_h": 0.3}
#: rad
_AS_ASKED = 1e-3


def usual_point(model: Model, at: Mapping[str, float]) -> OperatingPoint:
    """The point asked for; without one level, at a yaw of 0.3 rad, or the rest without command
    where the model cannot be level.

    Raises ConfigurationError if there is no such equilibrium.
    """
    if at:
        return operating_point(model, at)
    level = {name: _LEVEL[name] for name in model.controlled if name in _LEVEL}
    try:
        return operating_point(model, level)
    except ConfigurationError:
        return operating_point(model, {})


def not_level(model: Model, at: Mapping[str, float], point: OperatingPoint) -> tuple[str, ...]:
    """A sentence for a point that :func:`usual_point` took instead of a level one."""
    level = {name: _LEVEL[name] for name in model.controlled if name in _LEVEL}
    reached = {name: float(point.x[model.state_index(name)]) for name in level}
    if at or all(abs(reached[name] - level[name]) < _AS_ASKED for name in level):
        return ()
    asked = ", ".join(f"{name} = {value:g}" for name, value in level.items())
    return (
        f"the model has no equilibrium at {asked} rad, where the study begins when nothing is "
        "asked for: this is the rest without command instead (choose another by study.at)",
    )
