"""The least-squares problem of a moving horizon, solved for one linearisation.

    min  |z_0 − ẑ_0|²_{P⁻¹} + Σ_k |z_{k+1} − F(z_k)|²_{Q⁻¹} + Σ_k |y_k − h(z_k)|²_{R⁻¹}
    s.t. lower ≤ z_k ≤ upper

A Gauss–Newton step without bounds is a Kalman smoother of the model linearised along the last
trajectory (Bell 1994, "The iterated Kalman smoother as a Gauss–Newton method", SIAM J. Optim. 4):
compiled, linear in the length of the window, and never divides by a process noise that may be
zero. Where its result leaves the bounds, the same step is solved as a dense quadratic program in
the normalised noises ξ (z_0 = ẑ_0 + L ξ_0, F's error √q ξ_k), whose Hessian I + JᵀJ no noise level
makes singular.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.qp import Qp
from trms_cli.observers.augmentation import Augmentation
from trms_cli.observers.kalman_step import exact_measurement, exact_transition
from trms_cli.observers.update import diagonal, gain_stage

FloatArray = npt.NDArray[np.float64]

INPUTS = (
    *("trajectory", "arrival", "P", "memory", "u", "known", "y", "believed"),
    *("p", "q", "r", "floor"),
)
OUTPUTS = ("smoothed", "moved", "A", "seen", "H")


def smoothing_step(augmented: Augmentation, length: int) -> ca.Function:
    """One Gauss–Newton step over ``length`` samples, without bounds.

    Inputs: trajectory to linearise along (n, length + 1), mean and covariance at its beginning,
    and for each sample the memory before it, command and known torques during it, measurement and
    mask at its end. Outputs: the smoothed trajectory; for :func:`bounded` F(z_k) (n, length) and
    its slopes side by side (n, n·length), h(z_k) (n_y, length) and its slopes (n_y, n·length).
    """
    model, n, n_y = augmented.model, augmented.n, len(augmented.channels)
    Z, arrival = ca.MX.sym("trajectory", n, length + 1), ca.MX.sym("arrival", n)
    P_0, memory = ca.MX.sym("P", n, n), ca.MX.sym("memory", augmented.n_m, length)
    u, known = ca.MX.sym("u", model.n_u, length), ca.MX.sym("known", model.n_w, length)
    y, believed = ca.MX.sym("y", n_y, length), ca.MX.sym("believed", n_y, length)
    p = ca.MX.sym("p", len(model.parameters))
    q, r, floor = ca.MX.sym("q", n), ca.MX.sym("r", n_y), ca.MX.sym("floor", n)

    repeated = ca.repmat(p, 1, length)
    moved, A, _ = exact_transition(augmented).map(length)(Z[:, :length], memory, u, repeated, known)
    seen, H = exact_measurement(augmented).map(length)(Z[:, 1:], u, repeated)
    forward, backward = _forward(n, n_y), gain_stage(n, n)
    m, P = arrival, P_0
    filtered, predicted = [(m, P)], []
    for k in range(length):
        A_k, H_k = A[:, k * n : (k + 1) * n], H[:, k * n : (k + 1) * n]
        m_prior, P_prior, m, P = forward(
            *(m, P, Z[:, k], moved[:, k], A_k, Z[:, k + 1], seen[:, k], H_k),
            *(y[:, k], believed[:, k], q, r, floor),
        )
        predicted.append((m_prior, P_prior))
        filtered.append((m, P))
    smoothed = [m]
    for k in reversed(range(length)):
        m_k, P_k = filtered[k]
        m_prior, P_prior = predicted[k]
        gain = backward(P_k @ A[:, k * n : (k + 1) * n].T, P_prior)
        smoothed.append(m_k + gain @ (smoothed[-1] - m_prior))
    return ca.Function(
        "mhe_step",
        [Z, arrival, P_0, memory, u, known, y, believed, p, q, r, floor],
        [ca.horzcat(*reversed(smoothed)), moved, A, seen, H],
        list(INPUTS),
        list(OUTPUTS),
    )


def _forward(n: int, n_y: int) -> ca.Function:
    """One sample of the Kalman filter of the model linearised at z and at z⁺."""
    m, P = ca.MX.sym("m", n), ca.MX.sym("P", n, n)
    z, moved, A = ca.MX.sym("z", n), ca.MX.sym("moved", n), ca.MX.sym("A", n, n)
    z_next, seen, H_all = ca.MX.sym("z_next", n), ca.MX.sym("seen", n_y), ca.MX.sym("H", n_y, n)
    y, believed = ca.MX.sym("y", n_y), ca.MX.sym("believed", n_y)
    q, r, floor = ca.MX.sym("q", n), ca.MX.sym("r", n_y), ca.MX.sym("floor", n)
    m_prior = moved + A @ (m - z)
    P_prior = A @ P @ A.T + diagonal(q)
    H = H_all * ca.repmat(believed, 1, n)
    cross = P_prior @ H.T
    gain = gain_stage(n, n_y)(cross, H @ cross + diagonal(believed * r + (1 - believed)))
    m_next = m_prior + gain @ (believed * (y - seen - H_all @ (m_prior - z_next)))
    left = ca.MX.eye(n) - gain @ H
    P_next = (
        left @ P_prior @ left.T
        + (gain * ca.repmat((believed * r).T, n, 1)) @ gain.T
        + diagonal(floor)
    )
    return ca.Function(
        "forward",
        [m, P, z, moved, A, z_next, seen, H_all, y, believed, q, r, floor],
        [m_prior, P_prior, m_next, (P_next + P_next.T) / 2],
    )


def bounded(
    inputs: dict[str, FloatArray],
    outputs: dict[str, FloatArray],
    rows: npt.NDArray[np.intp],
    lower: FloatArray,
    upper: FloatArray,
) -> tuple[Qp, FloatArray, FloatArray]:
    """The same step with bounds, as a quadratic program.

    Parameters
    ----------
    inputs, outputs : dicts
        Of :func:`smoothing_step`, by name.
    rows : (k,) int array
        Entries of z that are bounded.
    lower, upper : (k,) arrays

    Returns
    -------
    qp : Qp
        In ξ, shape (n (length + 1),).
    centre : (n, length + 1) array
    slopes : (length + 1, n, n (length + 1)) array
        The trajectory is ``centre[:, k] + slopes[k] @ ξ``.
    """
    Z, A, H = inputs["trajectory"], outputs["A"], outputs["H"]
    n, count = Z.shape
    root_q, weight = np.sqrt(inputs["q"]), inputs["believed"] / inputs["r"][:, None]
    slopes, centre = np.zeros((count, n, n * count)), np.empty((n, count))
    slopes[0, :, :n] = np.linalg.cholesky(inputs["P"])
    centre[:, 0] = inputs["arrival"]
    for k in range(count - 1):
        A_k = A[:, k * n : (k + 1) * n]
        centre[:, k + 1] = outputs["moved"][:, k] + A_k @ (centre[:, k] - Z[:, k])
        slopes[k + 1] = A_k @ slopes[k]
        own = np.arange(n * (k + 1), n * (k + 2))
        slopes[k + 1, np.arange(n), own] += root_q
    sensed = np.stack([H[:, k * n : (k + 1) * n] @ slopes[k + 1] for k in range(count - 1)])
    offset = np.stack(
        [
            inputs["y"][:, k]
            - outputs["seen"][:, k]
            - H[:, k * n : (k + 1) * n] @ (centre[:, k + 1] - Z[:, k + 1])
            for k in range(count - 1)
        ]
    )
    J = sensed.reshape(-1, n * count)
    w = weight.T.ravel()
    limited = slopes[:, rows].reshape(-1, n * count)
    around = centre[rows].T.ravel()
    free = np.full(n * count, np.inf)
    qp = Qp(
        hessian=np.eye(n * count) + (J.T * w) @ J,
        gradient=-J.T @ (w * offset.ravel()),
        rows=limited,
        lower=np.concatenate([-free, np.tile(lower, count) - around]),
        upper=np.concatenate([free, np.tile(upper, count) - around]),
        linear=np.full(len(limited), np.inf),
        quadratic=np.zeros(len(limited)),
    )
    return qp, centre, slopes
