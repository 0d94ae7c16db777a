"""``trms run plant=replay``: an observer over a recording, logged, scored and drawn."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from time import perf_counter
from typing import Any

from trms_cli.composition.composer import Composition, Outcome
from trms_cli.core import wording
from trms_cli.core.errors import EXIT_OK, ConfigurationError, TrmsError, interrupted_code
from trms_cli.core.findings import Cell, Column, Findings, NextCommand, Section, Table, table
from trms_cli.core.invocation import program
from trms_cli.core.plugin_contract import check_contract, plugin_failure
from trms_cli.core.plugins import TARGET, build, locate
from trms_cli.library.tasks import experiment as assembly
from trms_cli.library.tasks.git_revision import GitRevision
from trms_cli.library.tasks.scene import RunScene
from trms_cli.models.model import Model, Signal
from trms_cli.plants.replay import RecordedRig
from trms_cli.recordings.for_model import RecordedRun
from trms_cli.recordings.run_log import RunLog
from trms_cli.recordings.topics import Field, Topic, standard_topics
from trms_cli.runs.place import note_run
from trms_cli.runs.run_folder import LOG_NAME, PICTURE_NAME, SCORE_NAME, write_document
from trms_cli.scoring.innovations import innovation_table
from trms_cli.scoring.score import Series, score_tables
from trms_cli.simulation.history import History
from trms_cli.simulation.replay import Replay, time_offset

INNOVATIONS_NAME = "innovations.json"
#: Groups that a recording makes no use of.
_NO_PART = ("controller", "ref", "effect", "fault", "supervisor", "sim")
#: File names of measured rotor curves, by the key of a model that takes one.
_CURVES = {"main_curve": "static_main.csv", "tail_curve": "static_tail.csv"}


def is_replay(config: Mapping[str, Any]) -> bool:
    """Whether the chosen plant is a recording."""
    node = config["plant"]
    if not isinstance(node, Mapping) or TARGET not in node:
        return False
    target = locate(str(node[TARGET]), "plant")
    return isinstance(target, type) and issubclass(target, RecordedRig)


def perform_replay(composition: Composition) -> Outcome:
    """Run the observer over the recording: log, score, print and draw."""
    begin = perf_counter()
    config = composition.config
    model = build(config["model"], "model")
    observer = build(config["observer"], "observer")
    check_contract(observer, "observer")
    plant = build(config["plant"], "plant")
    try:
        rig = plant.load(model)
    except ConfigurationError as error:
        if not error.where.startswith("plant"):
            error.where = f"plant.{error.where}"
        raise
    revision = GitRevision.ask()
    topics = _topics(model, rig)
    logs: list[RunLog] = []

    def make_history(rig: RecordedRun) -> History:
        metadata = assembly.run_metadata(composition, model, rig, revision.answer())
        scene = RunScene(config, topics, model, rig)
        log = RunLog(
            composition.folder("run") / LOG_NAME,
            [*topics, *scene.topics()],
            metadata | _about(rig),
            assembly.attachments(composition, model, None),
            publish_time="log",
        )
        logs.append(log)
        note_run(log.path)
        units = {t.name: {f.name: f.unit for f in t.fields} for t in topics}
        return History(units, scene.sink(log))

    replay = Replay.start(model, rig, observer, make_history)
    log = logs[0]
    screen = ReplayScreen(composition, rig, log.path)
    try:
        replay.run(screen.progress)
    except KeyboardInterrupt as error:
        log.close("interrupted", _score(replay, log.path, complete=False))
        screen.say_interrupted(replay.done * rig.sample_time)
        return Outcome(interrupted_code(error), folder=log.path.parent)
    except BaseException as error:
        log.close("failed")
        reached = replay.done * rig.sample_time
        if isinstance(error, Exception) and not isinstance(error, TrmsError):
            failure = plugin_failure(error, {"observer": observer}, reached)
            if failure is not None:
                raise failure from error
        raise
    spent = perf_counter() - begin
    score = _score(replay, log.path, complete=True)
    table = _innovations(replay)
    log.close("completed", score)
    for name, document in ((SCORE_NAME, score), (INNOVATIONS_NAME, table)):
        write_document(document, log.path.with_name(name))
    picture = None
    if config["picture"]:
        from trms_cli.reporting.replay_picture import draw_replay

        picture = log.path.with_name(PICTURE_NAME)
        draw_replay(replay.history, table, picture, title=screen.what)
    screen.say_finished(score, table, picture, spent)
    return Outcome(EXIT_OK, _objective(table), log.path.parent)


def _topics(model: Model, rig: RecordedRun) -> list[Topic]:
    def fields(*signals: Signal) -> list[Field]:
        return [Field(s.name, s.unit, s.description) for s in signals]

    return standard_topics(
        references=fields(*(model.states[model.state_index(name)] for name in rig.references)),
        inputs=fields(*rig.inputs),
        outputs=fields(*rig.outputs),
        estimates=fields(*model.states, *model.disturbances),
        controller=False,
    )


def _about(rig: RecordedRun) -> dict[str, str]:
    """What the log says of the recording."""
    source = rig.recording.source
    about = {f"recording.{key}": text for key, text in rig.recording.metadata.items()}
    about |= {"recording.file": str(source), "recording.sha256": rig.sha256}
    offset = time_offset(rig)
    return about | ({"time_offset_s": repr(offset)} if offset else {})


def _tables(replay: Replay) -> dict[str, Series]:
    history = replay.history
    return {
        topic: Series(history.times(topic), history.columns(topic), history.units[topic])
        for topic in history.fields
    }


def _score(replay: Replay, path: Path, *, complete: bool) -> dict[str, Any]:
    rig, model = replay.rig, replay.model
    lower, upper = rig.input_limits
    limits = {
        signal.name: (low, high)
        for signal, low, high in zip(rig.inputs, lower.tolist(), upper.tolist(), strict=True)
    }
    limits |= {name: (-stop, stop) for name, stop in model.stops.items()}
    return score_tables(
        _tables(replay),
        limits=limits,
        duration_s=round(replay.done * rig.sample_time, 9),
        log=str(path),
        complete=complete,
    )


def _innovations(replay: Replay) -> dict[str, Any]:
    tables, outputs = _tables(replay), replay.rig.outputs
    return innovation_table(
        tables["/estimate"],
        tables["/measurement"],
        [signal.name for signal in outputs],
        [signal.unit for signal in outputs],
    )


def _objective(table: Mapping[str, Any]) -> float | None:
    """What a sweeper minimises: prediction error over that of no change, summed over channels."""
    ratios = []
    for figures in table["channels"].values():
        if not figures["unchanged_rmse"] or figures["prediction_rmse"] is None:
            return None
        ratios.append(figures["prediction_rmse"] / figures["unchanged_rmse"])
    return float(sum(ratios))


class ReplayScreen:
    """What a person sees: progress on a terminal, then figures, notes and files.

    Parameters
    ----------
    composition : Composition
    rig : RecordedRun
    log : Path
    """

    _PATIENCE = 0.5  # s, before progress is worth a line

    def __init__(self, composition: Composition, rig: RecordedRun, log: Path) -> None:
        self._composition, self._rig, self._log = composition, rig, log
        self._begin = perf_counter()
        self._line = ""
        choices = composition.shown_choices
        duration = len(rig) * rig.sample_time
        self.what = (
            f"{rig.recording.source.name} · model {choices['model']} · observer "
            f"{choices['observer']} · {duration:g} s at {1 / rig.sample_time:g} Hz"
        )

    def progress(self, time: float, surprise: float) -> None:
        """Recorded time (s) and the largest present innovation of an angle (rad)."""
        if not sys.stderr.isatty() or perf_counter() - self._begin < self._PATIENCE:
            return
        line = f"{time:.0f} / {len(self._rig) * self._rig.sample_time:g} s, off {surprise:.4f} rad"
        sys.stderr.write("\r" + line.ljust(len(self._line)))
        sys.stderr.flush()
        self._line = line

    def say_interrupted(self, time: float) -> None:
        """Where the log of an interrupted replay is."""
        self._clear()
        sys.stderr.write(
            f"\ninterrupted at {time:.2f} s; the log up to there is complete and readable\n"
            f"  log  {self._log}\n"
        )

    def say_finished(
        self, score: Mapping[str, Any], table: Mapping[str, Any], picture: Path | None, spent: float
    ) -> None:
        """The figures in short, what to know about them, and the files."""
        self._clear()
        if self._composition.job is not None:
            what = " ".join(self._composition.overrides) or self.what
            print(f"{self._composition.job:>4}  {what}  {_in_short(table)}")
            return
        from trms_cli.reporting.screen import show

        show(self.findings(score, table, picture, spent), "replay")

    def findings(
        self, score: Mapping[str, Any], table: Mapping[str, Any], picture: Path | None, spent: float
    ) -> Findings:
        """What the replay has to tell; `spent` is the time that it took, s."""
        tracking = [
            f"{wording.signal(name)} {wording.quantity(channel['rmse'], channel['unit'])}"
            for name, channel in score["channels"].items()
        ]
        recorded = {"recorded": f"tracking RMSE {', '.join(tracking)}"} if tracking else {}
        time = f"{score['duration_s']:g} s replayed in {spent:.2f} s"
        return Findings(
            self.what,
            [],
            [Section("One step ahead", blocks=[_table_of(table["channels"])])],
            table,
            list(self._notes()),
            facts=recorded | {"time": time},
            files={"log": self._log} | ({"picture": picture} if picture is not None else {}),
            next=[NextCommand(f"{program()} score {shlex.quote(str(self._log))}")],
        )

    def _notes(self) -> Iterator[str]:
        ignored = [text for text in self._composition.overrides if _has_no_part(text)]
        given = f" ({' '.join(ignored)})" if ignored else ""
        yield (
            "a recording cannot be steered: commands, references and sample time are its own; "
            f"{', '.join(_NO_PART)} have no part in it{given}"
        )
        yield from self._rig.remarks
        lost = sum(1 for happening in self._rig.happenings if happening.kind == "gap")
        if lost:
            yield "the observer predicts across gaps with the last command held: see /event"
        model = self._composition.config["model"]
        beside = {
            key: self._rig.recording.source.with_name(name)
            for key, name in _CURVES.items()
            if key in model and model[key] is None
        }
        found = {key: path for key, path in beside.items() if path.is_file()}
        if found:
            words = " ".join(f"model.{key}={shlex.quote(str(p))}" for key, p in found.items())
            yield f"measured rotor curves lie beside the recording, to be used by {words}"

    def _clear(self) -> None:
        if self._line:
            sys.stderr.write("\r" + " " * len(self._line) + "\r")
            self._line = ""


def _has_no_part(override: str) -> bool:
    key = override.partition("=")[0].lstrip("+~")
    return any(word in _NO_PART for word in re.split(r"[.@/]", key))


def _table_of(channels: Mapping[str, Any]) -> Table:
    """One step ahead: a row a channel."""
    columns = [
        Column(
            "one step ahead", lambda each: wording.titled(wording.signal(each[0]), each[1]["unit"])
        ),
        Column("RMSE of the prediction", lambda each: each[1]["prediction_rmse"]),
        Column("RMSE if nothing changed", lambda each: each[1]["unchanged_rmse"]),
        Column("mean (ν/σ)²", lambda each: each[1]["normalised_square"]),
        Column("within ±2σ", lambda each: wording.percent(each[1]["within_2sd"], 1)),
        Column("correlation with the next", lambda each: each[1]["correlation"]),
        Column("white? p", lambda each: _p(each[1]["whiteness_p"])),
    ]
    return table(channels.items(), columns, "Of a consistent observer: (ν/σ)² 1, within ±2σ 95 %.")


def _channel(each: tuple[str, Mapping[str, Any]]) -> str:
    return wording.titled(wording.signal(each[0]), each[1]["unit"])


def _p(p: float | None) -> Cell:
    return "<0.001" if p is not None and p < 1e-3 else p


def _in_short(table: Mapping[str, Any]) -> str:
    parts = [
        f"{name} {'–' if c['prediction_rmse'] is None else format(c['prediction_rmse'], '.3g')} "
        f"{c['unit']}"
        for name, c in table["channels"].items()
    ]
    return f"one step ahead: RMSE {', '.join(parts)}"
