"""A study of stability: request, findings, document, files."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from time import perf_counter
from typing import Any

from trms_cli.composition.composer import Composition
from trms_cli.composition.plain_values import check_out, model_of_choice, number, truth
from trms_cli.core.errors import ConfigurationError, TrmsError
from trms_cli.core.findings import Findings, as_data
from trms_cli.core.invocation import command_line
from trms_cli.core.plugins import TARGET, build, check_contract
from trms_cli.core.versions import versions
from trms_cli.library.tasks.subject import model_of
from trms_cli.library.tasks.task import Done, Listener
from trms_cli.stability.study import Study
from trms_cli.stability.subject import LoopParts, Subject, effects_of

SCHEMA = "trms.stability/1"
#: Files of a study in its folder.
DOCUMENT_NAME, PAGE_NAME = "stability.json", "stability.html"


def perform(composition: Composition, listener: Listener) -> Done:
    """Answer the question of a configuration.

    Raises TrmsError if the question makes no sense for the model; it says what is possible.
    """
    from trms_cli.runs.run_folder import removed_if_empty, write_document

    begin = perf_counter()
    request = request_of(composition)
    subject = subject_words(request.subject)
    folder = composition.folder("stability")  # before the work, which a wrong name would lose
    files = {"figures": folder / DOCUMENT_NAME}
    with listener.progress() as line, removed_if_empty(folder):
        findings = findings_of(request, line.tell)
        document = document_of(composition, request, findings)
        write_document(document, files["figures"])
        facts = {"model": document["model"], "command": f"`{document['command']}`"}
        facts["versions"] = ", ".join(f"{name} {v}" for name, v in document["versions"].items())
        if request.page:
            from trms_cli.reporting.page import write_page

            line.tell("figures")
            page = write_page(replace(findings, facts=facts), folder / PAGE_NAME, subject)
            files |= {"page": page} if page else {}
    spent = {"time": f"{perf_counter() - begin:.1f} s"}
    # On a terminal the tables have these figures, a few lines below.
    return Done(folder, replace(findings, facts=spent, files=files, measures=()), subject)


@dataclass(frozen=True)
class StabilityRequest:
    """What is studied, and how."""

    study: Study
    subject: Subject
    page: bool  #: Whether figures and page are made


def request_of(composition: Composition) -> StabilityRequest:
    """Build everything that was asked for; raises TrmsError for the first key that is wrong."""
    config = composition.config
    check_out(config["out"])
    page = truth(config["page"], "page")
    study = build(config["study"], "study")
    if not isinstance(study, Study):
        raise ConfigurationError(
            f"{config['study'].get(TARGET)!r} is no study",
            where="study",
            remedy="choose one that `trms list study` shows",
        )
    name = model_of_choice(composition)
    return StabilityRequest(study, Subject(model_of(config), name, _loop_of(composition)), page)


def _loop_of(composition: Composition) -> LoopParts | None:
    config = composition.config
    if config.get("controller") is None:
        return None
    parts = {key: build(config[key], key) for key in ("model", "controller", "observer")}
    for key in ("controller", "observer"):
        check_contract(parts[key], key)
    sample_time = number(config["sim"]["sample_time"], "sim.sample_time")
    if not sample_time > 0:
        raise ConfigurationError(
            f"{sample_time!r} given", where="sim.sample_time", remedy="a time above 0 s"
        )
    option_names = {key: str(composition.choices.get(key)) for key in ("controller", "observer")}
    return LoopParts(
        parts["model"], parts["controller"], parts["observer"], sample_time, option_names
    )


def findings_of(request: StabilityRequest, tell: Callable[[str], None]) -> Findings:
    """The findings of the study, with what of the effects it leaves out.

    Raises TrmsError: a study's own keys are named as they are typed.
    """
    try:
        findings = request.study.run(request.subject, tell)
    except TrmsError as error:
        own = {field.name for field in fields(request.study)}  # type: ignore[arg-type]
        if error.where.split(".")[0].split("[")[0] in own:
            error.where = f"study.{error.where}"
        raise
    return replace(findings, warnings=[*findings.warnings, *_left_out(request.subject)])


def document_of(
    composition: Composition, request: StabilityRequest, findings: Findings
) -> dict[str, Any]:
    """The JSON twin: ``trms.stability/1``."""
    subject, data = request.subject, as_data(findings)
    return {
        "schema": SCHEMA,
        "study": str(composition.choices.get("study")),
        "title": data.pop("title"),
        "model": subject.name,
        "effects": [name for name, _ in effects_of(subject.model)],
        "loop": None if subject.loop is None else dict(subject.loop.names),
        **data,
        "settings": composition.config["study"],
        "command": command_line(),
        "versions": versions(),
    }


def subject_words(subject: Subject) -> str:
    """``newtonian with pitch_coulomb_friction, under pid with full_state``."""
    words, effects = subject.name, [name for name, _ in effects_of(subject.model)]
    if effects:
        words += f" with {', '.join(effects)}"
    if subject.loop is not None:
        names = subject.loop.names
        words += f", under {names['controller']} with {names['observer']}"
    return words


def _left_out(subject: Subject) -> list[str]:
    """What of the effects is no part of ẋ = f(x, u), for a study of the model alone."""
    if subject.loop is not None:
        return []
    dry = "dry friction acts by impulses, which are no part of ẋ = f(x, u); "
    kinds = (
        (subject.dry, dry + "eigenvalues and equilibria are those without"),
        (
            subject.on_commands,
            "on the commands' way to the motors; eigenvalues are those of the rig behind it",
        ),
        (subject.on_sensors, "changes what is measured, not how the rig moves"),
    )
    return [f"{', '.join(effects)}: {words}" for effects, words in kinds if effects]
