"""A validation: models and recordings, result, findings, files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from trms_cli.composition.composer import Composition
from trms_cli.composition.plain_values import check_out, model_of_choice, truth
from trms_cli.core import wording
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build, construct
from trms_cli.core.versions import versions
from trms_cli.identification.admission.admit import admit
from trms_cli.identification.admission.issues import Admission, merge_admissions
from trms_cli.identification.data import DataOptions, load_datasets
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.validation.validate import ValidationOptions
from trms_cli.library.tasks.subject import driven_model, driven_recordings, model_of, several
from trms_cli.library.tasks.task import Done, Listener
from trms_cli.library.tasks.validated_models import shown_names
from trms_cli.models.model import Model

if TYPE_CHECKING:
    from trms_cli.identification.validation.validate import ModelValidation

#: What a channel without declared noise is given, so that filters stay invertible.
_NO_NOISE = 1e-6
#: Keys of the configuration that make up a :class:`ValidationOptions`.
_OPTION_KEYS = ("horizons", "windows", "predictor", "tests", "block", "seed")


@dataclass(frozen=True)
class ValidationRequest:
    """What is validated."""

    models: Mapping[str, Model]  #: By the name that is shown
    datasets: Mapping[str, Sequence[Dataset]]  #: The recordings as each model takes them
    options: ValidationOptions
    data: DataOptions
    driven: tuple[str, ...]
    effects: tuple[str, ...]
    page: bool
    admission: Admission  #: What was found in the recordings, by all models together


def validation_of(
    compositions: Sequence[Composition], model_names: Sequence[str]
) -> ValidationRequest:
    """Build everything that was asked for.

    Raises TrmsError for the first key or recording that is wrong.
    """
    config = compositions[0].config
    options = construct(ValidationOptions, {key: config[key] for key in _OPTION_KEYS})
    data = build(config["data"], "data")
    real = several(config["real"], "real")
    driven = several(config["driven"], "driven")
    truth(config["page"], "page")
    check_out(config["out"])
    models: dict[str, Model] = {}
    recordings: dict[str, Sequence[Dataset]] = {}
    admissions: dict[str, Admission] = {}
    names = shown_names(model_names or [model_of_choice(compositions[0])])
    for name, composition in zip(names, compositions, strict=True):
        model = model_of(composition.config)
        simulated = driven_model(model, driven)
        loaded = load_datasets(real, model, data)
        admissions[name] = admit(loaded, model, purpose="validation")
        models[name], recordings[name] = simulated, loaded
    admission = merge_admissions(admissions)
    admission.require()
    datasets = {name: driven_recordings(loaded, driven) for name, loaded in recordings.items()}
    for driven_ones in datasets.values():
        _check_noise(driven_ones)
    return ValidationRequest(
        models=models,
        datasets=datasets,
        options=options,
        data=data,
        driven=driven,
        effects=tuple(config["effect"] or ()),
        page=config["page"],
        admission=admission,
    )


def _check_noise(datasets: Sequence[Dataset]) -> None:
    """A channel without noise would weigh infinitely much, and no band would hold."""
    for dataset in datasets:
        for signal, sd in zip(dataset.outputs, dataset.noise_sd, strict=True):
            if sd == _NO_NOISE:
                raise ConfigurationError(
                    f"no noise of {signal.name} is declared",
                    where="data.noise_sd",
                    remedy=f"data.noise_sd.{signal.name}=… ({signal.unit}), or "
                    "data.noise_sd=estimate",
                )


def calibrate_validations(
    validations: Sequence[ModelValidation],
    request: ValidationRequest,
    progress: Callable[[str], None],
) -> tuple[list[ModelValidation], list[str]]:
    """p-values from simulation, where they are asked for; and what to say of it."""
    if request.options.tests.calibration != "simulated":
        return list(validations), []
    from trms_cli.identification.validation.validate import calibrate_tests as simulated_p_values

    results, notes = [], []
    total = request.options.tests.simulations
    for validation in validations:

        def tell(count: int, name: str = validation.name) -> None:
            progress(f"{name}: simulation {count} of {total}")

        tests = simulated_p_values(validation, request.data.quantum, tell)
        if tests is None:
            notes.append(
                f"{validation.name}: left alone over the recording it leaves the range of what was "
                "measured, so its p-values are not from simulations"
            )
        results.append(validation if tests is None else replace(validation, tests=tests))
    return results, notes


def notes_on(request: ValidationRequest) -> list[str]:
    """What a reader should know of how the figures came about."""
    return list(dict.fromkeys(_notes(request)))


def _notes(request: ValidationRequest) -> Iterator[str]:
    if request.driven:
        yield f"driven by the measured {', '.join(request.driven)}: its errors have no part here"
    if request.effects:
        yield f"with {', '.join(request.effects)} added to the model"
    if request.options.windows.start == "fitted":
        yield (
            "the starts of the windows were fitted to the windows themselves: the errors flatter, "
            "most over short horizons"
        )
    several = len(request.models) > 1
    for model, datasets in request.datasets.items():
        for dataset in datasets:
            prefix = f"{model}, {dataset.name}: " if several else f"{dataset.name}: "
            for remark in dataset.remarks:
                yield prefix + remark


def objective(document: Mapping[str, Any]) -> float | None:
    """What a sweeper minimises: errors over those of no change, geometric mean."""
    if "models" in document:
        return None
    ratios = [
        row["rms"] / row["unchanged_rms"]
        for rows in document["by_horizon"].values()
        for row in rows.values()
        if row["rms"] and row["unchanged_rms"]
    ]
    return float(np.exp(np.mean(np.log(ratios)))) if ratios else None


#: Files of a validation in its folder.
DOCUMENT_NAME, PAGE_NAME = "validation.json", "validation.html"


def perform(
    compositions: Sequence[Composition], listener: Listener, model_names: Sequence[str] = ()
) -> Done:
    """Validate the model of each configuration; they differ in their model only.

    `model_names`: what each model was called when it was asked for; empty for one from a
    configuration.
    """
    from trms_cli.identification.validation import findings
    from trms_cli.identification.validation.document import document_of
    from trms_cli.identification.validation.validate import validate_all
    from trms_cli.runs.run_folder import write_document

    begin = perf_counter()
    request = validation_of(compositions, model_names)
    listener.begin(", ".join(request.models), dict(_facts(request)))
    with listener.progress() as line:
        validations = validate_all(request.models, request.datasets, request.options, line.tell)
        validations, notes = calibrate_validations(validations, request, line.tell)
        line.tell("figures")
        document = document_of(validations)
        document["notes"] = [*notes_on(request), *notes]
        document["warnings"] = Admission(request.admission.warnings).as_data()
        document["versions"] = versions()
        folder = compositions[0].folder("validate")
        files = {"figures": folder / DOCUMENT_NAME}
        write_document(document, files["figures"])
        if request.page:
            from trms_cli.reporting.page import write_page

            line.tell("page")
            whole = findings.findings(document, validations)
            page = write_page(whole, folder / PAGE_NAME, pictures=False, interactive=False)
            files |= {"page": page} if page else {}
    result = findings.findings(document)
    facts = {f"note{' ' * i}": note for i, note in enumerate(notes)}
    facts["time"] = wording.seconds(perf_counter() - begin)
    result = replace(result, facts=facts, files=files, measures=(), warnings=())
    if compositions[0].job is not None:
        result = replace(result, lead=[findings.in_short(document)])
    return Done(folder, result, objective=objective(document))


def _facts(request: ValidationRequest) -> Iterator[tuple[str, str]]:
    datasets = next(iter(request.datasets.values()))
    yield (
        "on",
        "\n".join(f"{d.source}  {d.duration:g} s at {1 / d.sample_time:g} Hz" for d in datasets),
    )
    notes = dict.fromkeys(_without_model(n, request) for n in notes_on(request))
    if notes:
        yield "note", "\n".join(notes)
    if request.admission.warnings:
        yield "warning", "\n".join(map(str, request.admission.warnings))


def _without_model(note: str, request: ValidationRequest) -> str:
    """A note on a recording, which each of several models has."""
    own = (name for name in request.models if note.startswith(f"{name}, "))
    return note.removeprefix(f"{next(own, '')}, ")
