"""Gains of a PID law from the linearised model, and how robust they are.

The rig's axes are lightly damped and lag behind a rotor: rules for plants without overshoot
(Ziegler–Nichols, SIMC) do not fit them, and maximising k_i alone leaves them ringing. The rule is
optimal output feedback (Levine & Athans 1970, IEEE TAC 15) under a bound on the sensitivity:
among the gains with

    max_ω |S(e^{jωT})| ≤ M,    S = 1/(1 + G C),    closed loop stable

the ones that, after a step of the load, minimise

    J = Σ_j ∫ (α² + ρ² α̇² + λ² (u − u_∞)²) dt        per unit of the load

over several operating points j, at each of which the bound holds: the rig's gain in pitch grows by
three quarters from −0.3 to 0.3 rad, while its frequency falls. Loads are what is left to these
gains: references are followed by the feed-forward, whose error, a torque that the model missed,
is a load. G is the discretised model between a torque asked for and its angle, with the rotor, the
hold and the sampling in it and the axes before this one held, and C the law exactly as it is
computed, filter and lead included: what is tuned is what runs. M bounds the distance to the
critical point (gain margin above M/(M − 1), phase margin above 2 asin 1/(2M)).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from trms_cli.core.arrays import ComplexArray, FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.process_cache import cached_result

_FREQUENCIES = 110
#: Searched, times the plant's gain: ln(1 + k_p), log₁₀ k_i (per s), log₁₀ k_d (s). A slightly
#: negative k_p is the best for a lightly damped axis: it slows the swing that k_d then damps.
_LOWEST, _HIGHEST = np.array([-1.0, -2.5, -1.5]), np.array([2.6, 1.0, 1.0])
_SLOW, _BAND = 0.05, 0.5  # rad/s
#: Drawn together slowly: the bound makes a narrow ridge of the best, along which the grid walks.
_FIRST_GRID, _GRID, _ROUNDS, _SHRINK = 12, 5, 30, 0.87
#: Squarings of the closed loop's transition: the cost is summed over 2¹³ samples.
_DOUBLINGS = 13
#: Weight of the command, times the plant's gain. It only keeps the cost from being flat in it.
_EFFORT = 0.05


@dataclass(frozen=True)
class Filters:
    """The dynamics of the law besides its integral."""

    derivative: float  #: T_f, time constant of the derivative's filter, s
    #: ``lead``, ``lead_filter``: τ and τ_f of the lead ``(1 + τ s)/(1 + τ_f s)`` behind the three
    #: terms, s. Equal: none.
    lead: float = 1.0
    lead_filter: float = 1.0

    @property
    def ratio(self) -> float:
        """τ/τ_f, what the lead makes of a jump."""
        return self.lead / self.lead_filter


class Gains(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Gains of one axis, by which the law asks for a torque: ``kp e + ki ∫e dt + kd de/dt``."""

    #: ``kp``, ``ki``, ``kd``: N m/rad, N m/(rad s), N m s/rad; before the lead. kd acts on −α
    #: without a reference lag.
    kp: float
    ki: float
    kd: float = 0.0


@dataclass(frozen=True)
class AxisMargins:
    """Robustness of a loop."""

    gain_margin: float  #: Factor by which the loop gain may grow (inf when it never crosses −180°)
    phase_margin: float  #: Phase that may be lost at the crossover, rad
    crossover: float  #: Highest frequency at which the loop gain is 1, rad/s
    peak_sensitivity: float  #: max |S|


@dataclass(frozen=True)
class AxisPlant:
    """One input to one angle, ``x⁺ = A x + b u``, ``y = c x``, every ``step`` s."""

    A: FloatArray
    b: FloatArray
    c: FloatArray
    step: float

    def response(self, z: ComplexArray) -> ComplexArray:
        """``c (z − A)⁻¹ b`` at each z, shape as z."""
        resolvent = z[:, None, None] * np.eye(self.b.size) - self.A
        right = np.broadcast_to(self.b[:, None], (z.size, self.b.size, 1))
        return np.linalg.solve(resolvent, right)[..., 0] @ self.c


def frequencies(step: float, density: int = 1) -> FloatArray:
    """Up to half the sampling rate, rad/s; dense where the rig's modes lie, so that no narrow peak
    of a lightly damped one is missed."""
    fast = math.pi / step
    slow = np.geomspace(0.05, min(10.0, fast), _FREQUENCIES * density, endpoint=False)
    return np.concatenate([slow, np.geomspace(min(10.0, fast), fast, 20 * density)])


def terms(z: ComplexArray, step: float, filters: Filters) -> ComplexArray:
    """Responses of the three terms of the law, lead included, to the measured angle, shape (3, n).

    As in :mod:`trms_cli.controllers.pid`: the integral is advanced after its use, the derivative
    is a backward difference behind a first-order filter.
    """
    keep = filters.derivative / (filters.derivative + step)
    slow = filters.lead_filter / (filters.lead_filter + step)
    lead = filters.ratio + (1 - filters.ratio) * (1 - slow) * z / (z - slow)
    derivative = (1 - keep) / step * (z - 1) / (z - keep)
    return lead * np.stack([np.ones_like(z), step / (z - 1), derivative])


def closed_loop(
    plant: AxisPlant, gains: FloatArray, filters: Filters
) -> tuple[FloatArray, FloatArray]:
    """Transition of [plant state, integral, filtered derivative, last angle, lead's lag], and u.

    ``gains``: (k, 3) array; k_p, k_i, k_d of k candidates. Returns (k, n + 4, n + 4) array, (k, n +
    4) array.
    """
    count, n, T, c = gains.shape[0], plant.b.size, plant.step, plant.c
    keep = filters.derivative / (filters.derivative + T)
    slow = filters.lead_filter / (filters.lead_filter + T)
    share = (1 - keep) / T
    kp, ki, kd = gains[:, :1], gains[:, 1:2], gains[:, 2:]
    # v = −kp y + I + D,  D = keep D₋ − kd share (y − y₋)
    v = np.zeros((count, n + 4))
    v[:, :n] = -(kp + kd * share) * c
    v[:, n], v[:, n + 1], v[:, n + 2] = 1.0, keep, kd[:, 0] * share
    # lagged = slow lagged₋ + (1 − slow) v,  u = ratio v + (1 − ratio) lagged
    lagged = (1 - slow) * v
    lagged[:, n + 3] = slow
    u = filters.ratio * v + (1 - filters.ratio) * lagged
    after = np.zeros((count, n + 4, n + 4))
    after[:, :n, :n] = plant.A
    after[:, :n] += plant.b[:, None] * u[:, None, :]
    after[:, n, :n], after[:, n, n] = -ki * T * c, 1.0
    after[:, n + 1, :n] = -kd * share * c
    after[:, n + 1, n + 1], after[:, n + 1, n + 2] = keep, kd[:, 0] * share
    after[:, n + 2, :n] = c
    after[:, n + 3] = lagged
    return after, u


def with_loop_closed(
    plant: AxisPlant, gains: Gains, filters: Filters, B: FloatArray, C: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The rig with one axis' loop closed, its law's states appended: A, B and C for the others."""
    row = np.array([[gains.kp, gains.ki, gains.kd]])
    A = closed_loop(plant, row, filters)[0][0]
    more = A.shape[0] - B.shape[0]
    return A, np.pad(B, ((0, more), (0, 0))), np.pad(C, ((0, 0), (0, more)))


def load_costs(
    plant: AxisPlant, gains: FloatArray, filters: Filters, smoothness: float, effort: float
) -> FloatArray:
    """J of k candidates, infinite where the loop is not stable, shape (k,)."""
    n, T = plant.b.size, plant.step
    A, u = closed_loop(plant, gains, filters)
    angle, rate = np.zeros(n + 4), np.zeros(n + 4)
    angle[:n] = plant.c
    rate[:n] = plant.c @ (plant.A - np.eye(n)) / T
    X = T * (
        np.outer(angle, angle)
        + smoothness**2 * np.outer(rate, rate)
        + effort**2 * u[:, :, None] * u[:, None, :]
    )
    # In deviations from its end, the run after a step of the load begins with the integral and the
    # lag of the lead off by that step and everything else at its end.
    start = np.zeros(n + 4)
    start[n] = start[n + 3] = 1.0
    with np.errstate(all="ignore"):  # an unstable candidate overflows
        for _ in range(_DOUBLINGS):
            before = _along(X, start)
            X = X + A.transpose(0, 2, 1) @ X @ A
            A = A @ A
        cost = _along(X, start)
        settled = cost - before < 1e-3 * cost
    return np.where(settled, cost, np.inf)


def _along(X: FloatArray, start: FloatArray) -> FloatArray:
    """startᵀ X start of each X, shape (k,)."""
    return np.asarray((X @ start) @ start)


def tune_gains(
    plants: Sequence[AxisPlant], filters: Filters, peak: float, smoothness: float, where: str
) -> Gains:
    """The gains of least cost whose sensitivity stays below a peak.

    A grid that is drawn together around the best: deterministic,
    and done before an optimiser would have been imported.

    ``plants``: the axis at each operating point. ``peak``: M, above 1. ``smoothness``: ρ, s.
    ``where``: configuration key, for messages. Raises ConfigurationError if no gains in the
    searched range meet the bound.
    """
    inputs = [array for plant in plants for array in (plant.A, plant.b, plant.c)]
    return cached_result(
        __file__,
        [*inputs, plants[0].step, filters, peak, smoothness],
        Gains,
        lambda: _searched_for(plants, filters, peak, smoothness, where),
    )


def _strength(plants: Sequence[AxisPlant]) -> float:
    """The largest gain of the axis, by which the search is scaled, rad per unit of its input.

    At rest, or for an axis that nothing pulls back, whose gain there has no bound, in its band.
    """
    both = np.array([_SLOW, _BAND]) * 1j
    return max(float(np.abs(p.response(np.exp(both * p.step))).min()) for p in plants)


def _searched_for(
    plants: Sequence[AxisPlant], filters: Filters, peak: float, smoothness: float, where: str
) -> Gains:
    step = plants[0].step
    z = np.exp(1j * frequencies(step) * step)
    responses = [plant.response(z) for plant in plants]
    loops = [terms(z, step, filters) * response for response in responses]
    scale = 1.0 / max(_strength(plants), 1e-12)
    if plants[0].response(np.exp([complex(_SLOW * step)]))[0].real < 0:
        scale = -scale
    best_cost, best = math.inf, np.zeros(3)
    low, high = _LOWEST, _HIGHEST
    for count in (_FIRST_GRID, *(_GRID,) * _ROUNDS):
        axes = [np.linspace(a, b, count) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        gains = scale * _searched(grid)
        robust = np.flatnonzero(_distance(gains, loops) >= 1 / peak)
        if robust.size:
            costs = np.sum(
                [
                    load_costs(p, gains[robust], filters, smoothness, _EFFORT / abs(scale))
                    for p in plants
                ],
                axis=0,
            )
            least = int(np.argmin(costs))
            if costs[least] < best_cost:
                best_cost, best = float(costs[least]), grid[robust[least]]
        if not math.isfinite(best_cost):
            break
        half = (high - low) * _SHRINK / 2
        low, high = best - half, best + half
    if not math.isfinite(best_cost):
        raise ConfigurationError(
            f"no gains keep the sensitivity of this axis below {peak:g}",
            where=where,
            remedy="raise max_sensitivity, shorten derivative_filter, or give kp, ki and kd",
        )
    kp, ki, kd = (scale * _searched(best)).tolist()
    return Gains(kp, ki, kd)


def _distance(gains: FloatArray, loops: Sequence[ComplexArray]) -> FloatArray:
    """Least distance |1 + GC| to the critical point over all loops, shape (k,).

    Written out term by term: a matrix product of this size wakes all threads of the linear algebra
    library, which takes longer than the product.
    """
    least = np.full(gains.shape[0], np.inf)
    for loop in loops:
        total = 1 + gains[:, :1] * loop[0] + gains[:, 1:2] * loop[1] + gains[:, 2:] * loop[2]
        least = np.minimum(least, np.abs(total).min(axis=1))
    return least


def _searched(grid: FloatArray) -> FloatArray:
    """Gains (times the plant's) at points of the search grid, shape (…, 3)."""
    return np.concatenate([np.expm1(grid[..., :1]), 10.0 ** grid[..., 1:]], axis=-1)


def margins(plant: AxisPlant, gains: Gains, filters: Filters) -> AxisMargins:
    """Margins of the loop broken at the input."""
    omega = frequencies(plant.step, density=8)
    z = np.exp(1j * omega * plant.step)
    weights = np.array([gains.kp, gains.ki, gains.kd])
    L = (weights @ terms(z, plant.step, filters)) * plant.response(z)
    crossings = np.flatnonzero(np.diff(np.sign(np.abs(L) - 1)) != 0)
    turns = np.flatnonzero((np.diff(np.sign(L.imag)) != 0) & (L.real[:-1] < 0))
    above = -1 / L.real[turns]
    above = above[above > 1]
    lag = np.abs(np.angle(-L[crossings]))
    return AxisMargins(
        gain_margin=float(above.min()) if above.size else math.inf,
        phase_margin=float(lag.min()) if lag.size else math.inf,
        crossover=float(omega[crossings[-1]]) if crossings.size else 0.0,
        peak_sensitivity=float((1 / np.abs(1 + L)).max()),
    )


def worst(several: Iterable[AxisMargins]) -> AxisMargins:
    """The least margins, and the largest peak and crossover, of several loops."""
    all_of_them = list(several)
    return AxisMargins(
        gain_margin=min(m.gain_margin for m in all_of_them),
        phase_margin=min(m.phase_margin for m in all_of_them),
        crossover=max(m.crossover for m in all_of_them),
        peak_sensitivity=max(m.peak_sensitivity for m in all_of_them),
    )
