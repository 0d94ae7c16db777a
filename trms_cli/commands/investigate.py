"""``trms investigate``: experiments on a rig until one cause of the gap is sure."""

from collections.abc import Sequence
from pathlib import Path

from trms_cli.commands.execution import help_of_options, study
from trms_cli.commands.resume import Resumption
from trms_cli.composition.composer import Composition, Outcome
from trms_cli.core.errors import ConfigurationError

SUMMARY = "experiments, each advised by the last diagnosis, until one cause is sure"
COMPOSES = "investigate"

HELP = """\
usage: trms investigate [plant=NAME] [model=NAME|FILE.yaml] [budget=SECONDS] [KEY=VALUE]…
       trms investigate resume=FOLDER [budget=SECONDS] [arm=true]

Records a rig, diagnoses the recording, makes the experiment that the diagnosis advises, diagnoses
all recordings together, and so on: until one cause has a probability of 0.95 (`sure`), nothing
that could be recorded tells the rest apart, or the budget of rig time is spent. Before each
experiment the rigs that are still possible are simulated, and the commands made as small as all
of them need to stay off their stops and within the rig's envelope. A real rig is landed after each
experiment, and a person is asked before each, unless arm=true.

Each experiment is a run of its own (experiment-1/run.mcap …); diagnosis/ is as `trms diagnose`
leaves it, with the corrected model; investigation.json has the experiments with the probabilities
after each. Ctrl-C lands the rig and keeps what is recorded; resume=FOLDER goes on.

examples
  trms investigate effect=yaw_coulomb_friction plant.prior_seed=3   a simulated rig
  trms investigate plant=udp plant.host=10.0.0.7 budget=300        a real one
  trms investigate plant=serial model=fit.yaml 'candidates=[yaw_*]'
  trms investigate resume=outputs/…-investigate budget=600         with more rig time

options
""" + help_of_options("investigation")


def main(argv: Sequence[str]) -> int:
    """Compose and investigate."""
    return _RESUMPTION.main(argv, perform)


def perform(composition: Composition, folder: Path | None = None) -> Outcome:
    """Investigate the rig that a configuration names; in the folder of an earlier one, go on."""
    from trms_cli.library.tasks.investigate import perform as task

    return study("investigate", composition, task, folder=folder)


def _begun(folder: Path, text: str) -> None:
    if not (folder / "investigation.json").is_file():
        raise ConfigurationError(
            f"the investigation in {text!r} has recorded nothing",
            where="resume",
            remedy="investigate anew into another folder",
        )


_RESUMPTION = Resumption(
    noun="investigation",
    verb="investigate",
    command="investigate",
    may_change=("budget=", "sure=", "arm=", "jobs=", "page=", "--cfg", "job"),
    only="budget, sure, arm, jobs and page",
    check=_begun,
)
