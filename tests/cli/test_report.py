"""``trms report`` as a person meets it: on a run, on two, on a sweep, on what is broken."""

import json
import os
import re
import shutil
from html import unescape
from pathlib import Path

import numpy as np
import pytest

from trms_cli.cli import main
from trms_cli.recordings.run_log import RunLog
from trms_cli.recordings.topics import Field, standard_topics

QUICK = ("observer=full_state", "plant=ideal", "sim.duration=3", "picture=false")
FIELD = "<img src=x onerror=window.harmed=1>"  # a field's name may hold no quotes
ATTACK = '"><img src=x onerror=window.harmed=1><script>window.harmed=1</script>'


@pytest.fixture(scope="module")
def lab(tmp_path_factory) -> Path:
    """Two runs, and a sweep of eight jobs of which four fail."""
    folder = tmp_path_factory.mktemp("lab")

    def run(*argv: str, out: str) -> int:
        return main(["run", *argv, *QUICK, f"out={folder / out}"])

    assert run("controller=lqr", out="first") == 0
    assert run("controller=pid", out="second") == 0
    choices = ("controller=lqr,pid", "ref=square,sine", "controller.sample_time=null,0.03")
    assert run("-m", *choices, "launcher.workers=0", out="sweep") == 1
    return folder


@pytest.fixture
def here(lab, tmp_path, monkeypatch) -> Path:
    """A copy of the lab as the working folder."""
    place = tmp_path / "lab"
    shutil.copytree(lab, place)
    monkeypatch.chdir(place)
    return place


#: What the pages of the lab's runs are called by, before the run's name.
WHAT = "lqr on square, model newtonian, plant ideal (newtonian)"


def report(*argv: str) -> int:
    """Run the command in this process."""
    return main(["report", *argv])


def told_of(capsys, *argv: str) -> dict:
    """The JSON document of a page that is made."""
    capsys.readouterr()
    assert report(*argv, "--json") == 0
    document: dict = json.loads(capsys.readouterr().out)
    return document


def page_of(folder: str) -> str:
    return Path(folder, "report.html").read_text(encoding="utf-8")


def section_of(folder: str, heading: str) -> str:
    """A part of a folder's page."""
    return page_of(folder).partition(f">{heading}</h2>")[2].partition("</section>")[0]


def title(page: Path) -> str:
    return unescape(re.search("<title>(.*?)</title>", page.read_text(encoding="utf-8"))[1])


class TestWhatItIsOf:
    def test_a_run(self, here, capsys):
        assert report("first") == 0
        text = page_of("first")
        assert title(here / "first/report.html") == f"{WHAT}: first"
        assert "<h2>Angles and commands</h2>" in text and "<h2>Score</h2>" in text
        said = capsys.readouterr().out
        assert "report     first/report.html  (run: a run" in said and "next  " in said
        assert "lqr followed pitch to" in said
        markup = re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)
        assert re.search(r'(src|href)="(?!#|data:|\./)', markup) is None and "http:" not in markup
        told = told_of(capsys, "first", "--force")
        assert told["schema"] == "trms.report/1" and told["kind"] == "run"
        assert told["runs"] == ["first/run.mcap"] and told["file"] == "first/report.html"
        assert told["bytes"] == (here / "first/report.html").stat().st_size

    @pytest.mark.parametrize(
        ("given", "page", "name"),
        [
            ("first/score.json", "first/report.html", f"{WHAT}: first"),
            ("monday.mcap", "report.html", f"{WHAT}: monday"),
            ("two", "two/report.html", "Comparison of a and b"),
        ],
    )
    def test_is_told_from_where_it_lies(self, here, given, page, name):
        shutil.copy("first/run.mcap", "monday.mcap")
        shutil.copytree("first", "two/a")
        shutil.copytree("second", "two/b")
        assert report(given) == 0
        assert title(here / page) == name

    def test_two_runs(self, here):
        assert report("first", "second/run.mcap", "--out", "both.html", "--title", "Two") == 0
        assert title(here / "both.html") == "Two"
        text = (here / "both.html").read_text(encoding="utf-8")
        assert "<h2>How they differ</h2>" in text and "<h2>Tracking</h2>" in text
        row = re.search(r'<th scope="row">controller</th>(.*?)</tr>', text)
        assert re.findall(r">(\w+)</td>", row[1]) == ["lqr", "pid"]

    def test_few_runs_of_a_sweep_are_a_sweep(self, here, capsys):
        shutil.copytree("sweep/0", "few/0")
        shutil.copytree("sweep/4", "few/1")
        Path("few/sweep.json").write_text(json.dumps({"schema": "trms.sweep/1", "total": 5}))
        told = told_of(capsys, "few")
        assert told["kind"] == "sweep" and title(here / "few/report.html") == "Sweep few"
        # what was asked counts, not what came of it
        assert told["lead"][0].startswith("2 of 5 runs completed; 3 not begun")

    def test_drawn_rigs_are_conditions_and_no_entrants(self, here, capsys):
        drawn = ("plant=simulated", "plant.parameters.k_g=prior", "plant.parameters.k_m=prior")
        sampler = ("sampler=random", "sampler.samples=3", "sampler.limits.rmse_yaw=0.001")
        argv = ("-m", "controller=lqr,pid", *drawn, *sampler, "sim.duration=2", "picture=false")
        argv += ("launcher.workers=0", "observer=full_state", "out=drawn")
        assert main(["run", *argv]) == 0
        told = told_of(capsys, "drawn")
        assert told["kind"] == "sweep"
        assert "lqr 3 of 3 (100.0 %" in told["lead"][2] and "rmse_yaw ≤ 0.001" in told["lead"][2]
        ranking = section_of("drawn", "Ranking")
        assert "on the same draw;" in ranking and "k_g" not in ranking
        assert set(re.findall(r'<th scope="row">([a-z]+)</th>', ranking)) == {"lqr", "pid"}

    def test_a_sweep_with_failures(self, here, capsys):
        assert report("first", "--out", "sweep/0/report.html") == 0
        assert report("sweep") == 0
        assert page_of("sweep").count("<tr><td>") == 8
        assert "4 of 8 runs completed; 4 failed." in capsys.readouterr().out
        assert "0.03" in section_of("sweep", "What failed")
        assert '<a href="./0/report.html">0</a>' in page_of("sweep")
        # the reports of single runs are no runs, and change nothing
        assert report("sweep", "--force") == 0

    def test_an_optimisation_has_its_front(self, here):
        objectives = [{"figure": "rmse_alpha_h", "direction": "minimize"}, "effort"]
        plan = {"schema": "trms.sweep/1", "objectives": objectives, "pareto": [0, 2]}
        Path("sweep/sweep.json").write_text(json.dumps(plan))
        assert report("sweep") == 0
        section = section_of("sweep", "Objectives")
        assert "the least rmse_yaw, the least effort" in section
        assert set(re.findall(r'<tr><th scope="row">(\d)</th>', section)) == {"0", "2"}

    def test_a_search_under_several_conditions_shows_its_trials(self, here):
        trials = [
            {"trial": n, "values": {"gain": 0.5 * n}, "allowed": True,
             "figures": {"rmse": 1.0 - 0.1 * n, "effort": n}}
            for n in range(3)
        ]  # fmt: skip
        trials.append({"trial": 3, "figures": {}, "problem": "it fell", "allowed": False})
        directions = {"rmse": "minimise", "effort": "maximise"}
        summary = {
            "objectives": [{"name": n, "direction": way} for n, way in directions.items()],
            "pareto": [2],
            "trials": trials,
            "history": [None, 0.5, 0.75],
        }
        plan = {"schema": "trms.sweep/1", "sampler": {"objectives": ["rmse"]}, "summary": summary}
        Path("sweep/sweep.json").write_text(json.dumps(plan))
        assert report("sweep") == 0
        section = section_of("sweep", "Objectives")
        assert "the least rmse, the largest effort" in section and "the best so far" in section
        rows = re.findall(r'<tr><th scope="row">(\d)</th><td class="number">(.*?)</td>', section)
        assert rows == [("2", "0.8")]

    @pytest.mark.parametrize(
        "plan",
        [
            "",
            "[",
            "[]",
            '{"schema": "trms.sweep/1", "objectives": 3, "pareto": "x"}',
            '{"schema": "trms.sweep/1", "objectives": [{}, 1, null], "pareto": [null, "x"]}',
        ],
    )
    def test_words_of_a_sweep_that_are_none_change_nothing(self, here, plan):
        Path("sweep/sweep.json").write_text(plan)
        assert report("sweep") == 0

    def test_scores_alone(self, here):
        for folder, controller in (("first", "lqr"), ("second", "pid")):
            score = json.loads(Path(folder, "score.json").read_text())
            score["run"] = {"coordinates": {"controller": controller, "ref": "square"}}
            os.makedirs(f"scores/{folder}")
            Path(f"scores/{folder}/score.json").write_text(json.dumps(score))
        assert report("scores") == 0
        assert "scores alone" in page_of("scores") and page_of("scores").count("<tr><td>") == 2


class TestWhatIsBroken:
    def test_nothing_is_overwritten_unasked(self, here, capsys):
        Path("first/report.html").write_text("mine")
        assert report("first") == 2 and page_of("first") == "mine"
        assert "--force" in capsys.readouterr().err
        assert report("first", "--force") == 0
        assert report("first", "--out", "first/report.html") == 2
        assert title(here / "first/report.html") == f"{WHAT}: first"

    @pytest.mark.parametrize(
        "argv, words",
        [
            (("nowhere",), "there is no such file or folder"),
            (("empty",), "there is no run here"),
            (("text.mcap",), "not an MCAP file"),
            (("first", "--out", "page.pdf"), "ends in .html"),
            (("first", "--out", "first/run.mcap/x.html"), "folder"),
            ((), "required"),
        ],
    )
    def test_what_cannot_be_used_is_told(self, here, capsys, argv, words):
        os.mkdir("empty")
        Path("text.mcap").write_text("hello")
        code = report(*argv)
        said = capsys.readouterr()
        assert code == 2 and re.search(words, said.err), said.err
        assert len(said.err.splitlines()) < 10 and not list(here.rglob("report.html"))

    def test_a_run_that_died_is_drawn_as_far_as_it_went(self, here, capsys):
        whole = Path("first/run.mcap").read_bytes()
        Path("first/run.mcap").write_bytes(whole[: len(whole) * 2 // 3])
        assert report("first") == 0
        assert "Incomplete: the file was not finished" in capsys.readouterr().out

    def test_an_unreadable_log_among_others_is_named(self, here, capsys):
        shutil.copytree("first", "mixed/a")
        shutil.copytree("second", "mixed/b")
        Path("mixed/c.mcap").write_bytes(b"hello")
        assert report("mixed") == 0
        assert "c.mcap" in capsys.readouterr().out

    def test_recordings_and_runs_without_a_reference_are_drawn(self, here, capsys):
        rows = "".join(f"{0.1 * i:.1f},1,0,{0.01 * i:.2f},0\n" for i in range(50))
        Path("mine.csv").write_text(f"t[s],u_v[V],u_h[V],alpha_v[rad],alpha_h[rad]\n{rows}")
        open_loop = ("controller=open_loop", "sim.duration=2", "picture=false", "out=open")
        assert main(["import", "mine.csv"]) == 0 and main(["run", *open_loop]) == 0
        for what in ("mine.mcap", "open"):
            capsys.readouterr()
            assert report(what) == 0
            assert "without a reference to follow" in capsys.readouterr().out

    def test_damage_anywhere_gives_a_page_or_a_message(self, here, capsys):
        whole = Path("first/run.mcap").read_bytes()
        generator = np.random.default_rng(3)
        for _ in range(25):
            hurt = bytearray(whole)
            for place in generator.integers(8, len(whole), 20):
                hurt[place] = int(generator.integers(256))
            Path("first/run.mcap").write_bytes(hurt)
            assert report("first", "--force") in (0, 2)
            assert "bug in trms" not in capsys.readouterr().err

    def test_a_giant_is_refused_before_it_is_read(self, here, capsys, monkeypatch):
        monkeypatch.setenv("TRMS_LARGEST_FILE", "0.01")
        assert report("first") == 2
        assert "are read" in capsys.readouterr().err


def hostile_log(path: Path) -> None:
    """A log that says what a stranger wants wherever it can say anything."""
    angle, volt = Field("alpha_h", "rad", ATTACK), Field("u_h", "V", ATTACK)
    own = Field(FIELD, ATTACK, ATTACK)
    topics = standard_topics(
        references=[angle],
        inputs=[volt, own],
        outputs=[angle, own],
        states=[angle, own],
        estimates=[angle],
    )
    said = json.dumps({"controller": ATTACK, "ref": ATTACK, ATTACK: [ATTACK]})
    run = dict.fromkeys(
        ("command", "seed", "git", "platform", "loop", "recording.file", ATTACK), ATTACK
    )
    run |= {
        "choices": said,
        "versions": json.dumps({"trms": ATTACK}),
        "limits": json.dumps({ATTACK: [0, 1]}),
        "overrides": json.dumps([f"controller={ATTACK}", f"{ATTACK}=1"]),
    }
    with RunLog(path, topics, run, {"config.yaml": ("text/yaml", ATTACK.encode())}) as log:
        for i in range(40):
            now = i * 100_000_000
            for topic in topics:
                row = [ATTACK if f.kind == "text" else float(np.sin(i)) for f in topic.fields]
                if topic.name != "/event":
                    log.write(topic.name, now, row)
            log.event(now, ATTACK, ATTACK, ATTACK, 1.0)


def test_a_strangers_words_stay_words(here, capsys):
    """In a log, its folder, a status and a sweep: no page holds them as markup."""
    folder = here / "strange" / ATTACK.replace("/", "∕")
    folder.mkdir(parents=True)
    hostile_log(folder / "run.mcap")
    hostile_log(here / "strange" / f"{ATTACK.replace('/', '∕')}.mcap")
    failed = here / "strange" / "job"
    failed.mkdir()
    status = {
        "schema": "trms.status/1",
        "job": ATTACK,
        "overrides": [f"controller={ATTACK}", ATTACK],
        "choices": {"controller": ATTACK},
        "state": "failed",
        "error": {"problem": ATTACK, "where": ATTACK, "remedy": ATTACK},
    }
    (failed / "status.json").write_text(json.dumps(status))
    (here / "strange" / "sweep.json").write_text(
        json.dumps({"schema": "trms.sweep/1", "command": ATTACK, "objectives": [ATTACK, "effort"]})
    )
    pages = [
        ((str(folder),), "run.html"),
        ((str(folder), str(here / "first")), "pair.html"),
        ((str(here / "strange"), "--title", ATTACK), "sweep.html"),
    ]
    for argv, name in pages:
        assert report(*argv, "--out", name) == 0, capsys.readouterr().err
        text = (here / name).read_text(encoding="utf-8")
        assert "<img" not in text and "<script>window" not in text
        assert "&lt;img src=x" in text  # it is there, as words
