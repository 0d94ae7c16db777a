"""All equilibria of a model as a result, and that result as data."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.models.model import Model, Signal, by_name, names
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.equilibria.proof import RangePiece
from trms_cli.stability.equilibria.survey import NamedPoint, Survey


@dataclass(frozen=True)
class EquilibriaResult:
    """All equilibria of a model."""

    model: Model
    surveys: Sequence[Survey]
    named_points: Sequence[NamedPoint]


def survey_data(survey: Survey) -> dict[str, Any]:
    """Curves over one input, their landmarks, and what is proved of them."""
    model = survey.model
    return {
        "over": survey.setting.over,
        "range": survey.setting.bounds,
        "inputs": survey.setting.inputs,
        "held": survey.setting.held_angles,
        "released": survey.system.released,
        "free": survey.system.free,
        "box": _columns(survey.system.unknowns, survey.box.lower, survey.box.upper),
        "curves": [
            {
                "states": _columns(model.states, *(p.x for p in one.points)),
                "inputs": _columns(model.inputs, *(p.u for p in one.points)),
                "growing": [p.unstable for p in one.points],
                "verdict": [p.verdict for p in one.points],
                "rightmost": [float(p.eigenvalues[0].real) for p in one.points],
                "ends": one.curve.ends,
            }
            for one in survey.curves
        ],
        "landmarks": [
            {
                "kind": one.kind,
                "angle": one.name or None,
                "input": float(one.y[-1]),
                "frequency": one.frequency,
                "growing": one.at.unstable,
                **_states(model, one.at),
            }
            for one in survey.landmarks
        ],
        "proofs": [
            {
                "input": check.input,
                "complete": check.proof.complete,
                "count": check.proof.count,
                "agrees_with_curves": check.agree,
                "equilibria": [
                    {
                        "unique": one.unique,
                        "exists": one.exists,
                        "states": _columns(model.states, one.x.lower, one.x.upper),
                        "inputs": _columns(model.inputs, one.u.lower, one.u.upper),
                    }
                    for one in check.proof.enclosed
                ],
            }
            for check in survey.checks
        ],
        "range_proof": survey.pieces,
        "range_proved": proved_share(survey.pieces),
    }


def named_data(model: Model, point: NamedPoint) -> dict[str, Any]:
    """A named equilibrium, and what dry friction holds there."""
    return {
        "name": point.name,
        **_states(model, point),
        "eigenvalues": point.eigenvalues,
        "growing": point.unstable,
        "verdict": point.verdict,
        "quantities": point.quantities,
        "friction": [
            {name: value for name, value in vars(band).items() if name != "angle"}
            for band in point.bands
        ],
    }


def proved_share(pieces: Sequence[RangePiece]) -> float | None:
    """Share of a range in which the number is proved."""
    if not pieces:
        return None
    whole = pieces[-1].upper - pieces[0].lower
    return sum(piece.upper - piece.lower for piece in pieces if piece.count is not None) / whole


def _states(model: Model, at: OperatingPoint) -> dict[str, Any]:
    return {"states": by_name(model.states, at.x), "inputs": by_name(model.inputs, at.u)}


def _columns(signals: Sequence[Signal], *rows: FloatArray) -> dict[str, Any]:
    """The numbers of each signal, by its name."""
    return dict(zip(names(signals), np.array(rows).reshape(-1, len(signals)).T, strict=True))
