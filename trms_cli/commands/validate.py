"""``trms validate``: hold models against recordings."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from trms_cli.commands.execution import execute, help_of_options, study
from trms_cli.composition.composer import Composition, Outcome, compose
from trms_cli.core.errors import EXIT_OK
from trms_cli.library.tasks.validated_models import model_list, named_sets, one_of

if TYPE_CHECKING:
    from trms_cli.library.tasks.task import Done, Listener

SUMMARY = "how well models foretell recordings: errors, residual tests, spectra"
COMPOSES = "validate"

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
""" + help_of_options("validation")


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


def perform_all(compositions: Sequence[Composition], model_names: Sequence[str]) -> Outcome:
    """Validate the model of each configuration; they differ in their model only.

    `model_names`: what each model was called on the command line; empty for one from a
    configuration.
    """
    from trms_cli.library.tasks.validate import perform as task

    def together(_: Composition, listener: Listener) -> Done:
        return task(compositions, listener, model_names)

    return study("validate", compositions[0], together)
