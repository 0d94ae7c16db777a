"""The frequency response of a closed loop, measured as on the bench.

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
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import ComplexArray, FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.models.dry_friction import SPEEDS
from trms_cli.models.model import Model, names
from trms_cli.models.operating_point import OperatingPoint, operating_point
from trms_cli.models.steady_state import SteadyState
from trms_cli.models.vector_field import VectorField, without_impulses
from trms_cli.stability.closed_loop import Enough, LoopRun, run_loop
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts, Subject


@dataclass(frozen=True)
class ExcitationPeriod:
    """One period of a multisine of rms 1."""

    step: float  #: Control period over which each value is held, s
    #: (n,) array of int; harmonics of the period that are in it, the lowest first
    lines: npt.NDArray[np.int64]
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
    chosen = np.unique(np.minimum(lines, half))
    n = chosen.size
    if seed:
        phases = np.random.default_rng(seed).uniform(0, 2 * math.pi, n)
    else:
        order = np.arange(n)
        phases = -math.pi * order * (order + 1) / n
    spectrum = np.zeros(half + 1, dtype=complex)
    spectrum[chosen] = np.exp(1j * phases)
    spectrum[half] = 1.0
    values = np.fft.irfft(spectrum, 2 * half)
    return ExcitationPeriod(step, chosen, values / np.sqrt(np.mean(values**2)))


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
    held: tuple[str, ...] = ()

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
    held: tuple[str, ...] = ()  #: As of :class:`FrequencyResponse`


class NoLoopError(Exception):
    """The controller's commands do not depend on what it sees."""


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
        """The response around an operating point. Raises NoLoopError."""
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
            raise NoLoopError
        answers: list[_Answer] = []
        for doing, added in zip(words, [*one_by_one, together], strict=True):
            tell(doing)
            last = _experiment(model, loop, point, added, self.periods * probe.length * step)
            if last.gone:
                return NoResponse(last.run, last.gone, last.leaves, last.reversed)
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

    def __init__(self, added: FloatArray, ratio: int) -> None:
        self.ratio, self._added = ratio, added
        self.commands: list[FloatArray] = []

    def __call__(self, k: int, u: FloatArray) -> FloatArray:
        length = len(self._added)
        if k % self.ratio == 0:
            done = len(self.commands)
            if done % length == 0 and done >= 2 * length and self.drift < SETTLED:
                raise Enough
            self.commands.append(u.copy())
        return np.asarray(u + self._added[(k // self.ratio) % length])

    def period(self, back: int = 0) -> FloatArray:
        """The last whole period of the commands, or one before, (N, n_u); empty where none is."""
        length = len(self._added)
        end = (len(self.commands) // length - back) * length
        return np.array(self.commands[max(end - length, 0) : max(end, 0)])

    @property
    def drift(self) -> float:
        """Change of the answer from the last period but one to the last."""
        last, before = self.period(), self.period(1)
        if not len(before):
            return np.inf
        moved = float(np.linalg.norm(last - last.mean(axis=0)))
        return float(np.linalg.norm(last - before)) / moved if moved > 0 else 0.0


@dataclass(frozen=True)
class _Answer:
    """The last period of an experiment."""

    run: LoopRun
    commands: FloatArray
    drift: float
    rest: FloatArray
    limited: int
    reversed: tuple[str, ...]
    gone: str
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
    leaves = bool(run.ended) or grows or away > _FAR
    gone = ""
    if run.ended or adder.drift > NOT_PERIODIC:
        name = model.controlled[int(np.argmax(np.abs(last).max(axis=0)))]
        after = f"after {run.time[-1] if run.time.size else 0.0:.0f} s"
        gone = f"{name} is up to {away:.2g} rad away {after}"
        if run.ended:
            gone += f", where the run ends: {run.ended}"
        elif not leaves:
            gone = (
                f"{name} stays within {away:.2g} rad, but {after} the answer to the test signal "
                f"still changes by {100 * adder.drift:.0f} % from period to period"
            )
    turned = tuple(
        name for name in _speeds(model) if np.ptp(np.sign(run.x[:, model.state_index(name)])) > 0
    )
    return _Answer(run, commands, adder.drift, rest, limited, turned, gone, leaves)


def _speeds(model: Model) -> list[str]:
    """The states that are rotors' speeds."""
    return [SPEEDS[rotor] for rotor in model.rotors if SPEEDS.get(rotor) in model.state_names]


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
    moved = []
    for impulses in (True, False):
        ends = field.motions(starts, commands, _WAIT, _WAIT / 10, impulses=impulses)
        moved.append(np.abs(ends[:, 1] - ends[:, 0]).max(axis=0))
    with_friction, free = moved
    rows = {name: model.state_index(name) for name in (*model.controlled, *_speeds(model))}
    return tuple(name for name, i in rows.items() if with_friction[i] < _HELD * free[i])


#: Level, and yaw where the cable pulls and the tail rotor turns: at ω_h = 0 its thrust, ω|ω|, has
#: no slope, and no linear loop of yaw exists.
DEFAULT = {"alpha_v": 0.0, "alpha_h": 0.3}
#: Harmonics of the lowest line up to half the controller's rate: fewer are no curve.
_FEWEST = 10
#: Samples per swing of the rig: of its clock, over which it is integrated in one go, and of the
#: controller, whose loop ends at half its rate.
_OF_THE_RIG, _OF_THE_CONTROLLER = 10, 2


def point_of(subject: Subject, at: Mapping[str, float]) -> OperatingPoint:
    """The operating point asked for; :data:`DEFAULT` where nothing is. Raises TrmsError."""
    model = subject.model
    at = at or {name: value for name, value in DEFAULT.items() if name in model.controlled}
    if model.sample_time is None:
        return operating_point(model, at)
    for name in at:
        unknown = (
            f"model {subject.name!r} only steps from sample to sample, and where it rests is found "
            f"by its angles, not by {name!r}"
        )
        require_known(name, model.controlled, unknown, f"at.{name}")
    wanted = np.array([at.get(name, 0.0) for name in model.controlled])
    target = SteadyState(model).solve(wanted)
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


def measured(
    analyser: Analyser, subject: Subject, loop: LoopParts, point: OperatingPoint, tell: Tell
) -> FrequencyResponse | NoResponse:
    """The response; that of the rig without its dry friction where that holds it at the point.

    Raises ConfigurationError if the controller does not answer, samples slower than the rig swings,
    or leaves no band above the lowest line.
    """
    _require_band(analyser.lowest, subject, loop, point)
    held = held_by_friction(subject.model, point)
    rig = without_impulses(subject.model) if held else subject.model
    try:
        return replace(analyser.measure(rig, loop, point, tell), held=held)
    except NoLoopError:
        raise ConfigurationError(
            f"the commands of controller={loop.names['controller']} do not depend on what it sees: "
            "there is no loop",
            where="controller",
            remedy="choose one that feeds back, as controller=lqr; without a controller, "
            "study=local tells the rig's own modes",
        ) from None


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
