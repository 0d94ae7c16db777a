"""``trms validate`` as a person types it."""

import json
from pathlib import Path

import numpy as np
import pytest

from trms_cli.cli import main
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.resources import config_folder
from trms_cli.library.tasks.validated_models import model_list, named_sets, one_of, shown_names

HEADER = "t[s],u_v[V],alpha_v[deg],omega_v[rpm]\n"


def write(path: Path, seconds: float = 8.0, commands: bool = True) -> Path:
    """A vertical rig that is no model's: a lightly damped swing, a rotor that lags."""
    rng = np.random.default_rng(0)
    step, rows = 0.02, []
    angle, rate, speed = -0.6, 0.0, 0.0
    for k in range(round(seconds / step)):
        u = 1.2 + 0.4 * ((k // 60) % 2) if commands else 1.2
        speed += step * (150.0 * u - speed) / 0.4
        rate += step * (-4.0 * (angle + 0.62 - 1.4e-5 * speed**2) - 0.1 * rate)
        angle += step * rate
        shown = np.degrees(angle) + 0.03 * rng.standard_normal()
        rpm = speed * 9.5493 + 15 * rng.standard_normal()
        rows.append(f"{k * step:.2f},{u:g},{shown:.3f},{rpm:.1f}\n")
    path.write_text(HEADER + "".join(rows), encoding="utf-8")
    return path


@pytest.fixture
def here(tmp_path) -> Path:
    write(tmp_path / "rig.csv")
    return tmp_path


def read(folder: Path) -> dict:
    document: dict = json.loads((folder / "validation.json").read_text(encoding="utf-8"))
    return document


@pytest.mark.slow
def test_leaves_figures_and_a_page(here, trms):
    done = trms("validate", "real=rig.csv", "model=newtonian_vertical", "out=here")
    assert "Left alone for 2 s" in " ".join(done.stdout.split())
    document = read(here / "here")
    assert document["schema"] == "trms.validation/1"
    assert document["model"] == "newtonian_vertical"
    assert list(document["error"]) == ["alpha_v", "omega_v"]
    assert list(document["error"]["alpha_v"]) == ["0.1", "0.5", "2.0"]
    assert document["left_out_horizons_s"] == [10.0]
    assert document["fit_percent"]["alpha_v"] < 90  # it is no model's rig
    page = (here / "here/validation.html").read_text(encoding="utf-8")
    assert "newtonian_vertical" in page and page.count("data:image/") >= 5
    again = trms("validate", "real=rig.csv", "model=newtonian_vertical", "out=here", code=2)
    assert "not empty" in again.stderr


def test_a_recording_of_a_few_seconds_has_errors_but_no_correlations(trms, tmp_path):
    write(tmp_path / "rig.csv", seconds=3.0)
    trms("validate", "real=rig.csv", "model=newtonian_vertical", "out=here")
    assert read(tmp_path / "here")["error"]["alpha_v"]["0.5"] > 0
    page = (tmp_path / "here/validation.html").read_text(encoding="utf-8")
    assert "newtonian_vertical: the recording is too short for tests of correlation." in page


def test_compares_models_a_file_among_them(here, trms):
    text = (config_folder() / "parameters/bench.yaml").read_text(encoding="utf-8")
    mine = "name: mine\nmodel: newtonian_vertical\n" + text[text.index("parameters:") :]
    (here / "mine.yaml").write_text(mine, encoding="utf-8")
    words = ("model=[newtonian_vertical,mine.yaml]", "page=false", "horizons=[0.5,2]")
    done = trms("validate", "real=rig.csv", *words, "out=both")
    document = read(here / "both")
    assert set(document["models"]) == {"newtonian_vertical", "mine"}
    assert [row["model"] for row in document["ranking"]]
    assert document["comparison"][0]["ratio"] == pytest.approx(1.0)  # the same parameters
    assert not (here / "both/validation.html").exists()
    assert "do not tell" in done.stdout


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["real=none.csv"], "none.csv"),
        (["real=rig.csv", "model=newtonian"], "no u_h"),
        (["real=rig.csv", "driven=[omega_h]"], "omega_h"),
        (["real=rig.csv", "horizons=[2,1]"], "rising"),
        (["real=rig.csv", "windows.start=guessed"], "windows.start"),
        (["real=rig.csv", "tests.level=2"], "tests.level"),
        (["real=rig.csv", "data.end=1"], "are needed"),
        (["real=rig.csv", "predictor.torques=[nothing]"], "nothing"),
        (["real=rig.csv", "effect=yaw_coulomb_friction"], "yaw"),
        (["real=rig.csv", "page=3"], "page"),
        (["real=rig.csv", "picture=false"], "page=false"),
        (["real=rig.csv", "data.quantum.alpha_v=0"], "noise"),
        ([], "real"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_is_explained(here, trms, arguments, words):
    assert words in trms("validate", "model=newtonian_vertical", *arguments, code=2).said
    assert not (here / "outputs").exists()


class TestWhatTheRecordingsTell:
    """Recordings are looked at before models are held against them, as before a fit."""

    @pytest.mark.parametrize(
        ("more", "told"),
        [
            (["model=newtonian_vertical"], ["rpm read as rad/s", "omega_v[rpm]"]),
            # also where its speed would drive the beam
            (["model=newtonian_vertical", "driven=[omega_v]"], ["rpm read as rad/s"]),
            # of the models the one that it is of
            (["model=[newtonian_vertical,narx_vertical]"], ["newtonian_vertical: omega_v is"]),
        ],
    )
    def test_a_wrong_unit_is_named(self, here, trms, more, told):
        text = write(here / "long.csv", seconds=30.0).read_text(encoding="utf-8")
        assert "omega_v[rpm]" in text
        (here / "spoilt.csv").write_text(text.replace("omega_v[rpm]", "omega_v[rad/s]"), "utf-8")
        said = trms("validate", "real=spoilt.csv", *more, "out=never", code=2).said
        assert all(words in said for words in told) and "narx" not in said
        assert not (here / "never").exists()

    def test_a_warning_stands_everywhere(self, here, trms):
        write(here / "still.csv", commands=False)
        words = ("real=still.csv", "model=newtonian_vertical", "out=here", "horizons=[0.5]")
        assert "warning    still: the inputs never move" in trms("validate", *words).stdout
        assert read(here / "here")["warnings"][0]["check"] == "excitation"
        page = (here / "here/validation.html").read_text(encoding="utf-8")
        assert "the inputs never move" in page


class TestListsOfModels:
    def test_a_list_is_taken_apart_and_one_model_left_to_the_composition(self):
        assert model_list(["real=a.csv", "model=newtonian"]) is None
        assert model_list(["real=a.csv"]) is None
        argv = ["real=a.csv", "model=[newtonian,fits/b.yaml]", "seed=1"]
        assert model_list(argv) == ("newtonian", "fits/b.yaml")
        assert one_of(argv, "newtonian") == ["model=newtonian", "real=a.csv", "seed=1"]

    def test_a_parameter_set_stands_for_its_file(self, capsys):
        (choice, *_) = one_of(["real=a.csv", "model=[tras,tras_record]"], "tras_record")
        assert choice.endswith("parameters/tras_record.yaml")
        assert main(["validate", "real=a.csv", "model=bench", "--cfg", "job"]) == 0
        assert "parameters/bench.yaml" in capsys.readouterr().out
        (alternatives,) = named_sets(["model=bench,newtonian"])
        assert alternatives.endswith("parameters/bench.yaml,newtonian")
        assert named_sets(["real=a.csv", "model=tras"]) == ["real=a.csv", "model=tras"]

    @pytest.mark.parametrize(
        ("words", "told"),
        [
            (["model=[]"], "no model"),
            (["model=[a,a]"], "twice"),
            (["model=[a"], "bracket"),
            (["-m", "model=[a,b]"], "model=a,b"),  # a sweep takes alternatives instead
        ],
    )
    def test_what_is_no_list(self, words, told):
        with pytest.raises(ConfigurationError, match=told):
            model_list(words)

    def test_names_stay_unique(self):
        namesakes = ["x/fit.yaml", "y/fit.yaml", "tras"]
        assert shown_names(namesakes) == namesakes
        assert shown_names(["x/fit.yaml", "tras"]) == ["fit", "tras"]
        fits = ["monday/model.yaml", "b/tuesday/model.yaml", "model.yaml"]
        assert shown_names(fits) == ["monday", "tuesday", "model"]
