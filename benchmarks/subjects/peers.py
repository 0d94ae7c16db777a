"""``newton_mpc`` beside interior-point methods: the same problem, interleaved by samples.

The peers among our own controllers (``nmpc``) and others are raced on one horizon without blocks.
The default ``newton_mpc`` has a limit besides: it is ahead of the default ``nmpc`` by five times,
at the same cost.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from benchmarks.document import LIMIT, Column, Table
from benchmarks.lockstep import quantiles, race
from benchmarks.options import Options
from benchmarks.setups import CONVERGED, FULL_STATE, experiment, newton_horizon, newton_of
from trms_cli.controllers.controller import Controller
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.controllers.nmpc import Nmpc
from trms_cli.controllers.ocp import Method

TITLE = "newton_mpc and its peers on the same problem"
#: Time of newton_mpc as a share of nmpc's, and how much more the closed loop may cost, %.
LIMIT_SHARE, LIMIT_COST = 1 / 5, 0.5
_AGAINST = ("square", "sine")


def run(options: Options) -> list[Table]:
    """Both races."""
    return [_peers(options), _against_nmpc(options)]


def _against_nmpc(options: Options) -> Table:
    """The default controllers, each with its own configuration file."""
    table = Table(
        "newton_against_nmpc",
        "newton_mpc against nmpc, both by default (full state)",
        [
            Column("ref", "reference"),
            Column("solver", "nmpc by"),
            Column("what", "what"),
            Column("newton", "newton_mpc", "", 4),
            Column("nmpc", "nmpc", "", 4),
            Column("value", "newton_mpc", "of nmpc"),
            *LIMIT,
        ],
    )
    for ref in _AGAINST:
        loop_setup = experiment(
            "controller=newton_mpc",
            f"ref={ref}",
            *FULL_STATE,
            f"sim.duration={options.duration(40.0)}",
        )
        problem = newton_of(loop_setup)
        solvers: tuple[Method, ...] = ("ipopt", "fatrop")
        ours, *others = race(
            loop_setup,
            {"newton_mpc": problem, **{name: Nmpc.of(problem, solver=name) for name in solvers}},
        )
        cost = ours.closed_loop_objective(problem)
        median, _ = quantiles(ours.counted_times)
        for other in others:
            theirs, _ = quantiles(other.counted_times)
            table.add_limited(
                "value",
                median / theirs,
                LIMIT_SHARE,
                ref=ref,
                solver=other.name,
                what="median time, µs",
                newton=median,
                nmpc=theirs,
            )
            their_cost = other.closed_loop_objective(problem)
            table.add_limited(
                "value",
                100.0 * (cost / their_cost - 1.0),
                LIMIT_COST,
                ref=ref,
                solver=other.name,
                what="closed-loop objective, %",
                newton=cost,
                nmpc=their_cost,
            )
    table.notes.append(
        f"limits: at most {LIMIT_SHARE:g} of nmpc's time, at most {LIMIT_COST:g} % more cost; "
        "negative: newton_mpc did better."
    )
    return table


def _peers(options: Options) -> Table:
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
    loop_setup = experiment(
        "controller=newton_mpc",
        "ref=square",
        *FULL_STATE,
        *newton_horizon(20),
        f"sim.duration={options.duration(40.0)}",
    )
    problem = newton_of(loop_setup)
    controllers: dict[str, Controller] = {
        "newton_mpc, converged": replace(problem, **CONVERGED),
        "newton_mpc, one iteration": replace(problem, max_iterations=1),
    }
    missing: dict[str, str] = {}
    for name, make in peers(problem).items():
        try:
            controller = make()
            race(replace(loop_setup, duration=2 * problem.sample_time), {name: controller})
        except ModuleNotFoundError as error:
            missing[name] = f"not installed ({error.name}): pip install 'trms-cli[bench]'"
        except Exception as error:
            missing[name] = f"does not run here: {str(error).strip().splitlines()[-1]}"
        else:
            controllers[name] = controller
    entrants = race(loop_setup, controllers)
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
    return table


def peers(problem: NewtonMpc) -> Mapping[str, Callable[[], Controller]]:
    """Makers of the peers by name; a maker may raise when its peer is not installed."""

    def do_mpc() -> Controller:
        import importlib.util

        if importlib.util.find_spec("do_mpc") is None:
            raise ModuleNotFoundError("do_mpc is not installed", name="do-mpc")
        from benchmarks.peers.do_mpc_peer import DoMpc

        return DoMpc(problem=problem)

    return {
        "fatrop, C": lambda: Nmpc.of(problem, solver="fatrop"),
        "fatrop, VM": lambda: Nmpc.of(problem, solver="fatrop", machine_code=False),
        "IPOPT, C": lambda: Nmpc.of(problem, solver="ipopt"),
        "IPOPT, VM": lambda: Nmpc.of(problem, solver="ipopt", machine_code=False),
        "do-mpc": do_mpc,
    }
