"""A validation: models and recordings, result, findings, files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from time import perf_counter

from trms_cli.composition.composer import Composition
from trms_cli.core import wording
from trms_cli.core.versions import versions
from trms_cli.library.tasks import validation_request
from trms_cli.library.tasks.task import Done, Listener
from trms_cli.library.tasks.validation_request import ValidationRequest

#: Files of a validation in its folder.
DOCUMENT_NAME, PAGE_NAME = "validation.json", "validation.html"


def perform(
    compositions: Sequence[Composition], listener: Listener, given: Sequence[str] = ()
) -> Done:
    """Validate the model of each configuration; they differ in their model only.

    `given`: what each model was called when it was asked for; empty for one from a configuration.
    """
    from trms_cli.identification.validation import findings
    from trms_cli.identification.validation.document import document_of
    from trms_cli.identification.validation.validate import validate_all
    from trms_cli.runs.run_folder import write_document

    begin = perf_counter()
    request = validation_request.validation_of(compositions, given)
    listener.begin(", ".join(request.models), dict(_facts(request)))
    with listener.progress() as line:
        validations = validate_all(request.models, request.datasets, request.options, line.tell)
        validations, notes = validation_request.calibrated(validations, request, line.tell)
        line.tell("figures")
        document = document_of(validations)
        document["notes"] = [*validation_request.notes_on(request), *notes]
        document["warnings"] = validation_request.warnings_of(request)
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
    told = findings.findings(document)
    facts = {f"note{' ' * i}": note for i, note in enumerate(notes)}
    facts["time"] = wording.seconds(perf_counter() - begin)
    told = replace(told, facts=facts, files=files, measures=(), warnings=())
    if compositions[0].job is not None:
        told = replace(told, lead=[findings.in_short(document)])
    return Done(folder, told, objective=validation_request.objective(document))


def _facts(request: ValidationRequest) -> Iterator[tuple[str, str]]:
    datasets = next(iter(request.datasets.values()))
    yield (
        "on",
        "\n".join(f"{d.source}  {d.duration:g} s at {1 / d.sample_time:g} Hz" for d in datasets),
    )
    notes = dict.fromkeys(_without_model(n, request) for n in validation_request.notes_on(request))
    if notes:
        yield "note", "\n".join(notes)
    if request.admission.warnings:
        yield "warning", "\n".join(map(str, request.admission.warnings))


def _without_model(note: str, request: ValidationRequest) -> str:
    """A note on a recording, which each of several models has."""
    own = (name for name in request.models if note.startswith(f"{name}, "))
    return note.removeprefix(f"{next(own, '')}, ")
