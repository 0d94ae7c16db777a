"""How much of each impairment a loop stands in simulation, and what its linear margins foretell.

What goes wrong between a controller and its rig (late commands, wrong gains, dry friction) has one
size each, of which a given one means that nothing is wrong. A coarse scan, then bisection finds the
first size that a loop does not stand. Nothing says that a loop which fails at one size fails at all
larger ones, so all sizes of the scan are tried; the bisection then closes in on the first failure
that the scan shows. A shorter failure between two sizes of the scan is not seen.

What a run came to is told from the last two thirds of it: each third's mean error and swing (half
of the range) of each angle tell whether the loop has settled, is still on its way, rests beside the
point, or swings on.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.models.model import Model, names
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.models.state_scales import bench_ratios
from trms_cli.stability.closed_loop import LoopRun, Path, run_loop
from trms_cli.stability.loops.frequency_response import MarginResult
from trms_cli.stability.subject import LoopParts, Subject

ImpairmentKind = Literal["delay", "gain", "friction"]
_UNITS: dict[ImpairmentKind, str] = {"delay": "s", "gain": "", "friction": "N m"}


@dataclass(frozen=True)
class Impairment:
    """One way in which a loop is made worse; larger sizes are worse.

    *Delay*: all commands reach the motors late. *Gain*: one command reaches its motor too large, or
    too small, within its limits. *Friction*: Coulomb friction of an axis.
    """

    kind: ImpairmentKind
    of: str = ""  #: The input of a gain, the axis of friction
    up: bool = False  #: Whether a gain is too large: a factor of size, else of 1/size
    #: Whether a gain changes only the command's distance to the point's, as in linear theory
    of_changes: bool = False
    force_unit: str = "N m"  #: Of friction
    force_ratio: float = 1.0  #: Of the axis' force to that of a small bench, by which sizes go

    @property
    def key(self) -> str:
        """``delay``, ``gain_up_u_v``, ``friction_pitch``."""
        side = ("up" if self.up else "down") if self.kind == "gain" else ""
        return "_".join(part for part in (self.kind, side, self.of) if part)

    @property
    def words(self) -> str:
        """``delay of all commands``, ``gain of u_v too large``, ``Coulomb friction of pitch``."""
        if self.kind == "gain":
            return f"gain of {self.of} too {'large' if self.up else 'small'}"
        return "delay of all commands" if self.kind == "delay" else f"Coulomb friction of {self.of}"

    @property
    def unit(self) -> str:
        return self.force_unit if self.kind == "friction" else _UNITS[self.kind]

    @property
    def none(self) -> float:
        """The size at which nothing is wrong."""
        return 1.0 if self.kind == "gain" else 0.0

    def display_size(self, size: float) -> float:
        """The size as it is told: a gain of 1/size for one that is too small."""
        return 1 / size if self.kind == "gain" and not self.up else size

    def amount(self, size: float) -> str:
        """The size in words: ``0.1 s``, ``2``, ``0.004 N m``."""
        return f"{self.display_size(size):.3g} {self.unit}".rstrip()

    def rig(self, model: Model, size: float) -> Model:
        """The rig that has it."""
        if self.kind != "friction":
            return model
        friction = CoulombFriction(axis=self.of, torque=size)
        return extend_model(model, {f"added_{self.key}": friction})

    def path(
        self, model: Model, point: OperatingPoint, sample_time: float, size: float
    ) -> Path | None:
        """What its commands pass; None where they pass as they are."""
        if self.kind == "delay":
            return CommandDelay(size / sample_time, point.u)
        if self.kind == "friction":
            return None
        factor = np.ones(model.n_u)
        factor[names(model.inputs).index(self.of)] = self.display_size(size)
        lower, upper = model.input_bounds()
        around = point.u if self.of_changes else np.zeros(model.n_u)
        # the amplifier behind the wrong gain has the limits that the command has
        return lambda k, u: np.clip(around + factor * (u - around), lower, upper)


def impairments_of(model: Model) -> tuple[Impairment, ...]:
    """All that fit a rig; one that only steps cannot gain friction."""
    gains = [Impairment("gain", u, up) for u in names(model.inputs) for up in (True, False)]
    if model.sample_time is not None:
        return (Impairment("delay"), *gains)
    ratios, units = bench_ratios(model), {s.name: s.unit for s in model.disturbances}
    frictions = [
        Impairment(
            "friction",
            axis,
            force_unit=units[place.moment].replace("*", " "),
            force_ratio=float(ratios.disturbances[[*units].index(place.moment)]),
        )
        for axis, place in model.axes.items()
    ]
    return (Impairment("delay"), *gains, *frictions)


@dataclass
class CommandDelay:
    """Commands as they were a time ago.

    Between two samples the delayed command has its mean over the sample: the mixture of two
    neighbours, so that any time is possible.
    """

    samples: float  #: The time over the sample time
    before: FloatArray  #: (n_u,) array; in force before the first command
    _past: deque[FloatArray] = field(init=False)
    _share: float = field(init=False)

    def __post_init__(self) -> None:
        whole = int(self.samples)
        self._share = self.samples - whole
        self._past = deque([self.before.copy() for _ in range(whole + 2)], maxlen=whole + 2)

    def __call__(self, k: int, u: FloatArray) -> FloatArray:
        self._past.append(u.copy())
        return np.asarray((1 - self._share) * self._past[1] + self._share * self._past[0])


Kind = Literal[
    "settles", "dies out", "still creeping", "rests beside", "chatters", "swings", "is lost"
]
#: Crossings of its mean in the last two thirds that a swing has at the least: a start from where
#: friction held an axis has fewer.
_CROSSINGS = 4
#: Of one third to the next: a swing that keeps more than this part does not die out, and an error
#: that does is not on its way back; it may come to rest anywhere.
_SHRINKS, _RETURNS = 0.8, 0.5
#: Of one sixth of the run to the next: a mean error that keeps more does not creep on.
_STILL = 0.98
#: Share of half its range from which a command is at its limit.
_LIMIT = 1 - 1e-6


@dataclass(frozen=True)
class RunVerdict:
    """How a run ended."""

    #: ``settles``: within the bounds; ``dies out``: not yet, but getting there; ``still creeping``:
    #: beyond the bounds, but closer and closer, too slowly for the run to show where to; ``rests
    #: beside`` the point; ``chatters``: commands swing on, too fast to be seen in the angles;
    #: ``swings`` on; ``is lost``: it went too far from the point
    kind: Kind
    rest: FloatArray  #: (n_r,) array; mean error in the last third, rad
    swing: FloatArray  #: (n_r,) array; half of the range in the last third, rad
    axis: int  #: The angle that is worst

    @property
    def calm(self) -> bool:
        """Whether no swing goes on, wherever the loop rests."""
        return self.kind not in ("chatters", "swings", "is lost")

    @property
    def back(self) -> bool:
        """Whether the loop came back to the point, or is coming."""
        return self.kind in ("settles", "dies out")


@dataclass(frozen=True)
class Bounds:
    """What is told apart."""

    rest: float  #: rad that a loop may rest beside the point
    swing: float  #: rad by which it may swing
    chatter: float  #: Share of half the range of a command by which that may swing

    def closer(self, factor: float) -> Bounds:
        """Those for a loop that begins that much closer to its point."""
        return Bounds(self.rest / factor, self.swing / factor, self.chatter / factor)

    def verdict(self, errors: FloatArray, commands: FloatArray, ended: bool) -> RunVerdict:
        """The verdict on a run by its angles' errors (n, n_r), rad, and whether it ended early.

        Commands (n, n_u) are shares of half their range.
        """
        third = max(1, len(errors) // 3)
        before, last = errors[-2 * third : -third], errors[-third:]
        rest, swing = last.mean(axis=0), np.ptp(last, axis=0) / 2
        if ended or not len(before):
            return RunVerdict("is lost", rest, swing, int(np.argmax(np.abs(errors[-1]))))
        rest_before = before.mean(axis=0)
        worst = int(np.argmax(np.maximum(np.abs(rest), swing)))
        swings = _swings_on(errors[-2 * third :], self.swing)
        if swings.any():
            return RunVerdict("swings", rest, swing, int(np.argmax(np.where(swings, swing, -1.0))))
        if _swings_on(commands[-2 * third :], self.chatter).any():
            return RunVerdict("chatters", rest, swing, worst)
        away = np.abs(rest)
        beside = (away > self.rest) & (away > _RETURNS * np.abs(rest_before))
        if beside.any():
            # with a command at its limit for good, nothing pushes on towards the point
            spent = bool(np.all(np.abs(commands[-third:]) >= _LIMIT, axis=0).any())
            # A mean error creeps that shrinks from each quarter to the next.
            quarters = np.array_split(errors[-2 * third :], 4)
            means = np.array([np.abs(part.mean(axis=0)) for part in quarters])
            creeps = np.all(means[1:] < _STILL * means[:-1], axis=0)
            resting = beside & (spent | ~creeps)
            kind: Kind = "rests beside" if resting.any() else "still creeping"
            is_relevant = resting if resting.any() else beside
            return RunVerdict(kind, rest, swing, int(np.argmax(np.where(is_relevant, away, -1.0))))
        settled = bool(np.all((away <= self.rest) & (swing <= self.swing)))
        return RunVerdict("settles" if settled else "dies out", rest, swing, worst)


def _swings_on(values: FloatArray, bound: float) -> BoolArray:
    """Which of (n, m) signals swing beyond a bound without getting calmer, (m,)."""
    half = len(values) // 2
    before, last = (np.ptp(part, axis=0) / 2 for part in (values[:half], values[half:]))
    above = values > values.mean(axis=0)
    crossed = (above[1:] != above[:-1]).sum(axis=0)
    return np.asarray((last > bound) & (last > _SHRINKS * before) & (crossed >= _CROSSINGS))


#: Halvings at the most: enough from a size that fails at once down to a thousandth of it.
_HALVINGS = 10


@dataclass(frozen=True)
class TrialRun:
    """One size."""

    size: float
    run: LoopRun
    verdict: RunVerdict


@dataclass(frozen=True)
class FailureBracket:
    """Where a loop first fails."""

    runs: tuple[TrialRun, ...]  #: By size
    below: TrialRun  #: The largest size before the first failure
    above: TrialRun | None  #: The first failure; None: all sizes were stood
    again: tuple[float, ...]  #: Sizes of the scan beyond it that are stood again

    @property
    def limit(self) -> float | None:
        """Between the two, by their geometric mean (the arithmetic one where nothing is 0)."""
        if self.above is None:
            return None
        return _between(self.below.size, self.above.size)


def find_failure(
    sizes: Sequence[float],
    nothing: TrialRun,
    attempt: Callable[[float], TrialRun],
    precision: float,
    fails: Callable[[TrialRun], bool],
) -> FailureBracket:
    """The first failure: of a scan of sizes, the smallest first, and then by bisection.

    ``nothing`` is the run with nothing wrong, which does not fail; the bisection ends at a factor
    of ``precision`` between two sizes.
    """
    scanned = [attempt(size) for size in sizes]
    trials = [nothing, *scanned]
    first = next((i for i, t in enumerate(trials) if fails(t)), None)
    if first is None:
        return FailureBracket(tuple(trials), trials[-1], None, ())
    below, above = trials[first - 1], trials[first]
    again = tuple(t.size for t in trials[first:] if not fails(t))
    for _ in range(_HALVINGS):
        if below.size > 0 and above.size <= precision * below.size:
            break
        middle = attempt(_between(below.size, above.size))
        trials.append(middle)
        if fails(middle):
            above = middle
        else:
            below = middle
    return FailureBracket(tuple(sorted(trials, key=lambda t: t.size)), below, above, again)


def _between(low: float, high: float) -> float:
    return math.sqrt(low * high) if low > 0 else high / 2


@dataclass(frozen=True)
class ToleranceTrial:
    """How a loop is tried."""

    subject: Subject
    loop: LoopParts
    point: OperatingPoint  #: Also the reference
    offset: Mapping[str, float]  #: By how much the start differs, by state
    duration: float  #: s
    bounds: Bounds
    distance_limit: float  #: rad from the point at which a run is ended

    def errors(self, x: FloatArray) -> FloatArray:
        """Controlled angles' distances from the point, rad, (…, n_r), at states (…, n_x)."""
        model = self.subject.model
        rows = [model.state_index(name) for name in model.controlled]
        return np.asarray((x - self.point.x)[..., rows])

    def at(self, impairment: Impairment, size: float) -> TrialRun:
        """A run with the impairment at a size; at ``impairment.none`` nothing is wrong."""
        model = self.subject.model

        def departure(x: FloatArray) -> str:
            far = float(np.abs(self.errors(x)).max())
            return f"an angle is {far:.2g} rad away" if far > self.distance_limit else ""

        wrong = size != impairment.none
        rig = impairment.rig(model, size) if wrong else model
        path = impairment.path(model, self.point, self.loop.sample_time, size) if wrong else None
        run = run_loop(
            rig,
            self.loop,
            self.point,
            self.duration,
            offset=self.offset,
            path=path,
            until=departure,
        )
        lower, upper = model.input_bounds()
        commands = run.u / ((upper - lower) / 2)
        verdict = self.bounds.verdict(self.errors(run.x), commands, bool(run.stop_reason))
        return TrialRun(size, run, verdict)


@dataclass(frozen=True)
class ImpairmentLimits:
    """How much of an impairment a loop stands."""

    impairment: Impairment
    back: FailureBracket  #: Up to where the loop comes back to the point
    calm: FailureBracket  #: Up to where it does not swing on, wherever it rests
    #: Size at which the linear loop becomes unstable; None: at none, or nothing is foretold
    predicted: float | None
    foretold: bool  #: Whether the linear margins say anything of this impairment


def limits_of(
    trial: ToleranceTrial,
    impairment: Impairment,
    sizes: Sequence[float],
    precision: float,
    nothing: TrialRun,
    margins: MarginResult,
) -> ImpairmentLimits:
    """Both limits of one impairment; runs are shared between the two searches."""
    runs = {impairment.none: replace(nothing, size=impairment.none)}

    def attempt(size: float) -> TrialRun:
        if size not in runs:
            runs[size] = trial.at(impairment, size)
        return runs[size]

    def search(fails: Callable[[TrialRun], bool]) -> FailureBracket:
        return find_failure(sizes, runs[impairment.none], attempt, precision, fails)

    calm = search(lambda run: not run.verdict.calm)
    back = search(lambda run: not run.verdict.back)
    return ImpairmentLimits(impairment, back, calm, *_predicted(impairment, margins))


def _predicted(impairment: Impairment, margins: MarginResult) -> tuple[float | None, bool]:
    """The size at which the linear loop becomes unstable, and whether it says anything."""
    if impairment.kind == "friction":
        return None, False
    if impairment.kind == "delay":
        limit = margins.together.delay
    else:
        own = next(loop.margins for loop in margins.loops if loop.name == impairment.of)
        limit = own.up if impairment.up else own.down
    return (None if limit is None else impairment.display_size(limit.value)), True


#: Factor within which a foretold and a simulated limit count as the same.
_ALIKE = 1.2
#: How much closer to the point the run begins that tells what a difference is due to.
_CLOSER = 20.0


def explanation(limits: ImpairmentLimits, trial: ToleranceTrial) -> str:
    """Why the simulated limit of the swing is not the foretold one, as far as runs show it.

    One more run, between the two limits and from a start much closer to the point, where the rig
    is as good as linear, tells whether the difference is one of the swing's size.
    """
    impairment, limit, predicted = limits.impairment, limits.calm.limit, limits.predicted
    if not limits.foretold:
        return ""
    if range_text := _range_ends(limits, trial):
        return range_text
    most = limits.calm.runs[-1].size
    if limit is None and (predicted is None or predicted > most):
        return "none within the scan, as foretold"
    if limit and predicted and 1 / _ALIKE < limit / predicted < _ALIKE:
        return "as foretold"
    between = float(np.sqrt((limit or most) * (predicted or _ALIKE**2 * (limit or most))))
    offset = {name: value / _CLOSER for name, value in trial.offset.items()}
    near = replace(trial, offset=offset, bounds=trial.bounds.closer(_CLOSER))
    closer = near.at(impairment, between)
    stable = predicted is None or between < predicted
    later = limit is None or (predicted and limit > predicted)
    words = f"{'later' if later else 'sooner'} than foretold"
    if closer.verdict.calm == stable:
        return (
            f"{words}; from a start {_CLOSER:g} times closer the linear loop is right: a large "
            f"swing is not linear{_at_limits(limits, trial)}"
        )
    too = f"{words}, from a start {_CLOSER:g} times closer too"
    if impairment.kind == "gain":
        changes = near.at(replace(impairment, of_changes=True), between)
        if changes.verdict.calm == stable:
            return (
                f"{too}; scaling only the command's changes, the linear loop is right: with all "
                "of it scaled, the controller works at another command, where its law has another "
                "slope"
            )
    return too


def _range_ends(limits: ImpairmentLimits, trial: ToleranceTrial) -> str:
    """A word where the command that holds the point is out of the range at too small a gain."""
    gain, above = limits.impairment, limits.back.above
    if gain.kind != "gain" or gain.up or above is None:
        return ""
    model = trial.subject.model
    channel = names(model.inputs).index(gain.of)
    lower, upper = model.input_bounds()
    u = float(trial.point.u[channel])
    bound = float((upper if u > 0 else lower)[channel])
    if not u or bound / u > above.size:
        return ""
    return (
        f"holding the point takes {abs(u):.3g} V: with a gain below {u / bound:.2g} the command "
        f"would have to pass its limit of {abs(bound):.3g} V"
    )


def _at_limits(limits: ImpairmentLimits, trial: ToleranceTrial) -> str:
    if limits.calm.above is None:
        return ""
    applied = limits.calm.above.run.applied
    lower, upper = trial.subject.model.input_bounds()
    share = float(np.mean(np.any((applied <= lower) | (applied >= upper), axis=1)))
    return f" (commands at a limit {100 * share:.0f} % of the time)" if share >= 0.01 else ""
