"""A fitted model's file is read back as the model that was fitted."""

from pathlib import Path

import numpy as np
import pytest

from trms_cli.core.errors import RecordingError
from trms_cli.effects.model_file import load_model
from trms_cli.identification.model_writer import ModelOrigin, model_document, write_model
from trms_cli.identification.problem import Prior, free_parameters, with_values
from trms_cli.models.driven_model import DrivenModel
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.parameters import parameter_file

ORIGIN = ModelOrigin(
    option="newtonian", limits={"u_v": 2.5, "u_h": 2.5, "alpha_v": 1.05, "alpha_h": 2.8}
)
FITTED = {"k_fvp": 1.7123456789012345e-05, "k_ov": 0.0042}


def document(model, values=FITTED, origin=ORIGIN, **changes):
    free = free_parameters(model.parameters, list(values), **changes)
    return model_document(
        "rig_7",
        model,
        origin,
        values=values,
        deviations={name: 0.01 * abs(value) for name, value in values.items()},
        free=free,
        source="fitted to rig.csv",
    )


def test_comes_back_bit_for_bit(tmp_path: Path) -> None:
    model, path = Newtonian(), tmp_path / "fit.yaml"
    write_model(document(model), path, "trms identify real=rig.csv")
    back = load_model(str(path))
    for parameter in model.parameters:
        wanted = FITTED.get(parameter.name, parameter.value)
        assert back.parameters[parameter.name].value == wanted
        assert back.parameters[parameter.name].lower == parameter.lower
        assert back.parameters[parameter.name].unit == parameter.unit
    assert back.input_limits == model.input_limits and back.stops == model.stops
    assert path.read_text().startswith("# trms identify real=rig.csv\n")


def test_keeps_the_width_of_the_prior_about_the_new_value(tmp_path: Path) -> None:
    model = Newtonian()
    content = document(model)["parameters"]["k_ov"]
    was = model.parameters["k_ov"]
    assert content["prior_sd"] * content["value"] == pytest.approx(
        was.prior_sd * was.value, rel=1e-5
    )
    assert content["sd"] == pytest.approx(4.2e-5)
    path = tmp_path / "fit.yaml"
    write_model(document(model), path)
    assert parameter_file(str(path)).parameters["k_ov"].sd == pytest.approx(4.2e-5)
    # Infinite bounds are left out.
    assert np.isinf(free_parameters(model.parameters, ["k_g"])[0].lower)
    content = document(model, {"k_g": 0.02})["parameters"]["k_g"]
    assert "lower" not in content and "upper" not in content


def test_bounds_and_priors_of_the_fit_are_those_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "fit.yaml"
    content = document(
        Newtonian(), priors={"k_fvp": None, "k_ov": Prior(sd=0.001)}, bounds={"k_ov": (0.001, 0.01)}
    )
    write_model(content, path)
    back = load_model(str(path)).parameters
    assert (back["k_ov"].lower, back["k_ov"].upper) == (0.001, 0.01)
    assert back["k_fvp"].prior_sd is None
    assert "no prior" in back["k_fvp"].source


def test_values_reach_the_models_beneath() -> None:
    driven = DrivenModel(Newtonian(), ["omega_v", "omega_h"])
    changed = with_values(driven, {"m_cb": 0.09})
    assert changed.parameters["m_cb"].value == 0.09 == changed.base.parameters["m_cb"].value
    assert driven.parameters["m_cb"].value != 0.09
    # The rest is where gravity puts it, by the parameters of the model beneath.
    assert not np.allclose(changed.rest(), driven.rest())


def test_says_when_the_disk_does_not_take_it(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be written"):
        write_model(document(Newtonian()), tmp_path / "no" / "fit.yaml")
