"""``trms run`` as a person meets it: what it prints and leaves behind, and what it answers."""

import json
import re
from pathlib import Path

import pytest
import yaml

from tests.program import installed
from trms_cli.recordings.log_reader import read_log

#: A short run that needs no solver to be compiled and no observer.
QUICK = ("controller=newton_mpc", "observer=full_state", "plant=ideal", "sim.duration=4")
#: The topics that a seed and a configuration fix.
SIMULATED = ("/reference", "/command", "/measurement", "/plant/state", "/estimate", "/prediction")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """One finished run with noise, a filter and a picture; its folder and what it printed."""
    folder = tmp_path_factory.mktemp("finished")
    words = ("controller=newton_mpc", "sim.duration=4", "seed=3", "out=there")
    result = installed(folder, "run", *words, COLUMNS="100")
    return folder / "there", result


def raw(log: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Log time and bytes of every message by topic, read by the mcap library alone."""
    from mcap.reader import make_reader

    found: dict[str, list[tuple[int, bytes]]] = {}
    with log.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            found.setdefault(channel.topic, []).append((message.log_time, message.data))
    return found


class TestWhatItLeaves:
    def test_the_screen_fits_a_terminal_and_tells_what_to_do_next(self, finished):
        _, result = finished
        lines = result.stdout.splitlines()
        # The commands at the end hold the path of the program, as long as that is.
        table = lines[: next(i for i, line in enumerate(lines) if line.startswith("next"))]
        assert max(map(len, table)) <= 100 and len(lines) <= 24
        for part in (
            *("tracking", "RMSE", "inputs", "estimate", "solver", "× real time"),
            *("there/run.mcap", "there/run.png", "trms score there/run.mcap"),
        ):
            assert part in result.stdout
        assert result.stderr == ""  # no progress where nobody watches

    def test_log_score_and_picture(self, finished, trms):
        folder, _ = finished
        files = sorted(file.name for file in folder.iterdir())
        assert files == ["run.mcap", "run.png", "score.json"]
        picture = (folder / "run.png").read_bytes()
        assert picture.startswith(b"\x89PNG") and len(picture) > 20_000
        score = json.loads((folder / "score.json").read_text(encoding="utf-8"))
        assert score["schema"] == "trms.score/1" and score["complete"] is True
        assert score["duration_s"] == 4.0 and set(score["channels"]) == {"alpha_v", "alpha_h"}
        # the score equals what `trms score` reads from the log
        again = json.loads(trms("score", str(folder / "run.mcap"), "--json").stdout)
        for group in ("channels", "inputs"):
            for name, figures in score[group].items():
                for key, value in figures.items():
                    expected = pytest.approx(value, 1e-9) if isinstance(value, float) else value
                    assert again[group][name][key] == expected

    def test_the_log_says_what_it_is(self, finished):
        log = read_log(finished[0] / "run.mcap")
        assert log.complete and log.outcome == "completed" and log.run["seed"] == "3"
        assert log.run["command"].endswith("seed=3 out=there")
        assert {"trms", "python", "numpy", "casadi"} <= set(json.loads(log.run["versions"]))
        assert yaml.safe_load(log.config)["sim"]["duration"] == 4.0
        assert "parameters.yaml" in log.attachments and log.score["schema"] == "trms.score/1"

    def test_without_a_folder_named_it_is_dated(self, trms, tmp_path):
        trms("run", *QUICK, "picture=false", "sim.duration=0.02")  # a run of one sample
        (log,) = tmp_path.glob("outputs/*/*-run/run.mcap")
        assert re.fullmatch(r"\d\d-\d\d-\d\d-run", log.parent.name)


class TestTheSameAgain:
    """A run is a pure function of configuration and seed."""

    @pytest.mark.parametrize("seed", [3, 4])
    def test_the_seed_decides_every_byte(self, finished, trms, tmp_path, seed):
        words = ("controller=newton_mpc", "sim.duration=4", f"seed={seed}", "picture=false")
        trms("run", *words, "out=again")
        first, second = raw(finished[0] / "run.mcap"), raw(tmp_path / "again" / "run.mcap")
        assert all(first[topic] for topic in SIMULATED)
        differ = {topic for topic in SIMULATED if first[topic] != second[topic]}
        assert differ == set() if seed == 3 else "/measurement" in differ
        assert "/reference" not in differ

    def test_from_a_log(self, finished, trms, tmp_path):
        log = finished[0] / "run.mcap"
        result = trms("run", "--from", str(log), "out=again", "picture=false")
        assert result.stderr == ""
        swept = ("-m", "seed=3,4", "launcher.workers=0", "picture=false", "out=swept")
        trms("run", "--from", str(log), *swept)
        first, second = raw(log), raw(tmp_path / "again" / "run.mcap")
        assert all(first[topic] == second[topic] for topic in SIMULATED)
        assert raw(tmp_path / "swept" / "0" / "run.mcap")["/measurement"] == first["/measurement"]

    def test_from_a_log_with_something_else(self, finished, trms, tmp_path):
        log = finished[0] / "run.mcap"
        words = ["sim.duration=2", "model.parameters.k_g=0.1", "effect=tail_dead_zone", "out=b"]
        trms("run", "--from", str(log), *words)
        then = yaml.safe_load(read_log(log).config)
        now = yaml.safe_load(read_log(tmp_path / "b" / "run.mcap").config)
        assert now["seed"] == then["seed"] == 3 and now["sim"]["duration"] == 2.0
        assert now["model"]["parameters"] == {"k_g": 0.1}
        assert now["plant"]["model"] == then["plant"]["model"]  # the rig is that of the log
        assert list(now["plant"]["effects"]) == ["tail_dead_zone"]
        assert now["controller"] == then["controller"]

    def test_option_files_that_changed_since(self, trms, tmp_path):
        lab = tmp_path / "lab" / "ref"
        lab.mkdir(parents=True)
        square = "# mine\ndefaults:\n  - square\n  - _self_\nalpha_v:\n  amplitude: {}  # rad\n"
        (lab / "mine.yaml").write_text(square.format(0.2))
        words = [*QUICK, "--config-dir", "lab", "ref=mine", "picture=false"]
        trms("run", *words, "out=first")
        (lab / "mine.yaml").write_text(square.format(0.1))
        again = ("run", "--from", "first/run.mcap")
        assert "ref.alpha_v.amplitude" in trms(*again, "out=again").stderr
        first, second = (raw(tmp_path / folder / "run.mcap") for folder in ("first", "again"))
        assert all(first[topic] == second[topic] for topic in SIMULATED)
        told = trms(*again, "seed=1", code=2).said
        assert "option files have changed" in told and "trms run --from first/run.mcap" in told

    @pytest.mark.parametrize(
        ("words", "expected"),
        [
            (["--from"], "no log given"),
            (["--from", "nowhere.mcap"], "there is no such file"),
            (["--from", "notes.txt"], "not an MCAP file"),
            (["--from", "imported.mcap"], "holds no configuration"),
            (["--from", "old.mcap"], "of the schema trms.run/0"),
            (["--from", "a.mcap", "--from", "b.mcap"], "given twice"),
        ],
    )
    def test_logs_that_cannot_be_repeated(self, refused, tmp_path, words, expected):
        from trms_cli.recordings.run_log import RunLog
        from trms_cli.recordings.topics import Field, Topic

        (tmp_path / "notes.txt").write_text("notes")
        topic = Topic("/command", (Field("u_v", "V"),))
        RunLog(tmp_path / "imported.mcap", [topic], {}).close("completed")
        RunLog(tmp_path / "old.mcap", [topic], {"schema": "trms.run/0"}).close("completed")
        refused("run", *words, words=expected)


FRICTION = "yaw_coulomb_friction"
BAD_INPUT = [
    # typed, words of the answer
    ("controller.max_iteration=3", "controller.max_iteration", "did you mean max_iterations?"),
    ("controller.max_iterations=0", "controller.max_iterations", "0 given"),
    ("controller.state_weights.alpha_v=-1", "controller.state_weights", "-1"),
    ("controller.state_weights.alpha_v=nan", "controller.state_weights.alpha_v", "give a number"),
    ("controller.sample_time=0.03", "controller.sample_time", "whole multiple"),
    ("controller._target_=nowhere.X", "controller._target_", "have not allowed"),
    ("sim.duration=-1", "sim.duration", "-1.0 given"),
    ("sim.duration=0", "sim.duration", "at least one sample"),
    ("sim.duration=soon", "sim.duration", "'soon' given"),
    ("sim.duration=nan", "sim.duration", "nan"),
    ("sim.duration=1e15", "sim.duration", "at most"),
    ("sim.duration=true", "sim.duration", "give a number"),
    ("sim.sample_time=0", "sim.sample_time", "above 0 s"),
    ("sim.sample_time=0.03", "sim.sample_time=0.03", "controller.sample_time=0.1 s"),
    ("effect=[yaw_coulomb_friction", "effect", "a bracket is missing"),
    ("effect=[main_input_delay,main_input_delay]", "effect", "main_input_delay stands twice"),
    ("controller.terminal=maybe", "controller.terminal", "allowed: contractive, control_lyapunov"),
    ("signal@ref.alpha_x=sine", "signal@ref.alpha_x", "allowed: signal@ref.alpha_h, signal"),
    ("controller.soft_limits.alpha_v=0.5", "controller.soft_limits.alpha_v", "[lower, upper]"),
    ("ref=from_csv ref.alpha_v.file=nix.csv", "no file 'nix.csv'", "in ref.alpha_v.file"),
    (f"model=newtonian_vertical effect={FRICTION}", f"in effect.{FRICTION}", "another model"),
    (
        "disturbance@plant.disturbances=yaw_push plant.disturbances.yaw_push.equation=foo",
        "in plant.disturbances.yaw_push.equation do",
        "pitch_moment",
    ),
    ("ref=from_csv ref.alpha_v.file=a ref.alpha_v.column=nan", "ref.alpha_v.column", "a text"),
    ("--bogus", "the command line", "--from"),
    ("sim.prediction_every=-1", "sim.prediction_every", "from 0 on"),
    ("sim.scene_every=-1", "sim.scene_every"),
    ("seed=1.5", "seed", "whole number"),
    ("seed=-1", "seed", "whole number"),
    ("plant.parameters.k_gg=1", "plant.parameters.k_gg", "did you mean k_g?"),
    ("model.parameters.k_gg=1", "model.parameters.k_gg", "did you mean k_g?"),
    ("plant.parameters.k_g=nan", "plant.parameters.k_g", "give a number"),
    ("plant.integration_step=-1", "plant.integration_step", "> 0"),
    ("plant.initial.alpha_q=1", "plant.initial.alpha_q", "did you mean alpha_"),
    ("plant.initial.alpha_v=nan", "plant.initial.alpha_v", "give a number"),
    ("plant.initial.omega_v=1e200", "plant.initial.omega_v", "give a number up to"),
    ("plant.initial.omega_v=1e5", "plant.initial.omega_v", "<= 10000"),
    ("plant.sensors.channels=[spin]", "no 'spin'", "plant.sensors.channels", "alpha_v"),
    ("plant.sensors.channels=alpha_v", "plant.sensors.channels", "a list, each item a text"),
    ("model=newtonian_horizontal plant.sensors.channels=[alpha_v]", "no 'alpha_v'", "alpha_h"),
    ("controller=pid controller.pitch=3", "controller.pitch", "keys kp, ki, kd"),
    ("controller=pid controller.pitch={kp:1,kq:1}", "controller.pitch.kq", "did you mean kp?"),
    ("plant.sensors.noise_sd.omega_v=-1", "plant.sensors.noise_sd", "-1"),
    ("plant.sensors.loss_probability=2", "plant.sensors.loss_probability", "2"),
    ("plant.prior_seed=-3", "plant.prior_seed", "-3 given"),
    ("ref.alpha_h=null", "ref.alpha_h"),
    ("ref.alpha_v.amplitude=nan", "ref.alpha_v.amplitude", "give a number"),
    (f"effect={FRICTION} effect.{FRICTION}.torque=-0.1", f"{FRICTION}.torque", "-0.1 given"),
    ("picture=maybe", "picture", "true or false"),
    ("out=5", "out", "name a folder"),
]


@pytest.mark.parametrize("word", ["plant.parameters.J_mr=1e-300", "model.parameters.k_g=1e19"])
def test_absurd_numbers_end_in_one_screen_without_warnings(program, word):
    result = program("run", word, "sim.duration=0.5", "picture=false", code=None)
    assert "Warning" not in result.stderr
    assert (result.returncode == 0) == (result.stderr == "")


@pytest.mark.parametrize("case", BAD_INPUT, ids=lambda case: case[0])
def test_bad_input_is_answered_on_one_screen_and_leaves_nothing(refused, case):
    typed, *words = case
    refused("run", "controller=newton_mpc", "sim.duration=1", *typed.split(), words=words)
