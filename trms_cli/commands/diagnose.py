"""``trms diagnose``: where a model and a rig differ, which effect causes it, how far it shrinks."""

from collections.abc import Sequence
from pathlib import Path

from trms_cli.commands.execution import help_of_options, study
from trms_cli.commands.resume import Resumption
from trms_cli.composition.composer import Composition, Outcome
from trms_cli.core.errors import ConfigurationError

SUMMARY = "where a model and a rig differ, which effect causes it, how far the gap shrinks"
COMPOSES = "diagnose"

HELP = """\
usage: trms diagnose real=FILE [model=NAME|FILE.yaml] [KEY=VALUE]… [--config-dir DIR]…
       trms diagnose resume=FOLDER

Holds recordings of a rig against a model and tells where the gap between them lies, which effect
that the model lacks causes it, with which confidence, and how far the gap shrinks once the effect
is added. Leaves a folder with a report (report.html), all figures (diagnosis.json), and the
corrected model (corrected_model.yaml), which `model=PATH` takes anywhere. Every effect of
`trms list effect` that explains something is a candidate, those in a folder of your own among
them. Ctrl-C stops; finished fits are kept, and resume=FOLDER goes on after them.

examples
  trms diagnose real=rig.csv                                   model=newtonian
  trms diagnose 'real=[monday.csv,tuesday.mcap]' out=diagnosis  several recordings of one rig
  trms diagnose real=today.csv 'against=[monday.csv]'          what changed since
  trms diagnose real=rig.csv model=fit.yaml effort=thorough
  trms diagnose real=rig.csv 'candidates=[yaw_*,main_*]'       some candidates
  trms diagnose real=rig.csv 'candidates=[all,"!ground_effect"]'   all but one
  trms diagnose real=rig.csv effect=yaw_coulomb_friction       on top of an effect that is known
  trms diagnose real=rig.csv --config-dir mylab --allow my_lab   effects in mylab/effect too
  trms diagnose real=rig.csv 'data.channels=[alpha_v,alpha_h]' two angles alone
  trms diagnose resume=outputs/…-diagnose                      a stopped diagnosis goes on
  trms validate model=DIR/corrected_model.yaml real=other.csv  on a recording it has not seen
  trms run --from LOG controller=newton_mpc model=DIR/corrected_model.yaml   control the same rig

options
""" + help_of_options("diagnosis")


def main(argv: Sequence[str]) -> int:
    """Compose and diagnose."""
    return _RESUMPTION.main(argv, perform)


def perform(composition: Composition, folder: Path | None = None) -> Outcome:
    """Diagnose what a configuration asks for; in the folder of an earlier one, go on with that."""
    from trms_cli.library.tasks.diagnose import perform as task

    return study("diagnose", composition, task, folder=folder)


def _unfinished(folder: Path, text: str) -> None:
    if (folder / "diagnosis.json").is_file():
        raise ConfigurationError(
            f"the diagnosis in {text!r} is finished",
            where="resume",
            remedy=f"look at {folder / 'diagnosis.json'}, or diagnose anew into another folder",
        )


_RESUMPTION = Resumption(
    noun="diagnosis",
    verb="diagnose",
    command="diagnose",
    may_change=("jobs=", "page=", "--cfg", "job"),
    only="jobs and page",
    check=_unfinished,
)
