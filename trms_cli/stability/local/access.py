"""What inputs can move and sensors can see of a linear model: modes, energies, constant torques.

Sizes make numbers of different units comparable. An angle counts as 0.1 rad and its rate as
0.1 rad/s, an input as its limit. Any other state counts as a tenth of what a full command moves it
by in the end (``−A⁺B u_max``): a rotor's speed, a current.

Gramians over a finite time and for ever, of stable and of unstable systems alike:

    W_c(T) = ∫₀ᵀ e^{At} B Bᵀ e^{Aᵀt} dt        W_o(T) = ∫₀ᵀ e^{Aᵀt} Cᵀ C e^{At} dt

Over a finite time they exist whatever the eigenvalues. They are found by doubling,
``W(2t) = W(t) + Φ(t) W(t) Φ(t)ᵀ``, ``Φ(2t) = Φ(t)²``, from a step so short that Van Loan's block
exponential is exact to rounding (Van Loan 1978, IEEE Trans. Autom. Control 23(3)); the block
exponential of the whole time would overflow with armature currents as states. For ever they solve
the Lyapunov equation of a stable A.

The least energy ``∫ |u|² dt`` that moves ``c x`` by d in the time T from rest is ``d²/(c W_c cᵀ)``
(Kailath, Linear Systems, 1980, sec. 9.2).

The test of Popov, Belevitch and Hautus (PBH): the eigenvalue λ is controllable by B if and only if
``[λI − A, B]`` has full rank; its smallest singular value, in scaled units, is how much of a change
of A and B takes it away (Eising 1984, Syst. Control Lett. 4). What the inputs reach is exactly the
span of the Krylov matrix ``[B, AB, …]``: where a mode is out of reach, its left eigenvector is
orthogonal to B, which is told as zero when it is below what the operating point is exact to.
Sensors are the dual: ``[λI − A; C]`` and the right eigenvector.

A constant torque is a state without a rate beside the others, ``ẋ = A x + e d, ḋ = 0``. What the
sensors see of (A, C) at all is found first: the span of Cᵀ under the resolvent ``(A − μI)⁻ᵀ``,
which has the same invariant subspaces as A and no fast modes that would swamp the slow ones. In
that quotient the torque is observable if and only if ``[A e; C 0]`` has full column rank; several
torques are told at once as far as the rank goes (Davison & Smith 1971, Automatica 7). The error is
that of the best linear estimate from readings with white noise over a time, the initial state known
to ten motions worth speaking of (1 rad, 1 rad/s) and the torque not at all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import scipy.linalg

from trms_cli.core.arrays import ComplexArray, FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.models.model import Model, names
from trms_cli.stability.local.linear import STILL, EigenMode, Matrices, modes_of, parts_of
from trms_cli.stability.local.sweep import EigenvalueSweep, OperatingPath

#: rad, rad/s: a motion of an axis worth speaking of.
MOTION = 0.1
_SHARE = 0.1


@dataclass(frozen=True)
class Scales:
    """Sizes, each in its own unit."""

    x: FloatArray  #: (n_x,) array
    u: FloatArray  #: (n_u,) array; limits
    y: FloatArray  #: (n_y,) array; standard deviation of one reading of each output


def scales_of(model: Model, matrices: Matrices, angle_noise: float, other_noise: float) -> Scales:
    """The usual sizes of a model; noise of an angle's reading (rad), and of any other (rad/s)."""
    limit = np.array([model.input_limits[signal.name] for signal in model.inputs])
    limit = np.where(np.isfinite(limit), limit, 1.0)
    a = matrices.a if matrices.sample_time is None else matrices.a - np.eye(len(matrices.a))
    deflection = np.abs(np.linalg.pinv(a, rcond=1e-9) @ matrices.b) @ limit
    x = np.empty(model.n_x)
    for i, part in enumerate(parts_of(model)):
        motion = part.name in model.axes or model.states[i].unit == "rad"
        x[i] = MOTION if motion else (_SHARE * deflection[i] if deflection[i] > 1e-9 else 1.0)
    y = np.array([angle_noise if s.unit == "rad" else other_noise for s in model.outputs])
    return Scales(x, limit, y)


#: What is reached beside the largest is rounding below this.
_ROUNDING = 1e-18
#: Norm of A times the first step.
_SHORT = 0.5


def controllability_gramian(
    a: FloatArray, b: FloatArray, duration: float, sample_time: float | None = None
) -> FloatArray:
    """W_c(T), (n, n), of ẋ = A x + B u over a duration (s), or of a step.

    That of a step is ``Σ Aᵏ B Bᵀ Aᵏᵀ / T_s``, so that ``d²/W`` is a least ``T_s Σ u²`` and energies
    compare.
    """
    n = len(a)
    if sample_time is not None:
        return _steps(a, b @ b.T / sample_time, max(1, round(duration / sample_time)))
    norm = float(np.abs(a).sum(axis=1).max(initial=0.0))
    doublings = max(0, math.ceil(math.log2(max(norm * duration / _SHORT, 1.0))))
    step = duration / 2**doublings
    block = np.block([[-a, b @ b.T], [np.zeros((n, n)), a.T]]) * step
    exponential = scipy.linalg.expm(block)
    flow = exponential[n:, n:].T
    gramian = _symmetric(flow @ exponential[:n, n:])
    for _ in range(doublings):
        gramian = _symmetric(gramian + flow @ gramian @ flow.T)
        flow = flow @ flow
    return gramian


def observability_gramian(
    a: FloatArray, c: FloatArray, duration: float, sample_time: float | None = None
) -> FloatArray:
    """W_o(T), (n, n): that of controllability of the dual system."""
    return controllability_gramian(a.T, c.T, duration, sample_time)


def stationary_gramian(
    a: FloatArray, b: FloatArray, sample_time: float | None = None
) -> FloatArray | None:
    """W_c(∞) of a stable system; None for any other."""
    values = np.linalg.eigvals(a)
    if sample_time is None:
        if not np.all(values.real < 0):
            return None
        return _symmetric(scipy.linalg.solve_continuous_lyapunov(a, -b @ b.T))
    if not np.all(np.abs(values) < 1):
        return None
    return _symmetric(scipy.linalg.solve_discrete_lyapunov(a, b @ b.T / sample_time))


def hankel_values(controllable: FloatArray, observable: FloatArray) -> FloatArray:
    """Hankel singular values of two Gramians, largest first."""
    values = np.linalg.eigvals(controllable @ observable)
    return np.asarray(np.sort(np.sqrt(np.maximum(values.real, 0.0)))[::-1])


def volts_to_move(
    gramian: FloatArray, direction: FloatArray, distance: float, duration: float
) -> float:
    """Root mean square of the least command that moves ``direction x`` by a distance, in its unit.

    Infinite where it does not move, but for rounding.
    """
    reach = float(direction @ gramian @ direction)
    largest = float(np.abs(gramian).max(initial=0.0)) * float(direction @ direction)
    if reach <= _ROUNDING * largest or reach <= 0.0:
        return math.inf
    return abs(distance) / math.sqrt(reach * duration)


def _steps(flow: FloatArray, first: FloatArray, count: int) -> FloatArray:
    """Σ over ``count`` steps, by doubling."""
    total = np.zeros_like(first)
    gramian, power = first, flow
    transition = np.eye(len(flow))
    while count:
        if count & 1:
            total = total + transition @ gramian @ transition.T
            transition = transition @ power
        gramian = gramian + power @ gramian @ power.T
        power = power @ power
        count >>= 1
    return _symmetric(total)


def _symmetric(matrix: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (matrix + matrix.T))


Grade = Literal["none", "weak", "yes"]

#: Margins below this, relative to the scaled matrices' size, are rounding.
_PBH_ROUNDING = 1e-10
#: Strengths below this are none: an operating point is as exact as that.
_NOTHING = 1e-8
#: A full command that pumps a mode to less than this share of a motion worth speaking of, or a
#: motion that reads as less than this many standard deviations of the noise, is weak.
WEAK_REACH, WEAK_SIGHT = 1.0, 3.0


@dataclass(frozen=True)
class PbhResult:
    """What an input, or a sensor set, has to do with a mode."""

    grade: Grade
    #: Smallest singular value of the scaled PBH matrix, 1/s (1 of a model that steps). Zero: out of
    #: reach.
    margin: float
    #: Of inputs: how far a full command can pump the mode in the time given, relative to a motion
    #: worth speaking of. Of sensors: the reading of such a motion in standard deviations.
    strength: float


def _graded(
    mode: EigenMode, a: FloatArray, b: FloatArray, step: float | None, strength: float, weak: float
) -> PbhResult:
    """By the smallest singular value of [λI − A, B], and by the strength."""
    value = mode.eigenvalue if step is None else complex(np.exp(mode.eigenvalue * step))
    value = value if abs(value.imag) > STILL else complex(value.real)
    sizes = np.linalg.svd(np.hstack([value * np.eye(len(a)) - a, b]), compute_uv=False)
    margin, rounding = float(sizes[-1]), _PBH_ROUNDING * float(max(1.0, sizes[0]))
    # One eigenvector of several says nothing of the others: there the margin decides.
    several = mode.multiplicity > 1
    if strength <= _NOTHING or (several and margin <= rounding):
        return PbhResult("none", 0.0, strength if several else 0.0)
    return PbhResult("weak" if strength < weak else "yes", margin, strength)


@dataclass(frozen=True)
class Gramians:
    """Gramians at a point, states and inputs scaled (a full command is 1, a motion is 1)."""

    controllability: FloatArray  #: (n, n) array; over the finite time
    observability: FloatArray  #: (n, n) array; over the finite time
    controllability_forever: FloatArray | None  #: (n, n) array; of a stable system
    observability_forever: FloatArray | None  #: (n, n) array; of a stable system
    hankel: FloatArray | None  #: (n,) array; Hankel singular values of one, largest first
    #: Largest entry of ``A W + W Aᵀ + B Bᵀ`` relative to that of ``B Bᵀ``
    lyapunov_residual: float | None


@dataclass(frozen=True)
class ModeAccess:
    """What acts on a mode and sees it."""

    mode: EigenMode
    by_input: tuple[PbhResult, ...]  #: Each input alone, then all together
    by_sensors: tuple[PbhResult, ...]  #: Each set


@dataclass(frozen=True)
class Access:
    """What inputs move and sensors see of one linear model, in sizes that make it comparable."""

    model: Model
    matrices: Matrices
    scales: Scales

    @cached_property
    def scaled(self) -> Matrices:
        """The linear model in the sizes; torques stay in their unit."""
        m, x = self.matrices, self.scales.x[:, None]
        b = m.b * self.scales.u[None, :] / x
        c = m.c * self.scales.x[None, :] / self.scales.y[:, None]
        return Matrices(m.a * self.scales.x[None, :] / x, b, m.e / x, c, m.sample_time)

    @cached_property
    def modes(self) -> tuple[EigenMode, ...]:
        """Of the linear model."""
        return modes_of(self.model, self.matrices).modes

    def by_inputs(self, mode: EigenMode, inputs: list[int], duration: float) -> PbhResult:
        """How well some inputs move a mode."""
        b = self.scaled.b[:, inputs]
        # w in scaled states, its own motion of size one.
        left_vector, _ = self._eigenvectors(mode)
        # ∫₀ᵀ e^{Re λ t} dt: what a command in step with the mode adds up to; per sample of a step.
        rate, step = mode.eigenvalue.real, self.matrices.sample_time
        total = duration if abs(rate) * duration < 1e-9 else float(np.expm1(rate * duration) / rate)
        pumped = float(np.abs(left_vector @ b).sum()) * (total if step is None else total / step)
        return _graded(mode, self.scaled.a, b, step, pumped, WEAK_REACH)

    def by_sensors(self, mode: EigenMode, outputs: list[int]) -> PbhResult:
        """How well some sensors see a mode."""
        c = self.scaled.c[outputs]
        _, right = self._eigenvectors(mode)
        reading = float(np.abs(c @ right).max(initial=0.0))
        # Rows of size one: a margin is to tell structure, not the quality of the sensor.
        size = np.abs(c).max(axis=1, keepdims=True, initial=0.0)
        rows = c / np.where(size > 0, size, 1.0)
        return _graded(
            mode, self.scaled.a.T, rows.T, self.matrices.sample_time, reading, WEAK_SIGHT
        )

    def _eigenvectors(self, mode: EigenMode) -> tuple[ComplexArray, ComplexArray]:
        """Left and right in scaled states, the largest entry of the right one of size one."""
        right, left = mode.right / self.scales.x, mode.left * self.scales.x
        size = float(np.abs(right).max())
        return left * size, right / size

    def of_modes(
        self, sets: tuple[tuple[str, ...], ...], duration: float
    ) -> tuple[ModeAccess, ...]:
        """The PBH test of each mode, by each input and each set of sensors."""
        n_u, output_names = self.model.n_u, names(self.model.outputs)
        inputs = [*([j] for j in range(n_u)), *([list(range(n_u))] if n_u > 1 else [])]
        outputs = [[output_names.index(name) for name in one] for one in sets]
        return tuple(
            ModeAccess(
                mode,
                tuple(self.by_inputs(mode, channels, duration) for channels in inputs),
                tuple(self.by_sensors(mode, channels) for channels in outputs),
            )
            for mode in self.modes
        )

    def volts(self, duration: float) -> FloatArray:
        """Least rms command of each input alone that moves each state by its size, (n_x, n_u)."""
        n, step = self.model.n_x, self.matrices.sample_time
        volts = np.empty((n, self.model.n_u))
        for j in range(self.model.n_u):
            b = self.matrices.b[:, [j]] / self.scales.x[:, None]
            gramian = controllability_gramian(self.scaled.a, b, duration, step)
            volts[:, j] = [volts_to_move(gramian, row, 1.0, duration) for row in np.eye(n)]
        return volts

    def gramians(self, duration: float) -> Gramians:
        """The scaled Gramians of all inputs and all sensors."""
        a, b, c, step = self.scaled.a, self.scaled.b, self.scaled.c, self.matrices.sample_time
        forever, observability = stationary_gramian(a, b, step), stationary_gramian(a.T, c.T, step)
        hankel, residual = None, None
        if forever is not None and observability is not None:
            hankel, drive = hankel_values(forever, observability), b @ b.T
            balance = (
                a @ forever + forever @ a.T + drive
                if step is None
                else a @ forever @ a.T - forever + drive / step
            )
            residual = float(np.abs(balance).max() / np.abs(drive).max())
        reach = controllability_gramian(a, b, duration, step)
        sight = observability_gramian(a, c, duration, step)
        return Gramians(reach, sight, forever, observability, hankel, residual)

    def torques(
        self, sensors: Sequence[str], durations: Sequence[float], reading_time: float
    ) -> TorqueEstimates:
        """Which constant torques some sensors tell.

        Errors are after each of the durations (s) of readings ``reading_time`` (s) apart; a model
        that steps is read at each step.
        """
        output_names = names(self.model.outputs)
        a, e, step = self.scaled.a, self.scaled.e, self.matrices.sample_time
        c = self.scaled.c[[output_names.index(name) for name in sensors]]
        steady = a if step is None else a - np.eye(len(a))
        basis = _seen_basis(steady, c)
        own_a, own_c, own_e = basis.T @ steady @ basis, c @ basis, basis.T @ e
        sizes = np.abs(own_e).max(axis=0, initial=0.0)
        acts = sizes > _RANK * np.abs(e).max(axis=0, initial=0.0)
        n = len(a)

        def error_of(column: FloatArray, duration: float) -> float | None:
            """Standard deviation of the torque's estimate."""
            size = float(np.abs(column).max())
            still = np.eye(1) * (0.0 if step is None else 1.0)
            joint = np.block([[a, column / size], [np.zeros((1, n)), still]])
            read = np.hstack([c, np.zeros((len(c), 1))])
            information = observability_gramian(joint, read, duration, step)
            # Readings add up as an integral over the time between two of them; a step is a reading.
            information = information / reading_time if step is None else information * step
            information[np.arange(n), np.arange(n)] += _PRIOR**-2
            # The information that is left of the torque when the state is estimated with it.
            cross = information[:n, n]
            try:
                known = cross @ np.linalg.solve(information[:n, :n], cross)
            except np.linalg.LinAlgError:  # an unstable mode has outgrown all others
                return None
            remaining_information = float(information[n, n] - known)
            if not remaining_information > 1e-12 * information[n, n]:
                return None
            return float(1.0 / (np.sqrt(remaining_information) * size))

        alone = {}
        for j, name in enumerate(names(self.model.disturbances)):
            is_observable = bool(acts[j]) and _rank(own_a, own_e[:, [j]], own_c) == len(own_a) + 1
            error, *others = (
                error_of(e[:, [j]], duration) if is_observable else None for duration in durations
            )
            alone[name] = TorqueEstimate(is_observable, error, tuple(others))
        together = _rank(own_a, own_e[:, acts], own_c) - len(own_a) if acts.any() else 0
        return TorqueEstimates(together, alone)


@dataclass(frozen=True)
class InputGains:
    """What each input alone moves along a line of operating points."""

    #: (n, n_c, n_u) array; how far each controlled state is moved in the time given by one unit
    #: (rms) of each input, at best; 0 where it is not
    per_volt: FloatArray
    #: (n, n_c, n_u) array; PBH margin of the slowest mode of that state's axis by each input, 1/s
    margin: FloatArray


def input_gains(
    path: OperatingPath, sweep: EigenvalueSweep, scales: Scales, duration: float
) -> InputGains:
    """Evaluate a sweep."""
    model = path.model
    rows = [model.state_index(name) for name in model.controlled]
    axis_of = {axis.angle: name for name, axis in model.axes.items()}
    shape = (len(sweep.places), len(rows), model.n_u)
    per_volt, margin = np.zeros(shape), np.full(shape, np.nan)
    for k, place in enumerate(sweep.places):
        matrices = path.linear.matrices(place.point.x, place.point.u, path.side, place.condition.p)
        access = Access(model, matrices, scales)
        for j in range(model.n_u):
            gramian = controllability_gramian(
                matrices.a, matrices.b[:, [j]], duration, matrices.sample_time
            )
            for i, row in enumerate(rows):
                volts = volts_to_move(gramian, np.eye(model.n_x)[row], MOTION, duration)
                per_volt[k, i, j] = MOTION / volts
                axis = axis_of.get(model.controlled[i], "")
                # The mode that the state takes part in most, of its axis's own if there are any.
                own = [mode for mode in access.modes if axis and mode.name.startswith(axis)]
                if access.modes:
                    mode = max(own or access.modes, key=lambda mode: float(mode.participation[row]))
                    margin[k, i, j] = access.by_inputs(mode, [j], duration).margin
    return InputGains(per_volt, margin)


def sensor_sets(
    model: Model, requested_sets: Sequence[Sequence[str]] | None
) -> tuple[tuple[str, ...], ...]:
    """The sets asked for; else all, the angles with each tachometer, the angles, and each alone.

    Raises ConfigurationError for a name that the model does not measure, and for an empty set.
    """
    output_names = names(model.outputs)
    if requested_sets is not None:
        for one in requested_sets:
            for name in one:
                require_known(name, output_names, f"{name!r} is not measured", "study.sensors")
            if not one:
                raise ConfigurationError(
                    "an empty set of sensors given",
                    where="study.sensors",
                    remedy="give names, as 'study.sensors=[[alpha_v,alpha_h],[alpha_v]]'",
                )
        return tuple(tuple(dict.fromkeys(one)) for one in requested_sets)
    angles = tuple(signal.name for signal in model.outputs if signal.unit == "rad")
    others = [name for name in output_names if name not in angles]
    sets = [
        output_names,
        *((*angles, name) for name in others),
        angles,
        *((name,) for name in output_names),
    ]
    return tuple(dict.fromkeys(one for one in sets if one))


def set_words(model: Model, sensors: Sequence[str]) -> str:
    """``all``, ``angles``, ``angles, omega_v``, ``alpha_v``."""
    output_names = names(model.outputs)
    if len(sensors) == len(output_names) and len(output_names) > 1:
        return "all"
    angles = tuple(signal.name for signal in model.outputs if signal.unit == "rad")
    if len(angles) > 1 and set(angles) <= set(sensors):
        return ", ".join(["angles", *(name for name in sensors if name not in angles)])
    return ", ".join(sensors)


#: Directions that are this small beside the others are none.
_RANK = 1e-6
#: 1/s: where the resolvent is taken, beside what a rig's eigenvalues are likely to be.
_SHIFT = 0.7391
#: Standard deviation of the initial state in motions worth speaking of.
_PRIOR = 10.0


@dataclass(frozen=True)
class TorqueEstimate:
    """Whether sensors tell a constant torque, if it is the only one."""

    seen: bool
    #: Standard deviation of its estimate after the first of the times asked for, in its unit; None
    #: where it is not seen
    error: float | None
    errors_over_time: tuple[float | None, ...]  #: The same after each of the others


@dataclass(frozen=True)
class TorqueEstimates:
    """All constant torques by one set of sensors."""

    together: int  #: How many of them can be told at once
    alone: dict[str, TorqueEstimate]  #: By disturbance


def _seen_basis(a: FloatArray, c: FloatArray) -> FloatArray:
    """Orthonormal basis of what C sees of A, (n, k)."""
    n = len(a)
    resolvent = np.linalg.inv(a - _SHIFT * np.eye(n)).T
    basis = np.zeros((n, 0))
    fresh = c.T
    for _ in range(n):
        added = []
        for column in fresh.T:
            size = float(np.linalg.norm(column))
            if size == 0.0:
                continue
            rest = column / size
            for _ in range(2):  # twice is enough: Gram–Schmidt loses digits once
                rest = rest - basis @ (basis.T @ rest)
            residual_norm = float(np.linalg.norm(rest))
            if residual_norm > _RANK:
                added.append(rest / residual_norm)
                basis = np.hstack([basis, (rest / residual_norm)[:, None]])
        if not added:
            break
        fresh = resolvent @ np.array(added).T
    return basis


def _rank(a: FloatArray, e: FloatArray, c: FloatArray) -> int:
    """Rank of [A e; C 0], its rows and columns brought to one size."""
    whole = np.block([[a, e], [c, np.zeros((len(c), e.shape[1]))]])
    for axis in (1, 0, 1, 0):
        size = np.abs(whole).max(axis=axis, keepdims=True)
        whole = whole / np.where(size > 0, size, 1.0)
    return int(np.linalg.matrix_rank(whole, tol=_RANK))
