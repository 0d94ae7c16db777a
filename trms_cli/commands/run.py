"""``trms run``: compose an experiment and close the loop."""

import atexit
import gc
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from trms_cli.commands.execution import execute, help_of_options, study
from trms_cli.composition.catalogue import take_option
from trms_cli.composition.composer import Composition, Outcome
from trms_cli.core.errors import ConfigurationError
from trms_cli.reporting.progress import termination
from trms_cli.runs.run_folder import log_of

SUMMARY = "close the loop: simulate or replay, log, score, draw"
COMPOSES = "run"

HELP = """\
usage: trms run [GROUP=OPTION]… [KEY=VALUE]… [-m] [--cfg job] [--config-dir DIR]…
       trms run --from LOG [GROUP=OPTION]… [KEY=VALUE]…

Closes the loop once and leaves a folder with the log (run.mcap), the score (score.json) and a
picture (run.png). The same configuration and seed give the same run, byte for byte.

examples
  trms run controller=pid ref=sine                          another controller, another reference
  trms run ref.alpha_h.amplitude=0.3 sim.duration=40        rad, s
  trms run signal@ref.alpha_v=sawtooth                      one axis follows something else
  trms run effect=yaw_coulomb_friction effect.yaw_coulomb_friction.torque=0.01    N m
  trms run 'effect=[tail_dead_zone,main_input_delay]'       what the model does not know
  trms run plant.parameters.k_g=0.1 plant.prior_seed=3      a rig that differs from the model
  trms run disturbance@plant.disturbances=yaw_push          a push that nobody announces
  trms run -m controller=pid,lqr,newton_mpc seed=1,2,3      nine runs, on all cores
  trms run controller=pid --cfg job                         every key with its value, no run
  trms run --from outputs/…/run.mcap                        that run again, bit for bit
  trms run --from outputs/…/run.mcap controller=lqr         the same, but for the controller
  trms run --from rig/run.mcap controller=newton_mpc model=fit/model.yaml   that rig, another belief
  trms run --config-dir mylab/configs --allow my_lab controller=mine   a plugin of your own
  trms run plant=replay plant.file=rig.csv model=tras       an observer over a recording

keys that are changed most
  sim.duration (s)   sim.sample_time (s)   seed   out (folder)   picture (true, false)
  ref.alpha_v.amplitude, ref.alpha_h.amplitude (rad)    ref.alpha_h.frequency (Hz)
  controller.sample_time (s)   controller.max_iterations   controller.input_rate_limits.u_v (V/s)
  plant.parameters.NAME, model.parameters.NAME (SI)   plant.sensors.noise_sd.omega_v (rad/s)
  effect.NAME.SIZE (the unit: `trms list effect NAME`)

options
  --from LOG         repeat the run of a log (or of a run's folder); what follows changes it, and
                     model= only what is believed: the rig stays the log's
""" + help_of_options("run")


OPTION = "--from"


def main(argv: Sequence[str]) -> int:
    """Compose and run."""
    log, rest = take_log(argv)
    with _rare_collection(), termination():
        if log is None:
            return execute(rest, COMPOSES, perform)
        from trms_cli.library.tasks.repeat import repetition

        again = repetition(log, rest, COMPOSES)
        if isinstance(again, Composition):
            return perform(again).exit_code
        return execute(again, COMPOSES, perform, recorded=True)


def perform(composition: Composition) -> Outcome:
    """Run one composed experiment: log it, score it, print and draw it."""
    from trms_cli.library.tasks.run import perform as task

    return study("run", composition, task)


def take_log(argv: Sequence[str]) -> tuple[Path | None, list[str]]:
    """Take ``--from LOG`` off `argv`.

    Raises ConfigurationError if it names nothing, or stands twice.
    """
    logs, rest = take_option(argv, OPTION)
    if not logs:
        return None, rest
    log = logs[0]
    if not log or log.startswith("-") or ("=" in log and not Path(log).exists()):
        raise ConfigurationError(
            f"{log!r} given" if log else "no log given",
            where=OPTION,
            remedy=f"write {OPTION} outputs/…/run.mcap",
        )
    if len(logs) > 1:
        raise ConfigurationError(
            "given twice", where=OPTION, remedy="a run is repeated from one log"
        )
    return log_of(Path(log)), rest


@contextmanager
def _rare_collection() -> Iterator[None]:
    """Look for unused objects rarely: what start-up and history hold stays in use to the end.

    Looking through it again and again costs a tenth of a short run.
    """
    before = gc.get_threshold()
    gc.set_threshold(100_000, 50, 1000)
    atexit.register(gc.freeze)  # nor look through it all once more at the very end
    try:
        yield
    finally:
        gc.set_threshold(*before)
