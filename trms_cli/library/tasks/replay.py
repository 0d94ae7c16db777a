"""``trms run plant=replay``: an observer over a recording, logged, scored and drawn."""

import re
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from time import perf_counter
from typing import Any

from trms_cli.composition.composer import Composition
from trms_cli.core import wording
from trms_cli.core.errors import ConfigurationError, TrmsError
from trms_cli.core.findings import Cell, Column, Findings, NextCommand, Section, Table, table
from trms_cli.core.invocation import program
from trms_cli.core.plugins import TARGET, build, check_contract, locate, plugin_failure
from trms_cli.library.tasks import experiment as assembly
from trms_cli.library.tasks.git_revision import GitRevision
from trms_cli.library.tasks.scene import RunScene
from trms_cli.library.tasks.task import Done, Listener
from trms_cli.models.model import Model, Signal
from trms_cli.plants.replay import RecordedRig
from trms_cli.recordings.for_model import RecordedRun
from trms_cli.recordings.run_log import RunLog
from trms_cli.recordings.topics import Field, Topic, standard_topics
from trms_cli.runs.place import note_run
from trms_cli.runs.run_folder import LOG_NAME, PICTURE_NAME, SCORE_NAME, write_document
from trms_cli.scoring.score import innovation_table, score_tables
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


def perform(composition: Composition, listener: Listener) -> Done:
    """Run the observer over the recording: log it, score it, draw it."""
    begin = perf_counter()
    config = composition.config
    model = build(config["model"], "model")
    observer = build(config["observer"], "observer")
    check_contract(observer, "observer")
    gap_watch = build(config["gap_watch"], "gap_watch")
    check_contract(gap_watch, "gap_watch")
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
        return History(assembly.units_of(topics), scene.sink(log))

    replay = Replay.start(model, rig, observer, make_history, gap_watch)
    log, whole = logs[0], len(rig) * rig.sample_time
    try:
        with listener.progress() as line:
            replay.run(lambda time, off: line.tell(f"{time:.0f} / {whole:g} s, off {off:.4f} rad"))
    except KeyboardInterrupt as error:
        log.close("interrupted", _score(replay, log.path, complete=False))
        raise assembly.interruption_of(
            error, replay.completed_samples * rig.sample_time, log.path
        ) from None
    except BaseException as error:
        log.close("failed")
        reached = replay.completed_samples * rig.sample_time
        if isinstance(error, Exception) and not isinstance(error, TrmsError):
            failure = plugin_failure(error, {"observer": observer, "gap_watch": gap_watch}, reached)
            if failure is not None:
                raise failure from error
        raise
    spent = perf_counter() - begin
    score = _score(replay, log.path, complete=True)
    table = _innovations(replay)
    log.close("completed", score)
    for name, document in ((SCORE_NAME, score), (INNOVATIONS_NAME, table)):
        write_document(document, log.path.with_name(name))
    choices = composition.choice_labels
    title = (
        f"{rig.recording.source.name} · model {choices['model']} · observer "
        f"{choices['observer']} · {whole:g} s at {1 / rig.sample_time:g} Hz"
    )
    files = {"log": log.path}
    if config["picture"]:
        from trms_cli.reporting.run_picture import draw_replay

        files["picture"] = log.path.with_name(PICTURE_NAME)
        draw_replay(assembly.tables_of(replay.history), table, files["picture"], title=title)
    tracking = [
        f"{wording.signal(name)} {wording.quantity(channel['rmse'], channel['unit'])}"
        for name, channel in score["channels"].items()
    ]
    recorded = {"recorded": f"tracking RMSE {', '.join(tracking)}"} if tracking else {}
    findings = Findings(
        title,
        [_in_short(table)] if composition.job is not None else [],
        [Section("One step ahead", blocks=[_table_of(table["channels"])])],
        table,
        list(_notes(composition, rig)),
        facts=recorded | {"time": f"{score['duration_s']:g} s replayed in {spent:.2f} s"},
        files=files,
        next=[NextCommand(f"{program()} score {shlex.quote(str(log.path))}")],
    )
    return Done(log.path.parent, findings, objective=_objective(table), command="replay")


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
    source = rig.recording.source
    about = {f"recording.{key}": text for key, text in rig.recording.metadata.items()}
    about |= {"recording.file": str(source), "recording.sha256": rig.sha256}
    offset = time_offset(rig)
    return about | ({"time_offset_s": repr(offset)} if offset else {})


def _score(replay: Replay, path: Path, *, complete: bool) -> dict[str, Any]:
    return score_tables(
        assembly.tables_of(replay.history),
        limits=assembly.limits_of(replay.rig, replay.model),
        duration_s=round(replay.completed_samples * replay.rig.sample_time, 9),
        log=str(path),
        complete=complete,
    )


def _innovations(replay: Replay) -> dict[str, Any]:
    tables, outputs = assembly.tables_of(replay.history), replay.rig.outputs
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


def _notes(composition: Composition, rig: RecordedRun) -> Iterator[str]:
    ignored = [text for text in composition.overrides if _has_no_part(text)]
    parenthesis = f" ({' '.join(ignored)})" if ignored else ""
    yield (
        "a recording cannot be steered: commands, references and sample time are its own; "
        f"{', '.join(_NO_PART)} have no part in it{parenthesis}"
    )
    yield from rig.remarks
    if any(happening.kind == "gap" for happening in rig.happenings):
        yield "the observer predicts across gaps with the last command held: see /event"
    model = composition.config["model"]
    beside = {
        key: rig.recording.source.with_name(name)
        for key, name in _CURVES.items()
        if key in model and model[key] is None
    }
    curves = {key: path for key, path in beside.items() if path.is_file()}
    if curves:
        words = " ".join(f"model.{key}={shlex.quote(str(p))}" for key, p in curves.items())
        yield f"measured rotor curves lie beside the recording, to be used by {words}"


def _has_no_part(override: str) -> bool:
    key = override.partition("=")[0].lstrip("+~")
    return any(word in _NO_PART for word in re.split(r"[.@/]", key))


def _table_of(channels: Mapping[str, Any]) -> Table:
    """One step ahead: a row a channel."""
    columns = [
        Column(
            "one step ahead",
            lambda each: wording.with_unit(wording.signal(each[0]), each[1]["unit"]),
        ),
        Column("RMSE of the prediction", lambda each: each[1]["prediction_rmse"]),
        Column("RMSE if nothing changed", lambda each: each[1]["unchanged_rmse"]),
        Column("mean (ν/σ)²", lambda each: each[1]["normalised_square"]),
        Column("within ±2σ", lambda each: wording.percent(each[1]["within_2sd"], 1)),
        Column("correlation with the next", lambda each: each[1]["correlation"]),
        Column("white? p", lambda each: _p(each[1]["whiteness_p"])),
    ]
    return table(channels.items(), columns, "Of a consistent observer: (ν/σ)² 1, within ±2σ 95 %.")


def _p(p: float | None) -> Cell:
    return "<0.001" if p is not None and p < 1e-3 else p


def _in_short(table: Mapping[str, Any]) -> str:
    parts = [
        f"{name} {'–' if c['prediction_rmse'] is None else format(c['prediction_rmse'], '.3g')} "
        f"{c['unit']}"
        for name, c in table["channels"].items()
    ]
    return f"one step ahead: RMSE {', '.join(parts)}"
