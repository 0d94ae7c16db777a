"""Everything that a search for periodic orbits gave, and its JSON data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.models.model import Model, names
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.cycles.absence import Absence
from trms_cli.stability.cycles.branch import OverCommand
from trms_cli.stability.cycles.search import FATES, Search
from trms_cli.stability.cycles.shooting import Orbit

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Found:
    """Everything that a search gave."""

    model: Model
    point: OperatingPoint
    widths: FloatArray  #: (n_x,) array; half-widths of the box of starts
    duration: float  #: s, of each motion
    smooth: bool  #: Whether there were slopes for Newton's method
    proof: Absence
    search: Search
    channel: int  #: Of the command that is varied
    over: OverCommand | None  #: None where there are no slopes

    @property
    def state(self) -> int:
        """The controlled state that moves most."""
        rows = [self.model.state_index(name) for name in self.model.controlled]
        orbits = [*self.search.orbits, *self.search.continuum] or [
            orbit
            for branch in (self.over.branches if self.over else ())
            for orbit in branch.orbits[-1:]
        ]
        if not orbits:
            return rows[0]
        return max(rows, key=lambda row: max(float(orbit.swing[row]) for orbit in orbits))

    @property
    def excluded(self) -> bool:
        """No cycle can be: proved for all states, and nothing acts that the proof leaves out."""
        return self.proof.proved and self.proof.everywhere and self.smooth


def results_of(found: Found) -> dict[str, Any]:
    """The findings as JSON data."""
    model = found.model
    results: dict[str, Any] = {
        "at": {
            "x": dict(zip(model.state_names, found.point.x.tolist(), strict=True)),
            "u": dict(zip(names(model.inputs), found.point.u.tolist(), strict=True)),
        },
        "box": dict(zip(model.state_names, found.widths.tolist(), strict=True)),
        "proof": {
            "no_cycle": found.proof.proved and found.smooth,
            "everywhere": found.proof.everywhere,
            "blocks": [
                {
                    "states": list(block.states),
                    "constant": block.constant,
                    "divergence": _finite(block.divergence),
                    "share": block.share,
                }
                for block in found.proof.blocks
            ],
        },
        "motions": {fate.replace(" ", "_"): found.search.count(fate) for fate in FATES},
        "cycles": [orbit_data(model, orbit) for orbit in found.search.orbits],
        "continuum": [orbit_data(model, orbit) for orbit in found.search.continuum],
    }
    if found.over is not None:
        results["over"] = {
            "command": model.inputs[found.channel].name,
            "hopf": [
                {
                    "u": float(hopf.u[found.channel]),
                    "x": hopf.x.tolist(),
                    "omega": hopf.omega,
                }
                for hopf in found.over.hopfs
            ],
            "branches": [
                {
                    "ended": branch.ended,
                    "u": branch.commands(found.channel).tolist(),
                    "period": [orbit.period for orbit in branch.orbits],
                    "swing": [float(orbit.swing[found.state]) for orbit in branch.orbits],
                    "stable": branch.stable().tolist(),
                    "changes": [
                        {"kind": c.kind, "u": c.command, "period": c.period, "swing": c.swing}
                        for c in branch.changes(found.channel, found.state)
                    ],
                }
                for branch in found.over.branches
            ],
            "swing_of": model.states[found.state].name,
        }
    return results


def _finite(bounds: tuple[float, float] | None) -> list[float | None] | None:
    if bounds is None:
        return None
    return [value if np.isfinite(value) else None for value in bounds]


def orbit_data(model: Model, orbit: Orbit) -> dict[str, Any]:
    """An orbit as JSON data."""
    return {
        "period": orbit.period,
        "stable": orbit.stable,
        "lowest": dict(zip(model.state_names, orbit.path.min(axis=0).tolist(), strict=True)),
        "highest": dict(zip(model.state_names, orbit.path.max(axis=0).tolist(), strict=True)),
        "multipliers": [[m.real, m.imag] for m in orbit.multipliers.tolist()],
        "trivial_error": orbit.trivial_error,
        "misfit": orbit.misfit,
    }
