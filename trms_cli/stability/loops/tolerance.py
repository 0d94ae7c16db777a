"""How much of each impairment a loop stands in simulation, and what its linear margins foretell."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.closed_loop import run_loop
from trms_cli.stability.loops.impairments import Gain, Impairment
from trms_cli.stability.loops.margins import Margins
from trms_cli.stability.loops.tolerance_search import Found, Tried, searched
from trms_cli.stability.loops.verdict import Bounds
from trms_cli.stability.subject import LoopParts, Subject

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Trial:
    """How a loop is tried."""

    subject: Subject
    loop: LoopParts
    point: OperatingPoint  #: Also the reference
    offset: Mapping[str, float]  #: By how much the start differs, by state
    duration: float  #: s
    bounds: Bounds
    lost: float  #: rad from the point at which a run is ended

    def errors(self, x: FloatArray) -> FloatArray:
        """Controlled angles' distances from the point, rad, (n, n_r)."""
        model = self.subject.model
        rows = [model.state_index(name) for name in model.controlled]
        return np.asarray(x[:, rows] - self.point.x[rows])

    def at(self, impairment: Impairment, size: float) -> Tried:
        """A run with the impairment at a size; at ``impairment.none`` nothing is wrong."""
        model = self.subject.model
        rows = [model.state_index(name) for name in model.controlled]
        goal = self.point.x[rows]

        def gone(x: FloatArray) -> str:
            far = float(np.abs(x[rows] - goal).max())
            return f"an angle is {far:.2g} rad away" if far > self.lost else ""

        wrong = size != impairment.none
        rig = impairment.rig(model, size) if wrong else model
        time = self.loop.sample_time
        path = impairment.path(model, self.point, time, size) if wrong else None
        run = run_loop(
            rig,
            self.loop,
            self.point,
            self.duration,
            offset=self.offset,
            path=path,
            until=gone,
        )
        lower, upper = model.input_bounds()
        commands = run.u / ((upper - lower) / 2)
        verdict = self.bounds.verdict(self.errors(run.x), commands, bool(run.ended))
        return Tried(size, run, verdict)


@dataclass(frozen=True)
class Limits:
    """What was found of an impairment."""

    impairment: Impairment
    back: Found  #: Up to where the loop comes back to the point
    calm: Found  #: Up to where it does not swing on, wherever it rests
    #: Size at which the linear loop becomes unstable; None: at none, or nothing is foretold
    predicted: float | None
    foretold: bool  #: Whether the linear margins say anything of this impairment


def limits_of(
    trial: Trial,
    impairment: Impairment,
    sizes: Sequence[float],
    precision: float,
    nothing: Tried,
    margins: Margins | None,
) -> Limits:
    """Both limits of one impairment; runs are shared between the two searches."""
    runs: dict[float, Tried] = {
        impairment.none: Tried(impairment.none, nothing.run, nothing.verdict)
    }

    def attempt(size: float) -> Tried:
        if size not in runs:
            runs[size] = trial.at(impairment, size)
        return runs[size]

    def found(fails: Callable[[Tried], bool]) -> Found:
        return searched(sizes, runs[impairment.none], attempt, precision, fails)

    calm = found(lambda tried: not tried.verdict.calm)
    back = found(lambda tried: not tried.verdict.back)
    return Limits(impairment, back, calm, *_predicted(impairment, margins))


def _predicted(impairment: Impairment, margins: Margins | None) -> tuple[float | None, bool]:
    """The size at which the linear loop becomes unstable, and whether it says anything."""
    if margins is None or impairment.kind == "friction":
        return None, False
    if not isinstance(impairment, Gain):
        delay = margins.together.delay
        return (None if delay is None else delay.value), True
    crossings = margins.loops[impairment.channel].crossings
    if impairment.up:
        return (None if crossings.up is None else crossings.up.value), True
    return (None if crossings.down is None else 1 / crossings.down.value), True


#: Factor within which a foretold and a simulated limit count as the same.
_ALIKE = 1.2
#: How much closer to the point the run begins that tells what a difference is due to.
_CLOSER = 20.0


def explanation(limits: Limits, trial: Trial) -> str:
    """Why the simulated limit of the swing is not the foretold one, as far as runs show it.

    One more run, between the two limits and from a start much closer to the point, where the rig
    is as good as linear, tells whether the difference is one of the swing's size.
    """
    impairment, limit, predicted = limits.impairment, limits.calm.limit, limits.predicted
    if not limits.foretold:
        return ""
    if isinstance(impairment, Gain) and not impairment.up:
        held = _range_ends(limits, impairment, trial)
        if held:
            return held
    most = limits.calm.tried[-1].size
    if limit is None and (predicted is None or predicted > most):
        return "none within the scan, as foretold"
    if limit and predicted and 1 / _ALIKE < limit / predicted < _ALIKE:
        return "as foretold"
    between = float(np.sqrt((limit or most) * (predicted or _ALIKE**2 * (limit or most))))
    offset = {name: value / _CLOSER for name, value in trial.offset.items()}
    near = replace(trial, offset=offset, bounds=trial.bounds.closer(_CLOSER))
    closer = near.at(impairment, between)
    stable = predicted is None or between < predicted
    words = (
        "later than foretold"
        if limit is None or (predicted and limit > predicted)
        else ("sooner than foretold")
    )
    if closer.verdict.calm == stable:
        return (
            f"{words}; from a start {_CLOSER:g} times closer the linear loop is right: a large "
            f"swing is not linear{_at_limits(limits, trial)}"
        )
    too = f"{words}, from a start {_CLOSER:g} times closer too"
    if isinstance(impairment, Gain):
        changes = near.at(replace(impairment, of_changes=True), between)
        if changes.verdict.calm == stable:
            return (
                f"{too}; scaling only the command's changes, the linear loop is right: with all "
                "of it scaled, the controller works at another command, where its law has another "
                "slope"
            )
    return too


def _range_ends(limits: Limits, gain: Gain, trial: Trial) -> str:
    """A word where the command that holds the point is out of the range at the wrong gain."""
    lower, upper = trial.subject.model.input_bounds()
    u = float(trial.point.u[gain.channel])
    bound = float((upper if u > 0 else lower)[gain.channel])
    above = limits.back.above
    if not u or above is None or bound / u > above.size:
        return ""
    return (
        f"holding the point takes {abs(u):.3g} V: with a gain below {u / bound:.2g} the command "
        f"would have to pass its limit of {abs(bound):.3g} V"
    )


def _at_limits(limits: Limits, trial: Trial) -> str:
    if limits.calm.above is None:
        return ""
    applied = limits.calm.above.run.applied
    lower, upper = trial.subject.model.input_bounds()
    share = float(np.mean(np.any((applied <= lower) | (applied >= upper), axis=1)))
    if share < 0.01:
        return ""
    return f" (commands at a limit {100 * share:.0f} % of the time)"
