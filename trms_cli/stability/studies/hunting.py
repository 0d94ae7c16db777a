"""Whether a loop with dry friction hunts, how far and how fast, and what predicts it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from trms_cli.controllers.controller import ControlSetup
from trms_cli.controllers.pid import Pid
from trms_cli.controllers.pid_feed_forward import ROTOR_OF_AXIS
from trms_cli.controllers.pid_tuning import Gains
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.findings import Findings
from trms_cli.models.model import Model, names
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.cycles.hunting_findings import HuntingResult, findings_of
from trms_cli.stability.cycles.hunting_prediction import harmonics, predict, swings
from trms_cli.stability.cycles.hunting_runs import (
    AxisRun,
    HuntingLevel,
    LevelSweep,
    axis_run,
    with_sizes,
)
from trms_cli.stability.cycles.stick_slip import (
    Friction,
    FrictionLaw,
    StickSlip,
    friction_loop,
    frictions_of,
)
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts, Subject, not_level, usual_point

_Factors = tuple[Annotated[float, Meta(gt=0)], ...]

#: s, of a run at least; predicted periods that it lasts at least.
_SHORTEST, _PERIODS = 200.0, 8
#: By which a run in which slips are too rare to tell is lengthened, once.
_LONGER = 4.0
#: Factors of the predicted curves, and excesses beside the one in force.
_CURVE = np.geomspace(0.25, 4.0, 11)
_EXCESSES = (0.5, 1.0, 2.0)


@dataclass(frozen=True, kw_only=True)
class Hunting:
    """Stick-slip in a closed loop."""

    axis: Literal["pitch", "yaw"] | None = None  #: None: the one axis with dry friction
    #: Operating point by angles (rad) or by commands (V); nothing: level, at a yaw of 0.3 rad
    at: Mapping[str, float] = field(default_factory=dict)
    #: rad, by which the axis starts beside its reference
    push: Annotated[float, Meta(ge=-3, le=3)] = 0.3
    #: s, of each run; None: 200, or eight predicted periods
    duration: Annotated[float, Meta(ge=20, le=100000)] | None = None
    #: Factors of the friction, and of k_i of a PID, for further runs
    torques: _Factors | None = None
    integrals: _Factors | None = None  #: None: half and twice for a PID, none for others

    def run(self, subject: Subject, tell: Tell) -> Findings:
        """Simulate, predict, confirm.

        Raises
        ------
        ConfigurationError
            Without a controller that feeds back or dry friction, and for an operating point that
            does not exist.
        ModelError
            For a model without equations.
        """
        loop = subject.require_loop("hunting")
        model = subject.require_equations("hunting")
        friction = self._friction(model)
        pid = loop.controller if isinstance(loop.controller, Pid) else None
        if self.integrals and pid is None:
            raise ConfigurationError(
                f"controller={loop.names['controller']} has no k_i",
                where="integrals",
                remedy="leave it out, or choose controller=pid",
            )
        point = usual_point(model, self.at)
        channel = names(model.inputs).index(model.rotors[ROTOR_OF_AXIS[friction.axis]])
        case = _Case(model, loop, point, friction, self.push, channel)
        prediction = one = events = None
        warnings = list(not_level(model, self.at, point))
        if pid is not None:
            tell("the event map of the linear loop")
            linear = friction_loop(model, loop, pid, point, friction.axis)
            if linear.stable():
                events = StickSlip(linear, friction.law)
                prediction = predict(events)
                tell("describing functions")
                one = harmonics(linear, friction.law)
            else:
                warnings.append("the linear loop without friction is unstable: nothing predicted")
            if loop.names["observer"] != "full_state":
                warnings.append(
                    "the prediction takes the true angle; in simulation "
                    f"observer={loop.names['observer']} stands in between"
                )
        else:
            warnings.append(
                "predicted for controller=pid only, whose law is linear and known: here simulation"
            )
        duration = self.duration or max(
            _SHORTEST,
            _PERIODS * prediction.cycle.period if prediction and prediction.cycle else 0.0,
        )
        tell(f"{duration:.0f} s of the loop")
        expected = prediction.cycle.swing if prediction and prediction.cycle else None
        run = case.run(duration)
        elsewhere = None
        if expected is not None and not run.hunts:
            # The push may have ended within the reach of rest: begin on the cycle.
            elsewhere, run = run, case.run(duration, push=expected / 2.0)
        if run.verdict == "undecided" and self.duration is None:
            duration *= _LONGER
            tell(f"slips are rare: {duration:.0f} s of the loop")
            run = case.run(duration)
        coulomb = None
        if friction.law.excess > 0:
            tell("the same with Coulomb friction alone")
            short = min(duration, _SHORTEST)
            alone = replace(friction.law, excess=0.0)
            coulomb = case.run(short, law=alone)
            if coulomb.verdict == "undecided":
                coulomb = case.run(_LONGER * short, law=alone)
        sweeps = [
            self._over_torques(case, events, duration, tell),
            self._over_integrals(case, pid, events, duration, tell),
        ]
        if run.at_limit:
            warnings.append("a command reaches its limit: the prediction knows none")
        own = HuntingLevel(1.0, expected, run)
        return findings_of(
            HuntingResult(
                model,
                f"controller={loop.names['controller']}",
                point.words(model),
                friction,
                self.push,
                run,
                elsewhere,
                channel,
                coulomb,
                prediction,
                one,
                events,
                [
                    replace(s, levels=sorted([*s.levels, own], key=lambda level: level.factor))
                    for s in sweeps
                    if s.levels
                ],
                tuple(warnings),
            )
        )

    def _friction(self, model: Model) -> Friction:
        frictions = frictions_of(model)
        if self.axis is not None:
            frictions = tuple(one for one in frictions if one.axis == self.axis)
        if len(frictions) == 1 and frictions[0].law.torque > 0:
            return frictions[0]
        if len(frictions) > 1:
            raise ConfigurationError(
                f"dry friction by {', '.join(one.effect for one in frictions)}",
                where="axis",
                remedy="choose an axis with one of them: study.axis=pitch",
            )
        axis = str(self.axis or [*model.axes, "pitch"][0])
        raise ConfigurationError(
            "without dry friction on an axis nothing sticks",
            where="effect",
            remedy=f"add it: effect={axis}_stribeck_friction (or {axis}_coulomb_friction)",
        )

    def _over_torques(
        self, case: _Case, events: StickSlip | None, duration: float, tell: Tell
    ) -> LevelSweep:
        law = case.friction.law
        factors = self.torques if self.torques is not None else (0.5, 2.0) if events else ()
        curves = []
        if events is not None and factors:
            for excess in sorted({law.excess, *(law.excess * e for e in _EXCESSES)} - {0.0}):
                laws = [replace(law.scaled(float(f)), excess=excess) for f in _CURVE]
                words = f"predicted, F_s/F_c = {1 + excess:.3g}"
                curves.append((words, swings(events, laws)))

        def one(factor: float) -> tuple[float | None, AxisRun]:
            scaled = law.scaled(factor)
            expected = _finite(swings(events, [scaled])[0]) if events is not None else None
            return expected, case.reached(duration, expected, law=scaled)

        return _sweep("torques", "friction", curves, factors, one, tell)

    def _over_integrals(
        self, case: _Case, pid: Pid | None, events: StickSlip | None, duration: float, tell: Tell
    ) -> LevelSweep:
        factors = self.integrals if self.integrals is not None else (0.5, 2.0) if events else ()
        if pid is None or events is None or not factors:
            return _sweep("integrals", "k_i", [], (), lambda _: (None, case.run(duration)), tell)

        def of(factor: float) -> tuple[LoopParts, StickSlip | None]:
            changed = _with_integral(case, pid, factor)
            loop = replace(case.loop, controller=changed)
            linear = friction_loop(case.model, loop, changed, case.point, case.friction.axis)
            return loop, StickSlip(linear, case.friction.law) if linear.stable() else None

        def swing(factor: float) -> float:
            there = of(factor)[1]
            return float("nan") if there is None else float(swings(there, [case.friction.law])[0])

        def one(factor: float) -> tuple[float | None, AxisRun]:
            expected = _finite(swing(factor))
            return expected, case.reached(duration, expected, loop=of(factor)[0])

        values = np.array([swing(float(f)) for f in _CURVE])
        return _sweep("integrals", "k_i", [("predicted", values)], factors, one, tell)


@dataclass(frozen=True)
class _Case:
    """A loop to be run with other friction, or another controller."""

    model: Model
    loop: LoopParts
    point: OperatingPoint
    friction: Friction
    push: float
    channel: int

    def run(
        self,
        duration: float,
        *,
        law: FrictionLaw | None = None,
        loop: LoopParts | None = None,
        push: float | None = None,
    ) -> AxisRun:
        """A run, with other friction, another loop or another push."""
        model = self.model
        if law is not None:
            sizes = {f"{self.friction.effect}.{key}": value for key, value in vars(law).items()}
            model = with_sizes(model, {k: v for k, v in sizes.items() if k in model.parameters})
        start = self.push if push is None else push
        axis = self.friction.axis
        return axis_run(model, loop or self.loop, self.point, axis, start, duration, self.channel)

    def reached(self, duration: float, expected: float | None, **other: Any) -> AxisRun:
        """A run; where it rests but a cycle of some swing is expected, one from that cycle."""
        run = self.run(duration, **other)
        if expected is not None and not run.hunts:
            run = self.run(duration, **other, push=expected / 2.0)
        return run


def _with_integral(case: _Case, pid: Pid, factor: float) -> Pid:
    """The PID with the gains that it has, but k_i of the axis times a factor."""
    period = pid.sample_time or case.loop.sample_time
    state = pid.init(ControlSetup(case.loop.model, period, case.point.u))
    gains: dict[str, Gains] = {}
    for name, law in zip(case.loop.model.axes, state.axes, strict=True):
        own = factor if name == case.friction.axis else 1.0
        gains[name] = Gains(law.gains.kp, own * law.gains.ki, law.gains.kd)
    return replace(pid, **gains)  # type: ignore[arg-type]


def _sweep(
    name: str,
    label: str,
    curves: Sequence[tuple[str, np.ndarray]],
    factors: Sequence[float],
    one: Callable[[float], tuple[float | None, AxisRun]],
    tell: Tell,
) -> LevelSweep:
    levels = []
    for factor in factors:
        tell(f"{label} × {factor:g}")
        levels.append(HuntingLevel(factor, *one(factor)))
    return LevelSweep(name, label, _CURVE, curves, levels)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
