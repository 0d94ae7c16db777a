"""``trms watch``: pictures that fit, a terminal that is left as it was, runs that go on or die."""

import functools
import json
import math
import os
import re
import shutil
import signal
import subprocess
import termios
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rich.text import Text

from tests.cli.terminal import NORMAL
from tests.program import INSTALLED, in_process, loaded_by, wait_for
from trms_cli.commands.watch.frame import (
    NAMES,
    About,
    Player,
    TerminalCurve,
    View,
    about,
    chart,
    plain_line,
    run_frame,
    scale,
)
from trms_cli.commands.watch.screen import keys_in
from trms_cli.commands.watch.sweep import sweep_frame, sweep_line
from trms_cli.core.wording import SIGNALS
from trms_cli.runs.follower import AxisMoment, Event, Input, Moment, RunFollower, Solver
from trms_cli.runs.query import latest_run
from trms_cli.sweeps.outcome import Job, SweepFollower, SweepState, _values
from trms_cli.sweeps.record import drive_sweep


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with a run of 6 s and a sweep of four."""
    folder = tmp_path_factory.mktemp("lab")
    sweep = ("-m", "controller=pid,lqr", "seed=1,2", "launcher.workers=0", "out=sweep")
    one = ("controller=lqr", "effect=yaw_coulomb_friction", "out=one")
    for argv in ((*sweep, "sim.duration=2"), (*one, "sim.duration=6")):
        in_process(folder, "run", *argv, "picture=false", TRMS_RUNS="off")
    return folder


@pytest.fixture
def there(made, trms, tmp_path):
    """Run ``trms watch`` beside a copy of them."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    os.utime(tmp_path / "one" / "run.mcap")  # the latest

    def watch(*argv: str, code: int = 0):
        result = trms("watch", *argv, TRMS_RUNS="off", LINES="25", COLUMNS="80", code=code)
        return result.stdout if code == 0 else result.stderr

    return watch


def a_view(axes: int = 2, events: int = 5, words: str = "", **changes) -> View:
    """A run at 12.5 s with everything that a run can have."""
    t = np.arange(0.0, 12.5, 0.02)
    figures = (0.3, 0.29, 0.291, 0.2905, 0.009, 0.12)
    names = ["alpha_v", "alpha_h", "omega_v", "third 出力"][:axes]
    moment = Moment(
        time=12.5,
        speed=37.2,
        axes=tuple(
            AxisMoment(name, "rad", *figures, t, np.sign(np.sin(t)), np.sin(t)) for name in names
        ),
        inputs=(
            Input("u_v", "V", 2.5, -2.5, 2.5, True, 0.25),
            Input("u_h", "V", -0.7, -2.5, 2.5, False, 0.0),
            Input("u_free", "V", math.nan, -math.inf, math.inf, False, math.nan),
        ),
        solver=Solver(
            3.0, 41.5, 20.0, 600, 7, 2, 3.0, "failed", words, "degraded", "missing alpha_h"
        ),
        events=tuple(Event(i, "fault", "plant", f"happening {i} {words}") for i in range(events)),
        event_count=events,
    )
    what = About(f"newton_mpc · ref square {words}", "effects x", f"runs/{words}/run.mcap", 80.0)
    return View(
        **({"moment": moment, "state": "running", "keys": "q quit", "about": what} | changes)
    )


def text_of(lines: list[Text]) -> str:
    return "\n".join(line.plain for line in lines)


class TestFrame:
    def test_of_80_by_24_has_everything(self):
        text = text_of(run_frame(a_view(), 80, 24))
        for words in (
            "newton_mpc", "running", "effects x", "run.mcap", "12.5 / 80 s", "16 %", "37.2×",
            "reference", "measured", "state", "estimate", "error", "RMSE",
            "0.3000", "0.2900", "0.2910", "0.2905", "0.0090", "0.1200", "pitch", "yaw",
            "main rotor", "2.5000 V", "at a limit 25.0 %", "-0.7000 V",
            "3 ms now", "41.5 ms p99", "of 20 ms", "7 missed", "failed", "degraded",
            "missing alpha_h", "2 fall-backs", "happening 4", "q quit",
        ):  # fmt: skip
            assert words in text
        assert sum("⠀" < sign <= "⣿" for sign in text) > 100
        assert "0.0 s" in text and "20.0 s" in text  # of the curves

    @settings(max_examples=80, deadline=None)
    @given(
        width=st.integers(1, 200),
        height=st.integers(1, 60),
        axes=st.integers(0, 4),
        events=st.integers(0, 8),
        words=st.text(max_size=40),
        plain=st.booleans(),
        state=st.sampled_from(["running", "completed", "failed", "died", "unfinished"]),
        replay=st.sampled_from(["", "replay 4×"]),
        silent=st.sampled_from([0.0, 100.0]),
    )
    def test_fits_whatever_it_shows(
        self, width, height, axes, events, words, plain, state, replay, silent
    ):
        view = a_view(axes, events, words, state=state, replay=replay, silent=silent)
        lines = run_frame(view, width, height, plain=plain)
        assert 0 < len(lines) <= height
        for line in lines:
            assert line.cell_len <= width
            assert line.plain.isprintable()
            assert not plain or line.plain.isascii()

    def test_a_small_terminal_keeps_the_figures_and_a_large_one_has_more(self):
        text = text_of(run_frame(a_view(), 80, 12))
        assert "RMSE" in text and "7 missed" in text and "q quit" in text
        assert "⣀" not in text
        small, large = run_frame(a_view(), 80, 24), run_frame(a_view(), 160, 50)
        assert len(small) <= 24 < len(large) <= 50
        assert max(line.cell_len for line in large) == 160

    @pytest.mark.parametrize(
        ("state", "words"),
        [("died", "nobody writes it"), ("failed", "failed"), ("interrupted", "interrupted")],
    )
    def test_says_how_a_run_ended(self, state, words):
        assert words in text_of(run_frame(a_view(state=state), 80, 24))
        assert words in plain_line(a_view(state=state))

    def test_says_that_nothing_comes_and_leaves_out_what_a_run_does_not_have(self):
        assert "no sample for 12 s" in text_of(run_frame(a_view(silent=12.0), 100, 24))
        assert "no sample for" not in text_of(run_frame(a_view(silent=1.0), 100, 24))
        moment = Moment(0.0, math.nan, (), (), None, (), 0)
        text = text_of(run_frame(View(About("x", "", "l", None), moment, "running"), 80, 24))
        assert "no sample yet" in text and "nan" not in text and "solver" not in text

    def test_what_a_run_is(self):
        choices = {"controller": "lqr", "ref": "sine", "observer": "ekf", "plant": "simulated",
                   "model": "newtonian", "effect": ["a", "b"], "fault": []}  # fmt: skip
        found = about(choices, {"loop": "closed"}, "run.mcap", 1.0)
        assert found.what.startswith("lqr · ref sine · observer ekf · plant simulated")
        assert found.extras == "effects a+b"
        assert "ref" not in about(choices, {"loop": "open"}, "run.mcap", 1.0).what
        assert about({}, {"file": "rig.csv"}, "run.mcap", 1.0).what == "rig.csv"
        replayed = about(choices, {"recording.file": "rig.csv"}, "run.mcap", 1.0)
        assert replayed.what == "rig.csv · observer ekf · model newtonian"
        assert {name: SIGNALS[name] for name in NAMES} == NAMES


class TestChart:
    @settings(max_examples=60, deadline=None)
    @given(
        values=st.lists(st.floats(-50, 50) | st.just(math.nan), min_size=1, max_size=60),
        columns=st.integers(1, 60),
        rows=st.integers(1, 10),
        plain=st.booleans(),
    )
    @example(values=[math.nan, 0.0, math.nan], columns=58, rows=1, plain=False)  # at an edge
    def test_has_its_size_and_a_dot_where_there_are_values(self, values, columns, rows, plain):
        v = np.array(values)
        t = np.linspace(0.0, 10.0, len(v))
        limits = scale(v)
        present = v[~np.isnan(v)]
        if present.size:
            assert limits[0] <= present.min() + 1e-9 and present.max() - 1e-9 <= limits[1]
        cells = chart(
            t, (TerminalCurve(v, "", "*"),), (0.0, 10.0), limits, (columns, rows), plain=plain
        )
        assert [len(row) for row in cells] == [columns] * rows
        drawn = {i for row in cells for i, cell in enumerate(row) if cell.sign != " "}
        expected = {min(int(x / 10.0 * columns), columns - 1) for x in t[~np.isnan(v)]}
        assert expected <= drawn

    def test_a_rising_line_rises(self):
        t = np.linspace(0.0, 1.0, 100)
        cells = chart(t, (TerminalCurve(t, "", "*"),), (0.0, 1.0), (0.0, 1.0), (10, 10), plain=True)
        rows = ["".join(cell.sign for cell in row) for row in cells]
        assert rows[0].rstrip().endswith("*") and rows[-1].startswith("*")
        for column in range(9):
            highest = [
                next(i for i, row in enumerate(rows) if row[c] == "*") for c in (column, column + 1)
            ]
            assert highest[1] <= highest[0]

    def test_one_line_without_holes_and_a_hole_where_samples_are_missing(self):
        t = np.linspace(0.0, 10.0, 500)
        lost = (t > 4.0) & (t < 6.0)
        for keep, holes in ((t >= 0, 0), (~lost, 1)):
            v = np.where(keep, 0.5, np.nan)
            row = chart(t, (TerminalCurve(v, "", "*"),), (0.0, 10.0), (0.0, 1.0), (50, 1))[0]
            text = "".join(cell.sign for cell in row)
            assert len(re.findall(" +", text.strip())) == holes

    def test_of_dots(self):
        # 2 × 4 dots: a line along the lowest row, and one along the highest
        t = np.linspace(0.0, 1.0, 50)
        curves = (TerminalCurve(np.zeros(50), "a", "-"), TerminalCurve(np.ones(50), "b", "*"))
        row = chart(t, curves, (0.0, 1.0), (0.0, 1.0), (3, 1))[0]
        assert [cell.sign for cell in row] == ["⣉"] * 3
        assert row[0].style == "b"  # the later one lies over the earlier one


@pytest.mark.parametrize(
    ("sent", "keys"),
    [
        ("q", ["q"]),
        ("\x1b[C\x1b[D", ["right", "left"]),
        ("+\x1bOC ", ["+", "right", " "]),
        ("\x1b[H\x1b[F", ["home", "end"]),
        ("\x1b[15~q", ["q"]),
        ("\x1b", []),
    ],
)
def test_keys(sent, keys):
    assert keys_in(sent) == keys


class TestPlayer:
    @pytest.fixture
    def player(self, made):
        run = RunFollower(made / "one" / "run.mcap")
        yield Player(run, live=False, speed=2.0, begin=1.0, span=20.0)
        run.close()

    @pytest.mark.parametrize(
        "steps",
        [
            # what is pressed, how long is waited (s), and where one is then (s)
            [("", 0.5, 2.0), ("+", 0.5, 4.0), ("-", 0.25, 4.5), ("", 10.0, 5.98)],
            [(" ", 1.0, 1.0), ("right", 0.0, 5.98), ("left", 0.0, 0.98), ("end", 0.0, 5.98)],
            [(" ", 0.0, 1.0), ("home", 0.0, 0.0)],
        ],
        ids=["speed", "pause and seek", "home"],
    )
    def test_goes_where_it_is_told(self, player, steps):
        for key, seconds, place in steps:
            assert not key or player.press(key)
            player.advance(seconds)
            assert player.position == pytest.approx(place)
            assert player.at_end == (place == 5.98)
        assert player.press("x") and not player.press("q")

    def test_a_moment_seen_again_is_the_same(self, player):
        player.advance(1.0)
        first = text_of(run_frame(player.view(keys=False), 80, 24))
        player.press("end")
        player.press("home")
        player.advance(1.5)
        assert text_of(run_frame(player.view(keys=False), 80, 24)) == first


class TestOnce:
    def test_of_the_latest_run_with_the_figures_of_its_score(self, there, tmp_path):
        text = there("--once")
        score = json.loads((tmp_path / "one" / "score.json").read_text())
        for name, label in (("alpha_v", "pitch"), ("alpha_h", "yaw")):
            rmse = f"{score['channels'][name]['rmse']:.4f}"
            assert re.search(rf"{label} .* {rmse}$", text, re.M)
        assert "lqr · ref square" in text and "yaw_coulomb_friction" in text
        assert "completed" in text and "6.0 / 6 s" in text
        lines = text.splitlines()
        assert len(lines) <= 24 and max(map(len, lines)) <= 80
        assert "\x1b" not in text

    @pytest.mark.parametrize("what", ["one", "one/run.mcap"])
    def test_of_a_moment(self, there, what):
        assert "3.0 / 6 s" in there(what, "--once", "--from", "3")

    def test_without_unicode(self, there, program):
        assert there("one", "--once", "--plain").isascii()
        shown = program("watch", "one", "--once", PYTHONIOENCODING="ascii").stdout
        assert "RMSE" in shown and shown.isascii()

    def test_is_quick_and_without_hydra(self, there, tmp_path):
        loaded = loaded_by("import trms_cli.cli as c; c.main(['watch', 'one', '--once'])", tmp_path)
        assert not loaded & {"hydra", "omegaconf", "casadi", "scipy", "matplotlib", "pyarrow"}


class TestLines:
    """Without a terminal."""

    def test_a_line_now_and_then_and_the_last_one(self, there):
        lines = there("one", "--speed", "4").splitlines()
        assert 2 <= len(lines) <= 5
        assert lines[0].startswith("0.0 s of 6") and lines[-1].startswith("6.0 s of 6")
        assert "pitch" in lines[0] and "RMSE" in lines[0] and "completed" in lines[-1]

    def test_a_reader_that_leaves(self, there, tmp_path):
        line = f"'{INSTALLED}' watch one --speed 2 | head -1"
        result = subprocess.run(
            line, shell=True, cwd=tmp_path, capture_output=True, text=True, timeout=30
        )
        assert result.stdout.count("\n") == 1 and result.stderr == ""


class TestWrong:
    """What cannot be watched is told, with exit code 2."""

    @pytest.mark.parametrize(
        ("argv", "words"),
        [
            (["--speed", "0"], "--speed"),
            (["--speed", "-1"], "--speed"),
            (["--speed", "nan"], "--speed"),
            (["--speed", "fast"], "--speed"),
            (["--span", "0"], "--span"),
            (["--from", "-3"], "--from"),
            (["one", "--from", "60"], "the run ends at 5.98 s"),
            (["nothing"], "there is no such file"),
            (["one/score.json"], "not an MCAP file"),
            (["sweep", "--speed", "2"], "not replayed"),
            (["empty"], "there is no run in it"),
            (["empty.mcap"], "the file is empty"),
            (["--sped", "2"], "did you mean --speed"),
        ],
    )
    def test_is_told(self, made, tmp_path, refused, argv, words):
        for name in ("one", "sweep"):
            (tmp_path / name).symlink_to(made / name)
        (tmp_path / "empty").mkdir()
        (tmp_path / "empty.mcap").touch()
        refused("watch", *argv, words=words)

    def test_no_run_at_all(self, refused, monkeypatch):
        monkeypatch.setenv("TRMS_RUNS", "off")
        refused("watch", words="there is no run under this folder")


@pytest.fixture
def on_screen(there, in_terminal):
    return functools.partial(in_terminal, "watch")


class TestTerminal:
    @pytest.mark.parametrize(("how", "code"), [("q", 0), ("ctrl-c", 130), ("sigterm", 143)])
    def test_is_left_as_it_was(self, on_screen, how, code):
        screen = on_screen("one", "--speed", "0.5")
        assert screen.read(20.0, b"RMSE")
        assert termios.tcgetattr(screen.slave) != screen.before  # keys come one by one
        if how == "sigterm":
            screen.process.send_signal(signal.SIGTERM)
        else:
            screen.type(b"q" if how == "q" else b"\x03")
        assert screen.end() == code
        assert screen.is_as_it_was()
        assert b"Traceback" not in screen.shown

    def test_keys_pause_and_seek(self, on_screen):
        screen = on_screen("one", "--speed", "0.1")
        assert screen.read(20.0, b"replay 0.1")
        screen.type(b" ")
        assert screen.read(5.0, b"paused")
        screen.type(b"\x1b[C\x1b[C")
        assert screen.read(5.0, b"6.0 / 6 s")
        screen.type(b"q")
        assert screen.end() == 0
        last = screen.shown.rpartition(NORMAL)[2].decode()
        assert "6.0 / 6 s" in last and "q quit" not in last  # the last picture stays


def test_a_run_that_goes_on_is_found_followed_and_told_when_killed(
    started, on_screen, there, tmp_path, monkeypatch
):
    monkeypatch.setenv("TRMS_RUNS", "off")
    words = ("controller=newton_mpc", "sim.duration=20000", "picture=false", "out=long")
    process, log = started("run", *words), tmp_path / "long" / "run.mcap"
    wait_for(lambda: log.exists() and log.stat().st_size > 50_000)
    if RunFollower(log).state == "unfinished":
        pytest.skip("this system does not tell who writes a file")
    os.utime(tmp_path / "one" / "run.mcap")  # a later one, but not running
    found = latest_run(tmp_path)
    assert found is not None and found.running and found.log == log
    assert "running" in there("--once").splitlines()[0]
    screen = on_screen()
    assert screen.read(20.0, b"running") and screen.read(5.0, b"/ 20000 s")
    process.kill()
    process.wait()
    assert screen.end() == 1
    assert screen.is_as_it_was()
    last = screen.shown.rpartition(NORMAL)[2].decode()
    assert "died: its log has no end, and nobody writes it" in last
    assert "died" in there("long", "--once")


class TestSweep:
    @pytest.fixture
    def folder(self, tmp_path) -> Path:
        folder = tmp_path / "sweep"
        for job in range(4):
            (folder / str(job)).mkdir(parents=True)
        (folder / "multirun.yaml").write_text(
            "hydra:\n  sweeper:\n    _target_: x.BasicSweeper\n    params: null\n"
            "  overrides:\n    task:\n"
            "    - controller=pid,lqr\n    - seed=range(1,4)\n    - ref=sine\n"
            "  verbose: false\nsim:\n  duration: 1\n"
        )
        return folder

    @staticmethod
    def say(folder: Path, job: int, at: float | None = None, **words) -> None:
        file = folder / str(job) / "status.json"
        given = ["controller=pid", f"seed={job}", "ref=sine"]
        status = {"schema": "trms.status/1", "job": job, "overrides": given}
        file.write_text(json.dumps(status | words))
        if at is not None:
            os.utime(file, (at, at))

    def test_progress(self, folder):
        now = time.time()
        sweep = SweepFollower(folder)
        for job in range(2):
            self.say(folder, job, now - 20 + 10 * job, state="done", objective=0.5 - 0.1 * job)
        self.say(folder, 2, now, state="failed", error={"problem": "no way\nat all"})
        self.say(folder, 3, now, state="running", pid=os.getpid())
        seen = sweep.now()
        assert (seen.total, len(seen.jobs), seen.has_ended) == (6, 4, False)
        assert [job.state for job in seen.jobs] == ["done", "done", "failed", "running"]
        assert seen.rate == pytest.approx(0.1) and seen.left_s == pytest.approx(30.0)
        text = text_of(sweep_frame(seen, 80, 24))
        for words in (
            "2 / 6 done", "1 running", "1 failed", "6 jobs/min", "30 s left",
            "1  0.4 ", "controller=pid seed=1", "no way",
        ):  # fmt: skip
            assert words in text
        assert "ref=sine" not in text and "at all" not in text
        assert sweep_line(seen).startswith("2 of 6 done | 1 failed | 1 running | 6 jobs/min")

    def test_a_job_whose_process_is_gone(self, folder):
        ended = subprocess.Popen(["true"])
        ended.wait()
        self.say(folder, 0, state="running", pid=ended.pid)
        seen = SweepFollower(folder).now()
        assert seen.count("gone") == 1 and seen.has_ended
        assert "died" in text_of(sweep_frame(seen, 80, 24))

    def test_a_sweep_whose_driver_has_gone(self, folder):
        record = {"schema": "trms.sweep/1", "overrides": [], "state": "running"}
        (folder / "sweep.json").write_text(json.dumps(record))
        self.say(folder, 0, 100.0, state="done", objective=1.0)
        self.say(folder, 1, 110.0, state="interrupted")
        self.say(folder, 2, 120.0, state="interrupted")
        sweep = SweepFollower(folder)
        with drive_sweep(folder):
            assert sweep.now().state == "running" and not sweep.now().has_ended
            (folder / "sweep.json").write_text(json.dumps(record | {"total": 200}))
        seen = sweep.now()
        assert seen.stopped and seen.has_ended and seen.total == 200
        text = text_of(sweep_frame(seen, 80, 24))
        for words in (
            "stopped before its end", "0 running  2 interrupted  197 not begun", "sweep resume",
        ):  # fmt: skip
            assert words in text
        assert "left" not in text
        assert "stopped before its end" in sweep_line(seen) and "left" not in sweep_line(seen)

    @pytest.mark.parametrize(
        ("state", "words"), [("done", "ended"), ("interrupted", "stopped before its end")]
    )
    def test_the_end_is_what_the_record_says(self, folder, state, words):
        record = {"schema": "trms.sweep/1", "overrides": [], "state": state, "total": 1}
        (folder / "sweep.json").write_text(json.dumps(record))
        sweep = SweepFollower(folder)
        self.say(folder, 0, 100.0, state="running", pid=os.getpid())
        assert sweep.now().count("running") == 1
        self.say(folder, 0, 110.0, state="done", objective=1.0)
        assert sweep.now().count("done") == 1  # what has changed is seen
        assert words in text_of(sweep_frame(sweep.now(), 80, 24))

    @settings(max_examples=40, deadline=None)
    @given(width=st.integers(1, 150), height=st.integers(1, 50), plain=st.booleans())
    def test_fits(self, width, height, plain):
        jobs = tuple(
            Job(str(i), state, ("a=1", f"b={i}"), 1.0, "a problem " * 9, 100.0 + i)
            for i, state in enumerate(5 * ("done", "failed", "running", "interrupted"))
        )
        seen = SweepState(Path("a/folder"), ("a=1",), 30, jobs, 0.3, 200.0)
        lines = sweep_frame(seen, width, height, plain=plain)
        assert 0 < len(lines) <= height and all(line.cell_len <= width for line in lines)
        assert not plain or all(line.plain.isascii() for line in lines)

    def test_of_a_stranger(self, folder):
        for job, text in enumerate(['{"schema": 3}', "[", "null", '{"schema": "trms.status/1"}']):
            (folder / str(job) / "status.json").write_text(text)
        seen = SweepFollower(folder).now()
        assert len(seen.jobs) == 1
        assert sweep_frame(seen, 80, 24)

    @pytest.mark.parametrize(
        "text",
        ["1", "a,b", "[a,b]", "[a,b],[c]", "'a,b',c", "range(1,5)", "range(5)", "range(0,1,0.25)",
         "choice(a,b,c)", "{a:1,b:2}", "range(5,1,-2)", "null,1.5"],
    )  # fmt: skip
    def test_jobs_are_counted_as_hydra_does(self, text):
        from hydra.core.override_parser.overrides_parser import OverridesParser

        override = OverridesParser.create().parse_override(f"key={text}")
        count = len(list(override.sweep_string_iterator())) if override.is_sweep_override() else 1
        assert _values(text) == count

    @pytest.mark.parametrize(
        "text", ["glob(*)", "interval(0,1)", "shuffle(a,b)", "range(start=1,stop=3)"]
    )
    def test_what_only_hydra_can_count_is_not_known(self, text):
        assert _values(text) is None
