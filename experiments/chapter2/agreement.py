"""Where the two models must agree, and which term makes them differ elsewhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.chapter2.axes import ANGLES, pair_of_commands, rest_of
from experiments.chapter2.bridge import TERMS, Bridge
from experiments.chapter2.simulation import FloatArray, OpenLoop, Response
from experiments.chapter2.study import Study
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.newtonian import Newtonian


@dataclass(frozen=True)
class Agreement:
    """Two models that are the same where they are compared."""

    what: str
    largest: float  #: Difference of an angle over all cases, rad
    travel: float  #: By how much that angle moved, rad


@dataclass(frozen=True)
class TermStudy:
    """How much each term matters in one case; RMS differences of the angles, rad."""

    name: str
    newtonian: dict[str, float]  #: All terms as in the Newtonian model, the beam on the axis
    #: One term as in the Newtonian model, by term and angle
    left_wrong: dict[str, dict[str, float]]
    arm: dict[str, float]  #: The beam on the axis instead of h beside it


def study_agreement(study: Study) -> tuple[list[Agreement], list[TermStudy]]:
    """Simulate the nine cases with every intermediate model."""
    T, n = study.sample_time, study.substeps
    whole = OpenLoop(Lagrangian(), T, n, stops=False)
    start = rest_of(whole)
    on_axis = whole.model.parameters.replaced({"h": 0.0}).values
    right = OpenLoop(Bridge(TERMS), T, n, stops=False)
    wrong = {
        term: OpenLoop(Bridge(tuple(t for t in TERMS if t != term)), T, n, stops=False)
        for term in TERMS
    }
    newtonian = OpenLoop(Newtonian(), T, n, stops=False)
    finer = OpenLoop(Lagrangian(), T, 2 * n, stops=False)

    terms, by_hand, by_step, travel = [], 0.0, 0.0, 0.0
    for name in study.two_axes:
        u = pair_of_commands(study, name)
        with_arm = whole.respond(u, start)
        measure = whole.respond(u, start, on_axis)
        by_hand = max(by_hand, _largest(right.respond(u, start), measure))
        by_step = max(by_step, _largest(finer.respond(u, start), with_arm))
        travel = max(travel, *(float(np.ptp(measure.outputs[angle])) for angle in ANGLES))
        terms.append(
            TermStudy(
                name,
                _rms(newtonian.respond(u, start), measure),
                {term: _rms(loop.respond(u, start), measure) for term, loop in wrong.items()},
                _rms(measure, with_arm),
            )
        )
    agreements = [
        _one_axis(study, "horizontal", {"h": 0.0}, "yaw alone, h = 0"),
        _one_axis(study, "vertical", {"r_ts": 0.0}, "pitch alone, r_ts = 0"),
        Agreement("nine cases, h = 0, the four terms put right by hand", by_hand, travel),
        Agreement(
            f"the same model with {T / n * 1e3:g} and {T / n * 5e2:g} ms steps", by_step, travel
        ),
    ]
    return agreements, terms


def _one_axis(study: Study, freedom: str, same: dict[str, float], what: str) -> Agreement:
    """Squares through several levels with one axis."""
    responses = []
    u = _staircase(study.sample_time)
    for kind in (Newtonian, Lagrangian):
        parameter_set = kind(freedom=freedom).parameters  # type: ignore[arg-type]
        values = {name: value for name, value in same.items() if name in parameter_set}
        model = kind(freedom=freedom, parameters=values)  # type: ignore[arg-type]
        loop = OpenLoop(model, study.sample_time, study.substeps, stops=False)
        start = {"alpha_v": -0.5} if freedom == "vertical" else {}
        responses.append(loop.respond(u, start))
    angle = "alpha_v" if freedom == "vertical" else "alpha_h"
    travel = float(np.ptp(responses[1].outputs[angle]))
    return Agreement(what, _largest(*responses), travel)


def _staircase(sample_time: float) -> FloatArray:
    levels = np.repeat([0.8, -0.4, 1.0, 0.2, -0.8, 0.6], round(8.0 / sample_time))
    return np.asarray(levels[:, None], dtype=np.float64)


def _largest(first: Response, second: Response) -> float:
    return max(
        float(np.abs(first.outputs[a] - second.outputs[a]).max())
        for a in ANGLES
        if a in first.outputs
    )


def _rms(first: Response, second: Response) -> dict[str, float]:
    return {a: float(np.sqrt(np.mean((first.outputs[a] - second.outputs[a]) ** 2))) for a in ANGLES}
