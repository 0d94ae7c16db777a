"""``trms runs`` as a person types it, over runs that the program has made."""

import csv
import functools
import io
import json
import shutil
from pathlib import Path

import pytest

from tests.program import in_process, loaded_by
from trms_cli.runs.columns import COLUMNS


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with a sweep of four, a run of its own and one with an effect."""
    folder = tmp_path_factory.mktemp("lab")
    usual = ["sim.duration=3", "picture=false"]
    for argv in (
        ["-m", "controller=pid,lqr", "seed=1,2", "launcher.workers=0", "out=sweep"],
        ["effect=yaw_coulomb_friction", "controller=lqr", "out=friction"],
        ["controller=pid", "plant.parameters.k_g=0.1"],
    ):
        in_process(folder, "run", *argv, *usual, TRMS_RUNS=str(folder / ".index"))
    return folder


@pytest.fixture
def lab_with_runs(made, tmp_path) -> Path:
    """A copy of it: runs that were copied in, and that nobody has told of."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True, ignore=shutil.ignore_patterns(".index"))
    return tmp_path


@pytest.fixture
def ask(trms, lab_with_runs):
    """Run ``trms runs`` there, with an index of its own."""
    return functools.partial(trms, "runs", TRMS_RUNS=str(lab_with_runs / ".index"))


@pytest.fixture
def heading(ask):
    """The heads of the table's columns."""
    return lambda *argv: ask(*argv).stdout.splitlines()[0].split()


@pytest.fixture
def runs_of(ask):
    """The runs of the JSON document."""
    return lambda *argv: json.loads(ask("--json", *argv).stdout)["runs"]


class TestFigures:
    """The index and the score say the same."""

    def test_of_every_run(self, runs_of, trms):
        runs = runs_of()
        assert len(runs) == 6
        logs = [run["log"] for run in runs]
        scores = json.loads(trms("score", *logs, "--json").stdout)["scores"]
        for run, score in zip(runs, scores, strict=True):
            for name, said in score["channels"].items():
                for ours in ("rmse", "iae", "overshoot", "settling_time", "steady_state_error"):
                    theirs = {"overshoot": "overshoot_percent", "settling_time": "settling_time_s"}
                    assert run[f"{ours}_{name}"] == said[theirs.get(ours, ours)]
            for name, said in score["inputs"].items():
                assert run[f"effort_{name}"] == said["effort"]
                assert run[f"saturation_{name}"] == said["saturation_share"]
            for name in ("median", "p99", "max"):
                assert run[f"solve_{name}"] == score["solver"]["time_ms"][name]
            assert run["failures"] == score["solver"]["failures"]
            assert run["nees"] == score["estimate"]["nees_mean"]
            assert run["duration"] == score["duration_s"] == 3.0
            assert run["complete"] is True
        assert {run["sample_time"] for run in runs} == {0.02}

    def test_what_was_chosen(self, runs_of, lab_with_runs):
        swept = runs_of("--in", "sweep", "--sort", "path")
        chosen = [("pid", 1), ("pid", 2), ("lqr", 1), ("lqr", 2)]
        assert [(run["controller"], run["seed"]) for run in swept] == chosen
        (run,) = runs_of("effects contains 'friction'")
        assert run["effects"] == "yaw_coulomb_friction"
        assert run["path"] == str(lab_with_runs / "friction")
        (run,) = runs_of("plant.parameters.k_g == 0.1")
        assert run["path"].startswith(str(lab_with_runs / "outputs"))
        assert json.loads(run["overrides"])[0] == "controller=pid"
        assert run["version"] and run["observer"] == "ukf"


class TestFolders:
    """What changes under it."""

    def test_runs_elsewhere_are_known_by_what_they_told(self, made, trms):
        result = trms("runs", "--all", "--json", TRMS_RUNS=str(made / ".index"))
        assert len(json.loads(result.stdout)["runs"]) == 6
        nothing = trms("runs", TRMS_RUNS=str(made / ".index"))
        assert "--all" in nothing.stdout

    def test_a_broken_log_is_one_line(self, ask, lab_with_runs):
        for name in ("a.mcap", "b.mcap"):
            (lab_with_runs / "sweep" / name).write_bytes(b"\x1b[31mbroken")
        (lab_with_runs / "sweep" / "\x1b[31mred.mcap").write_bytes(b"")
        result = ask()
        assert len(result.stdout.splitlines()) == 7
        assert len(result.stderr.splitlines()) == 1
        assert "3 logs could not be read" in result.stderr
        assert "\x1b" not in result.stderr + result.stdout
        assert len(ask("--unreadable").stdout.splitlines()) == 3
        assert len(json.loads(ask("--json").stdout)["unreadable"]) == 3


class TestOutput:
    def test_a_pipe_gets_aligned_columns(self, ask):
        lines = ask("--sort", "rmse_yaw").stdout.splitlines()
        heading, *rows = (line.split() for line in lines)
        assert heading[0] == "path"
        assert "rmse_yaw" in heading or "rmse_alpha_h" in heading
        errors = [float(row[-heading[::-1].index("rmse_alpha_h") - 1]) for row in rows]
        assert errors == sorted(errors)
        assert len(rows) == 6

    def test_columns_of_ones_own(self, ask, heading):
        lines = ask("--columns", "controller,rmse_yaw", "--limit", "2").stdout.splitlines()
        assert lines[0].split() == ["controller", "rmse_yaw"] and len(lines) == 3
        assert "git" in heading("--columns", "+git")
        assert heading("--columns", "all", "--limit", "1") == list(COLUMNS)

    def test_what_is_asked_about_and_settings_in_which_runs_differ_are_shown(self, heading):
        asked = heading("seed > 0 and nees < 100", "--sort", "saturation")
        assert {"seed", "nees", "saturation"} <= {*asked}
        every, one_sweep = heading(), heading("--in", "sweep")
        assert "plant.parameters.k_g" in every and "overrides" not in every
        assert "plant.parameters.k_g" not in one_sweep and {"controller", "seed"} <= {*one_sweep}

    def test_json(self, ask):
        document = json.loads(ask("controller == 'lqr'", "--json", "--limit", "1").stdout)
        assert document["schema"] == "trms.runs/1"
        assert (document["matching"], document["of"], len(document["runs"])) == (3, 6, 1)
        assert document["units"]["rmse_alpha_h"] == "rad"
        assert ask("seed == 77").stdout == "none of the 6 runs matches\n"

    def test_csv_and_parquet(self, ask, lab_with_runs):
        import pyarrow.parquet as pq

        result = ask("--csv", "runs.csv", "--parquet", "runs.parquet", "--sort", "path")
        assert result.stdout == "6 runs written to runs.csv and runs.parquet\n"
        rows = list(csv.DictReader((lab_with_runs / "runs.csv").open()))
        table = pq.read_table(lab_with_runs / "runs.parquet").to_pylist()
        runs = json.loads(ask("--json", "--sort", "path").stdout)["runs"]
        assert table == runs
        assert [float(row["rmse_alpha_h"]) for row in rows] == [r["rmse_alpha_h"] for r in runs]
        refused = ask("--csv", "runs.csv", code=2)
        assert "nothing is overwritten" in refused.stderr
        ask("--csv", "runs.csv", "--force")
        printed = list(csv.reader(io.StringIO(ask("--csv", "-", "--columns", "seed").stdout)))
        assert printed[0] == ["seed"]
        assert len(printed) == 7

    @pytest.mark.parametrize("width", [40, 80, 160])
    def test_a_terminal_of_any_width(self, lab_with_runs, in_terminal, width):
        index = str(lab_with_runs / ".index")
        screen = in_terminal("runs", size=(40, width), TRMS_RUNS=index, NO_COLOR="1")
        assert screen.end() == 0
        assert max(map(len, screen.lines)) <= width and screen.lines[-1] == "6 runs"
        assert any("pid" in line for line in screen.lines)
        assert not any("…" in line for line in screen.lines)

    def test_it_starts_without_what_is_heavy(self, lab_with_runs, ask):
        ask("--rebuild")  # the logs are read
        code = "import trms_cli.cli as c; c.main(['runs', '--json', 'seed == 1'])"
        loaded = loaded_by(code, lab_with_runs, TRMS_RUNS=str(lab_with_runs / ".index"))
        slow = {"numpy", "scipy", "casadi", "hydra", "omegaconf", "rich", "pyarrow", "mcap", "yaml"}
        assert not loaded & slow


class TestWrong:
    """What cannot be answered says why."""

    @pytest.mark.parametrize(
        ("argv", "hint"),
        [
            (["rmse_yw < 1"], "did you mean rmse_yaw"),
            (["controller == pid"], "quoted: 'pid'"),
            (["controller", "==", "pid"], "in quotes"),
            (["sweep"], "--in sweep"),
            (["--in", "nowhere"], "there is no folder"),
            (["--sort", "rmse_yw"], "did you mean rmse_yaw"),
            (["--columns", "controler"], "did you mean controller"),
            (["--limit", "-1"], "less than none"),
            (["--force"], "--force goes with"),
            (["--all", "--in", "sweep"], "--all goes without"),
            (["__import__('os').system('touch hacked') == 0"], "nothing is called"),
        ],
    )
    def test_it(self, lab_with_runs, refused, monkeypatch, tmp_path_factory, argv, hint):
        monkeypatch.setenv("TRMS_RUNS", str(tmp_path_factory.mktemp("index")))
        refused("runs", *argv, words=hint)
