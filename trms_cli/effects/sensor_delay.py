"""Delay of an angle sensor, of any fraction of a sample: ``y(t) = α(t − d)``.

The sensor remembers what it would have shown at past samples. Between them stand cubics with the
slopes of parabolas through neighbours (Catmull & Rom 1974, for uneven spacing): exact for
parabolas in time, of third order in the sample time otherwise, smooth in the delay.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.effects.effect import EffectContext, SensorEffect
from trms_cli.models.model import Signal, Window
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class SensorDelay(SensorEffect):
    """Transport delay of one measured angle."""

    axis: str  #: Name of an axis of the model, or of an output
    delay: NotNegative | None = None  #: d, s
    #: Bound of the delay, s; the past angles that are kept reach back this far
    longest: Positive = 0.1

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("delay", "s", (0.02, 0.1), "transport delay d", upper=self._reach),)

    @property
    def _reach(self) -> float:
        return max(self.longest, self.delay or 0.0)

    def sensor_memory(self, step: float) -> tuple[Signal, ...]:
        # One more than the delay reaches: the slope of the last stretch needs a neighbour.
        count = math.ceil(self._reach / step - 1e-9) + 1
        return tuple(Signal(f"past_{k + 1}", "rad", "earlier angle") for k in range(count))

    def sensor_path(
        self, at: EffectContext, before: ca.SX, after: ca.SX, window: Window, step: float
    ) -> ca.SX:
        if window[0] > 0:
            return at.sensor_memory
        row = self.row(at.model)
        return ca.vertcat(before[row], at.sensor_memory[:-1, 0])

    def inverse(
        self, recorded: FloatArray, step: float, sizes: Mapping[str, float]
    ) -> FloatArray | None:
        from scipy.interpolate import CubicSpline

        valid_rows = np.flatnonzero(np.isfinite(recorded))
        if len(valid_rows) < 4:
            return np.full_like(recorded, np.nan)
        later = np.arange(len(recorded)) + sizes["delay"] / step
        # what was not measured, and what is shown before the first sample or after the last, stays
        # unknown
        between = np.clip(np.searchsorted(valid_rows, later), 1, len(valid_rows) - 1)
        inside = valid_rows[between] - valid_rows[between - 1] <= 1
        inside &= (later >= valid_rows[0]) & (later <= valid_rows[-1])
        return np.where(inside, CubicSpline(valid_rows, recorded[valid_rows])(later), np.nan)

    def reading(self, at: EffectContext, y: ca.SX, step: float, since: float) -> ca.SX:
        row = self.row(at.model)
        # Ages of the remembered angles in steps: now, the last sample, the one before …
        ages = [0.0, *(since + k for k in range(at.sensor_memory.shape[0]))]
        angles = [y[row], *ca.vertsplit(at.sensor_memory)]
        y = ca.SX(y)
        y[row] = _at_age(at.sizes["delay"] / step, ages, angles)
        return y


def _at_age(age: ca.SX, ages: list[float], values: list[ca.SX]) -> ca.SX:
    """The curve through values of rising ages, at an age; beyond the last one its value.

    Written as the first value and what each stretch adds, which is zero bit for bit where the
    stretch has not begun.
    """
    widths = [b - a for a, b in pairwise(ages)]
    rises = [b - a for a, b in pairwise(values)]
    slopes = _slopes(widths, rises)
    result = values[0]
    for k, (width, rise) in enumerate(zip(widths, rises, strict=True)):
        s = ca.fmin(ca.fmax((age - ages[k]) / width, 0), 1)
        bend = (1 - s) * width * slopes[k] - s * width * slopes[k + 1]
        result = result + s * s * (3 - 2 * s) * rise + s * (1 - s) * bend
    return result


def _slopes(widths: list[float], rises: list[ca.SX]) -> list[ca.SX]:
    """Slope at each age of the parabola through it and its neighbours."""
    steep = [rise / width for rise, width in zip(rises, widths, strict=True)]
    inner = [
        (steep[k] * widths[k + 1] + steep[k + 1] * widths[k]) / (widths[k] + widths[k + 1])
        for k in range(len(widths) - 1)
    ]
    if not inner:
        return [steep[0], steep[0]]
    return [2 * steep[0] - inner[0], *inner, 2 * steep[-1] - inner[-1]]
