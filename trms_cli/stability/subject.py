"""What a study is about: a model with its effects, and the loop around it where there is one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from trms_cli.controllers.controller import Controller
from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import ExtendedModel
from trms_cli.models.model import Model


@dataclass(frozen=True)
class LoopParts:
    """What closes the loop around a rig.

    Attributes
    ----------
    model : Model
        What controller and observer believe: the subject's model without the effects.
    controller : Controller
    observer : Observer
    sample_time : float
        s, of the observer and the controller's clock.
    names : dict of str to str
        The options chosen: ``controller``, ``observer``.
    """

    model: Model
    controller: Controller
    observer: Any
    sample_time: float
    names: dict[str, str]


@dataclass(frozen=True)
class Subject:
    """What is studied.

    Attributes
    ----------
    model : Model
        With its effects.
    name : str
        What the model is called on the command line.
    loop : LoopParts or None
        None: the model alone.
    """

    model: Model
    name: str
    loop: LoopParts | None = None

    def require_equations(self, study: str, instead: str = "") -> Model:
        """The model, refused if it only steps from sample to sample.

        Raises
        ------
        ModelError
        """
        if self.model.sample_time is not None:
            raise ModelError(
                f"{study} needs the equations ẋ = f(x, u), and model {self.name!r} only steps from "
                f"sample to sample ({self.model.sample_time:g} s)",
                where="model",
                remedy=(f"{instead}; or " if instead else "")
                + "choose a model with equations, as model=newtonian or a fitted model.yaml of one",
            )
        return self.model

    def require_loop(self, study: str) -> LoopParts:
        """The loop, refused where there is none.

        Raises
        ------
        ConfigurationError
        """
        if self.loop is None:
            raise ConfigurationError(
                f"{study} is about a closed loop, and no controller is chosen",
                where="controller",
                remedy="choose one, as controller=lqr (`trms list controller`)",
            )
        return self.loop

    def require_no_loop(self, study: str, instead: str = "") -> None:
        """Refuse a controller where the study is about the model alone.

        Raises
        ------
        ConfigurationError
        """
        if self.loop is not None:
            raise ConfigurationError(
                f"{study} is about the model alone, and controller={self.loop.names['controller']} "
                "is given",
                where="controller",
                remedy=instead or "leave out the controller",
            )

    def left_out_of_equations(self) -> tuple[str, ...]:
        """Effects that f(x, u) does not hold, by name: friction as impulses, delays, sensors."""
        return tuple(name for name, effect in effects_of(self.model) if _outside_equations(effect))


def effects_of(model: Model) -> tuple[tuple[str, Effect], ...]:
    """The effects of a model with their names, the innermost first."""
    if not isinstance(model, ExtendedModel):
        return ()
    return (*effects_of(model.base), (model.effect_name, model.effect))


def _outside_equations(effect: Effect) -> bool:
    parts = ("input_path", "impulse", "output", "sensor_path", "reading", "noise_sd")
    return any(getattr(type(effect), part) is not getattr(Effect, part) for part in parts)
