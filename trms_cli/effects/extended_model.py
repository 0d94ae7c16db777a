"""A model with one effect added: itself a model, so that effects compose in any number."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np

from trms_cli.core.errors import ModelError
from trms_cli.effects.effect import Effect, EffectContext
from trms_cli.models.model import FloatArray, Model, Signal, Window
from trms_cli.models.scales import unit_at_port


class ExtendedModel(Model):
    """A model beneath, and an effect on it.

    States, memory and parameters of the effect follow those of the model beneath; the effect's
    parameters are named ``<effect>.<size>``.

    Raises ModelError if the model lacks the axis or rotor that the effect acts on, or has an effect
    of that name.

    ``name``: the effect's name, unique among those of ``base``.
    """

    def __init__(self, base: Model, name: str, effect: Effect) -> None:
        try:
            effect = effect.for_model(base)
        except ModelError as error:
            if not error.where:
                error.where = f"effect.{name}"
                error.remedy += "; leave the effect out, or choose another model (model=…)"
            raise
        if base.sample_time is not None:
            _require_outside(base, name, effect)
        own = effect.parameters()
        if name in effect_names(base):
            raise ModelError(
                f"the model has an effect {name!r} already",
                where=name,
                remedy="leave it out, or give the second one a name of its own",
            )
        self.base, self.effect, self.effect_name = base, effect, name
        self.take_over(base)
        self.friction_holds = base.friction_holds or effect.overrides("impulse")
        self.states = (*base.states, *_prefixed(effect, effect.states(), name))
        self._sizes = tuple(parameter.name for parameter in own)
        self.parameters = base.parameters.concatenate(
            replace(parameter, name=f"{name}.{parameter.name}") for parameter in own
        )

    def without_effects(self) -> Model:
        return self.base.without_effects()

    def rest(self) -> FloatArray:
        return np.concatenate([self.base.rest(), np.zeros(self.n_x - self.base.n_x)])

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        return _dynamics_function(self)(x, u, p, w)

    def _dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        at = self._context(x, u, p, w)
        pushed = w + self.effect.disturbance(at)
        return ca.vertcat(
            self.base.dynamics(at.x, u, at.p, pushed), self.effect.derivative(replace(at, w=pushed))
        )

    def transition(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        if self.sample_time is None:
            return super().transition(x, u, p, w)
        at = self._context(x, u, p, w)
        return self.base.transition(at.x, u, at.p, w)

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        at = self._context(x, u, p)
        return self.effect.output(at, self.base.measurement(at.x, u, at.p))

    def quantities(self, x: ca.SX, u: ca.SX, p: ca.SX) -> dict[str, ca.SX]:
        at = self._context(x, u, p)
        return self.base.quantities(at.x, u, at.p)

    def memory(self, step: float) -> tuple[Signal, ...]:
        own = _prefixed(self.effect, self.effect.memory(step), self.effect_name)
        return (*self.base.memory(step), *own)

    def input_path(
        self, memory: ca.SX, u: ca.SX, p: ca.SX, window: Window, step: float
    ) -> tuple[ca.SX, ca.SX]:
        n = len(self.base.memory(step))
        at = self._context(ca.SX.zeros(self.n_x), u, p)
        arriving, beneath = self.base.input_path(memory[:n, :], u, at.p, window, step)
        at = replace(at, u=arriving, own=memory[n:, :])
        arriving, own = self.effect.input_path(at, window, step)
        return arriving, ca.vertcat(beneath, own)

    def impulse(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX, duration: float) -> ca.SX:
        at = self._context(x, u, p, w)
        at = replace(at, x=self.base.impulse(at.x, u, at.p, w, duration))
        return ca.vertcat(self.effect.impulse(at, duration), at.own)

    def sensor_memory(self, step: float) -> tuple[Signal, ...]:
        own = _prefixed(self.effect, self.effect.sensor_memory(step), self.effect_name)
        return (*self.base.sensor_memory(step), *own)

    def sensor_path(
        self,
        memory: ca.SX,
        before: ca.SX,
        after: ca.SX,
        u: ca.SX,
        p: ca.SX,
        window: Window,
        step: float,
    ) -> ca.SX:
        first, last = (self._context(x, u, p) for x in (before, after))
        base_memory, own = self._sensors(memory, step)
        beneath = self.base.sensor_path(base_memory, first.x, last.x, u, first.p, window, step)
        if own.is_empty():
            return beneath
        # A part that begins a step still reads by the memory of the last one.
        y_before = self.base.reading(base_memory, first.x, u, first.p, step, window[0] or 1.0)
        y_after = self.base.reading(beneath, last.x, u, first.p, step, window[1])
        own = self.effect.sensor_path(
            replace(last, sensor_memory=own), y_before, y_after, window, step
        )
        return ca.vertcat(beneath, own)

    def reading(
        self, memory: ca.SX, x: ca.SX, u: ca.SX, p: ca.SX, step: float, since: float = 1.0
    ) -> ca.SX:
        at = self._context(x, u, p)
        base_memory, own = self._sensors(memory, step)
        y = self.base.reading(base_memory, at.x, u, at.p, step, since)
        return self.effect.reading(replace(at, sensor_memory=own), y, step, since)

    def noise_sd(self, p: ca.SX, step: float) -> ca.SX:
        at = self._context(ca.SX.zeros(self.n_x), ca.SX.zeros(self.n_u), p)
        return ca.vertcat(self.base.noise_sd(at.p, step), self.effect.noise_sd(at, step))

    def resolutions(self) -> dict[str, int]:
        own = self.effect.resolution(self.base)
        size = {} if own is None else {f"{self.effect_name}.{own[0]}": own[1]}
        return self.base.resolutions() | size

    def _sensors(self, memory: ca.SX, step: float) -> tuple[ca.SX, ca.SX]:
        """Sensors' memory of the model beneath, and the effect's."""
        n = len(self.base.sensor_memory(step))
        return memory[:n, 0], memory[n:, 0]

    def _context(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX | None = None) -> EffectContext:
        """Where the effect is evaluated; without torques where none matter."""
        n, n_p = self.base.n_x, len(self.base.parameters)
        w = ca.SX.zeros(self.n_w) if w is None else w
        sizes = {name: p[n_p + i] for i, name in enumerate(self._sizes)}
        return EffectContext(self.base, x[:n, :], u, p[:n_p, :], w, x[n:, :], sizes)


def _require_outside(base: Model, name: str, effect: Effect) -> None:
    """Refuse an effect that would change the equations of a model that has none."""
    if effect.overrides("states", "derivative", "disturbance", "impulse"):
        raise ModelError(
            f"{name} acts within the equations of motion, and model {base.name!r} only steps from "
            "sample to sample",
            where=f"effect.{name}",
            remedy="add effects on the command's path to it (a dead zone, a delay, a lag), or let "
            "the rig have equations: model@plant.model=newtonian",
        )


def extend_model(model: Model, effects: Mapping[str, Effect]) -> Model:
    """A model with effects added; a command passes their input paths in the order given.

    Effects with impulses (dry friction, stops) are added after all others, so that the order in
    which effects are named does not matter to the mechanics: an impulse has to meet the inertia
    that the other effects leave.
    """
    ordered = sorted(effects.items(), key=lambda item: item[1].overrides("impulse"))
    for name, effect in ordered:
        model = ExtendedModel(model, name, effect)
    return model


def effect_names(model: Model) -> tuple[str, ...]:
    """Names of the effects that a model has, the innermost first."""
    if not isinstance(model, ExtendedModel):
        return ()
    return (*effect_names(model.base), model.effect_name)


@lru_cache(maxsize=128)
def _dynamics_function(model: ExtendedModel) -> ca.Function:
    """The equations as a function, inlined where it is called: effects beneath are built once."""
    at = model.symbols()
    return ca.Function("dynamics", list(at), [model._dynamics(*at)])


def _prefixed(effect: Effect, signals: tuple[Signal, ...], name: str) -> tuple[Signal, ...]:
    def own(signal: Signal) -> Signal:
        unit = unit_at_port(signal.unit, effect.rig_scale)
        return replace(signal, name=f"{name}.{signal.name}", unit=unit)

    return tuple(map(own, signals))
