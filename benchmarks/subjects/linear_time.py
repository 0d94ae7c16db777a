"""A sample of ``linear_mpc``: the engine's recursion, and the condensed program in NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.document import LIMIT, Column, Table
from benchmarks.lockstep import quantiles, race
from benchmarks.options import Options
from benchmarks.setups import FULL_STATE, experiment, newton_horizon
from trms_cli.controllers.linear_mpc import LinearMpc
from trms_cli.core.qp import Daqp

TITLE = "linear_mpc: time of a sample"
#: V, between commands to the same samples.
LIMIT_APART = 1e-7
_CASES = {
    **{f"N = {n}, an input a period": newton_horizon(n) for n in (20, 40, 80)},
    "default (N = 40, 20 inputs)": (),
    "default, linearisation=fixed": ("controller.linearisation=fixed",),
}


def run(options: Options) -> list[Table]:
    """Both close their own loop side by side, on squares with the full state."""
    table = Table(
        "linear_time",
        TITLE + ", by the engine's recursion and condensed (squares, full state, all of it)",
        [
            Column("case", "case"),
            Column("median", "recursion", "µs"),
            Column("p99", "99 %", "µs"),
            Column("condensed", "condensed", "µs"),
            Column("condensed_p99", "99 %", "µs"),
            Column("times", "condensed / recursion"),
            Column("apart", "apart", "V"),
            *LIMIT,
        ],
    )
    for name, overrides in options.cases(_CASES).items():
        chosen = experiment(
            *("controller=linear_mpc", "ref=square", *FULL_STATE, *overrides),
            f"sim.duration={options.duration(80.0)}",
        )
        assert isinstance(chosen.controller, LinearMpc)
        condensed = replace(chosen.controller, qp=Daqp())
        ours, theirs = race(chosen, {"recursion": chosen.controller, "condensed": condensed})
        median, p99 = quantiles(ours.counted_times)
        of_condensed, of_condensed_p99 = quantiles(theirs.counted_times)
        apart = float(np.abs(np.array(ours.commands) - np.array(theirs.commands)).max())
        table.add_limited(
            "apart",
            apart,
            LIMIT_APART,
            case=name,
            median=median,
            p99=p99,
            condensed=of_condensed,
            condensed_p99=of_condensed_p99,
            times=of_condensed / median,
        )
    table.notes.append(
        "condensed: the trajectory's slopes, the dense program and DAQP in NumPy, as without a "
        "compiler (the slopes are compiled here). The limit is on the difference of the commands."
    )
    return [table]
