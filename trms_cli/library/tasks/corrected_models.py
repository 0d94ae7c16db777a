"""The models that a diagnosis leaves: refitted, and corrected by the cause that was found."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trms_cli.composition.catalogue import config_folder
from trms_cli.composition.composer import Composition
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.invocation import command_line
from trms_cli.effects.extended_model import extended
from trms_cli.gap.diagnosis import NO_EFFECT, Cause, DiagnosisResult
from trms_cli.gap.findings import likeliest
from trms_cli.identification.model_writer import ModelOrigin, model_document, write_model
from trms_cli.identification.problem import FreeParameter, free_parameters
from trms_cli.library.tasks.diagnosis_request import DiagnosisRequest
from trms_cli.library.tasks.files import effect_arguments, origin_of
from trms_cli.models.model import Model

CORRECTED_NAME, REFIT_NAME = "corrected_model.yaml", "refit_model.yaml"


def write_models(
    request: DiagnosisRequest, origin: ModelOrigin, diagnosis: DiagnosisResult, folder: Path
) -> tuple[Path, Path]:
    """Write the corrected model, and the nominal one refitted without a cause; their files."""
    cause = applied_cause(diagnosis)
    refit = {} if diagnosis.verdict == "no_gap" else dict(diagnosis.refit)
    deviations: dict[str, float | None] = {n: p.sd for n, p in diagnosis.parameters.items()}
    if cause is None and not refit and diagnosis.verdict != "no_gap":
        refit = {name: p.fitted for name, p in diagnosis.parameters.items()}
    values = refit if cause is None else {n: p.fitted for n, p in diagnosis.parameters.items()}
    corrected_path, refit_path = folder / CORRECTED_NAME, folder / REFIT_NAME
    _write(request, origin, cause, values, deviations, corrected_path, corrected_words(diagnosis))
    words = "the nominal model with its parameters refitted, and nothing added"
    if diagnosis.verdict == "no_gap":
        words = "the nominal model: there is no gap, so nothing was refitted"
    spread = deviations if cause is None else {}
    _write(request, origin, None, refit, spread, refit_path, words)
    return corrected_path, refit_path


def applied_cause(diagnosis: DiagnosisResult) -> Cause | None:
    """The cause that the corrected model has, and that the figures of the sealed part are of.

    The likeliest, where it is an effect that was fitted: a torque from outside is estimated, not
    simulated, and has no sizes.
    """
    first = likeliest(diagnosis)
    if first is None or not first.parameters or set(first.effects) & set(NO_EFFECT):
        return None
    return first if diagnosis.verdict in ("effect", "undecided") else None


def corrected_words(diagnosis: DiagnosisResult) -> str:
    """What the corrected model is, for the comment in its file."""
    applied, first = applied_cause(diagnosis), likeliest(diagnosis)
    refit = "the nominal model with its parameters refitted"
    if applied is not None:
        named = f"{' with '.join(applied.effects)} (p = {applied.probability:.2f})"
        open_ = "; undecided: this is the likeliest cause" if diagnosis.verdict != "effect" else ""
        return f"the nominal model refitted together with {named}{open_}"
    if diagnosis.verdict == "effect" and first is not None:
        return f"{refit}: {' with '.join(first.effects)} was not fitted, so it is not added"
    return {
        "no_gap": "the nominal model as it was: no gap was found",
        "parameters_only": f"{refit}: other parameters explain the gap, and no effect is needed",
        "none_of_these": f"{refit}: no effect of the library explains what is left of the gap",
    }.get(diagnosis.verdict, f"{refit}; undecided, so no effect was added")


def model_origin(composition: Composition, request: DiagnosisRequest) -> ModelOrigin:
    """What the models' files say besides values; a model of one's own goes in as a plugin."""
    try:
        return origin_of(composition) or ModelOrigin(option="")
    except ConfigurationError:
        effects = composition.config.get("effect") or {}
        node = {key: _plain(value) for key, value in composition.config["model"].items()}
        if (config_folder() / "model" / f"{composition.choices['model']}.yaml").is_file():
            node.pop("parameters", None)  # they stand in the file
        return ModelOrigin(
            option=node, effects={name: effect_arguments(name, n) for name, n in effects.items()}
        )


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    return list(map(_plain, value)) if isinstance(value, (list, tuple)) else value


def _write(
    request: DiagnosisRequest,
    origin: ModelOrigin,
    cause: Cause | None,
    values: Mapping[str, float],
    deviations: Mapping[str, float | None],
    path: Path,
    words: str,
) -> None:
    model, effects = request.problem.model, dict(origin.effects)
    free = _known(model, values)
    if cause is not None:
        candidates = request.candidates
        model = extended(model, {name: candidates.effects[name] for name in cause.effects})
        for name in cause.effects:
            effects[name] = effect_arguments(name, candidates.nodes[name])
        values = dict(values) | {name: size.value for name, size in cause.parameters.items()}
    files = {d.source: d.sha256 for d in request.problem.datasets}
    document = model_document(
        request.problem.datasets[0].name,
        model,
        ModelOrigin(option=origin.option, limits=origin.limits, effects=effects),
        values=values,
        deviations=deviations,
        free=free,
        source="diagnosed on "
        + ", ".join(f"{Path(f).name} (sha256 {digest[:16]})" for f, digest in files.items()),
    )
    write_model(document, path, f"{command_line()}\n{words}")


def _known(model: Model, values: Mapping[str, float]) -> tuple[FreeParameter, ...]:
    """What was known of the fitted parameters before."""
    fitted = [name for name in values if name in model.parameters]
    return free_parameters(model.parameters, fitted) if fitted else ()
