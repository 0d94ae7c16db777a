"""``trms validate``: hold models against recordings."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from time import perf_counter

from trms_cli.commands.execution import execute
from trms_cli.commands.validate_models import model_list, named_sets, one_of
from trms_cli.composition.composer import Composition, Outcome, compose
from trms_cli.core.errors import EXIT_OK

SUMMARY = "how well models foretell recordings: errors, residual tests, spectra"
COMPOSES = "validate"

#: Files of a validation in its folder.
DOCUMENT_NAME, PAGE_NAME = "validation.json", "validation.html"

HELP = """\
usage: trms validate real=FILE [model=NAME|FILE.yaml] [KEY=VALUE]… [--cfg job] [--config-dir DIR]…
       trms validate real=FILE 'model=[NAME,FILE.yaml,…]' …

Holds models against recordings that they were not fitted to, and leaves a folder with the figures
(validation.json) and a page with tables and pictures (validation.html): errors one step ahead and
over free runs of several lengths, where in the operating range they lie, what the residual tests
find, spectra, and the statistics of the signals. Several models are compared over the same
windows, with intervals on the differences.

examples
  trms validate real=rig.csv                                    model=newtonian
  trms validate real=outputs/…/run.mcap model=fit.yaml          a run's log, a fitted model
  trms validate 'real=[monday.csv,tuesday.csv]' model=fit.yaml
  trms validate real=rig.csv 'model=[newtonian,rahideh,fit.yaml]'
  trms validate real=rig.csv effect=yaw_coulomb_friction effect.yaw_coulomb_friction.torque=0.004
  trms validate real=rig.csv 'driven=[omega_v,omega_h]'         the beam, driven by measured rotors
  trms validate real=rig.csv data.start=60 data.end=120         a part of it, s
  trms validate real=rig.csv 'horizons=[0.5,5]' windows.stride=0.25
  trms validate real=rig.csv tests.calibration=simulated        p-values from simulations
  trms validate real=tras.csv model=tras data.command_delay=1   a row's command acts one row later

options
  -m, --multirun     one validation for each combination of the values that commas part
  --cfg job          print the composed configuration and stop
  --config-dir DIR   a folder with option files of your own, searched first (may be repeated)
  --allow PACKAGE    let classes of your own package run in this call (for good: trms allow)
"""


def main(argv: Sequence[str]) -> int:
    """Compose, one configuration a model, and validate."""
    models = model_list(argv)
    if models is None:
        return execute(named_sets(argv), COMPOSES, perform)
    if "--cfg" in argv or "-c" in argv:
        for name in models:
            sys.stdout.write("---\n")
            execute(one_of(argv, name), COMPOSES, perform)
        return EXIT_OK
    compositions = [compose(one_of(argv, name), COMPOSES) for name in models]
    return perform_all(compositions, list(models)).exit_code


def perform(composition: Composition) -> Outcome:
    """Validate the one model of a configuration."""
    return perform_all([composition], [])


def perform_all(compositions: Sequence[Composition], given: Sequence[str]) -> Outcome:
    """Validate the model of each configuration; they differ in their model only.

    Parameters
    ----------
    given : sequence of str
        What each model was called on the command line; empty for one from a configuration.
    """
    from trms_cli.commands import validate_request as request
    from trms_cli.commands.progress_line import ProgressLine
    from trms_cli.commands.validate_screen import ValidateScreen
    from trms_cli.identification.validation.document import document_of
    from trms_cli.identification.validation.validate import validate_all
    from trms_cli.runs.run_folder import write_document

    begin = perf_counter()
    asked = request.validation_of(compositions, given)
    screen = ValidateScreen(compositions[0], asked)
    with ProgressLine() as line:
        validations = validate_all(asked.models, asked.datasets, asked.options, line.tell)
        validations, notes = request.calibrated_where_asked(validations, asked, line.tell)
        line.tell("figures")
        document = document_of(validations)
        document["notes"] = [*request.notes_on(asked), *notes]
        document["warnings"] = request.warnings_of(asked)
        document["versions"] = request.versions()
        folder = compositions[0].folder("validate")
        write_document(document, folder / DOCUMENT_NAME)
        page = None
        if asked.page:
            from trms_cli.commands.validate_page import page_of

            line.tell("page")
            page = folder / PAGE_NAME
            try:
                page_of(document, validations).write(page)
            except OSError as error:  # the figures are safe: this much may fail
                sys.stderr.write(f"no page: {error.strerror or error}\n")
                page = None
    screen.say_finished(document, folder / DOCUMENT_NAME, page, perf_counter() - begin)
    return Outcome(EXIT_OK, request.objective(document), folder)
