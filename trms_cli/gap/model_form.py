"""Whether the model's own laws are of another form than the rig's, before effects are blamed.

Where every law of a model errs by a tenth, three effects that mimic them explain a recording better
than the one that the rig has. So the nominal model is refitted once more with its laws free
(:mod:`trms_cli.effects.model_form`), each held by a prior to what models usually err by, and the
effects race again beside it. The richer world is taken where its best says clearly more than the
best of the plain one: with few laws off it hardly does, for its score is a held-out one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from trms_cli.core.wording import number
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import ExtendedModel, extend_model
from trms_cli.effects.model_form import MODEL_FORM
from trms_cli.gap.competing_model import FittedModel, Refit, refit
from trms_cli.gap.diagnosis import LawDeparture
from trms_cli.gap.problem import applicable_candidates
from trms_cli.gap.race import Race
from trms_cli.identification.problem import FreeParameter
from trms_cli.models.model import Model
from trms_cli.models.parameters import ParameterSet

#: Nats that the best of a race must gain for the model's laws to be doubted at all, that free laws
#: alone must gain for effects to race beside them, and by which the best there must lead.
_WORTH_DOUBTING, _FREE, _LEAD = 20.0, 15.0, 8.0
#: Largest departure of a law that is still the model's, and the share of it from which on one is
#: taken to go beyond.
_MOST, _NEAR = 0.2, 0.95


@dataclass(frozen=True)
class FreeForm:
    """The nominal model with the form of its laws free, refitted."""

    model: Model
    nominal: Refit

    @property
    def key(self) -> str:
        """What is kept of a race beside it begins with this."""
        return f"form {' '.join(departures(self.nominal))} "


def refit_with_free_form(
    race: Race,
    unseen: int = 0,
    *,
    candidate_names: Collection[str] = (),
    watch: Callable[[str], object] = lambda message: None,
) -> FreeForm | None:
    """The refit with free laws, where it says enough to race again; None: the laws will do.

    ``unseen``: as of :func:`~trms_cli.gap.competing_model.refit`. ``candidate_names``: these
    are no nuisance. ``watch``: told what is being done, may raise to stop.
    """
    plain = race.refit
    best = max((e.fit.score for e in race.entries), default=plain.fit.score)
    if best < plain.fit.score + _WORTH_DOUBTING:
        return None
    problem = plain.structure.problem
    free_of_them = {name: law for name, law in MODEL_FORM.items() if name not in candidate_names}
    laws, _ = applicable_candidates(problem.model, free_of_them)
    if not laws:
        return None
    model = with_effects_beneath_impulses(problem.model, {n: laws[n].effect for n in laws})
    free = [_with_prior(size) for law in laws.values() for size in law.free]
    while free:
        watch("laws of another form")
        try:
            free_refit = refit(
                model, (*problem.free, *free), problem.datasets, problem.window_length, unseen
            )
        except (FloatingPointError, np.linalg.LinAlgError):
            return None  # what cannot be reckoned with is no reason to stop
        beyond = {
            name for name, law in departures(free_refit).items() if abs(law.value) > _NEAR * _MOST
        }
        if not beyond:
            return (
                FreeForm(model, free_refit)
                if free_refit.fit.score > plain.fit.score + _FREE
                else None
            )
        # what a law would have to bend so far for is something else, which an effect has to say
        free = [size for size in free if size.name not in beyond]
    return None


def with_effects_beneath_impulses(model: Model, effects: Mapping[str, Effect]) -> Model:
    """The model with further effects in the order in which a model file would have them.

    Impulses (dry friction) that the model has already act after them.
    """
    own: dict[str, Effect] = {}
    base = model
    while isinstance(base, ExtendedModel):
        own = {base.effect_name: base.effect, **own}
        base = base.base
    extended_model = extend_model(base, {**own, **effects})
    own_parameters = {p.name: p for p in model.parameters}
    extended_model.parameters = ParameterSet(
        [own_parameters.get(p.name, p) for p in extended_model.parameters]
    )
    return extended_model


def _with_prior(free: FreeParameter) -> FreeParameter:
    """A law's departure with its prior: about none, as wide as half of what an effect's is."""
    sd = (free.prior_sd or 2 * _MOST) / 2
    return replace(free, start=0.0, prior_mean=0.0, prior_sd=sd, lower=-_MOST, upper=_MOST)


def leads(free: Race, plain: Race) -> bool:
    """Whether the best beside free laws says clearly more than all that raced without."""
    with_, without = (
        max((race.refit.fit.score, *(e.fit.score for e in race.entries))) for race in (free, plain)
    )
    return with_ > without + _LEAD


def departures(fitted: FittedModel) -> dict[str, LawDeparture]:
    """Departures of the laws of a fitted model by name; empty where they were not free."""
    sd = fitted.fit.sd
    return {
        free.name: LawDeparture(
            value=float(fitted.at_mean_gains[i]),
            sd=float(sd[i]),
            unit=free.unit,
            words=_words(free.name, float(fitted.at_mean_gains[i]), float(sd[i])),
        )
        for i, free in enumerate(fitted.structure.problem.free)
        if free.name.split(".")[0] in MODEL_FORM
        and free.name.split(".")[0] not in fitted.names  # that raced for itself
    }


def _words(name: str, value: float, sd: float) -> str:
    """A departure as a colleague calls it."""
    law, size = name.split(".")
    axis = law.removesuffix("_model_form")
    rotor = MODEL_FORM[law].rotor
    more = "more" if value > 0 else "less"
    higher = "a higher power" if value > 0 else "a lower power"
    by = f"(by {number(abs(value), 2)} ± {number(sd, 1)})"
    share = f"{number(100 * abs(value), 2)} ± {number(100 * sd, 1)} %"
    return {
        "damping": f"{axis} damping goes with {higher} of the rate {by}",
        "thrust": f"thrust of the {rotor} rotor goes with {higher} of its speed {by}",
        "spring": f"{axis} is pulled back {share} {more} at 1 rad",
        "inertia": f"{axis} has {share} {more} inertia",
    }[size]
