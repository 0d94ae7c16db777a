"""What the online and the offline robust MPC share: targets, coordinates, bounds, weights."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.controllers.controller import ControlSample, ControlSetup, Delay, PresentReference
from trms_cli.controllers.lqr import in_order
from trms_cli.controllers.robust.coordinates import Coordinates, thrust_demand
from trms_cli.controllers.robust.lmi import Task
from trms_cli.controllers.robust.polytope import Coefficients, Polytope, RegulationTarget, StateBox
from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.models import steady_state
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model, names
from trms_cli.models.steady_state import SteadyState

#: Share of a bound on the input below which a target is held by its own input alone.
_NO_ROOM = 0.02
_NO_STOP = math.pi  # rad, of an axis without stops
#: Of an estimate beyond all bounds.
LAW_NOT_FINITE = "the law is not finite at this estimate"


@dataclass(frozen=True, kw_only=True)
class RegulationDesign(PresentReference):
    """What is regulated, and how dear deviations are."""

    sample_time: Positive = 0.1  #: Control period, s
    delay: Delay = "none"
    #: Commands whose rotors are regulated by their thrust
    thrust_inputs: tuple[str, ...] = ("u_h",)
    smallest_speed: Positive = 5.0  #: ε, rad/s: below it the thrust counts as linear in the speed
    #: Distance of a thrust from its target, as a rotor speed in rad/s, within which the reaction of
    #: that rotor on the other axis is a bounded disturbance and no coefficient
    thrust_band: Positive = 120.0
    #: λ, of a thrust without demand, a period
    thrust_pole: Annotated[float, Meta(gt=0, lt=1)] = 0.9
    #: ``state_weights``, ``rate_weights``, ``input_weights``: Of the controlled angles (1/rad²),
    #: their rates (1/(rad/s)²) and the inputs (1/V²; of a demand of thrust, whose bound counts as
    #: the command's limit)
    state_weights: Mapping[str, Positive] = field(default_factory=dict)
    rate_weights: Mapping[str, NotNegative] = field(default_factory=dict)
    input_weights: Mapping[str, Positive] = field(default_factory=dict)
    principal_components: Annotated[int, Meta(ge=1, le=5)] = 2  #: K; the polytope has 2^K vertices
    margin: NotNegative = 0.05  #: Share by which the polytope is widened beyond the samples
    points: Annotated[int, Meta(ge=32)] = 256  #: Samples of the coefficients
    #: Half-width of the region of operation in states that are neither angles nor rotor speeds,
    #: rad/s
    rate_range: Positive = 1.5
    #: Whether the observer's constant disturbances enter the target (offset-free)
    disturbance_compensation: bool = True


@dataclass
class Aim:
    """Where the regulation is going."""

    steady: steady_state.Target
    target: RegulationTarget  #: The same in the coordinates
    message: str
    reference: FloatArray  #: (n_r,) array; the reference, rad
    is_new: bool = False  #: Whether it is another than that of the aim before


class Regulation:
    """The regulation of one model to its steady states.

    Raises ConfigurationError for a model that it does not work with, or names that the model does
    not have.
    """

    def __init__(self, design: RegulationDesign, setup: ControlSetup) -> None:
        model = setup.model
        if not model.axes:
            raise ConfigurationError(
                f"model {model.name!r} has no axis to regulate",
                where="controller",
                remedy="choose newton_mpc for a rotor alone",
            )
        self.design, self.model = design, model
        self.coordinates = Coordinates(
            model, setup.sample_time, design.thrust_inputs, design.smallest_speed
        )
        self.demands = tuple(
            thrust_demand(self.coordinates, rotor, design.thrust_pole)
            for rotor in self.coordinates.rotors
        )
        self.n, self.m = self.coordinates.n, self.coordinates.m
        self.lower, self.upper = model.input_bounds()
        self.scale_z = np.maximum(self.coordinates.sizes / 2, 1e-6)
        self.scale_v = np.ones(self.m)
        for demand in self.demands:
            if demand.scale <= 0:
                raise ConfigurationError(
                    "within a period the rotor cannot keep up with the thrust it is asked for",
                    where="controller.thrust_pole",
                    remedy="a pole nearer to 1, or a longer controller.sample_time",
                )
            rotor = demand.rotor
            self.scale_z[rotor.coordinate] = 4 * demand.scale
            self.scale_v[rotor.input] = demand.scale / self.upper[rotor.input]
        self.coefficients = Coefficients(
            self.coordinates,
            self.demands,
            self.scale_z,
            self.scale_v,
            design.points,
            design.thrust_band**2,
        )
        self.steady = SteadyState(model)
        self._rows = [
            self.coordinates.positions.index(model.state_index(n)) for n in model.controlled
        ]
        self._q = in_order(design.state_weights, model.controlled, 1.0, "state_weights")
        self._dq = in_order(design.rate_weights, model.controlled, 0.5, "rate_weights")
        self._r = in_order(design.input_weights, names(model.inputs), 0.05, "input_weights")
        self._free: list[int] = []
        self.operation = self._operation()
        #: Coordinates that mechanical stops bound.
        self.bounded = tuple(
            row
            for row, name in zip(self._rows, model.controlled, strict=True)
            if np.isfinite(model.stops.get(name, np.inf))
        )

    def aim(self, sample: ControlSample, previous: Aim | None, disturbance: FloatArray) -> Aim:
        """The steady state of the reference under the torques that are estimated."""
        request = sample.reference[-1]
        if (
            previous is not None
            and np.array_equal(request, previous.reference)
            and np.array_equal(disturbance, previous.target.w)
        ):
            return previous
        last = previous.steady if previous is not None else None
        steady = self.steady.solve(request, disturbance, last)
        message = ""
        if not steady.converged and last is not None:
            assert previous is not None
            return Aim(
                last,
                previous.target,
                "nothing holds the rig at the estimated disturbance; the last target stays",
                previous.reference,
            )
        if steady.projected:
            message = "the reference is out of reach; the closest is the target"
        z = self.coordinates.forward(steady.x)
        target = RegulationTarget(z, self.coordinates.demand(z, steady.u), disturbance.copy())
        return Aim(
            steady,
            target,
            message,
            request.copy(),
            last is None or steady.reference != last.reference,
        )

    def aim_at(self, reference: FloatArray) -> Aim:
        """The steady state of a reference (n_r,) without disturbances."""
        rest, w = self.model.rest(), np.zeros(self.model.n_w)
        estimate = Estimate(rest, np.zeros_like(rest), w, w)
        sample = ControlSample(0.0, reference[None, :], estimate, np.zeros(self.m))
        return self.aim(sample, None, w)

    def angles(self, values: FloatArray) -> FloatArray:
        """A deviation (n,) of the controlled angles alone, given in rad, shape (n_r,)."""
        z = np.zeros(self.n)
        z[self._rows] = values / self.scale_z[self._rows]
        return z

    def deviation(self, x: FloatArray, target: RegulationTarget) -> FloatArray:
        """z − z_s in units of the scales, shape (n,)."""
        return np.asarray((self.coordinates.forward(x) - target.z) / self.scale_z)

    def command(self, x: FloatArray, aim: Aim, deviation: FloatArray, dv: FloatArray) -> FloatArray:
        """Commands within their limits that give v − v_s (in units of the scales), shape (n_u,)."""
        v = aim.target.v + dv * self.scale_v
        for demand in self.demands:
            i = demand.rotor.coordinate
            v[demand.rotor.input] += demand.pole * deviation[i] * self.scale_z[i]
        if self.demands:
            v = self.coordinates.command(x, v, aim.target.w)
        if not np.isfinite(v).all():
            v = aim.steady.u
        return self.limited(v)

    def limited(self, u: FloatArray) -> FloatArray:
        """Commands (n_u,) cut to their limits."""
        return np.minimum(np.maximum(u, self.lower), self.upper)

    def input_bounds(self, aim: Aim) -> FloatArray:
        """What the limits leave around the steady inputs, in units of the scales, shape (m,)."""
        u = aim.steady.u
        room = np.minimum(self.upper - u, u - self.lower)
        least = _NO_ROOM * self.upper
        for demand in self.demands:
            rotor = demand.rotor
            room[rotor.input] = demand.bound(float(aim.target.z[rotor.coordinate]))
            least[rotor.input] = _NO_ROOM * demand.scale
        return np.asarray(np.maximum(room, least) / self.scale_v)

    def state_bounds(self, target: RegulationTarget) -> FloatArray:
        """What the mechanical stops leave around the target, in units of the scales, (n,)."""
        bounds = np.full(self.n, np.inf)
        for row, name in zip(self._rows, self.model.controlled, strict=True):
            stop = self.model.stops.get(name, np.inf)
            if np.isfinite(stop):
                bounds[row] = max(stop - abs(target.z[row]), 0.05) / self.scale_z[row]
        return bounds

    def weights(self, A: FloatArray) -> FloatArray:
        """C (2 n_r, n) in units of the scales: angles, and their mean rates over a period.

        ``A``: (n, n) array; a typical one.
        """
        rows = np.array(self._rows)
        C = np.zeros((2 * len(rows), self.n))
        for k, row in enumerate(rows):
            C[2 * k, row] = math.sqrt(self._q[k]) * self.scale_z[row]
            rate = A[row].copy()
            rate[row] -= 1.0
            for demand in self.demands:
                rate[demand.rotor.coordinate] = 0.0
            scale = self.scale_z[row] / self.coordinates.period
            C[2 * k + 1] = math.sqrt(self._dq[k]) * scale * rate
        return C

    def task(self, polytope: Polytope, aim: Aim, deviation: FloatArray) -> Task:
        """The inequalities' data for deviations (n,) or (k, n) from a target."""
        return Task(
            polytope.A,
            polytope.B,
            self.weights(polytope.centre[:, : self.n]),
            self._r,
            np.atleast_2d(deviation),
            self.input_bounds(aim),
            self.state_bounds(aim.target),
        )

    def region_of(self, target: RegulationTarget, extents: FloatArray) -> StateBox:
        """The box target ± extents (n,), in units of the scales, within the region of operation."""
        half = extents * self.scale_z
        return StateBox(target.z - half, target.z + half).within(self.around(target))

    def covers(self, target: RegulationTarget, extents: FloatArray, reached: FloatArray) -> bool:
        """Whether what is possible of target ± reached lies in the box of target ± extents."""
        return self.region_of(target, extents).contains(
            self.region_of(target, reached), 1e-6 * self.scale_z
        )

    def around(self, target: RegulationTarget) -> StateBox:
        """The region of operation with the target's own momenta in its middle."""
        lower, upper = self.operation.lower.copy(), self.operation.upper.copy()
        for i in self._free:
            lower[i] += target.z[i]
            upper[i] += target.z[i]
        return StateBox(lower, upper)

    def _operation(self) -> StateBox:
        """All that the frame and the motors let be; momenta within the configured range."""
        model, half = self.model, np.full(self.n, self.design.rate_range)
        angles = {axis.angle for axis in model.axes.values()} | set(model.controlled)
        for i, row in enumerate(self.coordinates.positions):
            name = model.states[row].name
            if name in angles and model.states[row].unit == "rad":
                stop = model.stops.get(name, np.inf)
                half[i] = stop if np.isfinite(stop) else _NO_STOP
            elif model.states[row].unit == "rad/s" and not name.startswith("omega"):
                self._free.append(i)
            else:
                half[i] = self.coordinates.sizes[i]
        for demand in self.demands:
            half[demand.rotor.coordinate] = demand.largest
        return StateBox(-half, half)


def no_law(model: Model) -> ConfigurationError:
    """What to say where no law is certified even near a target."""
    both = ", ".join(names(model.inputs))
    return ConfigurationError(
        f"no law is certified for model {model.name!r} near its level steady state",
        where="controller",
        remedy=f"where a rotor stands still there: controller.thrust_inputs=[{both}]; else narrow "
        "controller.least_reach or controller.targets, or choose newton_mpc",
    )
