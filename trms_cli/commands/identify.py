"""``trms identify``: fit a model to recordings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

from trms_cli.commands.execution import execute
from trms_cli.composition.composer import Composition, Outcome
from trms_cli.core.errors import EXIT_OK, SimulationError

if TYPE_CHECKING:
    from trms_cli.identification.method import FitResult

SUMMARY = "fit a model's parameters, or a network, to recordings"
COMPOSES = "identify"

#: Files of a fit in its folder.
MODEL_NAME, DOCUMENT_NAME = "model.yaml", "identification.json"

HELP = """\
usage: trms identify real=FILE [GROUP=OPTION]… [KEY=VALUE]… [-m] [--cfg job] [--config-dir DIR]…
       trms identify resume=FOLDER [KEY=VALUE]…

Fits a model to recordings of one rig and leaves a folder with the fitted model (model.yaml, which
`model=PATH` takes anywhere), the figures as JSON (identification.json) and a page with pictures
(identification.html). The end of each recording is kept from the fit and shows how good it is.
Ctrl-C stops a fit at the best so far and writes that.

examples
  trms identify real=rig.csv                                 all parameters that have a prior
  trms identify real=rig.csv free=[k_fvp,k_ov,l_cb]          some of them
  trms identify real=rig.csv 'free=[priors,"!k_g"]'          all but one
  trms identify 'real=[monday.csv,tuesday.csv]' validation.real=friday.csv
  trms identify real=rig.csv driven=[omega_v,omega_h]        rotor speeds taken from the recording
  trms identify real=rig.csv effect=yaw_coulomb_friction 'free=[priors,yaw_coulomb_friction.torque]'
  trms identify real=rig.csv 'priors.k_ov={mean: 0.004, sd: 0.001}' 'bounds.k_ov=[0,0.01]'
  trms identify real=rig.csv method=genetic method.generations=200
  trms identify -m real=rig.csv method=genetic,cma_es,multiple_shooting
  trms identify resume=outputs/…-identify                    a stopped search goes on
  trms identify resume=outputs/…-identify method.generations=400
  trms identify real=rig.csv model=fit.yaml                from a fitted model on
  trms identify real=rig.csv method.profiles=[k_ov]          with the profile likelihood of one

options
  -m, --multirun     one fit for each combination of the values that commas part
  --cfg job          print the composed configuration and stop
  --config-dir DIR   a folder with option files of your own, searched first (may be repeated)
  --allow PACKAGE    let classes of your own package run in this call (for good: trms allow)
"""


def main(argv: Sequence[str]) -> int:
    """Compose and fit."""
    from trms_cli.commands.identify_resume import RESUMPTION

    folder, rest = RESUMPTION.take_folder(argv)
    if folder is not None:
        return RESUMPTION.go_on(folder, rest, perform)
    return execute(rest, COMPOSES, perform)


def perform(composition: Composition, folder: Path | None = None) -> Outcome:
    """Fit what a configuration asks for; in the folder of an earlier fit, go on with that."""
    begin = perf_counter()
    from trms_cli.commands import identify_assessment as assessment
    from trms_cli.commands import identify_files as files
    from trms_cli.commands.identify_document import document_of
    from trms_cli.commands.identify_pictures import draw_all
    from trms_cli.commands.identify_progress import STATE_NAME, FitProgress
    from trms_cli.commands.identify_request import identification_of
    from trms_cli.commands.identify_screen import IdentifyScreen
    from trms_cli.runs.run_folder import write_document

    asked = identification_of(composition)
    origin = files.origin_of(composition) if asked.problem.free else None
    again = folder is not None
    folder = folder or composition.folder("identify")
    if not again:
        files.write_config(composition, folder)
    screen = IdentifyScreen(composition, asked, folder)
    screen.say_begin()
    progress = FitProgress(folder / STATE_NAME, resume=again, quiet=composition.job is not None)
    with progress:
        result = asked.method.fit(asked.problem, progress)
    if again:  # now that it is known to be the same search
        files.write_config(composition, folder)
    screen.say_fitted(result)
    _require_simulated(result)
    fitted = assessment.assess(asked, result)
    model = files.write_fitted_model(
        asked, fitted.result, fitted.deviations, origin, folder / MODEL_NAME
    )
    assessment.judge(asked, fitted, files.network_of(result, model))
    document = document_of(composition, asked, fitted, perf_counter() - begin)
    write_document(document, folder / DOCUMENT_NAME)
    page = draw_all(fitted, document, folder) if composition.config["picture"] else None
    screen.say_finished(document, model, page, perf_counter() - begin)
    if progress.exit_code is not None and composition.job is not None:
        raise KeyboardInterrupt  # the sweep ends too
    code = EXIT_OK if progress.exit_code is None else progress.exit_code
    return Outcome(code, result.cost, folder)


def _require_simulated(result: FitResult) -> None:
    """A fit that could simulate nothing has no model to write."""
    from trms_cli.identification.method import FitOutcome as Ended

    if result.outcome is Ended.FAILED:
        problem, _, remedy = result.outcome.value.partition(": ")
        raise SimulationError(problem, where="model", remedy=remedy)
