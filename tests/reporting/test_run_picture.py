"""A run's picture: drawn for every kind of run, whole, and beside the run or in line."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.reporting.conftest import events, example_run, logged
from trms_cli.reporting import run_picture
from trms_cli.reporting.run_picture import Painter, draw_run
from trms_cli.scoring.score import Series, score_tables

LIMITS = {"u_v": (-0.5, 0.5), "alpha_v": (-1.05, 1.05)}  # which u_v exceeds
EXAMPLE = example_run(seconds=10.0).tables
TIME = EXAMPLE["/reference"].time
#: Columns by topic of a run with all that its picture shows, but events.
EVERYTHING = {
    topic: dict(table.columns)
    for topic, table in EXAMPLE.items()
    if topic not in ("/event", "/prediction")
}
PITCH = {"/reference": {"alpha_v": np.sin(TIME)}}


def told(columns: dict[str, dict[str, Any]], *happened: Any) -> dict[str, Series]:
    """Signals that are made up, with their events."""
    times = {topic: EXAMPLE[topic].time for topic in columns}
    if happened:
        columns = {**columns, "/event": events(*happened)}
        times["/event"] = columns["/event"].pop("time")
    return logged(columns, times)


@pytest.fixture
def history() -> dict[str, Series]:
    return told(EVERYTHING)


def score(tables: dict[str, Series]) -> dict[str, Any]:
    return score_tables(tables, limits=LIMITS, duration_s=10.0)


def size(picture: Path) -> tuple[int, int]:
    content = picture.read_bytes()
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    assert content.rstrip().endswith(b"IEND\xaeB`\x82")
    return struct.unpack(">II", content[16:24])  # type: ignore[return-value]


def only(*topics: str) -> dict[str, dict[str, Any]]:
    return {topic: columns for topic, columns in EVERYTHING.items() if topic in topics}


@pytest.mark.parametrize(
    "columns",
    [
        EVERYTHING,
        only("/reference", "/command", "/plant/state", "/controller"),
        only("/command", "/measurement", "/estimate"),
        only("/reference", "/command"),
        {**EVERYTHING, **PITCH},
        {**EVERYTHING, "/plant/state": {"alpha_v": np.full(len(TIME), np.nan)}},
        {**EVERYTHING, "/controller": {"solve_time_s": np.zeros(len(TIME) // 2)}},
    ],
    ids=["all", "no observer", "recording", "no outputs", "one axis", "no numbers", "no time"],
)
def test_every_kind_of_run_is_drawn(tmp_path, columns):
    history = told(columns)
    path = tmp_path / "run.png"
    draw_run(history, score(history), path, title="x", limits=LIMITS)
    width, height = size(path)
    assert width == 990 and height > 250


ROTORS = {"main_motor": 0.001 * np.sin(TIME), "sd_main_motor": np.full(len(TIME), 1e-4)}


@pytest.mark.parametrize(
    ("topic", "columns", "title", "least"),
    [
        ("/reference", EVERYTHING["/reference"], "", 150),
        ("/estimate", {**EVERYTHING["/estimate"], **ROTORS}, "", 80),
        ("/reference", PITCH["/reference"], " · ".join(f"part {i} of it" for i in range(10)), 15),
    ],
    ids=["another axis", "torques on rotors", "a title of two lines"],
)
def test_what_is_more_makes_the_picture_taller(tmp_path, topic, columns, title, least):
    one = {**EVERYTHING, **PITCH}
    heights = []
    for shown, words in ((one, "short"), ({**one, topic: columns}, title)):
        history = told(shown)
        draw_run(history, score(history), tmp_path / "run.png", title=words)
        heights.append(size(tmp_path / "run.png")[1])
    assert heights[1] - heights[0] > least


def test_events_change_the_picture(tmp_path):
    pictures = set()
    for happened in (
        [],
        [(2.0, "saturation_begin", "u_v", "", 3.0)],
        [(2.0, "saturation_begin", "u_v", "", 3.0), (4.0, "saturation_end", "u_v", "", 0)],
        [(2.0, "fault", "controller", "", np.nan)],
        [(2.0, "fault_end", "controller", "", np.nan)],
    ):
        history = told(EVERYTHING, *happened)
        draw_run(history, score(history), tmp_path / "run.png")
        pictures.add((tmp_path / "run.png").read_bytes())
    assert len(pictures) == 4  # the end of a fault alone is no mark


def test_equal_runs_are_equal_pictures_beside_or_in_line(tmp_path, history):
    with Painter(beside=True) as beside, Painter(beside=False) as in_line:
        beside.draw(history, score(history), tmp_path / "a.png", title="x")
        in_line.draw(history, score(history), tmp_path / "b.png", title="x")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize("missing", [True, False], ids=["never began", "died"])
def test_without_the_process_beside_the_picture_is_drawn_in_line(
    tmp_path, monkeypatch, history, missing
):
    if missing:
        monkeypatch.setattr(run_picture.sys, "executable", str(tmp_path / "no_python"))
    with Painter(beside=True) as painter:
        if not missing:
            painter._process.kill()
            painter._process.wait()
        painter.draw(history, score(history), tmp_path / "run.png")
    assert size(tmp_path / "run.png")


def test_a_run_that_fails_leaves_no_process():
    painter = Painter(beside=True)
    process = painter._process
    with pytest.raises(RuntimeError), painter:
        raise RuntimeError
    assert process is not None and process.poll() is not None


def test_a_folder_that_is_gone_is_an_error_of_the_disk(tmp_path, history):
    with Painter(beside=True) as painter, pytest.raises(OSError, match="nowhere"):
        painter.draw(history, score(history), tmp_path / "nowhere" / "run.png")
