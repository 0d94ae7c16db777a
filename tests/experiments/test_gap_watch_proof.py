"""The proof of the gap watch: what it counts, and a trial of two rigs."""

import math
from dataclasses import replace

import numpy as np
import pytest

from experiments.gap.watch import tables
from experiments.gap.watch.evaluate import BLOCK, evaluate, evaluate_all, without_threshold
from experiments.gap.watch.recordings import cases_of, make, read
from trms_cli.gap.watch.gap_watch import GapWatch


def _row(**changes):
    row = {"kind": "steady", "drive": "rich", "effect": "", "onset": None, "locations": []}
    return row | {"duration": 120.0, "alarms": [], "blocks": []} | changes


def _alarm(time, since, location="pitch_moment"):
    words = {"kind": "change", "form": "constant", "size": 0.01, "unit": "N*m", "statistic": 99.0}
    return words | {"time": time, "since": since, "location": location}


def test_blocks_that_follow_one_another_are_one_crossing():
    blocks = [[begin * BLOCK, value, ""] for begin, value in enumerate((90, 95, 20, 81, 10))]
    assert tables.crossings(_row(blocks=blocks), 80.0) == 2
    assert tables.crossings(_row(blocks=blocks), 100.0) == 0


def test_hours_are_those_after_learning():
    rows = [_row()] * 360
    assert tables.hours_watched(rows, GapWatch(learning=20.0)) == pytest.approx(1.0)


def test_no_alarm_in_ten_hours_leaves_less_than_four():
    low, high = tables.poisson_interval(0)
    assert low == 0.0
    assert high == pytest.approx(-math.log(0.025), rel=1e-6)


def test_a_thrust_is_part_of_its_moment_and_silence_an_infinite_delay():
    begun = {"kind": "onset", "onset": 50.0, "effect": "x", "locations": ["main_thrust"]}
    rows = [_row(**begun, alarms=[_alarm(30.0, 28.0), _alarm(53.0, 50.2)]), _row(**begun)]
    text = tables.proof([*rows, _row()], GapWatch())
    assert "onset: 1 alarms before it" in text
    line = next(line for line in text.splitlines() if line.startswith("all"))
    assert line.split()[1:4] == ["2", "50%", "50%"]
    assert line.split()[-1] == "100%"
    assert "inf" in line


@pytest.mark.slow
def test_steady_rigs_scatter_by_a_third_of_what_others_do():
    steady, offset = (cases_of(kind, 4, seed=3) for kind in ("steady", "offset"))
    for one, other in zip(steady, offset, strict=True):
        own, whole = (np.array(list(c.parameters.values())) for c in (one, other))
        assert np.allclose(own, whole / 3, atol=1e-4)
    assert [case.drive for case in steady] == ["rich", "closed_loop"] * 2


@pytest.mark.slow
def test_two_rigs_are_made_and_watched_once(tmp_path):
    make(tmp_path, {"steady": (5, 2)}, 30.0)
    config = without_threshold(GapWatch(learning=10.0))
    rows = evaluate_all(read(tmp_path), config, tmp_path / "results.jsonl")
    assert all(row["blocks"] and not row["alarms"] for row in rows)
    again = evaluate_all(read(tmp_path), config, tmp_path / "results.jsonl")
    assert again == rows
    assert evaluate(next(read(tmp_path)), replace(config))["blocks"] == rows[0]["blocks"]
