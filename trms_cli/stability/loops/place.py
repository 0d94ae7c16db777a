"""Where a loop is studied, and its response there: what both studies of loops begin with."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from trms_cli.controllers.operating_point import SteadyState
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.stability.loops.frequency_response import Analyser, Measured, NoLoopError, NotHeld
from trms_cli.stability.operating_point import OperatingPoint, operating_point
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts, Subject

#: Level, and yaw where the cable pulls and the tail rotor turns: at ω_h = 0 its thrust, ω|ω|, has
#: no slope, and no linear loop of yaw exists.
DEFAULT = {"alpha_v": 0.0, "alpha_h": 0.3}


def point_of(subject: Subject, at: Mapping[str, float]) -> OperatingPoint:
    """The operating point asked for; :data:`DEFAULT` where nothing is.

    Raises
    ------
    TrmsError
    """
    model = subject.model
    asked = at or {name: value for name, value in DEFAULT.items() if name in model.controlled}
    if model.sample_time is None:
        return operating_point(model, asked)
    return _of_a_black_box(subject, asked)


def _of_a_black_box(subject: Subject, at: Mapping[str, float]) -> OperatingPoint:
    """Where a model rests that only steps; such a point is found by its angles."""
    model = subject.model
    for name in at:
        if name not in model.controlled:
            raise ConfigurationError(
                f"model {subject.name!r} only steps from sample to sample, and where it rests is "
                f"found by its angles, not by {name!r}",
                where=f"at.{name}",
                remedy=nearest(name, model.controlled),
            )
    wanted = np.array([at.get(name, 0.0) for name in model.controlled])
    target = SteadyState(model).solve(wanted)
    if not target.converged or target.projected:
        reached = ", ".join(
            f"{name}={value:.4g}"
            for name, value in zip(model.controlled, target.reference_reached, strict=True)
        )
        raise ConfigurationError(
            f"model {subject.name!r} finds no rest there",
            where="at",
            remedy=f"the closest that it has: {reached}" if target.converged else "",
        )
    return OperatingPoint(target.x, target.u)


def measured(
    analyser: Analyser, subject: Subject, loop: LoopParts, point: OperatingPoint, tell: Tell
) -> Measured | NotHeld:
    """The response.

    Raises
    ------
    ConfigurationError
        If the controller does not answer.
    """
    try:
        return analyser.measure(subject.model, loop, point, tell)
    except NoLoopError:
        raise ConfigurationError(
            f"the commands of controller={loop.names['controller']} do not depend on what it sees: "
            "there is no loop",
            where="controller",
            remedy="choose one that feeds back, as controller=lqr; without a controller, "
            "study=local tells the rig's own modes",
        ) from None
