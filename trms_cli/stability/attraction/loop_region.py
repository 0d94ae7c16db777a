"""The loop closed by the LQR law in continuous time, with its integral and its saturation.

The sampled law (:mod:`trms_cli.controllers.lqr`) with a state that is known and a reference that
does not move reads, for short periods,

    v = ū − K (x − x̄) − K_i ξ        u = v within the limits
    ξ̇ = angles − reference + (unwind/T) (v − u)

and begins with ξ = −M (x − x̄): what starts deviate in is x alone. It is a model like any other, in
the states (x, ξ), whose command is the feed-forward ū.

From which starts a closed loop recovers: its runs, and for an LQR sets that are proved.
"""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from trms_cli.controllers.controller import ControlSetup
from trms_cli.controllers.lqr import Lqr, Regulator
from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.models.model import Model, Signal
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.attraction.region import (
    AttractionRegion,
    ConfidenceShare,
    RegionRequest,
    StartSet,
    attraction_region,
    require_states,
    share_of,
)
from trms_cli.stability.attraction.system import around, require_attractive
from trms_cli.stability.closed_loop import run_loop
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts, Subject


@dataclass(frozen=True)
class LinearLaw:
    """The law at an equilibrium."""

    regulator: Regulator
    period: float  #: Control period T, s
    point: OperatingPoint  #: x̄ and ū of the rig
    #: (n_r,) array; ξ at the start with x = x̄, rad s: not zero where the rig rests at another
    #: command than the controller's model of it does
    start: FloatArray


def linear_law(model: Model, loop: LoopParts, point: OperatingPoint) -> LinearLaw | None:
    """The law of an LQR loop; None for other controllers, or where rig and belief differ in states.

    Raises ConfigurationError if the controller cannot be designed.
    """
    controller = loop.controller
    if not isinstance(controller, Lqr) or model.state_names != loop.model.state_names:
        return None
    period = controller.sample_time or loop.sample_time
    state = controller.init(ControlSetup(loop.model, period, point.u))
    law = state.regulator
    if law.K.shape[1] != model.n_x:
        return None
    target = state.steady.solve(point.x[state.rows])
    if not target.converged:
        return None
    away = point.x - target.x
    # At rest the integral makes up for what the feed-forward lacks.
    resting = np.linalg.lstsq(law.K_i, target.u - point.u - law.K @ away, rcond=None)[0]
    return LinearLaw(law, period, point, -law.M @ away - resting)


class LinearLawLoop(Model):
    """The closed loop as a model; commands stay within the limits if it is saturated."""

    def __init__(self, base: Model, law: LinearLaw, *, saturated: bool = True) -> None:
        self._base, self._law, self._saturated = base, law, saturated
        self.take_over(base)
        self.name = f"{base.name} with lqr"
        added = (Signal(f"xi_{name}", "rad s", f"integral of {name}") for name in base.controlled)
        self.states = (*base.states, *added)

    @property
    def point(self) -> OperatingPoint:
        """The equilibrium in (x, ξ)."""
        rest = self._law.point
        return OperatingPoint(np.concatenate([rest.x, np.zeros(len(self.controlled))]), rest.u)

    @property
    def gain(self) -> FloatArray:
        """(K, K_i), (n_u, n_x + n_r)."""
        return np.hstack([self._law.regulator.K, self._law.regulator.K_i])

    def starts(self) -> tuple[FloatArray, FloatArray]:
        """L, o with y = L (x − x̄) + o at the start, (n, n_x) and (n,)."""
        n = self._base.n_x
        matrix = np.vstack([np.eye(n), -self._law.regulator.M])
        return matrix, np.concatenate([np.zeros(n), self._law.start])

    def rest(self) -> FloatArray:
        return np.concatenate([self._base.rest(), np.zeros(len(self.controlled))])

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        n, point = self._base.n_x, self._law.point
        away = ca.vertcat(x[:n] - ca.DM(point.x), x[n:])
        command = u - ca.mtimes(ca.DM(self.gain), away)
        applied_command = command
        if self._saturated:
            lower, upper = self._base.input_bounds()
            applied_command = ca.fmin(ca.fmax(command, ca.DM(lower)), ca.DM(upper))
        rows = [self._base.state_index(name) for name in self.controlled]
        drift = ca.vertcat(*(away[row] for row in rows))
        if self._saturated:
            back = self._law.regulator.unwind / self._law.period
            drift += ca.mtimes(ca.DM(back), command - applied_command)
        return ca.vertcat(self._base.dynamics(x[:n], applied_command, p, w), drift)

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        return self._base.measurement(x[: self._base.n_x], u, p)


#: s, of a run where none is given.
_DURATION = 20.0
#: Share of a run, at its end, in which the angles must stay where they belong.
_END = 0.1
#: Starts in a proved set from which the loop itself is run.
_INSIDE = 8


@dataclass(frozen=True)
class LoopStarts:
    """Runs of the loop."""

    d: FloatArray  #: (n, m) array; starts, as deviations
    recovered: BoolArray  #: (n,) bool

    @property
    def count(self) -> int:
        """Of those that recovered."""
        return int(self.recovered.sum())

    @property
    def share(self) -> ConfidenceShare:
        return share_of(self.count, len(self.recovered))


@dataclass(frozen=True)
class LoopRegion:
    """From which starts a loop recovers."""

    subject: Subject
    point: OperatingPoint
    states: tuple[str, ...]  #: In which starts deviate
    box: FloatArray  #: (m,) array; half-widths
    duration: float  #: s, of a run
    tolerance: float  #: rad
    runs: LoopStarts  #: From random starts in the box
    region: AttractionRegion | None  #: Of the law as equations; None for any other than an LQR's
    inside: LoopStarts | None  #: Runs from starts in the largest proved set

    @property
    def controller(self) -> str:
        return self.subject.require_loop("").names.get("controller", "the controller")


def loop_region(
    subject: Subject, point: OperatingPoint, request: RegionRequest, tell: Tell
) -> LoopRegion:
    """The region of a loop: by simulation, and by proof where the law is an LQR's.

    Raises TrmsError if the loop is unstable around the point, or a name is no state.
    """
    model, loop = subject.model, subject.require_loop("study=region_of_attraction")
    requested_states = () if request.states in (None, "all") else tuple(request.states or ())
    deviating_states = requested_states or _deviating(model)
    require_states(
        [n for n in deviating_states if n not in model.state_names],
        model.state_names,
        "study.states",
    )
    require_states(request.box, deviating_states, "study.box")
    box = np.array([request.box.get(n, _half_width(model, point, n)) for n in deviating_states])
    duration = request.duration or _DURATION
    law = linear_law(model, loop, point)
    region = None
    if law is not None:
        closed, free = LinearLawLoop(model, law), LinearLawLoop(model, law, saturated=False)
        system = around(closed, closed.point)
        require_attractive(system)
        matrix, offset = closed.starts()
        positions = list(system.positions)
        columns = [model.state_index(name) for name in deviating_states]
        starts = StartSet(deviating_states, matrix[np.ix_(positions, columns)], offset[positions])
        # Rows with |row · y| < 1 where no command is at a limit.
        lower, upper = model.input_bounds()
        rows_of_limits = closed.gain / np.minimum(upper - point.u, point.u - lower)[:, None]
        linear = around(free, free.point), rows_of_limits[:, positions]
        reduced_request = replace(request, box={}, duration=None)
        region = attraction_region(
            system, reduced_request, tell, starts=starts, linear_inside=linear, box=box
        )
    random = np.random.default_rng(3)
    rows = [model.state_index(name) for name in model.controlled]

    def runs_from(d: FloatArray) -> LoopStarts:
        recovered = np.zeros(len(d), dtype=bool)
        for k, start in enumerate(d):
            tell(f"run {k + 1} of {len(d)}")
            offset = dict(zip(deviating_states, start.tolist(), strict=True))
            run = run_loop(model, loop, point, duration, offset=offset)
            tail = run.x[-max(1, int(_END * len(run.x))) :, rows]
            away = np.abs(tail - point.x[rows])
            # A comparison with what is not a number is false.
            recovered[k] = not run.stop_reason and bool(np.all(away <= request.tolerance))
        return LoopStarts(d, recovered)

    runs = runs_from(random.uniform(-1.0, 1.0, (request.loop_starts, len(deviating_states))) * box)
    best = None if region is None else region.largest
    inside = None
    if region is not None and best is not None:
        samples = random.uniform(-1.0, 1.0, (200_000, len(deviating_states))) * box
        proved = samples[best.estimate.contains(region.starts.of(samples))][:_INSIDE]
        inside = runs_from(proved) if len(proved) else None
    return LoopRegion(
        subject, point, deviating_states, box, duration, request.tolerance, runs, region, inside
    )


def _deviating(model: Model) -> tuple[str, ...]:
    """Both angles, or the one angle and its rate."""
    if len(model.controlled) > 1:
        return tuple(model.controlled)
    angle = model.controlled[0]
    rate = "S" + angle.removeprefix("alpha")
    return (angle, rate) if rate in model.state_names else (angle,)


def _half_width(model: Model, point: OperatingPoint, name: str) -> float:
    """1 rad, but not beyond a stop; 1 rad/s; a fifth of a rotor's speed."""
    stop = model.stops.get(name)
    value = abs(point.value(model, name))
    if stop is not None and stop > value:
        return min(1.0, stop - value)
    return max(1.0, 0.2 * value)
