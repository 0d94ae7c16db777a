"""Sorts runs into a table: who ran (entrants) in what (conditions)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError
from trms_cli.scoring.comparison.compared_run import ComparedRun, State
from trms_cli.scoring.comparison.coordinates import differing

#: Coordinates of who ran; the others are of what was run in.
OF_ENTRANTS = ("controller", "observer", "model", "supervisor", "qp_solver")
#: The coordinate that is no rig's.
REFERENCE = "ref"


@dataclass(frozen=True, kw_only=True)
class ComparisonGroup:
    """Entrants × conditions."""

    by: tuple[str, ...]  #: Coordinates that name an entrant
    given_by: tuple[str, ...]  #: Coordinates that name a condition, of those in which runs differ
    entrants: tuple[str, ...]  #: Names
    outside: tuple[str, ...]  #: Per entrant, why it is not ranked; "" if it is
    conditions: tuple[Mapping[str, str], ...]  #: Coordinates of each condition
    #: The runs of an entrant in a condition: one, or repetitions of one another
    cells: Mapping[tuple[int, int], tuple[ComparedRun, ...]]

    def run(self, entrant: int, condition: int) -> ComparedRun:
        """One run of a cell: a failed one if there is one."""
        runs = self.cells[entrant, condition]
        return next((run for run in runs if run.state is State.FAILED), runs[0])

    def errors(self, metric: str) -> npt.NDArray[np.float64]:
        """Tracking errors (entrants, conditions): NaN where nobody ran, inf for a failed run."""
        table = np.full((len(self.entrants), len(self.conditions)), np.nan)
        for place, runs in self.cells.items():
            values = [_error(run, metric) for run in runs]
            table[place] = float(np.mean(values))
        return table

    def condition_name(self, condition: int) -> str:
        """In what it differs from the others."""
        told = self.conditions[condition]
        parts = []
        for key in self.given_by:
            if told[key] not in ("", "–", "none"):
                name = key.rpartition(".")[2]
                parts.append(f"{name} {told[key]}" if "." in key or name == "seed" else told[key])
        return ", ".join(parts) or "the same for all"

    def clusters(self) -> npt.NDArray[np.int64]:
        """Which rig each condition is of: all but the reference."""
        rigs: dict[tuple[tuple[str, str], ...], int] = {}
        found = []
        for told in self.conditions:
            key = tuple((name, told[name]) for name in self.given_by if not _of_reference(name))
            found.append(rigs.setdefault(key, len(rigs)))
        return np.array(found, dtype=np.int64)


def group(runs: Sequence[ComparedRun], by: Sequence[str] = ()) -> ComparisonGroup:
    """Sort runs that count into a contest.

    Parameters
    ----------
    runs : sequence of ComparedRun
        Incomplete ones are passed over.
    by : sequence of str
        Coordinates that name an entrant; by default those of controller, observer and model in
        which the runs differ, and where they do not, all in which they do.

    Raises
    ------
    ConfigurationError
        If `by` names a coordinate that there is not.
    """
    counted = [run for run in runs if run.state.ranked]
    differ = differing(counted)
    known = list(dict.fromkeys(key for run in counted for key in run.coordinates))
    for key in by:
        if key not in known:
            raise ConfigurationError(
                f"the runs have no {key!r}", where="--by", remedy=f"there are: {', '.join(known)}"
            )
    chosen = tuple(by) or tuple(key for key in usual_entrants(differ) if key in known)
    given = tuple(key for key in differ if key not in chosen)
    entrants: dict[str, int] = {}
    outside: list[str] = []
    conditions: dict[tuple[str, ...], int] = {}
    cells: dict[tuple[int, int], list[ComparedRun]] = {}
    for run in counted:
        name = controller_name(run, chosen, given)
        if name not in entrants:
            entrants[name] = len(entrants)
            outside.append(run.outside)
        told = tuple(run.coordinates.get(key, "") for key in given)
        place = entrants[name], conditions.setdefault(told, len(conditions))
        cells.setdefault(place, []).append(run)
    return ComparisonGroup(
        by=chosen,
        given_by=given,
        entrants=tuple(entrants),
        outside=tuple(outside),
        conditions=tuple(dict(zip(given, told, strict=True)) for told in conditions),
        cells={place: tuple(members) for place, members in cells.items()},
    )


def usual_entrants(differ: Sequence[str]) -> tuple[str, ...]:
    """Coordinates that name who ran, of those in which runs differ."""
    own = [key for key in differ if _stem(key) in OF_ENTRANTS]
    # a setting is named with the option that has it
    return tuple(dict.fromkeys(part for key in own for part in (_stem(key), key))) or tuple(differ)


def controller_name(run: ComparedRun, by: Sequence[str], given: Sequence[str] = ()) -> str:
    """``newton_mpc + ukf``, and the settings in which it differs: ``max_iterations=1``."""
    parts = []
    for key in by:
        value = run.coordinates.get(key, "")
        if "." not in key:
            parts.append(value if key in OF_ENTRANTS or not given else f"{key} {value}")
        elif value not in ("", "–"):
            parts.append(f"{key.partition('.')[2]}={value}")
    return " + ".join(parts) or "all runs"


def matching(runs: Sequence[ComparedRun], where: Mapping[str, Sequence[str]]) -> list[ComparedRun]:
    """The runs whose coordinates match patterns, as a shell matches file names.

    Raises ConfigurationError if a coordinate is unknown, or nothing is left.
    """
    left = list(runs)
    for key, patterns in where.items():
        values = dict.fromkeys(run.coordinates.get(key, "") for run in left)
        if not any(key in run.coordinates for run in left):
            known = dict.fromkeys(key for run in left for key in run.coordinates)
            raise ConfigurationError(
                f"the runs have no {key!r}",
                where="--where",
                remedy=f"there are: {', '.join(known)}",
            )
        left = [
            run
            for run in left
            if any(fnmatchcase(run.coordinates.get(key, ""), pattern) for pattern in patterns)
        ]
        if not left:
            raise ConfigurationError(
                f"no run has {key} {', '.join(patterns)}",
                where="--where",
                remedy=f"there are: {', '.join(values)}",
            )
    return left


def _error(run: ComparedRun, metric: str) -> float:
    if run.state is State.FAILED:
        return math.inf
    return run.error(metric)


def _stem(key: str) -> str:
    return key.partition(".")[0].partition("@")[0]


def _of_reference(key: str) -> bool:
    return _stem(key) == REFERENCE or key.partition("@")[2].partition(".")[0] == REFERENCE
