"""The frequency response of a closed loop, measured as on the bench, and the margins read off it.

A frequency response analyser between controller and rig adds a small periodic signal d to one
command at a time, and reads what the controller asks for, u_c, and what reaches the motors,
u = u_c + d. When the loop has settled, at each line of the signal

    S = U D⁻¹ = (I + L)⁻¹     T = −U_c D⁻¹ = L (I + L)⁻¹     L = −U_c U⁻¹ = T S⁻¹

(n_u, n_u) matrices, column j from the experiment on input j: sensitivity, complementary
sensitivity and loop transfer at the rig's input. Nothing is asked of the controller but to run.
The signal changes only where the command does, so that the loop, sampled at the controller's
rate, sees a sampled signal: the response is that of the sampled loop, hold and delays in it,
exactly, up to half that rate. Whether it is that of a linear loop is tested: the answer to another
signal, half as strong and on all inputs at once, has to be the one that T predicts.

The test signal is a multisine of few lines, held over control periods: all harmonics of the lowest
line at first, then lines a constant factor apart, up to half the controller's rate. What lies
between the lines is left empty on purpose: power found there is not the answer of a linear loop.
Phases after M. R. Schroeder, "Synthesis of low-peak-factor signals and binary sequences with low
autocorrelation", IEEE Trans. Information Theory 16(1), 1970.

Set-valued friction at rest takes up any torque below its own: a test signal of a few millivolts
then does not turn the axis, and what is read of its loop is no response, but zero. The linear loop
that margins are about is that of the rig as it glides.

Sources: Ljung, "System Identification", 2nd ed. 1999, sec. 6.2 and 13.5 (closed loops, the joint
input-output approach); Pintelon & Schoukens, "System Identification: A Frequency Domain Approach",
2nd ed. 2012, ch. 2–4 (periodic signals, lines left empty to detect distortion).

The loop is known to be stable: it was measured closed. Along a change of the loop that grows from
nothing, it stays so until the changed Nyquist curve first runs through −1. For a factor g that is a
crossing of the negative real axis at −1/g; for a phase or a delay, a crossing of the unit circle.

Disk margins tell how much gain and phase may change at once. A loop's actuator is changed by a
factor f from the disk

    D(α) = { (1 + δ/2) / (1 − δ/2) : |δ| < α }

which holds all gains in ((2 − α)/(2 + α), (2 + α)/(2 − α)), all phases within ±2 arctan(α/2), and
their combinations. With S the sensitivity and T = I − S, the loop stands all such factors, also
if they vary with frequency, up to

    α = min_ω 2/|S − T|                of one loop, the others closed
    α = min_ω 2/μ_Δ(S − T)             of all loops at once, each with a factor of its own
    α = min_ω 2/σ̄(S − T)               of any linear change of all commands, coupling included

μ is the structured singular value for diagonal complex Δ. For two loops it is exact here: the
upper bound ``min_D σ̄(D M D⁻¹)`` equals μ up to three blocks, and the best scaling of a 2 × 2
matrix is the one that makes its off-diagonal entries equal. Beyond two loops the norm σ̄, a bound
on the safe side, is used (Seiler, Packard & Gahinet, "An introduction to disk margins", IEEE
Control Systems Magazine 40(5), 2020, the balanced case, skew 0).

Between the lines the sensitivity S is interpolated, not L: the closed loop has no sharp peaks
where the rig's lightly damped modes and the controller's integrators have theirs. How far that
carries is judged by leaving out every other line.
"""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter

import numpy as np

from trms_cli.core.arrays import ComplexArray, FloatArray, IntArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.models.model import Model, names
from trms_cli.models.operating_point import OperatingPoint, operating_point
from trms_cli.models.steady_state import SteadyState
from trms_cli.models.vector_field import VectorField, without_impulses
from trms_cli.stability.closed_loop import Enough, LoopRun, run_loop
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts, Subject, level_of


@dataclass(frozen=True)
class ExcitationPeriod:
    """One period of a multisine of rms 1."""

    step: float  #: Control period over which each value is held, s
    #: (n,) array of int; harmonics of the period that are in it, the lowest first
    lines: IntArray
    values: FloatArray  #: (N,) array; one period

    @property
    def length(self) -> int:
        """Control periods after which it repeats."""
        return self.values.size

    @property
    def period(self) -> float:
        """Time after which it repeats, s."""
        return self.length * self.step

    @property
    def omega(self) -> FloatArray:
        """Frequencies of the lines, rad/s, (n,)."""
        return np.asarray(2 * math.pi * self.lines / self.period, dtype=np.float64)

    def spectrum(self, samples: FloatArray) -> ComplexArray:
        """Of one period (N, m), at the lines, (n, m)."""
        return np.asarray(np.fft.rfft(samples, axis=0)[self.lines])

    def beside(self, samples: FloatArray) -> float:
        """Power of a period (N, m) off the lines, as a share of that on them."""
        power = (np.abs(np.fft.rfft(samples, axis=0)) ** 2).sum(axis=1)
        on = float(power[self.lines].sum())
        power[0] = 0.0
        return (float(power.sum()) - on) / on if on > 0 else 0.0


def harmonics_of(step: float, lowest: float) -> int:
    """Harmonics of the lowest line (rad/s) up to half the rate of a control period (s)."""
    return round(math.pi / (lowest * step))


def multisine(step: float, lowest: float, ratio: float, seed: int = 0) -> ExcitationPeriod:
    """A multisine of a controller's band: a control period (s), the lowest line (rad/s).

    It repeats after the whole even number of control periods closest to that of the lowest line;
    ``ratio`` is that of a line to the one below it, where the harmonics are denser than that. Seed
    0 has Schroeder's phases, another random ones: another signal of the same spectrum.
    """
    half = max(2, harmonics_of(step, lowest))
    lines = [1]
    while lines[-1] < half:
        lines.append(max(lines[-1] + 1, round(lines[-1] * ratio)))
    # half the rate is a line too: the loop is real there, and may cross −1
    harmonics = np.unique(np.minimum(lines, half))
    n = harmonics.size
    if seed:
        phases = np.random.default_rng(seed).uniform(0, 2 * math.pi, n)
    else:
        order = np.arange(n)
        phases = -math.pi * order * (order + 1) / n
    spectrum = np.zeros(half + 1, dtype=complex)
    spectrum[harmonics] = np.exp(1j * phases)
    spectrum[half] = 1.0
    values = np.fft.irfft(spectrum, 2 * half)
    return ExcitationPeriod(step, harmonics, values / np.sqrt(np.mean(values**2)))


#: Part of the response by which it may still differ from one period to the next: settled.
SETTLED = 1e-4
#: Beyond this part the answer is not periodic, and there is no response.
NOT_PERIODIC = 0.05
#: Growth of the angles' excursions from the second period to the last, and rad from the point,
#: with which a loop leaves it: no test signal of the size meant here pushes it so far.
_GROWS, _FAR = 1.5, 0.05
#: Control periods within which a controller that closes a loop answers to a step.
_SOON = 50


@dataclass(frozen=True)
class FrequencyResponse:
    """What was measured."""

    omega: FloatArray  #: (n,) array; rad/s
    #: ``S``, ``T``: (n, n_u, n_u) arrays; sensitivity and complementary sensitivity at the rig's
    #: input
    S: ComplexArray
    T: ComplexArray
    inputs: tuple[str, ...]
    step: float  #: Control period, s
    #: Part of the response that still changed from the last period but one to the last
    drift: float
    beside: float  #: Power of the commands off the lines, as a share of that on them
    #: Part of the answer to the signal at half the amplitude on all inputs that T does not predict
    nonlinearity: float
    #: (n_r,) array; mean of the controlled angles in the last period, less the operating point's,
    #: rad
    rest: FloatArray
    statuses: Mapping[str, int]  #: Control samples by how their computation ended
    limited: int  #: Control samples at a limit of the command
    #: Rotors' speeds that were zero or changed their sign: their thrust has no slope there
    reversed: tuple[str, ...]
    duration: float  #: s simulated
    #: Angles and rotor speeds that dry friction holds at the point: the response is that of the rig
    #: without it
    held_states: tuple[str, ...] = ()

    @property
    def L(self) -> ComplexArray:
        """Loop transfer at the rig's input, (n, n_u, n_u)."""
        return np.asarray(self.T @ np.linalg.inv(self.S))


@dataclass(frozen=True)
class NoResponse:
    """A loop that has no response: it leaves the point, or swings by itself."""

    run: LoopRun  #: Of the experiment that showed it
    words: str  #: What it did: ``alpha_v is 0.31 rad away after 100 s, further and further``
    #: Whether it leaves the point; else it stays near, but does not answer periodically
    leaves: bool
    reversed: tuple[str, ...]  #: As of :class:`FrequencyResponse`
    held_states: tuple[str, ...] = ()  #: As of :class:`FrequencyResponse`


@dataclass(frozen=True)
class Analyser:
    """How a response is measured."""

    lowest: float = 0.1  #: Lowest line, rad/s
    #: Of a line to the one below it, where the harmonics of the lowest are denser
    ratio: float = 1.06
    amplitude: float = 0.001  #: rms of the signal, as a share of half the range of each input
    periods: int = 6  #: Periods after which the loop has to have settled; two at the least

    def measure(
        self, model: Model, loop: LoopParts, point: OperatingPoint, tell: Tell
    ) -> FrequencyResponse | NoResponse:
        """The response around an operating point.

        Raises ConfigurationError if the controller does not answer.
        """
        step = loop.control_period
        probe = multisine(step, self.lowest, self.ratio)
        other = multisine(step, self.lowest, self.ratio, seed=1)
        lower, upper = model.input_bounds()
        size = self.amplitude * (upper - lower) / 2
        one_by_one = [np.outer(probe.values, row) for row in np.diag(size)]
        shifts = [round(i * other.length / model.n_u) for i in range(model.n_u)]
        together = np.column_stack(
            [half * np.roll(other.values, s) for half, s in zip(size / 2, shifts, strict=True)]
        )
        inputs = names(model.inputs)
        words = [*(f"response to {name}" for name in inputs), "half the amplitude, all inputs"]
        # A controller whose commands are the same with and without a step added closes no loop.
        brief = _SOON * step
        plain = run_loop(model, loop, point, brief)
        pushed = run_loop(model, loop, point, brief, path=lambda k, u: u + size)
        if np.array_equal(plain.u, pushed.u):
            raise ConfigurationError(
                f"the commands of controller={loop.names['controller']} do not depend on what it "
                "sees: there is no loop",
                where="controller",
                remedy="choose one that feeds back, as controller=lqr; without a controller, "
                "study=local tells the rig's own modes",
            )
        answers: list[_Answer] = []
        for doing, added in zip(words, [*one_by_one, together], strict=True):
            tell(doing)
            last = _experiment(model, loop, point, added, self.periods * probe.length * step)
            if last.departure:
                return NoResponse(last.run, last.departure, last.leaves, last.reversed)
            answers.append(last)
        each, check = answers[:-1], answers[-1]
        T = np.stack(
            [
                -probe.spectrum(a.commands) / probe.spectrum(d[:, [j]])
                for j, (a, d) in enumerate(zip(each, one_by_one, strict=True))
            ],
            axis=2,
        )
        predicted = -np.einsum("kij,kj->ki", T, other.spectrum(together))
        answer = other.spectrum(check.commands)
        return FrequencyResponse(
            omega=probe.omega,
            S=np.eye(model.n_u) - T,
            T=T,
            inputs=inputs,
            step=step,
            drift=max(a.drift for a in answers),
            beside=max(probe.beside(a.commands) for a in answers),
            nonlinearity=float(np.linalg.norm(answer - predicted) / np.linalg.norm(answer)),
            rest=check.rest,
            statuses=dict(sum((Counter(a.run.statuses) for a in answers), Counter())),
            limited=sum(a.limited for a in answers),
            reversed=tuple(sorted({name for a in answers for name in a.reversed})),
            duration=sum(a.run.time.size for a in answers) * loop.sample_time,
        )


class _Adder:
    """Adds a periodic signal to the commands, and ends the run when the answer repeats."""

    def __init__(self, signal: FloatArray, ratio: int) -> None:
        self.ratio, self._signal = ratio, signal
        self.commands: list[FloatArray] = []

    def __call__(self, k: int, u: FloatArray) -> FloatArray:
        length = len(self._signal)
        if k % self.ratio == 0:
            count = len(self.commands)
            if count % length == 0 and count >= 2 * length and self.drift < SETTLED:
                raise Enough
            self.commands.append(u.copy())
        return np.asarray(u + self._signal[(k // self.ratio) % length])

    def period(self, back: int = 0) -> FloatArray:
        """The last whole period of the commands, or one before, (N, n_u); empty where none is."""
        length = len(self._signal)
        end = (len(self.commands) // length - back) * length
        return np.array(self.commands[max(end - length, 0) : max(end, 0)])

    @property
    def drift(self) -> float:
        """Change of the answer from the last period but one to the last."""
        last, before = self.period(), self.period(1)
        if not len(before):
            return np.inf
        amplitude = float(np.linalg.norm(last - last.mean(axis=0)))
        return float(np.linalg.norm(last - before)) / amplitude if amplitude > 0 else 0.0


@dataclass(frozen=True)
class _Answer:
    """The last period of an experiment."""

    run: LoopRun
    commands: FloatArray
    drift: float
    rest: FloatArray
    limited: int
    reversed: tuple[str, ...]
    departure: str
    leaves: bool


def _experiment(
    model: Model, loop: LoopParts, point: OperatingPoint, added: FloatArray, duration: float
) -> _Answer:
    """A period (N, n_u) is added to the commands until they repeat, for a duration (s) at most."""
    adder = _Adder(added, round(loop.control_period / loop.sample_time))
    run = run_loop(model, loop, point, duration, path=adder)
    commands = adder.period()
    rows = [model.state_index(name) for name in model.controlled]
    angles = run.x[:, rows] - point.x[rows]
    samples = min(len(angles), len(commands) * adder.ratio or len(angles))
    last = angles[-samples:]
    rest = last.mean(axis=0)
    lower, upper = model.input_bounds()
    limited = int(np.any((run.u <= lower) | (run.u >= upper), axis=1)[:: adder.ratio].sum())
    first = angles[samples : 2 * samples]
    away = float(np.abs(last).max()) if last.size else 0.0
    grows = bool(np.linalg.norm(last) > _GROWS * np.linalg.norm(first))
    leaves = bool(run.stop_reason) or grows or away > _FAR
    departure = ""
    if run.stop_reason or adder.drift > NOT_PERIODIC:
        name = model.controlled[int(np.argmax(np.abs(last).max(axis=0)))]
        after = f"after {run.time[-1] if run.time.size else 0.0:.0f} s"
        departure = f"{name} is up to {away:.2g} rad away {after}"
        if run.stop_reason:
            departure += f", where the run ends: {run.stop_reason}"
        elif not leaves:
            departure = (
                f"{name} stays within {away:.2g} rad, but {after} the answer to the test signal "
                f"still changes by {100 * adder.drift:.0f} % from period to period"
            )
    turned = tuple(
        name
        for name in model.rotor_speeds.values()
        if np.ptp(np.sign(run.x[:, model.state_index(name)])) > 0
    )
    return _Answer(run, commands, adder.drift, rest, limited, turned, departure, leaves)


#: Step of the commands, as a share of half their range: any dry friction takes up so little.
_STEP = 1e-6
#: s that the rig has to answer, and part of the free motion below which it has not.
_WAIT, _HELD = 0.5, 0.01


def held_by_friction(model: Model, point: OperatingPoint) -> tuple[str, ...]:
    """Angles and rotor speeds that a small step of the commands moves without dry friction alone.

    A model that only steps from sample to sample has no friction of this kind.
    """
    if model.sample_time is not None:
        return ()
    lower, upper = model.input_bounds()
    commands = np.vstack([point.u, point.u + _STEP * (upper - lower) / 2])
    starts = np.vstack([point.x, point.x])
    field = VectorField(model)
    displacements = []
    for impulses in (True, False):
        ends = field.motions(starts, commands, _WAIT, _WAIT / 10, impulses=impulses)
        displacements.append(np.abs(ends[:, 1] - ends[:, 0]).max(axis=0))
    with_friction, free = displacements
    rows = {
        name: model.state_index(name) for name in (*model.controlled, *model.rotor_speeds.values())
    }
    return tuple(name for name, i in rows.items() if with_friction[i] < _HELD * free[i])


#: Harmonics of the lowest line up to half the controller's rate: fewer are no curve.
_FEWEST = 10
#: Samples per swing of the rig: of its clock, over which it is integrated in one go, and of the
#: controller, whose loop ends at half its rate.
_OF_THE_RIG, _OF_THE_CONTROLLER = 10, 2


def point_of(subject: Subject, at: Mapping[str, float]) -> OperatingPoint:
    """The operating point asked for; the level one where nothing is. Raises TrmsError."""
    model = subject.model
    at = at or level_of(model)
    if model.sample_time is None:
        return operating_point(model, at)
    for name in at:
        unknown = (
            f"model {subject.name!r} only steps from sample to sample, and where it rests is found "
            f"by its angles, not by {name!r}"
        )
        require_known(name, model.controlled, unknown, f"at.{name}")
    angles = np.array([at.get(name, 0.0) for name in model.controlled])
    target = SteadyState(model).solve(angles)
    if not target.exact:
        reached = ", ".join(
            f"{name}={value:.4g}"
            for name, value in zip(model.controlled, target.reference_reached, strict=True)
        )
        raise ConfigurationError(
            f"model {subject.name!r} finds no rest there",
            where="at",
            remedy=f"the closest that it has: {reached}" if target.converged else "",
        )
    return OperatingPoint(target.x, target.u)


def measure_response(
    analyser: Analyser, subject: Subject, loop: LoopParts, point: OperatingPoint, tell: Tell
) -> FrequencyResponse | NoResponse:
    """The response; that of the rig without its dry friction where that holds it at the point.

    Raises ConfigurationError if the controller does not answer, samples slower than the rig swings,
    or leaves no band above the lowest line.
    """
    _require_band(analyser.lowest, subject, loop, point)
    held_states = held_by_friction(subject.model, point)
    rig = without_impulses(subject.model) if held_states else subject.model
    return replace(analyser.measure(rig, loop, point, tell), held_states=held_states)


def _require_band(lowest: float, subject: Subject, loop: LoopParts, point: OperatingPoint) -> None:
    """Refuse a sampling that is slower than the rig, and a lowest line too close to its end."""
    step, swing = loop.control_period, 0.0
    if loop.model.sample_time is None:
        A, _ = VectorField(loop.model).linearised(point.x[: loop.model.n_x], point.u)
        swing = float(np.abs(np.linalg.eigvals(A).imag).max())
    periods = (
        ("sim.sample_time", "the loop", loop.sample_time, _OF_THE_RIG),
        ("controller.sample_time", "the controller", step, _OF_THE_CONTROLLER),
    )
    for where, who, period, fewest in periods:
        most = 2 * math.pi / (fewest * swing) if swing else math.inf
        if period > most:
            raise ConfigurationError(
                f"{who} samples every {period:g} s, slower than the rig moves: it swings at "
                f"{swing:.2g} rad/s there, and at least {fewest} samples of a swing are needed",
                where=where,
                remedy=f"{where}=0.02; at the most {most:.2g} s",
            )
    if harmonics_of(step, lowest) < _FEWEST:
        raise ConfigurationError(
            f"a response from {lowest:g} rad/s on cannot be measured: the controller samples every "
            f"{step:g} s, so that it ends at half its rate, {math.pi / step:.3g} rad/s",
            where="lowest",
            remedy=f"study.lowest of at most {math.pi / step / _FEWEST:.2g} rad/s",
        )


@dataclass(frozen=True)
class StabilityLimit:
    """The first change that makes a loop unstable."""

    value: float  #: A factor, rad or s
    omega: float  #: rad/s at which the loop then swings


@dataclass(frozen=True)
class ClassicalMargins:
    """Limits of a loop; None where no such change makes the measured curve run into −1."""

    up: StabilityLimit | None  #: Factor of the loop's gain, above and below 1
    down: StabilityLimit | None  #: Factor of the loop's gain, above and below 1
    phase: StabilityLimit | None  #: Least phase lost or gained at a unit gain, rad
    delay: StabilityLimit | None  #: s
    crossover: float  #: Highest frequency at which the gain is 1, rad/s; 0 if it never is


def classical_margins(omega: FloatArray, loops: ComplexArray) -> ClassicalMargins:
    """The limits of a loop (n,), or of several (n, m) that change together; ω is dense.

    Of several (the characteristic loci) the first to reach −1 counts.
    """
    curves = np.reshape(loops, (len(omega), -1)).T
    factors = [limit for curve in curves for limit in _factors(omega, curve)]
    lags = [limit for curve in curves for limit in _lags(omega, curve)]
    # a lead of φ is a lag of 2π − φ
    phases = [StabilityLimit(min(lag.value, 2 * math.pi - lag.value), lag.omega) for lag in lags]
    delays = [StabilityLimit(lag.value / lag.omega, lag.omega) for lag in lags]
    value = attrgetter("value")
    return ClassicalMargins(
        up=min((f for f in factors if f.value > 1), key=value, default=None),
        down=max((f for f in factors if f.value < 1), key=value, default=None),
        phase=min(phases, key=value, default=None),
        delay=min(delays, key=value, default=None),
        crossover=max((lag.omega for lag in lags), default=0.0),
    )


def _factors(omega: FloatArray, curve: ComplexArray) -> list[StabilityLimit]:
    """Factors that bring the curve to −1."""
    before, after = curve[:-1], curve[1:]
    k = np.flatnonzero((np.sign(before.imag) != np.sign(after.imag)) & (before.real < 0))
    share = before.imag[k] / (before.imag[k] - after.imag[k])
    real = before.real[k] + share * (after.real[k] - before.real[k])
    at = omega[k] + share * (omega[k + 1] - omega[k])
    limits = [
        StabilityLimit(-1 / r, w) for r, w in zip(real.tolist(), at.tolist(), strict=True) if r < 0
    ]
    # the curve of a sampled loop ends on the real axis, at half the rate
    end = complex(curve[-1])
    if end.real < 0 and abs(end.imag) < 1e-3 * abs(end.real):
        limits.append(StabilityLimit(-1 / end.real, float(omega[-1])))
    return limits


def _lags(omega: FloatArray, curve: ComplexArray) -> list[StabilityLimit]:
    """Phases in (0, 2π) that, lost, bring the curve to −1."""
    size = np.log(np.abs(curve))
    k = np.flatnonzero(np.sign(size[:-1]) != np.sign(size[1:]))
    share = size[k] / (size[k] - size[k + 1])
    direction = curve / np.abs(curve)
    there = direction[k] + share * (direction[k + 1] - direction[k])
    at = omega[k] + share * (omega[k + 1] - omega[k])
    lag = np.angle(-there) % (2 * math.pi)
    return [StabilityLimit(a, w) for a, w in zip(lag.tolist(), at.tolist(), strict=True)]


@dataclass(frozen=True)
class DiskMargin:
    """The largest disk."""

    alpha: float  #: Its size
    omega: float  #: Where it is reached, rad/s

    @property
    def gain_up(self) -> float:
        """Factor; infinite from α = 2 on."""
        return (2 + self.alpha) / (2 - self.alpha) if self.alpha < 2 else math.inf

    @property
    def gain_down(self) -> float:
        """Factor; 0 from α = 2 on."""
        return max(0.0, (2 - self.alpha) / (2 + self.alpha))

    @property
    def phase(self) -> float:
        """rad."""
        return 2 * math.atan(self.alpha / 2)


def disk_margin(omega: FloatArray, size: FloatArray) -> DiskMargin:
    """From a norm of S − T at each frequency, (n,)."""
    worst = int(np.argmax(size))
    return DiskMargin(2.0 / float(size[worst]), float(omega[worst]))


def diagonal_mu(M: ComplexArray) -> FloatArray:
    """μ of matrices (n, m, m) for a diagonal complex Δ, (n,); an upper bound for m > 2."""
    if M.shape[1] != 2:
        return largest_singular_value(M)
    size = np.abs(M)
    frobenius = size[:, 0, 0] ** 2 + size[:, 1, 1] ** 2 + 2 * size[:, 0, 1] * size[:, 1, 0]
    determinant = np.abs(np.linalg.det(M))
    # the square root's argument is (σ̄² − σ̲²)², negative by rounding only
    apart = np.sqrt(np.maximum(frobenius**2 - 4 * determinant**2, 0.0))
    return np.asarray(np.sqrt((frobenius + apart) / 2))


def largest_singular_value(M: ComplexArray) -> FloatArray:
    """σ̄ of matrices (n, m, m), (n,)."""
    return np.asarray(np.linalg.svd(M, compute_uv=False)[:, 0])


#: Frequencies between the lowest and the highest line at which margins are sought.
_DENSE = 4000


@dataclass(frozen=True)
class Peak:
    """The largest value of a norm."""

    value: float
    omega: float  #: rad/s


@dataclass(frozen=True)
class LoopMargins:
    """One loop, opened at its command while the others stay closed: ``L_i = 1/S_ii − 1``."""

    name: str  #: The input
    margins: ClassicalMargins
    #: max |S_ii|; its inverse is the distance of the Nyquist curve to −1, the modulus margin
    sensitivity: Peak
    complementary: Peak  #: max |T_ii|
    disk: DiskMargin


@dataclass(frozen=True)
class MarginResult:
    """All margins of a measured response."""

    response: FrequencyResponse

    @cached_property
    def omega(self) -> FloatArray:
        """Frequencies, rad/s, (n,)."""
        first, last = self.response.omega[[0, -1]]
        dense = np.geomspace(first, last, _DENSE)
        dense[[0, -1]] = first, last
        return dense

    @cached_property
    def S(self) -> ComplexArray:
        """Sensitivity at :attr:`omega`, (n, n_u, n_u)."""
        return interpolate_response(self.response.omega, self.response.S, self.omega)

    @cached_property
    def T(self) -> ComplexArray:
        """Complementary sensitivity, (n, n_u, n_u)."""
        return np.asarray(np.eye(self.S.shape[1]) - self.S)

    @cached_property
    def L(self) -> ComplexArray:
        """Loop transfer ``S⁻¹ − I``, (n, n_u, n_u)."""
        return np.asarray(np.linalg.inv(self.S) - np.eye(self.S.shape[1]))

    @cached_property
    def single(self) -> ComplexArray:
        """Loops opened one at a time, (n, n_u)."""
        return np.asarray(1 / np.diagonal(self.S, axis1=1, axis2=2) - 1)

    @cached_property
    def loops(self) -> tuple[LoopMargins, ...]:
        """Each loop's own."""
        w, loops = self.omega, []
        for i, name in enumerate(self.response.inputs):
            S, T = self.S[:, i, i], self.T[:, i, i]
            peaks, disk = (peak(w, np.abs(S)), peak(w, np.abs(T))), disk_margin(w, np.abs(S - T))
            loops.append(LoopMargins(name, classical_margins(w, self.single[:, i]), *peaks, disk))
        return tuple(loops)

    @cached_property
    def together(self) -> ClassicalMargins:
        """One factor or delay on all commands: by the characteristic loci, eigenvalues of L."""
        return classical_margins(
            self.omega, continuous(np.asarray(np.linalg.eigvals(self.L), dtype=np.complex128))
        )

    @cached_property
    def disk_each(self) -> DiskMargin:
        """All commands at once, each by a factor of its own."""
        return disk_margin(self.omega, diagonal_mu(self.S - self.T))

    @cached_property
    def disk_any(self) -> DiskMargin:
        """Any linear change of the commands, coupling included."""
        return disk_margin(self.omega, largest_singular_value(self.S - self.T))

    @cached_property
    def sensitivity(self) -> Peak:
        """max σ̄(S), the inverse of min σ̲(I + L)."""
        return peak(self.omega, largest_singular_value(self.S))

    @cached_property
    def complementary(self) -> Peak:
        """max σ̄(T)."""
        return peak(self.omega, largest_singular_value(self.T))

    @cached_property
    def interpolation(self) -> float:
        """Largest miss at a line of the interpolation through every other line.

        An upper bound of what is missed between the lines: they are twice as dense.
        """
        omega, S = self.response.omega, self.response.S
        knots = np.union1d(np.arange(0, omega.size, 2), [omega.size - 1])
        guess = interpolate_response(omega[knots], S[knots], omega)
        return float(largest_singular_value(guess - S).max())


def interpolate_response(
    omega: FloatArray, values: ComplexArray, frequencies: FloatArray
) -> ComplexArray:
    """Cubic splines over the logarithm of the frequency, along the first axis."""
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(np.log(omega), values, axis=0)(np.log(frequencies)))


def continuous(loci: ComplexArray) -> ComplexArray:
    """Eigenvalues (n, m) in the order in which each follows its predecessor."""
    from scipy.optimize import linear_sum_assignment

    ordered = loci.copy()
    for k in range(1, len(loci)):
        apart = np.abs(ordered[k - 1][:, None] - loci[k][None, :])
        ordered[k] = loci[k][linear_sum_assignment(apart)[1]]
    return ordered


def peak(omega: FloatArray, size: FloatArray) -> Peak:
    """The largest of (n,) values."""
    at = int(np.argmax(size))
    return Peak(float(size[at]), float(omega[at]))
