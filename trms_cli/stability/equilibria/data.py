"""The study of equilibria as JSON data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from trms_cli.models.model import Model, names
from trms_cli.stability.equilibria.curves import EquilibriumPoint
from trms_cli.stability.equilibria.named_points import NamedPoint
from trms_cli.stability.equilibria.proof import Enclosed, Piece
from trms_cli.stability.equilibria.survey import Survey


def survey_data(model: Model, survey: Survey) -> dict[str, Any]:
    """Curves, special points, proofs."""
    unknowns = names(survey.system.unknowns)
    return {
        "over": survey.setting.over,
        "range": list(survey.setting.bounds),
        "inputs": dict(survey.setting.inputs),
        "held": dict(survey.setting.held),
        "released": list(survey.system.released),
        "free": list(survey.system.free),
        "box": {
            name: [finite(low), finite(high)]
            for name, low, high in zip(
                unknowns, survey.box.lower.tolist(), survey.box.upper.tolist(), strict=True
            )
        },
        "curves": [
            {
                "states": _columns(model.state_names, [p.x for p in one.points]),
                "inputs": _columns(names(model.inputs), [p.u for p in one.points]),
                "growing": [p.unstable for p in one.points],
                "verdict": [p.verdict for p in one.points],
                "rightmost": [finite(p.eigenvalues[0].real) for p in one.points],
                "ends": list(one.curve.ends),
            }
            for one in survey.curves
        ],
        "landmarks": [
            {
                "kind": one.kind,
                "angle": one.name or None,
                "input": float(one.y[-1]),
                "frequency": one.frequency,
                **_point(model, one.at),
            }
            for one in survey.landmarks
        ],
        "proofs": [
            {
                "input": check.input,
                "complete": check.proof.complete,
                "count": check.proof.count,
                "agrees_with_curves": check.agree,
                "equilibria": [_enclosed(model, one) for one in check.proof.found],
            }
            for check in survey.checks
        ],
        "range_proof": [
            {"lower": piece.lower, "upper": piece.upper, "count": piece.count}
            for piece in survey.pieces
        ],
        "range_proved": proved_share(survey.pieces),
    }


def proved_share(pieces: Sequence[Piece]) -> float | None:
    """Share of a range in which the number is proved."""
    if not pieces:
        return None
    whole = pieces[-1].upper - pieces[0].lower
    known = sum(piece.upper - piece.lower for piece in pieces if piece.count is not None)
    return known / whole


def named_data(model: Model, point: NamedPoint) -> dict[str, Any]:
    """A named point."""
    return {
        "name": point.name,
        "states": dict(zip(model.state_names, point.x.tolist(), strict=True)),
        "inputs": dict(zip(names(model.inputs), point.u.tolist(), strict=True)),
        "eigenvalues": [[finite(v.real), finite(v.imag)] for v in point.eigenvalues],
        "growing": point.unstable,
        "verdict": point.verdict,
        "quantities": {name: finite(value) for name, value in point.quantities.items()},
        "friction": [
            {
                "axis": band.axis,
                "torque": band.torque,
                "lower": band.lower,
                "upper": band.upper,
                "command": list(band.command) if band.command else None,
            }
            for band in point.bands
        ],
    }


def finite(value: float) -> float | None:
    """A number for JSON."""
    return float(value) if math.isfinite(value) else None


def _columns(heads: Sequence[str], rows: Sequence[np.ndarray]) -> dict[str, list[float]]:
    table = np.array(rows).reshape(-1, len(heads))
    return {name: table[:, k].tolist() for k, name in enumerate(heads)}


def _point(model: Model, at: EquilibriumPoint) -> dict[str, Any]:
    return {
        "states": dict(zip(model.state_names, at.x.tolist(), strict=True)),
        "inputs": dict(zip(names(model.inputs), at.u.tolist(), strict=True)),
        "growing": at.unstable,
    }


def _enclosed(model: Model, one: Enclosed) -> dict[str, Any]:
    return {
        "unique": one.unique,
        "exists": one.exists,
        "states": {
            name: [finite(low), finite(high)]
            for name, low, high in zip(
                model.state_names, one.x.lower.tolist(), one.x.upper.tolist(), strict=True
            )
        },
        "inputs": {
            name: [finite(low), finite(high)]
            for name, low, high in zip(
                names(model.inputs), one.u.lower.tolist(), one.u.upper.tolist(), strict=True
            )
        },
    }
