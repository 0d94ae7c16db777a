"""Sensors of a simulated rig: noise, quantum, lost samples; all drawn before the run."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.core.ranges import NotNegative

#: A perfect channel still gets this declared noise (its unit), so that an observer's covariance
#: stays invertible.
_LEAST_NOISE = 1e-6


@dataclass(frozen=True, kw_only=True)
class Sensors:
    """Which channels are measured, and how well."""

    channels: tuple[str, ...] | None = None  #: Measured outputs; None takes all that the model has
    #: Standard deviation of white noise per channel, rad or rad/s
    noise_sd: Mapping[str, NotNegative] = field(default_factory=dict)
    #: Resolution per channel (an encoder's step, a tacho's bit), rad or rad/s; 0 for none
    quantum: Mapping[str, NotNegative] = field(default_factory=dict)
    #: Share of the samples that are lost, each sample with all its channels
    loss_probability: Annotated[float, Meta(ge=0, lt=1)] = 0.0

    def measured(self, available: tuple[str, ...]) -> tuple[str, ...]:
        """The measured channels, checked against what the model has.

        Raises ConfigurationError for a channel that the model does not have.
        """
        selection = available if self.channels is None else tuple(self.channels)
        for name in selection:
            require_known(name, available, f"the model measures no {name!r}", "sensors.channels")
        if not selection:
            raise ConfigurationError(
                "no channel is measured",
                where="sensors.channels",
                remedy=f"choose from: {', '.join(available)}",
            )
        return selection

    def declared_noise(self, channels: tuple[str, ...]) -> dict[str, float]:
        """Standard deviation of noise and quantisation (uniform, q²/12) together."""
        return {
            name: max(
                _LEAST_NOISE,
                float(
                    np.hypot(self.noise_sd.get(name, 0.0), self.quantum.get(name, 0.0) / 12**0.5)
                ),
            )
            for name in channels
        }

    def draw_noise(
        self, channels: tuple[str, ...], samples: int, generator: np.random.Generator
    ) -> FloatArray:
        """All noise of a run, shape (samples, n_y); NaN where the sample is lost."""
        # Always the same number of draws, so that one channel's noise does not shift another's.
        noise = generator.standard_normal((samples, len(channels)))
        noise *= [self.noise_sd.get(name, 0.0) for name in channels]
        is_lost = generator.random(samples) < self.loss_probability
        noise[is_lost] = np.nan
        return noise

    def quanta(self, channels: tuple[str, ...]) -> FloatArray:
        """Resolution of each channel, 0 for none, shape (n_y,)."""
        return np.array([self.quantum.get(name, 0.0) for name in channels])
