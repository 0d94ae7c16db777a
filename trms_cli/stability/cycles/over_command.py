"""Equilibria, Hopf points and branches of cycles over one command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.cycles.branch import Branch, born_at, followed
from trms_cli.stability.cycles.hopf import Curve, Hopf, equilibria_over, hopf_points
from trms_cli.stability.cycles.shooting import Orbit, Shooting

FloatArray = npt.NDArray[np.float64]

#: Part of the period and of the swings by which an orbit may be off between its neighbours.
_NEAR = 0.02


@dataclass(frozen=True)
class OverCommand:
    """What there is over a command."""

    curve: Curve  #: Equilibria, as far as the stops
    hopfs: Sequence[Hopf]  #: Within the stops
    #: One for each Hopf point, then those of orbits that are on none of these
    branches: Sequence[Branch]

    def born(self, i: int) -> Branch:
        """The branch of a Hopf point."""
        return self.branches[i]


def followed_over(
    model: Model,
    point: OperatingPoint,
    channel: int,
    orbits: Sequence[Orbit],
    shooting: Shooting | None,
    limit: int,
) -> OverCommand:
    """Equilibria over a command, the Hopf points on them, and all branches of cycles.

    Parameters
    ----------
    orbits : sequence of Orbit
        Found otherwise, at the point's command.
    shooting : Shooting or None
        None: no cycle can be.
    limit : int
        Most orbits of a branch.
    """
    curve = _within_stops(model, equilibria_over(model, point.x, point.u, channel), point)
    hopfs = hopf_points(model, curve, point.u, channel)
    found: list[Branch] = []
    if shooting is not None:
        found = [born_at(shooting, hopf, channel, limit) for hopf in hopfs]
        for orbit in orbits:
            if not any(_on(branch, orbit, channel) for branch in found):
                one, other = (
                    followed(shooting, orbit, channel, limit, towards=sign) for sign in (-1.0, 1.0)
                )
                found.append(
                    Branch(
                        [*reversed(one.orbits), *other.orbits[1:]], f"{one.ended}; {other.ended}"
                    )
                )
    return OverCommand(curve, hopfs, found)


def at_the_point(
    shooting: Shooting, branches: Sequence[Branch], channel: int, u: FloatArray
) -> list[Orbit]:
    """The orbits of branches at one command, closed between their neighbours."""
    found = []
    for branch in branches:
        for one, other in zip(branch.orbits[:-1], branch.orbits[1:], strict=True):
            before, after = float(one.u[channel] - u[channel]), float(other.u[channel] - u[channel])
            if before * after > 0.0 or before == after:
                continue
            share = before / (before - after)
            orbit = shooting.closed(
                one.nodes + share * (other.nodes - one.nodes),
                one.period + share * (other.period - one.period),
                u,
            )
            if orbit is not None:
                found.append(orbit)
    return found


def _within_stops(model: Model, curve: Curve, point: OperatingPoint) -> Curve:
    kept = np.ones(len(curve.commands), dtype=bool)
    for name, stop in model.stops.items():
        if name in model.state_names:
            kept &= np.abs(curve.x[:, model.state_index(name)]) <= stop
    if not kept.any():
        return curve
    return Curve(curve.commands[kept], curve.x[kept], curve.growth[kept])


def _on(branch: Branch, orbit: Orbit, channel: int) -> bool:
    """Whether an orbit is one of a branch: between two neighbours in command, period and swing."""
    for one, other in zip(branch.orbits[:-1], branch.orbits[1:], strict=True):
        low, high = sorted((one.u[channel], other.u[channel]))
        if not low - 1e-9 <= orbit.u[channel] <= high + 1e-9:
            continue
        share = (orbit.u[channel] - one.u[channel]) / max(high - low, 1e-12)
        share = abs(float(share))
        period = one.period + share * (other.period - one.period)
        swing = one.swing + share * (other.swing - one.swing)
        if abs(period - orbit.period) < _NEAR * orbit.period and np.allclose(
            swing, orbit.swing, rtol=_NEAR, atol=0.02 * float(orbit.swing.max())
        ):
            return True
    return False
