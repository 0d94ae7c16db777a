"""A Lyapunov function of the energy: its equilibrium, its bounds, and the largest level set found.

The equilibrium follows in turns from equations of one unknown each, ``s(ω) = 0`` of each rotor,
then the balance of pitch and that of yaw at the thrusts found. A change of sign of each, told by
interval arithmetic, proves an equilibrium between the bounds (intermediate values); that s rises
makes the rotor's the only one.

Bounds of the slopes θ over boxes of states are mean values of derivatives between two places.

A potential well ends at the saddle beside a stable equilibrium. The well of pitch is that of a
pendulum with a constant moment. With G sin(α_v + δ) the moment of gravity, its other equilibria are

    α_s = ±π − 2δ − ᾱ_v     (mod 2π)

and the lower of the two barriers beside ᾱ_v is how deep it is. The well of yaw is a spring and has
no end.

Up to which level V falls is proved by branch and bound in the order of V. A box of states is done
with once Q is positive definite all over it. Always the boxes that reach deepest are taken next;
the deepest one left bounds from below the level up to which V falls

    c* = inf { V(y) : Q(y) not positive definite },

and the lowest middle of a box at which Q is found indefinite bounds it from above.

Weights: along rays from the equilibrium it is sampled where Q stops being definite; the weights
whose set {V < c} has the largest volume are taken, and the level is then proved. Sampling only
proposes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.errors import ModelError
from trms_cli.stability.intervals.branch_and_bound import (
    BoxSearch,
    NegativityProof,
    branch_and_bound,
    halve_boxes,
    prove_negative,
)
from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval, definite, stack
from trms_cli.stability.lyapunov.energy import SLOPES, Energy, EnergyWeights

#: Newton steps from the guess, and how far they may lead away from it, as a share of 1 + |value|.
#: What a solver leaves of a moment at the equilibrium would be a term of V̇ that is not in −zᵀQz.
_STEPS, _AWAY = 5, 1e-6
#: Half widths that are tried, as shares of 1 + |value|.
_WIDTHS = (1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6)


def enclose_rest(energy: Energy, x: FloatArray) -> Interval:
    """Bounds of the equilibrium near a numerical solution x, as a state of motion, (3k,).

    Raises ModelError if no change of sign is found.
    """
    y = np.array(energy.to_motion(x)).ravel()
    bounds = {name: Interval.point(0.0) for name in energy.names()}
    thrust: dict[str, Interval] = {}
    for axis in energy.axes:
        speed = ca.SX.sym("speed")
        settling = ca.Function("s", [speed], [energy.settling(axis, speed)])
        guess = float(y[energy.index("omega", axis)])
        omega = _zero(settling, guess, f"speed of the rotor of axis {axis}")
        bounds[f"omega_{axis}"] = omega
        thrust[axis] = _at(ca.Function("F", [speed], [energy.thrust(axis, speed)]), omega)
    for axis in reversed(energy.axes):
        angle, push, lever = ca.SX.sym("angle"), ca.SX.sym("push"), ca.SX.sym("lever")
        pitch = bounds.get("alpha_v", Interval.point(0.0))
        arm = Interval.point(energy.c["l_m" if axis == "v" else "l_t"])
        lifted = arm if axis == "v" else arm * pitch.cosine()
        balance = ca.Function(
            "balance", [angle, push, lever], [energy.restoring(axis, angle) - lever * push]
        )
        guess = float(y[energy.index("alpha", axis)])
        bounds[f"alpha_{axis}"] = _zero(balance, guess, f"alpha_{axis}", thrust[axis], lifted)
    return stack([bounds[name] for name in energy.names()])


def _at(function: ca.Function, *values: Interval) -> Interval:
    columns = [Interval(np.array([[v.lower]]), np.array([[v.upper]])) for v in values]
    return Enclosure(function)(*columns)[0][0, 0]


def _zero(function: ca.Function, guess: float, what: str, *arguments: Interval) -> Interval:
    """Bounds of a zero near a guess."""
    exact = _at(function, Interval.point(0.0), *arguments)
    if abs(guess) < 1e-9 and abs(exact.lower) < 1e-300 and abs(exact.upper) < 1e-300:
        return Interval.point(0.0)  # nothing drives it: exactly zero
    guess = _polished(function, guess, *(v.middle for v in arguments))
    for width in _WIDTHS:
        reach = width * (1.0 + abs(guess))
        low, high = (_at(function, Interval.point(guess + d), *arguments) for d in (-reach, reach))
        if low.upper < 0.0 < high.lower:
            return Interval.of(guess - reach, guess + reach)
        if high.upper < 0.0 < low.lower:
            raise ModelError(
                f"the equilibrium at {what} = {guess:.4g} is on a crest of the potential: a "
                "saddle, which no function can show to be stable",
                where="study.at",
                remedy="choose one in the well, at a smaller angle; study=equilibria shows both",
            )
    raise ModelError(
        f"no equilibrium is proved near {what} = {guess:.6g}",
        where="study.at",
        remedy="choose one away from the fold, where the restoring moment still rises",
    )


def _polished(function: ca.Function, guess: float, *arguments: FloatArray) -> float:
    """The zero near a guess to the last digits; the guess where Newton's steps lead away."""
    symbols = [ca.SX.sym(f"a{i}") for i in range(function.n_in())]
    value = function(*symbols)
    slope = ca.Function("slope", symbols, [value, ca.jacobian(value, symbols[0])])
    at, best, least = guess, guess, float("inf")
    for _ in range(_STEPS):
        residual, rate = (float(part) for part in slope(at, *(float(g) for g in arguments)))
        if abs(residual) < least:
            best, least = at, abs(residual)
        if residual == 0.0 or rate == 0.0:
            break
        at -= residual / rate
        if abs(at - guess) > _AWAY * (1.0 + abs(guess)):
            break
    return best


#: Parts into which a range is cut before a derivative is bounded over it.
_PARTS = 8


class Slopes:
    """θ of an energy function, about an equilibrium (3k,) known between bounds."""

    def __init__(self, energy: Energy, rest: Interval) -> None:
        self.energy, self.rest = energy, rest
        t = ca.SX.sym("t")

        def of(expression: ca.SX) -> Enclosure:
            return Enclosure(ca.Function("slope", [t], [expression]))

        self._ratio = {
            a: of(ca.substitute(energy.rotors[a].ratio, energy.rotors[a].omega, t))
            for a in energy.axes
        }
        self._stiffness = {a: of(energy.stiffness(a, t)) for a in energy.axes}
        self._restoring = {a: of(energy.restoring(a, t)) for a in energy.axes}
        self._thrust = of(energy.thrust("h", t))

    def __call__(self, boxes: Interval) -> Interval:
        """Bounds (m, 6) over boxes (m, 3k)."""
        count = len(boxes.lower)
        zero = Interval.point(np.zeros(count))
        bounds = dict.fromkeys(SLOPES, zero)
        for a in self.energy.axes:
            i, j = self.energy.index("omega", a), self.energy.index("alpha", a)
            bounds[f"psi_{a}"] = over(self._ratio[a], boxes[:, i].hull(self.rest[i]))
            bounds[f"lambda_{a}"] = self._well(a, boxes[:, j], self.rest[j])
        if self.energy.k == 2:
            pitch, yaw = self.energy.index("alpha", "v"), self.energy.index("omega", "h")
            between = boxes[:, pitch].hull(self.rest[pitch])
            bounds["sigma"] = between.sine()
            speed = self.rest[yaw]
            still = self._thrust(speed[None, None])[0]
            bounds["thrust_h"] = still[np.zeros(count, dtype=int), 0]
        return stack([bounds[name] for name in SLOPES])

    def _well(self, axis: str, angle: Interval, rest: Interval) -> Interval:
        """λ: between the derivatives on the way, and the quotient itself away from the rest."""
        slope = over(self._stiffness[axis], angle.hull(rest))
        apart = ~angle.meets(rest)
        moment = self._restoring[axis](angle[:, None])[0][:, 0]
        there = self._restoring[axis](rest[None, None])[0]
        with np.errstate(invalid="ignore", over="ignore"):
            quotient = (moment - there[:, 0]) / (angle - rest)
        return Interval(
            np.where(apart, np.maximum(slope.lower, quotient.lower), slope.lower),
            np.where(apart, np.minimum(slope.upper, quotient.upper), slope.upper),
        )


def over(derivative: Enclosure, between: Interval, parts: int = _PARTS) -> Interval:
    """Bounds (m,) of a function of one variable over ranges (m,), cut into parts."""
    share = np.linspace(0.0, 1.0, parts + 1)
    edges = between.lower[:, None] + share * between.width[:, None]
    edges[:, -1] = between.upper
    bounds = derivative(Interval(edges[:, :-1].ravel(), edges[:, 1:].ravel())[:, None])[0]
    shape = (len(between.lower), parts)
    return Interval(
        bounds.lower.reshape(shape).min(axis=1), bounds.upper.reshape(shape).max(axis=1)
    )


class EnergyCandidate:
    """V of a model at a command about an equilibrium x, with bounds that count."""

    def __init__(self, energy: Energy, x: FloatArray, weights: EnergyWeights) -> None:
        self.energy, self.x = energy, np.asarray(x, dtype=float)
        self.weights = weights
        self.rest = enclose_rest(energy, self.x)
        self.slopes = Slopes(energy, self.rest)
        self._moving = Enclosure(energy.moving)
        self._well = {a: Enclosure(energy.alone(energy.well(a), "alpha", a)) for a in energy.axes}
        if "v" in energy.axes:  # the well of pitch, with the place at rest first
            by_rest = [ca.SX.sym("at_rest"), ca.SX.sym("state")]
            well = self._well["v"].function(*reversed(by_rest))
            self._well_by_rest = Enclosure(ca.Function("by_rest", by_rest, [well]))
        self._store = {
            a: Enclosure(energy.alone(energy.stored(a), "omega", a)) for a in energy.axes
        }
        self._decay = Enclosure(energy.decay)
        self._mass = Enclosure(energy.inertia)
        self._inverse = _inverse_inertia(energy)

    def weighted(self, weights: EnergyWeights) -> EnergyCandidate:
        """The same with other weights."""
        other = object.__new__(EnergyCandidate)
        other.__dict__.update(self.__dict__)
        other.weights = weights
        return other

    @property
    def centre(self) -> FloatArray:
        """The equilibrium as a state of motion, (3k,)."""
        return self.rest.middle

    # Numbers

    def value(self, y: npt.ArrayLike) -> FloatArray:
        """V at states of motion (m, 3k): (m,), J."""
        columns = np.atleast_2d(y).T
        return np.array(self.energy.value(columns, self.centre, self.weights.array())).ravel()

    def derivative(self, x: npt.ArrayLike) -> FloatArray:
        """V̇ at states (m, n_x): (m,), W."""
        columns = np.atleast_2d(x).T
        return np.array(self.energy.derivative(columns, self.centre, self.weights.array())).ravel()

    def states(self, y: npt.ArrayLike) -> FloatArray:
        """States of the model (m, n_x) from states of motion (m, 3k)."""
        return np.array(self.energy.to_state(np.atleast_2d(y).T)).T

    def motions(self, x: npt.ArrayLike) -> FloatArray:
        """States of motion (m, 3k) from states of the model (m, n_x)."""
        return np.array(self.energy.to_motion(np.atleast_2d(x).T)).T

    # Bounds

    def terms(self, boxes: Interval) -> Interval:
        """Bounds of the terms of V over boxes (m, 3k): (m, 2 + 2k); none is below zero.

        Wells and stores rise away from the equilibrium (:meth:`extent` says how far), so that
        their bounds are their values at the nearest and the farthest place.
        """
        weights = Interval.point(self.weights.array())
        moving = self._moving(boxes, self.rest, weights)[0]
        parts = [Interval(np.maximum(moving.lower[:, i], 0.0), moving.upper[:, i]) for i in (0, 1)]
        for row in range(2, 2 + 2 * self.energy.k):
            function, weight, j = self._term(row)
            parts.append(self._rising(function, boxes, j) * Interval.point(weight))
        return stack(parts)

    def _rising(self, function: Enclosure, boxes: Interval, j: int) -> Interval:
        """Bounds of a function of one state that rises away from the equilibrium, (m,)."""
        box, rest = boxes[:, j], self.rest[j]
        nearest = np.where(box.lower > rest.upper, box.lower, box.upper)
        near, low, high = (
            function(Interval.point(place[:, None]), rest[None])
            for place in (nearest, box.lower, box.upper)
        )
        lower = np.where(box.meets(rest), 0.0, np.maximum(near[0].lower[:, 0], 0.0))
        upper = np.maximum(low[0].upper[:, 0], high[0].upper[:, 0])
        return Interval(lower, np.maximum(upper, lower))

    def values(self, boxes: Interval) -> Interval:
        """Bounds of V over boxes, (m,)."""
        parts = self.terms(boxes)
        total = parts[:, 0]
        for i in range(1, parts.lower.shape[1]):
            total = total + parts[:, i]
        return total

    def matrices(self, boxes: Interval) -> Interval:
        """Bounds of Q over boxes: (m, 3k, 3k), or (m, 2k, 2k) where the angles are not in it.

        They are not for the plain energy, unless the tail rotor's thrust turns with the pitch.
        """
        bounds = self._decay(boxes, self.slopes(boxes), Interval.point(self.weights.array()))[0]
        size = (3 if self.has_angles else 2) * self.energy.k
        return bounds[:, :size, :size]

    @property
    def has_angles(self) -> bool:
        """Whether z has the angles: their rows of Q are not zero."""
        if self.weights.strict or self.energy.k != 2:
            return self.weights.strict
        speed = self.rest[self.energy.index("omega", "h")]
        return not (speed.lower == 0.0 and speed.upper == 0.0)

    def inertias(self, boxes: Interval) -> Interval:
        """Bounds of M over boxes, (m, k, k)."""
        return self._mass.matrices(boxes)[0]

    def falls_at_rest(self) -> bool:
        """Whether Q is positive definite at the equilibrium."""
        return bool(definite(self.matrices(self.rest[None]))[0][0])

    # Sets

    def extent(self, level: float, ends: Interval | None = None) -> Interval:
        """A box around {V <= level}, (3k,).

        Every term of V is at most the level; each well rises on both sides up to the ends given,
        (k,), each store everywhere, so that where one has passed the level nothing beyond counts.
        """
        k, axes, y = self.energy.k, self.energy.axes, self.centre
        lower, upper = np.empty(3 * k), np.empty(3 * k)
        for row in range(2, 2 + 2 * k):
            low, high = -np.inf, np.inf
            if row < 2 + k and ends is not None:
                low, high = float(ends.lower[row - 2]), float(ends.upper[row - 2])
            j = self._term(row)[2]
            lower[j] = self._reach(row, level, -1.0, low)
            upper[j] = self._reach(row, level, 1.0, high)
        angles = slice(2 * k, 3 * k)
        pitch = Interval.point(0.0)
        if "v" in axes:
            pitch = Interval(lower, upper)[self.energy.index("alpha", "v")]
        away = np.maximum(np.abs(lower[angles] - y[angles]), np.abs(upper[angles] - y[angles]))
        for i, a in enumerate(axes):
            inverse = float(over(self._inverse[i], pitch[None], 64).upper[0])
            gamma = self.weights.yaw if a == "h" else 1.0
            cross = self.weights.cross_h if a == "h" else self.weights.cross_v
            rate = float(np.sqrt(2.0 * level * inverse / gamma)) + cross * float(away[i])
            lower[i], upper[i] = -rate * (1.0 + 1e-9), rate * (1.0 + 1e-9)
        return Interval(lower, upper)

    def _reach(self, row: int, level: float, side: float, end: float) -> float:
        """Where one term, rising away from the equilibrium, has passed a level; else the end."""
        function, weight, j = self._term(row)
        rest = float(self.centre[j])

        def value(distance: float) -> float:
            return weight * float(function.function(rest + side * distance, rest))

        farthest = abs(end - rest)
        distance = _smallest(lambda d: value(d) >= level, farthest)
        # Numbers propose, bounds decide.
        further = 1e-6
        while distance < farthest and self._row(row, rest + side * distance) < level:
            distance = min(distance * (1.0 + further), farthest)
            further *= 2.0  # at very low levels the bounds of the equilibrium are what is left
        return rest + side * distance

    def well_at(self, axis: str, angle: float) -> float:
        """A lower bound of γU of an axis at an angle, J."""
        return self._row(2 + self.energy.axes.index(axis), angle)

    def _term(self, row: int) -> tuple[Enclosure, float, int]:
        """A well or a store, its weight and the position of its state, by its row in the terms."""
        a = self.energy.axes[(row - 2) % self.energy.k]
        w, index = self.weights, self.energy.index
        if row < 2 + self.energy.k:
            return self._well[a], w.yaw if a == "h" else 1.0, index("alpha", a)
        return self._store[a], w.rotor_h if a == "h" else w.rotor_v, index("omega", a)

    def _row(self, row: int, state: float) -> float:
        """A lower bound of one well or store at a state."""
        function, weight, j = self._term(row)
        rest = self.rest[j : j + 1]
        at = Interval.point(np.array([[state]]))
        lower = float(function(at, rest)[0].lower[0, 0])
        if function is self._well.get("v"):
            # Near the fold a well is shallower than the bounds of the equilibrium are wide, if
            # these are not followed through the differences: by the mean value form they are.
            lower = max(lower, float(self._well_by_rest.mean_value(rest[None], at).lower[0, 0]))
        return lower * weight * (1.0 - 1e-12 * np.sign(lower))


def _smallest(passed: Callable[[float], bool], farthest: float) -> float:
    """A distance at which a rising quantity has passed, close to the first one."""
    high = min(1e-3, farthest)
    while not passed(high):
        if high >= farthest or high > 1e9:
            return farthest
        high = min(2.0 * high, farthest)
    low = 0.0
    while high - low > 1e-4 * high:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if passed(middle) else (middle, high)
    return high


def _inverse_inertia(energy: Energy) -> list[Enclosure]:
    """Diagonal of M⁻¹ by the pitch angle."""
    t = ca.SX.sym("t")
    mass = energy.mass(t)
    if energy.k == 1:
        entries = [1 / mass[0, 0]]
    else:
        determinant = mass[0, 0] * mass[1, 1] - mass[0, 1] ** 2
        entries = [mass[1, 1] / determinant, mass[0, 0] / determinant]
    return [Enclosure(ca.Function("inverse", [t], [entry])) for entry in entries]


#: rad. About the equilibrium the slope of U' is looked at, U' itself beyond; and how far before the
#: saddle the well is taken to end.
_NEAR = 0.02
_BEFORE = 1e-4


@dataclass(frozen=True)
class Wells:
    """The wells of all axes that move."""

    ends: Interval  #: (k,), rad: between them every U rises away from the equilibrium
    #: J, a lower bound of V wherever an angle is at one of its ends; infinite without a saddle
    depth: float
    saddles: tuple[float, float] | None  #: α_v below and above, rad
    proofs: tuple[NegativityProof, ...]  #: That they rise

    def hold(self, places: FloatArray) -> BoolArray:
        """Which states of motion (m, 3k) have all their angles between the ends, (m,)."""
        angles = places[:, -len(self.ends.lower) :]
        within = (angles > self.ends.lower) & (angles < self.ends.upper)
        return np.asarray(within.all(axis=1))

    @property
    def rise(self) -> bool:
        return all(proof.holds for proof in self.proofs)


def wells_of(candidate: EnergyCandidate) -> Wells:
    """The wells about a candidate's equilibrium, with proofs."""
    energy = candidate.energy
    lower, upper = np.full(energy.k, -np.inf), np.full(energy.k, np.inf)
    depth, saddles, proofs = math.inf, None, []
    for i, a in enumerate(energy.axes):
        rest = float(candidate.centre[energy.index("alpha", a)])
        if a == "v":
            tilt = math.atan2(-energy.gravity[0], -energy.gravity[1])
            saddles = (-math.pi - 2 * tilt - rest, math.pi - 2 * tilt - rest)
            lower[i], upper[i] = saddles[0] + _BEFORE, saddles[1] - _BEFORE
            proofs += _rises(candidate, a, rest, float(lower[i]), float(upper[i]))
            heights = [candidate.well_at(a, end) for end in (lower[i], upper[i])]
            depth = min(heights)
    return Wells(Interval(lower, upper), depth, saddles, tuple(proofs))


def _rises(
    candidate: EnergyCandidate, axis: str, rest: float, lower: float, upper: float
) -> list[NegativityProof]:
    """U'' > 0 near the equilibrium, and beyond it U' has the sign of α − ᾱ up to the ends."""
    energy, angle, still = candidate.energy, ca.SX.sym("angle"), ca.SX.sym("still")
    j = energy.index("alpha", axis)
    moment = energy.restoring(axis, angle) - energy.restoring(axis, still)
    above = ca.Function("above", [angle, still], [-moment])
    below = ca.Function("below", [angle, still], [moment])
    curved = ca.Function("curved", [angle], [-energy.stiffness(axis, angle)])
    near = min(_NEAR, 0.25 * (upper - rest), 0.25 * (rest - lower))
    # The equilibrium is known between bounds: the worse end of them for each side.
    high, low = candidate.rest.upper[j], candidate.rest.lower[j]
    proofs = [prove_negative(curved, [rest - near], [rest + near])]
    if upper - _BEFORE > rest + near:
        proofs.append(prove_negative(above, [rest + near], [upper], given=[high]))
    if lower + _BEFORE < rest - near:
        proofs.append(prove_negative(below, [lower], [rest - near], given=[low]))
    return proofs


def stop_level(candidate: EnergyCandidate, ends: Interval | None = None) -> tuple[float, str]:
    """The lowest level of V at which an angle may reach a mechanical stop, J, and that stop.

    Infinite for a model without stops; zero or less where the equilibrium is at a stop or beyond
    it. The wells must rise up to there. A stop beyond their ends (k,) is not in the well, and
    bounds nothing.
    """
    lowest, name = math.inf, ""
    for i, a in enumerate(candidate.energy.axes):
        stop = candidate.energy.model.stops[f"alpha_{a}"]
        rest = float(candidate.centre[candidate.energy.index("alpha", a)])
        for end in (-stop, stop):
            if not math.isfinite(end):
                continue
            if ends is not None and not float(ends.lower[i]) <= end <= float(ends.upper[i]):
                continue
            level = candidate.well_at(a, end) if abs(rest) < stop else 0.0
            if level < lowest:
                lowest, name = level, f"alpha_{a} = {end:.4g} rad"
    return lowest, name


#: Bounds (m, n, n) over boxes (m, n_y), or (m,) bounds of V.
Bounds = Callable[[Interval], Interval]

#: The search ends when the bounds of c* are this close to each other.
_CLOSE = 0.01


@dataclass(frozen=True)
class DecayLevel:
    """How far decay reaches."""

    #: Q is proved positive definite where V < level, within the first box; infinite if all over
    level: float
    fails: float  #: V at the lowest state found where Q is not; infinite if there is none
    point: FloatArray | None  #: (n_y,) array or None; that state
    examined: int  #: Boxes bounded


def decay_level(
    matrices: Bounds,
    values: Bounds,
    box: Interval,
    most: float,
    budget: int = 20_000,
    *,
    patient: bool = True,
) -> DecayLevel:
    """Bounds of the level up to which Q is positive definite, in a box (n_y,) of states.

    States with V above ``most`` are not asked about. A search that is not ``patient`` ends at the
    first state found where Q is not definite.
    """
    size = np.where(box.width > 0.0, box.width, 1.0)
    fails, point = np.inf, None

    def visit(boxes: Interval, _: FloatArray) -> tuple[Interval, FloatArray, int]:
        nonlocal fails, point
        is_proved, middles = definite(matrices(boxes))
        bad = ~middles & ~is_proved
        if bad.any():
            # The middle matrix of the bounds sorts out where to look; the point itself decides.
            places = Interval.point(boxes.middle[bad])
            truly = ~definite(matrices(places))[0]
            levels = np.where(truly, values(places).upper, np.inf)
            if levels.min() < fails:
                best = int(np.argmin(levels))
                fails, point = float(levels[best]), places.lower[best]
        open_ = boxes[~is_proved]
        if not len(open_.lower) or (not patient and fails < most):
            return open_[:0], np.zeros(0), len(is_proved)
        halves = halve_boxes(open_, _directions(matrices, open_, size))
        deep = values(halves).lower
        # Boxes above the lowest failure say nothing more about c*.
        keep = deep < min(fails, most)
        return halves[keep], deep[keep], len(is_proved)

    def enough(lowest: float) -> bool:
        return (not patient and fails < most) or lowest >= (1.0 - _CLOSE) * min(fails, most)

    first = BoxSearch(box[None], np.atleast_1d(values(box[None]).lower), 0)
    search = branch_and_bound(first, visit, budget=budget, enough=enough)
    level = min(search.lowest, fails) if patient or fails >= most else 0.0
    return DecayLevel(level, fails, point, search.examined)


def _directions(matrices: Bounds, boxes: Interval, size: FloatArray) -> npt.NDArray[np.intp]:
    """The direction that makes most of the width of Q, box by box; the longest where none does.

    Found by collapsing one direction at a time to its middle.
    """
    count, n = boxes.lower.shape
    middle = boxes.middle
    scale = np.sqrt(
        np.maximum(np.einsum("mii->mi", matrices(Interval.point(middle)).upper), 1e-300)
    )
    weight = 1.0 / (scale[:, :, None] * scale[:, None, :])
    whole = _spread(matrices(boxes), weight)
    gain = np.zeros((count, n))
    for j in range(n):
        lower, upper = boxes.lower.copy(), boxes.upper.copy()
        lower[:, j] = upper[:, j] = middle[:, j]
        gain[:, j] = whole - _spread(matrices(Interval(lower, upper)), weight)
    relative = boxes.width / size
    gain = np.where(relative > 1e-9, gain, -np.inf)
    useless = gain.max(axis=1) <= 1e-9 * np.abs(whole)
    return np.where(useless, relative.argmax(axis=1), gain.argmax(axis=1))


def _spread(matrix: Interval, weight: FloatArray) -> FloatArray:
    width = np.nan_to_num(matrix.width, nan=1e300, posinf=1e300)
    return np.asarray((width * weight).sum(axis=(1, 2)))


#: Rays, and places on each.
_RAYS = 100
_PLACES = 12
#: Share of the sampled level that is to be proved first.
_SHARE = 0.9
#: J, looked at where a well has no end and no stop.
_DEEPEST = 1.0
#: Functions whose level is proved, unless one reaches as far as the well does.
_PROVED = 3
#: γ that are tried where none near 1 does.
_HEAVY = (8.0, 32.0, 128.0)


@dataclass(frozen=True)
class LevelSearchResult:
    """A function and how far it reaches."""

    candidate: EnergyCandidate
    wells: Wells
    decay_level: DecayLevel
    requested_level: float  #: The level up to which decay was to be proved, J

    @property
    def level(self) -> float:
        """Proved: V falls on {V < level}, within the well; J."""
        return min(self.decay_level.level, self.requested_level)


def search_levels(energy: Energy, x: FloatArray, strict: bool, budget: int) -> LevelSearchResult:
    """The function with the largest proved set, with cross terms if it is to be strict."""
    first = EnergyCandidate(energy, x, rotor_weights(energy, 1.05))
    wells = wells_of(first)
    ceiling = wells.depth
    if ceiling <= 0.0:  # the barrier is not bounded away from zero: nothing can be proved
        return LevelSearchResult(first, wells, DecayLevel(0.0, math.inf, None, 0), 0.0)
    if not math.isfinite(ceiling):
        stop, _ = stop_level(first)
        ceiling = stop if math.isfinite(stop) and stop > 0.0 else _DEEPEST
    sampled: list[tuple[float, float, EnergyCandidate]] = []
    for choices in (_choices(energy, strict), _choices(energy, strict, _HEAVY)):
        for weights in choices:
            candidate = first.weighted(weights)
            if candidate.falls_at_rest():
                level = _sampled(candidate, wells, ceiling)
                sampled.append((_volume(candidate, level), level, candidate))
        if sampled:
            break
    if not sampled:
        return LevelSearchResult(first, wells, DecayLevel(0.0, 0.0, first.centre, 0), ceiling)
    sampled.sort(key=lambda choice: -choice[0])
    # Samples tell functions apart that differ much; of those next to each other the proofs decide.
    best = _proved(sampled[0][2], wells, ceiling, sampled[0][1], budget)
    for _, level, candidate in sampled[1:_PROVED]:
        if best.level >= (1.0 - _CLOSE) * ceiling:
            break
        other = _proved(candidate, wells, ceiling, level, budget)
        if _volume(candidate, other.level) > _volume(best.candidate, best.level):
            best = other
    return best


def _proved(
    candidate: EnergyCandidate, wells: Wells, ceiling: float, sampled: float, budget: int
) -> LevelSearchResult:
    """How far one function reaches, from the level that samples gave."""
    target_level = ceiling if sampled >= ceiling else _SHARE * sampled
    for patient in (False, False, True):
        box = candidate.extent(target_level, wells.ends)
        decay = decay_level(
            candidate.matrices, candidate.values, box, target_level, budget, patient=patient
        )
        if decay.fails >= target_level:
            break
        if not patient:
            target_level = _SHARE * decay.fails
    return LevelSearchResult(candidate, wells, decay, target_level)


def rotor_weights(energy: Energy, margin: float, yaw: float = 1.0) -> EnergyWeights:
    """c of each rotor by completing the square against friction, times a margin.

    ``c = margin Σ γ (lever ψ_max)² / 4 k_o``: with one axis and a margin above one, V̇ ≤ 0 at all
    speeds, since ψ never exceeds ψ_max = max k_f J/k_t.
    """
    gamma = {"h": yaw, "v": 1.0}
    weights = {}
    for a in energy.axes:
        rotor, c = energy.rotors[a], energy.c
        bound = rotor.bound
        if not math.isfinite(bound):
            ratio = ca.Function("ratio", [rotor.omega], [rotor.ratio])
            bound = float(ratio(400.0))
        lever, other = ("l_t", "v") if a == "h" else ("l_m", "h")
        direct = gamma[a] * (c[lever] * bound) ** 2 / (4 * c[f"k_o{a}"])
        reaction = gamma[other] * c["k_t" if a == "h" else "k_m"] ** 2 / (4 * c[f"k_o{other}"])
        weights[f"rotor_{a}"] = margin * (direct + (reaction if energy.k == 2 else 0.0))
    return EnergyWeights(**weights, yaw=yaw)


def _choices(
    energy: Energy, strict: bool, yaws: tuple[float, ...] = (0.5, 1.0, 2.0)
) -> Iterator[EnergyWeights]:
    # Each choice is tried in turn; heavy yaw only pays where the cross moment k_g is large.
    margins = (1.05,) if energy.k == 1 and not strict else (1.5, 3.0, 6.0)
    if not energy.weighted:
        yaws = (1.0,)
    crosses = (0.05, 0.15, 0.4) if strict else (0.0,)
    fastest = {}
    for a in "hv":
        if a in energy.axes:
            inertia = ca.DM(ca.substitute(energy.mass(ca.SX(0)), energy.y, 0 * energy.y))
            i = energy.axes.index(a)
            fastest[a] = energy.c[f"k_o{a}"] / float(inertia[i, i])
    for margin, yaw, cross in itertools.product(margins, yaws, crosses):
        yield replace(
            rotor_weights(energy, margin, yaw),
            cross_h=cross * fastest.get("h", 0.0),
            cross_v=cross * fastest.get("v", 0.0),
        )


def curvature(candidate: EnergyCandidate) -> FloatArray:
    """∇²V at the equilibrium, (3k, 3k)."""
    energy = candidate.energy
    v = energy.value(energy.y, energy.rest, energy.weights)
    hessian = ca.hessian(v, energy.y)[0]
    function = ca.Function("H", [energy.y, energy.rest, energy.weights], [ca.densify(hessian)])
    return np.array(function(candidate.centre, candidate.centre, candidate.weights.array()))


def rays(candidate: EnergyCandidate, count: int, seed: int = 0) -> FloatArray:
    """Directions from the equilibrium, evenly over the level sets of V near it: (count, 3k)."""
    n = 3 * candidate.energy.k
    unit = np.random.default_rng(seed).normal(size=(count, n))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(curvature(candidate))
    # The symmetric root: signs and order of the vectors, which a processor may choose, drop out.
    root = vectors / np.sqrt(np.maximum(values, 1e-12)) @ vectors.T
    return np.asarray(unit @ root)


def _sampled(candidate: EnergyCandidate, wells: Wells, ceiling: float) -> float:
    """About the level up to which Q is definite, J."""
    # Single terms are where V is lowest for what they do to Q.
    single = np.diag(1.0 / np.sqrt(np.maximum(np.diagonal(curvature(candidate)), 1e-12)))
    directions = np.concatenate([rays(candidate, _RAYS), single, -single])
    y, n = candidate.centre, directions.shape[1]
    lowest = ceiling
    for _ in range(3):
        reach = math.sqrt(2.0 * lowest) * 1.3
        share = np.linspace(1.0 / _PLACES, 1.0, _PLACES)
        places = (y + reach * directions[:, None, :] * share[:, None]).reshape(-1, n)
        levels = candidate.value(places)
        within = wells.hold(places) & (levels < lowest)
        if not within.any():
            return lowest
        bad = ~definite(candidate.matrices(Interval.point(places[within])))[0]
        if not bad.any():
            return lowest
        lowest = float(levels[within][bad].min())
        worst = places[within][bad][np.argmin(levels[within][bad])]
        # Once more about the worst direction.
        near = (worst - y) / reach
        spread = np.random.default_rng(1).normal(size=directions.shape) * 0.25
        directions = near * (1.0 + spread)
    return lowest


def _volume(candidate: EnergyCandidate, level: float) -> float:
    """Logarithm of the volume of the ellipsoid that {V < level} is near the equilibrium."""
    sign, determinant = np.linalg.slogdet(curvature(candidate))
    if sign <= 0 or level <= 0.0:
        return -1e300
    n = 3 * candidate.energy.k
    return 0.5 * (n * math.log(level) - float(determinant))
