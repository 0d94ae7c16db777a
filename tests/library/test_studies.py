"""Fits, validations, diagnoses, excitations and studies from Python, and what they hand on."""

import json
from pathlib import Path

import pytest

from trms_cli import (
    ConfigurationError,
    TrmsError,
    build,
    excite,
    identify,
    load,
    run,
    stability,
    sweep,
    validate,
)
from trms_cli.core.findings import Findings
from trms_cli.library import html


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    folder = tmp_path_factory.mktemp("studies")
    excited = excite(duration=15, lead_in=5, rigs=0, picture=False, out=folder / "excited")
    made = run(
        controller={"played": {"u_v": {"file": excited}}},
        observer="full_state",
        plant={"parameters": {"k_fvp": 1.7e-5}},
        sim={"duration": 20},
        picture=False,
        out=folder / "rig",
    )
    assert list(excited.commands) == ["u_v", "u_h"]
    assert excited.commands.attrs["units"]["u_v"] == "V"
    assert made["/command"].u_v.iloc[-1] == pytest.approx(excited.commands.u_v.iloc[999], abs=1e-6)
    return made


@pytest.fixture(scope="module")
def fit(rig, tmp_path_factory):
    out = tmp_path_factory.mktemp("fit") / "fit"
    return identify(real=rig, free=["k_fvp"], method={"starts": 1}, picture=False, out=out)


def test_a_fit_is_what_its_folder_says_and_goes_wherever_a_model_goes(fit, rig, here):
    assert fit.document == json.loads((fit.folder / "identification.json").read_text())
    assert fit.parameters.loc["k_fvp", "value"] == pytest.approx(1.7e-5, rel=0.02)
    assert fit.report is None and fit.config["free"] == ["k_fvp"] and load(fit.folder) == fit
    assert "<table" in fit._repr_html_() and "converged" in repr(fit)
    with_it = run(model=fit, controller="lqr", sim={"duration": 0.5}, picture=False)
    assert with_it.config["model"]["path"] == str(fit.model)
    with pytest.raises(ConfigurationError, match="it has real"):
        run(model=rig)


@pytest.mark.slow
def test_models_are_validated_side_by_side(fit, rig, here):
    judged = validate(
        real=rig, model=["newtonian", fit], horizons=[0.5, 2.0], windows={"stride": 2.0}, page=False
    )
    errors = judged.errors[2.0].unstack("channel")["alpha_v"]
    assert len(errors) == 2 and errors.drop("newtonian").iloc[0] < 0.3 * errors["newtonian"]
    assert "<table" in judged._repr_html_()
    alone = validate(real=rig, model=fit, horizons=[0.5], windows={"stride": 4.0}, page=False)
    assert alone.errors[0.5].between(0, 5).all()


@pytest.mark.slow
def test_a_study_answers_in_sentences_also_of_objects(here):
    named = stability("margins", controller="lqr", page=False)
    given = stability("margins", controller=build("controller", "lqr"), page=False)
    assert named.results == given.results and named.lead and named.tables[0].attrs["caption"]
    assert "<table" in named._repr_html_()
    with pytest.raises(TrmsError):
        stability("margins", page=False)


def test_a_view_shows_each_sentence_once_and_text_as_text():
    found = Findings("A <i>", ["It sticks.", "**Sure**: friction."], warnings=["<b>short</b>"])
    shown = html.view(found, paths={"model": Path("a<b>.yaml"), "page": None})
    assert shown.count("It sticks.") == 1 and "<strong>Sure</strong>: friction." in shown
    assert "A &lt;i&gt;" in shown and "&lt;b&gt;short" in shown and "a&lt;b&gt;.yaml" in shown
    assert "page</dt>" not in shown


@pytest.mark.slow
def test_a_sweep_is_a_frame_and_goes_on(here):
    swept = sweep(
        controller=["pid", "lqr"],
        plant={"parameters": {"k_g": [0.0123, 0.1]}},
        effect=[["main_inflow", "tail_inflow"], "main_inflow"],
        sim={"duration": 0.5},
        picture=False,
        out="many",
    )
    assert swept.counts["done"] == len(swept) == len(swept.frame) == 8
    assert set(swept.frame["plant.parameters.k_g"]) == {0.0123, 0.1}
    assert set(swept.frame["effects"]) == {"main_inflow", "main_inflow+tail_inflow"}
    assert list(swept.frame.index) == list(range(8))
    best = swept.frame.rmse.idxmin()
    assert swept.best == swept[best] and swept.compare().winner
    assert load("many").resume().counts["done"] == 8


def test_objects_are_no_part_of_a_sweep(here):
    lqr = build("controller", "lqr")
    for keys in ({"controller": ["pid", lqr]}, {"seed": [1, 2], "controller": lqr}):
        with pytest.raises(ConfigurationError, match="other processes"):
            sweep(**keys)
    assert not list(here.iterdir())
