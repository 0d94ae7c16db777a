"""Unscented Kalman filter with integrating disturbances.

The state of the model is augmented by constant torques on chosen equations
(:mod:`trms_cli.observers.augmentation`). Sigma points are drawn anew between prediction and
update: on a linear model the filter is the Kalman filter.

The covariance is updated in Joseph's form over the sigma points,

    P = Σ_i W_i (x̃_i − K ỹ_i)(x̃_i − K ỹ_i)ᵀ + K R Kᵀ

a sum of squares for non-negative weights (which the defaults have), with a floor far below every
physical scale. A missing channel's row of ỹ is zero: the update conditions exactly on the others.

Sigma points and weights are those of the scaled unscented transform: R. van der Merwe, "Sigma-point
Kalman filters for probabilistic inference in dynamic state-space models", 2004, as in filterpy's
``MerweScaledSigmaPoints`` (importing filterpy takes longer than a whole short run, so the formulas
stand here and a test holds them equal).

Prediction and update are one compiled function. It is built in stages, so that the generated code
stays short: what differs from point to point is one function mapped over the sigma points. Sums
over the points are written out for few states, and matrix products for many.

Nothing is summed that is known already: a torque is the same after a sample, so that its own
covariance stays, and where all channels are linear in z no sigma point is measured, since the sums
over them are H P⁻ Hᵀ and P⁻ Hᵀ to rounding.
"""

from dataclasses import dataclass
from typing import Annotated

import casadi as ca
import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.c_source import share_slow_operations
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.process_cache import call_memoised
from trms_cli.core.ranges import NotNegative
from trms_cli.models.discretisation import DiscreteModel
from trms_cli.observers import kalman_step as kalman
from trms_cli.observers.augmentation import Augmentation, AugmentedModel
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.recursive_filter import INPUTS, OUTPUTS, RecursiveFilter

#: Length of z up to which sums over the points are written out. The code grows with its cube: the
#: compiler takes 3 s for 10, 5 s for 12.
_MOST_WRITTEN_OUT = 12


@dataclass(frozen=True)
class SigmaPoints:
    """Sigma points of an n-vector: the mean and, for each direction, one on either side."""

    n: int
    #: ``alpha``, ``beta``, ``kappa``: Spread, prior knowledge of the distribution (2 for a normal
    #: one), and a second spread: ``λ = α²(n + κ) − n``
    alpha: float
    beta: float
    kappa: float

    def __post_init__(self) -> None:
        if not self.spread > 0:
            raise ConfigurationError(
                f"alpha={self.alpha!r} and kappa={self.kappa!r} spread no sigma points over "
                f"{self.n} states",
                where="observer.kappa",
                remedy=f"kappa is above {-self.n}, alpha above 0",
            )

    @property
    def count(self) -> int:
        return 2 * self.n + 1

    @property
    def spread(self) -> float:
        """``n + λ``: squared distance of the points in standard deviations."""
        return self.alpha**2 * (self.n + self.kappa)

    @property
    def mean_weights(self) -> FloatArray:
        weights = np.full(self.count, 0.5 / self.spread)
        weights[0] = 1.0 - self.n / self.spread
        return weights

    @property
    def covariance_weights(self) -> FloatArray:
        weights = self.mean_weights
        weights[0] += 1.0 - self.alpha**2 + self.beta
        return weights

    def around(self, mean: ca.SX, covariance: ca.SX) -> ca.SX:
        """The points as columns, shape (n, 2n + 1)."""
        root = ca.chol(covariance).T * np.sqrt(self.spread)
        centre = ca.repmat(mean, 1, self.n)
        return ca.horzcat(mean, centre + root, centre - root)


def filter_step(augmented: AugmentedModel, points: SigmaPoints) -> ca.Function:
    """One sample; see :mod:`trms_cli.observers.recursive_filter` for inputs and outputs."""
    n, n_m = points.n, augmented.n_m
    spread = _spread_stage(points)
    predict = _prediction_stage(augmented, points)

    inputs = kalman.step_inputs(augmented, len(augmented.model.parameters))
    m, P, memory, u, y, mask, advance, w_known, p, q, r, floor, gate = inputs
    root, sigma_points = spread(m, P)
    successors = propagated(augmented, points, sigma_points, memory, u, p, w_known)
    q = kalman.added_variances(augmented, q, m, memory, u, p, w_known)
    m_prior, P_prior = predict(m, P, root, successors[: augmented.n_s, :], advance, q)
    memory_next = ca.if_else(advance > 0, successors[n:, 0], memory) if n_m else memory
    sensed = readings(augmented, points, m_prior, P_prior, u, p)
    update = _update_stage(augmented, points, *(value.sparsity() for value in sensed[:2]))
    m_next, P_next, health, sd, d, d_sd, *rest = update(
        m_prior, *sensed, y, mask, r, floor, w_known, gate
    )
    return ca.Function(
        "ukf_step",
        inputs,
        [m_next, P_next, memory_next, health, sd, d, d_sd, sensed[-1], *rest],
        list(INPUTS),
        list(OUTPUTS),
    )


def _written_out(stage: ca.Function, n: int) -> ca.Function:
    """A stage without loops, where it is small: zeros and halves of symmetric products are left
    out of it, and what divides more than once does so once."""
    return share_slow_operations(stage.expand()) if n <= _MOST_WRITTEN_OUT else stage


def _spread_stage(points: SigmaPoints) -> ca.Function:
    """Cholesky factor of the covariance, and the sigma points."""
    m, P = ca.SX.sym("m", points.n), ca.SX.sym("P", points.n, points.n)
    results = ca.cse([ca.chol(P).T, ca.densify(points.around(m, P))])
    return share_slow_operations(ca.Function("spread", [m, P], results))


def propagated(
    augmented: AugmentedModel, points: SigmaPoints, sigma_points: ca.MX, *at: ca.MX
) -> ca.MX:
    """Sigma points (and the memory) after a sample, the first from the mean, (n + n_m, 2n + 1).

    ``at``: memory, u, p and w_known.

    Dry friction is linearised at the mean. The points of an axis that is slow beside the deviation
    of its rate lie on both sides of rest, and friction that opposed each would take out of the mean
    the friction that acts. And of an axis that rests, some points would slip: quantisation noise
    would then count as news of a torque that the friction takes up whatever it is.
    """
    n, count = augmented.n, points.count
    arguments = [ca.repmat(value, 1, count) for value in at]
    gliding = augmented.gliding()
    if gliding is None:
        return dynamics_stage(augmented).map(count)(sigma_points, *arguments)
    successors = step_stage(augmented, gliding.step).map(count)(sigma_points, *arguments)
    mean = sigma_points[:, 0]
    added, slope = friction_stage(augmented, gliding)(mean, *at)
    friction = ca.repmat(added, 1, count) + slope @ (sigma_points - ca.repmat(mean, 1, count))
    return ca.vertcat(successors[:n, :] + friction, successors[n:, :])


def dynamics_stage(augmented: AugmentedModel) -> ca.Function:
    """One sigma point (and the memory) over one sample."""
    return step_stage(augmented, augmented.discrete.step)


def step_stage(augmented: AugmentedModel, step: ca.Function) -> ca.Function:
    """One sigma point (and the memory) over one sample by a step of its model."""
    n_s = augmented.n_s
    z, memory, u, p, w_known = augmented.symbols()
    w = augmented.torques(z, w_known)
    after = step(ca.vertcat(z[:n_s, 0], memory), u, p, w)
    return share_slow_operations(
        ca.Function(
            "advance_one",
            [z, memory, u, p, w_known],
            [ca.densify(ca.vertcat(after[:n_s, 0], z[n_s:, 0], after[n_s:, 0]))],
        )
    )


def friction_stage(augmented: AugmentedModel, gliding: DiscreteModel) -> ca.Function:
    """``(z, memory, u, p, w_known)`` → what dry friction adds to z in a sample, and its slope."""
    at = augmented.symbols()
    ends = [step_stage(augmented, step)(*at) for step in (augmented.discrete.step, gliding.step)]
    added = (ends[0] - ends[1])[: augmented.n, 0]
    results = ca.cse([added, ca.jacobian(added, at[0])])
    return ca.Function("friction", list(at), [ca.densify(result) for result in results])


def _prediction_stage(augmented: AugmentedModel, points: SigmaPoints) -> ca.Function:
    """Mean and covariance after a sample; the torques keep theirs, and are no part of the sums."""
    n, n_s, count = points.n, augmented.n_s, points.count
    m, P = ca.MX.sym("m", n), ca.MX.sym("P", n, n)
    root = ca.MX.sym("root", ca.Sparsity.lower(n))
    after = ca.MX.sym("after", n_s, count)
    advance, q = ca.MX.sym("advance"), ca.MX.sym("q", n)
    mean = after @ ca.DM(points.mean_weights)
    off = after - ca.repmat(mean, 1, count)
    # Σ_i W_i x̃_i d̃_iᵀ: the torques d̃_i of two opposite points are opposite.
    apart = (after[:, 1 : n + 1] - after[:, n + 1 :]) * (0.5 / np.sqrt(points.spread))
    cross = root[n_s:, :] @ apart.T
    lower = ca.vertcat(
        ca.horzcat(_square(off, points.covariance_weights), ca.MX(n_s, n - n_s)),
        ca.horzcat(cross, ca.tril(P[n_s:, n_s:])),
    )
    moved = ca.tril2symm(lower) + ca.diag(q)
    results = [
        ca.if_else(advance > 0, ca.vertcat(mean, m[n_s:]), m),
        ca.if_else(advance > 0, moved, P),
    ]
    return _written_out(ca.Function("predict", [m, P, root, after, advance, q], results), n)


def _square(off: ca.MX, weights: FloatArray) -> ca.MX:
    """Lower half of ``Σ_i W_i off_i off_iᵀ``."""
    weighted = off * _repeated(weights, off)
    return ca.mac(weighted, off.T, ca.MX.zeros(ca.Sparsity.lower(off.shape[0])))


def measurement_stage(augmented: AugmentedModel) -> ca.Function:
    """What is measured of one sigma point."""
    z, _, u, p, _ = augmented.symbols()
    return ca.Function("measure_one", [z, u, p], [ca.densify(augmented.measured(z, u, p))])


def _repeated(weights: FloatArray, off: ca.MX) -> ca.DM:
    """A weight for each column, in all rows."""
    return ca.repmat(ca.DM(weights).T, off.shape[0], 1)


def readings(
    augmented: AugmentedModel, points: SigmaPoints, m: ca.MX, P: ca.MX, u: ca.MX, p: ca.MX
) -> tuple[ca.MX, ...]:
    """Deviations x̃ and ỹ, ``Σ W x̃ ỹᵀ``, ``Σ W ỹ ỹᵀ``, and the mean reading.

    Where all channels are linear in z, the columns of the Cholesky factor stand for the pairs of
    points, each with a weight of one, and the sums follow from the covariance.
    """
    n, count = points.n, points.count
    z, _, *at = augmented.symbols()[:4]
    y = augmented.measured(z, *at)
    slope = ca.jacobian(y, z)
    if not ca.depends_on(slope, z):
        covariance = ca.SX.sym("P", n, n)
        root = ca.chol(covariance).T
        cross = ca.densify(covariance @ slope.T)
        results = [root, slope @ root, cross, ca.densify(slope @ cross), ca.densify(y)]
        linear = ca.Function("readings", [z, covariance, *at], results)
        return share_slow_operations(linear)(m, P, u, p)
    _, drawn = _spread_stage(points)(m, P)
    measure = measurement_stage(augmented).map(count)
    seen = measure(drawn, ca.repmat(u, 1, count), ca.repmat(p, 1, count))
    predicted = seen @ ca.DM(points.mean_weights)
    off_x, off_y = drawn - ca.repmat(m, 1, count), seen - ca.repmat(predicted, 1, count)
    weighted = off_y * _repeated(points.covariance_weights, off_y)
    return off_x, off_y, off_x @ weighted.T, weighted @ off_y.T, predicted


def _update_stage(
    augmented: AugmentedModel, points: SigmaPoints, of_x: ca.Sparsity, of_y: ca.Sparsity
) -> ca.Function:
    """The update by what :func:`readings` gives."""
    n, n_y, count = points.n, len(augmented.channels), of_x.size2()
    m, off_x, all_off_y = ca.MX.sym("m", n), ca.MX.sym("off_x", of_x), ca.MX.sym("off_y", of_y)
    all_cross, spread_y = ca.MX.sym("cross", n, n_y), ca.MX.sym("spread_y", n_y, n_y)
    predicted = ca.MX.sym("predicted", n_y)
    y, mask, r = ca.MX.sym("y", n_y), ca.MX.sym("mask", n_y), ca.MX.sym("r", n_y)
    floor, w_known = ca.MX.sym("floor", n), ca.MX.sym("known", augmented.model.n_w)
    gate = ca.MX.sym("gate", n_y)

    variance = ca.diag(spread_y) + r
    innovation = mask * (y - predicted)
    believed = kalman.gate_channels(mask, innovation, variance, gate)
    # A channel that is not there tells nothing, with a variance of one: it changes nothing.
    off_y = all_off_y * ca.repmat(believed, 1, count)
    cross = all_cross * ca.repmat(believed.T, n, 1)
    S = spread_y * (believed @ believed.T) + kalman.diagonal(believed * r + (1 - believed))
    gain = kalman.gain_stage(n, n_y)(cross, S)
    m_next = m + gain @ innovation
    noise = gain * ca.repmat((believed * r).T, n, 1)
    weights = np.ones(n) if count == n else points.covariance_weights
    lower = ca.mac(noise, gain.T, _square(off_x - gain @ off_y, weights))
    P = ca.tril2symm(lower) + ca.diag(floor)
    sd = ca.sqrt(ca.diag(P))
    stage = ca.Function(
        "update",
        [m, off_x, all_off_y, all_cross, spread_y, predicted, y, mask, r, floor, w_known, gate],
        [
            m_next,
            P,
            ca.sum1(m_next) + ca.sum1(sd) + ca.sum1(ca.vec(P)),
            sd,
            *kalman.disturbances(augmented, m_next, sd, w_known),
            innovation,
            ca.sqrt(variance),
            mask - believed,
        ],
    )
    return _written_out(stage, n)


@dataclass(frozen=True, kw_only=True)
class Ukf(RecursiveFilter):
    """Unscented Kalman filter; the fields that it shares with the others are those of
    :class:`trms_cli.observers.augmentation.FilterOptions`.
    """

    #: ``alpha``, ``beta``, ``kappa``: Spread of the sigma points; see :class:`SigmaPoints`. With α
    #: = 1 and κ = 0 no weight is negative.
    alpha: Annotated[float, Meta(gt=0, le=1)] = 1.0
    beta: NotNegative = 2.0
    kappa: float = 0.0

    def compose(
        self, setup: ObserverSetup, augmented: Augmentation
    ) -> tuple[ca.Function, FloatArray]:
        points = SigmaPoints(augmented.n, self.alpha, self.beta, self.kappa)
        step = call_memoised(filter_step, augmented.alone(), points)
        return step, augmented.model.parameters.values
