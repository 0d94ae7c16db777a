"""Prediction and update of the UKF as one compiled function.

Built in stages, so that the generated code stays short: what differs from point to point is one
function mapped over the sigma points, sums over the points are matrix products, and only the
Cholesky factors are written out.
"""

from __future__ import annotations

import casadi as ca

from trms_cli.models.discretisation import DiscreteModel
from trms_cli.observers.sigma_points import SigmaPoints


def filter_step(
    discrete: DiscreteModel, equations: list[int], channels: list[int], points: SigmaPoints
) -> ca.Function:
    """One sample: prediction from the last, update with the measurement.

    The first eight inputs are ``m, P, memory, u, y, mask, advance, known``, the first four outputs
    the next ``m, P, memory`` and a number that is finite exactly if they are.
    """
    model = discrete.model
    n, n_y = points.n, len(channels)
    n_m, n_p = discrete.n_x - _estimated(discrete), len(model.parameters)
    spread = _spread_stage(points)
    advance_one = _dynamics_stage(discrete, equations)
    predict = _prediction_stage(points)
    measure = _measurement_stage(discrete, channels, n)
    update = _update_stage(discrete, equations, points, n_y)

    m, P = ca.MX.sym("m", n), ca.MX.sym("P", n, n)
    memory, u, p = ca.MX.sym("memory", n_m), ca.MX.sym("u", model.n_u), ca.MX.sym("p", n_p)
    y, mask, advance = ca.MX.sym("y", n_y), ca.MX.sym("mask", n_y), ca.MX.sym("advance")
    q, r, floor = ca.MX.sym("q", n), ca.MX.sym("r", n_y), ca.MX.sym("floor", n)
    known = ca.MX.sym("known", model.n_w)

    drawn = spread(m, P)
    count = points.count
    moved = advance_one.map(count)(
        drawn,
        ca.repmat(memory, 1, count),
        ca.repmat(u, 1, count),
        ca.repmat(p, 1, count),
        ca.repmat(known, 1, count),
    )
    m_prior, P_prior = predict(drawn, moved[:n, :], advance, q)
    memory_next = ca.if_else(advance > 0, moved[n:, 0], memory) if n_m else memory
    redrawn = spread(m_prior, P_prior)
    seen = measure.map(count)(redrawn, ca.repmat(u, 1, count), ca.repmat(p, 1, count))
    results = update(m_prior, redrawn, seen, y, mask, r, floor, known)
    m_next, P_next, health, *rest = results
    return ca.Function(
        "ukf_step",
        [m, P, memory, u, y, mask, advance, known, p, q, r, floor],
        [m_next, P_next, memory_next, health, *rest],
        [
            *("m", "P", "memory", "u", "y", "mask", "advance", "known"),
            *("p", "q", "r", "floor"),
        ],
        [
            *("m_next", "P_next", "memory_next", "health", "sd", "d", "d_sd"),
            *("predicted", "innovation", "innovation_sd"),
        ],
    )


def _estimated(discrete: DiscreteModel) -> int:
    """How many entries of the full state are estimated: all but the known past commands."""
    return discrete.model.n_x + discrete.n_sensors


def _spread_stage(points: SigmaPoints) -> ca.Function:
    m, P = ca.SX.sym("m", points.n), ca.SX.sym("P", points.n, points.n)
    return ca.Function("spread", [m, P], [points.around(m, P)])


def _dynamics_stage(discrete: DiscreteModel, equations: list[int]) -> ca.Function:
    """One sigma point (and the memory) over one sample."""
    model = discrete.model
    n_s = _estimated(discrete)
    z = ca.SX.sym("z", n_s + len(equations))
    memory, u = ca.SX.sym("memory", discrete.n_x - n_s), ca.SX.sym("u", model.n_u)
    p = ca.SX.sym("p", len(model.parameters))
    known = ca.SX.sym("known", model.n_w)
    w = ca.SX(known)
    for k, equation in enumerate(equations):
        w[equation] += z[n_s + k]
    after = discrete.step(ca.vertcat(z[:n_s, 0], memory), u, p, w)
    return ca.Function(
        "advance_one",
        [z, memory, u, p, known],
        [ca.densify(ca.vertcat(after[:n_s, 0], z[n_s:, 0], after[n_s:, 0]))],
    )


def _prediction_stage(points: SigmaPoints) -> ca.Function:
    n, count = points.n, points.count
    before, after = ca.MX.sym("before", n, count), ca.MX.sym("after", n, count)
    advance, q = ca.MX.sym("advance"), ca.MX.sym("q", n)
    moved = ca.if_else(advance > 0, after, before)
    m = moved @ ca.DM(points.mean_weights)
    off = moved - ca.repmat(m, 1, count)
    P = _weighted(off, points) @ off.T + _diagonal(advance * q)
    return ca.Function("predict", [before, after, advance, q], [m, P])


def _weighted(off: ca.MX, points: SigmaPoints) -> ca.MX:
    """Deviations times their covariance weights."""
    return off * ca.repmat(ca.DM(points.covariance_weights).T, off.shape[0], 1)


def _diagonal(values: ca.MX) -> ca.MX:
    return ca.densify(ca.diag(values))


def _measurement_stage(discrete: DiscreteModel, channels: list[int], n: int) -> ca.Function:
    model, n_s = discrete.model, _estimated(discrete)
    z, u = ca.SX.sym("z", n), ca.SX.sym("u", model.n_u)
    p = ca.SX.sym("p", len(model.parameters))
    # What is known beside the points, past commands, has no part in a measurement.
    full = ca.vertcat(z[:n_s, 0], ca.SX.zeros(discrete.n_x - n_s))
    y = discrete.measurement(full, u, p)[channels]
    return ca.Function("measure_one", [z, u, p], [ca.densify(y)])


def _update_stage(
    discrete: DiscreteModel, equations: list[int], points: SigmaPoints, n_y: int
) -> ca.Function:
    model, n_s = discrete.model, _estimated(discrete)
    n, count = points.n, points.count
    m, drawn = ca.MX.sym("m", n), ca.MX.sym("drawn", n, count)
    seen = ca.MX.sym("seen", n_y, count)
    y, mask, r = ca.MX.sym("y", n_y), ca.MX.sym("mask", n_y), ca.MX.sym("r", n_y)
    floor, known = ca.MX.sym("floor", n), ca.MX.sym("known", model.n_w)

    predicted = seen @ ca.DM(points.mean_weights)
    off_y = seen - ca.repmat(predicted, 1, count)
    S_all = _weighted(off_y, points) @ off_y.T
    off_y = off_y * ca.repmat(mask, 1, count)
    off_x = drawn - ca.repmat(m, 1, count)
    S = _weighted(off_y, points) @ off_y.T + _diagonal(mask * r + (1 - mask))
    gain = _gain_stage(n, n_y)(_weighted(off_x, points) @ off_y.T, S)
    innovation = mask * (y - predicted)
    m_next = m + gain @ innovation
    left = off_x - gain @ off_y
    P = (
        _weighted(left, points) @ left.T
        + (gain * ca.repmat((mask * r).T, n, 1)) @ gain.T
        + _diagonal(floor)
    )
    P = (P + P.T) / 2
    sd = ca.sqrt(ca.diag(P))
    d, d_sd = ca.MX(known), ca.MX.zeros(model.n_w)
    for k, equation in enumerate(equations):
        d[equation] += m_next[n_s + k]
        d_sd[equation] = sd[n_s + k]
    return ca.Function(
        "update",
        [m, drawn, seen, y, mask, r, floor, known],
        [
            m_next,
            P,
            ca.sum1(m_next) + ca.sum1(sd) + ca.sum1(ca.vec(P)),
            sd,
            d,
            d_sd,
            predicted,
            innovation,
            ca.sqrt(ca.diag(S_all) + r),
        ],
    )


def _gain_stage(n: int, n_y: int) -> ca.Function:
    """``cross S⁻¹`` by Cholesky factors."""
    cross, S = ca.SX.sym("cross", n, n_y), ca.SX.sym("S", n_y, n_y)
    root = ca.chol(S)
    gain = ca.solve(root, ca.solve(root.T, cross.T)).T
    return ca.Function("gain", [cross, S], [ca.densify(gain)])
