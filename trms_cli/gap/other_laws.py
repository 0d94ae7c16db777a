"""Whether the model's own laws are of another form than the rig's, before effects are blamed.

Where every law of a model errs by a tenth, three effects that mimic them explain a recording better
than the one that the rig has. So the nominal model is refitted once more with its laws free
(:mod:`trms_cli.effects.other_laws`), each held by a prior to what models usually err by, and the
effects race again beside it. The richer world is taken where its best says clearly more than the
best of the plain one: with few laws off it hardly does, for its score is a held-out one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from trms_cli.core.wording import number
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.other_laws import LAWS
from trms_cli.gap.competing_model import FittedModel, Refit, refit
from trms_cli.gap.diagnosis import LawDeparture
from trms_cli.gap.problem import applicable_candidates
from trms_cli.gap.race import Race
from trms_cli.identification.problem import FreeParameter
from trms_cli.models.model import Model

#: Nats that the best of a race must gain for the model's laws to be doubted at all, that free laws
#: alone must gain for effects to race beside them, and by which the best there must lead.
_WORTH_DOUBTING, _FREE, _LEAD = 20.0, 15.0, 8.0
#: Largest departure of a law that is still the model's, and the share of it from which on one is
#: taken to go beyond.
_MOST, _NEAR = 0.2, 0.95


@dataclass(frozen=True)
class FreeLaws:
    """The nominal model with its laws free, refitted."""

    model: Model
    nominal: Refit


def with_free_laws(race: Race, unseen: int = 0) -> FreeLaws | None:
    """The refit with free laws, where it says enough to race again; None: the laws will do.

    ``unseen``: as of :func:`~trms_cli.gap.competing_model.refit`.
    """
    plain = race.refit
    best = max((e.fit.score for e in race.entries), default=plain.fit.score)
    if best < plain.fit.score + _WORTH_DOUBTING:
        return None
    problem = plain.structure.problem
    laws, _ = applicable_candidates(problem.model, LAWS)
    if not laws:
        return None
    model = extend_model(problem.model, {name: laws[name].effect for name in laws})
    free = [_held(size) for law in laws.values() for size in law.free]
    while free:
        made = refit(model, (*problem.free, *free), problem.datasets, problem.window_length, unseen)
        far = {name for name, law in departures(made).items() if abs(law.value) > _NEAR * _MOST}
        if not far:
            return FreeLaws(model, made) if made.fit.score > plain.fit.score + _FREE else None
        # what a law would have to bend so far for is something else, which an effect has to say
        free = [size for size in free if size.name not in far]
    return None


def _held(free: FreeParameter) -> FreeParameter:
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
            value=float(fitted.fit.theta[i]),
            sd=float(sd[i]),
            unit=free.unit,
            words=_words(free.name, float(fitted.fit.theta[i]), float(sd[i])),
        )
        for i, free in enumerate(fitted.structure.problem.free)
        if free.name.split(".")[0] in LAWS
    }


def _words(name: str, value: float, sd: float) -> str:
    """A departure as a colleague calls it."""
    law, size = name.split(".")
    axis = law.split("_")[0]
    rotor = "main" if axis == "pitch" else "tail"
    more = "more" if value > 0 else "less"
    power = f"with a power {number(abs(value), 2)} ± {number(sd, 1)}"
    higher = "higher" if value > 0 else "lower"
    share = f"{number(100 * abs(value), 2)} ± {number(100 * sd, 1)} %"
    return {
        "damping": f"{axis} damping goes {power} {higher} of the rate",
        "thrust": f"thrust of the {rotor} rotor goes {power} {higher} of its speed",
        "spring": f"{axis} is pulled back {share} {more} at 1 rad",
        "inertia": f"{axis} has {share} {more} inertia",
    }[size]
