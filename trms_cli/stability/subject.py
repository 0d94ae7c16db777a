"""What a study is about: a model with its effects, the loop around it if there is one, a point."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from trms_cli.controllers.controller import Controller
from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import ExtendedModel, extend_model
from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint, operating_point


@dataclass(frozen=True)
class LoopParts:
    """What closes the loop around a rig."""

    model: Model  #: What controller and observer believe: the subject's model without the effects
    controller: Controller
    observer: Any
    sample_time: float  #: s, of the observer and the controller's clock
    names: dict[str, str]  #: The options chosen: ``controller``, ``observer``

    @property
    def control_period(self) -> float:
        """The controller's own sample time, or the loop's, s."""
        return getattr(self.controller, "sample_time", None) or self.sample_time


@dataclass(frozen=True)
class Subject:
    """What is studied.

    Raises ConfigurationError for a controller that plays commands, whatever the rig does: it closes
    no loop.
    """

    model: Model  #: With its effects
    name: str  #: What the model is called on the command line
    loop: LoopParts | None = None  #: None: the model alone

    def __post_init__(self) -> None:
        if self.loop is None or getattr(self.loop.controller, "follows_reference", True):
            return
        raise ConfigurationError(
            f"controller={self.loop.names['controller']} plays commands, whatever the rig does: "
            "there is no loop",
            where="controller",
            remedy="leave it out to study the model alone, or choose one that feeds back, as "
            "controller=lqr",
        )

    def require_equations(
        self, study: str, instead: str = "", *, command_path: bool = False
    ) -> Model:
        """The model, refused if it only steps from sample to sample: ModelError.

        The message says who asks (``study``) and what is possible instead. Effects that only change
        a command on its way to the motors (a delay, a dead zone) stay with ``command_path``. Like
        those of sensors they are no part of ẋ = f(x, u): without them, whoever simulates sees the
        same rig as whoever reads the equations, and commands are those that reach the motors.
        Effects with impulses (dry friction) stay.
        """
        if self.model.sample_time is not None:
            raise ModelError(
                f"{study} needs the equations ẋ = f(x, u), and model {self.name!r} only steps from "
                f"sample to sample ({self.model.sample_time:g} s)",
                where="model",
                remedy=(f"{instead}; or " if instead else "")
                + "choose a model with equations, as model=newtonian or a fitted model.yaml of one",
            )
        if command_path or self.loop is not None:  # a loop feels its delays
            return self.model
        return _without_paths(self.model)

    def require_loop(self, study: str) -> LoopParts:
        """The loop; ConfigurationError where there is none."""
        if self.loop is None:
            raise ConfigurationError(
                f"{study} is about a closed loop, and no controller is chosen",
                where="controller",
                remedy="choose one, as controller=lqr (`trms list controller`)",
            )
        return self.loop

    def require_no_loop(self, study: str, instead: str = "") -> None:
        """Refuse a controller where the study is about the model alone: ConfigurationError."""
        if self.loop is not None:
            raise ConfigurationError(
                f"{study} is about the model alone, and controller={self.loop.names['controller']} "
                "is given",
                where="controller",
                remedy=instead or "leave out the controller",
            )

    def left_out_of_equations(self) -> tuple[str, ...]:
        """Effects that f(x, u) does not hold, by name: friction as impulses, delays, sensors."""
        return (*self.dry, *self.on_commands, *self.on_sensors)

    @property
    def dry(self) -> tuple[str, ...]:
        """Effects that act by impulses, by name."""
        return _overriding(self.model, _IMPULSES)

    @property
    def on_commands(self) -> tuple[str, ...]:
        """Effects that change commands on their way to the motors, by name."""
        return _overriding(self.model, _COMMANDS)

    @property
    def on_sensors(self) -> tuple[str, ...]:
        """Effects that change what is measured, by name."""
        return _overriding(self.model, _SENSORS)


#: Methods of an effect by what they change.
_INSIDE = ("states", "derivative", "disturbance")
_IMPULSES, _COMMANDS = ("impulse",), ("input_path",)
_SENSORS = ("output", "sensor_path", "reading")


def effects_of(model: Model) -> tuple[tuple[str, Effect], ...]:
    """The effects of a model with their names, the innermost first."""
    if not isinstance(model, ExtendedModel):
        return ()
    return (*effects_of(model.base), (model.effect_name, model.effect))


def _overriding(model: Model, methods: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name for name, effect in effects_of(model) if effect.overrides(*methods))


def _without_paths(model: Model) -> Model:
    """The model without the effects that act on commands and sensors only."""
    effects = effects_of(model)
    inner_effects = {name: e for name, e in effects if e.overrides(*_INSIDE, *_IMPULSES)}
    if len(inner_effects) == len(effects):
        return model
    moving = extend_model(model.without_effects(), inner_effects)
    values = {p.name: p.value for p in model.parameters if p.name in moving.parameters}
    moving.parameters = moving.parameters.replaced(values)
    return moving


#: rad. Yaw is where the cable pulls, off the place where its stiffness jumps, and where the tail
#: rotor turns: at ω_h = 0 its thrust, ω|ω|, has no slope, and no linear loop of yaw exists.
_LEVEL = {"alpha_v": 0.0, "alpha_h": 0.3}
#: rad
_AS_ASKED = 1e-3


def level_of(model: Model) -> dict[str, float]:
    """Where a study begins when nothing is asked for: level, the tail rotor turning; rad."""
    return {name: _LEVEL[name] for name in model.controlled if name in _LEVEL}


def usual_point(model: Model, at: Mapping[str, float]) -> OperatingPoint:
    """The point asked for; without one level, at a yaw of 0.3 rad, or the rest without command
    where the model cannot be level.

    Raises ConfigurationError if there is no such equilibrium.
    """
    if at:
        return operating_point(model, at)
    try:
        return operating_point(model, level_of(model))
    except ConfigurationError:
        return operating_point(model, {})


def not_level(model: Model, at: Mapping[str, float], point: OperatingPoint) -> tuple[str, ...]:
    """A sentence for a point that :func:`usual_point` took instead of a level one."""
    level = level_of(model)
    reached = {name: float(point.x[model.state_index(name)]) for name in level}
    if at or all(abs(reached[name] - level[name]) < _AS_ASKED for name in level):
        return ()
    level_text = ", ".join(f"{name} = {value:g}" for name, value in level.items())
    return (
        f"the model has no equilibrium at {level_text} rad, where the study begins when nothing is "
        "asked for: this is the rest without command instead (choose another by study.at)",
    )
