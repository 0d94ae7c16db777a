"""The built-in sets: what their sources publish, and what they take from set bench."""

import casadi as ca
import pytest
import yaml

from trms_cli.core.errors import ModelError
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.models.feedback_manual import FeedbackManual
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model
from trms_cli.models.parameters import parameter_file
from trms_cli.models.single_rotor import SingleRotor

TASTEMIROV = {
    "l_t": 0.275,
    "l_m": 0.254,
    "k_fvp": 1.497e-5,
    "k_fvn": 0.900e-5,
    "k_fhp": 3.776e-6,
    "k_fhn": 2.305e-6,
    "k_chp": 0.00987,
    "k_chn": 0.00987,
}


def test_tastemirov_is_bench_but_for_what_is_published():
    ours, bench = parameter_file("tastemirov"), parameter_file("bench")
    assert set(ours.parameters) == set(bench.parameters)
    for parameter in ours.parameter_set():
        theirs = bench.parameters[parameter.name]
        published = parameter.name in TASTEMIROV
        assert parameter.source == ("Tastemirov et al. 2017" if published else "set bench")
        assert parameter.value == TASTEMIROV.get(parameter.name, theirs.value)
        assert (parameter.unit, parameter.prior_sd) == (theirs.unit, theirs.prior_sd)


def test_tastemirovs_inertia_comes_out_too_large_as_the_file_says():
    model = Lagrangian(parameter_set="tastemirov")
    x, u, p, _ = model.symbols()
    inertia = ca.Function("J", [x, u, p], [model.quantities(x, u, p)["inertia_pitch"]])
    found = float(inertia(model.rest(), [0, 0], model.parameters.values))
    assert found == pytest.approx(0.0654, abs=5e-5)
    text = (config_folder() / "parameters" / "tastemirov.yaml").read_text(encoding="utf-8")
    assert "give 0.0654" in text


@pytest.mark.parametrize(
    ("name", "base", "own"),
    [("rahideh", "bench", {"k_g"}), ("tras_record", "tras", {"gBA", "gC", "c_fv", "c_fh"})],
)
def test_a_set_differs_from_its_base_in_what_its_source_gives_alone(name, base, own):
    ours, theirs = (parameter_file(each).parameter_set() for each in (name, base))
    assert ours.names == theirs.names
    assert {p.name for p in ours if theirs[p.name].value != p.value} == own


@pytest.mark.parametrize(
    ("model", "settings", "problem"),
    [
        (Lagrangian, {"parameter_set": "tras"}, "belongs to model 'tras'"),
        (FeedbackManual, {"parameter_set": "bench"}, "belongs to model 'newtonian'"),
        (SingleRotor, {"parameter_set": "tras", "rotor": "main"}, "has no 'k_uv'"),
    ],
)
def test_a_set_of_another_model_is_told(model, settings, problem):
    with pytest.raises(ModelError, match=problem):
        model(**settings)


@pytest.mark.parametrize(
    "option",
    [
        *("lagrangian", "lagrangian_full", "lagrangian_vertical", "lagrangian_horizontal"),
        *("tastemirov", "feedback_manual"),
        *("motor_main", "motor_tail", "propeller_main", "propeller_tail"),
    ],
)
def test_options_build_what_they_say(option):
    text = (config_folder() / "model" / f"{option}.yaml").read_text(encoding="utf-8")
    model = build(yaml.safe_load(text), "model")
    assert isinstance(model, Model)
    assert model.dynamics(*model.symbols()).shape == (model.n_x, 1)
    sizes = {"lagrangian": 6, "lagrangian_full": 8, "tastemirov": 6, "feedback_manual": 7}
    assert model.n_x == sizes.get(option, 3 if "lagrangian" in option else 1)
