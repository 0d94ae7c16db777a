"""The models that an answer leaves beside its document, as a diagnosis does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from experiments.gap.blind.fresh import CORRECTED, REFIT
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import extended
from trms_cli.gap.diagnosis import NO_EFFECT, Diagnosis
from trms_cli.gap.problem import GapProblem
from trms_cli.identification.model_writer import ModelOrigin, model_document, write_model
from trms_cli.identification.problem import free_parameters
from trms_cli.models.model import Model


def write_models(answer: Diagnosis, problem: GapProblem, folder: Path) -> None:
    """Write the nominal model refitted, and with the first cause's effects.

    An answer whose correction is no effect of the library (a regressed force) leaves none: its
    shrink is what it tells itself.
    """
    first = answer.causes[0] if answer.causes else None
    effects: tuple[str, ...] = ()
    if first is not None and not set(first.effects) & set(NO_EFFECT):
        effects = first.effects if first.parameters else ()
        if answer.verdict == "effect" and not effects:
            return
    elif answer.verdict == "none_of_these" and answer.where:
        return
    refitted = dict(answer.refit)
    _write(answer, problem, (), refitted, folder / REFIT)
    values = {name: p.fitted for name, p in answer.parameters.items()} or refitted
    if first is not None:
        values |= {name: size.value for name, size in first.parameters.items()}
    _write(answer, problem, effects, values, folder / CORRECTED)


def _write(
    answer: Diagnosis,
    problem: GapProblem,
    effects: tuple[str, ...],
    values: dict[str, float],
    path: Path,
) -> None:
    chosen = {name: problem.candidates[name] for name in effects}
    nominal = [name for name in values if name in problem.model.parameters]
    model: Model = extended(problem.model, chosen)
    document = model_document(
        problem.datasets[0].name,
        model,
        ModelOrigin(
            option=problem.model_name,
            effects={name: _arguments(effect) for name, effect in chosen.items()},
        ),
        values=values,
        deviations={name: p.sd for name, p in answer.parameters.items() if p.sd == p.sd},
        free=free_parameters(problem.model.parameters, nominal) if nominal else (),
        source="fitted by a baseline on " + ", ".join(d.name for d in problem.datasets),
    )
    write_model(document, path)


def _arguments(effect: Effect) -> dict[str, Any]:
    """What an effect is made with besides its sizes."""
    sizes = {p.name for p in effect.parameters()}
    own: list[str] = list(getattr(effect, "__dataclass_fields__", ()))
    return {name: getattr(effect, name) for name in own if name not in sizes}
