"""``python -m tests.fuzz.quadratic_programs``: drawn programs of the engine by the million.

All of them have to end within their bound of recursions, finite and within their limits; one in so
many is solved by DAQP and OSQP besides, and its optimality is compared.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np

from tests.controllers.test_riccati_qp import CASES, Program, merit
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.controllers.qp.osqp import Osqp
from trms_cli.core.qp import Daqp

#: Optimality that may be lost, as a share of the program's value.
_LOST = 1e-6


def main() -> int:
    """Hunt in all structures; how many programs failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.quadratic_programs")
    parser.add_argument("--count", type=int, default=125_000, help="programs of each structure")
    parser.add_argument("--every", type=int, default=50, help="how many go by between two compared")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    failed = 0
    for name, (keys, model) in CASES.items():
        with tempfile.TemporaryDirectory() as folder:
            programs = Program(Path(folder), NewtonMpc(**keys), model(), optimise="-O3")
            failed += _hunt(name, programs, options)
    return 1 if failed else 0


def _hunt(name: str, programs: Program, options: argparse.Namespace) -> int:
    draw, begin, daqp, osqp = np.random.default_rng(options.seed), perf_counter(), Daqp(), Osqp()
    failed = compared = worst_recursions = 0
    worst = 0.0
    for k in range(options.count):
        programs.draw(draw)
        z, _, _ = programs.solve()
        worst_recursions = max(worst_recursions, programs.recursions)
        failed += not np.isfinite(z).all()
        if k % options.every:
            continue
        qp = programs.condensed()
        others = [s.solve(s.start(), qp) for s in (daqp, osqp)]
        box = qp.lower[: len(z)], qp.upper[: len(z)]
        values = [merit(qp, np.clip(other.z, *box)) for other in others if other.solved]
        if len(values) < 2 or abs(values[0] - values[1]) > _LOST * (1 + abs(values[0])):
            continue  # they do not agree either
        lost = (merit(qp, z) - min(values)) / (1 + abs(min(values)))
        compared, worst = compared + 1, max(worst, lost)
        failed += lost > _LOST
    print(
        f"{name:12} {options.count} programs in {perf_counter() - begin:.0f} s, {failed} failed; "
        f"at most {worst_recursions} recursions of {programs.sizes['RECURSIONS']}; of {compared} "
        f"that DAQP and OSQP agree on, {worst:.1e} of the value lost at most",
        flush=True,
    )
    return failed


if __name__ == "__main__":
    sys.exit(main())
