"""The test signal of a frequency response: a multisine of few lines, held over control periods.

All harmonics of the lowest line at first, then lines a constant factor apart, up to half the
controller's rate. What lies between the lines is left empty on purpose: power found there is not
the answer of a linear loop. Phases after M. R. Schroeder, "Synthesis of low-peak-factor signals
and binary sequences with low autocorrelation", IEEE Trans. Information Theory 16(1), 1970.

The frequency response of a closed loop, measured as on the bench.

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

Sources: Ljung, "System Identification", 2nd ed. 1999, sec. 6.2 and 13.5 (closed loops, the joint
input-output approach); Pintelon & Schoukens, "System Identification: A Frequency Domain Approach",
2nd ed. 2012, ch. 2–4 (periodic signals, lines left empty to detect distortion).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import ComplexArray, FloatArray
from trms_cli.models.dry_friction import SPEEDS
from trms_cli.models.model import Model, names
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.closed_loop import Enough, LoopRun, run_loop
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts


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
    """A multisine of a controller's band.

    Parameters
    ----------
    step : float
        Control period, s.
    lowest : float
        Lowest line, rad/s; the period is the whole even number of control periods closest to it.
    ratio : float
        Of a line to the one below it, where the harmonics are denser than that.
    seed : int
        0: Schroeder's phases; else random ones, of another signal of the same spectrum.
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
    #: (n_r,) array; largest excursion of the controlled angles from that mean, rad
    swing: FloatArray
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
        """The response around an operating point.

        Raises NoLoopError.
        """
        step = getattr(loop.controller, "sample_time", None) or loop.sample_time
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
        _require_answer(model, loop, point, size)
        answers: list[_Answer] = []
        for doing, added in zip(words, [*one_by_one, together], strict=True):
            tell(doing)
            answers.append(self._answer(model, loop, point, probe.length, added))
            if answers[-1].gone:
                last = answers[-1]
                return NoResponse(last.run, last.gone, last.leaves, last.reversed)
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
            swing=np.max([a.swing for a in answers], axis=0),
            statuses=dict(sum((Counter(a.run.statuses) for a in answers), Counter())),
            limited=sum(a.limited for a in answers),
            reversed=tuple(sorted({name for a in answers for name in a.reversed})),
            duration=sum(a.run.time.size for a in answers) * loop.sample_time,
        )

    def _answer(
        self, model: Model, loop: LoopParts, point: OperatingPoint, length: int, added: FloatArray
    ) -> _Answer:
        """One experiment: a period (N, n_u) is added to the commands until they repeat."""
        step = getattr(loop.controller, "sample_time", None) or loop.sample_time
        adder = _Adder(added, round(step / loop.sample_time))
        run = run_loop(model, loop, point, self.periods * length * step, path=adder)
        return _answered(model, point, run, adder)


def _require_answer(model: Model, loop: LoopParts, point: OperatingPoint, step: FloatArray) -> None:
    """Refuse a controller whose commands are the same with and without a step added to them."""
    period = getattr(loop.controller, "sample_time", None) or loop.sample_time
    plain = run_loop(model, loop, point, _SOON * period)
    pushed = run_loop(model, loop, point, _SOON * period, path=lambda k, u: u + step)
    if np.array_equal(plain.u, pushed.u):
        raise NoLoopError


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

    @property
    def last(self) -> FloatArray:
        """The last whole period of the commands, (N, n_u)."""
        length = len(self._added)
        end = len(self.commands) // length * length
        return np.array(self.commands[end - length : end])

    @property
    def drift(self) -> float:
        """Change of the answer from the last period but one to the last."""
        length = len(self._added)
        end = len(self.commands) // length * length
        if end < 2 * length:
            return np.inf
        last, before = self.last, np.array(self.commands[end - 2 * length : end - length])
        moved = float(np.linalg.norm(last - last.mean(axis=0)))
        return float(np.linalg.norm(last - before)) / moved if moved > 0 else 0.0


@dataclass(frozen=True)
class _Answer:
    """The last period of an experiment."""

    run: LoopRun
    commands: FloatArray
    drift: float
    rest: FloatArray
    swing: FloatArray
    limited: int
    reversed: tuple[str, ...]
    gone: str
    leaves: bool


def _answered(model: Model, point: OperatingPoint, run: LoopRun, adder: _Adder) -> _Answer:
    rows = [model.state_index(name) for name in model.controlled]
    angles = run.x[:, rows] - point.x[rows]
    samples = min(len(angles), adder.last.shape[0] * adder.ratio or len(angles))
    last = angles[-samples:]
    rest = last.mean(axis=0)
    swing = np.abs(last - rest).max(axis=0)
    lower, upper = model.input_bounds()
    limited = int(np.any((run.u <= lower) | (run.u >= upper), axis=1)[:: adder.ratio].sum())
    first = angles[samples : 2 * samples]
    away = float(np.abs(last).max()) if last.size else 0.0
    grows = bool(np.linalg.norm(last) > _GROWS * np.linalg.norm(first))
    leaves = bool(run.ended) or grows or away > _FAR
    gone = ""
    if run.ended or adder.drift > NOT_PERIODIC:
        furthest = int(np.argmax(np.abs(last).max(axis=0)))
        name, seconds = model.controlled[furthest], run.time[-1] if run.time.size else 0.0
        gone = f"{name} is up to {away:.2g} rad away after {seconds:.0f} s"
        if run.ended:
            gone += f", where the run ends: {run.ended}"
        elif not leaves:
            gone = (
                f"{name} stays within {away:.2g} rad, but after {seconds:.0f} s the answer to the "
                f"test signal still changes by {100 * adder.drift:.0f} % from period to period"
            )
    speeds = [SPEEDS[rotor] for rotor in model.rotors if SPEEDS.get(rotor) in model.state_names]
    turned = tuple(
        name for name in speeds if np.ptp(np.sign(run.x[:, model.state_index(name)])) > 0
    )
    return _Answer(run, adder.last, adder.drift, rest, swing, limited, turned, gone, leaves)
