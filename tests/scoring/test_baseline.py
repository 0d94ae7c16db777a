"""What counts as worse, better, or the same."""

import copy
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.core.errors import RecordingError
from trms_cli.scoring.baseline import (
    Baseline,
    FigureTolerance,
    baseline_from,
    compare,
    has_regressed,
    read_baseline,
)

KEY = "channels.alpha_v.rmse"


def changed(score: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    other = copy.deepcopy(score)
    *parents, last = path.split(".")
    node = other
    for parent in parents:
        node = node[parent]
    node[last] = value
    return other


def row(score: dict[str, Any], baseline: Baseline, key: str) -> Any:
    return {row.key: row for row in compare(score, baseline)}[key]


def test_a_score_is_the_same_as_itself_and_not_held_against_a_shorter_one(
    score: dict[str, Any],
) -> None:
    rows = compare(score, Baseline(score))
    assert {row.verdict for row in rows} == {"same"}
    assert not has_regressed(rows)
    assert len({row.key for row in rows}) == len(rows) > 20
    with pytest.raises(RecordingError, match="30 s long"):
        compare({**score, "duration_s": 30.0}, Baseline(score))


@given(then=st.floats(0, 10), now=st.floats(0, 10))
def test_verdicts_mirror_each_other(score: dict[str, Any], then: float, now: float) -> None:
    tolerance = {"rmse": FigureTolerance(absolute=0.1)}
    before, after = changed(score, KEY, then), changed(score, KEY, now)
    forth = row(after, Baseline(before, tolerance), KEY).verdict
    back = row(before, Baseline(after, tolerance), KEY).verdict
    assert {"worse": "better", "better": "worse", "same": "same"}[forth] == back
    if abs(now - then) > 0.1 + 1e-9:
        assert forth == ("worse" if now > then else "better")
    elif abs(now - then) < 0.1 - 1e-9:
        assert forth == "same"


def test_tolerances_of_one_figure_win_over_those_of_a_kind(score: dict[str, Any]) -> None:
    baseline = Baseline(
        score,
        {"rmse": FigureTolerance(absolute=5.0), KEY: FigureTolerance(absolute=0.0, relative=0.5)},
    )
    assert row(changed(score, KEY, 3.0), baseline, KEY).verdict == "worse"
    yaw = "channels.alpha_h.rmse"
    assert row(changed(score, yaw, 3.0), baseline, yaw).verdict == "same"


def test_a_step_that_no_longer_settles_and_a_channel_that_is_gone_are_regressions(
    score: dict[str, Any],
) -> None:
    worse = changed(score, "channels.alpha_v.settling_time_s", None)
    rows = compare(worse, Baseline(score))
    assert [r.key for r in rows if r.regressed] == ["channels.alpha_v.settling_time_s"]
    assert not has_regressed(compare(score, Baseline(worse)))
    without = copy.deepcopy(score)
    del without["channels"]["alpha_h"]
    assert has_regressed(compare(without, Baseline(score)))
    assert not has_regressed(compare(score, Baseline(without)))


@pytest.mark.parametrize("key", ["solver.failures", "constraint_violations.u_v.samples"])
def test_one_failure_more_is_a_regression(score: dict[str, Any], key: str) -> None:
    assert has_regressed(compare(changed(score, key, 2), Baseline(score)))


def test_effort_and_wall_time_do_not_decide(score: dict[str, Any]) -> None:
    more = changed(score, "inputs.u_v.effort", 1e6)
    more["solver"]["time_ms"]["median"] = 1e6
    rows = compare(more, Baseline(score))
    assert row(more, Baseline(score), "inputs.u_v.effort").verdict == "worse"
    assert not any("time_ms" in r.key for r in rows)
    assert not has_regressed(rows)


def test_a_baseline_survives_its_file_and_has_no_negative_tolerance(
    score: dict[str, Any], tmp_path: Path
) -> None:
    baseline = Baseline(score, {"rmse": FigureTolerance(absolute=0.01)}, "because")
    path = tmp_path / "baseline.json"
    path.write_text(json.dumps(baseline.document()))
    assert read_baseline(path) == baseline
    assert baseline_from(score, "here") == Baseline(score)
    document = Baseline(score).document()
    document["tolerances"] = {"rmse": -1.0}
    with pytest.raises(RecordingError, match="tolerance of"):
        baseline_from(document, "here")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"schema": "trms.compare/1"}',
        '{"schema": "trms.score/1"}',
        '{"schema": "trms.baseline/1", "score": 3, "tolerances": {}}',
        '{"schema": "trms.score/1", "duration_s": 1, "channels": {"alpha_v": {"rmse": "low"}}}',
    ],
)
def test_what_is_no_baseline_is_told(text: str, tmp_path: Path) -> None:
    path = tmp_path / "baseline.json"
    path.write_text(text)
    with pytest.raises(RecordingError, match="baseline") as caught:
        read_baseline(path)
    assert caught.value.where == str(path)
    with pytest.raises(RecordingError):
        read_baseline(tmp_path / "none.json")
