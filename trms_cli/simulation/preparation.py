"""What is looked at and tried before a rig is opened: references, reach, all that compiles."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from trms_cli.controllers.controller import ControlSample, ControlSetup
from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.invocation import note
from trms_cli.models.model import Model, names
from trms_cli.models.state_scales import state_scales
from trms_cli.models.steady_state import SteadyState
from trms_cli.observers.observer import ObserverSetup
from trms_cli.plants.envelope import beyond_reach, envelope_of
from trms_cli.plants.landing import Landing
from trms_cli.references.trajectory import ReferenceTrajectory

if TYPE_CHECKING:
    from trms_cli.simulation.closed_loop import Experiment

#: V; no landing is reckoned to begin farther from the safe command, where a rig has no limits.
_FARTHEST = 100.0
#: s for which a reference stands still where the rig is meant to rest there
_AT_REST = 2.0
#: Levels that are looked at: more are those of a random signal, which tells the same of each
_LEVELS = 50
#: Share of a level by which the nearest steady state misses it before that is worth a word, and
#: the least, rad (rad/s for a rotor on a bench)
_SHORT, _LEAST_SHORT = 0.02, 0.005
#: Control periods by a model's time constant: longer ones get a word, and what to try.
_PERIODS = 0.5, 0.25


def farthest_command(model: Model, landing: Landing) -> float:
    """How far any command is from any other, V; something large where there are no limits.

    Of a model of a user's, what is as far at the landing's rate.
    """
    lower, upper = model.input_bounds()
    if not model.bench_sizes:
        lasts = (upper - lower) / landing.rates(names(model.inputs), (lower, upper))
        return landing.rate * float(np.max(lasts, initial=0.0))
    return float(min(np.max(upper - lower, initial=0.0), 2 * _FARTHEST))


def reference_of(model: Model, reference: ReferenceTrajectory) -> ReferenceTrajectory:
    """The reference of what a model controls; one of a user's own may know only of names."""
    if hasattr(reference, "for_model"):
        return reference.for_model(model)
    return reference.restricted_to(model.controlled)


def check_reach(experiment: Experiment, references: FloatArray) -> None:
    """Remark what the rig cannot follow, references (samples, n_r) in rad.

    Raises ConfigurationError where a real rig is asked to go beyond its stops or its envelope.
    """
    model = experiment.model
    if not getattr(experiment.controller, "follows_reference", True):
        return
    units = {signal.name: signal.unit for signal in model.states}
    sentences = beyond_reach(
        references, model.controlled, envelope_of(experiment.plant), model.stops, units
    )
    if sentences and getattr(experiment.plant, "real_time", False):
        raise ConfigurationError(
            "; ".join(sentences),
            where="ref",
            remedy="a smaller reference, or other bounds in plant.envelope.readings",
        )
    for sentence in sentences or _beyond_thrust(model, references, experiment.sample_time):
        note(f"note   {sentence}")


def long_period(experiment: Experiment) -> Iterator[str]:
    """A sentence where the control period is long beside the time constants of a user's model."""
    model, step = experiment.model, experiment.sample_time
    if model.bench_sizes or model.sample_time is not None:
        return
    time, period = state_scales(model).time, experiment.samples_per_control * step
    better = max(1, int(_PERIODS[1] * time / step)) * step
    if period > _PERIODS[0] * time and better < period:
        yield (
            f"a control period of {period:g} s is long beside the time constants of {model.name}, "
            f"{time:.2g} s: try controller.sample_time={better:g}"
        )


def _beyond_thrust(model: Model, references: FloatArray, sample_time: float) -> list[str]:
    """A sentence for each angle whose reference stands still where no command holds the model.

    What moves on is not looked at: how far a rig swings beyond what it can hold is a matter of
    time.
    """
    steady = SteadyState(model)
    worst: dict[str, tuple[float, int, float, float]] = {}
    for k, level in _levels_at_rest(references, max(1, round(_AT_REST / sample_time))):
        target = steady.solve(level)
        if not (target.converged and target.projected):
            continue
        for axis, name in enumerate(model.controlled):
            short = abs(level[axis] - target.reference_reached[axis])
            far_off = max(_LEAST_SHORT, _SHORT * abs(level[axis]))
            if short > max(far_off, worst[name][0] if name in worst else 0.0):
                worst[name] = (short, k, level[axis], target.reference_reached[axis])
    unit = {signal.name: signal.unit for signal in model.states}
    return [
        f"the reference of {name} stands at {asked:.4g} {unit[name]} from "
        f"{k * sample_time:g} s on, where no command holds {model.name}: the nearest "
        f"steady state is at {nearest:.4g} {unit[name]}"
        for name, (_, k, asked, nearest) in worst.items()
    ]


def _levels_at_rest(references: FloatArray, samples: int) -> list[tuple[int, FloatArray]]:
    """Levels (n_r,) at which a reference stands still for so many samples, and from which on."""
    changes = np.flatnonzero(np.any(np.diff(references, axis=0) != 0, axis=1)) + 1
    begins = np.concatenate([[0], changes])
    lengths = np.diff([*begins.tolist(), len(references)])
    levels: dict[tuple[float, ...], int] = {}
    for k in begins[lengths >= samples].tolist():
        levels.setdefault(tuple(references[k].tolist()), k)
    return [(k, np.array(level)) for level, k in levels.items()][:_LEVELS]


def rehearse(
    experiment: Experiment,
    control: ControlSetup,
    observing: Callable[[FloatArray], ObserverSetup],
    references: FloatArray,
) -> None:
    """Ask observer and controller once for nothing, so that all is compiled and allocated."""
    e, model = experiment, experiment.model
    rest = dict(zip(model.state_names, model.rest().tolist(), strict=True))
    setup = observing(np.array([]))
    reading = np.array([rest.get(name, 0.0) for name in setup.outputs])
    observer_state = e.observer.init(observing(reading))
    gap_watch = e.gap_watch.init(observing(reading))
    gap_watch.step(control.first_command, reading)
    controller_state = e.controller.init(control)
    for want_prediction in (False, True):
        estimate = e.observer.step(observer_state, control.first_command, reading, rest)
        sample = ControlSample(0.0, references.copy(), estimate, control.first_command)
        e.controller.step(controller_state, sample, want_prediction=want_prediction)


def check_finite(references: FloatArray, times: FloatArray, axes: Sequence[str]) -> None:
    wrong = np.argwhere(~np.isfinite(references))
    if len(wrong):
        k, axis = wrong[0]
        raise ConfigurationError(
            f"the reference is {references[k, axis]} at {times[k]:g} s",
            where=f"ref.{axes[axis]}",
            remedy="a reference needs a finite value at every sample",
        )
