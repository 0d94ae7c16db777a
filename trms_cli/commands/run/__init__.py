"""``trms run``: compose an experiment and close the loop."""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from time import perf_counter
from typing import Any

from trms_cli.commands.execution import execute
from trms_cli.composition.composer import Composition, Outcome
from trms_cli.composition.plain_values import check_files
from trms_cli.core.errors import EXIT_OK, Terminated, interrupted_code
from trms_cli.library.tasks.run_score import limits_of, score_of, units_of
from trms_cli.runs.run_folder import LOG_NAME, PICTURE_NAME, SCORE_NAME, write_document

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
  trms run --config-dir mylab/configs --allow my_lab controller=mine   a plugin of your own
  trms run plant=replay plant.file=rig.csv model=tras       an observer over a recording

keys that are changed most
  sim.duration (s)   sim.sample_time (s)   seed   out (folder)   picture (true, false)
  ref.alpha_v.amplitude, ref.alpha_h.amplitude (rad)    ref.alpha_h.frequency (Hz)
  controller.sample_time (s)   controller.max_iterations   controller.input_rate_limits.u_v (V/s)
  plant.parameters.NAME, model.parameters.NAME (SI)   plant.sensors.noise_sd.omega_v (rad/s)
  effect.NAME.SIZE (the unit: `trms list effect NAME`)

options
  --from LOG         repeat the run of a log (or of a run's folder); what follows changes it
  -m, --multirun     one run for each combination of the values that commas part
  --cfg job          print the composed configuration and stop
  --config-dir DIR   a folder with option files of your own, searched first (may be repeated)
  --allow PACKAGE    let classes of your own package run in this call (for good: trms allow)
"""


def main(argv: Sequence[str]) -> int:
    """Compose and run."""
    from trms_cli.commands.run.repeat import repeat, take_log

    # The matrices of a control step are small: threads of the linear algebra only wait for each
    # other, and on a busy machine for milliseconds. Set before NumPy is loaded.
    for library in ("OPENBLAS", "OMP", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    log, rest = take_log(argv)
    with _rare_collection(), _termination():
        if log is not None:
            return repeat(log, rest, COMPOSES, perform)
        return execute(rest, COMPOSES, perform)


def perform(composition: Composition) -> Outcome:
    """Run one composed experiment: log it, score it, print and draw it."""
    import numpy as np

    from trms_cli.library.tasks import replay as run_replay

    if run_replay.is_replay(composition.config):
        return run_replay.perform_replay(composition)
    from trms_cli.commands.run.screen import RunScreen
    from trms_cli.library.tasks import experiment as assembly
    from trms_cli.library.tasks.git_revision import GitRevision
    from trms_cli.library.tasks.never_begun import tell_of_never_begun
    from trms_cli.library.tasks.scene import RunScene
    from trms_cli.simulation.closed_loop import Loop
    from trms_cli.simulation.history import History

    begin = perf_counter()
    check_files(composition.config)
    experiment = assembly.experiment_of(composition.config)
    _tell_of_missing_compiler(composition)
    tell_of_never_begun(composition, experiment)
    revision = GitRevision.ask()
    logs: list[Any] = []

    def make_history(plant: Any) -> History:
        # The folder is made once everything that may be wrong with the input has been looked at.
        from trms_cli.recordings.run_log import RunLog
        from trms_cli.runs.place import note_run

        topics = assembly.topics_of(experiment, plant)
        scene = RunScene(composition.config, topics, experiment.model, plant)
        log = RunLog(
            composition.folder("run") / LOG_NAME,
            [*topics, *scene.topics()],
            assembly.run_metadata(composition, experiment.model, plant, revision.answer())
            | {"loop": "closed" if _follows(experiment.controller) else "open"},
            assembly.attachments(composition, experiment.model, getattr(plant, "parameters", None)),
        )
        logs.append(log)
        note_run(log.path)
        return History({topic.name: units_of(topic) for topic in topics}, scene.sink(log))

    # What is not finite is looked for and told in words: NumPy's warnings would only repeat it.
    with (
        np.errstate(over="ignore", invalid="ignore", divide="ignore"),
        _painter(composition) as (painter),
    ):
        try:
            loop = Loop.start(experiment, make_history)
        except Exception as error:
            assembly.raise_explained(error, experiment, 0.0)
        log = logs[0]
        screen = RunScreen(composition, experiment, log.path)
        try:
            with screen:
                loop.run(screen.progress)
            score = score_of(loop, log.path, complete=True)
            log.close("completed", score)
        except KeyboardInterrupt as error:
            score = score_of(loop, log.path, complete=False)
            log.close("interrupted", score)
            write_document(score, log.path.with_name(SCORE_NAME))
            screen.say_interrupted(loop.done * experiment.sample_time)
            if composition.job is not None:
                raise  # the sweep ends too
            return Outcome(interrupted_code(error), folder=log.path.parent)
        except BaseException as error:
            log.close("failed")
            if isinstance(error, Exception):
                reached = loop.done * experiment.sample_time
                assembly.raise_explained(error, experiment, reached, log.path)
            raise
        write_document(score, log.path.with_name(SCORE_NAME))
        picture = log.path.with_name(PICTURE_NAME) if composition.config["picture"] else None
        if picture is not None:
            words = {"title": screen.title, "limits": limits_of(loop)}
            try:
                painter.draw(loop.history, score, picture, **words)
            except OSError as error:  # the run is safe in its log: this much may fail
                sys.stderr.write(f"no picture: {error.strerror or error}\n")
                picture = None
    screen.say_finished(score, picture, perf_counter() - begin)
    return Outcome(EXIT_OK, _objective(score), log.path.parent)


@contextmanager
def _termination() -> Iterator[None]:
    """SIGTERM ends what runs inside as Ctrl-C does."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals are the main thread's
        return

    def terminate(*_: Any) -> None:
        raise Terminated

    before = signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _tell_of_missing_compiler(composition: Composition) -> None:
    """Once a run, and in a sweep with its first job only; not where compiling is turned off."""
    from trms_cli.core.compilation import compiler

    if composition.job in (None, 0) and "TRMS_COMPILE" not in os.environ and compiler() is None:
        sys.stderr.write(
            "note   no C compiler: runs are two to three times slower; "
            "`trms doctor` tells what to install\n"
        )


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


def _painter(composition: Composition) -> Any:
    """Who draws: beside the run, which hides the plotting library's start; in a sweep, in line."""
    from trms_cli.reporting.painter import Painter

    wanted = bool(composition.config["picture"])
    return Painter(beside=wanted and composition.job is None)


def _objective(score: dict[str, Any]) -> float | None:
    """What a sweeper minimises: the sum of the channels' RMSE."""
    errors = [channel["rmse"] for channel in score["channels"].values()]
    if not errors or any(error is None for error in errors):
        return None
    return float(sum(errors))


def _follows(controller: Any) -> bool:
    """Whether there is a reference to be followed: not in open loop."""
    return bool(getattr(controller, "follows_reference", True))
