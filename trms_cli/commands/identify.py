"""``trms identify``: fit a model to recordings."""

from collections.abc import Sequence
from pathlib import Path

from trms_cli.commands.execution import help_of_options, study
from trms_cli.commands.resume import Resumption
from trms_cli.composition.composer import Composition, Outcome
from trms_cli.core.errors import ConfigurationError

SUMMARY = "fit a model's parameters, or a network, to recordings"
COMPOSES = "identify"

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
""" + help_of_options("fit")


def main(argv: Sequence[str]) -> int:
    """Compose and fit."""
    return _RESUMPTION.main(argv, perform)


def perform(composition: Composition, folder: Path | None = None) -> Outcome:
    """Fit what a configuration asks for; in the folder of an earlier fit, go on with that."""
    from trms_cli.library.tasks.identify import perform as task

    return study("identify", composition, task, folder=folder)


def _has_state(folder: Path, text: str) -> None:
    from trms_cli.reporting.progress import STATE_NAME

    if not (folder / STATE_NAME).is_file():
        raise ConfigurationError(
            f"{text!r} holds no state to go on from (no {STATE_NAME}): this fit was over before "
            "one was kept, or its method keeps none",
            where="resume",
            remedy="fit anew: such methods take seconds; or begin with model="
            f"{folder / 'model.yaml'}",
        )


_RESUMPTION = Resumption(
    noun="fit",
    verb="fit",
    command="identify",
    may_change=("method.", "jobs=", "picture=", "--cfg", "job"),
    only="its budget (method.…), jobs and picture",
    check=_has_state,
)
