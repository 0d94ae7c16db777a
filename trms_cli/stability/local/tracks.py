"""The tracks of a sweep as modes: conjugate partners together, named by who takes part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.models.model import Model
from trms_cli.stability.local.crossings import rates_of
from trms_cli.stability.local.parts import STILL, mode_name, parts_of, shares_of_parts
from trms_cli.stability.local.sweep import Sweep

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

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


def tracks_of(model: Model, sweep: Sweep) -> tuple[Track, ...]:
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
    return tuple(_told_apart(tracks))


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


def _told_apart(tracks: list[Track]) -> list[Track]:
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
