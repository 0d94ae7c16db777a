"""One Newton iteration a sample against several: what they cost, and what they gain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.chapter6.rig import MODEL, FloatArray, Loop
from experiments.chapter6.study import Iterations, Mode


@dataclass(frozen=True)
class Economy:
    """A closed loop with a number of iterations."""

    reference: str
    horizon: str
    count: int  #: Iterations a sample at the most
    cost: float  #: Sum of the stage costs of the loop, in the objective's unit
    mean_iterations: float
    seconds: float  #: Median time of a sample's computation, s; of this machine at this hour


def square_wave(wave: dict[str, float], duration: float, period: float) -> FloatArray:
    """Goals of both axes, a row a control period, high first."""
    time = np.arange(round(duration / period)) * period
    high = np.mod(time / wave["period"], 1.0) < 0.5
    sizes = np.array([wave[name] for name in MODEL.controlled])
    return np.where(high, 1.0, -1.0)[:, None] * sizes


def study_iterations(study: Iterations) -> list[Economy]:
    """Every count on every reference with every horizon."""
    rows = []
    for name, settings in study.horizons.items():
        if study.only and name not in study.only:
            continue
        for reference, wave in study.references.items():
            for count in study.counts:
                mode = Mode(
                    horizon=settings.get("horizon", 0), iterations=count, tolerance=study.tolerance
                )
                loop = Loop(mode.controller())
                goals = square_wave(wave, study.duration, loop.mpc.sample_time)
                record = loop.run(MODEL.rest(), goals, np.zeros(MODEL.n_u))
                rows.append(
                    Economy(
                        reference,
                        name,
                        count,
                        float(record.stage.sum()),
                        float(record.iterations.mean()),
                        float(np.median(record.seconds)),
                    )
                )
    return rows
