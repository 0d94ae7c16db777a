"""Dry friction with a constant force that it holds against: where a search for both begins.

Without the force, friction falls behind others that look like both, or is not found at all: no
partners would be looked for beside it. Where the model sticks hangs on both sizes, so that no slope
leads from far away to them, and many are tried.
"""

from collections.abc import Mapping
from functools import cache
from heapq import nlargest
from itertools import product

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.effects.effect import rotor_input
from trms_cli.effects.input_bias import InputBias
from trms_cli.gap.competing_model import Metric, ModelStructure, Refit
from trms_cli.gap.problem import CandidateEffect
from trms_cli.models.model import Model, names
from trms_cli.models.vector_field import VectorField

#: Sizes of friction, and of the force to either side; and how many of these points are the best.
_FRICTIONS, _FORCES, _BEST = 12, 10, 8


def is_constant(candidate: CandidateEffect) -> bool:
    """Whether an effect is a constant force."""
    return isinstance(candidate.effect, InputBias)


def held_forces(model: Model, candidates: Mapping[str, CandidateEffect]) -> list[tuple[str, str]]:
    """Dry frictions of one size (rivals come in their stead), each with the forces it may hold."""
    if model.bench_sizes:
        return []
    dry = [n for n, c in candidates.items() if c.effect.overrides("impulse") and len(c.free) == 1]
    forces = [name for name, candidate in candidates.items() if is_constant(candidate)]
    # sizes that an effect of the user's own states may have any sign, or be none
    tried = {name for name in (*dry, *forces) if np.abs(candidates[name].variants[:, 0]).min() > 0}
    return [
        (name, force)
        for name in filter(tried.__contains__, dry)
        for force in filter(tried.__contains__, forces)
        if _meet(model, candidates[name], candidates[force])
    ]


def _meet(model: Model, friction: CandidateEffect, force: CandidateEffect) -> bool:
    """Whether both may act on one equation: not if the input pushes another one directly."""
    axis = getattr(friction.effect, "axis", "")
    if axis not in model.axes or not isinstance(force.effect, InputBias):
        return True
    slopes = VectorField(model).slopes(0, 0, model.parameters.values, 0)
    pushed = np.array(slopes[1])[:, rotor_input(model, force.effect.rotor)]
    of_equations = np.array(slopes[3])
    lengths = np.linalg.norm(of_equations, axis=0) * np.linalg.norm(pushed)
    alike = np.abs(pushed @ of_equations) > (1 - 1e-9) * lengths
    own = names(model.disturbances).index(model.axes[axis].moment)
    return bool(alike[own] or not alike.any())


def best_sizes(
    structure: ModelStructure,
    refit: Refit,
    metric: Metric,
    pair: tuple[CandidateEffect, CandidateEffect],
    others: Mapping[str, float],
) -> list[tuple[FloatArray, FloatArray]]:
    """Points of a model with friction and force, the most promising first.

    ``pair``: the friction and the force. ``others``: values of all other parameters, by name.
    """
    tried_frictions, tried_forces = (np.abs(c.variants[:, 0]) for c in pair)
    around = np.geomspace(tried_forces.min() / 2, tried_forces.max(), _FORCES)
    frictions = np.geomspace(tried_frictions.min(), tried_frictions.max(), _FRICTIONS)
    forces = np.array([*-around[::-1], 0.0, *around])

    def point(place: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        sizes = float(frictions[place[0]]), float(forces[place[1]])
        own = dict(zip((c.free[0].name for c in pair), sizes, strict=True))
        return structure.point({**others, **own}, refit.fit.starts)

    @cache
    def score(place: tuple[int, int]) -> float:
        points, gains = [point(place)], refit.fit.gains
        entry = structure.fit(metric, points, centres=refit.centres, gains=gains, iterations=0)
        return entry.fit.score

    # every second size, then all about the best of these
    places = product(range(0, len(frictions), 2), range(0, len(forces), 2))
    near = {
        (i + di, j + dj)
        for i, j in nlargest(_BEST, places, key=score)
        for di, dj in product((-1, 0, 1), repeat=2)
        if 0 <= i + di < len(frictions) and 0 <= j + dj < len(forces)
    }
    return [point(place) for place in nlargest(_BEST, near, key=score)]
