"""What is claimed of an energy function, how each claim was checked, and motions beside it.

An energy is stated for the Newtonian and the Lagrangian rig; effects that only resist motion leave
it one. Of a function with its sets N and N′ each claim says how it was checked:

form        true of the expressions as they stand (derived in the documentation, by sympy in tests)
identity    derived, and the two sides evaluated on this model's own equations at many states
intervals   proved over boxes in interval arithmetic
simulated   seen along motions of the model; no proof
failed      a counterexample is shown: a state at which V rises, confirmed in interval arithmetic
open        neither proved nor refuted
"""

import math
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.quadratic_damping import QuadraticDamping
from trms_cli.effects.stribeck_friction import StribeckFriction
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.models.twin_rotor import TwinRotor
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval
from trms_cli.stability.lyapunov.candidate import (
    EnergyCandidate,
    LevelSearchResult,
    Wells,
    definite,
    rays,
    search_levels,
    stop_level,
)
from trms_cli.stability.lyapunov.energy import Energy
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import Subject, effects_of

#: Effects that only take energy from an axis: power −F_c|Ω| and the like.
_RESISTING = (CoulombFriction, StribeckFriction, QuadraticDamping)
_DRY = (CoulombFriction, StribeckFriction)
_INSTEAD = "study=region_of_attraction finds functions by computation for any model with equations"


@dataclass(frozen=True)
class EnergyRig:
    """What the energy is of."""

    model: TwinRotor  #: Without effects
    #: ``resisting``, ``dry``: Names of the effects that resist motion, and of those among them that
    #: hold it at rest
    resisting: tuple[str, ...]
    dry: tuple[str, ...]


def rig_of(subject: Subject) -> EnergyRig:
    """The rig beneath a subject.

    Raises ModelError for a model whose energy is not stated here, and for an effect that changes
    it.
    """
    model: Model = subject.require_equations("a Lyapunov function")
    resisting: list[str] = []
    dry: list[str] = []
    for name, effect in effects_of(model):
        if isinstance(effect, _RESISTING):
            resisting.append(name)
            if isinstance(effect, _DRY):
                dry.append(name)
        else:
            raise ModelError(
                f"effect {name!r} changes the motion in a way that the energy does not follow",
                where=f"effect.{name}",
                remedy="leave it out; friction and damping of an axis may stay. " + _INSTEAD,
            )
    model = model.without_effects()
    if not isinstance(model, Newtonian | Lagrangian):
        raise ModelError(
            f"the energy of model {subject.name!r} is not stated here, only that of the Newtonian "
            "and the Lagrangian TRMS",
            where="model",
            remedy="choose model=newtonian, newtonian_vertical, newtonian_horizontal or lagrangian "
            f"(lagrangian_…) with any parameters; {_INSTEAD}",
        )
    if model.stiff:
        raise ModelError(
            "the functions are those of rotors with quasi-static currents, and this model has the "
            "currents as states",
            where="model.currents",
            remedy="model.currents=quasi_static (it differs by less than 1e-4 rad)",
        )
    _require_friction_and_cable(model)
    return EnergyRig(model, tuple(resisting), tuple(dry))


def _require_friction_and_cable(model: TwinRotor) -> None:
    c = {p.name: p.value for p in model.parameters}
    for axis, name in (("h", "yaw"), ("v", "pitch")):
        if f"alpha_{axis}" in model.state_names and not c[f"k_o{axis}"] > 0.0:
            raise ModelError(
                f"k_o{axis} = {c[f'k_o{axis}']:g}: without viscous friction of {name} its energy "
                "has nothing to fall by",
                where=f"model.parameters.k_o{axis}",
                remedy="give it a value above 0",
            )
    if "alpha_h" in model.state_names and not min(c["k_chp"], c["k_chn"]) > 0.0:
        raise ModelError(
            "without a cable that pulls back (k_chp, k_chn > 0) yaw rests anywhere: there is no "
            "single equilibrium to prove",
            where="model.parameters.k_chp",
            remedy="give both a value above 0, or choose model=newtonian_vertical",
        )


_RAYS = 1500
_PLACES = 16
_ROUNDS = 4
#: Step along a direction of unit energy at which Q is looked at again: V of some 0.01 J.
_FAR = 0.14


@dataclass(frozen=True)
class RisingState:
    """A state at which V rises."""

    x: FloatArray  #: (n_x,) array
    y: FloatArray  #: (3k,) array; the same as a state of motion
    value: float  #: V in J and V̇ in W
    derivative: float  #: V̇ > 0 is confirmed with outward rounding

    @property
    def speed(self) -> float:
        """V̇/V, 1/s."""
        return self.derivative / self.value


def lowest_rising(candidate: EnergyCandidate, wells: Wells, ceiling: float) -> RisingState | None:
    """The state of lowest V found at which V̇ > 0; None where none is found below a ceiling (J)."""
    y, k = candidate.centre, candidate.energy.k
    directions = np.concatenate([rays(candidate, _RAYS), _weak(candidate, _FAR)])
    lowest, best = ceiling, None
    reaches = np.geomspace(1e-3, 1.3, _PLACES)
    for turn in range(_ROUNDS):
        steps = math.sqrt(2.0 * lowest) * reaches
        places = (y + directions[:, None, :] * steps[:, None]).reshape(-1, 3 * k)
        places = places[wells.hold(places)]
        states = candidate.states(places)
        values, rates = candidate.value(places), candidate.derivative(states)
        rises = (rates > 0.0) & (values < lowest)
        if not rises.any():
            break
        at = int(np.argmin(np.where(rises, values, np.inf)))
        state = _confirmed(candidate, states[at], places[at])
        if state is None:
            break
        lowest, best = state.value, state
        # Again around it, ever closer.
        along = (places[at] - y) / math.sqrt(2.0 * lowest)
        spread = np.random.default_rng(turn).normal(size=(_RAYS, 3 * k)) * 0.5 / (1 + turn)
        directions = along * (1.0 + spread)
        reaches = np.linspace(0.6, 1.0, _PLACES)
    return best


def fastest_rising(candidate: EnergyCandidate, wells: Wells, ceiling: float) -> RisingState | None:
    """Where V falls in no neighbourhood: the state on {V ≈ ceiling/100} with the largest V̇/V."""
    y, k = candidate.centre, candidate.energy.k
    step = math.sqrt(0.02 * ceiling)
    directions = np.concatenate([rays(candidate, _RAYS), _weak(candidate, step)])
    best: RisingState | None = None
    for turn in range(_ROUNDS):
        places = y + step * directions
        states = candidate.states(places)
        values, rates = candidate.value(places), candidate.derivative(states)
        within = wells.hold(places)
        quality = np.where(within & (rates > 0.0), rates / np.maximum(values, 1e-300), -np.inf)
        at = int(np.argmax(quality))
        if not quality[at] > 0.0:
            break
        state = _confirmed(candidate, states[at], places[at])
        if state is not None and (best is None or state.speed > best.speed):
            best = state
        spread = np.random.default_rng(turn).normal(size=(_RAYS, 3 * k)) * 0.5 / (1 + turn)
        directions = np.concatenate([directions[at] * (1.0 + spread), directions[at : at + 1]])
    return best


def _weak(candidate: EnergyCandidate, step: float) -> FloatArray:
    """Directions in which Q is least, at the equilibrium and where that has led: (m, 3k).

    Scaled so that V is about ½ at a step of one.
    """
    size = 3 * candidate.energy.k
    directions = [np.eye(size)[i] * sign for i in range(size) for sign in (-1.0, 1.0)]
    at_rest = _least(candidate, candidate.centre)
    directions += [at_rest, -at_rest]
    directions = [_scaled(candidate, direction) for direction in directions]
    for start in tuple(directions):
        direction = start
        for _ in range(2):
            place = candidate.centre + step * direction
            least = _least(candidate, place)
            least = least if float(least @ direction) >= 0.0 else -least
            direction = _scaled(candidate, least)
            directions.append(direction)
    return np.array(directions)


def _least(candidate: EnergyCandidate, y: FloatArray) -> FloatArray:
    """The deviation with the eigenvector of Q(y) that falls least, its rotors by their slope."""
    energy, k = candidate.energy, candidate.energy.k
    _, vectors = np.linalg.eigh(candidate.matrices(Interval.point(y[None])).middle[0])
    z = np.concatenate([vectors[:, 0], np.zeros(3 * k - len(vectors))])
    slopes = []
    for a in energy.axes:
        speed = ca.SX.sym("speed")
        slope = ca.jacobian(energy.settling(a, speed), speed)
        at = float(candidate.centre[energy.index("omega", a)])
        slopes.append(float(ca.Function("slope", [speed], [slope])(at)))
    return np.concatenate([z[:k], z[k : 2 * k] / np.array(slopes), z[2 * k :]])


def _scaled(candidate: EnergyCandidate, direction: FloatArray) -> FloatArray:
    value = float(candidate.value(candidate.centre + 1e-3 * direction)[0])
    return np.asarray(direction * 1e-3 * math.sqrt(0.5 / max(value, 1e-300)))


def _confirmed(candidate: EnergyCandidate, x: FloatArray, y: FloatArray) -> RisingState | None:
    """The state, if V̇ > 0 there without doubt."""
    bounds = Enclosure(candidate.energy.derivative)(
        Interval.point(x[None]), candidate.rest, Interval.point(candidate.weights.array())
    )[0]
    if not bounds.lower[0, 0] > 0.0:
        return None
    rate = float(candidate.derivative(x)[0])
    return RisingState(x, y, float(candidate.value(y)[0]), rate)


How = Literal["form", "identity", "intervals", "simulated", "failed", "open"]

#: States at which an identity is evaluated, and how far apart its sides may be, as a share of the
#: largest term in it.
_STATES = 500
_TOLERANCE = 1e-8
_PITCHES = 64


@dataclass(frozen=True)
class StabilityClaim:
    """One statement."""

    name: str  #: Short, for programs: ``falls``
    statement: str
    how: How
    detail: str  #: Figures of the check

    @property
    def holds(self) -> bool:
        return self.how not in ("failed", "open")


def identity_residual(candidate: EnergyCandidate, seed: int, states: int = _STATES) -> float:
    """Largest difference between the two sides, as a share of the largest term of either."""
    energy, k, y = candidate.energy, candidate.energy.k, candidate.centre
    random = np.random.default_rng(seed)
    sizes = np.repeat([1.0, 60.0, 0.7], k)
    places = y + sizes * random.normal(size=(states, 3 * k))
    rates = candidate.derivative(candidate.states(places))
    weights, worst = candidate.weights.array(), 0.0
    for place, rate in zip(places, rates, strict=True):
        z = np.array(energy.deviations(place, y)).ravel()
        matrix = np.array(energy.decay(place, energy.slopes_between(place, y), weights))
        terms = np.outer(z, z) * matrix
        worst = max(worst, abs(rate + terms.sum()) / max(float(np.abs(terms).max()), 1e-12))
    return worst


def positive_claim(result: LevelSearchResult) -> StabilityClaim:
    """V > 0 in the well but at the equilibrium."""
    candidate, boxes = result.candidate, sum(p.examined for p in result.wells.proofs)
    heavy = bool(definite(candidate.inertias(_pitches(candidate, result)))[0].all())
    has_positive_hold = _hold_is_positive(candidate, result)
    parts = [f"wells rise up to the saddles ({boxes} boxes)" if boxes else "wells rise (springs)"]
    parts.append("M ≻ 0, s' > 0")
    if candidate.weights.strict:
        parts.append("K − ME ≻ 0")
    good = result.wells.rise and heavy and has_positive_hold
    return StabilityClaim(
        "positive",
        "V > 0 in the well, but for the equilibrium",
        "intervals" if good else "open",
        "a sum of terms none of which is negative: " + ", ".join(parts)
        if good
        else "not proved: the wells do not rise all over, or a weight is too large",
    )


def _pitches(candidate: EnergyCandidate, result: LevelSearchResult) -> Interval:
    """Ranges of the pitch that cover the well, (n, 3k) boxes with all else zero."""
    energy = candidate.energy
    boxes = np.zeros((_PITCHES, 3 * energy.k))
    lower, upper = boxes, boxes.copy()
    if "v" in energy.axes:
        i, j = energy.axes.index("v"), energy.index("alpha", "v")
        edges = np.linspace(result.wells.ends.lower[i], result.wells.ends.upper[i], _PITCHES + 1)
        lower[:, j], upper[:, j] = edges[:-1], edges[1:]
    return Interval(lower, upper)


def _hold_is_positive(candidate: EnergyCandidate, result: LevelSearchResult) -> bool:
    """K/ε − M ≻ 0, so that ½ α̃ᵀE(K − ME)α̃ >= 0."""
    if not candidate.weights.strict:
        return True
    energy, w = candidate.energy, candidate.weights
    inertia = candidate.inertias(_pitches(candidate, result))
    cross = {"h": w.cross_h, "v": w.cross_v}
    hold = np.diag([energy.c[f"k_o{a}"] / cross[a] for a in energy.axes])
    matrix = Interval.point(np.broadcast_to(hold, inertia.lower.shape)) - inertia
    return bool(definite(matrix)[0].all())


def global_falling_claim(candidate: EnergyCandidate) -> StabilityClaim | None:
    """With one axis: c (4 k_o) > (lever ψ_max)², so that V̇ <= 0 at all states."""
    energy, w = candidate.energy, candidate.weights
    if energy.k != 1 or w.strict:
        return None
    (a,) = energy.axes
    bound = energy.rotors[a].bound
    if not math.isfinite(bound):
        return None
    c = energy.c
    spent = (c["l_t" if a == "h" else "l_m"] * bound) ** 2
    damping = 4.0 * c[f"k_o{a}"] * (w.rotor_h if a == "h" else w.rotor_v)
    return StabilityClaim(
        "falls_everywhere",
        "V̇ <= 0 at all states: the square is complete, (l ψ_max)² < 4 k_o c",
        "form" if spent < damping else "failed",
        f"{spent:.4g} < {damping:.4g}, with ψ < ψ_max = max k_f J/k_t = {bound:.4g} N s²/rad",
    )


def falling_claim(
    result: LevelSearchResult, level: float, rising: RisingState | None
) -> StabilityClaim:
    """V̇ < 0 on the set, but where z = 0."""
    if level > 0.0:
        where = "the equilibrium" if result.candidate.weights.strict else "z = 0"
        statement = f"V̇ < 0 on {{V < {level:.4g} J}} in the well, but at {where}"
        detail = f"Q ≻ 0, boxes that cover it: {result.decay_level.examined}"
        return StabilityClaim("falls", statement, "intervals", detail)
    statement = "V̇ <= 0 about the equilibrium"
    if rising is not None:
        detail = f"V̇ = {rising.derivative:.3g} W at a state with V = {rising.value:.3g} J"
        return StabilityClaim("falls", statement, "failed", detail)
    detail = "Q is not definite at rest"
    if result.wells.depth <= 0.0:
        statement = "V̇ < 0 on a level set in the well"
        detail = "the barrier is lower than its bounds are wide: no level below it is known"
    return StabilityClaim("falls", statement, "open", detail)


def invariance_claim(result: LevelSearchResult, inner: float, bounded_by: str) -> StabilityClaim:
    """That N′ is compact and kept."""
    box = result.candidate.extent(inner, result.wells.ends)
    finite = bool(np.all(np.isfinite(box.lower) & np.isfinite(box.upper)))
    return StabilityClaim(
        "kept",
        f"N′ = {{V <= {inner:.4g} J}} is compact and no motion leaves it",
        "intervals" if finite else "open",
        f"a level set below {bounded_by}, in a box of finite size; V does not rise on it",
    )


def attraction_claim(result: LevelSearchResult, dry: tuple[str, ...]) -> StabilityClaim:
    """What the invariance principle concludes."""
    if dry:
        return StabilityClaim(
            "attracts",
            "Motions from N′ come to rest where dry friction holds the axis",
            "form",
            "V̇ = 0 only at Ω = 0, ω = ω̄; there an axis stays while |U'(α)| <= F_c: rests are a "
            "set about the equilibrium",
        )
    strict = result.candidate.weights.strict
    if strict:
        detail = "V̇ < 0 on N′ but at the equilibrium: Lyapunov's theorem, without LaSalle"
    else:
        detail = (
            "V̇ = 0 only at Ω = 0, ω = ω̄; to stay there takes U'(α) = 0, which in the well is the "
            "equilibrium alone: LaSalle"
        )
    return StabilityClaim(
        "attracts",
        "Every motion from N′ goes to the equilibrium",
        "intervals" if result.wells.rise else "open",
        detail,
    )


#: N′ is closed, and strictly inside N.
_INSIDE = 0.999
#: J: no deeper are states sought at which V rises.
_DEEPEST = 1.0


@dataclass(frozen=True)
class LyapunovCertificate:
    """What is known of a function."""

    search: LevelSearchResult
    everywhere: bool  #: Whether N is the whole space
    outer: float  #: N is the part of {V < outer} about the equilibrium, J; 0: none is proved
    inner: float  #: N′ is the part of {V <= inner} about it, J; 0: there is none
    #: What ends N′: ``the saddle``, ``the stop alpha_v = 1.05 rad``, ``the decay of V``
    bounded_by: str
    rising: RisingState | None  #: The state of lowest V at which V rises, of those found
    claims: tuple[StabilityClaim, ...]

    @property
    def holds(self) -> bool:
        return self.outer > 0.0 and all(claim.holds for claim in self.claims)


def certify(
    rig: EnergyRig, point: OperatingPoint, function: str, budget: int, seed: int, tell: Tell
) -> LyapunovCertificate:
    """Choose a function, and check every claim about it.

    The point is that of the model without effects. Raises ConfigurationError where dry friction and
    cross terms would meet.
    """
    energy = Energy(rig.model, point.u)
    # Where yaw is held against the tail rotor's thrust the plain energy cannot fall: its moment
    # turns with cos α_v and has no potential, and V̇ has a term l_t F̄_h (cos α_v − cos ᾱ_v) Ω_h
    # that nothing in −zᵀQz outweighs without the angles in z.
    inputs = [signal.name for signal in energy.model.inputs]
    pushed = energy.k == 2 and bool(abs(energy.u[inputs.index("u_h")]) > 0.0)
    strict = function == "strict" or (function == "auto" and pushed)
    if strict and rig.resisting:
        raise ConfigurationError(
            f"a strict function does not fall by friction alone, and {rig.resisting[0]} is given",
            where="study.function",
            remedy="study.function=energy, at yaw 0 for a model of two axes (study.at.alpha_v=0); "
            "or leave the effect out",
        )
    tell("weights of V")
    result = search_levels(energy, point.x, strict, budget)
    everywhere = global_falling_claim(result.candidate)
    whole = everywhere is not None and everywhere.holds and result.wells.saddles is None
    outer = result.level if not whole else math.inf
    inner, bounded_by = _inner(result, outer)
    tell("where V rises")
    rising = None
    ceiling = min(result.wells.depth, _DEEPEST)
    if result.level < ceiling and (everywhere is None or not everywhere.holds):
        seek = lowest_rising if result.level > 0.0 else fastest_rising
        rising = seek(result.candidate, result.wells, ceiling)
    tell("claims")
    width = float(result.candidate.rest.width.max())
    residual = identity_residual(result.candidate, seed)
    claims = [
        StabilityClaim(
            "equilibrium",
            "There is an equilibrium within the bounds, and V and V̇ are zero there",
            "intervals",
            f"change of sign of each balance; bounds no wider than {width:.1g} rad/s or rad",
        ),
        StabilityClaim(
            "derivation",
            "V̇ = −zᵀQz along the model's own equations",
            "identity" if residual <= _TOLERANCE else "failed",
            f"largest difference at {_STATES} random states: {residual:.1g} of the largest term",
        ),
        positive_claim(result),
        *([everywhere] if everywhere is not None else []),
    ]
    proved = min(outer, result.level)
    claims.append(falling_claim(result, proved, rising))
    if proved > 0.0 and inner > 0.0:
        claims.append(invariance_claim(result, inner, bounded_by))
        claims.append(attraction_claim(result, rig.dry))
    return LyapunovCertificate(result, whole, outer, inner, bounded_by, rising, tuple(claims))


def _inner(result: LevelSearchResult, outer: float) -> tuple[float, str]:
    """The level of N′, and what ends it."""
    stop, name = stop_level(result.candidate, result.wells.ends)
    proved = min(outer, result.level)
    if stop <= 0.0 or proved <= 0.0:
        return 0.0, f"the stop {name}" if stop <= 0.0 else "the decay of V"
    if stop <= proved * (1.0 + 1e-9):
        return _INSIDE * stop, f"the stop {name}"
    if proved >= result.wells.depth * (1.0 - 1e-9):
        return _INSIDE * proved, "the saddle"
    return _INSIDE * proved, "the decay of V"


_STEP = 0.05
_DOUBLINGS = 60
_HALVINGS = 50
#: Rise of V, as a share of its level at the start, that the integrator's error may make.
_ERROR = 1e-6


@dataclass(frozen=True)
class LevelMotions:
    """Motions from one level set."""

    time: FloatArray  #: (n,) array; s
    y: FloatArray  #: (n, m, 3k) array; states of motion
    value: FloatArray  #: (n, m) array; V, J
    level: float  #: V at the start, J

    @property
    def rise(self) -> float:
        """The largest rise of V above anything it was before, as a share of the level."""
        before = np.minimum.accumulate(self.value, axis=0)
        return float(np.max(self.value - before) / self.level)

    @property
    def final_share(self) -> float:
        """The largest share of V that is left at the end."""
        return float(np.max(self.value[-1]) / self.level)


def on_level(
    candidate: EnergyCandidate, wells: Wells, level: float, directions: FloatArray
) -> FloatArray:
    """States of motion with V = level, one on each ray that meets it in the well: (m, 3k)."""
    y, k = candidate.centre, candidate.energy.k
    angles = directions[:, 2 * k :]
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = np.where(angles > 0.0, wells.ends.upper, wells.ends.lower)
        ends = (sides - y[2 * k :]) / angles
    ends = np.where(angles == 0.0, np.inf, ends).min(axis=1)

    def below(steps: FloatArray) -> BoolArray:
        return np.asarray(candidate.value(y + steps[:, None] * directions) < level)

    low, high = np.zeros(len(directions)), np.minimum(1e-3, ends)
    for _ in range(_DOUBLINGS):
        short = below(high) & (high < ends)
        if not short.any():
            break
        low = np.where(short, high, low)
        high = np.where(short, np.minimum(2.0 * high, ends), high)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        under = below(middle)
        low, high = np.where(under, middle, low), np.where(under, high, middle)
    states = y + low[:, None] * directions
    return np.asarray(states[np.abs(candidate.value(states) - level) < 1e-6 * level])


def plane_directions(candidate: EnergyCandidate, axis: str, count: int) -> FloatArray:
    """Directions in the plane of one angle and its rate, the rotors settled: (count, 3k)."""
    energy = candidate.energy
    turn = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False) + 0.3
    directions = np.zeros((count, 3 * energy.k))
    directions[:, energy.index("alpha", axis)] = 0.5 * np.cos(turn)
    directions[:, energy.index("Omega", axis)] = np.sin(turn)
    return directions


def motions(
    candidate: EnergyCandidate, model: Model, starts: FloatArray, level: float, duration: float
) -> LevelMotions:
    """Motions of a model, with its effects, from states of motion (m, 3k)."""
    states = candidate.states(starts)
    n = states.shape[1]
    whole = np.tile(model.rest(), (len(states), 1))
    whole[:, :n] = states
    path = VectorField(model).motions(whole, candidate.energy.u, duration, _STEP)
    count, m = path.shape[:2]
    y = candidate.motions(path[:, :, :n].reshape(-1, n)).reshape(count, m, -1)
    value = candidate.value(y.reshape(count * m, -1)).reshape(count, m)
    return LevelMotions(np.linspace(0.0, _STEP * (count - 1), count), y, value, level)


def motions_claim(paths: LevelMotions, duration: float) -> StabilityClaim:
    """Whether V fell along all of them."""
    good = bool(np.isfinite(paths.value).all()) and paths.rise <= _ERROR
    return StabilityClaim(
        "seen",
        f"Along {paths.value.shape[1]} motions from the edge of N′ V falls and none leaves N′",
        "simulated" if good else "failed",
        f"largest rise {paths.rise:.1g} of the level; at most {100 * paths.final_share:.2g} % of V "
        f"is left after {duration:g} s",
    )
