"""Interior-point methods through CasADi's wheel: IPOPT and fatrop on the whole NLP.

IPOPT: Wächter & Biegler 2006 (Math. Prog. 106). fatrop: Vanroye, Sathya, De Schutter & Decré 2023
(IROS), which detects the stages of the problem. Each sample is solved to convergence, started from
the last primal and dual solution shifted in time.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import casadi as ca
import numpy as np
import numpy.typing as npt

from benchmarks.peers.ocp import Ocp, build
from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Status
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.controllers.operating_point import SteadyState
from trms_cli.core.compilation import cache_folder, compiler

FloatArray = npt.NDArray[np.float64]

_IPOPT = {
    "print_level": 0,
    "sb": "yes",
    "max_iter": 200,
    "tol": 1e-8,
    "warm_start_init_point": "yes",
    "warm_start_bound_push": 1e-8,
    "warm_start_bound_frac": 1e-8,
    "warm_start_slack_bound_push": 1e-8,
    "warm_start_slack_bound_frac": 1e-8,
    "warm_start_mult_bound_push": 1e-8,
    "mu_init": 1e-6,
}
_FATROP = {"print_level": 0, "max_iter": 200, "tolerance": 1e-8, "mu_init": 1e-6}


@dataclass(frozen=True, kw_only=True)
class NlpMpc:
    """Nonlinear MPC, each sample solved to convergence.

    Attributes
    ----------
    problem : NewtonMpc
        The configuration whose problem is solved.
    solver : {"ipopt", "fatrop"}
    machine_code : bool
        Whether the derivatives run as compiled C, like those of ``newton_mpc``, or in CasADi's
        virtual machine.
    two_starts : bool
        Whether each sample is also solved from the steady state, and the better of the two local
        minima counts: what an optimum to compare with should be, at twice the time.
    periods_per_solve : int
        Control periods that a plan is followed before the next solve; a change of the reference
        asks for a solve at once.
    """

    problem: NewtonMpc
    solver: Literal["ipopt", "fatrop"] = "ipopt"
    machine_code: bool = True
    two_starts: bool = False
    periods_per_solve: int = 1

    @property
    def sample_time(self) -> float:
        """Control period, s."""
        return self.problem.sample_time

    def preview(self, setup: ControlSetup) -> int:
        """As ``newton_mpc``."""
        return self.problem.preview(setup)

    def init(self, setup: ControlSetup) -> NlpState:
        """The solver and its first guess."""
        return NlpState(self, setup)

    def step(self, state: NlpState, sample: ControlSample, *, want_prediction: bool) -> Command:
        """Solve to convergence."""
        return state.solve(sample)


class NlpState:
    """The solver with its last solution."""

    def __init__(self, config: NlpMpc, setup: ControlSetup) -> None:
        self.model, self.two_starts = setup.model, config.two_starts
        self.periods_per_solve = config.periods_per_solve
        self._plan: list[FloatArray] = []
        self._planned_for: FloatArray | None = None
        self.ocp = build(config.problem, setup.model, setup.sample_time)
        self.solver = _solver(config, self.ocp)
        weights = {name: q for name, q in config.problem.state_weights.items() if q > 0}
        self.steady_state = SteadyState(setup.model, weights)
        self.target: Any = None
        self._full = self.ocp.discrete.initial(setup.model.rest(), setup.first_command)
        self._advance = ca.Function("advance", *_memory_step(self.ocp)) if self._remembers else None
        self._warm: dict[str, FloatArray] | None = None
        self._first = True
        n_u = setup.model.n_u
        self._first_input = slice(self.ocp.n_state, self.ocp.n_state + n_u)

    @property
    def _remembers(self) -> bool:
        return len(self._full) > self.model.n_x

    def solve(self, sample: ControlSample) -> Command:
        """One sample, warm-started."""
        n_x, ocp = self.model.n_x, self.ocp
        if self._advance is not None and not self._first:
            moved = np.asarray(self._advance(self._full, sample.previous_command)).ravel()
            self._full[n_x:] = moved[n_x:]
        self._first = False
        self._full[:n_x] = sample.estimate.x
        w = sample.estimate.disturbance
        future = sample.reference[1:] if len(sample.reference) > 1 else sample.reference
        beyond = np.repeat(sample.reference[-1:], max(0, ocp.periods - len(future)), axis=0)
        r = np.concatenate([future, beyond])[: ocp.periods]
        if self._plan and self._planned_for is not None and np.array_equal(r, self._planned_for):
            return Command(self._plan.pop(0))
        self._planned_for = r
        self.target = self.steady_state.solve(sample.reference[-1], w, self.target)
        p = np.concatenate(
            [
                self._full,
                sample.previous_command,
                r.ravel(),
                self.target.x,
                self.target.u,
                w,
            ]
        )
        starts = [self._warm] if self._warm is not None else []
        if self._warm is None or self.two_starts:
            starts.append({"x0": self._cold()})
        begin = perf_counter()
        answers = [self._from(start, p) for start in starts]
        spent = perf_counter() - begin
        result, stats = min(answers, key=lambda a: (not a[1]["success"], float(a[0]["f"])))
        x = result["x"].full().ravel()
        solved = bool(stats["success"])
        # A bad point is no start: begin afresh from the steady state then.
        self._warm = None
        if solved:
            followed = range(1, self.periods_per_solve)
            size = self.ocp.stage_size or 0
            self._plan = [
                x[self._first_input.start + k * size :][: self.model.n_u] for k in followed
            ]
            self._warm = {
                "x0": self._shifted(x),
                "lam_x0": self._shifted(result["lam_x"].full().ravel()),
                "lam_g0": result["lam_g"].full().ravel(),
            }
        return Command(
            x[self._first_input],
            Status.OK if solved else Status.FAILED,
            sum(int(stats["iter_count"]) for _, stats in answers),
            float(result["f"]),
            qp_time=spent,
            message="" if solved else str(stats.get("return_status", "not solved")),
        )

    def _from(
        self, start: dict[str, FloatArray], p: FloatArray
    ) -> tuple[dict[str, ca.DM], dict[str, Any]]:
        ocp = self.ocp
        result = self.solver(
            p=p, lbx=ocp.lower, ubx=ocp.upper, lbg=ocp.g_lower, ubg=ocp.g_upper, **start
        )
        return result, self.solver.stats()

    def _cold(self) -> FloatArray:
        """Everywhere the steady state of the reference, from the present state on."""
        ocp, target = self.ocp, self.target
        full = ocp.discrete.initial(target.x, target.u)
        parts = {
            "x": np.concatenate([full, target.u])[: ocp.n_state],
            "u": target.u,
            "v": np.zeros(2 * self.model.n_x),
        }
        guess = np.concatenate([parts[kind] for kind, _ in ocp.layout])
        guess[: len(self._full)] = self._full
        return guess

    def _shifted(self, values: FloatArray) -> FloatArray:
        """On in time to the next solve; the end repeats. Blocked inputs stay where they are."""
        size, n = self.ocp.stage_size, self.ocp.periods
        if size is None:
            return values
        by = self.periods_per_solve
        shifted = values.copy()
        shifted[: size * (n - by)] = values[size * by : size * n]
        return shifted


def _memory_step(ocp: Ocp) -> tuple[list[ca.SX], list[ca.SX]]:
    """(full state, command) → full state a period later, for the memory of the input path."""
    x, u, _, _ = ocp.discrete.symbols()
    model = ocp.discrete.model
    return [x, u], [ocp.discrete.step(x, u, model.parameters.values, np.zeros(model.n_w))]


def _solver(config: NlpMpc, ocp: Ocp) -> ca.Function:
    options: dict[str, Any] = {"print_time": False, "calc_lam_p": False}
    if config.solver == "ipopt":
        options["ipopt"] = _IPOPT
    elif ocp.stage_size is None:
        raise NotImplementedError("fatrop's stages do not take blocked inputs")
    else:
        options |= {
            "fatrop": _FATROP,
            "structure_detection": "auto",
            "equality": ocp.equality,
        }
    # One expression graph of scalars: four times as fast as calls of the step's function.
    solver = ca.nlpsol("peer", config.solver, ocp.nlp, {**options, "expand": True})
    program = compiler()
    if not config.machine_code or program is None:
        return solver
    return ca.nlpsol("peer", config.solver, str(_library(solver, program)), options)


def _library(solver: ca.Function, program: str) -> Path:
    """The NLP's functions as a shared library, kept in the program's cache."""
    with tempfile.TemporaryDirectory() as scratch:
        here = os.getcwd()
        os.chdir(scratch)  # the generator writes beside itself
        try:
            source = Path(scratch) / solver.generate_dependencies("peer.c")
        finally:
            os.chdir(here)
        key = hashlib.sha256(source.read_bytes()).hexdigest()[:32]
        library = cache_folder() / f"peer_{key}.so"
        if not library.exists():
            library.parent.mkdir(parents=True, exist_ok=True)
            built = Path(scratch) / "peer.so"
            subprocess.run(
                [program, "-O1", "-fPIC", "-shared", "-o", str(built), str(source), "-lm"],
                check=True,
                capture_output=True,
            )
            temporary = library.with_suffix(f".{os.getpid()}")
            temporary.write_bytes(built.read_bytes())
            os.replace(temporary, library)
    return library
