"""What a sensor makes of an angle, a speed or any other output.

Where a sensor remembers, the output is taken as linear in time over each integration step, for
which lags and modes are solved exactly: none is too fast for the step.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import casadi as ca
import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ModelError
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.effects.effect import EffectContext, SensorEffect, output_row
from trms_cli.effects.inputs import LONGEST
from trms_cli.models.model import Model, Signal, Window, names
from trms_cli.models.parameters import Parameter
from trms_cli.models.scales import port_scale

#: A grid finer than doubles are: rounding to it changes no bit, but has a derivative of zero.
_FINEST = 2.0**-100
#: Hz: a slower mode is a motion of the rig; and at zero it would not exist.
_SLOWEST = 0.1


@dataclass(frozen=True, kw_only=True)
class SensorBias(SensorEffect):
    """Bias of an angle sensor: the encoder's zero is not where the beam is level, ``y = α + b``."""

    axis: str  #: Name of an axis of the model, or of an output
    bias: Annotated[float, Meta(ge=-1, le=1)] | None = None  #: b, rad

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("bias", "rad", (-0.035, 0.035), "bias b"),)

    def inverse(
        self, recorded: FloatArray, step: float, sizes: Mapping[str, float]
    ) -> FloatArray | None:
        return recorded - sizes["bias"]

    def output(self, at: EffectContext, y: ca.SX) -> ca.SX:
        return self.add_to_channel(at, y, at.sizes["bias"])


@dataclass(frozen=True, kw_only=True)
class SensorScale(SensorEffect):
    """Scale error of a sensor: ``y = (1 + e) α``."""

    axis: str  #: Name of an output, or of an axis
    error: Annotated[float, Meta(ge=-0.9, le=9)] | None = None  #: e

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("error", "1", (-0.1, 0.1), "relative error e of the gain"),)

    def output(self, at: EffectContext, y: ca.SX) -> ca.SX:
        return self.add_to_channel(at, y, at.sizes["error"] * y[self.row(at.model)])


@dataclass(frozen=True, kw_only=True)
class Crosstalk(SensorEffect):
    """Crosstalk of a sensor: it shows a part of another output, ``y_i = α_i + c (s_i/s_j) α_j``.

    ``s`` are the ranges of the two, so that c is a share of the other one's range.
    """

    axis: str  #: Name of an output, or of an axis
    source: str | None = None  #: Name of the other output; None: the next one of the model
    share: Annotated[float, Meta(ge=-1, le=1)] | None = None  #: c

    def check(self, model: Model) -> None:
        self.row(model)
        if self.source_row(model) == self.row(model):
            raise ModelError(
                f"model {model.name!r} has no output beside {self.axis!r} that it could show",
                remedy="crosstalk is between two outputs",
            )

    def source_row(self, model: Model) -> int:
        """Position of the other output in ``y``."""
        if self.source is not None:
            return output_row(model, self.source)
        return (self.row(model) + 1) % model.n_y

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("share", "1", (-0.1, 0.1), "share c of the other output"),)

    def output(self, at: EffectContext, y: ca.SX) -> ca.SX:
        outputs, other = names(at.model.outputs), self.source_row(at.model)
        own = port_scale(at.model, output=outputs[self.row(at.model)]).travel
        ratio = own / port_scale(at.model, output=outputs[other]).travel
        return self.add_to_channel(at, y, at.sizes["share"] * ratio * y[other])


@dataclass(frozen=True, kw_only=True)
class Quantisation(SensorEffect):
    """Quantisation of an angle: an encoder counts lines, ``y = q round(α/q)``.

    Rounding has no useful derivative: it is zero nearly everywhere, and a fit would see a sensor
    that shows nothing. What stands here has the value of the rounded angle and the derivative of
    the angle itself (the straight-through derivative: that of the mean over a quantum), and none in
    the quantum.
    """

    axis: str  #: Name of an axis of the model, or of an output
    quantum: NotNegative | None = None  #: q, rad

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("quantum", "rad", (0.001, 0.007), "quantum q"),)

    def resolution(self, model: Model) -> tuple[str, int]:
        return "quantum", self.row(model)

    def output(self, at: EffectContext, y: ca.SX) -> ca.SX:
        row = self.row(at.model)
        y = ca.SX(y)
        angle, quantum = y[row], _constant(at.sizes["quantum"])
        width = ca.fmax(quantum, _FINEST)
        rounding = width * ca.floor(angle / width + 0.5) - _constant(angle)
        y[row] = angle + ca.if_else(quantum > 0, rounding, 0)
        return y


def _constant(value: ca.SX) -> ca.SX:
    """The value with a derivative of zero."""
    return ca.floor(value / _FINEST) * _FINEST


@dataclass(frozen=True, kw_only=True)
class TachoLag(SensorEffect):
    """Lag of a tacho: the measured speed of a rotor is filtered, ``τ ẏ = ω − y``."""

    rotor: str  #: Name of a rotor of the model, or of an output
    time_constant: NotNegative | None = None  #: τ, s

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("time_constant", "s", (0.005, 0.1), "time constant τ"),)

    def sensor_memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("lag", "rad", "what is shown less what is there"),)

    def sensor_path(
        self, at: EffectContext, before: ca.SX, after: ca.SX, window: Window, step: float
    ) -> ca.SX:
        row = self.row(at.model)
        duration = (window[1] - window[0]) * step
        return _first_order_ramp(
            at.sensor_memory, after[row] - before[row], at.sizes["time_constant"], duration
        )

    def reading(self, at: EffectContext, y: ca.SX, step: float, since: float) -> ca.SX:
        return self.add_to_channel(at, y, at.sensor_memory[0])


@dataclass(frozen=True, kw_only=True)
class Dropout(SensorEffect):
    """Dropouts of a sensor: a share of its samples is lost, the last one shown in their place.

    Which are lost is chance. This is what such a sensor shows on the mean of all chances,
    ``m⁺ = p m + (1 − p) α``; a rig that loses samples in earnest has a fault (group ``fault``).
    """

    axis: str  #: Name of an output, or of an axis
    share: Annotated[float, Meta(ge=0, le=0.99)] | None = None  #: p: of the samples that are lost

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("share", "1", (0.3, 0.8), "share p of lost samples"),)

    def sensor_memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("lag", "rad", "what was shown less what was there"),)

    def sensor_path(
        self, at: EffectContext, before: ca.SX, after: ca.SX, window: Window, step: float
    ) -> ca.SX:
        row = self.row(at.model)
        kept = at.sizes["share"] if window[1] >= 1 else 1
        return kept * (at.sensor_memory - (after[row] - before[row]))

    def reading(self, at: EffectContext, y: ca.SX, step: float, since: float) -> ca.SX:
        return self.add_to_channel(at, y, at.sensor_memory[0])


@dataclass(frozen=True, kw_only=True)
class FlexibleMode(SensorEffect):
    """A flexible mode between the beam and the sensor: a lightly damped oscillator in series.

    What the encoder sits on hangs on the axis by a spring of its own; its deflection δ is driven by
    the acceleration of the axis, as that of a mass on a moving base::

        δ̈ + 2 ζ ω₀ δ̇ + ω₀² δ = −α̈        y = α + c δ

    With c = 1 the whole of it is seen, y/α = (2ζω₀ s + ω₀²)/(s² + 2ζω₀ s + ω₀²).
    """

    axis: str  #: Name of an axis of the model, or of an output
    #: c: how much of the deflection is seen
    share: Annotated[float, Meta(ge=0, le=10)] | None = None
    frequency: Annotated[float, Meta(ge=_SLOWEST)] | None = None  #: ω₀/2π, Hz
    damping: Annotated[float, Meta(ge=0, le=0.9)] | None = None  #: ζ

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("share", "1", (0.2, 2.0), "share c seen"),
            self.size("frequency", "Hz", (2.0, 12.0), "frequency ω₀/2π"),
            self.size("damping", "1", (0.01, 0.05), "damping ratio ζ"),
        )

    def sensor_memory(self, step: float) -> tuple[Signal, ...]:
        return (
            Signal("deflection", "rad", "deflection δ of the mode"),
            Signal("rate", "rad/s", "rate of the mode's own angle α + δ"),
        )

    def sensor_path(
        self, at: EffectContext, before: ca.SX, after: ca.SX, window: Window, step: float
    ) -> ca.SX:
        row = self.row(at.model)
        duration = (window[1] - window[0]) * step
        axis_rate = (after[row] - before[row]) / duration
        deflection, slope = at.sensor_memory[0], at.sensor_memory[1] - axis_rate
        # δ̈ + 2 ζ ω₀ δ̇ + ω₀² δ = 0 from here to the end of the part.
        zeta, natural = at.sizes["damping"], 2 * math.pi * at.sizes["frequency"]
        damped = natural * ca.sqrt(1 - zeta**2)
        decay = ca.exp(-zeta * natural * duration)
        cosine, sine = ca.cos(damped * duration), ca.sin(damped * duration) / damped
        damping_term = zeta * natural * sine
        return ca.vertcat(
            decay * (deflection * (cosine + damping_term) + slope * sine),
            decay * (slope * (cosine - damping_term) - deflection * natural**2 * sine) + axis_rate,
        )

    def reading(self, at: EffectContext, y: ca.SX, step: float, since: float) -> ca.SX:
        return self.add_to_channel(at, y, at.sizes["share"] * at.sensor_memory[0])


@dataclass(frozen=True, kw_only=True)
class SensorDelay(SensorEffect):
    """Transport delay of an angle sensor, of any fraction of a sample: ``y(t) = α(t − d)``.

    The sensor remembers what it would have shown at past samples. Between them stand cubics with
    the slopes of parabolas through neighbours (Catmull & Rom 1974, for uneven spacing): exact for
    parabolas in time, of third order in the sample time otherwise, smooth in the delay.
    """

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


def _first_order_ramp(error: ca.SX, rise: ca.SX, time_constant: ca.SX, duration: float) -> ca.SX:
    """How far ``τ v̇ = target − v`` is off its target after a window over which that rises evenly.

    ``e⁺ = exp(−h/τ) e − (1 − exp(−h/τ)) (τ/h) rise`` for ``e = v − target``. For τ = 0 it is zero,
    bit for bit, with finite derivatives.

    ``error``: v − target at the beginning of the window. ``rise``: change of the target over the
    window. ``time_constant``: τ, s, not negative. ``duration``: h, s.
    """
    divisor = ca.fmax(time_constant, duration / LONGEST)
    decay = ca.exp(-duration / divisor)
    return decay * error - (1 - decay) * (time_constant / duration) * rise
