"""Plugins that do nothing, so that what is left of a run is the loop and its log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model
from trms_cli.observers.observer import ObserverSetup
from trms_cli.plants.landing import Landing
from trms_cli.plants.plant import PlantSetup


@dataclass(frozen=True)
class HollowPlant:
    """Always the same state and measurement."""

    model: Model
    landing: ClassVar[Landing] = Landing(after_run=False)

    def init(self, setup: PlantSetup) -> HollowRun:
        return HollowRun(self.model)


class HollowRun:
    """See :class:`trms_cli.plants.plant.PlantRun`."""

    def __init__(self, model: Model) -> None:
        self.inputs, self.outputs, self.states = model.inputs, model.outputs, model.states
        self.noise_sd = {signal.name: 1.0 for signal in model.outputs}
        self.first_command = np.zeros(model.n_u)
        self.input_limits = model.input_bounds()
        self.known_disturbances: dict[str, Any] = {}
        # Digits as of real figures: a zero is quicker to write.
        generator = np.random.default_rng(0)
        self.state = generator.standard_normal(model.n_x)
        self._y = generator.standard_normal(model.n_y)

    def measure(self) -> np.ndarray:
        return self._y

    def advance(self, command: np.ndarray) -> None:
        pass


@dataclass(frozen=True)
class HollowObserver:
    """Always the same estimate, all its fields filled."""

    def init(self, setup: ObserverSetup) -> Estimate:
        generator = np.random.default_rng(1)
        model, n_y = setup.model, len(setup.outputs)
        sizes = (model.n_x, model.n_x, model.n_w, model.n_w, n_y, n_y, n_y)
        return Estimate(*(generator.standard_normal(size) for size in sizes))

    def step(
        self,
        state: Estimate,
        command: np.ndarray,
        measurement: np.ndarray,
        truth: Mapping[str, float] | None,
        known: np.ndarray | None = None,
    ) -> Estimate:
        return state


@dataclass(frozen=True)
class HollowController:
    """Always the same command."""

    sample_time: float | None = None

    def preview(self, setup: ControlSetup) -> int:
        return 0

    def init(self, setup: ControlSetup) -> Command:
        u = np.full(setup.model.n_u, 0.123456789)
        return Command(u, objective=1.23456789, kkt_residual=1e-9, slack=0.0)

    def step(self, state: Command, sample: ControlSample, *, want_prediction: bool) -> Command:
        return state
