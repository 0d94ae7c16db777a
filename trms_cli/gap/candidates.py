"""The candidates: effects as candidate causes, with what is believed of their sizes beforehand."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ModelError
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import ExtendedModel, effect_names, extended
from trms_cli.effects.quantisation import Quantisation
from trms_cli.identification.problem import FreeParameter
from trms_cli.models.model import Model
from trms_cli.models.parameters import Parameter

#: Multiples of the typical range's geometric middle at which an effect is tried.
_MULTIPLES = (0.3, 1.0, 3.0)
#: How far beyond its typical range a size may lie that gives an effect its shape, a factor.
_BEYOND = 2.0
#: Width of a size's prior, in the largest typical size.
_WIDTH = 2.0


@dataclass(frozen=True)
class CandidateEffect:
    """An effect as a candidate cause."""

    name: str
    effect: Effect
    locations: tuple[str, ...]  #: Where in the block diagram it acts
    free: tuple[FreeParameter, ...]  #: Its sizes, named ``<effect>.<size>``, with their priors
    variants: FloatArray  #: (k, n_s) array; sizes to try it at
    stochastic: bool  #: Whether noise drives it, so that no simulation shows it

    @property
    def simulated(self) -> bool:
        """Whether a simulation with slopes shows it: neither noise nor rounding has a slope."""
        return not self.stochastic and not isinstance(self.effect, Quantisation)


def applicable_candidates(
    model: Model, effects: Mapping[str, Effect]
) -> tuple[dict[str, CandidateEffect], dict[str, str]]:
    """Those effects that a model can carry and does not have already.

    Returns ``left_out``: why the others cannot be the cause here.
    """
    applicable, left_out = {}, {}
    for name, effect in effects.items():
        if name in effect_names(model):
            left_out[name] = "the nominal model has it already"
            continue
        try:
            with_effect = ExtendedModel(model, name, effect)
        except ModelError as error:
            left_out[name] = str(error.args[0] if error.args else error)
            continue
        applicable[name] = CandidateEffect(
            name,
            effect,
            locations(effect, with_effect),
            tuple(_free(name, i, p) for i, p in enumerate(effect.parameters())),
            variants(effect.parameters()),
            type(effect).noise_sd is not Effect.noise_sd,
        )
    return applicable, left_out


def joint(model: Model, chosen: Sequence[CandidateEffect]) -> Model:
    """The model with several effects."""
    return extended(model, {candidate.name: candidate.effect for candidate in chosen})


def locations(effect: Effect, model: ExtendedModel) -> tuple[str, ...]:
    """Where in the block diagram an effect acts.

    An effect says so itself, by an attribute ``locations``; else it is read from what it
    overrides: the input path is its rotor's actuator, an output its axis' sensor or its rotor's
    tacho, an impulse or torque the equation that it acts on.
    """
    said = getattr(effect, "locations", None)
    if said:
        return tuple(said)
    kind = type(effect)
    axis, rotor = getattr(effect, "axis", None), getattr(effect, "rotor", None)

    def overrides(*names: str) -> bool:
        return any(getattr(kind, name) is not getattr(Effect, name) for name in names)

    if overrides("input_path", "memory"):
        return (f"{rotor}_actuator",) if rotor else ("main_actuator", "tail_actuator")
    if overrides("output", "reading", "sensor_path"):
        if rotor:
            return (f"{rotor}_tacho",)
        return (f"{axis}_sensor",) if axis else ("pitch_sensor", "yaw_sensor")
    if overrides("disturbance"):
        touched = _touched(model)
        if touched:
            return touched
    if rotor:
        return (f"{rotor}_motor",)
    return (f"{axis}_moment",) if axis else ()


def variants(parameters: Sequence[Parameter]) -> FloatArray:
    """Sizes to try an effect at, one row each.

    The first size, and every other that is zero by default, can make the effect vanish: each of
    them is tried alone over its typical range, to both sides where both make sense; the others
    stay as they are, but for an arm that may point either way and a frequency, which no slope
    leads to from afar.
    """
    defaults = np.array([p.value for p in parameters], dtype=float)
    amplitudes = [i for i, p in enumerate(parameters) if i == 0 or _vanishes(p)]
    shapes = [i for i in range(len(parameters)) if i not in amplitudes]
    rows = []
    for i in amplitudes:
        base = defaults.copy()
        base[amplitudes] = 0.0
        for value, shape in itertools.product(_tried(parameters[i]), _shapes(parameters, shapes)):
            row = base.copy()
            row[i] = value
            row[shapes] = shape
            rows.append(row)
    return np.array(rows)


def _vanishes(parameter: Parameter) -> bool:
    return parameter.value == 0.0 and parameter.unit not in ("rad",) and parameter.name != "height"


def _tried(parameter: Parameter) -> list[float]:
    low, high = parameter.typical or (parameter.value / 3, parameter.value * 3)
    signed = low < 0 < high
    if signed or low == 0:
        middle = max(abs(low), abs(high)) / 2
        multiples: tuple[float, ...] = (0.4, 1.5)
    else:
        middle = float(np.sqrt(low * high))
        multiples = _MULTIPLES
    values = [middle * k for k in multiples]
    if signed or parameter.lower < 0:
        values += [-v for v in values]
    return [v for v in values if parameter.lower <= v <= parameter.upper]


def _shapes(parameters: Sequence[Parameter], chosen: Sequence[int]) -> list[tuple[float, ...]]:
    options = []
    for i in chosen:
        p = parameters[i]
        if p.name == "arm":
            options.append([p.value, -p.value])
        elif p.name in ("frequency", "width"):
            low, high = p.typical or (p.value / 2, p.value * 2)
            options.append([low * (high / low) ** k for k in (0.15, 0.5, 0.85)])
        else:
            options.append([p.value])
    return list(itertools.product(*options))


def _free(effect: str, index: int, parameter: Parameter) -> FreeParameter:
    low, high = parameter.typical or (parameter.value / 3, parameter.value * 3)
    amplitude = index == 0 or _vanishes(parameter)
    if amplitude or low <= 0 <= high:
        mean, sd = 0.0, _WIDTH * max(abs(low), abs(high))
        if not amplitude:
            mean, sd = parameter.value, max(abs(low), abs(high))
    else:
        mean, sd = parameter.value, high - low
    lower, upper = parameter.lower, parameter.upper
    if not amplitude and low > 0:  # what only gives an effect its shape stays near what is typical
        lower, upper = max(lower, low / _BEYOND), min(upper, high * _BEYOND)
    mean = float(np.clip(mean, lower, upper))
    return FreeParameter(
        name=f"{effect}.{parameter.name}",
        unit=parameter.unit,
        start=parameter.value,
        prior_mean=mean,
        prior_sd=sd,
        lower=lower,
        upper=upper,
    )


def _touched(model: ExtendedModel) -> tuple[str, ...]:
    """Equations on which an effect puts a torque, as its expressions say."""
    import casadi as ca

    from trms_cli.effects.effect import EffectContext

    base, effect = model.base, model.effect
    x, u, p, w = base.symbols()
    sizes = {q.name: ca.SX.sym(q.name) for q in effect.parameters()}
    own = ca.SX.sym("own", len(effect.states()))
    torque = effect.disturbance(EffectContext(base, x, u, p, w, own, sizes))
    return tuple(
        signal.name for i, signal in enumerate(base.disturbances) if not torque[i].is_zero()
    )
