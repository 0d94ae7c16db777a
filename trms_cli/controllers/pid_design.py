"""All numbers of a PID law that follow from the model: gains, filters, inverse, coupling, by axis.

The axes are designed one after the other, pitch first: each is tuned with those before it held by
their own loops, as they will be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from trms_cli.controllers.pid_feed_forward import (
    INVERTED,
    RotorTables,
    Table,
    decoupling,
    inverse,
    rotor_lag,
    rotor_tables,
)
from trms_cli.controllers.pid_tuning import (
    AxisPlant,
    Filters,
    Gains,
    Margins,
    held,
    margins,
    tuned,
    worst,
)
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.process_cache import kept
from trms_cli.models.linearisation import Linearisation, LinearModel, require_drivable
from trms_cli.models.model import Model, names
from trms_cli.models.steady_state import SteadyState

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
#: A, B and C of the rig at one operating point, its inputs torques.
_System = tuple[FloatArray, FloatArray, FloatArray]

#: Which rotor holds which axis.
ROTOR_OF_AXIS = {"pitch": "main", "yaw": "tail"}
#: ρ where none is given, s.
_SMOOTHNESS = 3.0
#: Part by which a mode may grow in a period before a loop counts as unstable: an axis that nothing
#: pulls back has modes at 1, which rounding moves by its square root.
_GROWTH = 1e-6


@dataclass(frozen=True)
class AxisDesign:
    """One axis."""

    angle: str  #: State that is the axis' angle
    channel: int  #: Position of its rotor's input in u
    gains: Gains
    filters: Filters
    margins: Margins  #: Of its loop, the worst of the operating points
    #: (c_0, c_1, c_2, c_3); torque by the angle and its derivatives, N m/rad, N m s/rad and so on
    inverse: tuple[float, ...]
    #: Torque by the rate of the torque fed forward to each axis before this one, s
    coupling: tuple[float, ...]
    curve: Table  #: Input by torque, V by N m
    holding: Table  #: torque by angle, N m by rad

    @property
    def rotor_lag(self) -> float:
        """τ, s; 0 for a rotor without."""
        return rotor_lag(np.array(self.inverse))


@dataclass(frozen=True, kw_only=True)
class Design:
    """What is asked of a design."""

    given: Mapping[str, Literal["auto"] | Gains]  #: dict of str to "auto" or Gains; by axis
    operating_points: Sequence[Mapping[str, float]]  #: Controlled angles, rad
    max_sensitivity: float  #: largest gain of the sensitivity function
    smoothness: Mapping[str, float]  #: By axis, s
    derivative_filter: float  #: s
    lead_filter: float  #: s

    def of(self, model: Model, step: float) -> dict[str, AxisDesign]:
        """The design for a model and a control period (s), by axis.

        Raises ConfigurationError by the key of an operating point or of gains that will not do.
        """
        return dict(kept(Design._of, self, model, step))

    def _of(self, model: Model, step: float) -> dict[str, AxisDesign]:
        """See :meth:`of`."""
        if not model.axes:
            raise ConfigurationError(
                f"model {model.name!r} has no axis, and pid holds the angles of axes",
                where="controller",
                remedy="choose newton_mpc or lqr",
            )
        channels = {name: _channel(model, name) for name in model.axes}
        steady = SteadyState(model)
        tables = rotor_tables(model, channels, steady)
        systems = [
            _driven_by_torques(point, channels, tables)
            for point in self._points(model, step, steady)
        ]
        free = systems
        designs: dict[str, AxisDesign] = {}
        for name, axis in model.axes.items():
            channel, row = channels[name], model.controlled.index(axis.angle)
            own = _responses(free, channel, row, step)
            coupling = [
                decoupling(
                    _responses(free, channels[other], row, step), own, INVERTED, self.lead_filter
                )
                for other in designs
            ]
            plants = [AxisPlant(A, B[:, channel], C[row], step) for A, B, C in systems]
            polynomial = inverse(_responses(systems, channel, row, step), INVERTED)
            filters = self._filters(rotor_lag(polynomial))
            gains = self._gains(name, plants, filters)
            designs[name] = AxisDesign(
                angle=axis.angle,
                channel=channel,
                gains=gains,
                filters=filters,
                margins=worst(margins(plant, gains, filters) for plant in plants),
                inverse=tuple(polynomial.tolist()),
                coupling=tuple(coupling),
                curve=tables[name].curve,
                holding=tables[name].holding,
            )
            systems = [
                held(plant, gains, filters, B, C)
                for plant, (_, B, C) in zip(plants, systems, strict=True)
            ]
            following = list(model.axes)[len(designs) :]
            if any(self.given[other] == "auto" for other in following):
                self._require_stable(name, systems)
        return designs

    def _points(self, model: Model, step: float, steady: SteadyState) -> list[LinearModel]:
        linearisation = Linearisation(model, step, steady)
        points = []
        for i, angles in enumerate(self.operating_points):
            where = f"controller.operating_points[{i}]"
            points.append(linearisation.at(angles, where))
            if any(self.given[name] == "auto" for name in model.axes):
                require_drivable(points[-1], where)
        return points

    def _filters(self, lag: float) -> Filters:
        if lag > self.lead_filter:
            return Filters(self.derivative_filter, lag, self.lead_filter)
        return Filters(self.derivative_filter)

    def _gains(self, name: str, plants: Sequence[AxisPlant], filters: Filters) -> Gains:
        given = self.given[name]
        if isinstance(given, Gains):
            return given
        return tuned(
            plants,
            filters,
            self.max_sensitivity,
            self.smoothness.get(name, _SMOOTHNESS),
            f"controller.{name}",
        )

    def _require_stable(self, name: str, systems: Sequence[_System]) -> None:
        """Refuse given gains with which another axis cannot be tuned."""
        for angles, (A, _, _) in zip(self.operating_points, systems, strict=True):
            if np.abs(np.linalg.eigvals(A)).max() > 1 + _GROWTH:
                where = ", ".join(f"{angle}={value:g}" for angle, value in angles.items())
                raise ConfigurationError(
                    f"with these gains the loop of {name} is unstable at {where} rad, "
                    "and the other axis cannot be tuned beside it",
                    where=f"controller.{name}",
                    remedy="give a larger kd (N m s/rad; the axis hardly damps itself), smaller kp "
                    "(N m/rad) and ki (N m/(rad s)), or auto; or give the gains of both axes",
                )


def _driven_by_torques(
    point: LinearModel, channels: Mapping[str, int], tables: Mapping[str, RotorTables]
) -> _System:
    """The rig at a point, the rotors' curves undone as the law undoes them."""
    B = point.B.copy()
    for name, channel in channels.items():
        volts = float(point.target.u[channel])
        B[:, channel] /= tables[name].curve.inverse().slope(volts)
    return point.A, B, point.C


def _responses(
    systems: Sequence[_System], channel: int, row: int, step: float
) -> list[ComplexArray]:
    """Of an angle to a torque asked for, rad/(N m), at the frequencies that are inverted."""
    z = np.exp(1j * INVERTED * step)
    return [AxisPlant(A, B[:, channel], C[row], step).response(z) for A, B, C in systems]


def _channel(model: Model, axis: str) -> int:
    """Input of the rotor that holds an axis.

    Raises ConfigurationError for a model with an axis or rotors of other names.
    """
    rotor = ROTOR_OF_AXIS.get(axis, "")
    if rotor not in model.rotors:
        raise ConfigurationError(
            f"no rotor of model {model.name!r} is known to hold its axis {axis!r}",
            where="controller",
            remedy="pid knows the axes pitch and yaw with the rotors main and tail; try lqr",
        )
    return names(model.inputs).index(model.rotors[rotor])
