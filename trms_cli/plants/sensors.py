"""Sensors of a simulated rig: noise, quantum, lost samples; all drawn before the run."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.core.ranges import NotNegative
from trms_cli.models.model import Signal, names
from trms_cli.recordings.recording import quantum

#: A perfect channel still gets this declared noise (its unit), so that an observer's covariance
#: stays invertible.
_LEAST_NOISE = 1e-6
#: The same of an estimate, as a share of what the channel spans.
_LEAST_SHARE = 1e-9
#: Standard deviation of a normal variable over its median absolute value.
_MAD_TO_SD = 1.4826
#: The third difference of white noise of variance 1 has the variance 1 + 9 + 9 + 1.
_THIRD_DIFFERENCE_SD = 20**0.5


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

    def noise_in(
        self,
        measurements: FloatArray,
        outputs: Sequence[Signal],
        remarks: list[str],
        estimated: Collection[str] = (),
    ) -> dict[str, float]:
        """Declared noise of what was recorded; of some, and what is not declared, an estimate.

        Where others are declared and a channel is not, the declaration is of another rig: of the
        bench, while the model has other names. An estimate is told in the remarks.

        ``measurements``: (n, n_y) array; NaN where missing.
        """
        noise = self.declared_noise(names(outputs))
        declared = {*self.noise_sd, *self.quantum}
        said = []
        for signal, column in zip(outputs, measurements.T, strict=True):
            name = signal.name
            if name in estimated or (declared and name not in declared):
                estimate = float(noise_estimate(column[:, None])[0])
                if name not in estimated:
                    span = float(np.nanmax(column) - np.nanmin(column))
                    rounding = (quantum(column) or 0.0) / 12**0.5
                    noise[name] = max(estimate, rounding, _LEAST_SHARE * span)
                noise[name] = max(noise[name], estimate)
                said.append(f"{name} {noise[name]:.3g} {signal.unit}")
        if said:
            remarks.append(f"noise estimated from the data: {', '.join(said)}")
        return noise

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


def noise_estimate(measurements: FloatArray) -> FloatArray:
    """Standard deviation of the white noise on each column.

    From the third differences, in which a motion that is smooth over four samples cancels, by
    their median absolute value, which single outliers do not move. Samples beside a missing
    one have no part in it. It overestimates where the motion is fast for the sample time. A
    channel at rest on an encoder's step gives 0; the quantum's share is declared apart.

    ``measurements``: (n, n_y) array; NaN where missing. Returns (n_y,) array; 0 for a column with
    fewer than eight differences.
    """
    estimates = []
    for column in measurements.T:
        third = np.diff(column, 3)
        third = third[np.isfinite(third)]
        spread = float(np.median(np.abs(third))) if len(third) >= 8 else 0.0
        estimates.append(_MAD_TO_SD * spread / _THIRD_DIFFERENCE_SD)
    return np.array(estimates)
