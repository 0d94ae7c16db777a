"""Where a loop is studied, and its response there: what both studies of loops begin with."""

from __future__ import annotations

from collections.abc import Mapping

from trms_cli.core.errors import ConfigurationError
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
    return operating_point(model, asked)


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
