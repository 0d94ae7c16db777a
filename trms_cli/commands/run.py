"""``trms run``: compose an experiment and close the loop."""

from __future__ import annotations

from collections.abc import Sequence

from trms_cli.commands.composition import Composition, execute
from trms_cli.core.errors import SimulationError

SUMMARY = "close the loop: simulate or replay, log, score, draw"
COMPOSES = "run"

HELP = """\
usage: trms run [GROUP=OPTION]… [KEY=VALUE]… [options]

  Closes the loop of a controller and a rig. GROUP=OPTION chooses a part, KEY=VALUE changes a
  value in it; `trms list GROUP OPTION` shows an option's keys with units.

  -m, --multirun     one run for each combination of the alternatives A,B in the overrides
  --cfg job          print the whole configuration as YAML and stop
  --config-dir DIR   also your own folder of YAML groups; classes may lie in DIR or beside it

examples
  trms run controller=pid ref=sine sim.duration=20
  trms run effect=[yaw_coulomb_friction,main_input_delay] plant.parameters.k_g=0.05
  trms run model=my_fit.yaml
  trms run -m controller=pid,newton_mpc seed=1,2,3
  trms run --config-dir my_lab/configs controller=mine
"""


def main(argv: Sequence[str]) -> int:
    """Compose and run."""
    return execute(argv, COMPOSES, _run)


def _run(composition: Composition) -> int:
    raise SimulationError("the loop is not built into this version yet", where="trms run")
