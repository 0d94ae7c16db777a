"""``newton_mpc`` beside interior-point methods: the same problem, interleaved by samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from benchmarks.document import Column, Table
from benchmarks.lockstep import quantiles, race
from benchmarks.options import Options
from benchmarks.setups import FULL_STATE, experiment, newton_horizon, newton_of
from trms_cli.controllers.controller import Controller
from trms_cli.controllers.newton_mpc import NewtonMpc

TITLE = "newton_mpc and its peers on the same problem"


def run(options: Options) -> list[Table]:
    """Race on squares; a peer that is not installed gets a row that says so."""
    table = Table(
        "peers",
        TITLE + " (squares, full state, N = 20, T_s = 0.1 s, bounds, terminal equality)",
        [
            Column("solver", "solver"),
            Column("median", "median", "ms"),
            Column("p99", "99 %", "ms"),
            Column("slower", "× newton_mpc", "converged"),
            Column("iterations", "iterations"),
            Column("failures", "failures"),
            Column("objective", "closed-loop", "objective", 4),
            Column("remark", ""),
        ],
    )
    chosen = experiment(
        "controller=newton_mpc",
        "ref=square",
        *FULL_STATE,
        *newton_horizon(20),
        f"sim.duration={options.duration(40.0)}",
    )
    problem = newton_of(chosen)
    controllers: dict[str, Controller] = {
        "newton_mpc, converged": replace(problem, max_iterations=50),
        "newton_mpc, one iteration": replace(problem, max_iterations=1),
    }
    missing: dict[str, str] = {}
    for name, make in peers(problem).items():
        try:
            controller = make()
            race(replace(chosen, duration=2 * problem.sample_time), {name: controller})
        except ModuleNotFoundError as error:
            missing[name] = f"not installed ({error.name}): pip install 'trms-cli[bench]'"
        except Exception as error:
            missing[name] = f"does not run here: {str(error).strip().splitlines()[-1]}"
        else:
            controllers[name] = controller
    entrants = race(chosen, controllers)
    reference = quantiles(entrants[0].counted_times)[0]
    for entrant in entrants:
        median, p99 = quantiles(entrant.counted_times)
        table.add(
            solver=entrant.name,
            median=median / 1e3,
            p99=p99 / 1e3,
            slower=median / reference,
            iterations=entrant.iterations,
            failures=entrant.failures,
            objective=entrant.closed_loop_objective(problem),
        )
    for name, remark in missing.items():
        table.add(solver=name, remark=remark)
    table.notes += [
        "every peer solves each sample to convergence (1e-8), warm-started; one thread each.",
        "“C”: derivatives compiled as those of newton_mpc; “VM”: CasADi's virtual machine.",
    ]
    return [table]


def peers(problem: NewtonMpc) -> Mapping[str, Callable[[], Controller]]:
    """Makers of the peers by name; a maker may raise when its peer is not installed."""
    from benchmarks.peers.nlp import NlpMpc

    def do_mpc() -> Controller:
        import importlib.util

        if importlib.util.find_spec("do_mpc") is None:
            raise ModuleNotFoundError("do_mpc is not installed", name="do-mpc")
        from benchmarks.peers.do_mpc_peer import DoMpc

        return DoMpc(problem=problem)

    return {
        "fatrop, C": lambda: NlpMpc(problem=problem, solver="fatrop"),
        "fatrop, VM": lambda: NlpMpc(problem=problem, solver="fatrop", machine_code=False),
        "IPOPT, C": lambda: NlpMpc(problem=problem, solver="ipopt"),
        "IPOPT, VM": lambda: NlpMpc(problem=problem, solver="ipopt", machine_code=False),
        "do-mpc": do_mpc,
    }
