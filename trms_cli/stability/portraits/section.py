"""The section of the state space that a portrait lies in, and the field on it.

A portrait of n_c coordinates c of a model of n_x states shows the surface of the states x that

    c(x) = c,     x_k = x_k°  for the states that are held,     f_k(x, u) = 0  for those settled,

with x° the operating point. Newton's method finds x(c), at many points at once. Implicit
differentiation gives its slope, J dx/dc = [I; 0], and with it two things: the field's own slopes in
the section, and how far the section is from being invariant,

    d = f(x(c), u) − (dx/dc) ċ.

Where d = 0 no motion leaves the section, and the portrait is the motion itself; elsewhere it is a
cut through the field, and trajectories drawn over it are projections.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint, operating_point
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.portraits.coordinates import Coordinates, check_states, default_states

FloatArray = npt.NDArray[np.float64]

_ITERATIONS = 40
#: Residual below which a point is placed, in the states' units.
_PLACED = 1e-9
#: A section is invariant if what leaves it is below this share of the field.
_INVARIANT = 1e-6


@dataclass(frozen=True)
class Section:
    """A section through a model's states."""

    coordinates: Coordinates
    point: OperatingPoint  #: What is held is held there, under its command
    settled: tuple[int, ...] = ()  #: Other states that follow from f_k = 0; the rest is held

    @property
    def held(self) -> tuple[int, ...]:
        """Other states that stay at the operating point."""
        return tuple(i for i in self.coordinates.others if i not in self.settled)

    def place(self, c: npt.ArrayLike) -> FloatArray:
        """States of points of the section.

        Parameters
        ----------
        c : (m, n_c)

        Returns
        -------
        (m, n_x) array
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
        known = np.isfinite(x).all(axis=1)
        if not known.any():
            return False
        c = np.atleast_2d(np.asarray(c, dtype=float))[known]
        scale = np.abs(self.coordinates.field.rates(x[known], self.point.u)).max()
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
        rows += [x[k] - float(self.point.x[k]) for k in self.held]
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
        found: FloatArray = np.asarray(np.linalg.solve(slope, columns), dtype=np.float64)
    except np.linalg.LinAlgError:
        found = np.linalg.pinv(np.nan_to_num(slope), rcond=1e-12) @ columns
    return found[..., 0] if right.ndim == 2 else found


def section_of(
    model: Model,
    states: Sequence[str] | None = None,
    at: Mapping[str, float] | None = None,
    others: str | Sequence[str] = "held",
) -> Section:
    """The section of a model for what is asked by name.

    Parameters
    ----------
    model : Model
        With equations.
    states : sequence of str or None
        Two or three coordinates; None: :func:`default_states`.
    at : dict of str to float or None
        Operating point; see :func:`trms_cli.models.operating_point.operating_point`.
    others : str or sequence of str
        See :func:`settled_states`.

    Raises
    ------
    ConfigurationError, ModelError
        For names that make no portrait, and without an equilibrium there.
    """
    states = tuple(states or default_states(model))
    check_states(model, states)
    point = operating_point(model, at or {})
    coordinates = Coordinates(VectorField(model), states, point)
    section = Section(coordinates, point, settled_states(coordinates, others))
    if section.settled and not section.is_determined():
        shown = ", ".join(model.state_names[i] for i in section.settled)
        raise ConfigurationError(
            f"{shown}: what settles has no value of its own there, as its rate does not depend "
            "on it",
            where="others",
            remedy="hold the others (held), or name those that settle, as [i_v]",
        )
    return section


def settled_states(coordinates: Coordinates, others: str | Sequence[str]) -> tuple[int, ...]:
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
        if name not in allowed:
            raise ConfigurationError(
                f"{name!r} is none of the states that the portrait leaves open",
                where=f"others[{number}]",
                remedy=nearest(name, allowed),
            )
    return tuple(sorted({model.state_index(name) for name in others}))
