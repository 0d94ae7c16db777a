"""The index says what lies in the folders, whatever has happened to them since."""

import json
import os
import re
import shutil
import sqlite3
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer

from tests.program import loaded_by
from trms_cli.commands.runs import HELP
from trms_cli.core.errors import ConfigurationError, TrmsError
from trms_cli.recordings.log_reader import read_log
from trms_cli.runs import find_runs, runs_frame, runs_table
from trms_cli.runs.columns import ALIASES, COLUMNS, figures_of
from trms_cli.runs.filter import translate_filter
from trms_cli.runs.place import index_file, new_runs, note_run
from trms_cli.runs.query import Query, find
from trms_cli.scoring.score import score_log

from .conftest import CONFIG, score


def paths(**how) -> list[str]:
    return [Path(run["path"]).name for run in find_runs(**how)]


class TestRow:
    def test_words_and_figures(self, write_run, runs):
        write_run(
            choices={"controller": "lqr", "effect": ["cable_stiffness", "inflow"]},
            overrides=["controller=lqr", "+plant.prior_seed=3", "ref.alpha_v.amplitude=0.25"],
            seed="7",
            command="trms run controller=lqr",
            git="abc-dirty",
        )
        (run,) = find_runs()
        assert run["path"] == str(runs / "one")
        assert run["log"] == str(runs / "one" / "run.mcap")
        assert (run["controller"], run["faults"]) == ("lqr", "")
        assert run["effects"] == "cable_stiffness+inflow"
        assert (run["seed"], run["duration"], run["sample_time"]) == (7, 6.0, 0.02)
        assert (run["complete"], run["outcome"]) == (True, "completed")
        assert (run["rmse_alpha_v"], run["rmse"], run["effort_u_v"]) == (0.1, 0.2, 2.0)
        assert run["settling_time_alpha_h"] is None
        assert (run["solve_p99"], run["failures"], run["violations"]) == (0.2, 0, 2)
        assert (run["git"], run["version"]) == ("abc-dirty", "0.1.0")
        assert [r["seed"] for r in find_runs("plant.prior_seed == 3")] == [7]
        assert find_runs("ref.alpha_v.amplitude > 0.25") == []

    def test_a_model_of_a_file_is_called_by_its_file_or_fit(self, write_run):
        for name, path in (("one", "fit/model.yaml"), ("two", "night/corrected_model.yaml")):
            config = CONFIG + f"model:\n  path: {path}\n".encode()
            write_run(name, choices={"model": "from_file"}, config=config)
        assert {run["model"] for run in find_runs()} == {"fit", "night corrected"}
        assert [Path(run["path"]).name for run in find_runs("model == 'fit'")] == ["one"]

    def test_a_killed_run_is_scored_as_far_as_it_goes_and_listed_without_a_sample(self, write_run):
        log = write_run(ending=None, samples=100)
        (run,) = find_runs()
        expected = figures_of(score_log(read_log(log)))
        assert (run["complete"], run["outcome"]) == (False, "unfinished")
        assert run["rmse_alpha_v"] == expected["rmse_alpha_v"] == pytest.approx(0.0)
        assert run["duration"] == 2.0
        log = write_run("two", ending=None)
        (run,) = find_runs("rmse is None")
        assert (run["log"], run["outcome"]) == (str(log), "unfinished")

    @pytest.mark.parametrize("ending", ["interrupted", "failed"])
    def test_a_run_that_ended_early_is_not_complete(self, write_run, ending):
        write_run(ending=ending)
        assert [(r["outcome"], r["complete"]) for r in find_runs()] == [(ending, False)]

    def test_a_log_cut_off_behind_its_samples_is_not_complete(self, write_run):
        log = write_run(samples=50)
        log.write_bytes(log.read_bytes()[:-30])
        assert [run["complete"] for run in find_runs()] == [False]

    def test_a_log_of_before_there_were_choices(self, write_run, runs):
        write_run(overrides=["controller=lqr", "effect=[inflow]"], old=True)
        (run,) = find_runs()
        assert (run["controller"], run["effects"], run["version"]) == ("lqr", "inflow", None)
        assert (run["rmse_alpha_v"], run["complete"]) == (0.1, True)

    def test_a_rig_with_other_channels(self, write_run):
        channels = {"beta": {"rmse": 0.3}, "alpha_v": {"rmse": 0.1}}
        write_run(scored=score(channels=channels))
        write_run("two")
        assert [r["rmse_alpha_v"] for r in find_runs("rmse_beta == 0.3")] == [0.1]
        found = find_runs(columns=["rmse_beta"], sort="rmse_beta")
        assert [r["rmse_beta"] for r in found] == [0.3, None]
        assert len(find_runs("estimate_rmse_omega_h == 0.5")) == 2

    def test_figures_of_other_rigs_stand_beside_the_columns_with_their_units(self, write_run):
        cart = {
            "channels": {"position": {"rmse": 0.3, "unit": "m"}},
            "inputs": {"force": {"effort": 2.0, "unit": "N"}},
        }
        write_run("cart", scored=cart)
        alone = find(Query())
        assert alone.runs[0]["rmse_position"] == 0.3 and alone.runs[0]["rmse"] == 0.3
        units = {name: alone.columns[name].unit for name in ("rmse_position", "rmse", "effort")}
        assert units == {"rmse_position": "m", "rmse": "m", "effort": "N² s"}
        write_run("twin")
        both = find(Query(columns=("path", "rmse", "rmse_*", "rmse_alpha_v")))
        assert list(both.columns) == ["path", "rmse", "rmse_position", "rmse_alpha_v"]
        # rad and m are no sum of one unit
        assert [c.unit for c in both.columns.values()] == ["", "", "m", "rad"]
        twins = find(Query(filter="rmse_alpha_v > 0", columns=("rmse",)))
        assert twins.columns["rmse"].unit == "rad"
        # the columns of a folder are those of its runs
        assert "rmse_position" not in find(Query(folders=("twin",))).columns

    def test_a_score_that_holds_what_it_should_not(self, write_run):
        channel = {"rmse": "0.1; DROP TABLE runs", "iae": [1], "steps": 1e40}
        odd = {"channels": {"alpha_v": channel}, "solver": "none", "duration_s": True, "inputs": []}
        write_run(scored=odd, seed="99999999999999999999", start="yesterday")
        (run,) = find_runs()
        for name in ("rmse_alpha_v", "iae_alpha_v", "steps_alpha_v", "duration", "seed", "time"):
            assert run[name] is None, name

    def test_logs_of_others_and_pipes_are_no_runs(self, runs):
        with (runs / "foreign.mcap").open("wb") as file:
            writer = Writer(file)
            writer.start()
            writer.finish()
        os.mkfifo(runs / "run.mcap")  # which is not waited for
        found = find(Query())
        assert (found.runs, found.unreadable) == ([], ())


class TestFolders:
    """New, changed, moved and deleted runs."""

    def test_new_changed_moved_deleted(self, write_run, runs):
        first = write_run("a")
        assert paths() == ["a"]
        write_run("b", choices={"controller": "lqr"})
        assert sorted(paths()) == ["a", "b"]
        shutil.move(first.parent, runs / "elsewhere")
        assert sorted(paths()) == ["b", "elsewhere"]
        shutil.rmtree(runs / "b")
        write_run("b", choices={"controller": "mpc"})
        assert paths(filter="controller == 'mpc'") == ["b"]
        assert paths(filter="controller == 'lqr'") == []
        shutil.rmtree(runs / "elsewhere")
        assert paths() == ["b"]

    def test_a_log_that_grows_is_read_again(self, write_run):
        log = write_run(ending=None, samples=50)
        whole = log.read_bytes()
        log.write_bytes(whole[:-200])
        find_runs()
        log.write_bytes(whole)
        assert find_runs()[0]["duration"] == 1.0

    def test_what_has_not_changed_is_not_read_again(self, write_run, monkeypatch):
        write_run("a")
        find_runs()
        write_run("b")
        looked = []
        look = lambda path: looked.append(path.parent.name) or None  # noqa: E731
        monkeypatch.setattr("trms_cli.runs.query.read_entry", look)
        find_runs()
        assert looked == ["b"]

    def test_made_anew_it_says_the_same(self, write_run, runs, index_of_its_own):
        for k in range(4):
            write_run(f"r{k}", seed=str(k))
            find_runs()  # one more each time
        shutil.rmtree(runs / "r1")
        write_run("killed", ending=None, samples=60)
        (runs / "broken.mcap").write_bytes(b"\x89MCAP0\r\n" + b"\x0c" + b"\xff" * 40)
        (runs / "no.mcap").write_bytes(b"nothing like it")
        fed = find(Query(sort="path"))
        rebuilt = find(Query(sort="path", rebuild=True))
        shutil.rmtree(index_of_its_own)
        anew = find(Query(sort="path"))
        assert fed == rebuilt == anew
        assert len(fed.runs) == 4

    def test_folders_beside_each_other_are_told_apart(self, write_run, runs):
        write_run("out/a")
        write_run("out0/b")
        write_run("out-1/c")
        assert paths(folders="out") == ["a"]
        assert sorted(paths(folders=["out", runs / "out0"])) == ["a", "b"]
        assert paths(folders=runs / "out-1" / "c" / "run.mcap") == ["c"]

    def test_names_that_a_user_chose_are_read_but_hidden_ones_and_no_text(self, write_run, runs):
        write_run(".trash/a")
        log = write_run("a")
        shutil.copy(log, runs / "my best.mcap")
        shutil.copy(log, os.fsencode(runs) + b"/\xff.mcap")
        assert sorted(paths()) == ["a", "my best.mcap"]
        assert find(Query()).unreadable[0][1] == "its name is no text"

    def test_a_large_working_folder_is_looked_through_in_part_and_said_so(
        self, write_run, monkeypatch
    ):
        for k in range(5):
            write_run(f"r{k}")
        monkeypatch.setattr("trms_cli.runs.query.MOST_ENTRIES", 4)
        found = find(Query())
        assert len(found.runs) < 5
        assert "name the folder of the runs with --in" in found.remarks[0]
        assert len(find(Query(folders=(".",))).runs) == 5
        assert len(find(Query()).runs) == 5  # known by now, and still there

    @pytest.mark.parametrize(
        "content",
        [
            b"",
            b"\x89MCAP0",
            b"x" * 100,
            b"\x89MCAP0\r\n\x0c" + (8).to_bytes(8, "little") + b"\xff" * 8,
        ],
    )
    def test_a_broken_log_is_told_of_and_disturbs_no_other(self, write_run, runs, content):
        write_run("a")
        (runs / "broken.mcap").write_bytes(content)
        found = find(Query())
        assert [run["controller"] for run in found.runs] == ["pid"]
        assert [Path(log).name for log, _ in found.unreadable] == ["broken.mcap"]
        (runs / "broken.mcap").unlink()
        assert find(Query()).unreadable == ()

    @settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(data=st.data())
    def test_a_log_with_any_bytes_changed_is_a_run_or_cannot_be_read(self, write_run, runs, data):
        log = runs / "one" / "run.mcap"
        whole = log.read_bytes() if log.is_file() else write_run(samples=5).read_bytes()
        content = bytearray(whole)
        for _ in range(data.draw(st.integers(1, 4))):
            content[data.draw(st.integers(8, len(content) - 1))] = data.draw(st.integers(0, 255))
        other = runs / "other.mcap"
        other.write_bytes(content[: data.draw(st.integers(1, len(content)))])
        found = find(Query())
        assert "pid" in [run["controller"] for run in found.runs if run["log"] == str(log)]
        assert {log for log, _ in found.unreadable} <= {str(other)}


class TestStatus:
    """Jobs of a sweep that failed before they had a log."""

    @staticmethod
    def write(folder: Path, **changes) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        document = {
            "schema": "trms.status/1",
            "job": 3,
            "overrides": ["controller=lqr", "seed=4", "plant.parameters.k_g=-1"],
            "state": "failed",
            "error": {"problem": "-1 given", "where": "plant.parameters.k_g", "trace": "…"},
        }
        path = folder / "status.json"
        path.write_text(json.dumps(document | changes))
        return path

    def test_it_is_a_failed_run(self, runs):
        self.write(runs / "sweep" / "3")
        (run,) = find_runs("outcome == 'failed' and plant.parameters.k_g < 0")
        assert (run["controller"], run["seed"], run["complete"]) == ("lqr", 4, False)
        assert run["problem"] == "plant.parameters.k_g -1 given"
        assert run["path"] == str(runs / "sweep" / "3")
        assert run["rmse"] is None

    def test_beside_a_log_the_log_counts(self, write_run, runs):
        self.write(runs / "one", state="running")
        assert [run["outcome"] for run in find_runs()] == ["unfinished"]
        write_run("one")
        assert [run["outcome"] for run in find_runs()] == ["completed"]
        assert len(find_runs(everywhere=True)) == 1
        (runs / "one" / "run.mcap").unlink()
        assert [run["outcome"] for run in find_runs()] == ["unfinished"]

    @pytest.mark.parametrize("text", ["", "[1]", '{"schema": "other/1"}', "[" * 5000, "\xff"])
    def test_files_of_this_name_of_others_are_passed_over(self, runs, text):
        (runs / "status.json").write_text(text, encoding="latin-1")
        found = find(Query())
        assert (found.runs, found.unreadable) == ([], ())

    @pytest.mark.parametrize(
        "changes",
        [{"overrides": 5}, {"choices": [1]}, {"error": 7}, {"choices": {"effect": {"a": 1}}}],
    )
    def test_what_is_not_as_it_should_be(self, runs, changes):
        self.write(runs / "x", **changes)
        assert len(find_runs()) == 1


class TestTold:
    def test_a_run_elsewhere_is_known(self, write_run, tmp_path):
        log = write_run("a", ending=None, samples=10)
        elsewhere = tmp_path / "elsewhere" / "a"
        elsewhere.parent.mkdir()
        shutil.move(log.parent, elsewhere)
        note_run(elsewhere / "run.mcap")
        assert paths() == []
        assert paths(everywhere=True) == ["a"]
        shutil.rmtree(elsewhere)
        assert paths(everywhere=True) == []

    def test_a_line_that_is_no_path_does_nothing(self, write_run, index_of_its_own):
        write_run("a")
        note_run(Path("one\ntwo"))
        ledger = next(index_of_its_own.glob("new-runs-*"))
        ledger.write_bytes(ledger.read_bytes() + b"\xff\xfe\n\0/x\nrelative\n/no/such/log.mcap\n")
        assert paths(everywhere=True) == []
        assert paths() == ["a"]

    def test_nothing_is_told_where_it_is_off_or_cannot_be(self, monkeypatch, tmp_path):
        monkeypatch.setenv("TRMS_RUNS", "off")
        monkeypatch.setenv("TRMS_CACHE", str(tmp_path / "cache"))
        note_run(tmp_path / "run.mcap")
        assert not (tmp_path / "cache").exists()
        (tmp_path / "file").touch()
        monkeypatch.setenv("TRMS_RUNS", str(tmp_path / "file" / "index"))
        note_run(tmp_path / "run.mcap")  # no error of a run

    def test_lines_of_many_processes_stay_whole(self, tmp_path):
        code = (
            "import sys; from pathlib import Path; from trms_cli.runs.place import note_run\n"
            "for k in range(200): note_run(Path(f'/runs/{sys.argv[1]}/{k}/' + 'x' * 60))"
        )
        started = [subprocess.Popen([sys.executable, "-c", code, str(k)]) for k in range(3)]
        told = []
        while any(process.poll() is None for process in started):
            for batch in new_runs():
                told += batch
        for batch in new_runs():
            told += batch
        whole = {f"/runs/{p}/{k}/" + "x" * 60 for p in range(3) for k in range(200)}
        assert set(told) <= whole
        assert len(told) >= 0.98 * len(whole)  # one may fall between two readers


class TestDatabase:
    def test_an_index_damaged_inside_or_as_a_whole_is_made_anew(self, write_run):
        for k in range(30):
            write_run(f"r{k}")
        find_runs()
        connection = sqlite3.connect(index_file())
        connection.execute("PRAGMA journal_mode = DELETE")
        connection.close()
        content = bytearray(index_file().read_bytes())
        content[4096:] = b"\xa5" * (len(content) - 4096)
        index_file().write_bytes(content)
        assert len(find_runs()) == 30
        index_file().write_bytes(b"no database at all, but long enough to be read as one" * 100)
        assert len(find_runs()) == 30

    def test_a_folder_that_is_not_there_or_gone(self, runs):
        with pytest.raises(ConfigurationError, match="there is no folder"):
            find_runs(folders="nowhere")
        runs.rmdir()
        with pytest.raises(ConfigurationError, match="there is no folder"):
            find_runs()

    def test_another_version_is_made_anew_and_knows_the_same_logs(self, write_run, tmp_path):
        log = write_run("a")
        elsewhere = shutil.move(log.parent, tmp_path / "elsewhere")
        find_runs(folders=elsewhere)
        connection = sqlite3.connect(index_file())
        connection.executescript(
            "DROP TABLE runs; CREATE TABLE runs (log TEXT, other TEXT); PRAGMA user_version = 5"
        )
        connection.close()
        assert paths(everywhere=True) == ["elsewhere"]

    def test_where_it_cannot_be_kept_the_logs_are_read(self, write_run, monkeypatch, tmp_path):
        write_run("a")
        (tmp_path / "file").touch()
        monkeypatch.setenv("TRMS_RUNS", str(tmp_path / "file" / "index"))
        found = find(Query())
        assert [run["controller"] for run in found.runs] == ["pid"]
        assert "cannot be kept" in found.remarks[0]

    def test_several_processes_at_once(self, write_run, runs):
        for k in range(60):
            write_run(f"r{k}", seed=str(k))
        code = (
            "from trms_cli.runs import find_runs\n"
            "from trms_cli.runs.query import Query, find\n"
            "for _ in range(3): find(Query(rebuild=True))\n"
            "print(len(find_runs()), sum(r['seed'] for r in find_runs()))"
        )
        started = [
            subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
            for _ in range(3)
        ]
        answers = [process.communicate(timeout=60)[0] for process in started]
        assert all(process.returncode == 0 for process in started)
        assert answers == [f"60 {sum(range(60))}\n"] * 3


class TestOrder:
    def test_what_has_no_value_comes_last(self, write_run):
        for k, value in enumerate((0.2, None, 0.1)):
            write_run(f"r{k}", scored=score(rmse_alpha_h=value))
        assert paths(sort="rmse_yaw") == ["r2", "r0", "r1"]
        assert paths(sort="rmse_yaw", descending=True) == ["r0", "r2", "r1"]
        assert paths(sort="rmse_yaw", limit=2) == ["r2", "r0"]

    def test_columns_are_called_as_they_were_asked_for(self, write_run):
        write_run(overrides=["plant.prior_seed=3", "plant.thing='x y'"])
        names = ["rmse_yaw", "plant.prior_seed", "plant.thing", "complete"]
        assert find_runs(columns=names) == [dict(zip(names, (0.1, 3, "x y", True), strict=True))]

    @pytest.mark.parametrize("how", [{"sort": "rmse_yaww"}, {"columns": ["rmse_yaww"]}])
    def test_a_column_that_is_not_there(self, write_run, how):
        write_run()
        with pytest.raises(ConfigurationError) as caught:
            find_runs(**how)
        assert "rmse_yaw" in caught.value.remedy


def test_a_table_has_types_units_and_what_find_runs_says(write_run):
    write_run("a", overrides=["plant.prior_seed=3"])
    write_run("b", scored=score(rmse_alpha_h=None), ending="failed")
    columns = ["path", "complete", "seed", "rmse_yaw", "plant.prior_seed"]
    table = runs_table(columns=columns, sort="rmse_yaw")
    assert table.to_pylist() == find_runs(columns=columns, sort="rmse_yaw")
    types = [str(field.type) for field in table.schema]
    assert types == ["string", "bool", "int64", "double", "double"]
    assert table.schema.field("rmse_yaw").metadata[b"unit"] == b"rad"
    assert runs_table().column_names == list(COLUMNS)
    assert runs_table("seed == 1").num_rows == 0


def test_values_of_several_types_become_text(write_run):
    write_run("a", overrides=["plant.x=3"])
    write_run("b", overrides=["plant.x=three"])
    assert sorted(runs_table(columns=["plant.x"])["plant.x"].to_pylist()) == ["3", "three"]


@pytest.mark.skipif(find_spec("pandas") is None, reason="pandas is no dependency")
def test_a_frame(write_run):
    write_run("a")
    write_run("b", scored=score(rmse_alpha_h=None))
    frame = runs_frame("controller == 'pid'", sort="rmse_yaw")
    assert frame["rmse_alpha_h"].tolist()[0] == 0.1
    assert frame["rmse_alpha_h"].isna().tolist() == [False, True]
    assert frame["time"].dt.tz is not None
    assert frame.attrs["units"]["duration"] == "s"


def test_without_pandas_it_says_what_to_install(write_run, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(TrmsError) as caught:
        runs_frame()
    assert "pip install pandas" in caught.value.remedy


def test_every_other_name_is_that_of_a_column():
    assert set(ALIASES.values()) <= set(COLUMNS)
    assert not set(ALIASES) & set(COLUMNS)
    assert ALIASES["rmse_yaw"] == "rmse_alpha_h"
    assert ALIASES["settling_time_pitch"] == "settling_time_alpha_v"
    assert ALIASES["effort_tail"] == "effort_u_h"


def test_a_run_that_tells_of_itself_loads_no_database(tmp_path):
    assert "sqlite3" not in loaded_by("import trms_cli.runs.place", tmp_path)


class TestPage:
    page = (Path(__file__).parents[2] / "docs" / "runs.md").read_text(encoding="utf-8")

    def test_every_column_is_told_of(self):
        for name in COLUMNS:
            stem = re.sub(r"_(alpha|u)_[vh]$", "", name)
            assert f"`{stem}`" in self.page or f"`{stem}_" in self.page, name
            assert re.search(rf"\b{stem}\b", HELP), name

    def test_its_filters_are_filters(self):
        typed = re.findall(r'(?:trms runs|runs_frame\() ?"([^"]+)"', self.page + HELP)
        rows = re.findall(r"^\| (`.*?) \| ", self.page.partition("## Columns")[0], re.MULTILINE)
        shown = [text for row in rows for text in re.findall(r"`([^`]+)`", row)]
        words = {"and", "or", "not", "not like", "not contains"}
        filters = [text for text in [*typed, *shown] if text not in words]
        assert len(filters) > 20
        for text in filters:
            if text != "controller == pid":  # the page's own example of a mistake
                translate_filter(text)
