"""Interior-point methods of CasADi's wheel on an optimal control problem, compiled and cached.

IPOPT: Wächter & Biegler 2006 (Math. Prog. 106). fatrop: Vanroye, Sathya, De Schutter & Decré 2023
(IROS), which takes the problem stage by stage and is linear in their number. Both take exact
second derivatives, as generated C where there is a compiler.
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

from trms_cli.controllers.ocp import Ocp
from trms_cli.core.compilation import COMPILER_FLAGS, cache_folder, compiler
from trms_cli.core.errors import ConfigurationError

FloatArray = npt.NDArray[np.float64]
Method = Literal["fatrop", "ipopt"]

#: A barrier that starts low does not throw the last plan away.
_FIRST_BARRIER = 1e-6
_CLOSE = 1e-8
#: Second derivatives are long: compiling takes a fraction of the time so, and they run as fast.
_FLAGS = ("-O1", *COMPILER_FLAGS[2:])
_IPOPT = {
    "print_level": 0,
    "sb": "yes",
    "mu_init": _FIRST_BARRIER,
    "warm_start_init_point": "yes",
    "warm_start_bound_push": _CLOSE,
    "warm_start_bound_frac": _CLOSE,
    "warm_start_slack_bound_push": _CLOSE,
    "warm_start_slack_bound_frac": _CLOSE,
    "warm_start_mult_bound_push": _CLOSE,
}


@dataclass(frozen=True)
class Solution:
    """How a solve ended."""

    unknowns: FloatArray  #: (n,) array; the last iterate
    objective: float  #: There
    #: ``converged``, ``at_cap``: Whether it is a local minimum, and whether the iterations ran out
    #: before
    converged: bool
    at_cap: bool
    iterations: int
    message: str  #: The solver's word
    multipliers: tuple[FloatArray, FloatArray]  #: Of the bounds and of g, for a next start
    seconds: float  #: Time that it took, s


class InteriorPoint:
    """A method on a problem; keeps nothing between two solves.

    Parameters
    ----------
    ocp : Ocp
    method : {"fatrop", "ipopt"}
    max_iterations : int
    tolerance : float
        Scaled residual of the optimality conditions.
    machine_code : bool
        Whether the derivatives run as compiled C; CasADi's virtual machine takes several times as
        long, and needs no compiler.

    Raises
    ------
    ConfigurationError
        If this CasADi came without the method.
    """

    def __init__(
        self, ocp: Ocp, method: Method, max_iterations: int, tolerance: float, machine_code: bool
    ) -> None:
        if not ca.has_nlpsol(method):
            raise ConfigurationError(
                f"this CasADi ({ca.__version__}) was built without {method}",
                where="controller.solver",
                remedy="install CasADi from its wheel (pip install casadi), or take the other one",
            )
        self.ocp, self._takes_multipliers = ocp, method == "ipopt"
        options = _options(ocp, method, max_iterations, tolerance)
        library = _library(ocp, method) if machine_code else None
        # A name of a library in place of the problem: its functions are loaded from there.
        self._solve = ca.nlpsol("nmpc", method, str(library) if library else ocp.nlp, options)
        self._bounds = {
            "lbx": ocp.lower,
            "ubx": ocp.upper,
            "lbg": ocp.g_lower,
            "ubg": ocp.g_upper,
        }

    def solve(
        self, guess: FloatArray, multipliers: tuple[FloatArray, FloatArray] | None = None
    ) -> Solution:
        """Solve at the horizon's present arguments; an exception of the library is a failure."""
        begin = perf_counter()
        start: dict[str, FloatArray] = {}
        if multipliers is not None and self._takes_multipliers:
            start = {"lam_x0": multipliers[0], "lam_g0": multipliers[1]}
        try:
            result = self._solve(x0=guess, p=self.ocp.parameters(), **self._bounds, **start)
            stats: dict[str, Any] = self._solve.stats()
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[-1]
            return Solution(guess, np.inf, False, False, 0, reason, _none(), perf_counter() - begin)
        unknowns = result["x"].full().ravel()
        objective = float(result["f"])
        finite = bool(np.isfinite(unknowns).all()) and np.isfinite(objective)
        word = str(stats.get("return_status", "not solved"))
        return Solution(
            unknowns,
            objective,
            bool(stats["success"]) and finite,
            "iter" in word.lower() and finite,
            int(stats["iter_count"]),
            word.replace("_", " "),
            (result["lam_x"].full().ravel(), result["lam_g"].full().ravel()),
            perf_counter() - begin,
        )


def _none() -> tuple[FloatArray, FloatArray]:
    return np.zeros(0), np.zeros(0)


def _options(ocp: Ocp, method: Method, max_iterations: int, tolerance: float) -> dict[str, Any]:
    options: dict[str, Any] = {
        "print_time": False,
        "calc_lam_p": False,
        "show_eval_warnings": False,
    }
    if method == "ipopt":
        own = {**_IPOPT, "max_iter": max_iterations, "tol": tolerance}
        return {**options, "ipopt": own}
    own = {"print_level": 0, "mu_init": _FIRST_BARRIER}
    own |= {"max_iter": max_iterations, "tolerance": tolerance}
    stages: dict[str, Any] = {
        "structure_detection": "manual",
        "equality": ocp.equality,
        **ocp.stages,
    }
    stages["N"] = len(ocp.stages["nx"]) - 1
    return {**options, **stages, "fatrop": own}


def _library(ocp: Ocp, method: Method) -> Path | None:
    """The problem's functions as a shared library in the cache; None without a compiler.

    The key is the content of the problem: its structure, not its weights, which are parameters.
    """
    program = compiler()
    if program is None:
        return None
    problem = ca.Function("nlp", [ocp.nlp[k] for k in "xp"], [ocp.nlp[k] for k in "fg"])
    content = [problem.serialize(), method, ca.__version__, program, *_FLAGS]
    key = hashlib.sha256("\n".join(content).encode()).hexdigest()[:32]
    library = cache_folder() / f"nmpc_{key}.so"
    if library.exists():
        return library
    try:
        library.parent.mkdir(parents=True, exist_ok=True)
        _build(ca.nlpsol("nmpc", method, ocp.nlp, _options(ocp, method, 1, 1.0)), program, library)
    except (OSError, subprocess.CalledProcessError):
        # An unwritable cache or a broken compiler costs speed, never the run.
        return None
    return library


def _build(solver: ca.Function, program: str, library: Path) -> None:
    with tempfile.TemporaryDirectory(dir=library.parent) as scratch:
        here = os.getcwd()
        os.chdir(scratch)  # the generator writes beside itself
        try:
            source = Path(scratch) / solver.generate_dependencies("nmpc.c")
        finally:
            os.chdir(here)
        built = Path(scratch) / library.name
        subprocess.run(
            [program, *_FLAGS, "-o", str(built), str(source), "-lm"],
            check=True,
            capture_output=True,
        )
        os.replace(built, library)
