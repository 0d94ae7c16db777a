"""What an excitation is: unit signals for all inputs in a band, unlike one another."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError


@dataclass(frozen=True)
class Plan:
    """What an excitation is asked for."""

    samples: int
    sample_time: float  #: s
    lowest: float  #: Band, Hz
    highest: float  #: Band, Hz
    inputs: int  #: How many signals
    seed: int = 0  #: Of everything that is drawn

    @property
    def duration(self) -> float:
        """s."""
        return self.samples * self.sample_time

    @property
    def time(self) -> FloatArray:
        """s from the begin, (samples,)."""
        return np.arange(self.samples, dtype=float) * self.sample_time


@dataclass(frozen=True)
class Shape:
    """Signals of unit peak."""

    values: FloatArray  #: (samples, inputs) array; within ±1, the largest size of each column 1
    about: dict[str, Any]  #: What was chosen: figures for the report, plain data


class ExcitationPlugin(Protocol):
    """A kind of excitation: immutable configuration."""

    def shape(self, plan: Plan) -> Shape:
        """The signals.

        Raises ConfigurationError if the band does not fit into the duration or below the Nyquist
        frequency.
        """


def crest_factor(values: FloatArray) -> float:
    """Largest size over the root of the mean square, both about the mean; 1 at best."""
    centred = values - values.mean()
    power = float(np.sqrt(np.mean(centred**2)))
    return float(np.abs(centred).max()) / power if power > 0 else float("inf")


def shape_of(signals: Sequence[FloatArray], **about: Any) -> Shape:
    """Signals brought to unit peak, their crest factors beside what was chosen."""
    values = np.column_stack(signals)
    peak = np.abs(values).max(axis=0)
    about["crest_factor"] = [crest_factor(column) for column in values.T]
    return Shape(values / np.where(peak > 0, peak, 1.0), about)


def check_band(plan: Plan) -> None:
    """Refuse a band that cannot be played.

    Raises ConfigurationError: it names the key and what is possible.
    """
    nyquist = 0.5 / plan.sample_time
    if not 0 < plan.lowest < plan.highest:
        too_short = plan.highest * plan.duration <= 1
        raise ConfigurationError(
            f"a band from {plan.lowest:.4g} to {plan.highest:.4g} Hz",
            where="duration" if too_short else "band.highest",
            remedy=f"a longer duration: {plan.duration:g} s hold no period of {plan.highest:.4g} Hz"
            if too_short
            else "give band.lowest < band.highest",
        )
    if plan.highest > 0.8 * nyquist:
        raise ConfigurationError(
            f"{plan.highest:.4g} Hz cannot be sampled every {plan.sample_time:g} s",
            where="band.highest",
            remedy=f"at most {0.8 * nyquist:.4g} Hz, or a smaller sample_time",
        )
    if plan.lowest * plan.duration < 1 - 1e-9:
        raise ConfigurationError(
            f"{plan.lowest:.4g} Hz has a period of {1 / plan.lowest:.4g} s, longer than the "
            f"excitation's {plan.duration:g} s",
            where="duration",
            remedy=f"at least {1 / plan.lowest:.4g} s, or a higher band.lowest",
        )
