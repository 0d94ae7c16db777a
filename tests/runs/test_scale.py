"""A sweep of thousands of hollow runs: the index tells of it what its files tell."""

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.hollow_sweep import FAILED_EVERY, hollow_sweep
from trms_cli.library.report.sweeps import rows_of
from trms_cli.library.tasks.compare import sort_standings
from trms_cli.library.tasks.sweep import go_on
from trms_cli.runs.many import gather_runs
from trms_cli.runs.query import Query, find
from trms_cli.scoring.comparison.findings import document
from trms_cli.scoring.comparison.ranking import group, rank
from trms_cli.scoring.comparison.runs import RunCollection, gather
from trms_cli.sweeps.outcome import outcome_of

COUNT = 200
FAILED = COUNT // FAILED_EVERY


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    place = tmp_path_factory.mktemp("scale")
    before = os.environ.get("TRMS_RUNS")
    os.environ["TRMS_RUNS"] = str(place / "index")
    assert hollow_sweep(place / "hollow", COUNT) == COUNT
    yield place / "hollow"
    if before is None:
        del os.environ["TRMS_RUNS"]
    else:
        os.environ["TRMS_RUNS"] = before


@pytest.mark.slow
def test_so_it_is_of_thousands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRMS_RUNS", str(tmp_path / "index"))
    hollow_sweep(tmp_path / "hollow", 2000)
    assert _document(gather_runs([tmp_path / "hollow"])) == _document(gather([tmp_path / "hollow"]))


def _document(gathered: RunCollection) -> dict[str, object]:
    ranking = rank(group(gathered.runs), "rmse")
    return document(ranking, gathered, sort_standings(ranking, "rank"))


def test_a_comparison_out_of_the_index_is_that_of_the_logs(sweep: Path) -> None:
    assert _document(gather_runs([sweep])) == _document(gather([sweep]))


def test_rows_of_a_report_are_those_of_trms_runs(sweep: Path) -> None:
    compact = rows_of([sweep], quiet=True)
    plain = find(Query(folders=(sweep,), sort="path", descending=False))
    assert len(compact.runs) == COUNT
    names = ("path", "outcome", "rmse_alpha_h", "effort", "seed")
    ended = [row for row in plain.runs if row["outcome"] == "completed"]
    assert len(ended) == COUNT - FAILED
    assert [[r[n] for n in names] for r in compact.runs if r["outcome"] == "completed"] == [
        [r[n] for n in names] for r in ended
    ]


def test_a_log_that_changes_in_a_folder_that_does_not_is_read_again(sweep: Path) -> None:
    folder = sweep / "0"
    long_ago = time.time() - 3600
    os.utime(folder, (long_ago, long_ago))
    question = Query(folders=(folder,))
    assert find(question).runs[0]["complete"]
    log = folder / "run.mcap"
    content = log.read_bytes()
    try:
        log.write_bytes(content[:2000])  # in place: the folder stays as old as it was
        os.utime(folder, (long_ago, long_ago))
        assert not any(row["complete"] for row in find(question).runs)
    finally:
        log.write_bytes(content)
    assert find(question).runs[0]["complete"]


def test_it_stands_as_it_was_left_and_resuming_makes_nothing_anew(sweep: Path) -> None:
    counts = outcome_of(sweep)["counts"]
    assert (counts["done"], counts["failed"], counts["left"]) == (COUNT - FAILED, FAILED, 0)
    outcome = go_on(sweep)
    assert outcome.counts["done"] == COUNT - FAILED
    assert outcome.results[0].figures["rmse"] > 0
    assert not (sweep / "0" / ".attempt-2").exists()
