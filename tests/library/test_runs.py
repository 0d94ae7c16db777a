"""A run from Python is that of the command line, and can be looked at."""

import json
import shlex

import numpy as np
import pytest

import trms_cli
from trms_cli import (
    ConfigurationError,
    RecordingError,
    build,
    compare,
    load,
    options,
    plot,
    read_log,
    report,
    run,
    runs,
    score,
)
from trms_cli.cli import main


def test_it_is_the_run_of_the_command_line_sample_by_sample(lqr, here):
    words = ["controller=lqr", "ref=sine", "sim.duration=2", "picture=false", "out=typed"]
    assert main(["run", *words]) == 0
    typed = read_log("typed")
    assert typed.score["channels"] == lqr.score["channels"]
    for topic in ("/command", "/plant/state", "/estimate"):
        assert typed[topic].equals(lqr[topic]), topic


def test_a_topic_is_a_frame_with_units(lqr, monkeypatch):
    estimate = lqr["estimate"]
    assert estimate.index.name == "time [s]" and len(estimate) == 100
    assert estimate.attrs["units"]["omega_v"] == "rad/s"
    assert set(lqr) == set(lqr.topics) and "/command" in lqr and "/nothing" not in lqr
    with pytest.raises(RecordingError, match="/estimate"):
        lqr["/nothing"]
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(trms_cli.TrmsError, match="pip install"):  # pandas
        lqr["/estimate"]
    assert np.isfinite(lqr.logged.table("/estimate").columns["alpha_h"]).all()


def test_it_tells_what_it_is(lqr):
    assert lqr.choices["controller"] == "lqr" and lqr.config["sim"]["duration"] == 2
    assert lqr.log == lqr.folder / "run.mcap" and lqr.outcome == "completed"
    assert json.loads((lqr.folder / "score.json").read_text()) == lqr.score
    assert "alpha_h RMSE" in repr(lqr) and "tracking" not in repr(lqr)
    assert "RMSE" in lqr.text and str(lqr.log) in lqr.text
    shown = lqr._repr_html_()
    assert "RMSE pitch" in shown and "<strong>lqr</strong> followed" in shown
    assert "<table" in shown and "data:image/png;base64" in shown and len(shown) < 150_000
    command = shlex.split(lqr.logged.run["command"])
    assert command[:3] == ["trms", "run", "controller=lqr"]


def test_its_figures_scores_and_pages(lqr, here):
    figure = lqr.figure()
    assert figure._repr_png_().startswith(b"\x89PNG")
    figure.savefig(here / "run.pdf")
    assert (here / "run.pdf").stat().st_size > 1000
    assert [axes.get_ylabel() for axes in figure.axes[:2]] == ["pitch [rad]", "yaw [rad]"]
    assert plot(lqr, what="tracking")._repr_png_().startswith(b"\x89PNG")
    assert score(lqr)["channels"] == lqr.score["channels"]
    both = score(lqr, lqr, baseline=lqr.folder / "score.json")
    assert both["schema"] == "trms.scores/1" and not both["scores"][0]["comparison"]["worse"]
    assert "<html" in report(lqr, out="page.html").read_text()[:200]


def test_again_is_the_same_but_for_what_is_given(lqr, here):
    same = lqr.again(picture=False)
    assert same["/plant/state"].equals(lqr["/plant/state"])
    pid = lqr.again(controller="pid", picture=False)
    assert pid.choices["controller"] == "pid" and pid.choices["ref"] == "sine"
    assert pid["/reference"].equals(lqr["/reference"])
    assert [same.folder.parts[0], pid.folder.parts[0]] == ["outputs", "outputs"]
    with pytest.raises(trms_cli.TrmsError, match="nothing is written over"):
        lqr.again(out=lqr.folder)
    found = compare(lqr, pid)
    assert found.is_pair and found.winner is None and len(found.frame) > 5
    assert "<table" in found._repr_html_()
    others = [pid, lqr.again(controller="newton_mpc", picture=False)]
    ranked = compare(lqr, others)
    assert sorted(ranked.frame["rank"]) == [1, 2, 3]
    assert ranked.winner == ranked.frame.set_index("rank").loc[1, "name"]
    with pytest.raises(ConfigurationError, match="rmse"):
        compare(lqr, others, metric="rms")


def test_runs_is_a_frame_and_the_room_of_its_name(lqr, here, monkeypatch):
    monkeypatch.setenv("TRMS_RUNS", str(here / "index"))
    frame = runs("controller == 'lqr'", lqr.folder)
    assert list(frame.controller) == ["lqr"] and frame.attrs["units"]["rmse_alpha_h"] == "rad"
    from trms_cli.runs.frame import find_runs

    assert trms_cli.runs.find_runs is find_runs


def test_a_folder_is_opened_again(lqr, tmp_path):
    assert load(lqr.folder) == lqr == load(lqr.log) and hash(load(lqr.folder)) == hash(lqr)
    with pytest.raises(RecordingError, match="no command left"):
        load(tmp_path)
    with pytest.raises(RecordingError, match="no log"):
        read_log(tmp_path)


def test_options_are_those_of_the_list_and_are_built_to_be_looked_at(capsys):
    assert main(["list", "controller", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["groups"]["controller"]["options"]
    found = options("controller")
    assert dict(found) == {entry["name"]: entry["summary"] for entry in listed}
    assert "lqr" in repr(found) and "<table" in found._repr_html_()
    assert "controller" in options() and "_target_" in repr(options("controller", "lqr"))
    with pytest.raises(ConfigurationError, match="did you mean lqr"):
        options("controller", "lrq")
    model = build("model", "newtonian", parameters={"k_g": 0.1})
    assert model.parameters["k_g"].value == 0.1
    assert build("effect", "yaw_coulomb_friction", torque=0.02).torque == 0.02
    with pytest.raises(ConfigurationError, match="did you mean controller"):
        build("controler", "lqr")


def test_a_misspelt_key_is_answered_as_on_the_command_line(here):
    with pytest.raises(ConfigurationError) as caught:
        run(controler="lqr")
    error = caught.value
    assert error.where == "controler" and "did you mean controller" in error.remedy
    assert "did you mean controller" in str(error) and not list(here.iterdir())
    shown = error._render_traceback_()
    assert shown[0].startswith("ConfigurationError: ") and "   in  controler" in shown
