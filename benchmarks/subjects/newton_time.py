"""How long a sample of ``newton_mpc`` takes: limits, and where the time goes."""

from __future__ import annotations

import numpy as np

from benchmarks.document import LIMIT, Column, Table, Value
from benchmarks.lockstep import Entrant, quantiles, race
from benchmarks.options import Options
from benchmarks.setups import FULL_STATE, experiment, iterations_of, newton_horizon

TITLE = "newton_mpc: time of a sample"
#: µs, medians.
LIMIT_ONE_ITERATION, AIM_ONE_ITERATION, LIMIT_CONVERGED = 150.0, 100.0, 1000.0
_REPEATS = 3

_CASES = {
    "one iteration, N = 20": (LIMIT_ONE_ITERATION, newton_horizon(20), 1),
    "converged, N = 20": (LIMIT_CONVERGED, newton_horizon(20), 50),
    "one iteration, default horizon": (None, (), 1),
    "default": (None, (), None),
}


def run(options: Options) -> list[Table]:
    """Time each case in a closed loop on squares with the full state."""
    table = Table(
        "newton_time",
        TITLE + " (squares, full state, all of it: references, target, status, Python)",
        [
            Column("case", "case"),
            Column("median", "median", "µs"),
            Column("p99", "99 %", "µs"),
            Column("linearise", "linearise", "µs"),
            Column("qp", "QP", "µs"),
            Column("other", "other", "µs"),
            Column("iterations", "iterations"),
            Column("samples", "samples"),
            *LIMIT,
        ],
    )
    for name, (limit, horizon, iterations) in _CASES.items():
        entrants = [
            _timed(options, horizon, iterations) for _ in range(1 if options.quick else _REPEATS)
        ]
        times = np.concatenate([entrant.counted_times for entrant in entrants])
        median, p99 = quantiles(times)
        linearise = float(np.median([entrant.part("linearise_time") for entrant in entrants]))
        qp = float(np.median([entrant.part("qp_time") for entrant in entrants]))
        cells: dict[str, Value] = {
            "case": name,
            "p99": p99,
            "linearise": linearise,
            "qp": qp,
            "other": median - linearise - qp,
            "iterations": float(np.mean([entrant.iterations for entrant in entrants])),
            "samples": len(times),
        }
        if limit is None:
            table.add(median=median, **cells)
        else:
            table.add_limited("median", median, limit, **cells)
    table.notes.append(
        f"limits in µs on the median; the aim of one iteration is {AIM_ONE_ITERATION:.0f} µs. "
        "“Other” is target, warm start, line search and status."
    )
    return [table]


def _timed(options: Options, horizon: tuple[str, ...], iterations: int | None) -> Entrant:
    loop_setup = experiment(
        "controller=newton_mpc",
        "ref=square",
        *FULL_STATE,
        *horizon,
        *iterations_of(iterations),
        f"sim.duration={options.duration(80.0)}",
    )
    return race(loop_setup, {"newton_mpc": loop_setup.controller})[0]
