"""Periodic orbits that are not isolated: those around a centre, as of a model without losses.

A limit cycle is an isolated periodic orbit. Where orbits of one command fill a continuum instead,
each of another size, a step from one to the next is no deviation that grows or decays: besides the
multiplier along the orbit a second one is 1 (Kuznetsov 2004, ch. 1.5: an orbit without other
multipliers on the circle is isolated). Such orbits neither attract nor repel, and no command has
to be found for them: the start decides which one is gone round.

The pair of multipliers at 1 is a double root: an error δ of the monodromy matrix splits it by √δ,
while the pair's mean is off by δ only. One orbit with such a pair may lie on a fold of limit
cycles; a continuum shows several, clearly of different size.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trms_cli.stability.cycles.shooting import Orbit, Shooting

#: How far the pair may be split, and its mean be off 1.
_SPLIT, _MEAN = 0.03, 1e-3
#: By which two orbits of a continuum differ in size, relative.
_DIFFERENT = 0.05
#: An orbit that is back this near, as part of its swing, repeats itself.
_REPEATED = 0.01


def continuum(orbits: Sequence[Orbit]) -> list[Orbit]:
    """Those of the orbits of one command that are part of a continuum; empty without one."""
    neutral = [orbit for orbit in orbits if _second_at_one(orbit)]
    sizes = [float(orbit.swing.max()) for orbit in neutral]
    if len(sizes) < 2 or max(sizes) < (1.0 + _DIFFERENT) * min(sizes):
        return []
    return neutral


def gone_round_once(shooting: Shooting, orbit: Orbit) -> Orbit:
    """The orbit of the smallest period, if an orbit goes two to four times round it."""
    last, near = len(orbit.path) - 1, _REPEATED * float(orbit.swing.max())
    for turns in (4, 3, 2):
        if float(np.abs(orbit.path[round(last / turns)] - orbit.path[0]).max()) < near:
            picked = np.linspace(0, last / turns, shooting.pieces + 1)[:-1].round().astype(int)
            once = shooting.closed(orbit.path[picked], orbit.period / turns, orbit.u)
            return orbit if once is None else once
    return orbit


def _second_at_one(orbit: Orbit) -> bool:
    others = orbit.multipliers[1:]
    if not others.size:
        return False
    pair = np.array([orbit.multipliers[0], others[int(np.argmin(np.abs(others - 1.0)))]])
    return bool(np.abs(pair - 1.0).max() < _SPLIT and abs(pair.mean() - 1.0) < _MEAN)
