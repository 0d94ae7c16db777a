"""An excitation for a rig: its operating point, band and amplitudes from the model of it.

The band goes from the model's slowest to its fastest mode where it is excited. The amplitudes are
the largest with which the simulated rig stays within its bounds. They are found by simulation,
first for each input alone, then for all together: in open loop pitch may run away beyond some
amplitude, and no linear estimate tells where.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest, require_known
from trms_cli.identification.excitation.excitation import (
    ExcitationPlugin,
    Plan,
    Shape,
    crest_factor,
)
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model, names
from trms_cli.models.steady_state import SteadyState

#: What is excited beyond the slowest and the fastest pole.
_BELOW, _ABOVE = 0.2, 5.0
#: rad/s: poles beyond are armature currents, poles below integrate.
_FASTEST, _SLOWEST = 100.0, 1e-3
#: Share of the Nyquist frequency that a band may reach.
_SHARE_OF_NYQUIST = 0.8


@dataclass(frozen=True)
class StateSpace:
    """``ẋ = A x + B u, y = C x + D u`` at a point."""

    a: FloatArray  #: (n_x, n_x), 1/s and so on
    b: FloatArray  #: (n_x, n_u)
    c: FloatArray  #: (n_y, n_x)
    d: FloatArray  #: (n_y, n_u)

    def response(self, frequencies: FloatArray) -> FloatArray:
        """Frequency response, (m, n_y, n_u), at frequencies in Hz."""
        eye = np.eye(len(self.a))
        return np.array(
            [
                self.c @ np.linalg.solve(2j * np.pi * f * eye - self.a, self.b) + self.d
                for f in frequencies
            ]
        )


def linearise_model(model: Model, x: FloatArray, u: FloatArray) -> StateSpace:
    """A model with a derivative, linearised at a point.

    Raises ConfigurationError for a model that only steps.
    """
    if model.sample_time is not None:
        raise ConfigurationError(
            f"model {model.name!r} has no poles: it only steps",
            where="model",
            remedy="design with a model with equations, as model=newtonian",
        )
    xs, us, p, w = model.symbols()
    f, y = model.dynamics(xs, us, p, w), model.measurement(xs, us, p)
    slopes = [ca.jacobian(of, by) for of in (f, y) for by in (xs, us)]
    evaluate = ca.Function("slopes", [xs, us, p, w], slopes)
    values = evaluate(x, u, model.parameters.values, np.zeros(model.n_w))
    return StateSpace(*(np.asarray(ca.densify(value)) for value in values))


def pole_range(system: StateSpace) -> tuple[float, float]:
    """Distance of the slowest and of the fastest pole of interest from zero, rad/s."""
    sizes = np.abs(np.linalg.eigvals(system.a))
    sizes = sizes[(sizes > _SLOWEST) & (sizes < _FASTEST)]
    return float(sizes.min()), float(sizes.max())


def band_of(
    system: StateSpace,
    sample_time: float,
    duration: float,
    lowest: float | None = None,
    highest: float | None = None,
) -> tuple[float, float]:
    """The band in Hz: what is given stands, the rest comes from the poles.

    From a fifth of the slowest pole, but at least one period in the duration, to five times the
    fastest, but at most 0.8 of the Nyquist frequency.
    """
    slow, fast = pole_range(system)
    if lowest is None:
        lowest = max(_BELOW * slow / (2 * np.pi), 1 / duration)
    if highest is None:
        highest = min(_ABOVE * fast / (2 * np.pi), _SHARE_OF_NYQUIST * 0.5 / sample_time)
    return float(lowest), float(highest)


@dataclass(frozen=True, kw_only=True)
class ExcitationRequest:
    """What an excitation is to be."""

    duration: float = 120.0  #: s, of the excitation itself
    sample_time: float = 0.02  #: s, of the excitation itself
    lead_in: float = 20.0  #: s before it, in which the rig comes to the operating point and settles
    lowest: float | None = None  #: Band, Hz
    highest: float | None = None  #: None: from the model
    #: Angles, rad, or a rotor's speed, rad/s; those not named: half-way from rest to level
    operating_point: Mapping[str, float] | None = None
    reversals: bool = False  #: Whether the rotors are to reverse: the commands are then about zero
    #: Of an input, in its unit; those not named are searched
    amplitude: Mapping[str, float] = field(default_factory=dict)
    #: Largest size of an angle, rad; those not named: a share of the stops
    bounds: Mapping[str, float] = field(default_factory=dict)
    share: float = 0.8  #: Of the stops and of the inputs' limits that may be used
    rigs: int = 8  #: Rigs drawn from the priors with which ranges are predicted as well
    seed: int = 0


#: s, longest integration step.
_INTEGRATION_STEP = 0.005
#: rad, how far an axis without a stop may go in the lead-in.
_FAR = 4 * np.pi
#: Samples between two looks at the bounds.
_CHECKED_AT_ONCE = 250
#: Simulations of a search for an amplitude.
_TRIALS = 9
#: Amplitudes below this share of the input's limit are none.
LEAST_SHARE = 0.01


class Trial:
    """Plays commands to a simulated rig and tells whether it stays within its bounds.

    ``bounds``: largest sizes of angles from the sample ``first`` on, rad. Before it only the stops
    count: the rig may come from beyond the bounds.
    """

    def __init__(
        self, model: Model, sample_time: float, bounds: Mapping[str, float], first: int
    ) -> None:
        self.model, self.bounds, self.first = model, dict(bounds), first
        substeps = max(1, math.ceil(sample_time / _INTEGRATION_STEP - 1e-9))
        self._discrete = discretise(model, sample_time, substeps)
        self._step = BufferedFunction(self._discrete.step)
        stops = [float(model.stops.get(name, np.inf)) for name in bounds]
        self._rows = [model.state_index(name) for name in bounds]
        self._before = np.array([s if np.isfinite(s) else _FAR for s in stops])
        self._after = np.array(list(bounds.values()))

    def play(
        self, commands: FloatArray, prior_seed: int | None = None
    ) -> tuple[FloatArray, FloatArray] | None:
        """States (n, n_x) and outputs (n, n_y); None where a bound is passed.

        ``commands``: (n, n_u) array. ``prior_seed``: of the rig's parameters, drawn from their
        priors; None takes the model's.
        """
        parameters = self.model.parameters
        if prior_seed is not None:
            parameters = parameters.draw(prior_seed, 1.0)
        step, n_x = self._step, self.model.n_x
        state, u = step.inputs[0], step.inputs[1]
        state[:] = self._discrete.initial(self.model.rest(), np.zeros(self.model.n_u))
        step.inputs[2][:] = parameters.values
        step.inputs[3][:] = 0.0
        states = np.empty((len(commands), n_x))
        for begin in range(0, len(commands), _CHECKED_AT_ONCE):
            end = min(begin + _CHECKED_AT_ONCE, len(commands))
            for k in range(begin, end):
                states[k] = state[:n_x]
                u[:] = commands[k]
                step()
                state[:] = step.outputs[0]
            angles = np.abs(states[begin:end, self._rows])
            late = np.arange(begin, end)[:, None] >= self.first
            if not np.all(np.isfinite(states[begin:end])):
                return None  # without angles no bound tells
            if not np.all(angles <= np.where(late, self._after, self._before)):
                return None  # beyond, or no longer a number
        sense = self._discrete.measurement.map(len(commands))
        full = np.tile(self._discrete.initial(self.model.rest(), commands[0]), (len(commands), 1))
        full[:, :n_x] = states
        outputs = np.asarray(sense(full.T, commands.T, parameters.values)).T
        return states, outputs

    def fits(self, commands: FloatArray) -> bool:
        """Whether the simulated rig stays within its bounds."""
        return self.play(commands) is not None


def largest_amplitudes(
    model: Model,
    request: ExcitationRequest,
    trial: Trial,
    commands: Callable[[FloatArray], FloatArray],
    room: FloatArray,
    progress: Callable[[str], None],
) -> FloatArray:
    """Amplitudes that are given stand; the others are as large as the bounds allow.

    ``commands``: of an amplitude (n_u,) what is played, (n, n_u). ``room``: (n_u,) array; largest
    amplitudes that the inputs' limits allow. Raises ConfigurationError if nothing fits; it tells
    which bound is in the way, and what to change.
    """
    inputs, upper = names(model.inputs), model.input_bounds()[1]
    for name, value in request.amplitude.items():
        require_known(name, inputs, f"the model has no input {name!r}", f"amplitude.{name}")
        i = inputs.index(name)
        if not 0 <= value <= room[i] / request.share + 1e-9:
            raise ConfigurationError(
                f"{value!r} given",
                where=f"amplitude.{name}",
                remedy=f"from 0 to {room[i] / request.share:.3g} {model.inputs[i].unit}",
            )
    presets = np.array([request.amplitude.get(name, np.nan) for name in inputs])
    free = np.isnan(presets)
    fixed = np.where(free, 0.0, presets)
    if not trial.fits(commands(fixed)):
        raise ConfigurationError(
            "with the amplitudes given the simulated rig passes "
            + " or ".join(f"±{limit:.3g} rad of {name}" for name, limit in trial.bounds.items()),
            where="amplitude",
            remedy="smaller ones, or leave amplitude out to have them searched",
        )

    def along(start: FloatArray, direction: FloatArray) -> float:
        """The largest share of the way in a direction that fits."""
        return _largest(lambda share: trial.fits(commands(start + share * direction)))

    alone = fixed.copy()
    for i in np.flatnonzero(free).tolist():
        progress(f"amplitude of {inputs[i]}")
        one = np.zeros(len(inputs))
        one[i] = room[i]
        alone[i] = room[i] * along(fixed, one)
    progress("amplitudes together")
    search_direction = np.where(free, alone, 0.0)
    amplitude = fixed + search_direction * along(fixed, search_direction)
    weak = [i for i in np.flatnonzero(free).tolist() if amplitude[i] < LEAST_SHARE * upper[i]]
    if weak:
        name = inputs[weak[0]]
        raise ConfigurationError(
            f"no amplitude of {name} keeps the simulated rig within "
            + ", ".join(f"±{limit:.3g} rad of {a}" for a, limit in trial.bounds.items()),
            where="bounds",
            remedy="wider bounds, another operating_point, a higher band.lowest or a shorter "
            "duration; or record under control, with an excitation on the references",
        )
    return amplitude


def _largest(fits: Callable[[float], bool]) -> float:
    """The largest share up to 1 that fits, by bisection from above; 0 fits."""
    if fits(1.0):
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(_TRIALS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


#: rad, for an axis without a stop.
_WITHOUT_STOP = 1.5
#: Share of the lead-in over which the command rises to that of the operating point.
_RISE = 0.5


@dataclass(frozen=True)
class ExcitationDesign:
    """An excitation and what it is expected to do."""

    model: Model
    time: FloatArray  #: (n,) array; s, lead-in included
    commands: FloatArray  #: (n, n_u) array
    first: int  #: Sample at which the excitation begins
    plan: Plan
    shape: Shape
    centre: FloatArray  #: (n_u,) array; command of the operating point
    amplitude: FloatArray  #: (n_u,) array
    crest_factor: FloatArray  #: (n_u,) array; of each input about its centre, during the excitation
    bounds: dict[str, float]  #: Of the angles, rad
    outputs: FloatArray  #: (n, n_y) array; of the simulated rig, without noise
    ranges: dict[str, tuple[float, float]]  #: Ends of each output during the excitation
    #: The same over the rigs drawn from the priors that stayed within the stops
    drawn_ranges: dict[str, tuple[float, float]]
    rig_count: int  #: Rigs drawn
    lost_rig_count: int  #: Those of them that went beyond a stop
    system: StateSpace  #: At the operating point, the rotors at their root mean square speed
    poles: tuple[float, float]  #: Slowest and fastest, rad/s


def design(
    model: Model,
    excitation: ExcitationPlugin,
    request: ExcitationRequest,
    progress: Callable[[str], None] = lambda words: None,
) -> ExcitationDesign:
    """Design an excitation by a model with equations that is roughly right for the rig.

    ``progress``: told in words what is being done. Raises ConfigurationError if nothing fits: it
    tells which bound is in the way, and what to change.
    """
    bounds = _bounds(model, request)
    upper = model.input_bounds()[1]
    centre, point = _operating_point(model, request, bounds)
    rough = linearise_model(model, point, centre)
    lowest, highest = band_of(
        rough, request.sample_time, request.duration, request.lowest, request.highest
    )
    samples = round(request.duration / request.sample_time)
    plan = Plan(samples, request.sample_time, lowest, highest, model.n_u, request.seed)
    progress("signals")
    shape = excitation.shape(plan)
    head = lead_in(centre, round(request.lead_in / request.sample_time))
    trial = Trial(model, request.sample_time, bounds, len(head))
    room = request.share * upper - np.abs(centre)
    if np.any(room < LEAST_SHARE * upper):
        worst = int(np.argmin(room / upper))
        raise ConfigurationError(
            f"the operating point takes {centre[worst]:.3g} {model.inputs[worst].unit} of "
            f"{names(model.inputs)[worst]}, and {request.share:.0%} of its limit are "
            f"{request.share * upper[worst]:.3g}",
            where="operating_point",
            remedy="an operating point nearer to rest, or a larger share",
        )

    def commands(amplitude: FloatArray) -> FloatArray:
        return np.vstack([head, centre + amplitude * shape.values])

    if trial.play(commands(np.zeros(model.n_u))) is None:
        raise ConfigurationError(
            "the simulated rig is beyond a bound before it is excited: it has not come to rest "
            "at the operating point, or passes a stop on its way there",
            where="lead_in",
            remedy="a longer lead_in, an operating point nearer to rest, or wider bounds than "
            + (", ".join(f"{name} ±{limit:.3g} rad" for name, limit in bounds.items()) or "none"),
        )
    amplitude = largest_amplitudes(model, request, trial, commands, room, progress)
    whole = commands(amplitude)
    played = trial.play(whole)
    assert played is not None  # the search ended with it
    states, outputs = played
    first = len(head)
    progress("rigs drawn from the priors")
    prior_ranges, loss_count = _prior_ranges(model, request, whole, first)
    return ExcitationDesign(
        model,
        np.arange(len(whole), dtype=np.float64) * request.sample_time,
        whole,
        first,
        plan,
        shape,
        centre,
        amplitude,
        np.array([crest_factor(column) for column in shape.values.T]),
        bounds,
        outputs,
        _ranges(model, [outputs[first:]]),
        prior_ranges,
        request.rigs,
        loss_count,
        linearise_model(model, _at_working_speed(model, point, states[first:]), centre),
        pole_range(rough),
    )


def _bounds(model: Model, request: ExcitationRequest) -> dict[str, float]:
    # A rotor's speed has no stop: its command alone limits it.
    angles = [name for name in model.controlled if _unit(model, name) == "rad"]
    for name in request.bounds:
        if name not in angles:
            raise ConfigurationError(
                f"{name!r} is no angle of model {model.name!r}",
                where=f"bounds.{name}",
                remedy=nearest(name, angles)
                if angles
                else "leave bounds out: this model has no angles, share limits its inputs",
            )
    bounds = {}
    for name in angles:
        stop = float(model.stops.get(name, np.inf))
        own = request.share * stop if np.isfinite(stop) else _WITHOUT_STOP
        bounds[name] = float(request.bounds.get(name, own))
        if not bounds[name] > 0:
            raise ConfigurationError(
                f"{bounds[name]!r} given", where=f"bounds.{name}", remedy="an angle above 0 rad"
            )
    return bounds


def _unit(model: Model, state: str) -> str:
    return model.states[model.state_index(state)].unit


def _operating_point(
    model: Model, request: ExcitationRequest, bounds: Mapping[str, float]
) -> tuple[FloatArray, FloatArray]:
    """Command and state about which the excitation is."""
    rest = model.rest()
    if request.reversals:
        if request.operating_point:
            raise ConfigurationError(
                "reversals and an operating point",
                where="operating_point",
                remedy="rotors that reverse have commands about zero: leave out one of the two",
            )
        return np.zeros(model.n_u), rest
    targets = {name: 0.5 * float(rest[model.state_index(name)]) for name in model.controlled}
    angles = request.operating_point or {}
    for name, value in angles.items():
        problem = f"model {model.name!r} controls no {name!r}"
        require_known(name, model.controlled, problem, f"operating_point.{name}")
        targets[name] = float(value)
    for name, value in targets.items():
        if not abs(value) < bounds.get(name, np.inf):
            raise ConfigurationError(
                f"{value:.3g} rad " + ("given" if name in angles else "without another one given"),
                where=f"operating_point.{name}",
                remedy=f"within the bound of ±{bounds[name]:.3g} rad",
            )
    target = SteadyState(model).solve(np.array([targets[name] for name in model.controlled]))
    if not target.exact:
        raise ConfigurationError(
            f"model {model.name!r} cannot rest at "
            + ", ".join(f"{n} {value:.3g} {_unit(model, n)}" for n, value in targets.items()),
            where="operating_point",
            remedy="the nearest point at which it rests: "
            + ", ".join(
                f"{name} {value:.3g} {_unit(model, name)}"
                for name, value in zip(model.controlled, target.reference_reached, strict=True)
            ),
        )
    return np.array(target.u), np.array(target.x)


def lead_in(centre: FloatArray, count: int) -> FloatArray:
    """From rest to the operating point, smoothly, and some time there: (count, n_u)."""
    share = np.clip(np.arange(count) / max(_RISE * count, 1.0), 0.0, 1.0)
    return np.outer((1 - np.cos(np.pi * share)) / 2, centre)


def _prior_ranges(
    model: Model, request: ExcitationRequest, commands: FloatArray, first: int
) -> tuple[dict[str, tuple[float, float]], int]:
    """Ranges over rigs drawn from the priors, and how many of them pass a stop."""
    stops = {
        name: float(model.stops.get(name, np.inf))
        for name in model.controlled
        if _unit(model, name) == "rad"
    }
    beyond = {name: stop if np.isfinite(stop) else 4 * np.pi for name, stop in stops.items()}
    free = Trial(model, request.sample_time, beyond, first)
    trajectories, loss_count = [], 0
    for number in range(request.rigs):
        played = free.play(commands, prior_seed=request.seed * 1000 + number)
        if played is None:
            loss_count += 1
        else:
            trajectories.append(played[1][first:])
    return (_ranges(model, trajectories) if trajectories else {}), loss_count


def _ranges(model: Model, outputs: list[FloatArray]) -> dict[str, tuple[float, float]]:
    return {
        name: (
            float(min(table[:, i].min() for table in outputs)),
            float(max(table[:, i].max() for table in outputs)),
        )
        for i, name in enumerate(names(model.outputs))
    }


def _at_working_speed(model: Model, point: FloatArray, states: FloatArray) -> FloatArray:
    """The operating point with each rotor at its root mean square speed.

    A thrust goes as the square of the speed: at rest it has no slope, and a response there would
    tell nothing of what an excitation does.
    """
    x = point.copy()
    for signal in model.states:
        if signal.name.startswith("omega_"):
            i = model.state_index(signal.name)
            size = float(np.sqrt(np.mean(states[:, i] ** 2)))
            x[i] = size if point[i] >= 0 else -size
    return x
