"""A run: the loop closed over an experiment, logged, scored, drawn and told about."""

from __future__ import annotations

import json
import os
import platform
import re
import shlex
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from trms_cli.composition.composer import Composition, Outcome
from trms_cli.composition.plain_values import check_files
from trms_cli.core import wording
from trms_cli.core.findings import Findings, NextCommand, Section
from trms_cli.core.invocation import note, program
from trms_cli.core.wording import headline
from trms_cli.library.tasks.task import Done, Listener, as_job
from trms_cli.recordings.topics import THINNED_KEY
from trms_cli.runs.run_folder import LOG_NAME, PICTURE_NAME, SCORE_NAME, write_document
from trms_cli.scoring.findings import in_short, short_tables, warnings_of

if TYPE_CHECKING:
    from trms_cli.simulation.closed_loop import Experiment
    from trms_cli.simulation.stop import StopRequest

_TO_THE_END = 1e-9  # s; what begins so shortly before the end has no sample either


def job(composition: Composition) -> Outcome:
    """One run of a sweep."""
    return as_job(composition, perform)


def perform(composition: Composition, listener: Listener) -> Done:
    """Run one composed experiment, or an observer over a recording: log it, score it, draw it."""
    import numpy as np

    from trms_cli.library.tasks import replay

    if replay.is_replay(composition.config):
        return replay.perform(composition, listener)
    from trms_cli.library.tasks import experiment as assembly
    from trms_cli.library.tasks.git_revision import GitRevision
    from trms_cli.library.tasks.scene import RunScene
    from trms_cli.reporting.run_picture import Painter
    from trms_cli.simulation.closed_loop import Loop
    from trms_cli.simulation.history import History
    from trms_cli.simulation.rig_life import RigLanded

    begin = perf_counter()
    check_files(composition.config)
    experiment = assembly.experiment_of(composition.config)
    _tell_of_missing_compiler(composition)
    if composition.job in (None, 0):  # in a sweep with its first job only
        from trms_cli.simulation.preparation import long_period

        for what in (*never_begun(experiment.plant, experiment.duration), *long_period(experiment)):
            note(f"note   {what}")
    revision = GitRevision.ask()
    has_picture = bool(composition.config["picture"])
    every = assembly.logged_every(composition.config)
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
            | {"loop": "closed" if _follows(experiment) else "open"}
            | _process_of(experiment)
            | ({THINNED_KEY: json.dumps(every)} if every else {}),
            assembly.attachments(composition, experiment.model, getattr(plant, "parameters", None)),
            every=every,
        )
        logs.append(log)
        note_run(log.path)
        return History(assembly.units_of(topics), scene.sink(log))

    # What is not finite is looked for and told in words: NumPy's warnings would only repeat it.
    with (
        np.errstate(over="ignore", invalid="ignore", divide="ignore"),
        # beside the run, which hides the plotting library's start; in a sweep, in line
        Painter(beside=has_picture and composition.job is None) as painter,
    ):
        try:
            loop = Loop.start(experiment, make_history, confirm=listener.confirm)
        except Exception as error:
            assembly.raise_explained(error, experiment, 0.0)
        log = logs[0]
        title = _title(composition, experiment)
        try:
            started = perf_counter()
            with (
                listener.simulation(experiment.duration) as progress,
                stop_request(loop, composition) as stop,
            ):
                loop.run(progress, stop)
            spent = perf_counter() - started
            score = score_of(loop, log.path, complete=True)
            log.close("completed", score)
        except KeyboardInterrupt as error:
            score = score_of(loop, log.path, complete=False)
            log.close("interrupted", score)
            write_document(score, log.path.with_name(SCORE_NAME))
            then = f"  try  {program()} score {shlex.quote(str(log.path))}\n"
            reached = loop.completed_samples * experiment.sample_time
            raise assembly.interruption_of(error, reached, log.path, then) from None
        except BaseException as error:
            if isinstance(error, RigLanded):
                score = score_of(loop, log.path, complete=False)
                log.close("landed", score)
                write_document(score, log.path.with_name(SCORE_NAME))
            log.close("failed")
            if isinstance(error, Exception):
                reached = loop.completed_samples * experiment.sample_time
                assembly.raise_explained(error, experiment, reached, log.path)
            raise
        finally:  # also where it was interrupted before the run took over
            loop.life.close("interrupted")
        write_document(score, log.path.with_name(SCORE_NAME))
        files = {"log": log.path}
        if has_picture:
            picture = log.path.with_name(PICTURE_NAME)
            try:
                limits = assembly.limits_of(loop.plant, experiment.model)
                painter.draw(
                    assembly.tables_of(loop.history), score, picture, title=title, limits=limits
                )
                files["picture"] = picture
            except OSError as error:  # the run is safe in its log: this much may fail
                note(f"no picture: {error.strerror or error}")
    findings = Findings(
        title,
        [_job_line(score)] if composition.job is not None else [],
        [Section("Score", blocks=short_tables(score))],
        score,
        [*_unheard(composition, experiment), *_beyond_limits(score), *warnings_of(score)],
        facts=in_short(score) | {"time": _time(score, experiment, spent, perf_counter() - begin)},
        files=files,
        next=_next(composition, experiment, shlex.quote(str(log.path))),
    )
    return Done(log.path.parent, findings, objective=_objective(score), command="run")


def stop_request(loop: Any, composition: Composition) -> AbstractContextManager[StopRequest]:
    """What Ctrl-C and SIGTERM ask for meanwhile; a job of a sweep has signals of its own."""
    from trms_cli.simulation.stop import StopRequest

    if composition.job is not None:
        return nullcontext(StopRequest())
    is_real = loop.pace is not None
    return StopRequest("landing the rig (once more: stop at once)" if is_real else "")


def score_of(loop: Any, path: Path, *, complete: bool) -> dict[str, Any]:
    """``trms.score/1`` of a loop that has run, or of as much of it as there is."""
    from trms_cli.library.tasks.experiment import limits_of, tables_of
    from trms_cli.scoring.score import score_tables

    return score_tables(
        tables_of(loop.history),
        limits=limits_of(loop.plant, loop.experiment.model),
        duration_s=loop.completed_samples * loop.experiment.sample_time,
        log=str(path),
        complete=complete,
    )


def _process_of(experiment: Experiment) -> dict[str, str]:
    """What a run by the clock says of itself, so that `trms watch` can ask it to land."""
    if not experiment.in_real_time:
        return {}
    return {"process": str(os.getpid()), "machine": platform.node()}


def never_begun(plant: Any, duration: float) -> Iterator[str]:
    """A sentence for each fault and disturbance of a rig that begins after a run of `duration` s.

    Such a run is as sound as the rig without them, and would be taken for one that withstood them.
    """
    end = f"after the end of the run ({duration:g} s)"
    for name, fault in _parts_by_name(plant, "faults"):
        start = getattr(fault, "start", None)
        if _is_after(start, duration):
            yield f"fault {name} begins at {start:g} s, {end}"
    for name, disturbance in _parts_by_name(plant, "disturbances"):
        torque = getattr(disturbance, "torque", None)
        start = getattr(torque, "start", None)
        # A signal rests at its offset before it begins; a file's first value holds before it.
        silent = getattr(torque, "offset", 0.0) == 0.0 and not hasattr(torque, "file")
        if silent and _is_after(start, duration):
            yield f"disturbance {name} begins at {start:g} s, {end}"


def _parts_by_name(plant: Any, key: str) -> Iterator[tuple[str, Any]]:
    parts = getattr(plant, key, None)
    if isinstance(parts, Mapping):
        yield from parts.items()


def _is_after(start: Any, duration: float) -> bool:
    return isinstance(start, (int, float)) and start >= duration - _TO_THE_END


def _tell_of_missing_compiler(composition: Composition) -> None:
    """Once a run, and in a sweep with its first job only; not where compiling is turned off."""
    from trms_cli.core.compilation import compiler

    if composition.job in (None, 0) and "TRMS_COMPILE" not in os.environ and compiler() is None:
        note(
            "note   no C compiler: runs are two to three times slower; "
            "`trms doctor` tells what to install"
        )


def _follows(experiment: Experiment) -> bool:
    """Whether there is a reference to be followed: not in open loop."""
    return bool(getattr(experiment.controller, "follows_reference", True))


def _objective(score: Mapping[str, Any]) -> float | None:
    """What a sweeper minimises: the sum of the channels' RMSE."""
    errors = [channel["rmse"] for channel in score["channels"].values()]
    if not errors or any(error is None for error in errors):
        return None
    return float(sum(errors))


def _title(composition: Composition, experiment: Experiment) -> str:
    rig = str(getattr(getattr(experiment.plant, "model", None), "name", ""))
    plant = composition.config["plant"]
    labels = composition.choice_labels
    return headline(labels, follows=_follows(experiment), rig=rig, plant=plant)


def _time(score: Mapping[str, Any], experiment: Experiment, spent: float, whole: float) -> str:
    """How long the loop took, and the run in all (s)."""
    duration = score["duration_s"]
    speed = duration / spent if spent > 0 else float("inf")
    samples = f"{duration:g} s at {1 / experiment.sample_time:g} Hz"
    if experiment.in_real_time:
        return f"{samples} by the clock, {whole:.2f} s in all"
    return f"{samples} simulated in {spent:.2f} s ({speed:.0f}× real time), {whole:.2f} s in all"


def _next(composition: Composition, experiment: Experiment, log: str) -> list[NextCommand]:
    """What to type next; the last with an override that would be interesting."""
    choices = composition.choices
    axes = list(experiment.model.axes)
    if axes and choices.get("plant") == "simulated" and not choices.get("effect"):
        other = f"effect={axes[-1] if experiment.model.bench_sizes else axes[0]}_coulomb_friction"
    elif not _follows(experiment):
        other = "controller=pid"
    else:
        other = "ref=sine" if choices.get("ref") != "sine" else "ref=square"
    typed = (f"score {log}", f"export {log}", f"run --from {log} {other}")
    return [NextCommand(f"{program()} {words}") for words in typed]


def _unheard(composition: Composition, experiment: Experiment) -> Iterator[str]:
    """What was asked for and has no part in the run."""
    if _follows(experiment):
        return
    heads = (text.lstrip("+~").partition("=")[0] for text in composition.overrides)
    reference_keys = [head for head in heads if re.match(r"ref\b|\w+@ref\b", head)]
    if reference_keys:
        name = composition.choices.get("controller")
        yield (f"{name} follows no reference; of no effect: {', '.join(reference_keys)}")


def _beyond_limits(score: Mapping[str, Any]) -> Iterator[str]:
    for name, violation in score["constraint_violations"].items():
        if violation["samples"]:
            samples = wording.count(violation["samples"], "sample")
            worst = wording.quantity(violation["worst"], violation["unit"])
            yield f"{name} beyond its limit on {samples}, by {worst}"


def _job_line(score: Mapping[str, Any]) -> str:
    figures = [
        f"{name} {wording.number(channel['rmse'])} {channel['unit']}"
        for name, channel in score["channels"].items()
    ]
    return f"RMSE {', '.join(figures) or '–'}"
