"""Region of attraction of a model's equilibrium: estimates, tested and measured by simulation.

A motion has come to rest as soon as it has entered a set that is proved to be attracted; before
that it may have left for good (far outside the box) or be undecided when the time is over. The
equations are integrated as the model's simulation integrates them, without dry friction.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.core.ranges import Positive
from trms_cli.models.discretisation import discretise
from trms_cli.models.operating_point import refine_operating_point
from trms_cli.models.vector_field import LONGEST_STEP, VectorField, without_impulses
from trms_cli.stability.attraction.estimates import (
    LABELS,
    Method,
    RegionEstimate,
    estimates,
    from_lyapunov_equation,
    methods_for,
)
from trms_cli.stability.attraction.system import ReducedSystem
from trms_cli.stability.study import Tell

IntArray = npt.NDArray[np.int8]
Inside = Callable[[FloatArray], BoolArray]

#: What became of a motion.
SETTLED, UNDECIDED, LEFT = 1, 0, -1
#: Motions that are integrated at once: one compiled function for all calls.
_BLOCK = 512
#: s between two looks at the states, and between two looks at who has arrived.
_STEP, _CHUNK = 0.1, 4.0
_CONFIDENCE = 0.95


@dataclass(frozen=True)
class ConfidenceShare:
    """A share with its confidence interval (95 %, Clopper and Pearson)."""

    value: float  #: the best guess
    lower: float  #: lower end
    upper: float  #: upper end

    def over(self, other: ConfidenceShare) -> ConfidenceShare:
        """The ratio of two, its interval the widest that both allow; at most 1 if they say so."""
        return ConfidenceShare(
            self.value / other.value if other.value else math.nan,
            self.lower / other.upper if other.upper else math.nan,
            self.upper / other.lower if other.lower else math.inf,
        )


def share_of(hits: int, count: int) -> ConfidenceShare:
    """The share of hits among independent draws."""
    from scipy.special import betaincinv

    tail = 0.5 * (1.0 - _CONFIDENCE)
    low = 0.0 if hits == 0 else float(betaincinv(hits, count - hits + 1, tail))
    high = 1.0 if hits == count else float(betaincinv(hits + 1, count - hits, 1.0 - tail))
    return ConfidenceShare(hits / count if count else math.nan, low, high)


def fates(
    system: ReducedSystem, starts: FloatArray, inside: Inside, duration: float, far: FloatArray
) -> tuple[IntArray, FloatArray]:
    """What becomes of motions from deviations (m, n) within a duration (s), (m,).

    :data:`SETTLED` once ``inside`` says of a deviation that it has arrived, :data:`LEFT` beyond
    \\|y_i\\| > far_i, else :data:`UNDECIDED`; and the deviations (m, n) where each was last seen.
    """
    positions, origin = list(system.positions), system.point.x
    outcomes = np.zeros(len(starts), dtype=np.int8)
    outcomes[inside(starts)] = SETTLED
    waiting = np.flatnonzero(outcomes == UNDECIDED)
    if not len(waiting):
        return outcomes, starts
    mover = _Mover(system)
    states = np.tile(mover.rest, (len(starts), 1))
    states[:, positions] += starts
    for _ in range(math.ceil(duration / _CHUNK)):
        if not len(waiting):
            break
        for first in range(0, len(waiting), _BLOCK):
            rows = waiting[first : first + _BLOCK]
            path = mover.trajectories(states[rows])
            y = path[:, :, positions] - origin[positions]
            states[rows] = path[-1]
            with np.errstate(invalid="ignore"):
                escapes = np.any(~(np.abs(y) <= far), axis=(0, 2))
            finite = np.where(np.isfinite(y), y, np.inf)
            arrived = inside(finite.reshape(-1, system.n)).reshape(-1, len(rows)).any(axis=0)
            outcomes[rows] = np.where(escapes, LEFT, np.where(arrived, SETTLED, UNDECIDED))
        waiting = waiting[outcomes[waiting] == UNDECIDED]
    return outcomes, states[:, positions] - origin[positions]


class _Mover:
    """Motions over a chunk of time: one compiled function for a block of them."""

    def __init__(self, system: ReducedSystem) -> None:
        model = without_impulses(system.model)
        substeps = math.ceil(_STEP / LONGEST_STEP - 1e-9)
        discrete = discretise(model, _STEP, substeps)
        self.rest = discrete.initial(system.point.x, system.point.u)
        self._every = BufferedFunction(discrete.step.map(_BLOCK))
        _, commands, p, _ = self._every.inputs
        commands.reshape(model.n_u, _BLOCK, order="F")[:] = system.point.u[:, None]
        values = model.parameters.values
        if p.size:
            p.reshape(values.size, _BLOCK, order="F")[:] = values[:, None]

    def trajectories(self, states: FloatArray) -> FloatArray:
        """(k, m, n) states after each of k steps, from (m, n) with m up to a block."""
        x, m = self._every.inputs[0], len(states)
        # A block that is not full repeats its states: one size, one function.
        x[...] = np.resize(states, (_BLOCK, states.shape[1])).T
        path = np.empty((round(_CHUNK / _STEP), m, states.shape[1]))
        for k in range(len(path)):
            self._every()
            x[...] = self._every.outputs[0]
            path[k] = x[:, :m].T
        return path


def failures(
    system: ReducedSystem,
    sets: Sequence[RegionEstimate],
    count: int,
    duration: float,
    seed: int,
    cut: bool = False,
) -> list[tuple[int, int]]:
    """A test of estimates by simulation: starts in each that are decided, and failures among them.

    To rest comes what ends where yᵀPy, of the linearisation's Lyapunov equation, is a hundredth of
    what it is on the smallest set's edge: deep inside all of them. Where the duration is ``cut``,
    shorter than the slowest mode needs for that, a motion that is still in its set, at a lower V
    than it began with, has not failed but is undecided, and not counted.
    """
    P = from_lyapunov_equation(system)
    starts = [_with_edge(estimate, count, seed) for estimate in sets]
    nonempty_starts = [y for y in starts if len(y)]
    if not nonempty_starts:
        return [(0, 0) for _ in sets]
    least = min(float(np.einsum("ij,jk,ik->i", y, P, y).max()) for y in nonempty_starts)

    def arrived(y: FloatArray) -> BoolArray:
        near = np.where(np.isfinite(y), y, 1e6)
        return np.asarray(np.einsum("ij,jk,ik->i", near, P, near) < 1e-2 * least)

    fate, last = fates(
        system, np.vstack(nonempty_starts), arrived, duration, np.full(system.n, np.inf)
    )
    ends = np.cumsum([len(y) for y in starts])
    counts = []
    for estimate, y, end in zip(sets, starts, ends, strict=True):
        own, at = fate[end - len(y) : end], last[end - len(y) : end]
        is_failure, still = own != SETTLED, np.zeros(len(y), dtype=bool)
        waits = np.flatnonzero(own == UNDECIDED)
        if cut and len(waits):
            V = estimate.candidate.values
            still[waits] = estimate.contains(at[waits]) & (V(at[waits]) < V(y[waits]))
        counts.append((int(np.sum(~still)), int(np.sum(is_failure & ~still))))
    return counts


def _with_edge(estimate: RegionEstimate, count: int, seed: int) -> FloatArray:
    """Starts in a set, half of them as near to its edge as it goes on their ray."""
    starts = estimate.draw(count, seed)
    for _ in range(40):
        further = starts.copy()
        further[::2] *= 1.05
        is_inside = estimate.contains(further)
        starts[is_inside] = further[is_inside]
    return starts


@dataclass(frozen=True)
class OtherRest:
    """Another equilibrium at the same command: its deviation (n,), and whether it attracts."""

    y: FloatArray  #: deviation from the equilibrium studied
    stable: bool  #: all eigenvalues in the left half plane


def other_rests(system: ReducedSystem, limits: FloatArray) -> list[OtherRest]:
    """Other equilibria in the box that Newton's method finds from random starts."""
    field, positions = VectorField(system.model), list(system.positions)
    random = np.random.default_rng(0)
    rests: list[OtherRest] = []
    for draw in random.uniform(-1.0, 1.0, (60, system.n)) * limits:
        start = system.point.x.copy()
        start[positions] += draw
        x = refine_operating_point(field, start, system.point.u)
        if x is None:
            continue
        y = x[positions] - system.point.x[positions]
        scale = np.maximum(limits, 1e-9)
        known_rests = [np.zeros(system.n), *(rest.y for rest in rests)]
        if (
            np.any(np.abs(y) > limits)
            or min(np.abs((y - k) / scale).max() for k in known_rests) < 1e-4
        ):
            continue
        slope = field.linearised(x, system.point.u)[0][np.ix_(positions, positions)]
        rests.append(OtherRest(y, bool(np.linalg.eigvals(slope).real.max() < 0.0)))
    return sorted(rests, key=lambda rest: float(np.linalg.norm(rest.y / limits)))


#: Time constants of the slowest mode after which a motion is undecided.
_TIME_CONSTANTS = 10.0
#: s, at which that is cut off: of up to three states, and of more, whose motions arrive late.
_LONGEST, _LONGEST_OF_MANY = 240.0, 120.0
#: Sides of the default box beyond those of the largest estimate.
_ROOM = 1.6
#: The default box goes to the nearest saddle and beyond by this factor.
_BEYOND = 1.2
#: Starts in each estimate, to test it by simulation.
_TESTED = 80
#: States up to which all is sampled densely.
_FEW = 3
#: Points from which the share of the box that an estimate fills is counted.
_COUNTED = 60_000
#: Motions that are drawn, and for how long, s.
_DRAWN, _SHOWN = 6, 12.0


@dataclass(frozen=True)
class StartSet:
    """What starts deviate in: y = matrix d + offset."""

    names: tuple[str, ...]  #: States of d
    matrix: FloatArray  #: (n, m) array
    offset: FloatArray  #: (n,) array

    @classmethod
    def of_all(cls, system: ReducedSystem) -> StartSet:
        """In all states of the system."""
        return cls(system.names, np.eye(system.n), np.zeros(system.n))

    def of(self, d: FloatArray) -> FloatArray:
        """Deviations y (k, n) of starts d (k, m)."""
        return np.asarray(d @ self.matrix.T + self.offset)

    @property
    def direct(self) -> bool:
        """Whether d is y."""
        return self.matrix.shape[0] == self.matrix.shape[1] and bool(
            np.array_equal(self.matrix, np.eye(len(self.matrix))) and not self.offset.any()
        )


@dataclass(frozen=True, kw_only=True)
class RegionRequest:
    """What is asked of a region, and how much is done for it."""

    #: sequence of str, "all" or None; in which starts deviate. None: the angles and what moves with
    #: them, the rotors at their speed.
    states: Sequence[str] | Literal["all"] | None = None
    #: Half-widths of the box of starts by state; what is not named is chosen
    box: Mapping[str, Positive] = field(default_factory=dict)
    #: The two states of the figure. Empty: the last angle and its rate; in a loop of two axes both
    #: angles.
    plane: Sequence[str] = ()
    #: ``lyapunov``, ``inclusion``, ``level_set``, ``integrals``, ``quartic``. None: all; of more
    #: than three states without the last two.
    methods: Sequence[Method] | None = None
    boxes: Annotated[int, Meta(ge=100, le=10_000_000)] = 40_000  #: Boxes that one proof may take
    #: Random starts, from which the share of the true region is counted. None: 2000, of more than
    #: three states 500.
    samples: Annotated[int, Meta(ge=20, le=1_000_000)] | None = None
    #: Starts along each side of the figure. None: 61, of more than three states 31.
    grid: Annotated[int, Meta(ge=5, le=401)] | None = None
    #: s, after which a motion is undecided. None: ten time constants of the slowest mode, at most
    #: 240 s, of more than three states 120 s; 20 s in a loop.
    duration: Positive | None = None
    #: Starts from which the loop itself is run, with controller and observer
    loop_starts: Annotated[int, Meta(ge=2, le=100_000)] = 24
    tolerance: Positive = 0.02  #: Of the angles at the end of such a run, rad

    def for_states(self, n: int) -> tuple[int, int]:
        """Samples and grid: fewer where motions of many states take long to arrive."""
        samples = (2000 if n <= _FEW else 500) if self.samples is None else self.samples
        return samples, (61 if n <= _FEW else 31) if self.grid is None else self.grid


@dataclass(frozen=True)
class EstimateTest:
    """An estimate beside the truth."""

    estimate: RegionEstimate
    #: Of the true region in the box that it covers; None where that is below what can be counted
    share: ConfidenceShare | None
    #: ``tested``, ``failed``: Starts in it that were simulated, and those that did not come to rest
    tested: int
    failed: int


@dataclass(frozen=True)
class RegionSection:
    """A section of the region."""

    axes: tuple[int, int]  #: Positions in d
    x: FloatArray  #: (g,) arrays; deviations of the grid
    y: FloatArray  #: (g,) arrays; deviations of the grid
    #: (g, g) array; at ``(x[j], y[i])``, see :mod:`~trms_cli.stability.attraction.region`
    fate: IntArray
    #: tuple of ((k, n) array, bool); motions that begin in it, as deviations y, and whether they
    #: come to rest
    paths: tuple[tuple[FloatArray, bool], ...]


@dataclass(frozen=True)
class AttractionRegion:
    """All that was found out."""

    system: ReducedSystem
    starts: StartSet
    box: FloatArray  #: (m,) array; half-widths of the box in d
    verdicts: tuple[EstimateTest, ...]
    #: Of the box that comes to rest. Where time was cut off, what is undecided widens its upper
    #: end.
    truth: ConfidenceShare
    #: ``samples``, ``undecided``: Random starts in the box, and those undecided when time was over
    samples: int
    undecided: int
    duration: float  #: s, until a motion is undecided
    #: s, that the slowest mode would need; above ``duration`` where that was cut off
    settling_time: float
    plane: RegionSection
    rests: tuple[OtherRest, ...]
    #: Labels of methods that were tried and found no set, or none larger than a quadratic's
    nothing: tuple[str, ...]

    @property
    def is_cut_short(self) -> bool:
        """Whether motions were followed for less than the slowest mode needs."""
        return self.duration < self.settling_time

    @property
    def largest(self) -> EstimateTest | None:
        """The largest set that is proved."""
        proved = (v for v in self.verdicts if v.estimate.proved)
        return max(proved, key=lambda v: v.estimate.log_volume, default=None)


def attraction_region(
    system: ReducedSystem,
    request: RegionRequest,
    tell: Tell,
    *,
    starts: StartSet | None = None,
    linear_inside: tuple[ReducedSystem, FloatArray] | None = None,
    box: FloatArray | None = None,
) -> AttractionRegion:
    """Estimates of a region of attraction, proofs of them, and the region by simulation.

    Starts deviate in all states of the system unless they are given. ``linear_inside`` as in
    :func:`~trms_cli.stability.attraction.estimates.estimates`. The half-widths ``box`` (m,) are
    used where the options give none; default: the largest estimate's and some room.
    """
    starts = StartSet.of_all(system) if starts is None else starts
    require_states(request.box, starts.names, "study.box")
    limits = _limits(system, request.box)
    selected_methods = methods_for(system) if request.methods is None else request.methods
    results = estimates(system, limits, selected_methods, request.boxes, tell, linear_inside)
    proved = [e for e in results if e.proved]
    arrival = max(proved, key=lambda e: e.log_volume).contains if proved else _tiny(limits)
    rests = other_rests(system, limits)
    if box is None:
        reaches = [np.abs(e.draw(4000, 1)).max(axis=0, initial=0.0) for e in results]
        reach = np.max(reaches, axis=0) if reaches else 0.2 * limits
        room = _ROOM
        for rest in [rest for rest in rests if not rest.stable][:1]:
            # The nearest saddle is to be seen, and what lies beyond it.
            room = max(room, _BEYOND * float(np.max(np.abs(rest.y) / reach)))
        box = np.minimum(room * reach, limits)
    box = np.array([request.box.get(n, float(r)) for n, r in zip(starts.names, box, strict=True)])
    samples, grid = request.for_states(system.n)
    slowest = float(-system.eigenvalues.real.max())
    settling_time = request.duration or _TIME_CONSTANTS / slowest
    longest = _LONGEST if system.n <= _FEW else _LONGEST_OF_MANY
    duration = request.duration or min(settling_time, longest)
    far = 4.0 * np.maximum(limits, np.abs(starts.matrix) @ box)
    tell(f"{samples} motions from random starts")

    def fate_of(d: FloatArray) -> IntArray:
        return fates(system, starts.of(d), arrival, duration, far)[0]

    random = np.random.default_rng(0)
    fate = fate_of(random.uniform(-1.0, 1.0, (samples, len(box))) * box)
    truth = share_of(int(np.sum(fate == SETTLED)), samples)
    if duration < settling_time:
        # Some of those that time did not suffice for may arrive.
        truth = replace(truth, upper=share_of(int(np.sum(fate != LEFT)), samples).upper)
    tell("motions from starts in the estimates")
    tests = failures(system, results, _TESTED, duration, 1, duration < settling_time)
    verdicts = tuple(
        EstimateTest(e, _covered(e, starts, box, truth), *test)
        for e, test in zip(results, tests, strict=True)
    )
    tell(f"{grid}² motions in a plane")
    plane = _plane(system, starts, request, box, fate_of)
    undecided = int(np.sum(fate == UNDECIDED))
    return AttractionRegion(
        system,
        starts,
        box,
        verdicts,
        truth,
        samples,
        undecided,
        duration,
        settling_time,
        plane,
        tuple(rests),
        tuple(LABELS[m] for m in selected_methods if m not in {e.method for e in results}),
    )


def require_states(
    requested_names: Mapping[str, float] | Sequence[str], state_names: Sequence[str], where: str
) -> None:
    """Refuse names that are not among the states that starts deviate in.

    Raises ConfigurationError.
    """
    for name in requested_names:
        if name not in state_names:
            raise ConfigurationError(
                f"starts do not deviate in {name!r}",
                where=f"{where}.{name}" if isinstance(requested_names, Mapping) else where,
                remedy=nearest(name, state_names) + "; others by study.states",
            )


def _limits(system: ReducedSystem, box: Mapping[str, float]) -> FloatArray:
    """How far estimates are sought: half a turn, and as far in the other states as fits to that."""
    size = np.sqrt(np.diag(np.linalg.inv(from_lyapunov_equation(system))))
    signals = [system.model.states[i] for i in system.positions]
    turns = [s for s, signal in zip(size, signals, strict=True) if signal.unit == "rad"]
    if turns:
        factor = np.pi / max(turns)
    else:
        rest = 1.0 + 2.0 * np.abs(system.point.x[list(system.positions)])
        factor = float(np.max(rest / size))
    half_widths = factor * size
    # Speeds of rotors are weighed lightly by that: let them go as far as they are from zero twice.
    half_widths = np.maximum(half_widths, 2.0 * np.abs(system.point.x[list(system.positions)]))
    return np.array(
        [box.get(signal.name, float(r)) for signal, r in zip(signals, half_widths, strict=True)]
    )


def _tiny(limits: FloatArray) -> Callable[[FloatArray], BoolArray]:
    """Arrival where nothing is proved: within a thousandth of the limits."""
    return lambda y: np.asarray(np.all(np.abs(y) <= 1e-3 * limits, axis=1))


def _covered(
    estimate: RegionEstimate, starts: StartSet, box: FloatArray, truth: ConfidenceShare
) -> ConfidenceShare | None:
    d = np.random.default_rng(2).uniform(-1.0, 1.0, (_COUNTED, len(box))) * box
    hits = int(np.sum(estimate.contains(starts.of(d))))
    if hits >= 100:
        return share_of(hits, _COUNTED).over(truth)
    if not starts.direct or np.any(estimate.extents > box) or truth.value == 0.0:
        return None
    filled = float(np.exp(estimate.log_volume - np.sum(np.log(2.0 * box))))
    return ConfidenceShare(filled, filled, filled).over(truth)


def plane_axes(
    names: Sequence[str], units: Sequence[str], requested_names: Sequence[str]
) -> tuple[int, int]:
    """Positions of the two states of the figure.

    Raises ConfigurationError for names that starts do not deviate in, or not two of them.
    """
    if requested_names:
        require_states(requested_names, names, "study.plane")
        if len(set(requested_names)) != 2:
            raise ConfigurationError(
                f"{', '.join(requested_names)} given", where="study.plane", remedy="name two states"
            )
        return names.index(requested_names[0]), names.index(requested_names[1])
    if len(names) == 1:
        return 0, 0
    angles = [i for i, unit in enumerate(units) if unit == "rad"]
    if not angles:
        return 0, 1
    last = angles[-1]
    rate = "S" + names[last].removeprefix("alpha")
    return last, names.index(rate) if rate in names else next(
        i for i in range(len(names)) if i != last
    )


def plane_starts(axes: tuple[int, int], x: FloatArray, y: FloatArray, size: int) -> FloatArray:
    """Starts on a grid in a plane of two axes, the other coordinates zero, (grid, size)."""
    across, up = np.meshgrid(x, y)
    d = np.zeros((across.size, size))
    d[:, axes[1]], d[:, axes[0]] = up.ravel(), across.ravel()
    return d


def _plane(
    system: ReducedSystem,
    starts: StartSet,
    request: RegionRequest,
    box: FloatArray,
    fate_of: Callable[[FloatArray], IntArray],
) -> RegionSection:
    units = [system.model.states[system.model.state_index(n)].unit for n in starts.names]
    i, j = plane_axes(starts.names, units, request.plane)
    lines = np.linspace(-1.0, 1.0, request.for_states(system.n)[1])
    d = plane_starts((i, j), lines * box[i], lines * box[j], len(box))
    fate = fate_of(d)
    field, positions = VectorField(system.model), list(system.positions)
    random, selection = np.random.default_rng(4), []
    for settled in (True, False):
        rows = np.flatnonzero((fate == SETTLED) == settled)
        if len(rows):
            # Those farthest out among a few: motions are seen, not dots.
            few = random.choice(rows, size=min(len(rows), 6 * _DRAWN), replace=False)
            size = np.abs(d[few] / box).max(axis=1)
            selection += [(k, settled) for k in few[np.argsort(size)[::-1][: _DRAWN // 2]]]
    begin = np.tile(system.point.x, (len(selection), 1))
    begin[:, positions] += starts.of(d[[k for k, _ in selection]])
    path = field.motions(begin, system.point.u, _SHOWN, 0.05, impulses=False)
    path = path[:, :, positions] - system.point.x[positions]
    paths = tuple((path[:, m], settled) for m, (_, settled) in enumerate(selection))
    return RegionSection(
        (i, j), lines * box[i], lines * box[j], fate.reshape(2 * lines.shape), paths
    )
