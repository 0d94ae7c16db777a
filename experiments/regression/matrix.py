"""The matrix of runs: read from YAML, crossed into cases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from itertools import product
from pathlib import Path
from typing import Any

import msgspec
import yaml

from trms_cli.core.errors import ConfigurationError
from trms_cli.scoring.figures import FIGURES, FigureTolerance

HERE = Path(__file__).parent
MATRIX = HERE / "matrix.yaml"


@dataclass(frozen=True)
class Case:
    """One run of the matrix."""

    name: str  #: ``controller/reference/rig``
    overrides: tuple[str, ...]  #: What follows ``trms run``
    #: Of the figures that decide, by name (``rmse``) or by key (``estimate.rmse.alpha_v``)
    tolerances: Mapping[str, FigureTolerance]


class _Rig(msgspec.Struct, forbid_unknown_fields=True):
    overrides: list[str]
    tolerances: dict[str, float | dict[str, float]]


class _Matrix(msgspec.Struct, forbid_unknown_fields=True):
    every: list[str]
    controllers: dict[str, list[str]]
    references: dict[str, list[str]]
    rigs: dict[str, _Rig]


def read_matrix(path: Path = MATRIX, pattern: str = "*", extra: Sequence[str] = ()) -> list[Case]:
    """Every case of a matrix whose name matches a pattern.

    Parameters
    ----------
    pattern : str
        As a shell matches file names: ``newton_mpc/*``, ``*/disturbed``.
    extra : sequence of str
        Overrides that every case gets after its own.

    Raises
    ------
    ConfigurationError
        If the file is not a matrix, or nothing matches.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        matrix = msgspec.convert(content, _Matrix)
        tolerances = {name: _tolerances(rig.tolerances) for name, rig in matrix.rigs.items()}
    except (OSError, yaml.YAMLError, msgspec.ValidationError, TypeError) as error:
        raise ConfigurationError(
            f"this is no matrix of runs: {str(error).splitlines()[0]}",
            where=str(path),
            remedy="it has every, controllers, references and rigs; see experiments/regression",
        ) from error
    cases = [
        Case(
            f"{controller}/{reference}/{rig}",
            (
                *matrix.rigs[rig].overrides,
                *matrix.controllers[controller],
                *matrix.references[reference],
                *matrix.every,
                *extra,
            ),
            tolerances[rig],
        )
        for controller, reference, rig in product(
            matrix.controllers, matrix.references, matrix.rigs
        )
    ]
    matches = [case for case in cases if fnmatch(case.name, pattern)]
    if not matches:
        raise ConfigurationError(
            f"no run matches {pattern!r}",
            where="--only",
            remedy="there are: " + ", ".join(case.name for case in cases),
        )
    return matches


def _tolerances(entries: Mapping[str, Any]) -> dict[str, FigureTolerance]:
    figure_names = {figure.key for figure in FIGURES if figure.tolerance is not None}
    groups = tuple({"states": "estimate"}.get(f.group, f.group) for f in FIGURES if f.tolerance)
    for name in entries:
        if name not in figure_names and not name.startswith(groups):
            raise TypeError(f"{name!r} is no figure of a score; there are {sorted(figure_names)}")
    return {
        name: FigureTolerance(**value)
        if isinstance(value, dict)
        else FigureTolerance(absolute=value)
        for name, value in entries.items()
    }
