"""newton_mpc and the UKF as the driver of the blind benchmark's rigs.

The rigs are those of :mod:`.blind.rig`, whose equations are no model's. Controller and observer
see what a lab's would: measured samples, and a model that somebody gave them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.gap.blind.rig import COMMAND_LIMIT, PITCH_QUANTUM, SPEED_NOISE, SPEED_QUANTUM
from trms_cli.composition.composer import compose
from trms_cli.controllers.controller import Controller, ControlSample, ControlSetup
from trms_cli.core.plugins import build
from trms_cli.models.model import Model, names
from trms_cli.observers.observer import Observer, ObserverSetup
from trms_cli.references.trajectory import ReferenceTrajectory

FloatArray = npt.NDArray[np.float64]

#: Channels in the order of the rigs' sensors.
CHANNELS = ("alpha_v", "alpha_h", "omega_v", "omega_h")
#: Standard deviation of their noise, quanta included: what the maker of a sensor declares.
NOISE_SD = dict(
    zip(
        CHANNELS,
        [PITCH_QUANTUM / np.sqrt(12)] * 2
        + [np.hypot(SPEED_NOISE, SPEED_QUANTUM / np.sqrt(12))] * 2,
        strict=True,
    )
)


@dataclass(frozen=True)
class Loop:
    """What closes a loop around a rig."""

    observer: Observer
    controller: Controller
    reference: ReferenceTrajectory


def loop_of(words: Sequence[str] = ()) -> Loop:
    """Observer, controller and reference as ``trms run`` would build them from its words."""
    config = compose([*words, "picture=false"]).config
    return Loop(*(build(config[key], key) for key in ("observer", "controller", "ref")))


class ModelBased:
    """One loop a rig, each with its own model; a :class:`experiments.gap.blind.rig.Driver`.

    The rigs have to begin at rest without a command (``settling=0``).

    Parameters
    ----------
    loops : sequence of n Loop
    models : sequence of n Model
        What each loop believes of its rig.
    samples : int
        Of the run.
    sample_time : float
        s.

    Attributes
    ----------
    references : (n, samples, 2) array
        Pitch and yaw, rad.
    """

    def __init__(
        self, loops: Sequence[Loop], models: Sequence[Model], samples: int, sample_time: float
    ) -> None:
        self._rigs = [
            _Controlled(loop, model, samples, sample_time)
            for loop, model in zip(loops, models, strict=True)
        ]
        self.references: FloatArray = np.stack([rig.references[:samples] for rig in self._rigs])

    def command(self, k: int, time: float, measured: FloatArray) -> FloatArray:
        """See :class:`experiments.gap.blind.rig.Driver`."""
        return np.stack(
            [rig.command(k, time, y) for rig, y in zip(self._rigs, measured, strict=True)]
        )


class _Controlled:
    """Observer and controller of one rig during a run."""

    def __init__(self, loop: Loop, model: Model, samples: int, sample_time: float) -> None:
        self._loop, self._model, self._sample_time = loop, model, sample_time
        period = getattr(loop.controller, "sample_time", None) or sample_time
        self._ratio = round(period / sample_time)
        self._u = np.zeros(model.n_u)
        setup = ControlSetup(model, period, self._u)
        ahead = self._ratio * np.arange(loop.controller.preview(setup) + 1)
        times = sample_time * np.arange(samples + ahead[-1])
        self._ahead = ahead
        self.references: FloatArray = loop.reference.restricted_to(model.controlled).sample(times)
        self._controller_state = loop.controller.init(setup)
        self._observer_state: Any = None

    def command(self, k: int, time: float, measured: FloatArray) -> FloatArray:
        """The command from now on, (2,) V."""
        if self._observer_state is None:
            self._observer_state = self._loop.observer.init(self._observing(measured))
        estimate = self._loop.observer.step(self._observer_state, self._u, measured, None)
        if k % self._ratio == 0:
            sample = ControlSample(time, self.references[k + self._ahead], estimate, self._u)
            command = self._loop.controller.step(
                self._controller_state, sample, want_prediction=False
            )
            self._u = np.clip(np.array(command.u, dtype=float), -COMMAND_LIMIT, COMMAND_LIMIT)
        return self._u

    def _observing(self, measured: FloatArray) -> ObserverSetup:
        noise: Mapping[str, float] = NOISE_SD
        model_outputs = names(self._model.outputs)
        if model_outputs != CHANNELS:
            raise ValueError(f"the rigs measure {CHANNELS}, and the model {model_outputs}")
        return ObserverSetup(self._model, self._sample_time, CHANNELS, noise, measured, self._u)
