"""A diagnosis: problem, result, findings, files."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from time import perf_counter

from trms_cli.composition.composer import Composition
from trms_cli.core import wording
from trms_cli.core.errors import EXIT_TERMINATED
from trms_cli.core.invocation import command_line, program
from trms_cli.core.versions import versions
from trms_cli.gap.diagnosis import DiagnosisResult
from trms_cli.library.tasks.corrected_models import model_origin, write_models
from trms_cli.library.tasks.diagnosis_request import DiagnosisRequest, request_of
from trms_cli.library.tasks.files import write_config
from trms_cli.library.tasks.task import Done, Interrupted, Listener

#: Files of a diagnosis in its folder.
DOCUMENT_NAME, PAGE_NAME = "diagnosis.json", "report.html"


def perform(composition: Composition, listener: Listener, folder: Path | None = None) -> Done:
    """Diagnose what a configuration asks for; in the folder of an earlier one, go on with that.

    Raises Interrupted if it was stopped.
    """
    begin = perf_counter()
    from trms_cli.gap.diagnose import diagnose
    from trms_cli.gap.diagnosis import document_of
    from trms_cli.gap.findings import findings
    from trms_cli.reporting.progress import LOG_NAME, STAGES_NAME, DiagnoseProgress
    from trms_cli.runs.run_folder import write_document

    request = request_of(composition)
    origin = model_origin(composition, request)
    again = folder is not None
    folder = folder or composition.folder("diagnose")
    write_config(composition, folder)
    words, facts = _words(composition, request), dict(_facts(request))
    listener.begin(words, facts)
    progress = DiagnoseProgress(
        folder / STAGES_NAME,
        folder / LOG_NAME,
        request.fingerprint,
        resume=again,
        quiet=listener.quiet,
    )
    for line in (command_line(), words, *facts.values(), *request.problem.warnings):
        progress.note(line)
    try:
        with progress:
            diagnosis = _completed(diagnose(request.problem, progress), request)
    except KeyboardInterrupt:
        how = f"{program()} diagnose resume={shlex.quote(str(folder))}"
        if progress.exit_code == EXIT_TERMINATED:
            raise Interrupted(folder, how, EXIT_TERMINATED) from None
        raise Interrupted(folder, how) from None
    files = {"figures": folder / DOCUMENT_NAME}
    write_document(document_of(diagnosis), files["figures"])
    files["model"], _ = write_models(request, origin, diagnosis, folder)
    result = findings(diagnosis, request.remarks, folder)
    if request.options.page:
        from trms_cli.reporting.findings_page import write_page

        facts = {**result.facts, "command": f"`{command_line()}`"}
        page = write_page(
            replace(result, facts=facts), folder / PAGE_NAME, pictures=False, interactive=False
        )
        files |= {"report": page} if page else {}
    progress.finish(f"verdict {diagnosis.verdict}: {diagnosis.sentence}")
    spent = {"time": wording.seconds(perf_counter() - begin)}
    return Done(folder, replace(result, measures=(), facts=spent, files=files))


def _completed(diagnosis: DiagnosisResult, request: DiagnosisRequest) -> DiagnosisResult:
    """With the versions, and the warnings of the admission."""
    warnings = dict.fromkeys((*request.problem.warnings, *diagnosis.warnings))
    return replace(
        diagnosis, versions=dict(diagnosis.versions) or versions(), warnings=tuple(warnings)
    )


def _words(composition: Composition, request: DiagnosisRequest) -> str:
    problem = request.problem
    words = [problem.model_name]
    if composition.config.get("effect"):
        words.append(f"with {', '.join(composition.config['effect'])}")
    words.append(wording.count(len(request.candidates.effects), "candidate"))
    return " · ".join([*words, f"effort {problem.effort}"])


def _facts(request: DiagnosisRequest) -> Iterator[tuple[str, str]]:
    lines = [
        f"{dataset.source}  {dataset.duration:g} s at {1 / dataset.sample_time:g} Hz  "
        + ", ".join(signal.name for signal in dataset.outputs)
        for dataset in request.problem.datasets
    ]
    yield "on", "\n".join(lines)
    if request.remarks:
        yield "note", "\n".join(request.remarks)
