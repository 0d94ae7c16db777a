"""The tracks of a sweep as modes: conjugate partners together, named by who takes part.

Where an eigenvalue crosses the imaginary axis along a sweep, located to rounding.

Brent's method on Re λ of the tracked eigenvalue, the operating point solved anew for each value.
A pair that crosses off zero frequency is a Hopf point of the rig's equations if nothing else
happens there; what crosses at zero is the end or the exchange of an equilibrium.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

from trms_cli.core.arrays import ComplexArray
from trms_cli.models.model import Model
from trms_cli.stability.local.modes import STILL, mode_name, parts_of, rate_of, shares_of_parts
from trms_cli.stability.local.sweep import EigenvalueSweep, LocusPoint, OperatingPath, match_spectra

#: Modes this many times as fast as the fastest motion of an axis have no room in a plane with it.
_FAR = 8.0


@dataclass(frozen=True)
class Track:
    """A mode over a sweep."""

    name: str  #: After the states that take part, on average
    part: str  #: The part of the rig with the largest share
    members: tuple[int, ...]  #: Columns of the sweep: one, or a pair that is conjugate somewhere
    rates: ComplexArray  #: (n, m) complex array; λ of the members, 1/s
    #: Too fast to be shown beside the motions of the axes: armature currents, a network's memory
    fast: bool

    @property
    def slowest(self) -> ComplexArray:
        """The member with the largest real part and a frequency of at least zero, (n,)."""
        best = np.argmax(self.rates.real + 1e-12 * (self.rates.imag > 0), axis=1)
        chosen = self.rates[np.arange(len(best)), best]
        found: ComplexArray = chosen.real + 1j * np.abs(chosen.imag)
        return found


@dataclass(frozen=True)
class Locus:
    """Eigenvalues over a range as modes, and where they cross the imaginary axis."""

    path: OperatingPath
    sweep: EigenvalueSweep
    tracks: tuple[Track, ...]
    crossings: tuple[Crossing, ...]

    def name(self, crossing: Crossing) -> str:
        """The mode that crosses, by what it is of there.

        That is the name of its track, unless the mode has become another along the range: its
        largest share is of another part, or it swings there and does not elsewhere.
        """
        track = next(track for track in self.tracks if crossing.track in track.members)
        shares = crossing.place.spectrum.participation(crossing.track)
        parts = parts_of(self.path.model)
        part = next(iter(shares_of_parts(parts, shares)))
        swings = crossing.frequency > 0.0
        if part == track.part and swings == ("swing" in track.name):
            return track.name
        # A real one grows on one side of the crossing: that is what it is called after.
        rate = complex(0.0, crossing.frequency) if swings else complex(1.0)
        return mode_name(parts, shares, rate)


def locus_of(path: OperatingPath, sweep: EigenvalueSweep) -> Locus:
    """The modes of a sweep and their crossings."""
    return Locus(path, sweep, tracks_of(path.model, sweep), crossings(path, sweep))


def tracks_of(model: Model, sweep: EigenvalueSweep) -> tuple[Track, ...]:
    """The modes of a sweep, the slowest motions of the rig first."""
    parts = parts_of(model)
    rates = rates_of(sweep, model.sample_time)
    found = []
    for members in _partners(rates):
        shares = np.mean(
            [[place.spectrum.participation(i) for i in members] for place in sweep.places],
            axis=(0, 1),
        )
        own = rates[:, members]
        swings = np.abs(own.imag).max(axis=1) > STILL
        typical = own[np.flatnonzero(swings)[0], 0] if swings.mean() >= 0.5 else own.real.mean()
        typical = complex(typical.real, abs(typical.imag))
        of_parts = shares_of_parts(parts, shares)
        found.append(
            (mode_name(parts, shares, typical), next(iter(of_parts)), members, own, shares)
        )
    moving = [
        float(np.median(np.abs(own)))
        for name, part, _, own, _ in found
        if part in model.axes and not name.startswith("past")
    ]
    paces = [float(np.median(np.abs(own))) for *_, own, _ in found]
    paces = [pace for pace in paces if np.isfinite(pace) and pace > STILL]
    limit = _FAR * max(moving or [min(paces, default=1.0)])
    tracks = [
        Track(name, part, tuple(members), own, not float(np.median(np.abs(own))) <= limit)
        for name, part, members, own, _ in found
    ]
    tracks.sort(key=lambda track: float(np.median(np.abs(track.rates))))
    return tuple(_distinct(tracks))


def cell(rates: ComplexArray, digits: int = 3) -> str:
    """λ of a mode at a point: ``−0.047 ± 1.83j``, or two real ones."""
    if np.abs(rates.imag).max() > STILL:
        return f"{_number(rates.real.mean(), digits)} ± {np.abs(rates.imag).max():.{digits}g}j"
    return ", ".join(_number(value, digits) for value in sorted(rates.real))


def _number(value: float, digits: int) -> str:
    if not np.isfinite(value):
        return "−∞"
    return f"{0.0 if abs(value) <= STILL else value:.{digits}g}".replace("-", "−")


def _partners(rates: ComplexArray) -> list[list[int]]:
    """Columns, each with the one that it is conjugate to where it swings."""
    left = list(range(rates.shape[1]))
    groups = []
    while left:
        i = left.pop(0)
        swings = np.flatnonzero(np.abs(rates[:, i].imag) > STILL)
        partner = None
        if swings.size:
            votes = [
                min(left, key=lambda j: abs(rates[k, j] - rates[k, i].conjugate()), default=None)
                for k in swings
            ]
            counted = [j for j in votes if j is not None]
            best = max(set(counted), key=counted.count) if counted else None
            if best is not None and np.median(
                np.abs(rates[swings, best] - rates[swings, i].conj())
            ) <= 1e-6 * (1.0 + np.median(np.abs(rates[swings, i]))):
                partner = best
        if partner is not None:
            left.remove(partner)
        groups.append([i] if partner is None else [i, partner])
    return groups


def _distinct(tracks: list[Track]) -> list[Track]:
    found = list(tracks)
    for name in {track.name for track in tracks}:
        same = [i for i, track in enumerate(found) if track.name == name]
        if len(same) < 2:
            continue
        words = ("slower", "faster") if len(same) == 2 else [str(k + 1) for k in range(len(same))]
        for i, word in zip(same, words, strict=True):
            t = found[i]
            found[i] = Track(f"{name} ({word})", t.part, t.members, t.rates, t.fast)
    return found


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
    place: LocusPoint

    @property
    def kind(self) -> str:
        """``Hopf`` or ``real``."""
        return "Hopf" if self.frequency > STILL else "real"


def rates_of(sweep: EigenvalueSweep, sample_time: float | None) -> np.ndarray:
    """λ along a sweep, (n, n_x) complex, 1/s."""
    rates = [[rate_of(value, sample_time) for value in row] for row in sweep.eigenvalues]
    return np.array(rates, dtype=complex)


def crossings(path: OperatingPath, sweep: EigenvalueSweep) -> tuple[Crossing, ...]:
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


def _located(
    path: OperatingPath, before: LocusPoint, after: LocusPoint, track: int
) -> Crossing | None:
    T = path.model.sample_time

    def place_at(value: float) -> LocusPoint | None:
        place = path.following(before, value)
        if place is None:
            return None
        # The far end settles which of two modes that meet in between is which.
        if abs(value - after.value) < abs(value - before.value):
            place = replace(place, spectrum=match_spectra(after.spectrum, place.spectrum)[0])
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
