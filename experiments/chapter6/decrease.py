"""The claim of the terminal constraint: the objective falls by the stage cost every sample.

With J(k) the objective of the plan at sample k, ℓ(k) what its first period costs, and the plan
ending where it must, the plan shifted in time costs J(k) − ℓ(k) and what its new last period costs.
Behind the terminal equality that is the last move, back to the steady-state input; behind a
terminal region nothing, for V falls by it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.chapter6.rig import FloatArray, Loop, Record
from experiments.chapter6.study import Decrease, Mode, draw_states


@dataclass(frozen=True)
class Claim:
    """What became of it in one mode."""

    mode: str
    samples: int  #: All of them
    held: float  #: Share of samples whose plan ended where it must
    kept: float  #: Share of these after which J fell by ℓ, within the tolerance
    kept_with_move: float  #: The same with the last move allowed for
    worst: float  #: Largest J(k+1) − J(k) + ℓ(k) after them, relative to J(k)
    converged: float  #: Share of samples whose iterations converged
    shifted: float  #: Largest terminal residual of a shifted plan after a held sample
    arrived: float  #: Largest error of an angle at the end, rad


def study_decrease(study: Decrease, seed: int) -> tuple[list[Claim], dict[str, list[Record]]]:
    """Every mode from the same states; the runs besides, by mode."""
    claims, runs = [], {}
    for name, mode in study.modes.items():
        if study.only and name not in study.only:
            continue
        claim, records = _checked(name, mode, study, seed)
        claims.append(claim)
        runs[name] = records
    return claims, runs


def _checked(name: str, mode: Mode, study: Decrease, seed: int) -> tuple[Claim, list[Record]]:
    mpc = mode.controller()
    loop, goal = Loop(mpc, mode.substeps), np.array(study.goal)
    target = loop.state.steady_state.solve(goal)
    goals = np.tile(goal, (study.samples, 1))
    records = [
        loop.run(x, goals, target.u) for x in draw_states(target.x, study.box, study.states, seed)
    ]
    rows = [_gaps(record, mode.terminal) for record in records]
    before, gaps, moves = (np.concatenate([row[i] for row in rows]) for i in range(3))
    is_met = np.concatenate([r.residual[:-1] <= study.held for r in records])
    slack = study.tolerance * before
    floor = before > 1e-9  # at rest there is nothing left to fall
    shifted = np.concatenate([r.shifted[1:] for r in records])
    angles = [2, 5]
    return (
        Claim(
            name,
            sum(len(r.objective) for r in records),
            float(is_met.mean()),
            float((gaps <= slack)[is_met & floor].mean()),
            float((gaps <= moves + slack)[is_met & floor].mean()),
            float((gaps / np.maximum(before, 1e-9))[is_met & floor].max()),
            float(np.concatenate([r.converged for r in records]).mean()),
            float(shifted[is_met].max()),
            float(max(np.abs(r.x[-1] - target.x)[angles].max() for r in records)),
        ),
        records,
    )


def _gaps(record: Record, terminal: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """J(k), J(k+1) − J(k) + ℓ(k), and the cost of the last move, (n − 1,) each."""
    before = record.objective[:-1]
    gaps = record.objective[1:] - before + record.stage[:-1]
    moves = record.last_move[:-1] if terminal == "equality" else np.zeros_like(before)
    return before, gaps, moves
