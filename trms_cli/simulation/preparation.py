"""What is looked at and tried before a rig is opened: references, reach, all that compiles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from trms_cli.controllers.controller import ControlSample, ControlSetup
from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.model import Model
from trms_cli.observers.observer import ObserverSetup
from trms_cli.plants.envelope import beyond_reach, envelope_of

if TYPE_CHECKING:
    from trms_cli.simulation.closed_loop import Experiment

#: V; no landing is reckoned to begin farther from the safe command, where a rig has no limits.
_FARTHEST = 100.0


def farthest_command(model: Model) -> float:
    """How far any command is from any other, V; something large where there are no limits."""
    lower, upper = model.input_bounds()
    return float(min(np.max(upper - lower, initial=0.0), 2 * _FARTHEST))


def refuse_beyond_reach(experiment: Experiment, references: FloatArray) -> None:
    """A real rig is not asked for what it cannot do."""
    sentences = out_of_reach(experiment, references)
    if sentences and getattr(experiment.plant, "real_time", False):
        raise ConfigurationError(
            "; ".join(sentences),
            where="ref",
            remedy="a smaller reference, or other bounds in plant.envelope.readings",
        )


def out_of_reach(experiment: Experiment, references: FloatArray) -> list[str]:
    """A sentence for each reference (samples, n_r) that goes beyond a stop or the envelope, rad."""
    model = experiment.model
    if not getattr(experiment.controller, "follows_reference", True):
        return []
    return beyond_reach(references, model.controlled, envelope_of(experiment.plant), model.stops)


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
