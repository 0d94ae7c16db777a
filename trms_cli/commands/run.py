"""``trms run``: compose an experiment and close the loop."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

from trms_cli.commands.composition import Composition, Outcome, execute
from trms_cli.core.errors import EXIT_INTERRUPTED, EXIT_OK

SUMMARY = "close the loop: simulate or replay, log, score, draw"
COMPOSES = "run"

HELP = """\
usage: trms run [GROUP=OPTION]… [KEY=VALUE]… [-m] [--cfg job] [--config-dir DIR]…
"""

LOG_NAME = "run.mcap"


def main(argv: Sequence[str]) -> int:
    """Compose and run."""
    return execute(argv, COMPOSES, perform)


def perform(composition: Composition) -> Outcome:
    """Run one composed experiment: log it, score it, print and draw it."""
    from trms_cli.commands import run_assembly as assembly
    from trms_cli.commands.run_screen import RunScreen
    from trms_cli.simulation.closed_loop import Loop
    from trms_cli.simulation.history import History

    experiment = assembly.experiment_of(composition.config)
    folder: list[Path] = []
    logs: list[Any] = []

    def make_history(plant: Any) -> History:
        # The folder is made once everything that may be wrong with the input has been looked at.
        from trms_cli.recordings.run_log import RunLog

        topics = assembly.topics_of(experiment, plant)
        folder.append(composition.folder("run"))
        log = RunLog(
            folder[0] / LOG_NAME,
            topics,
            assembly.run_metadata(composition, experiment.model, plant),
            assembly.attachments(composition, experiment.model, getattr(plant, "parameters", None)),
        )
        logs.append(log)
        return History({topic.name: _units(topic) for topic in topics}, log)

    loop = Loop.start(experiment, make_history)
    log = logs[0]
    screen = RunScreen(experiment.duration, sys.stderr)
    begin = perf_counter()
    try:
        with screen:
            loop.run(screen.progress)
    except KeyboardInterrupt:
        log.close("interrupted", _score(loop, log.path, complete=False))
        screen.say_interrupted(log.path, loop.done * experiment.sample_time)
        return Outcome(EXIT_INTERRUPTED)
    except BaseException:
        log.close("failed")
        raise
    spent = perf_counter() - begin
    score = _score(loop, log.path, complete=True)
    log.close("completed", score)
    picture = None
    if composition.config["picture"]:
        from trms_cli.reporting.run_picture import draw_run

        picture = folder[0] / "run.png"
        draw_run(loop.history, score, picture, title=_title(composition))
    screen.say_finished(score, log.path, picture, spent)
    return Outcome(EXIT_OK, _objective(score))


def _units(topic: Any) -> dict[str, str]:
    return {field.name: field.unit for field in topic.fields}


def _score(loop: Any, path: Path, *, complete: bool) -> dict[str, Any]:
    from trms_cli.scoring.score import Series, score_tables

    history = loop.history
    tables = {
        topic: Series(history.times(topic), history.columns(topic), history.units[topic])
        for topic in history.fields
        if topic != "/prediction"
    }
    lower, upper = loop.plant.input_limits
    limits = {
        signal.name: (low, high)
        for signal, low, high in zip(loop.plant.inputs, lower.tolist(), upper.tolist(), strict=True)
    }
    stops = loop.experiment.model.stops
    limits |= {name: (-stop, stop) for name, stop in stops.items()}
    return score_tables(
        tables,
        limits=limits,
        duration_s=loop.done * loop.experiment.sample_time,
        log=str(path),
        complete=complete,
    )


def _objective(score: dict[str, Any]) -> float | None:
    """What a sweeper minimises: the sum of the channels' RMSE."""
    errors = [channel["rmse"] for channel in score["channels"].values()]
    if not errors or any(error is None for error in errors):
        return None
    return float(sum(errors))


def _title(composition: Composition) -> str:
    choices = composition.choices
    words = [f"{choices.get('controller')}", f"ref {choices.get('ref')}"]
    effects = choices.get("effect")
    if effects:
        words.append(f"effect {', '.join(effects)}")
    return " · ".join(words)
