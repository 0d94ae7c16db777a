"""The loop closed by the LQR law in continuous time, with its integral and its saturation.

The sampled law (:mod:`trms_cli.controllers.lqr`) with a state that is known and a reference that
does not move reads, for short periods,

    v = ū − K (x − x̄) − K_i ξ        u = v within the limits
    ξ̇ = angles − reference + (unwind/T) (v − u)

and begins with ξ = −M (x − x̄): what starts deviate in is x alone. It is a model like any other, in
the states (x, ξ), whose command is the feed-forward ū.

From which starts a closed loop recovers: its runs, and for an LQR sets that are proved.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.controllers.controller import ControlSetup
from trms_cli.controllers.lqr import Lqr, Regulator
from trms_cli.core.chart import Axis, Chart, Mark, Panel, Points
from trms_cli.core.findings import Block, Findings, Judged, Section, Table
from trms_cli.models.model import Model, Signal
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.attraction import report
from trms_cli.stability.attraction.region import (
    AttractionRegion,
    RegionOptions,
    StartSet,
    attraction_region,
    plane_axes,
    require_states,
)
from trms_cli.stability.attraction.simulation import ConfidenceShare, share_of
from trms_cli.stability.attraction.system import around, require_attractive
from trms_cli.stability.closed_loop import run_loop
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts, Subject

FloatArray = npt.NDArray[np.float64]


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
        self.name = f"{base.name} with lqr"
        added = (Signal(f"xi_{name}", "rad s", f"integral of {name}") for name in base.controlled)
        self.states = (*base.states, *added)
        self.inputs, self.outputs, self.disturbances = base.inputs, base.outputs, base.disturbances
        self.parameters, self.controlled = base.parameters, base.controlled
        self.input_limits, self.stops = base.input_limits, base.stops
        self.axes, self.rotors, self.stiff = base.axes, base.rotors, base.stiff

    @property
    def point(self) -> OperatingPoint:
        """The equilibrium in (x, ξ)."""
        rest = self._law.point
        return OperatingPoint(np.concatenate([rest.x, np.zeros(len(self.controlled))]), rest.u)

    @property
    def gain(self) -> FloatArray:
        """(K, K_i), (n_u, n_x + n_r)."""
        return np.hstack([self._law.regulator.K, self._law.regulator.K_i])

    def unsaturated_rows(self) -> FloatArray:
        """Rows with \\|row · y\\| < 1 where no command is at a limit, (n_u, n)."""
        lower, upper = self._base.input_bounds()
        room = np.minimum(upper - self._law.point.u, self._law.point.u - lower)
        return np.asarray(self.gain / room[:, None])

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
        wanted = u - ca.mtimes(ca.DM(self.gain), away)
        given = wanted
        if self._saturated:
            lower, upper = self._base.input_bounds()
            given = ca.fmin(ca.fmax(wanted, ca.DM(lower)), ca.DM(upper))
        rows = [self._base.state_index(name) for name in self.controlled]
        drift = ca.vertcat(*(away[row] for row in rows))
        if self._saturated:
            back = self._law.regulator.unwind / self._law.period
            drift += ca.mtimes(ca.DM(back), wanted - given)
        return ca.vertcat(self._base.dynamics(x[:n], given, p, w), drift)

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
    recovered: npt.NDArray[np.bool_]  #: (n,) bool

    @property
    def share(self) -> ConfidenceShare:
        return share_of(int(self.recovered.sum()), len(self.recovered))


def loop_findings(
    subject: Subject,
    point: OperatingPoint,
    options: RegionOptions,
    chosen: Sequence[str],
    count: int,
    tolerance: float,
    tell: Tell,
    title: str,
) -> Findings:
    """The findings for a loop: by simulation, and by proof where the law is an LQR's.

    Raises TrmsError if the loop is unstable around the point, or a name is no state.
    """
    model, loop = subject.model, subject.require_loop("study=region_of_attraction")
    known = chosen or _deviating(subject)
    require_states(
        [n for n in known if n not in model.state_names], model.state_names, "study.states"
    )
    require_states(options.box, known, "study.box")
    box = np.array([options.box.get(n, _half_width(subject, point, n)) for n in known])
    duration = options.duration or _DURATION
    law = linear_law(model, loop, point)
    found = None
    if law is not None:
        found = _by_law(subject, law, tuple(known), box, options, tell)
    random = np.random.default_rng(3)
    d = random.uniform(-1.0, 1.0, (count, len(known))) * box
    runs = _runs(subject, point, known, d, duration, tolerance, tell)
    inside = None
    if found is not None:
        best = report.largest(found)
        if best is not None:
            drawn = random.uniform(-1.0, 1.0, (200_000, len(known))) * box
            proved = drawn[best.estimate.contains(found.starts.of(drawn))][:_INSIDE]
            if len(proved):
                inside = _runs(subject, point, known, proved, duration, tolerance, tell)
    return _told(
        subject, point, known, box, options, runs, inside, found, duration, tolerance, title
    )


def _by_law(
    subject: Subject,
    law: LinearLaw,
    known: tuple[str, ...],
    box: FloatArray,
    options: RegionOptions,
    tell: Tell,
) -> AttractionRegion:
    loop = LinearLawLoop(subject.model, law)
    system = around(loop, loop.point)
    require_attractive(system)
    matrix, offset = loop.starts()
    columns = [subject.model.state_index(name) for name in known]
    kept = list(system.kept)
    starts = StartSet(known, matrix[np.ix_(kept, columns)], offset[kept])
    free = LinearLawLoop(subject.model, law, saturated=False)
    rows = loop.unsaturated_rows()[:, kept]
    return attraction_region(
        system,
        replace(options, box={}, duration=None),
        tell,
        starts=starts,
        linear_inside=(around(free, free.point), rows),
        box=box,
    )


def _deviating(subject: Subject) -> tuple[str, ...]:
    """Both angles, or the one angle and its rate."""
    model = subject.model
    if len(model.controlled) > 1:
        return tuple(model.controlled)
    angle = model.controlled[0]
    rate = "S" + angle.removeprefix("alpha")
    return (angle, rate) if rate in model.state_names else (angle,)


def _half_width(subject: Subject, point: OperatingPoint, name: str) -> float:
    """1 rad, but not beyond a stop; 1 rad/s; a fifth of a rotor's speed."""
    index = subject.model.state_index(name)
    stop = subject.model.stops.get(name)
    value = abs(float(point.x[index]))
    if stop is not None and stop > value:
        return min(1.0, stop - value)
    return max(1.0, 0.2 * value)


def _runs(
    subject: Subject,
    point: OperatingPoint,
    known: Sequence[str],
    d: FloatArray,
    duration: float,
    tolerance: float,
    tell: Tell,
) -> LoopStarts:
    model, loop = subject.model, subject.require_loop("study=region_of_attraction")
    rows = [model.state_index(name) for name in model.controlled]
    recovered = np.zeros(len(d), dtype=bool)
    for k, start in enumerate(d):
        tell(f"run {k + 1} of {len(d)}")
        run = run_loop(
            model, loop, point, duration, offset=dict(zip(known, start.tolist(), strict=True))
        )
        tail = run.x[-max(1, int(_END * len(run.x))) :, rows]
        away = np.abs(tail - point.x[rows])
        # A comparison with what is not a number is false.
        recovered[k] = not run.ended and bool(np.all(away <= tolerance))
    return LoopStarts(d, recovered)


def _told(
    subject: Subject,
    point: OperatingPoint,
    known: Sequence[str],
    box: FloatArray,
    options: RegionOptions,
    runs: LoopStarts,
    inside: LoopStarts | None,
    found: AttractionRegion | None,
    duration: float,
    tolerance: float,
    title: str,
) -> Findings:
    model, loop = subject.model, subject.require_loop("study=region_of_attraction")
    name = loop.names.get("controller", "the controller")
    widths = ", ".join(f"{n} ±{value:.3g}" for n, value in zip(known, box, strict=True))
    said = [
        f"{name} recovered from {int(runs.recovered.sum())} of {len(runs.recovered)} random starts "
        f"within {widths} around {point.words(model)} in {duration:g} s: "
        f"{report.percent(runs.share)} of the box."
    ]
    notes = [
        "Runs of the loop start with the observer and the controller at rest; mechanical stops do "
        "not act."
    ]
    blocks: list[Block] = []
    if found is not None:
        said += _law_lead(found, inside)
        blocks = [*report.sections(found)[0].blocks]
        notes += [
            "Proofs are about the LQR law in continuous time, with its integral and saturation and "
            "a state that is known; the runs are the loop itself, sampled, with its observer.",
            *report.warnings(found),
        ]
    else:
        notes.append(
            f"Nothing is proved for {name}: only an LQR's law can be written as equations here "
            "(and only where the rig has the states that the controller believes in). The share "
            "is an estimate from runs."
        )
    section = Section(
        "Runs of the loop",
        (
            f"A start is recovered if all controlled angles stay within {tolerance:g} rad of where "
            f"they belong over the last tenth of {duration:g} s.",
        ),
        [*_run_blocks(subject, point, known, box, options, runs), _run_table(runs, inside)],
    )
    proofs = (
        [Section("Sets proved for the law", report.METHOD, blocks)] if found is not None else []
    )
    return Findings(title, said, [section, *proofs], _data(known, box, runs, inside, found), notes)


def _law_lead(found: AttractionRegion, inside: LoopStarts | None) -> list[str]:
    said = report.lead(found)
    if inside is not None:
        lost = int((~inside.recovered).sum())
        said.append(
            f"Of {len(inside.recovered)} runs of the loop itself from starts in the proved set "
            f"{lost or 'none'} failed to recover."
        )
    return said


def _run_table(runs: LoopStarts, inside: LoopStarts | None) -> Table:
    rows = [
        (
            "random in the box",
            len(runs.recovered),
            int(runs.recovered.sum()),
            report.percent(runs.share),
        )
    ]
    table: list[Sequence[Any]] = [*rows]
    if inside is not None:
        good = bool(inside.recovered.all())
        table.append(
            (
                "in the proved set",
                len(inside.recovered),
                Judged(int(inside.recovered.sum()), "good" if good else "bad"),
                report.percent(inside.share),
            )
        )
    return Table(
        ("starts", "runs", "recovered", "share (95 % confidence)"),
        table,
        "Runs of the loop itself.",
    )


def _run_blocks(
    subject: Subject,
    point: OperatingPoint,
    known: Sequence[str],
    box: FloatArray,
    options: RegionOptions,
    runs: LoopStarts,
) -> list[Chart]:
    model = subject.model
    signals = [model.states[model.state_index(name)] for name in known]
    i, j = plane_axes(list(known), [s.unit for s in signals], options.plane)
    if not options.plane and len(known) == 2:
        i, j = 0, 1
    if i == j:
        return []
    origin = [float(point.x[model.state_index(n)]) for n in known]
    marks: list[Mark] = []
    good, bad = (_of(origin, runs.d[kind]) for kind in (runs.recovered, ~runs.recovered))
    if len(good):
        marks.append(Points(good[:, i], good[:, j], "recovers", "dot", "blue"))
    if len(bad):
        marks.append(Points(bad[:, i], bad[:, j], "does not", "cross", "alarm"))
    marks.append(Points([origin[i]], [origin[j]], "equilibrium", "stable", "ink"))
    x, y = (
        Axis(known[k], signals[k].unit, (origin[k] - 1.05 * box[k], origin[k] + 1.05 * box[k]))
        for k in (i, j)
    )
    return [
        Chart(
            "recovered_starts",
            [Panel(x, y, marks)],
            f"Starts from which the loop of {subject.require_loop('').names.get('controller', '')} "
            f"comes back to {point.words(model)}.",
            columns=1,
            width=4.8,
            height=4.2,
        )
    ]


def _of(origin: Sequence[float], d: FloatArray) -> FloatArray:
    return np.asarray(np.array(origin) + d)


def _data(
    known: Sequence[str],
    box: FloatArray,
    runs: LoopStarts,
    inside: LoopStarts | None,
    found: AttractionRegion | None,
) -> Mapping[str, Any]:
    return {
        "runs": {
            "states": list(known),
            "box": dict(zip(known, box.tolist(), strict=True)),
            "starts": runs.d.tolist(),
            "recovered": [bool(v) for v in runs.recovered],
            "share": report.share_data(runs.share),
        },
        "runs_in_proved_set": None
        if inside is None
        else {"starts": inside.d.tolist(), "recovered": [bool(v) for v in inside.recovered]},
        "law": None if found is None else report.results(found),
    }
