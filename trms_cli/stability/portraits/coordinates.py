"""The two or three coordinates of a portrait: states by name, and the rates of angles.

A rate (``rate_v`` is dα_v/dt) is no state of the models whose states are angular momenta. It is a
function of the states: the row of its angle in f. A point of the portrait fixes it through the
state that it depends on most, its partner (S_v for ``rate_v``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.core.plugins import nearest
from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.local.linear import Linear

FloatArray = npt.NDArray[np.float64]

_RATE, _ANGLE = "rate_", "alpha_"
_LETTERS = {"alpha": "α", "omega": "ω", "tau": "τ", "psi": "ψ", "phi": "φ"}
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


def symbol(name: str) -> str:
    """A state's name with Greek letters: ``α_v``."""
    first, _, rest = name.partition("_")
    letter = _LETTERS.get(first, first)
    return f"{letter}_{rest}" if rest else letter


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


class Coordinates:
    """The coordinates of a portrait of a model.

    Parameters
    ----------
    field : VectorField
    names : sequence of str
        Two or three: states, or rates of angles (``rate_v``).
    point : OperatingPoint
        Where the dependence of rates on states is judged.

    Raises
    ------
    ConfigurationError
        For unknown, repeated, too few or too many names.
    ModelError
        For a model of one state.
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
        found = self.function(
            x.reshape(-1, self.model.n_x).T,
            u.reshape(-1, self.model.n_u).T,
            self.field.parameters,
            np.zeros(self.model.n_w),
        )
        return np.array(found[which]).T.reshape(*x.shape[:-1], len(self))

    @staticmethod
    def _value(item: Coordinate, x: ca.SX, f: ca.SX) -> ca.SX:
        return f[item.state] if item.is_rate else x[item.state]

    def _partners(self, point: OperatingPoint) -> dict[int, int]:
        """The state through which each rate is set, by the rate's place among the coordinates."""
        slopes, _ = self.field.linearised(point.x, point.u)
        taken = {item.state for item in self.items if not item.is_rate}
        found: dict[int, int] = {}
        for place, item in enumerate(self.items):
            if not item.is_rate:
                continue
            slope = np.abs(slopes[item.state])
            free = [i for i in range(len(slope)) if i not in taken]
            best = max(free, key=lambda i: slope[i], default=-1)
            if best < 0 or slope[best] < _LEAST_SLOPE:
                given = ", ".join(name for name in self.names if name != item.name)
                raise ConfigurationError(
                    f"{item.name} follows from {given}",
                    where="states",
                    remedy="name another state beside it, as the angle itself",
                )
            taken.add(best)
            found[place] = best
        return found


def _coordinate(model: Model, name: str, place: int) -> Coordinate:
    if name in model.state_names:
        index = model.state_index(name)
        return Coordinate(name, model.states[index].unit, index)
    rates = rate_names(model)
    if name in rates:
        index = model.state_index(rates[name])
        return Coordinate(name, f"{model.states[index].unit}/s", index, is_rate=True)
    raise ConfigurationError(
        f"{name!r} is neither a state of model {model.name!r} nor the rate of one of its angles",
        where=f"states[{place}]",
        remedy=nearest(name, (*model.state_names, *rates)),
    )


def check_states(model: Model, names: Sequence[str]) -> None:
    """Refuse what makes no plane and no space.

    Raises
    ------
    ConfigurationError
        For unknown, repeated, too few or too many names.
    ModelError
        For a model of one state.
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
