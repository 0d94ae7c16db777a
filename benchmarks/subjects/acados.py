"""``newton_mpc`` beside acados: the same problem in the same loop, where acados is installed.

acados is no dependency: it is built from source (docs/benchmarks.md, “Beside acados”). Where it is
missing its row says what there is to install, and ``newton_mpc`` is timed alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from benchmarks.document import Column, Table, Value
from benchmarks.lockstep import WARM_UP, Entrant, quantiles, race
from benchmarks.options import Options
from benchmarks.peers import acados_peer
from benchmarks.peers.acados_peer import FULL_CONDENSING, PARTIAL_CONDENSING, Acados
from benchmarks.setups import CONVERGED, FULL_STATE, experiment, newton_horizon, newton_of
from trms_cli.controllers.controller import Controller, ControlSample, ControlSetup
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.core.arrays import FloatArray
from trms_cli.models.estimate import Estimate
from trms_cli.simulation.closed_loop import Experiment

TITLE = "newton_mpc and acados on the same problem"
#: Horizons and iterations at the most.
_CASES = ((20, 1), (40, 1), (80, 1), (20, 50))
_QP_SOLVERS = {
    "acados, full condensing, DAQP": FULL_CONDENSING,
    "acados, partial condensing, HPIPM": PARTIAL_CONDENSING,
}
#: Samples whose commands are compared, both controllers iterated to the end: the way from rest to
#: the first reference, and the step at 20 s.
_COMPARED = 250
_OTHER_MINIMUM = 1e-3  # V
_NEWTON, _TO_THE_END = "newton_mpc", 200


def run(options: Options) -> list[Table]:
    """Race them by horizon; an acados that is missing gets a row that says so."""
    table = Table(
        "acados",
        TITLE + " (squares, full state, T_s = 0.1 s, bounds, terminal equality, no blocks)",
        [
            Column("periods", "N"),
            Column("mode", "iterations"),
            Column("solver", "solver"),
            Column("median", "median", "µs"),
            Column("p99", "99 %", "µs"),
            Column("inside", "of it in C", "µs"),
            Column("ratio", "newton_mpc", "of its time"),
            Column("iterations", "mean", "iterations"),
            Column("failures", "failures"),
            Column("objective", "closed-loop", "objective", 6),
            Column("apart", "apart", "V", 2),
            Column("elsewhere", "elsewhere", "%", 2),
            Column("remark", ""),
        ],
    )
    missing = acados_peer.missing_part()
    for periods, iterations in _CASES:
        _race(table, options, periods, iterations, {} if missing else _QP_SOLVERS)
    if missing:
        table.add(solver="acados", remark=missing)
    table.notes += [
        "median and 99 %: everything from an estimate to a command, called from Python. “In C”: of "
        "newton_mpc linearisation and QP, of acados its time_tot, preparation and feedback.",
        "newton_mpc of its time: its median over acados', side by side in one run; below 1 it is "
        "ahead.",
        "apart: median difference of first commands, both iterated to the end at the same samples. "
        f"Elsewhere: samples where it is above {_OTHER_MINIMUM:g} V, each in a minimum of its own.",
    ]
    return [table]


def _race(
    table: Table,
    options: Options,
    periods: int,
    iterations: int,
    qp_solvers: Mapping[str, str],
) -> None:
    loop_setup = experiment(
        "controller=newton_mpc",
        "ref=square",
        *FULL_STATE,
        *newton_horizon(periods),
        f"sim.duration={options.duration(80.0)}",
    )
    problem = newton_of(loop_setup)
    mode = "one" if iterations == 1 else "converged"
    peers = {name: Acados(problem, qp, iterations) for name, qp in qp_solvers.items()}
    remarks = {name: _trial(loop_setup, peer) for name, peer in peers.items()}
    runnable = {name: peer for name, peer in peers.items() if not remarks[name]}
    controllers: dict[str, Controller] = {
        _NEWTON: replace(problem, max_iterations=iterations, tolerance=CONVERGED["tolerance"]),
        **runnable,
    }
    newton, *others = race(loop_setup, controllers)
    reference = quantiles(newton.counted_times)[0]
    table.add(periods=periods, mode=mode, **_cells(newton, problem))
    for entrant in others:
        apart = command_differences(newton, problem, runnable[entrant.name], _COMPARED)
        table.add(
            periods=periods,
            mode=mode,
            ratio=reference / quantiles(entrant.counted_times)[0],
            apart=float(np.median(apart)),
            elsewhere=float(100.0 * np.mean(apart > _OTHER_MINIMUM)),
            **_cells(entrant, problem),
        )
    for name, remark in remarks.items():
        if remark:
            table.add(periods=periods, mode=mode, solver=name, remark=remark)


def _cells(entrant: Entrant, problem: NewtonMpc) -> Mapping[str, Value]:
    median, p99 = quantiles(entrant.counted_times)
    inside = [answer.linearise_time + answer.qp_time for answer in entrant.answers[WARM_UP:]]
    return {
        "solver": entrant.name,
        "median": median,
        "p99": p99,
        "inside": float(1e6 * np.median(inside)),
        "iterations": entrant.iterations,
        "failures": entrant.failures,
        "objective": entrant.closed_loop_objective(problem),
    }


def _trial(loop_setup: Experiment, peer: Acados) -> str:
    """Why a peer does not run here, in its last word; empty where it does."""
    try:
        race(replace(loop_setup, duration=2 * peer.sample_time), {"trial": peer})
    except Exception as error:
        words = str(error).strip().splitlines() or [type(error).__name__]
        return f"does not run here: {words[-1]}"
    return ""


def command_differences(
    along: Entrant, problem: NewtonMpc, peer: Acados, samples: int
) -> FloatArray:
    """How far first commands are apart at the samples of a loop, both iterated to the end, V.

    ``along``: the loop, of any controller. It tells whether the two solve the same problem: their
    own loops drift apart with whatever they do not agree about.
    """
    newton = replace(problem, max_iterations=_TO_THE_END, tolerance=1e-9)
    setup = ControlSetup(along.experiment.model, along.period, along.plant.first_command)
    ours, theirs = newton.init(setup), peer.init(setup)
    differences, previous = [], along.plant.first_command
    n_x, n_w = along.experiment.model.n_x, along.experiment.model.n_w
    for k, (state, command) in enumerate(zip(along.states, along.commands, strict=False)):
        if k == samples:
            break
        estimate = Estimate(state, np.zeros(n_x), np.zeros(n_w), np.zeros(n_w))
        sample = ControlSample(k * along.period, along.references[k : k + 1], estimate, previous)
        u = newton.step(ours, sample, want_prediction=False).u
        other = theirs.solve(sample, repeats=_TO_THE_END)
        differences.append(float(np.abs(u - other.u).max()))
        previous = command
    return np.array(differences)
