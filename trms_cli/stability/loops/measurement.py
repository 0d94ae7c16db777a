"""Where dry friction holds a rig at a point, so that a small signal moves nothing.

Set-valued friction at rest takes up any torque below its own. A test signal of a few millivolts
then does not turn the axis, and what is read of its loop is no response, but zero. The linear loop
that margins are about is that of the rig as it glides.

Where a loop is studied, and its response there: what both studies of loops begin with.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.models.dry_friction import SPEEDS
from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint, operating_point
from trms_cli.models.steady_state import SteadyState
from trms_cli.models.vector_field import VectorField, without_impulses
from trms_cli.stability.loops.frequency_response import (
    Analyser,
    FrequencyResponse,
    NoLoopError,
    NoResponse,
    harmonics_of,
)
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts, Subject

#: Step of the commands, as a share of half their range: any dry friction takes up so little.
_STEP = 1e-6
#: s that the rig has to answer, and part of the free motion below which it has not.
_WAIT, _HELD = 0.5, 0.01


def held_by_friction(model: Model, point: OperatingPoint) -> tuple[str, ...]:
    """Angles and rotor speeds that a small step of the commands moves without dry friction alone.

    A model that only steps from sample to sample has no friction of this kind.
    """
    if model.sample_time is not None:
        return ()
    lower, upper = model.input_bounds()
    commands = np.vstack([point.u, point.u + _STEP * (upper - lower) / 2])
    starts = np.vstack([point.x, point.x])
    field = VectorField(model)
    moved = []
    for impulses in (True, False):
        ends = field.motions(starts, commands, _WAIT, _WAIT / 10, impulses=impulses)
        moved.append(np.abs(ends[:, 1] - ends[:, 0]).max(axis=0))
    with_friction, free = moved
    speeds = [SPEEDS[rotor] for rotor in model.rotors if SPEEDS.get(rotor) in model.state_names]
    rows = {name: model.state_index(name) for name in (*model.controlled, *speeds)}
    return tuple(name for name, i in rows.items() if with_friction[i] < _HELD * free[i])


#: Level, and yaw where the cable pulls and the tail rotor turns: at ω_h = 0 its thrust, ω|ω|, has
#: no slope, and no linear loop of yaw exists.
DEFAULT = {"alpha_v": 0.0, "alpha_h": 0.3}
#: Harmonics of the lowest line up to half the controller's rate: fewer are no curve.
_FEWEST = 10
#: Samples per swing of the rig: of its clock, over which it is integrated in one go, and of the
#: controller, whose loop ends at half its rate.
_OF_THE_RIG, _OF_THE_CONTROLLER = 10, 2


def point_of(subject: Subject, at: Mapping[str, float]) -> OperatingPoint:
    """The operating point asked for; :data:`DEFAULT` where nothing is.

    Raises TrmsError.
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
    if not target.exact:
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
) -> FrequencyResponse | NoResponse:
    """The response; that of the rig without its dry friction where that holds it at the point.

    Raises ConfigurationError if the controller does not answer, samples slower than the rig swings,
    or leaves no band above the lowest line.
    """
    _require_band(analyser.lowest, subject, loop, point)
    held = held_by_friction(subject.model, point)
    rig = without_impulses(subject.model) if held else subject.model
    try:
        return replace(analyser.measure(rig, loop, point, tell), held=held)
    except NoLoopError:
        raise ConfigurationError(
            f"the commands of controller={loop.names['controller']} do not depend on what it sees: "
            "there is no loop",
            where="controller",
            remedy="choose one that feeds back, as controller=lqr; without a controller, "
            "study=local tells the rig's own modes",
        ) from None


def _require_band(lowest: float, subject: Subject, loop: LoopParts, point: OperatingPoint) -> None:
    """Refuse a sampling that is slower than the rig, and a lowest line too close to its end."""
    step = getattr(loop.controller, "sample_time", None) or loop.sample_time
    swing = _fastest_swing(loop.model, point)
    periods = (
        ("sim.sample_time", "the loop", loop.sample_time, _OF_THE_RIG),
        ("controller.sample_time", "the controller", step, _OF_THE_CONTROLLER),
    )
    for where, who, period, fewest in periods:
        most = 2 * math.pi / (fewest * swing) if swing else math.inf
        if period > most:
            raise ConfigurationError(
                f"{who} samples every {period:g} s, slower than the rig moves: it swings at "
                f"{swing:.2g} rad/s there, and at least {fewest} samples of a swing are needed",
                where=where,
                remedy=f"{where}=0.02; at the most {most:.2g} s",
            )
    if harmonics_of(step, lowest) < _FEWEST:
        raise ConfigurationError(
            f"a response from {lowest:g} rad/s on cannot be measured: the controller samples every "
            f"{step:g} s, so that it ends at half its rate, {math.pi / step:.3g} rad/s",
            where="lowest",
            remedy=f"study.lowest of at most {math.pi / step / _FEWEST:.2g} rad/s",
        )


def _fastest_swing(model: Model, point: OperatingPoint) -> float:
    """Largest frequency of the rig's own swings, rad/s; 0 without one, or without equations."""
    if model.sample_time is not None:
        return 0.0
    A, _ = VectorField(model).linearised(point.x[: model.n_x], point.u)
    return float(np.abs(np.linalg.eigvals(A).imag).max())
