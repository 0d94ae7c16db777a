"""A run that is followed says at each moment what a score of it up to there says."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from trms_cli.core.errors import RecordingError
from trms_cli.recordings.log_reader import TopicTable, read_log
from trms_cli.recordings.run_log import RunLog
from trms_cli.recordings.topics import Field, standard_topics
from trms_cli.runs.follower import GrowingArray, RunFollower, RunningSum
from trms_cli.scoring.score import limits_of, score_tables

LIMITS = '{"u_v": [-1.0, 1.0], "u_h": [null, 0.5]}'
ANGLES = [Field("alpha_v", "rad"), Field("alpha_h", "rad")]
DURATION = 6.0


def new_log(path: Path, *, references: bool = True, states: bool = True, **words: str) -> RunLog:
    topics = standard_topics(
        references=ANGLES if references else [],
        inputs=[Field("u_v", "V"), Field("u_h", "V")],
        outputs=[Field("omega_v", "rad/s"), *ANGLES],
        states=ANGLES if states else [],
        estimates=ANGLES,
    )
    config = b"sim:\n  note: 1\n  duration: 6.0\n  sample_time: 0.02\nseed: 0\n"
    attachments = {"config.yaml": ("application/yaml", config)}
    return RunLog(path, topics, {"command": "trms run", "limits": LIMITS} | words, attachments)


def write_seconds(
    log: RunLog, begin: int, end: int, *, references: bool = True, states: bool = True
) -> None:
    """Whole seconds at 50 Hz, the controller at 10 Hz, every third yaw reading missing."""
    rng = np.random.default_rng(begin)
    for k in range(50 * begin, 50 * end):
        t, ns = k / 50, k * 20_000_000
        yaw = math.sin(t) + 0.01 * rng.normal()
        if references:
            log.write("/reference", ns, (0.3, 0.5 if t % 2 < 1 else -0.5))
        log.write("/command", ns, (1.5 * math.sin(3 * t), 0.5 if k % 7 == 0 else -8.0))
        log.write("/measurement", ns, (20.0, 0.29, yaw if k % 3 else float("nan")))
        if states:
            log.write("/plant/state", ns, (0.1 * t, yaw + 0.001))
        log.write("/estimate", ns, (0.1, yaw, 0.01, 0.01, *[0.0] * 9))
        if k % 5 == 0:
            spent = float("nan") if k % 40 == 0 else 1e-3 * rng.random()
            late, failed = k % 35 == 0, k % 45 == 0
            status = "failed" if failed else "ok"
            mode = ("degraded", "missing alpha_h") if t > 3 else ("normal", "")
            row = (spent, 0.0, 0.0, 3, status, 0.0, 0.0, 0.0, failed, late, "", *mode, 0.0)
            log.write("/controller", ns, row)
        if k % 50 == 49:
            log.event(ns, "note", "person", f"second {k // 50}")
            log.flush()


@pytest.fixture(scope="module", params=[True, False], ids=["simulated", "rig"])
def finished(request, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    with new_log(path, states=request.param) as log:
        write_seconds(log, 0, 6, states=request.param)
    return path


def followed(path: Path) -> RunFollower:
    run = RunFollower(path)
    while run.look():
        pass
    return run


def until(table: TopicTable, time: float) -> TopicTable:
    n = int(np.sum(table.time <= time + 1e-9))
    columns = {name: column[:n] for name, column in table.columns.items()}
    return TopicTable(table.time[:n], table.time_ns[:n], columns, table.units)


@pytest.mark.parametrize("time", [0.0, 0.5, 3.33, 5.98])
def test_figures_are_those_of_the_score_until_then(finished: Path, time: float) -> None:
    log = read_log(finished)
    tables = {name: until(table, time) for name, table in log.tables.items()}
    score = score_tables(tables, limits=limits_of(log), duration_s=time)
    run = followed(finished)
    moment = run.at(time, 2.0)
    assert [axis.name for axis in moment.axes] == ["alpha_v", "alpha_h"]
    for axis in moment.axes:
        channel = score["channels"].get(axis.name, {"rmse": math.nan})  # none without a sample
        assert axis.rmse == pytest.approx(channel["rmse"], rel=1e-12, nan_ok=True)
    for given_ in moment.inputs:
        share = score["inputs"][given_.name]["saturation_share"]
        assert given_.share == pytest.approx(share, rel=1e-12)
    solver, said = moment.solver, score["solver"]
    assert solver is not None
    p99 = math.nan if said["time_ms"]["p99"] is None else said["time_ms"]["p99"]
    assert solver.p99_ms == pytest.approx(p99, rel=1e-12, nan_ok=True)
    assert solver.misses == said["deadline_misses"]
    assert solver.fallbacks == said["failures"]
    assert solver.steps == len(tables["/controller"])


def test_a_moment_is_of_the_samples_until_then(finished: Path) -> None:
    log = read_log(finished)
    simulated = "/plant/state" in log.tables
    run = followed(finished)
    pitch, yaw = run.at(3.33, 2.0).axes
    reference, measured = log.tables["/reference"], log.tables["/measurement"]
    k = int(np.searchsorted(reference.time, 3.33)) - 1
    source = log.tables["/plant/state" if simulated else "/measurement"]
    assert (pitch.name, pitch.unit) == ("alpha_v", "rad")
    assert pitch.reference == reference.columns["alpha_v"][k]
    assert pitch.measured == measured.columns["alpha_v"][k]
    assert pitch.estimate == 0.1
    assert math.isnan(pitch.state) != simulated
    assert pitch.error == pitch.reference - source.columns["alpha_v"][k]
    first = int(np.searchsorted(reference.time, 1.33 - 1e-9))
    np.testing.assert_array_equal(yaw.time, reference.time[first : k + 1])
    np.testing.assert_array_equal(yaw.references, reference.columns["alpha_h"][first : k + 1])
    np.testing.assert_array_equal(yaw.outputs, source.columns["alpha_h"][first : k + 1])


def test_words(finished: Path) -> None:
    run = followed(finished)
    assert (run.state, run.has_ended, run.total, run.latest) == ("completed", True, 6.0, 5.98)
    early, late = run.at(2.0, 1.0), run.at(5.0, 1.0, events=2)
    assert early.solver is not None and late.solver is not None
    assert (early.solver.mode, early.solver.reasons) == ("normal", "")
    assert (late.solver.mode, late.solver.reasons) == ("degraded", "missing alpha_h")
    assert early.solver.deadline_ms == pytest.approx(20.0)  # the time of a sample
    assert [event.message for event in early.events] == ["second 0", "second 1"]
    assert [event.message for event in late.events] == ["second 3", "second 4"]
    assert late.event_count == 5
    assert (late.inputs[1].lower, late.inputs[1].upper) == (-math.inf, 0.5)
    assert late.speed > 1.0


def test_it_follows_a_run_that_goes_on(tmp_path: Path) -> None:
    log = new_log(tmp_path / "run.mcap")
    run = RunFollower(log.path)
    if run.state == "unfinished":
        pytest.skip("this system does not tell who writes a file")
    assert not run.at(0.0, 2.0).axes
    for second in range(6):
        assert run.going_on and run.state == "running" and not run.has_ended
        write_seconds(log, second, second + 1)
        while run.look():
            pass
        assert run.latest == pytest.approx(second + 0.98)
        again = followed(log.path)  # who comes later sees the same
        a, b = (r.at(r.latest, 2.0) for r in (run, again))
        assert a.axes[0].rmse == pytest.approx(b.axes[0].rmse, rel=1e-12)
        assert (a.inputs, a.solver, a.events) == (b.inputs, b.solver, b.events)
    log.close("interrupted")
    while run.look():
        pass
    assert (run.state, run.has_ended) == ("interrupted", True)


def test_a_run_whose_writer_is_gone_has_died(tmp_path: Path) -> None:
    log = new_log(tmp_path / "run.mcap")
    write_seconds(log, 0, 2)
    log._stream.close()  # what the system does for a process that is killed
    run = followed(log.path)
    if run.state == "unfinished":
        pytest.skip("this system does not tell who writes a file")
    assert (run.state, run.has_ended, run.latest) == ("died", True, pytest.approx(1.98))


def test_without_a_reference_the_measured_angles_are_shown(tmp_path: Path) -> None:
    with new_log(tmp_path / "run.mcap", references=False) as log:
        write_seconds(log, 0, 1, references=False)
    moment = followed(log.path).at(0.5, 2.0)
    assert [axis.name for axis in moment.axes] == ["alpha_v", "alpha_h"]
    assert all(math.isnan(axis.rmse) and math.isnan(axis.reference) for axis in moment.axes)
    assert moment.axes[0].measured == 0.29


def test_replay_reads_no_further_than_it_has_to(finished: Path) -> None:
    run = RunFollower(finished)
    assert run.state == "completed" and not run.has_ended
    run.look_until(0.5)
    assert run.latest >= 0.5


@pytest.mark.parametrize("limits", ["nonsense", "[1]", '{"u_v": ["a", 1]}', '{"u_v": 3}'])
def test_words_of_a_stranger(tmp_path: Path, limits: str) -> None:
    with new_log(tmp_path / "run.mcap", limits=limits, choices="[") as log:
        write_seconds(log, 0, 1)
    try:
        run = followed(log.path)
    except RecordingError:
        return
    assert run.choices == {} and run.at(0.5, 1.0).axes


@settings(max_examples=60)
@given(
    st.lists(
        arrays(float, st.integers(0, 300), elements=st.floats(-10, 10) | st.just(math.nan)),
        max_size=5,
    )
)
def test_running_sums(pieces: list[np.ndarray]) -> None:
    total, growing = RunningSum(), GrowingArray()
    for piece in pieces:
        total.append(piece)
        growing.append(piece)
    whole = np.concatenate([np.empty(0), *pieces])
    np.testing.assert_array_equal(growing.values, whole)
    for k in {0, min(1, len(whole)), len(whole) // 2, len(whole)}:
        total_k, count = total.until(k)
        assert count == np.count_nonzero(~np.isnan(whole[:k]))
        assert total_k == pytest.approx(np.nansum(whole[:k]), abs=1e-9)
