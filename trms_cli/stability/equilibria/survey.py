"""All equilibria over one input: curves, what is special on them, and the proof beside them.

Of a curve ``y = (z, λ)`` are the unknowns z of :class:`RestSystem` and the varied input λ. On a
switch (a cable that is stiffer to one side) ∂f/∂x is the mean of both sides, which small swings
across it see; :mod:`trms_cli.stability.local.linear` tells why. All studies take the same.

Over two inputs at once only the stable ones are looked for, from those over the first.

Rest, hover and other equilibria have a name, and physical quantities there. Dry friction holds an
axis in a band of angles around them. Friction acts as impulses, which are no part of f(x, u). What
it can hold is read from the impulse itself: an axis at rest is pushed by a torque T for a moment,
and what the impulse takes from the rate that it would gain is the break-away torque,

    F = T (1 − rate with friction / rate without).

Every angle is held at which the static torques leave no more than F: the equilibria with a constant
torque between −F and F, which one curve of equilibria over that torque passes through.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import casadi as ca
import numpy as np
from scipy.stats import qmc

from trms_cli.core.arrays import ComplexArray, FloatArray
from trms_cli.core.errors import ConfigurationError, ModelError, TrmsError
from trms_cli.core.plugins import require_known
from trms_cli.models.continuation import ImplicitCurve, SolutionCurve
from trms_cli.models.model import Model, names
from trms_cli.models.operating_point import OperatingPoint, operating_point, refine_operating_point
from trms_cli.models.rest import static_motor_command
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.equilibria.proof import Proof, Prover, RangePiece, over_range
from trms_cli.stability.equilibria.rest_system import RestSystem, rest_system
from trms_cli.stability.intervals.interval import Interval
from trms_cli.stability.local.linear import Linear, Verdict, modes_of_matrix, parts_of
from trms_cli.stability.study import Tell

#: 1/s: growth below this is rounding (a free yaw neither grows nor returns).
GROWTH = 1e-7
_SEED = 20260


@dataclass(frozen=True)
class EquilibriumPoint(OperatingPoint):
    """An equilibrium with its stability."""

    eigenvalues: ComplexArray  #: (n_x,) complex array; of ∂f/∂x there, rightmost first
    unstable: int  #: How many of them grow
    verdict: Verdict  #: ``marginal`` where none grows and one neither grows nor dies out


class CurveEquations(ImplicitCurve):
    """``g(z, λ) = 0`` with the other inputs and torques given, v (n_v,); λ is that at ``varied``.

    ``box``, ``scale``: (n,), of z; ``bounds``: of λ.
    """

    def __init__(
        self,
        system: RestSystem,
        varied: int,
        v: FloatArray,
        box: Interval,
        scale: FloatArray,
        bounds: tuple[float, float],
    ) -> None:
        self.system, self.varied = system, varied
        y = ca.SX.sym("y", system.n + 1)
        inputs = ca.SX(ca.DM(v))
        inputs[varied] = y[system.n]
        p = ca.DM(system.model.parameters.values)
        super().__init__(
            system.residual(y[: system.n], inputs, p),
            y,
            system.unknowns,
            np.append(box.lower, bounds[0]),
            np.append(box.upper, bounds[1]),
            np.append(scale, 0.5 * (bounds[1] - bounds[0])),
        )
        self._point = ca.Function("point", [y], list(system.point(y[: system.n], inputs, p)))

    def point(self, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """x, u and what reaches the motors."""
        x, u, reached = self._point(y)
        return np.array(x)[:, 0], np.array(u)[:, 0], np.array(reached)[:, 0]

    def stability(self, y: FloatArray) -> EquilibriumPoint:
        """A point of a curve with its eigenvalues; y is (n + 1,)."""
        return equilibrium_point(self.system.linear, *self.point(y))

    def starts(self, inputs: FloatArray, count: int) -> list[FloatArray]:
        """Equilibria from many starts, at each of some inputs (m,)."""
        low = np.where(np.isfinite(self.lower), self.lower, -4.0 * self.scale)[:-1]
        high = np.where(np.isfinite(self.upper), self.upper, 4.0 * self.scale)[:-1]
        points: list[FloatArray] = []
        shares = qmc.Sobol(max(self.n, 1), seed=_SEED).random(count)
        for value in inputs:
            for share in shares:
                guess = np.append(low + share[: self.n] * (high - low), value)
                y = self.pinned(guess, self.n, float(value))
                if y is None or not self.inside(y):
                    continue
                if not any(self.same(y, other) for other in points):
                    points.append(y)
        return points


def equilibrium_point(
    linear: Linear, x: FloatArray, u: FloatArray, reached: FloatArray
) -> EquilibriumPoint:
    """An equilibrium with its eigenvalues; ``reached``, (n_u,), is what of u reaches the motors."""
    with np.errstate(invalid="ignore"):
        slopes = linear.a(x, reached)
    if not np.all(np.isfinite(slopes)):
        return EquilibriumPoint(x, u, np.full(len(x), np.nan, dtype=complex), 0, "marginal")
    values = np.linalg.eigvals(slopes).astype(complex)
    values = values[np.argsort(-values.real, kind="stable")]
    unstable, staying = (int(np.sum(values.real > side)) for side in (GROWTH, -GROWTH))
    verdict: Verdict = "unstable" if unstable else "marginal" if staying else "stable"
    if not unstable and staying > 1:
        # Two on the axis may grow as t: their eigenvectors decide.
        verdict = modes_of_matrix(slopes, parts_of(linear.model)).verdict
    return EquilibriumPoint(x, u, values, unstable, verdict)


Kind = Literal["fold", "kink", "oscillation", "exchange", "crossing", "level", "zero"]

_BISECTIONS = 40
#: Scaled distance from a fold of the two nodes between which its own eigenvalue crosses.
_BESIDE = 1e-5


@dataclass(frozen=True)
class Landmark:
    """A special point of a curve."""

    #: ``fold``: the input has an extreme, to rounding. ``kink``: the same where the equations have
    #: a kink, between two points of the curve. ``oscillation``: a pair of eigenvalues crosses the
    #: imaginary axis (Hopf). ``exchange``: a real one does, away from a fold. ``crossing``: another
    #: curve may cross. ``level``: a controlled angle is zero. ``zero``: the input is.
    kind: Kind
    name: str  #: The angle of a level; empty otherwise
    y: FloatArray  #: (n + 1,) array; unknowns and the varied input
    at: EquilibriumPoint
    frequency: float | None = None  #: Hz, of an oscillation


def landmarks(
    equations: CurveEquations, curve: SolutionCurve, points: Sequence[EquilibriumPoint]
) -> list[Landmark]:
    """The special points of a curve, in order along it."""
    folds = _folds(equations, curve)
    marks = list(folds)
    kinks = [place for place, one in folds if one.kind == "kink"]
    for before, after in pairwise(_with_folds(equations, curve, points, folds)):
        more = after.at.unstable - before.at.unstable
        # At a fold one real eigenvalue crosses, between the two nodes beside it. Where a kink is
        # is not known as well.
        folding = abs(more) == 1 and before.beside and after.beside
        kinked = more % 2 == 1 and any(abs(place - before.place) <= 2 for place in kinks)
        if more != 0 and not folding and not kinked:
            marks.append((before.place, _change(equations, before.y, after.y, before.at)))
    for k in curve.crossings:
        if not any(abs(place - k) <= 2 for place, _ in marks):
            y = curve.y[k]
            marks.append((k, Landmark("crossing", "", y, equations.stability(y))))
    levels: list[tuple[Kind, str, FloatArray]] = []
    for index, signal in enumerate(equations.system.unknowns):
        controlled = signal.name in equations.system.model.controlled
        if controlled and float(np.ptp(curve.y[:, index])) > 1e-6:
            for y in equations.crossings_of(curve, 0.0, index):
                if not _stays(equations, curve, y, index):
                    levels.append(("level", signal.name, y))
    levels += [("zero", "", y) for y in equations.crossings_of(curve, 0.0)]
    for kind, name, y in levels:
        mark = Landmark(kind, name, y, equations.stability(y))
        marks.append((_place(equations, curve, y), mark))
    return [landmark for _, landmark in sorted(marks, key=lambda item: item[0])]


def _stays(equations: CurveEquations, curve: SolutionCurve, y: FloatArray, index: int) -> bool:
    """Whether a coordinate keeps its value around a point: in a dead zone it crosses nothing."""
    k = _place(equations, curve, y)
    around = curve.y[max(k - 1, 0) : k + 2, index] - y[index]
    return int(np.sum(np.abs(around) < 1e-9 * equations.scale[index])) >= 2


def _place(equations: CurveEquations, curve: SolutionCurve, y: FloatArray) -> int:
    return int(np.argmin(np.linalg.norm((curve.y - y) / equations.scale, axis=1)))


def _folds(equations: CurveEquations, curve: SolutionCurve) -> list[tuple[float, Landmark]]:
    steps = np.diff(curve.y[:, -1])
    folds: list[tuple[float, Landmark]] = []
    # The end of a curve may lie on its last point: a step of nothing turns nowhere.
    moving = np.flatnonzero(np.abs(steps) > 1e-12 * equations.scale[-1])
    for i, j in pairwise(moving):
        if steps[i] * steps[j] >= 0:
            continue
        near = curve.y[j]
        y = equations.fold(near)
        smooth = y is not None and equations.inside(y)
        point = y if smooth and y is not None else near
        kind: Kind = "fold" if smooth else "kink"
        place = _between(equations, curve, point, range(int(i), int(j) + 1)) if smooth else float(i)
        folds.append((place, Landmark(kind, "", point, equations.stability(point))))
    return folds


def _between(
    equations: CurveEquations, curve: SolutionCurve, y: FloatArray, parts: Iterable[int]
) -> float:
    """Where a point lies on some parts of a curve, as a position among its points."""
    places: list[tuple[float, float]] = []
    for k in parts:
        chord = (curve.y[k + 1] - curve.y[k]) / equations.scale
        away = (y - curve.y[k]) / equations.scale
        share = float(np.clip(away @ chord / max(float(chord @ chord), 1e-300), 0.0, 1.0))
        places.append((float(np.linalg.norm(away - share * chord)), k + share))
    return min(places)[1]


@dataclass(frozen=True)
class _Node:
    """A point of a curve, its position among the others, and whether it is one beside a fold."""

    place: float
    y: FloatArray
    at: EquilibriumPoint
    beside: bool = False


def _with_folds(
    equations: CurveEquations,
    curve: SolutionCurve,
    points: Sequence[EquilibriumPoint],
    folds: Sequence[tuple[float, Landmark]],
) -> list[_Node]:
    """The points of a curve, with more of them towards each fold on both sides.

    Where a real eigenvalue is near zero a pair often is, too: both may cross in one step.
    """
    nodes = [_Node(float(k), y, at) for k, (y, at) in enumerate(zip(curve.y, points, strict=True))]
    for place, fold in folds:
        if fold.kind != "fold":
            continue
        k = min(math.floor(place), len(curve.y) - 2)
        chord = (curve.y[k + 1] - curve.y[k]) / equations.scale
        along = equations.tangent(fold.y, chord)

        def offset(y: FloatArray, fold: Landmark = fold, along: FloatArray = along) -> float:
            return float((y - fold.y) / equations.scale @ along)

        nodes = [n for n in nodes if abs(n.place - place) > 2 or abs(offset(n.y)) > _BESIDE]
        for side, end in ((-1.0, curve.y[k]), (1.0, curve.y[k + 1])):
            size = _BESIDE
            while size == _BESIDE or size < side * offset(end):
                guess = fold.y + side * size * along * equations.scale
                y = equations.corrected(guess, along)
                if y is not None and equations.inside(y):
                    at = equations.stability(y)
                    where = _between(equations, curve, y, (k,))
                    nodes.append(_Node(where, y, at, beside=size == _BESIDE))
                size *= 2.0
    return sorted(nodes, key=lambda node: node.place)


def _change(
    equations: CurveEquations, before: FloatArray, after: FloatArray, first: EquilibriumPoint
) -> Landmark:
    """Where the number of growing motions changes between two points, by bisection."""
    chord = (after - before) / equations.scale
    along = chord / np.linalg.norm(chord)
    low, high = 0.0, 1.0
    y, at = before, first
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        here = equations.corrected(before + middle * (after - before), along)
        if here is None:
            break
        y, at = here, equations.stability(here)
        if at.unstable == first.unstable:
            low = middle
        else:
            high = middle
    # What grows next to nothing crosses the axis; what is free stays on it.
    moving = at.eigenvalues[np.argsort(np.abs(at.eigenvalues))[len(equations.system.free) :]]
    crossing = moving[np.argmin(np.abs(moving.real))]
    turning = abs(crossing.imag) > 1e-6
    frequency = abs(float(crossing.imag)) / (2.0 * math.pi) if turning else None
    return Landmark("oscillation" if turning else "exchange", "", y, at, frequency)


#: Inputs at which equilibria are looked for from many starts, and how many starts.
_INPUTS, _STARTS = 9, 16
#: Share of the range below which a part of it is no longer cut.
_RESOLUTION = 2e-4
#: Scaled distance within which a point of a curve is the equilibrium that was proved.
_SAME = 1e-6


@dataclass(frozen=True)
class SurveySetting:
    """What is varied, and what the rest is."""

    over: str  #: The varied input
    bounds: tuple[float, float]  #: Its range
    inputs: Mapping[str, float]  #: The other inputs, where they are given
    held_angles: Mapping[str, float]  #: Angles that are held by an input that follows, rad

    @property
    def fixed_values(self) -> dict[str, float]:
        """Inputs and angles that stay as they are."""
        return {**self.inputs, **self.held_angles}


@dataclass(frozen=True)
class SurveyCurve:
    """A curve with the stability of its points."""

    curve: SolutionCurve
    points: tuple[EquilibriumPoint, ...]  #: One for each point of the curve
    landmarks: tuple[Landmark, ...]

    def values(self, model: Model, name: str) -> FloatArray:
        """A state or command along it."""
        return np.array([point.value(model, name) for point in self.points])


@dataclass(frozen=True)
class ProofCheck:
    """A proof and the points of the curves at the same input."""

    input: float
    proof: Proof
    #: Of the curves, in the order of the proof's equilibria where they agree
    points: tuple[EquilibriumPoint, ...]
    #: Whether each proved equilibrium is on a curve, and each point of a curve in the bounds of an
    #: equilibrium, proved or undecided
    agree: bool


@dataclass(frozen=True)
class Survey:
    """All equilibria over one input."""

    setting: SurveySetting
    system: RestSystem
    equations: CurveEquations
    box: Interval  #: (n,), of the unknowns
    curves: tuple[SurveyCurve, ...]
    checks: tuple[ProofCheck, ...]
    pieces: tuple[RangePiece, ...]  #: Numbers over the whole range; empty if not asked for
    late: int  #: Curves that only the proof led to

    @property
    def model(self) -> Model:
        return self.system.model

    @property
    def landmarks(self) -> tuple[Landmark, ...]:
        return tuple(one for curve in self.curves for one in curve.landmarks)


def survey(
    model: Model,
    setting: SurveySetting,
    box: Mapping[str, Sequence[float]],
    proof_inputs: FloatArray,
    whole_range: bool,
    tell: Tell,
) -> Survey:
    """All equilibria of a model over one input; ``box`` bounds states where not as usual.

    Their number is proved at some inputs, (m,), and for each between them if that is asked for.
    Raises TrmsError for a setting or a box that the model does not allow.
    """
    inputs = {setting.over, *setting.inputs}
    system = rest_system(model, inputs, setting.held_angles)
    bounds, scale = bounds_of(system, box)
    v = np.zeros(len(system.knowns))
    for name, value in setting.inputs.items():
        v[system.known_index(name)] = value
    index = system.known_index(setting.over)
    equations = CurveEquations(system, index, v, bounds, scale, setting.bounds)

    tell(f"curves over {setting.over}")
    seeds = equations.starts(np.linspace(*setting.bounds, _INPUTS), _STARTS)
    curves = equations.curves_through(seeds)

    tell(f"proofs over {setting.over}")
    prover = Prover(system, bounds, scale)
    input_rows = np.tile(v, (len(proof_inputs), 1))
    input_rows[:, index] = proof_inputs
    proofs = prover.at(input_rows)
    curves, late = complete_curves(equations, curves, proofs)
    checks = tuple(
        _check(equations, curves, float(value), proof)
        for value, proof in zip(proof_inputs, proofs, strict=True)
    )
    surveyed = []
    for curve in curves:
        points = tuple(equations.stability(y) for y in curve.y)
        surveyed.append(SurveyCurve(curve, points, tuple(landmarks(equations, curve, points))))
    pieces: tuple[RangePiece, ...] = ()
    if whole_range:
        tell(f"proof for every {setting.over}")
        width = setting.bounds[1] - setting.bounds[0]
        pieces = over_range(prover, v, index, setting.bounds, _RESOLUTION * width)
    return Survey(setting, system, equations, bounds, tuple(surveyed), checks, pieces, late)


def complete_curves(
    equations: CurveEquations, curves: list[SolutionCurve], proofs: Sequence[Proof]
) -> tuple[list[SolutionCurve], int]:
    """The curves with those through proved equilibria that are on none, and how many those are."""
    late = 0
    for proof in proofs:
        value = float(proof.knowns.lower[equations.varied])
        for one in proof.proved:
            crossings = [y for curve in curves for y in equations.crossings_of(curve, value)]
            if any(_within(equations, y, one.z) for y in crossings):
                continue
            y = equations.pinned(np.append(one.z.middle, value), equations.n, value)
            if y is not None and equations.inside(y):
                curves = [*curves, equations.through(y)]
                late += 1
    return curves, late


def _within(equations: CurveEquations, y: FloatArray, z: Interval) -> bool:
    slack = _SAME * equations.scale[:-1]
    return bool(np.all((z.lower - slack <= y[:-1]) & (y[:-1] <= z.upper + slack)))


def _check(
    equations: CurveEquations, curves: Sequence[SolutionCurve], value: float, proof: Proof
) -> ProofCheck:
    crossings = [y for curve in curves for y in equations.crossings_of(curve, value)]
    ordered: list[FloatArray] = []
    agree = True
    for one in proof.enclosed:
        inside = [y for y in crossings if _within(equations, y, one.z)]
        agree &= len(inside) == 1 if one.unique else True
        ordered += inside
    agree &= all(any(_within(equations, y, one.z) for one in proof.enclosed) for y in crossings)
    points = tuple(equations.stability(y) for y in (ordered if agree else crossings))
    return ProofCheck(value, proof, points, agree)


def setting_of(
    model: Model, over: str, bounds: tuple[float, float], at: Mapping[str, float]
) -> SurveySetting:
    """The other inputs of a survey.

    Inputs of ``at`` have their value, the others zero. An angle of ``at`` is held by the input of
    its own rotor, unless that is what is varied. With nothing named the pitch is held level where a
    tail rotor is varied and nothing else asks for the main rotor's command.
    """
    own = {rotor.axis: rotor.input for rotor in model.rotors.values()}
    holder = {model.axes[axis].angle: own[axis] for axis in own if axis in model.axes}
    held_angles = {
        name: value for name, value in at.items() if name in holder and holder[name] != over
    }
    if not at and "pitch" in model.axes and "pitch" in own and over == own.get("yaw"):
        angle = model.axes["pitch"].angle
        if not rest_system(model, {over}).free:
            held_angles = {angle: 0.0}
    released = {holder[name] for name in held_angles}
    others = [name for name in names(model.inputs) if name not in (over, *released)]
    free = rest_system(model, {over}, held_angles)
    inputs = {n: float(at.get(n, 0.0)) for n in others if n not in free.released}
    return SurveySetting(over, bounds, inputs, held_angles)


#: rad, just within ±π/2: with the beam upright the yaw of some models answers to nothing at all.
UPRIGHT = 1.57
#: Random states and inputs at which an equation is tried.
_TRIED = 4


def bounds_of(
    system: RestSystem, requested_bounds: Mapping[str, Sequence[float]]
) -> tuple[Interval, FloatArray]:
    """Bounds of the unknowns, (n,) each, and the size of each that counts.

    A pitch reaches to its stop, at least to :data:`UPRIGHT`; another angle to its stop, or a half
    turn; a released input to its limit; all else has no bounds.

    Raises ConfigurationError for a name that is no state, or bounds that are none; ModelError if
    with the beam upright, within the bounds, an equation holds for whatever else.
    """
    model = system.model
    for name, bounds in requested_bounds.items():
        unknown = f"{name!r} is no state of model {model.name!r}"
        require_known(name, model.state_names, unknown, f"study.box.{name}")
        if len(bounds) != 2 or not bounds[0] < bounds[1]:
            raise ConfigurationError(
                f"{list(bounds)} are no bounds",
                where=f"study.box.{name}",
                remedy="give a lower and a higher one, as [-1.57, 1.57]",
            )
    lower, upper = [], []
    for signal in system.unknowns:
        low, high = (
            requested_bounds[signal.name]
            if signal.name in requested_bounds
            else usual_bounds(model, signal.name)
        )
        lower.append(float(low))
        upper.append(float(high))
    box = Interval.of(lower, upper)
    _require_yaw(system, box)
    width = np.where(np.isfinite(box.width), box.width, np.nan)
    rest = np.array([100.0 if signal.unit == "rad/s" else 1.0 for signal in system.unknowns])
    return box, np.where(np.isnan(width), rest, np.minimum(0.5 * width, 10.0))


def _require_yaw(system: RestSystem, box: Interval) -> None:
    """ModelError if with the beam upright, in the box, an equation holds for whatever else."""
    model = system.model
    pitch = model.axes["pitch"].angle if "pitch" in model.axes else ""
    if pitch not in names(system.unknowns):
        return
    index = names(system.unknowns).index(pitch)
    p, random = model.parameters.values, np.random.default_rng(0)
    for upright in (-0.5 * math.pi, 0.5 * math.pi):
        if not box.lower[index] < upright < box.upper[index]:
            continue
        z = random.uniform(-1.0, 1.0, (system.n, _TRIED))
        v = random.uniform(-1.0, 1.0, (len(system.knowns), _TRIED))
        usual = np.abs(np.array(system.residual(z, v, p))).max(axis=1)
        z[index] = upright
        there = np.abs(np.array(system.residual(z, v, p))).max(axis=1)
        if np.any((usual > 0) & (there <= 1e-12 * usual)):
            raise ModelError(
                f"the equations of model {model.name!r} are singular in the box: with the beam "
                f"upright ({pitch} = {upright:.4g} rad) nothing turns it in yaw",
                where=f"study.box.{pitch}",
                remedy=f"stay within ±{UPRIGHT} rad, as study.box.{pitch}=[-{UPRIGHT},{UPRIGHT}]",
            )


def usual_bounds(model: Model, name: str) -> tuple[float, float]:
    """Bounds of an unknown that nothing is asked of."""
    pitch = model.axes["pitch"].angle if "pitch" in model.axes else ""
    stop, half = model.stops.get(name, math.inf), math.inf
    if name in names(model.inputs):
        half = model.input_limits[name]
    elif name == pitch:
        half = max(stop, UPRIGHT) if math.isfinite(stop) else UPRIGHT
    elif any(axis.angle == name for axis in model.axes.values()):
        half = stop if math.isfinite(stop) else math.pi
    return -half, half


_MAP_POINTS = 41


@dataclass(frozen=True)
class EquilibriumMap:
    """Controlled angles of the stable equilibria over two inputs."""

    first: FloatArray  #: (n,), (m,) arrays; the inputs
    second: FloatArray  #: (n,), (m,) arrays; the inputs
    #: dict of str to (m, n) array; rad; NaN where there is no stable equilibrium in the box
    angles: dict[str, FloatArray]


def equilibrium_map(model: Model, along: Survey, second: str) -> EquilibriumMap | None:
    """From the stable points along the first input, by steps of the second; None where not so."""
    over = along.setting.over
    if along.system.free or along.system.released or along.setting.held_angles:
        return None
    system = rest_system(model, {over, second})
    limit = model.input_limits[second]
    start = along.setting.inputs.get(second, 0.0)
    first = np.linspace(*along.setting.bounds, _MAP_POINTS)
    others = np.linspace(-limit, limit, _MAP_POINTS)
    rows = [model.state_index(name) for name in model.controlled]
    angles = np.full((len(rows), _MAP_POINTS, _MAP_POINTS), np.nan)
    box, scale = bounds_of(system, {})
    for column, value in enumerate(first):
        crossings = [
            y for one in along.curves for y in along.equations.crossings_of(one.curve, value)
        ]
        stable = [p for p in (along.equations.stability(y) for y in crossings) if not p.unstable]
        if not stable:
            continue
        v = np.zeros(len(system.knowns))
        v[system.known_index(over)] = value
        bounds = (-limit, limit)
        equations = CurveEquations(system, system.known_index(second), v, box, scale, bounds)
        x = stable[0].x
        seed = np.array([*(x[model.state_index(s.name)] for s in system.unknowns), start])
        for side in (others[others >= start], others[others < start][::-1]):
            y: FloatArray | None = seed
            for at in side:
                y = equations.pinned(y, equations.n, float(at)) if y is not None else None
                if y is None or not equations.inside(y):
                    break
                here = equations.stability(y)
                if not here.unstable:
                    row = int(np.argmin(np.abs(others - at)))
                    angles[:, row, column] = here.x[rows]
    return EquilibriumMap(first, others, dict(zip(model.controlled, angles, strict=True)))


_NEAR_ZERO = 1e-3  # V
_SAME_ANGLE = 1e-6  # rad


@dataclass(frozen=True)
class NamedPoint(EquilibriumPoint):
    """An equilibrium with a name."""

    name: str
    #: What the model names: thrusts (N), currents (A), torques (N m), inertias (kg m²)…
    quantities: Mapping[str, float]
    bands: tuple[FrictionBand, ...]  #: Where dry friction holds the axes around it


def named_points(
    model: Model, more: Mapping[str, Mapping[str, float]]
) -> tuple[list[NamedPoint], list[str]]:
    """Rest, hover, and what is asked for; and why the first two may be missing.

    ``more``: angles or commands by name, as of :func:`operating_point`. Raises TrmsError for a
    point that is asked for and does not exist.
    """
    points: list[NamedPoint] = []
    missing: list[str] = []
    usual: dict[str, Mapping[str, float]] = {"rest": {}}
    if "pitch" in model.axes:
        usual["hover"] = dict.fromkeys(model.controlled, 0.0)
    for name, at in usual.items():
        # A rig without command that rests with all controlled angles at zero: that is its hover.
        level = points and all(abs(points[0].value(model, n)) < 1e-9 for n in model.controlled)
        if name in more or (name == "hover" and level):
            continue
        try:
            points.append(_named_point(model, name, operating_point(model, at)))
        except TrmsError as error:
            missing.append(
                f"no {name}: {error.problem}" + (f" ({error.remedy})" if error.remedy else "")
            )
    for name, at in more.items():
        points.append(
            _named_point(model, name, operating_point(model, at, f"study.special.{name}"))
        )
    return points, missing


def _named_point(model: Model, name: str, point: OperatingPoint) -> NamedPoint:
    u, p = ca.SX.sym("u", model.n_u), ca.SX.sym("p", len(model.parameters))
    path = ca.Function("path", [u, p], [static_motor_command(model, u, p)])
    field = VectorField(model)

    def arrives(commands: FloatArray) -> FloatArray:
        return np.array(path(commands, field.parameters))[:, 0]

    # Commands of exactly zero where that changes no angle: as of :func:`operating_point`, for
    # commands that pass a dead zone on their way too.
    u = np.where(np.abs(point.u) < _NEAR_ZERO, 0.0, point.u)
    if not np.array_equal(u, point.u):
        settled = refine_operating_point(field, point.x, arrives(u))
        rows = [model.state_index(name) for name in model.controlled]
        if settled is not None and np.abs(settled - point.x)[rows].max() <= _SAME_ANGLE:
            point = OperatingPoint(settled, u)
    reached = arrives(point.u)
    at = equilibrium_point(Linear(model), point.x, point.u, reached)
    x, u, p, _ = model.symbols()
    expressions = model.quantities(x, u, p)
    evaluate = ca.Function("quantities", [x, u, p], [ca.vertcat(*expressions.values())])
    numbers = np.array(evaluate(point.x, reached, field.parameters)).ravel().tolist()
    return NamedPoint(
        **vars(at),
        name=name,
        quantities=dict(zip(expressions, numbers, strict=False)),
        bands=tuple(friction_bands(model, point.x, point.u, reached)),
    )


#: s, of the push: so short that no rate comes near the velocities on which friction depends.
_MOMENTS = (1e-7, 1e-6)
_PUSH = 1.0  # N m
_LEAST = 1e-9  # N m


@dataclass(frozen=True)
class FrictionBand:
    """Angles at which friction holds an axis."""

    axis: str
    angle: str  #: The state
    torque: float  #: F, N m
    #: ``lower``, ``upper``: rad; None where nothing else acts on the angle: any will do
    lower: float | None
    upper: float | None
    #: Where the angle is free: the input that balances it, and between what values it is held
    command: tuple[str, float, float] | None = None


def breakaway(model: Model, x: FloatArray, u: FloatArray, axis: str) -> float:
    """The torque that dry friction holds at rest, N m; 0 without any, and for one that creeps.

    ``x``: (n_x,); an equilibrium. ``u``: (n_u,); what reaches the motors.
    """
    short, longer = (_friction_torque(model, x, u, axis, moment) for moment in _MOMENTS)
    # What resists in proportion to the rate takes ten times as much in ten times the time.
    return longer if longer > _LEAST and abs(longer - short) < 0.1 * longer else 0.0


def _friction_torque(model: Model, x: FloatArray, u: FloatArray, axis: str, moment: float) -> float:
    symbols = model.symbols()
    impulse = ca.Function("impulse", list(symbols), [model.impulse(*symbols, moment)])
    field = VectorField(model)
    p, w = field.parameters, np.zeros(model.n_w)
    push = w.copy()
    push[names(model.disturbances).index(model.axes[axis].moment)] = _PUSH
    row = model.state_index(model.axes[axis].angle)

    def rate(state: FloatArray) -> float:
        return float(np.array(field.function(state, u, p, w))[row, 0])

    pushed = x + moment * np.array(field.function(x, u, p, push))[:, 0]
    after_impulse = np.array(impulse(pushed, u, p, push))[:, 0]
    without, rest = rate(pushed), rate(x)
    if without == rest:
        return 0.0
    return _PUSH * (1.0 - (rate(after_impulse) - rest) / (without - rest))


def friction_bands(
    model: Model, x: FloatArray, u: FloatArray, reached: FloatArray
) -> list[FrictionBand]:
    """The bands of all axes around an equilibrium; ``reached`` is what of u reaches the motors."""
    bands: list[FrictionBand] = []
    for axis, place in model.axes.items():
        torque = breakaway(model, x, reached, axis)
        if torque == 0.0:
            continue
        system = rest_system(model, names(model.inputs)[:1], torques_too=True)
        free = place.angle in system.free
        if not free and not system.released:
            system = rest_system(model, names(model.inputs), torques_too=True)
        box, scale = bounds_of(system, {})
        v = np.concatenate([u, np.zeros(model.n_w)])
        index = system.known_index(place.moment)
        limits = (-torque, torque)
        equations = CurveEquations(system, index, v, box, scale, limits)
        point = OperatingPoint(x, u)
        seed = np.array([*(point.value(model, s.name) for s in system.unknowns), 0.0])
        start = equations.pinned(seed, equations.n, 0.0)
        if start is None:
            continue
        curve = equations.through(start)
        reach = {
            signal.name: (float(curve.y[:, k].min()), float(curve.y[:, k].max()))
            for k, signal in enumerate(system.unknowns)
        }
        if free:
            moving = [name for name in system.released if reach[name][1] - reach[name][0] > 1e-9]
            command = (moving[-1], *reach[moving[-1]]) if moving else None
            bands.append(FrictionBand(axis, place.angle, torque, None, None, command))
        else:
            bands.append(FrictionBand(axis, place.angle, torque, *reach[place.angle]))
    return bands
