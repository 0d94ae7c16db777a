"""The conditions under which a trial is tried: the choices, crossed with rigs from the priors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from trms_cli.sweeps.samplers.drawing import Part, all_chosen, drawn_part, quantiles
from trms_cli.sweeps.samplers.latin_hypercube import hypercube
from trms_cli.sweeps.space import Choice, Prior, Space

#: Choices whose values are random numbers' seeds: fresh ones are conditions that nothing has seen.
_SEEDS = ("seed", "plant.prior_seed")
_FRESH = 0x46524553  # another stream of draws than that of the trials


def conditions_of(space: Space, draws: int, seed: int) -> list[Part]:
    """All conditions: every combination of choices with every draw.

    Parameters
    ----------
    draws : int
        Draws from the priors; one and the same for all trials. Without priors there is none.
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
    priors = [varied for varied in space.continuous if isinstance(varied, Prior)]
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
