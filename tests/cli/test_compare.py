"""``trms compare`` as a person meets it, on sweeps of short runs."""

import json
import shutil

import pytest

from tests.program import in_process

QUICK = ("observer=full_state", "plant=ideal", "sim.duration=4", "picture=false")


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """Two controllers × two references; and a sample time that both refuse."""
    folder = tmp_path_factory.mktemp("swept")
    words = ("controller=lqr,pid", "ref=square,sine", "controller.sample_time=null,0.03")
    in_process(folder, "run", "-m", *words, *QUICK, "launcher.workers=0", "out=there", code=1)
    return folder / "there"


class TestASweep:
    @pytest.fixture
    def found(self, trms, swept):
        return json.loads(trms("compare", str(swept), "--json").stdout)

    def test_is_ranked_by_what_differs(self, found, swept):
        assert found["schema"] == "trms.compare/1"
        assert found["by"] == ["controller", "controller.sample_time"]
        assert found["conditions_by"] == ["ref"]
        ranks = {entrant["name"]: entrant["rank"] for entrant in found["entrants"]}
        assert set(ranks.values()) == {1, 2, 3, 4}
        assert {ranks[f"{c} + sample_time=none"] for c in ("lqr", "pid")} == {1, 2}
        assert len(found["failed"]) == 4
        assert all("0.03" in job["message"] for job in found["failed"])
        error = json.loads((swept / "1" / "status.json").read_text())["error"]
        assert set(error) == {"type", "problem", "where", "remedy"}
        assert (error["type"], error["where"]) == ("ConfigurationError", "controller.sample_time")

    def test_its_errors_are_those_of_the_scores(self, found, swept):
        for entrant in found["entrants"]:
            for told in entrant["by_condition"]:
                if told["state"] == "done":
                    score = json.loads((swept.parent / told["path"] / "score.json").read_text())
                    rmse = sum(channel["rmse"] for channel in score["channels"].values())
                    assert told["error"] == pytest.approx(rmse, rel=1e-12)

    def test_the_table_states_the_rule_and_fits_100_columns(self, trms, swept):
        told = trms("compare", str(swept)).stdout.replace(str(swept), "")
        assert all(words in told for words in ("Ranked by tracking", "tracks best", "4 failed"))
        assert max(map(len, told.splitlines())) <= 100

    def test_where_and_by_choose(self, trms, swept):
        words = ("--where", "controller.sample_time=none", "--by", "ref", "--json")
        found = json.loads(trms("compare", str(swept), *words).stdout)
        assert {entrant["name"] for entrant in found["entrants"]} == {"ref square", "ref sine"}
        assert not found["failed"]

    def test_sorting_keeps_the_ranks(self, trms, swept, found):
        words = ("compare", str(swept), "--json", "--sort", "name")
        entrants = json.loads(trms(*words).stdout)["entrants"]
        assert [e["name"] for e in entrants] == sorted(e["name"] for e in entrants)
        usual = {e["name"]: e["rank"] for e in found["entrants"]}
        assert {e["name"]: e["rank"] for e in entrants} == usual

    def test_logs_that_were_given_other_names_count(self, trms, swept, tmp_path):
        for job in (0, 2, 4, 6):
            shutil.copy(swept / str(job) / "run.mcap", tmp_path / f"{job}.mcap")
        found = json.loads(trms("compare", str(tmp_path), "--json").stdout)
        assert found["by"] == ["controller"] and found["runs"] == 4


def test_two_logs_stand_side_by_side(trms, swept):
    one, other = str(swept / "0"), str(swept / "4" / "run.mcap")
    told = trms("compare", one, other).stdout
    assert "given differently" in told and "alpha_v RMSE" in told
    found = json.loads(trms("compare", one, other, "--json").stdout)
    assert found["schema"] == "trms.compare_pair/1"
    assert {row["key"] for row in found["differences"]} == {"controller"}


def test_a_log_that_was_cut_off_is_said_and_not_counted(trms, swept, tmp_path):
    for job in ("0", "4", "2"):
        shutil.copytree(swept / job, tmp_path / "runs" / job)
    cut = tmp_path / "runs" / "2" / "run.mcap"
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2])
    found = json.loads(trms("compare", "runs", "--json").stdout)
    assert [told["path"] for told in found["incomplete"]] == ["runs/2"]
    assert "1 incomplete, not counted" in trms("compare", "runs").stdout


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("nowhere",), "no such file or folder"),
        (("empty",), "there is no run here"),
        (("notes.txt",), "not an MCAP file"),
        (("empty", "--metric", "speed"), "invalid choice"),
        (("empty", "--where", "controller"), "no KEY=VALUE"),
        (("empty", "--bye", "x"), "did you mean --by"),
    ],
)
def test_errors_teach(refused, tmp_path, words, says):
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("no log\n")
    refused("compare", *words, words=says)


def test_one_run_alone_is_sent_to_score(refused, swept):
    refused("compare", str(swept / "0"), words="trms score")
