"""What a search found, as JSON data: every trial, the best, the front, and how it got there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from trms_cli.sweeps.figures import unit_of
from trms_cli.sweeps.samplers.drawing import Part
from trms_cli.sweeps.samplers.optimisation.aims import Aims, Tried, front, hypervolumes


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

    Returns
    -------
    dict
        ``objectives``: name, unit and direction of each. ``trials``: of each that has ended its
        number, the values that it set, what to type for them, its figures, whether it was allowed,
        or why it failed. ``pareto``: numbers of the best, along the first objective. ``best``: the
        number of the best for one objective. ``history``: after each trial the best so far, or
        with several objectives the hypervolume, None before there is one.
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
