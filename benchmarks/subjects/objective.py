"""Whether ``newton_mpc`` gives up anything for its speed: its objective beside IPOPT's."""

from __future__ import annotations

from dataclasses import replace

from benchmarks.document import LIMIT, Column, Table
from benchmarks.lockstep import race
from benchmarks.options import Options
from benchmarks.setups import CONVERGED, FULL_STATE, experiment, newton_horizon, newton_of
from trms_cli.controllers.nmpc import Nmpc

TITLE = "closed-loop objective of newton_mpc beside IPOPT, both converged"
#: %, of IPOPT's.
LIMIT_DIFFERENCE = 0.5
REFERENCES = ("square", "sine", "sawtooth")


def run(options: Options) -> list[Table]:
    """Sum the stage costs along the real trajectories of both."""
    table = Table(
        "objective",
        TITLE + " (full state)",
        [
            Column("ref", "reference"),
            Column("horizon", "horizon"),
            Column("ipopt", "IPOPT", "", 5),
            Column("newton", "newton_mpc", "converged", 5),
            Column("difference", "difference", "%", 2),
            *LIMIT,
            Column("one_iteration", "newton_mpc", "one iteration", 5),
            Column("one_iteration_difference", "difference", "%", 2),
        ],
    )
    horizons = {"N = 20, no blocks": newton_horizon(20), "default": ()}
    for ref in REFERENCES:
        for name, horizon in horizons.items():
            loop_setup = experiment(
                "controller=newton_mpc",
                f"ref={ref}",
                *FULL_STATE,
                *horizon,
                f"sim.duration={options.duration(40.0)}",
            )
            problem = newton_of(loop_setup)
            entrants = race(
                loop_setup,
                {
                    "ipopt": Nmpc.of(problem, solver="ipopt", second_start="always"),
                    "newton": replace(problem, **CONVERGED),
                    "one_iteration": replace(problem, max_iterations=1),
                },
            )
            ipopt, newton, once = (entrant.closed_loop_objective(problem) for entrant in entrants)
            table.add_limited(
                "difference",
                100.0 * (newton / ipopt - 1.0),
                LIMIT_DIFFERENCE,
                ref=ref,
                horizon=name,
                ipopt=ipopt,
                newton=newton,
                one_iteration=once,
                one_iteration_difference=100.0 * (once / ipopt - 1.0),
            )
    table.notes.append(
        "IPOPT takes the better of two local minima: from its last plan and from the steady state. "
        "The limit is on the converged difference, in %; negative: newton_mpc did better."
    )
    return [table]
