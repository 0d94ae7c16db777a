"""``trms diagnose``: where a model and a rig differ, which effect causes it, how far it shrinks."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

from trms_cli.commands.execution import execute
from trms_cli.composition.composer import Composition, Outcome
from trms_cli.core.errors import EXIT_OK, EXIT_TERMINATED, Terminated
from trms_cli.core.invocation import command_line

if TYPE_CHECKING:
    from trms_cli.commands.diagnose_request import Asked
    from trms_cli.gap.diagnosis import Diagnosis

SUMMARY = "where a model and a rig differ, which effect causes it, how far the gap shrinks"
COMPOSES = "diagnose"

#: Files of a diagnosis in its folder.
DOCUMENT_NAME, PAGE_NAME = "diagnosis.json", "report.html"

HELP = """\
usage: trms diagnose real=FILE [model=NAME|FILE.yaml] [KEY=VALUE]… [--config-dir DIR]…
       trms diagnose resume=FOLDER

Holds recordings of a rig against a model and tells where the gap between them lies, which effect
that the model lacks causes it, with which confidence, and how far the gap shrinks once the effect
is added. Leaves a folder with a report (report.html), all figures (diagnosis.json), and the
corrected model (corrected_model.yaml), which `model=PATH` takes anywhere. Every effect of
`trms list effect` is suspected, those in a folder of your own among them. Ctrl-C stops; finished
stages are kept, and resume=FOLDER goes on after them.

examples
  trms diagnose real=rig.csv                                   model=newtonian
  trms diagnose 'real=[monday.csv,tuesday.mcap]' out=diagnosis  several recordings of one rig
  trms diagnose real=rig.csv model=fit.yaml effort=thorough
  trms diagnose real=rig.csv 'candidates=[yaw_*,main_*]'       some suspects
  trms diagnose real=rig.csv 'candidates=[all,"!ground_effect"]'   all but one
  trms diagnose real=rig.csv effect=yaw_coulomb_friction       on top of an effect that is known
  trms diagnose real=rig.csv --config-dir mylab --allow my_lab   effects in mylab/effect too
  trms diagnose real=rig.csv 'data.channels=[alpha_v,alpha_h]' two angles alone
  trms diagnose resume=outputs/…-diagnose                      a stopped diagnosis goes on
  trms validate model=DIR/corrected_model.yaml real=other.csv  on a recording it has not seen
  trms run model=DIR/corrected_model.yaml                      control with the corrected model

options
  -m, --multirun     one diagnosis for each combination of the values that commas part
  --cfg job          print the composed configuration and stop
  --config-dir DIR   a folder with option files of your own, searched first (may be repeated)
  --allow PACKAGE    let classes of your own package run in this call (for good: trms allow)
"""


def main(argv: Sequence[str]) -> int:
    """Compose and diagnose."""
    from trms_cli.commands.diagnose_resume import RESUMPTION

    folder, rest = RESUMPTION.take_folder(argv)
    if folder is not None:
        return RESUMPTION.go_on(folder, rest, perform)
    return execute(rest, COMPOSES, perform)


def perform(composition: Composition, folder: Path | None = None) -> Outcome:
    """Diagnose what a configuration asks for; in the folder of an earlier one, go on with that."""
    begin = perf_counter()
    from trms_cli.commands.diagnose_models import model_origin, write_models
    from trms_cli.commands.diagnose_progress import LOG_NAME, STATE_NAME, DiagnoseProgress
    from trms_cli.commands.diagnose_request import diagnosis_asked
    from trms_cli.commands.diagnose_screen import DiagnoseScreen
    from trms_cli.commands.identify_files import write_config
    from trms_cli.gap.diagnose import diagnose
    from trms_cli.gap.diagnosis import document_of
    from trms_cli.runs.run_folder import write_document

    asked = diagnosis_asked(composition)
    origin = model_origin(composition, asked)
    again = folder is not None
    folder = folder or composition.folder("diagnose")
    write_config(composition, folder)
    screen = DiagnoseScreen(composition, asked, folder)
    screen.say_begin()
    progress = DiagnoseProgress(
        folder / STATE_NAME,
        folder / LOG_NAME,
        asked.fingerprint,
        resume=again,
        quiet=composition.job is not None,
    )
    progress.note(command_line())
    for line in screen.beginning():
        progress.note(line)
    try:
        with progress:
            diagnosis = completed(diagnose(asked.problem, progress), asked)
    except KeyboardInterrupt:
        screen.say_stopped()
        if progress.exit_code == EXIT_TERMINATED:
            raise Terminated from None
        raise
    write_document(document_of(diagnosis), folder / DOCUMENT_NAME)
    corrected, _ = write_models(asked, origin, diagnosis, folder)
    page = _write_page(diagnosis, asked, folder) if asked.options.page else None
    progress.finish(f"verdict {diagnosis.verdict}: {diagnosis.sentence}")
    screen.say_finished(diagnosis, corrected, page, perf_counter() - begin)
    return Outcome(EXIT_OK, folder=folder)


def completed(diagnosis: Diagnosis, asked: Asked) -> Diagnosis:
    """With what only the command knows: versions, and the warnings of the admission."""
    from trms_cli.commands.run_assembly import versions

    warnings = dict.fromkeys((*asked.problem.warnings, *diagnosis.warnings))
    return replace(
        diagnosis,
        versions=dict(diagnosis.versions) or versions(),
        warnings=tuple(warnings),
    )


def _write_page(diagnosis: Diagnosis, asked: Asked, folder: Path) -> Path | None:
    from trms_cli.reporting.diagnosis_page import diagnosis_page

    path = folder / PAGE_NAME
    try:
        diagnosis_page(diagnosis, remarks=asked.remarks).write(path)
    except OSError as error:  # the figures are safe: this much may fail
        sys.stderr.write(f"no page: {error.strerror or error}\n")
        return None
    return path
