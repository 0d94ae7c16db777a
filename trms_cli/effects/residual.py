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
from typing import Annotated, ClassVar, Literal

import casadi as ca
from msgspec import Meta

from trms_cli.core.errors import ModelError
from trms_cli.core.plugins import require_known
from trms_cli.effects.effect import Effect, EffectContext, SensorEffect, axis_of, rotor_input
from trms_cli.models.model import Model, index_of
from trms_cli.models.parameters import Parameter

Equation = Literal["pitch_moment", "yaw_moment", "main_motor", "tail_motor"]
#: Bumps over the range of an angle or command of the place's own, and of another one.
_BUMPS, _FEW_BUMPS = 7, 5
#: Half ranges from the middle beyond which a bump stays as it is.
_END = 1.2
#: Harmonics of a turn; what is slower is a matter of the bumps.
HARMONICS = range(3, 17)
#: Of a rate's or a speed's largest value, within which a sign turns.
_SHARP, _SOFT = 0.03, 0.2
#: Middle and half of the range of each variable of a rig of this kind: rad, rad/s, V.
USUAL_SPANS: Mapping[str, tuple[float, float]] = {
    "pitch_angle": (0.0, 0.6),
    "yaw_angle": (0.0, 1.5),
    "pitch_rate": (0.0, 1.0),
    "yaw_rate": (0.0, 1.0),
    "main_speed": (0.0, 200.0),
    "tail_speed": (0.0, 300.0),
    "main_command": (0.0, 2.5),
    "tail_command": (0.0, 2.5),
}

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
        valid_names = term_names(model, self.place)
        for name, _ in self.terms:
            require_known(name, valid_names, f"there is no term {name!r}", "terms", ModelError)
        for name, *_ in self.spans:
            require_known(name, USUAL_SPANS, f"there is no variable {name!r}", "spans", ModelError)

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
        """Middle and half of the range of each variable."""
        return {name: (ca.SX(middle), ca.SX(half)) for name, (middle, half) in self.spanned.items()}

    @property
    def spanned(self) -> dict[str, tuple[float, float]]:
        """Middle and half of the range of each variable, the usual ones where none are given."""
        return {**USUAL_SPANS, **{name: (middle, half) for name, middle, half in self.spans}}


@dataclass(frozen=True, kw_only=True)
class ResidualForce(Residual):
    """A force on an equation."""

    equation: Equation

    @property
    def place(self) -> str:
        return self.equation

    def check(self, model: Model) -> None:
        side, kind = self.equation.split("_")
        axis_of(model, side) if kind == "moment" else rotor_input(model, side)
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
        SensorEffect.check(self, model)
        super().check(model)

    def output(self, at: EffectContext, y: ca.SX) -> ca.SX:
        return self.add_to_channel(at, y, self.value(at))


def term_names(model: Model, place: str) -> tuple[str, ...]:
    """Names of the terms that a model has at a place, in their order."""
    x, u, p, w = model.symbols()
    at = EffectContext(model, x, u, p, w, ca.SX.zeros(0), {})
    spans = {name: (ca.SX(m), ca.SX(h)) for name, (m, h) in USUAL_SPANS.items()}
    return tuple(name for name, _ in terms(at, place, spans))


def variables(at: EffectContext) -> dict[str, ca.SX]:
    """What a term may be of, by name, as far as the model has it: rad, rad/s, V."""
    model = at.model
    expressions: dict[str, ca.SX] = {}
    for axis in ("pitch", "yaw"):
        if axis in model.axes:
            expressions[f"{axis}_angle"], expressions[f"{axis}_rate"] = (
                at.angle(axis),
                at.rate(axis),
            )
    for rotor in ("main", "tail"):
        if rotor in model.rotors:
            expressions[f"{rotor}_command"] = at.u[
                index_of(model.inputs, model.rotors[rotor].input, "input")
            ]
            if rotor in model.rotor_speeds:
                expressions[f"{rotor}_speed"] = at.speed(rotor)
    return expressions


def terms(at: EffectContext, place: str, spans: Spans) -> Iterator[_Term]:
    """The terms at a place, by name."""
    expressions = variables(at)
    scaled = {name: (v - spans[name][0]) / spans[name][1] for name, v in expressions.items()}
    # signs and powers are those of the variable itself: it has a zero of its own
    plain = {
        name: v / (ca.fabs(spans[name][0]) + spans[name][1])
        for name, v in expressions.items()
        if not name.endswith("angle")
    }
    side, kind = place.split("_")
    if kind == "sensor":
        yield from _of_an_angle(f"{side}_angle", expressions, scaled)
    elif kind == "moment":
        own, other = ("main", "tail") if side == "pitch" else ("tail", "main")
        yield from _of_an_axis(
            side, "yaw" if side == "pitch" else "pitch", expressions, scaled, plain
        )
        yield from _of_rotors(own, other, plain)
        yield from _of_thrust(side, own, scaled, plain)
    else:
        axis = "pitch" if side == "main" else "yaw"
        yield from _of_a_drive(side, "tail" if side == "main" else "main", axis, scaled, plain)


def _of_an_angle(
    angle: str, expressions: Mapping[str, ca.SX], scaled: Mapping[str, ca.SX]
) -> Iterator[_Term]:
    yield from _bumps(angle, scaled[angle], _BUMPS)
    for k in HARMONICS:
        yield f"{angle}_sine_{k}", ca.sin(k * expressions[angle])
        yield f"{angle}_cosine_{k}", ca.cos(k * expressions[angle])


def _of_an_axis(
    axis: str,
    other: str,
    expressions: Mapping[str, ca.SX],
    scaled: Mapping[str, ca.SX],
    plain: Mapping[str, ca.SX],
) -> Iterator[_Term]:
    yield from _of_an_angle(f"{axis}_angle", expressions, scaled)
    yield from _with_sign(f"{axis}_rate", plain[f"{axis}_rate"])
    if f"{other}_angle" in expressions:
        yield from _bumps(f"{other}_angle", scaled[f"{other}_angle"], _FEW_BUMPS)
        yield f"{other}_rate", plain[f"{other}_rate"]
        yield f"{other}_rate_square", plain[f"{other}_rate"] * ca.fabs(plain[f"{other}_rate"])


def _of_rotors(own: str, other: str, plain: Mapping[str, ca.SX]) -> Iterator[_Term]:
    for rotor in (own, other):
        for name in (f"{rotor}_speed", f"{rotor}_command"):
            if name in plain:
                v = plain[name]
                yield name, v
                yield f"{name}_square", v * ca.fabs(v)
                yield f"{name}_cube", v**3


def _of_thrust(
    axis: str, own: str, scaled: Mapping[str, ca.SX], plain: Mapping[str, ca.SX]
) -> Iterator[_Term]:
    """Products: thrust that changes with the angles, inflow, gyroscopic torques."""
    speed = f"{own}_speed" if f"{own}_speed" in plain else f"{own}_command"
    if speed not in plain:
        return
    thrust = plain[speed] * ca.fabs(plain[speed])
    for name in ("pitch_angle", "yaw_angle"):
        if name in scaled:
            yield f"thrust_{name}", thrust * scaled[name]
            yield f"thrust_{name}_square", thrust * scaled[name] ** 2
    yield "thrust_rate", ca.fabs(plain[speed]) * plain[f"{axis}_rate"]
    yield f"{axis}_angle_rate", scaled[f"{axis}_angle"] * plain[f"{axis}_rate"]
    other = "yaw_rate" if axis == "pitch" else "pitch_rate"
    if "main_speed" in plain and other in plain:
        yield "gyroscopic", plain["main_speed"] * plain[other]
        yield "gyroscopic_angle", plain["main_speed"] * plain[other] * scaled["pitch_angle"]


def _of_a_drive(
    rotor: str, other: str, axis: str, scaled: Mapping[str, ca.SX], plain: Mapping[str, ca.SX]
) -> Iterator[_Term]:
    speed, command = f"{rotor}_speed", f"{rotor}_command"
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
    if f"{axis}_rate" in plain:
        yield f"{axis}_rate", plain[f"{axis}_rate"]
        moving = plain.get(speed, plain[command])
        yield "thrust_rate", ca.fabs(moving) * plain[f"{axis}_rate"]
        yield from _bumps(f"{axis}_angle", scaled[f"{axis}_angle"], _FEW_BUMPS)


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
