"""Choosing free parameters: names, patterns, priors, bounds, and what is wrong with them."""

import re

import numpy as np
import pytest

from tests.identification.greybox.rigs import recording
from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.problem import FitProblem, Prior, free_parameters
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.parameters import Parameter, ParameterSet

SET = ParameterSet(
    [
        Parameter("mass", 2.0, "kg", prior_sd=0.1, lower=1e-9),
        Parameter("k_a", 3.0, "N", prior_sd=0.2),
        Parameter("k_b", -4.0, "N", prior_sd=0.5),
        Parameter("g", 9.81, "m/s^2"),
        Parameter("friction.torque", 0.0, "N*m", lower=0.0),
    ]
)


def chosen(*words: str, **settings: object) -> tuple[str, ...]:
    return tuple(p.name for p in free_parameters(SET, words, **settings))  # type: ignore[arg-type]


def test_words_name_parameters() -> None:
    assert chosen("priors") == ("mass", "k_a", "k_b")
    assert chosen("k_*") == ("k_a", "k_b")
    assert chosen("*.torque", "g") == ("g", "friction.torque")
    assert chosen("priors", "!k_*") == ("mass",)
    assert chosen("priors", "g", priors={"g": Prior(relative_sd=0.01)})[-1] == "g"
    # The order is that of the model, whatever is typed.
    assert chosen("k_b", "mass") == chosen("mass", "k_b") == ("mass", "k_b")


def test_priors_are_absolute_and_positive() -> None:
    mass, k_a, k_b = free_parameters(SET, ["priors"], priors={"k_a": Prior(mean=1.0, sd=0.3)})
    assert mass.prior_sd == pytest.approx(0.2)
    assert (k_a.prior_mean, k_a.prior_sd, k_a.start) == (1.0, 0.3, 3.0)
    assert k_b.prior_sd == pytest.approx(2.0)
    (flat,) = free_parameters(SET, ["mass"], priors={"mass": None})
    assert flat.prior_sd is None and flat.scale > 0


def test_search_range_is_finite_and_holds_the_start() -> None:
    # A parameter without prior that starts at zero has a scale of its bounds.
    (torque,) = free_parameters(SET, ["friction.torque"], bounds={"friction.torque": (0, 0.01)})
    assert 0 < torque.scale <= 0.01
    low, high = torque.search_range()
    assert low == 0.0 and 0 < high <= 0.01
    for parameter in free_parameters(SET.replaced({"k_a": 30.0}), ["*"], centres=SET):
        low, high = parameter.search_range()
        assert np.isfinite([low, high]).all()
        assert low <= parameter.start <= high


@pytest.mark.parametrize(
    ("words", "settings", "said"),
    [
        (["k_z"], {}, "k_a"),
        ([], {}, "priors"),
        (["priors", "!*"], {}, "priors"),
        (["mass"], {"priors": {"k_a": None}}, "not free"),
        (["mass"], {"bounds": {"mass": (3.0, 2.0)}}, "lower < upper"),
        (["mass"], {"bounds": {"mass": (3.0, None)}}, "outside"),
        (["mass"], {"priors": {"mass": Prior(sd=1.0, relative_sd=1.0)}}, "one of them"),
        (
            ["friction.torque"],
            {"priors": {"friction.torque": Prior(relative_sd=0.1)}},
            "give sd in N*m",
        ),
    ],
)
def test_mistakes_are_told(words: list[str], settings: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigurationError, match=re.escape(said)):
        free_parameters(SET, words, **settings)  # type: ignore[arg-type]


def test_a_set_without_priors_is_not_told_to_free_them() -> None:
    bare = ParameterSet([Parameter("k_a", 3.0, "N")])
    with pytest.raises(ConfigurationError) as caught:
        free_parameters(bare, ["priors"])
    assert "no priors" in caught.value.remedy and "k_a" in caught.value.remedy


def test_a_value_within_a_thousandth_of_its_scale_is_on_the_bound() -> None:
    model = Newtonian()
    asked = FitProblem(
        model=model,
        datasets=(recording(model, seconds=0.2, ranges=[(0.0, 0.1)] * 2)[0],),
        free=free_parameters(model.parameters, ["k_ov"], bounds={"k_ov": (0.001, 0.01)}),
    )
    scale = asked.scales[0]
    for value, wanted in (
        (0.001, -1),
        (0.001 + 0.9e-3 * scale, -1),
        (0.001 + 1.1e-3 * scale, 0),
        (0.01 - 1.1e-3 * scale, 0),
        (0.01 - 0.9e-3 * scale, 1),
    ):
        assert asked.on_bounds(np.array([value])).tolist() == [wanted]
