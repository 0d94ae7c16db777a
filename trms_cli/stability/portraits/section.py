"""The two or three coordinates of a portrait: states by name, and the rates of angles.

A rate (``rate_v`` is dα_v/dt) is no state of the models whose states are angular momenta. It is a
function of the states: the row of its angle in f. A point of the portrait fixes it through the
state that it depends on most, its partner (S_v for ``rate_v``).

The section of the state space that a portrait lies in, and the field on it.

A portrait of n_c coordinates c of a model of n_x states shows the surface of the states x that

    c(x) = c,     x_k = x_k°  for the states that are held,     f_k(x, u) = 0  for those settled,

with x° the operating point. Newton's method finds x(c), at many points at once. Implicit
differentiation gives its slope, J dx/dc = [I; 0], and with it two things: the field's own slopes in
the section, and how far the section is from being invariant,

    d = f(x(c), u) − (dx/dc) ċ.

Where d = 0 no motion leaves the section, and the portrait is the motion itself; elsewhere it is a
cut through the field, and trajectories drawn over it are projections.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.core.plugins import require_known
from trms_cli.core.wording import symbol
from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint, operating_point
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.local.linear import Linear

_RATE, _ANGLE = "rate_", "alpha_"
#: A rate that changes with no state by more than this can be set through none of them.
_LEAST_SLOPE = 1e-2


@dataclass(frozen=True)
class Coordinate:
    """A coordinate of a portrait."""

    name: str  #: As it is asked for: a state, or ``rate_v``
    unit: str
    state: int  #: The state, or the angle whose rate it is
    is_rate: bool = False

    @property
    def label(self) -> str:
        """``α_v``, ``dα_v/dt``."""
        if self.is_rate:
            return f"d{symbol(_ANGLE + self.name.removeprefix(_RATE))}/dt"
        return symbol(self.name)

    @property
    def rate_label(self) -> str:
        """``dα_v/dt``, ``d²α_v/dt²``."""
        if self.is_rate:
            return f"d²{symbol(_ANGLE + self.name.removeprefix(_RATE))}/dt²"
        return f"d{self.label}/dt"


def rate_names(model: Model) -> dict[str, str]:
    """Angle by the name of its rate, for the angles of the model's axes."""
    angles = [axis.angle for axis in model.axes.values()]
    return {_RATE + angle.removeprefix(_ANGLE): angle for angle in angles}


def default_states(model: Model) -> tuple[str, ...]:
    """Angle and rate of the first axis; for a model without axes its two or three states."""
    for rate, angle in rate_names(model).items():
        if angle in model.controlled[:1]:
            return (angle, rate)
    return tuple(reversed(model.state_names[-2:]))


class PortraitCoordinates:
    """The coordinates of a portrait of a model.

    Names are two or three: states, or rates of angles (``rate_v``); on which states rates depend is
    judged at the point. Raises as :func:`check_states`.
    """

    def __init__(self, field: VectorField, names: Sequence[str], point: OperatingPoint) -> None:
        self.field, self.model = field, field.model
        check_states(self.model, names)
        self.items = tuple(_coordinate(self.model, name, i) for i, name in enumerate(names))
        self.partners = self._partners(point)

    def __len__(self) -> int:
        return len(self.items)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(item.name for item in self.items)

    @cached_property
    def own(self) -> tuple[int, ...]:
        """States that a point of the portrait fixes: coordinates, and partners of rates."""
        states = [item.state for item in self.items if not item.is_rate]
        return tuple(sorted({*states, *self.partners.values()}))

    @cached_property
    def others(self) -> tuple[int, ...]:
        """States that it leaves open."""
        return tuple(i for i in range(self.model.n_x) if i not in self.own)

    @cached_property
    def linear(self) -> Linear:
        """Slopes of the whole model, with their mean where they differ on two sides."""
        return Linear(self.model)

    @cached_property
    def function(self) -> ca.Function:
        """``(x, u, p, w) → c, ċ``: the coordinates and how they change under a held command."""
        x, u, p, w = self.model.symbols()
        f = self.model.dynamics(x, u, p, w)
        values = ca.vertcat(*(self._value(item, x, f) for item in self.items))
        return ca.Function("coordinates", [x, u, p, w], [values, ca.jtimes(values, x, f)])

    def values(self, x: npt.ArrayLike, u: npt.ArrayLike) -> FloatArray:
        """Coordinates of states (…, n_x) under commands that broadcast to (…, n_u): (…, n_c)."""
        return self._evaluated(x, u, 0)

    def rates(self, x: npt.ArrayLike, u: npt.ArrayLike) -> FloatArray:
        """How the coordinates change there, likewise."""
        return self._evaluated(x, u, 1)

    def _evaluated(self, x: npt.ArrayLike, u: npt.ArrayLike, which: int) -> FloatArray:
        x = np.asarray(x, dtype=float)
        u = np.broadcast_to(np.asarray(u, dtype=float), (*x.shape[:-1], self.model.n_u))
        results = self.function(
            x.reshape(-1, self.model.n_x).T,
            u.reshape(-1, self.model.n_u).T,
            self.field.parameters,
            np.zeros(self.model.n_w),
        )
        return np.array(results[which]).T.reshape(*x.shape[:-1], len(self))

    @staticmethod
    def _value(item: Coordinate, x: ca.SX, f: ca.SX) -> ca.SX:
        return f[item.state] if item.is_rate else x[item.state]

    def _partners(self, point: OperatingPoint) -> dict[int, int]:
        """The state through which each rate is set, by the rate's place among the coordinates."""
        slopes, _ = self.field.linearised(point.x, point.u)
        used_states = {item.state for item in self.items if not item.is_rate}
        partners: dict[int, int] = {}
        for place, item in enumerate(self.items):
            if not item.is_rate:
                continue
            slope = np.abs(slopes[item.state])
            free = [i for i in range(len(slope)) if i not in used_states]
            best = max(free, key=lambda i: slope[i], default=-1)
            if best < 0 or slope[best] < _LEAST_SLOPE:
                other_names = ", ".join(name for name in self.names if name != item.name)
                raise ConfigurationError(
                    f"{item.name} follows from {other_names}",
                    where="states",
                    remedy="name another state beside it, as the angle itself",
                )
            used_states.add(best)
            partners[place] = best
        return partners


def _coordinate(model: Model, name: str, place: int) -> Coordinate:
    rates = rate_names(model)
    unknown = (
        f"{name!r} is neither a state of model {model.name!r} nor the rate of one of its angles"
    )
    require_known(name, (*model.state_names, *rates), unknown, f"states[{place}]")
    is_rate = name not in model.state_names
    index = model.state_index(rates[name] if is_rate else name)
    unit = model.states[index].unit
    return Coordinate(name, f"{unit}/s" if is_rate else unit, index, is_rate)


def check_states(model: Model, names: Sequence[str]) -> None:
    """Refuse what makes no plane and no space.

    Raises ConfigurationError for unknown, repeated, too few or too many names, ModelError for a
    model of one state.
    """
    if model.n_x < 2:
        raise ModelError(
            f"model {model.name!r} has one state, {model.state_names[0]}, and a portrait needs two",
            where="model",
            remedy="take the armature current as a second one: model.currents=dynamic"
            if model.rotors
            else "choose a model of two states or more",
        )
    if len(names) not in (2, 3):
        raise ConfigurationError(
            f"{len(names)} state{'s' * (len(names) != 1)} asked for: {', '.join(names) or 'none'}",
            where="states",
            remedy="two make a plane, three a space: "
            + ", ".join((*model.state_names, *rate_names(model))),
        )
    if len(set(names)) < len(names):
        raise ConfigurationError(
            f"{', '.join(names)}: one of them stands there twice",
            where="states",
            remedy="name each once",
        )
    for place, name in enumerate(names):
        _coordinate(model, name, place)


_ITERATIONS = 40
#: Residual below which a point is placed, in the states' units.
_PLACED = 1e-9
#: A section is invariant if what leaves it is below this share of the field.
_INVARIANT = 1e-6


@dataclass(frozen=True)
class StateSection:
    """A section through a model's states."""

    coordinates: PortraitCoordinates
    point: OperatingPoint  #: What is held is held there, under its command
    settled: tuple[int, ...] = ()  #: Other states that follow from f_k = 0; the rest is held

    @property
    def held_states(self) -> tuple[int, ...]:
        """Other states that stay at the operating point."""
        return tuple(i for i in self.coordinates.others if i not in self.settled)

    def place(self, c: npt.ArrayLike) -> FloatArray:
        """States (m, n_x) of points (m, n_c) of the section.

        NaN where there is none (a settled state without a value to settle at).
        """
        c = np.atleast_2d(np.asarray(c, dtype=float))
        x = np.tile(self.point.x, (len(c), 1))
        for place, item in enumerate(self.coordinates.items):
            if not item.is_rate:
                x[:, item.state] = c[:, place]
        if not (self.settled or self.coordinates.partners):
            return x
        for _ in range(_ITERATIONS):
            residual = self._residual(x, c)
            if not np.isfinite(residual).any() or np.nanmax(np.abs(residual)) <= _PLACED:
                break
            x = x - _solved(self._slope(x, c), residual)
        else:
            residual = self._residual(x, c)
        x[~(np.abs(residual).max(axis=1) <= 1e3 * _PLACED)] = np.nan
        return x

    def rates(self, c: npt.ArrayLike) -> FloatArray:
        """ċ at points of the section, (m, n_c)."""
        return self.coordinates.rates(self.place(c), self.point.u)

    def slopes(self, c: npt.ArrayLike) -> FloatArray:
        """∂ċ/∂c in the section at one point (n_c,), as an (n_c, n_c) matrix."""
        x = self.place(c)
        of_rates = np.array(self._rate_slopes(x[0], *self._rest))
        slopes: FloatArray = of_rates @ self._surface(x)[0]
        return slopes

    def leaving(self, c: npt.ArrayLike) -> FloatArray:
        """What leaves the section at points of it, d above, (m, n_x)."""
        x = self.place(c)
        flow = self.coordinates.rates(x, self.point.u)
        whole = self.coordinates.field.rates(x, self.point.u)
        return whole - np.einsum("mij,mj->mi", self._surface(x), flow)

    def is_determined(self) -> bool:
        """Whether the equations above have one solution near the operating point."""
        x = self.point.x[None]
        c = self.coordinates.values(x, self.point.u)
        slope = self._slope(x, c)[0]
        rows = np.abs(slope).max(axis=1, keepdims=True)
        return bool(
            np.all(rows > 0) and np.linalg.matrix_rank(slope / rows, tol=1e-9) == len(slope)
        )

    def is_invariant(self, c: npt.ArrayLike) -> bool:
        """Whether no motion leaves the section, judged at the points c (m, n_c)."""
        x = self.place(c)
        is_finite = np.isfinite(x).all(axis=1)
        if not is_finite.any():
            return False
        c = np.atleast_2d(np.asarray(c, dtype=float))[is_finite]
        scale = np.abs(self.coordinates.field.rates(x[is_finite], self.point.u)).max()
        return bool(np.abs(self.leaving(c)).max() <= _INVARIANT * max(1.0, scale))

    @property
    def _rest(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        model = self.coordinates.model
        return self.point.u, self.coordinates.field.parameters, np.zeros(model.n_w)

    @cached_property
    def _functions(self) -> tuple[ca.Function, ca.Function]:
        """``(x, c, u, p, w) → residual``, and its slope in x."""
        model, n = self.coordinates.model, len(self.coordinates)
        x, u, p, w = model.symbols()
        c = ca.SX.sym("c", n)
        values, _ = self.coordinates.function(x, u, p, w)
        f = model.dynamics(x, u, p, w)
        rows = [values - c, *(f[k] for k in self.settled)]
        rows += [x[k] - float(self.point.x[k]) for k in self.held_states]
        residual = ca.vertcat(*rows)
        slope = ca.densify(ca.jacobian(residual, x))
        inputs = [x, c, u, p, w]
        return ca.Function("residual", inputs, [residual]), ca.Function("slope", inputs, [slope])

    @cached_property
    def _rate_slopes(self) -> ca.Function:
        x, u, p, w = self.coordinates.model.symbols()
        _, flow = self.coordinates.function(x, u, p, w)
        return ca.Function("rate_slopes", [x, u, p, w], [ca.densify(ca.jacobian(flow, x))])

    def _residual(self, x: FloatArray, c: FloatArray) -> FloatArray:
        """(m, n_x)."""
        return np.array(self._functions[0](x.T, c.T, *self._rest)).T

    def _slope(self, x: FloatArray, c: FloatArray) -> FloatArray:
        """Of the residual, (m, n_x, n_x)."""
        n = self.coordinates.model.n_x
        side_by_side = np.array(self._functions[1](x.T, c.T, *self._rest))
        return side_by_side.T.reshape(-1, n, n).swapaxes(1, 2)

    def _surface(self, x: FloatArray) -> FloatArray:
        """dx/dc, (m, n_x, n_c)."""
        n_c, n = len(self.coordinates), self.coordinates.model.n_x
        slope = self._slope(x, np.zeros((len(x), n_c)))
        return _solved(slope, np.broadcast_to(np.eye(n)[:, :n_c], (len(x), n, n_c)))


def _solved(slope: FloatArray, right: FloatArray) -> FloatArray:
    """``slope⁻¹ right`` of each; by the pseudo-inverse where one of them is singular."""
    columns = right[..., None] if right.ndim == 2 else right
    try:
        solution: FloatArray = np.asarray(np.linalg.solve(slope, columns), dtype=np.float64)
    except np.linalg.LinAlgError:
        solution = np.linalg.pinv(np.nan_to_num(slope), rcond=1e-12) @ columns
    return solution[..., 0] if right.ndim == 2 else solution


def section_of(
    model: Model,
    states: Sequence[str] | None = None,
    at: Mapping[str, float] | None = None,
    others: str | Sequence[str] = "held",
) -> StateSection:
    """The section of a model with equations for what is asked by name.

    States default to :func:`default_states`; for ``at`` see
    :func:`trms_cli.models.operating_point.operating_point`, for ``others`` :func:`settled_states`.
    Raises TrmsError for names that make no portrait, and without an equilibrium there.
    """
    states = tuple(states or default_states(model))
    check_states(model, states)
    point = operating_point(model, at or {})
    coordinates = PortraitCoordinates(VectorField(model), states, point)
    section = StateSection(coordinates, point, settled_states(coordinates, others))
    if section.settled and not section.is_determined():
        settled_names = ", ".join(model.state_names[i] for i in section.settled)
        raise ConfigurationError(
            f"{settled_names}: what settles has no value of its own there, as its rate does not "
            "depend on it",
            where="others",
            remedy="hold the others (held), or name those that settle, as [i_v]",
        )
    return section


def settled_states(
    coordinates: PortraitCoordinates, others: str | Sequence[str]
) -> tuple[int, ...]:
    """Which of the other states settle: none (``held``), all (``settled``), or those named.

    Raises ConfigurationError for a name that is none of the other states.
    """
    model = coordinates.model
    if others == "held":
        return ()
    if others == "settled":
        return coordinates.others
    allowed = [model.state_names[i] for i in coordinates.others]
    for number, name in enumerate(others):
        unknown = f"{name!r} is none of the states that the portrait leaves open"
        require_known(name, allowed, unknown, f"others[{number}]")
    return tuple(sorted({model.state_index(name) for name in others}))
