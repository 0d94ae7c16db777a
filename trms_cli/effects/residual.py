"""What has no name: a force on one equation, or an error of one angle's sensor, as smooth terms.

    residual = share · Σ coefficient · term(angles, rates, rotor speeds, commands)

It stands for a law that nobody has written down yet: the yardstick that named causes have to reach
in a diagnosis, and, where none does, what the corrected model gains. Terms are dimensionless, so
that coefficients are in the unit of the place. Bumps and harmonics of a turn follow the angle
wherever it goes (a detent of a dozen teeth is one harmonic), the others have the forms that
physics knows. Bumps are counted from the middle of the range that a variable was seen in, in halves
of it; beyond that range nothing is known, and they stay as at its ends.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

import casadi as ca
from msgspec import Meta

from trms_cli.core.errors import ModelError
from trms_cli.core.plugins import require_known
from trms_cli.effects.effect import Effect, EffectContext, SensorEffect
from trms_cli.models import beam_rig
from trms_cli.models.dry_friction import axis_of
from trms_cli.models.model import Model, index_of
from trms_cli.models.parameters import Parameter
from trms_cli.models.rig_parts import ANGLES, RigParts, parts_of
from trms_cli.models.scales import scales_of

#: Bumps over the range of an angle or command of the place's own, and of another one.
_BUMPS, _FEW_BUMPS = 7, 5
#: Half ranges from the middle beyond which a bump stays as it is.
_END = 1.2
#: Harmonics of a turn; what is slower is a matter of the bumps.
HARMONICS = range(3, 17)
#: Of a rate's or a speed's largest value, within which a sign turns.
_SHARP, _SOFT = 0.03, 0.2
#: rad/s. Half of the range of a rotor's speed.
_USUAL_SPEED = 200.0

#: Middle and half of a variable's range as expressions, by variable.
Spans = Mapping[str, tuple[ca.SX, ca.SX]]
_Term = tuple[str, ca.SX]


@dataclass(frozen=True, kw_only=True)
class Residual(Effect):
    """Terms with their coefficients; ``share`` takes all of it back."""

    #: It explains nothing: it is no candidate unless it is asked for
    explains: ClassVar[bool] = False
    #: Name of each term and its coefficient, in the unit of the place
    terms: tuple[tuple[str, float], ...] = ()
    #: Of variables: the middle and the half of the range that they were seen in
    spans: tuple[tuple[str, float, float], ...] = ()
    share: Annotated[float, Meta(ge=0)] = 1.0

    @property
    def place(self) -> str:
        """Where it acts in the block diagram."""
        raise NotImplementedError

    @property
    def locations(self) -> tuple[str, ...]:
        return (self.place,)

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("share", "1", (0.5, 1.0), "how much of it acts"),)

    def check(self, model: Model) -> None:
        valid_names, usual = term_names(model, self.place), usual_spans(model)
        for name, _ in self.terms:
            require_known(name, valid_names, f"there is no term {name!r}", "terms", ModelError)
        for name, *_ in self.spans:
            require_known(name, usual, f"there is no variable {name!r}", "spans", ModelError)

    def value(self, at: EffectContext) -> ca.SX:
        """All terms together, in the unit of the place."""
        weights, total = self.coefficients(at), ca.SX(0)
        for name, value in terms(at, self.place, self.ranges(at)):
            if name in weights:
                total += weights[name] * value
        return total

    def coefficients(self, at: EffectContext) -> dict[str, ca.SX]:
        """By term."""
        return {name: at.sizes["share"] * value for name, value in self.terms}

    def ranges(self, at: EffectContext) -> Spans:
        """Middle and half of the range of each variable, the usual ones where none are given."""
        given = {name: (middle, half) for name, middle, half in self.spans}
        return symbolic(usual_spans(at.model) | given)


@dataclass(frozen=True, kw_only=True)
class ResidualForce(Residual):
    """A force on an equation."""

    equation: str  #: Name of a disturbance that moves an axis or a rotor

    @property
    def place(self) -> str:
        return self.equation

    def check(self, model: Model) -> None:
        index_of(model.disturbances, self.equation, f"a disturbance of model {model.name!r}")
        super().check(model)

    def disturbance(self, at: EffectContext) -> ca.SX:
        return at.on(self.equation, self.value(at))


@dataclass(frozen=True, kw_only=True)
class ResidualReading(Residual, SensorEffect):
    """An error of an angle's sensor that depends on the angle."""

    axis: str  #: Name of an axis of the model

    @property
    def place(self) -> str:
        return f"{self.axis}_sensor"

    def check(self, model: Model) -> None:
        axis_of(model, self.axis)
        SensorEffect.check(self, model)
        super().check(model)

    def output(self, at: EffectContext, y: ca.SX) -> ca.SX:
        return self.add_to_channel(at, y, self.value(at))


def usual_spans(model: Model) -> dict[str, tuple[float, float]]:
    """Middle and half of the range of each variable, as rigs of a model usually have them."""
    if model.bench_sizes:
        return dict(beam_rig.USUAL_SPANS)
    model = model.without_effects()
    parts, scales = parts_of(model), scales_of(model)
    halves: dict[str, float] = {}
    for axis in model.axes:
        halves[_variable(parts.angle(axis))] = scales.travels[axis]
        halves[_variable(parts.rate(axis))] = scales.travels[axis] / scales.time
    halves |= {f"{drive}_command": scales.inputs[name] for drive, name in parts.drives.items()}
    halves |= {f"{rotor}_speed": _USUAL_SPEED for rotor in model.rotor_speeds}
    return {name: (0.0, half) for name, half in halves.items()}


def symbolic(spans: Mapping[str, tuple[float, float]]) -> Spans:
    """As expressions."""
    return {name: (ca.SX(middle), ca.SX(half)) for name, (middle, half) in spans.items()}


def term_names(model: Model, place: str) -> tuple[str, ...]:
    """Names of the terms that a model has at a place, in their order."""
    x, u, p, w = model.symbols()
    at = EffectContext(model, x, u, p, w, ca.SX.zeros(0), {})
    return tuple(name for name, _ in terms(at, place, symbolic(usual_spans(model))))


def _variable(words: str) -> str:
    """*yaw angle* as ``yaw_angle``; of an axis that there is not, what no variable is called."""
    return words.replace(" ", "_")


def variables(at: EffectContext) -> dict[str, ca.SX]:
    """What a term may be of, by name, as far as the model has it: rad or m, by s, V."""
    model, parts = at.model, parts_of(at.model)
    expressions: dict[str, ca.SX] = {}
    for axis in model.axes:
        expressions[_variable(parts.angle(axis))] = at.angle(axis)
        expressions[_variable(parts.rate(axis))] = at.rate(axis)
    for drive, name in parts.drives.items():
        expressions[f"{drive}_command"] = at.u[index_of(model.inputs, name, "input")]
        if drive in model.rotor_speeds:
            expressions[f"{drive}_speed"] = at.speed(drive)
    return expressions


def terms(at: EffectContext, place: str, spans: Spans) -> Iterator[_Term]:
    """The terms at a place, by name."""
    expressions, parts = variables(at), parts_of(at.model)
    scaled = {name: (v - spans[name][0]) / spans[name][1] for name, v in expressions.items()}
    # signs and powers are those of the variable itself: it has a zero of its own
    plain = {
        name: v / (ca.fabs(spans[name][0]) + spans[name][1])
        for name, v in expressions.items()
        if not name.endswith(ANGLES)
    }
    part, kind = parts.part_of(place), parts.kind_of(place)
    if kind == "sensor":
        yield from _of_an_angle(parts, part, expressions, scaled)
    elif kind == "moment":
        own = parts.drive_of(part)
        yield from _of_an_angle(parts, part, expressions, scaled)
        yield from _of_rates(parts, part, scaled, plain)
        yield from _of_rotors(own, parts.other_drive(own), plain)
        yield from _of_thrust(parts, part, own, scaled, plain)
    elif kind == "motor":
        yield from _of_a_drive(parts, part, scaled, plain)


def _of_an_angle(
    parts: RigParts, axis: str, expressions: Mapping[str, ca.SX], scaled: Mapping[str, ca.SX]
) -> Iterator[_Term]:
    angle = _variable(parts.angle(axis))
    yield from _bumps(angle, scaled[angle], _BUMPS)
    for k in HARMONICS if parts.turns(axis) else ():
        yield f"{angle}_sine_{k}", ca.sin(k * expressions[angle])
        yield f"{angle}_cosine_{k}", ca.cos(k * expressions[angle])


def _of_rates(
    parts: RigParts, axis: str, scaled: Mapping[str, ca.SX], plain: Mapping[str, ca.SX]
) -> Iterator[_Term]:
    """Of the own rate, and of another axis' angle and rate."""
    rate, other = _variable(parts.rate(axis)), parts.other_axis(axis)
    yield from _with_sign(rate, plain[rate])
    angle, rate = _variable(parts.angle(other)), _variable(parts.rate(other))
    if angle in scaled:
        yield from _bumps(angle, scaled[angle], _FEW_BUMPS)
        yield rate, plain[rate]
        yield f"{rate}_square", plain[rate] * ca.fabs(plain[rate])


def _of_rotors(own: str, other: str, plain: Mapping[str, ca.SX]) -> Iterator[_Term]:
    for rotor in (own, other):
        for name in (f"{rotor}_speed", f"{rotor}_command"):
            if name in plain:
                v = plain[name]
                yield name, v
                yield f"{name}_square", v * ca.fabs(v)
                yield f"{name}_cube", v**3


def _of_thrust(
    parts: RigParts, axis: str, own: str, scaled: Mapping[str, ca.SX], plain: Mapping[str, ca.SX]
) -> Iterator[_Term]:
    """Products: thrust that changes with the angles, inflow, gyroscopic torques."""
    speed = f"{own}_speed" if f"{own}_speed" in plain else f"{own}_command"
    if speed not in plain:
        return
    # what is no rotor pushes in proportion
    thrust = plain[speed] * (ca.fabs(plain[speed]) if own in parts.rotors else 1.0)
    rate, other = (_variable(parts.rate(name)) for name in (axis, parts.other_axis(axis)))
    for name in (_variable(parts.angle(any_axis)) for any_axis in parts.axes):
        yield f"thrust_{name}", thrust * scaled[name]
        yield f"thrust_{name}_square", thrust * scaled[name] ** 2
    yield "thrust_rate", ca.fabs(plain[speed]) * plain[rate]
    angle = _variable(parts.angle(axis))
    yield f"{angle}_rate", scaled[angle] * plain[rate]
    spin = f"{parts.drive_of(parts.tilting)}_speed"
    if spin in plain and other in plain:
        yield "gyroscopic", plain[spin] * plain[other]
        tilting = _variable(parts.angle(parts.tilting))
        yield "gyroscopic_angle", plain[spin] * plain[other] * scaled[tilting]


def _of_a_drive(
    parts: RigParts, rotor: str, scaled: Mapping[str, ca.SX], plain: Mapping[str, ca.SX]
) -> Iterator[_Term]:
    speed, command, other = f"{rotor}_speed", f"{rotor}_command", parts.other_drive(rotor)
    axis = parts.rotors[rotor].axis
    angle, rate = _variable(parts.angle(axis)), _variable(parts.rate(axis))
    if speed in plain:
        yield from _with_sign(speed, plain[speed])
        yield from _bumps(speed, scaled[speed], _FEW_BUMPS)
    yield from _with_sign(command, plain[command])
    yield from _bumps(command, scaled[command], _BUMPS)
    if f"{other}_command" in plain:
        load = plain[f"{other}_command"]
        yield f"{other}_command", load
        yield f"{command}_load", plain[command] * load
        yield f"{command}_load_square", plain[command] * load**2
    if f"{other}_speed" in plain:
        yield f"{other}_speed", plain[f"{other}_speed"]
    if rate in plain:
        yield rate, plain[rate]
        moving = plain.get(speed, plain[command])
        yield "thrust_rate", ca.fabs(moving) * plain[rate]
        yield from _bumps(angle, scaled[angle], _FEW_BUMPS)


def _bumps(name: str, scaled: ca.SX, count: int) -> Iterator[_Term]:
    """Gaussian bumps side by side over the range; beyond it, as at its ends."""
    inside = ca.fmin(ca.fmax(scaled, -_END), _END)
    width = 2.0 / (count - 1)
    for i in range(count):
        centre = -1.0 + i * width
        yield f"{name}_bump_{i + 1}", ca.exp(-(((inside - centre) / width) ** 2))


def _with_sign(name: str, v: ca.SX) -> Iterator[_Term]:
    yield name, v
    yield f"{name}_square", v * ca.fabs(v)
    yield f"{name}_sign", ca.tanh(v / _SHARP)
    yield f"{name}_soft_sign", ca.tanh(v / _SOFT)
