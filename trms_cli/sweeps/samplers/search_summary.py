"""What a search found, as JSON data: every trial, the best, the front, and how it got there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from trms_cli.sweeps.figures import unit_of
from trms_cli.sweeps.samplers.drawing import Part, all_chosen, drawn_part, quantiles
from trms_cli.sweeps.samplers.latin_hypercube import hypercube
from trms_cli.sweeps.samplers.objectives import Aims, Tried, front, hypervolumes
from trms_cli.sweeps.space import Choice, PriorOfKey, Space


def best_trials(aims: Aims, tried: Sequence[Tried | None]) -> list[int]:
    """Numbers of the trials that no other allowed trial dominates; of one objective the best."""
    allowed = [i for i, each in enumerate(tried) if each is not None and aims.allowed(each)]
    if not allowed:
        return []
    losses = np.array([aims.losses(each) for each in tried if each and aims.allowed(each)])
    if losses.shape[1] == 1:
        return [allowed[int(losses.argmin())]]
    order = front(losses)
    return [allowed[i] for i in order[np.argsort(losses[order, 0], kind="stable")]]


def outcome(
    aims: Aims,
    parts: Sequence[Part],
    tried: Sequence[Tried | None],
    conditions: int,
    fixed: Sequence[str],
) -> dict[str, Any]:
    """What is known of a search, also of one that was stopped.

    Returns ``objectives``: name, unit and direction of each. ``trials``: of each that has ended its
    number, the values that it set, what to type for them, its figures, whether it was allowed, or
    why it failed. ``pareto``: numbers of the best, along the first objective. ``best``: the number
    of the best for one objective. ``history``: after each trial the best so far, or with several
    objectives the hypervolume, None before there is one.
    """
    ended = [(i, each) for i, each in enumerate(tried) if each is not None]
    best = best_trials(aims, tried)
    return {
        "kind": "optimisation",
        "objectives": [
            {
                "name": name,
                "unit": unit_of(name),
                "direction": "maximise" if name in aims.maximised else "minimise",
            }
            for name in aims.objectives
        ],
        "limits": dict(aims.limits),
        "over_conditions": "worst" if aims.worst else "mean",
        "conditions": conditions,
        "fixed": list(fixed),
        "trials": [_record(aims, i, parts[i], each, conditions) for i, each in ended],
        "pareto": best,
        "best": best[0] if best and len(aims.objectives) == 1 else None,
        "history": _history(aims, [each for _, each in ended]),
    }


def _record(aims: Aims, number: int, part: Part, tried: Tried, conditions: int) -> dict[str, Any]:
    record: dict[str, Any] = {
        "trial": number,
        "points": list(range(number * conditions, (number + 1) * conditions)),
        "values": dict(part.values or {}),
        "overrides": list(part.overrides),
        "figures": dict(tried.figures),
        "allowed": aims.allowed(tried),
    }
    return record | ({"problem": tried.problem} if tried.failed else {})


def _history(aims: Aims, tried: Sequence[Tried]) -> list[float | None]:
    """After each trial: the best so far, or the hypervolume of the front so far."""
    allowed = [i for i, each in enumerate(tried) if aims.allowed(each)]
    steps: dict[int, float] = {}
    if allowed:
        losses = np.array([aims.losses(tried[i]) for i in allowed])
        if len(aims.objectives) == 1:
            sign = -1.0 if aims.maximised else 1.0
            so_far = [float(sign * value) for value in np.minimum.accumulate(losses[:, 0])]
        else:
            so_far = hypervolumes(losses) or []
        steps = dict(zip(allowed, so_far, strict=False))
    history: list[float | None] = []
    for i in range(len(tried)):
        history.append(steps.get(i, history[-1] if history else None))
    return history


#: Choices whose values are random numbers' seeds: fresh ones are conditions that nothing has seen.
_SEEDS = ("seed", "plant.prior_seed")
_FRESH = 0x46524553  # another stream of draws than that of the trials


def conditions_of(space: Space, draws: int, seed: int) -> list[Part]:
    """All conditions: every combination of choices with every draw.

    ``draws``: draws from the priors; one and the same for all trials. Without priors there is none.
    """
    rigs = _rigs(space, draws, [seed])
    return [rig + choice for rig in rigs for choice in all_chosen(space.choices)]


def fresh_conditions(space: Space, count: int, seed: int) -> list[Part]:
    """Conditions that no trial has seen: `count` seeds not used, each with a rig of its own.

    Seeds that were choices (``seed=1,2``, ``plant.prior_seed=range(5)``) are replaced, all other
    choices kept.
    """
    kept = tuple(choice for choice in space.choices if choice.key not in _SEEDS)
    seeded = [choice for choice in space.choices if choice.key in _SEEDS]
    if not any(choice.key == "seed" for choice in seeded):
        seeded.append(Choice("seed", ()))
    columns = [_unused(choice, space.fixed, count) for choice in seeded]
    rigs = _rigs(space, count, [seed, _FRESH])
    parts = []
    for i in range(count):
        values = {choice.key: column[i] for choice, column in zip(seeded, columns, strict=True)}
        drawn = Part(tuple(f"{key}={value}" for key, value in values.items()), values)
        parts += [rigs[i % len(rigs)] + drawn + choice for choice in all_chosen(kept)]
    return parts


def _rigs(space: Space, draws: int, seed: Sequence[int]) -> list[Part]:
    priors = [varied for varied in space.continuous if isinstance(varied, PriorOfKey)]
    if not priors:
        return [Part()]
    shares = hypercube(draws, len(priors), list(seed))
    columns = [quantiles(prior, shares[:, i]) for i, prior in enumerate(priors)]
    return [drawn_part(priors, row) for row in zip(*columns, strict=True)]


def _unused(choice: Choice, fixed: Sequence[str], count: int) -> list[str]:
    """Seeds that are neither among the values of a choice nor fixed, nor the default."""
    typed = [text.partition("=") for text in fixed]
    used = {*choice.values, "0", *(value for key, _, value in typed if key == choice.key)}
    return list(_first(count, (str(n) for n in range(1, 10**9) if str(n) not in used)))


def _first(count: int, values: Iterator[str]) -> Iterator[str]:
    for _ in range(count):
        yield next(values)
