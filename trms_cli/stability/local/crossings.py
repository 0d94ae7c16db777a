"""Where an eigenvalue crosses the imaginary axis along a sweep, located to rounding.

Brent's method on Re λ of the tracked eigenvalue, the operating point solved anew for each value.
A pair that crosses off zero frequency is a Hopf point of the rig's equations if nothing else
happens there; what crosses at zero is the end or the exchange of an equilibrium.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

from trms_cli.stability.local.modes import rate_of
from trms_cli.stability.local.parts import STILL
from trms_cli.stability.local.sweep import Path, Place, Sweep
from trms_cli.stability.local.tracking import matched

#: Values are located to this share of the step that they are searched in.
_EXACT = 1e-12
#: A real part (1/s) that is larger than this where its sign changes has jumped.
_JUMPED = 1e-6


@dataclass(frozen=True)
class Crossing:
    """A crossing of the imaginary axis."""

    track: int  #: Of the sweep
    value: float  #: Of what is varied
    frequency: float  #: Im λ there, rad/s; 0 for a real eigenvalue
    unstable_above: bool  #: Whether the mode is unstable for larger values
    jumps: bool  #: Whether Re λ jumps there (a switch is passed) instead of going through zero
    place: Place

    @property
    def kind(self) -> str:
        """``Hopf`` or ``real``."""
        return "Hopf" if self.frequency > STILL else "real"


def rates_of(sweep: Sweep, sample_time: float | None) -> np.ndarray:
    """λ along a sweep, (n, n_x) complex, 1/s."""
    rates = [[rate_of(value, sample_time) for value in row] for row in sweep.eigenvalues]
    return np.array(rates, dtype=complex)


def crossings(path: Path, sweep: Sweep) -> tuple[Crossing, ...]:
    """All crossings of a sweep by rising value, one for each conjugate pair."""
    T = path.model.sample_time
    rates = rates_of(sweep, T)
    found = []
    for k, (before, after) in enumerate(zip(sweep.places, sweep.places[1:], strict=False)):
        for track in range(rates.shape[1]):
            a, b = rates[k, track], rates[k + 1, track]
            if min(abs(a.real), abs(b.real)) <= STILL or a.real * b.real > 0:
                continue
            crossing = _located(path, before, after, track)
            if crossing is not None and crossing.frequency > -STILL:
                found.append(crossing)
    return tuple(found)


def _located(path: Path, before: Place, after: Place, track: int) -> Crossing | None:
    T = path.model.sample_time

    def place_at(value: float) -> Place | None:
        place = path.following(before, value)
        if place is None:
            return None
        # The far end settles which of two modes that meet in between is which.
        if abs(value - after.value) < abs(value - before.value):
            place = replace(place, spectrum=matched(after.spectrum, place.spectrum)[0])
        return place

    def growth(value: float) -> float:
        place = place_at(value)
        return np.nan if place is None else rate_of(place.spectrum.values[track], T).real

    low, high = growth(before.value), growth(after.value)
    if not low * high < 0:
        return None
    span = abs(after.value - before.value)
    try:
        value = brentq(growth, before.value, after.value, xtol=_EXACT * span)
    except (ValueError, RuntimeError):
        return None
    place = place_at(value)
    if place is None:
        return None
    rate = rate_of(place.spectrum.values[track], T)
    frequency = rate.imag if abs(rate.imag) > STILL else 0.0
    return Crossing(track, value, frequency, high > 0, abs(rate.real) > _JUMPED, place)
