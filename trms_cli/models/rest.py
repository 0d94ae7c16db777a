"""Where a model rests: the equations of a steady state, and the unknowns that are left in them.

For a model with a derivative they are ``f(x, u, p, w) = 0`` in all states. A model that steps
rests where a step changes nothing; the states that only remember equal what they remember,

    x = state(s, u)      residual(s, u) = (transition(x, u) − x) / T  in the rows of s

so that a network with many delays has no more unknowns than it has outputs. The residual has the
unit of a rate in both cases.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from trms_cli.core.process_cache import kept
from trms_cli.models.discrete import copied_states, root_of
from trms_cli.models.model import Model

#: s; the fixed point of the input path's memory is that of any step.
_STEP = 0.02


@dataclass(frozen=True)
class RestEquations:
    """Equations of the steady states of one model."""

    unknowns: tuple[int, ...]  #: Positions in x of the states s that the others follow from
    state: ca.Function  #: ``(s, u) → x``, inlined where it is called
    #: ``(s, u, p, w)`` → what is zero at rest, in the unit of s per second, shape (n_s, 1)
    residual: ca.Function


def rest_equations(model: Model) -> RestEquations:
    """The equations for the states of a model at rest, without the memory of its input path."""
    return kept(_rest_equations, model)


def _rest_equations(model: Model) -> RestEquations:
    """See :func:`rest_equations`."""
    x, u, p, w = model.symbols()
    if model.sample_time is None:
        f = model.dynamics(x, u, p, w)
        return RestEquations(
            tuple(range(model.n_x)),
            ca.Function("state", [x, u], [x]),
            ca.Function("residual", [x, u, p, w], [f]),
        )
    copies = copied_states(model)
    roots = [root_of(copies, i) for i in range(model.n_x)]
    unknowns = [i for i, root in enumerate(roots) if root == ("x", i)]
    s = ca.SX.sym("s", len(unknowns))
    lifted = ca.vertcat(*(s[unknowns.index(at)] if kind == "x" else u[at] for kind, at in roots))
    change = model.transition(lifted, u, p, w)[unknowns] - s
    return RestEquations(
        tuple(unknowns),
        ca.Function("state", [s, u], [lifted]),
        ca.Function("residual", [s, u, p, w], [change / model.sample_time]),
    )


def arriving(model: Model, u: ca.SX, p: ca.SX) -> ca.SX:
    """What reaches the motors when ``u`` has been held for long, (n_u, 1): dead zones and limits.

    The memory of the input path is at the fixed point of its update; one Newton step from zero
    finds it for every path that is linear in its memory (delays, lags).
    """
    n_m = len(model.memory(_STEP))
    memory = ca.SX.sym("memory", n_m)
    reached, after = model.input_path(memory, u, p, (0.0, 1.0), _STEP)
    if n_m == 0:
        return reached
    change = after - memory
    fixed = -ca.solve(ca.densify(ca.jacobian(change, memory)), change)
    fixed = ca.substitute(fixed, memory, ca.SX.zeros(n_m))
    return ca.substitute(reached, memory, fixed)
