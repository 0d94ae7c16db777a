"""Trajectories of a portrait, and what of them is drawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.stability.portraits.section import Section

FloatArray = npt.NDArray[np.float64]

#: Points while a mode lasts that is over within a step, and between them in its time constants.
_FINE_STEPS, _FINE = 40, 0.2
#: Starts of motions that are integrated at once.
_MOST_AT_ONCE = 64


@dataclass(frozen=True)
class Journey:
    """A trajectory."""

    time: FloatArray  #: (n,) array; s
    x: FloatArray  #: (n, n_x) array
    c: FloatArray  #: (n, n_c) array; coordinates
    #: (n,) bool array; whether a command is at its bound; False throughout for the model alone
    saturated: npt.NDArray[np.bool_]


def journeys(
    section: Section,
    starts: FloatArray,
    duration: float,
    step: float,
) -> tuple[Journey, ...]:
    """Motions of the whole model from starts (m, n_x) with the section's command held.

    Where a mode is over within a step (an armature's current: 0.1 ms), finer points come first: a
    line from the start to the end of the first step would show the fall along it aslant.
    """
    coordinates, u = section.coordinates, section.point.u
    fine = _fine_step(section, step)
    time: FloatArray = np.arange(max(1, round(duration / step)) + 1, dtype=np.float64) * step
    if fine:
        early = np.arange(_FINE_STEPS + 1) * fine
        time = np.concatenate([early, early[-1] + time[1:]])
    found: list[Journey] = []
    for first in range(0, len(starts), _MOST_AT_ONCE):
        part = starts[first : first + _MOST_AT_ONCE]
        if fine:
            begun = coordinates.field.motions(part, u, _FINE_STEPS * fine, fine)
            rest = coordinates.field.motions(begun[-1], u, duration, step)
            x = np.concatenate([begun, rest[1:]])
        else:
            x = coordinates.field.motions(part, u, duration, step)
        never = np.zeros(len(time), dtype=bool)
        for i in range(len(part)):
            c = coordinates.values(x[:, i], u)
            found.append(Journey(time, x[:, i], c, never))
    return tuple(found)


def _fine_step(section: Section, step: float) -> float:
    """s between points while the fastest mode lasts; 0 where a step shows it."""
    slopes, _ = section.coordinates.field.linearised(section.point.x, section.point.u)
    fastest = float(np.abs(np.linalg.eigvals(slopes).real).max())
    return _FINE / fastest if fastest * step > 1.0 else 0.0


def spaced(
    journey: Journey, window: FloatArray, apart: float, longest: float = np.inf
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """A trajectory for drawing: points some distance apart, up to a length, within the window.

    Parameters
    ----------
    apart, longest : float
        In shares of the window's width.

    Returns
    -------
    (n, n_c) array, (n,) bool array
        NaN where it is outside; whether a command is at its bound.
    """
    c = journey.c
    steps = np.linalg.norm(np.diff(c, axis=0) / np.ptp(window, axis=1), axis=1)
    length = np.concatenate([[0.0], np.cumsum(np.nan_to_num(steps, nan=np.inf))])
    finite = np.isfinite(length)
    end = min(float(length[finite][-1]), longest)
    kept = np.unique(np.searchsorted(length[finite], np.arange(0.0, end + apart / 2, apart)))
    kept = kept[kept < finite.sum()]
    points = c[kept].copy()
    inside = np.all((points >= window[:, 0]) & (points <= window[:, 1]), axis=1)
    # One point beyond each way out, so that lines reach the edge.
    near = inside.copy()
    near[1:] |= inside[:-1]
    near[:-1] |= inside[1:]
    points[~near] = np.nan
    return points, journey.saturated[kept]
