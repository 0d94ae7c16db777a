"""Rest, hover and other equilibria that have a name, with the physical quantities there."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import TrmsError
from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint, operating_point, refined
from trms_cli.models.rest import arriving
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.equilibria.friction_band import Band, bands
from trms_cli.stability.equilibria.stability_of_points import GROWTH, eigenvalues_at
from trms_cli.stability.local.linear import Linear
from trms_cli.stability.local.modes import Verdict

FloatArray = npt.NDArray[np.float64]

_NEAR_ZERO = 1e-3  # V
_SAME_ANGLE = 1e-6  # rad


@dataclass(frozen=True)
class NamedPoint:
    """An equilibrium with a name."""

    name: str
    x: FloatArray  #: (n_x,), (n_u,) arrays
    u: FloatArray  #: (n_x,), (n_u,) arrays
    eigenvalues: npt.NDArray[np.complex128]  #: (n_x,) complex array; rightmost first
    verdict: Verdict
    #: What the model names: thrusts (N), currents (A), torques (N m), inertias (kg m²)…
    quantities: Mapping[str, float]
    bands: tuple[Band, ...]  #: Where dry friction holds the axes around it

    @property
    def unstable(self) -> int:
        """How many motions grow."""
        return int(np.sum(self.eigenvalues.real > GROWTH))


def named_points(
    model: Model, more: Mapping[str, Mapping[str, float]], where: str = "study.special"
) -> tuple[list[NamedPoint], list[str]]:
    """Rest, hover, and what is asked for; and why the first two may be missing.

    Parameters
    ----------
    more : dict of str to dict
        Angles or commands by name, as of :func:`operating_point`.

    Raises
    ------
    TrmsError
        For a point that is asked for and does not exist.
    """
    found: list[NamedPoint] = []
    missing: list[str] = []
    usual: dict[str, Mapping[str, float]] = {"rest": {}}
    if "pitch" in model.axes:
        usual["hover"] = dict.fromkeys(model.controlled, 0.0)
    for name, at in usual.items():
        if name in more or (name == "hover" and found and _is_level(model, found[0])):
            continue
        try:
            found.append(_named(model, name, operating_point(model, at)))
        except TrmsError as error:
            missing.append(
                f"no {name}: {error.problem}" + (f" ({error.remedy})" if error.remedy else "")
            )
    for name, at in more.items():
        found.append(_named(model, name, operating_point(model, at, f"{where}.{name}")))
    return found, missing


def _is_level(model: Model, rest: NamedPoint) -> bool:
    """Whether a rig without command rests with all controlled angles at zero: that is its hover."""
    return all(abs(rest.x[model.state_index(name)]) < 1e-9 for name in model.controlled)


def _without_rounding(
    model: Model,
    point: OperatingPoint,
    field: VectorField,
    arrives: Callable[[FloatArray], FloatArray],
) -> OperatingPoint:
    """The point with commands of exactly zero where that changes no angle.

    As of :func:`operating_point`, for commands that pass a dead zone on their way too.
    """
    u = np.where(np.abs(point.u) < _NEAR_ZERO, 0.0, point.u)
    if np.array_equal(u, point.u):
        return point
    x = refined(field, point.x, arrives(u))
    rows = [model.state_index(name) for name in model.controlled]
    if x is None or np.abs(x - point.x)[rows].max() > _SAME_ANGLE:
        return point
    return OperatingPoint(x, u)


def _named(model: Model, name: str, point: OperatingPoint) -> NamedPoint:
    u, p = ca.SX.sym("u", model.n_u), ca.SX.sym("p", len(model.parameters))
    path = ca.Function("path", [u, p], [arriving(model, u, p)])
    field = VectorField(model)

    def arrives(commands: FloatArray) -> FloatArray:
        return np.array(path(commands, field.parameters))[:, 0]

    point = _without_rounding(model, point, field, arrives)
    reached = arrives(point.u)
    values, verdict = eigenvalues_at(Linear(model), point.x, reached)
    x, u, p, _ = model.symbols()
    expressions = model.quantities(x, u, p)
    evaluate = ca.Function("quantities", [x, u, p], [ca.vertcat(*expressions.values())])
    numbers = np.array(evaluate(point.x, reached, field.parameters)).ravel().tolist()
    return NamedPoint(
        name,
        point.x,
        point.u,
        values,
        verdict,
        dict(zip(expressions, numbers, strict=False)),
        tuple(bands(model, point.x, point.u, reached)),
    )
