"""One Newton iteration on the optimality conditions of a steady state, as a compiled function.

See :mod:`trms_cli.controllers.operating_point` for what it is about and how it is used.
"""

from __future__ import annotations

import casadi as ca

from trms_cli.core.errors import ModelError
from trms_cli.models.model import Model
from trms_cli.models.rest import RestEquations, arriving

_PROXIMAL = 1e-12


def controlled_rows(model: Model, equations: RestEquations) -> list[int]:
    """Positions of the controlled angles among the unknowns."""
    rows = [model.state_index(name) for name in model.controlled]
    for name, row in zip(model.controlled, rows, strict=True):
        if row not in equations.unknowns:
            raise ModelError(
                f"{name!r} is controlled, and model {model.name!r} only copies it from another "
                "state or an input",
                where="model",
                remedy="control a state that the model computes",
            )
    return [equations.unknowns.index(row) for row in rows]


def newton_step(model: Model, equations: RestEquations) -> ca.Function:
    """One step on the optimality conditions from (s, u); s is x where x has a derivative.

    Active inputs go to their bound; the others are stationary. Returns the next s and u, a report
    (the largest rate |f|, the largest move of a controlled angle, and the slope of the cost in
    each input), and the whole state x of the s and u given.
    """
    n_s, n_u = len(equations.unknowns), model.n_u
    _, _, p, w = model.symbols()
    n = n_s + n_u
    z = ca.SX.sym("z", n + n_s)
    s, u, multiplier, curved = z[:n_s], z[n_s:n], z[n:], ca.SX.sym("curved")
    rows = controlled_rows(model, equations)
    n_r = len(rows)
    r, q = ca.SX.sym("r", n_r), ca.SX.sym("q", n_r)
    active, bound = ca.SX.sym("active", n_u), ca.SX.sym("bound", n_u)
    reach = ca.SX.sym("reach", n_u)

    reached = arriving(model, u, p)
    f = equations.residual(s, reached, p, w)
    slopes = ca.jacobian(f, z[:n])
    f_s, f_u = slopes[:, :n_s], slopes[:, n_s:]
    curvature = curved * ca.jacobian(slopes.T @ multiplier, z[:n])
    select = ca.SX(ca.DM.eye(n_s)[rows, :])
    weigh = select.T @ ca.diag(q)

    free = ca.diag(1 - active)
    # Rows: stationarity in s, stationarity (or the bound) in u, the dynamics.
    in_s = weigh @ select + _PROXIMAL * ca.SX.eye(n_s) + curvature[:n_s, :n_s]
    in_u = _PROXIMAL * free + ca.diag(active) + free @ curvature[n_s:, n_s:]
    system = ca.blockcat(
        [
            [in_s, curvature[:n_s, n_s:], f_s.T],
            [free @ curvature[n_s:, :n_s], in_u, free @ f_u.T],
            [f_s, f_u, -_PROXIMAL * ca.SX.eye(n_s)],
        ]
    )
    right = ca.vertcat(-weigh @ (s[rows] - r), active * (bound - u), -f)
    solution = _solved(system, right)
    ds, du, following = solution[:n_s], solution[n_s:n], solution[n:]
    # Near the double root the slope is tiny and the step huge: no input moves by more than a
    # quarter of its range at once.
    largest = ca.mmax(ca.fabs(du) / reach)
    shorten = ca.if_else(largest > 0.5, 0.5 / largest, 1.0)
    report = ca.vertcat(ca.mmax(ca.fabs(f)), ca.mmax(ca.fabs(ds[rows])), f_u.T @ following)
    return ca.Function(
        "steady_state_step",
        [z, r, w, p, q, active, bound, reach, curved],
        [
            ca.vertcat(z[:n] + shorten * ca.vertcat(ds, du), following),
            report,
            equations.state(s, reached),
        ],
        ["z", "r", "w", "p", "q", "active", "bound", "reach", "curved"],
        ["z_next", "report", "x"],
    )


def _solved(matrix: ca.SX, right: ca.SX) -> ca.SX:
    """Solution of a square system whose conditioning is poor by nature.

    CasADi's QR is a modified Gram–Schmidt, accurate to the condition number squared; one step of
    iterative refinement brings that back to the condition number.
    """
    q, r = ca.qr(matrix)

    def solve(b: ca.SX) -> ca.SX:
        return ca.solve(r, q.T @ b)

    first = solve(right)
    return first + solve(right - matrix @ first)
