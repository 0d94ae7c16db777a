"""Numbers and names in words: one way of writing each."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.core import wording


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"), (math.nan, "–"), (math.inf, "∞"), (-math.inf, "−∞"), (0.0, "0"), (7, "7"),
        (-3, "−3"), (0.12345, "0.123"), (-0.5, "−0.5"), (1234.5, "1234"), (99_999.0, "99999"),
        (1e5, "1.00e05"), (-2.5e-4, "−2.50e−04"), (100.0, "100"), (0.012345, "0.0123"),
        (-3.14159, "−3.14"), (123456.0, "1.23e05"), (4321.0, "4321"), (1.2e-5, "1.20e−05"),
        ("text", "text"),
    ],
)  # fmt: skip
def test_a_cell_has_three_digits_and_a_true_minus(value, text):
    assert wording.cell(value) == text


@pytest.mark.parametrize(
    ("value", "sd", "text"),
    [
        (1.23456, 0.0123, "1.235"), (1.2, 0.0012, "1.2000"), (1.69623e-5, 5.9e-8, "1.6962e−05"),
        (0.02, 2.7e-4, "0.02000"), (1.5, 4.0, "1.5"), (-0.353, 1e-9, "−0.353000"), (0.0, 0.1, "0"),
        (0.5, None, "0.5"), (0.5, 0.0, "0.5"), (4321.25, 0.3, "4321.25"), (None, 0.1, "–"),
    ],
)  # fmt: skip
def test_a_number_with_a_deviation_goes_to_its_second_digit(value, sd, text):
    assert wording.cell(value, sd) == text


@given(st.floats(1e-8, 1e8), st.floats(1e-4, 1.0), st.floats(-1e4, 1e4))
def test_what_is_shown_is_within_the_deviation_and_reads_back_to_its_digits(value, share, other):
    text = wording.cell(value, share * value).replace("−", "-")
    assert abs(float(text) - value) <= 0.06 * share * value + 1e-2 * share * value
    text = wording.number(other).replace("−", "-")
    assert float(text) == pytest.approx(other, rel=6e-3, abs=1e-12)


@pytest.mark.parametrize(
    ("share", "text"),
    [(0.0, "0 %"), (1.0, "100 %"), (0.9999, "over 99 %"), (1e-9, "under 1 %"), (0.456, "46 %"),
     (-0.1, "−10 %"), (-0.003, "0 %"), (4.56, "456 %"), (math.nan, "–"), (None, "–")],
)  # fmt: skip
def test_a_share_is_never_rounded_to_all_or_nothing(share, text):
    assert wording.percent(share) == text


@pytest.mark.parametrize(
    ("unit", "text"),
    [("N*m*s^2", "N m s²"), ("1", ""), ("", ""), ("kg m²", "kg m²"), ("V^2*s", "V² s"),
     ("rad/s^2", "rad/s²"), ("s^-1", "s⁻¹")],
)  # fmt: skip
def test_units_are_printed_one_way(unit, text):
    assert wording.unit(unit) == text


def test_lists_counts_names_and_times_are_written_as_prose_does():
    assert wording.listing([]) == ""
    assert wording.listing(["a"]) == "a"
    assert wording.listing(["a", "b"], "or") == "a or b"
    assert wording.listing(["a", "b", "c"]) == "a, b and c"
    assert wording.listing(["a", "b", "c", "d"], most=2) == "a, b and 2 more"
    assert wording.count(1, "step") == "1 step"
    assert wording.count(0, "step") == "no step"
    assert wording.count(2, "deadline missed", "deadlines missed") == "2 deadlines missed"
    assert wording.signal("alpha_v") == "pitch"
    assert wording.readable("yaw_coulomb_friction") == "yaw Coulomb friction"
    assert wording.interval(0.1, 0.25, "rad") == "0.1 to 0.25 rad"
    assert wording.percent_interval(0.182, 0.456) == "18 to 46 %"
    assert wording.with_unit("friction", "N*m") == "friction [N m]"
    assert [wording.seconds(s) for s in (0.25, 12.34, 250.0, 7500.0)] == [
        "250 ms", "12.3 s", "4 min 10 s", "2 h 05 min",
    ]  # fmt: skip
    # A plant that is not simulated has no equations of the model.
    assert wording.plant_name({"plant": "replay", "model": "newtonian"}) == "replay"
    assert wording.plant_name({"plant": "mine", "model": "newtonian"}, "bench") == "mine (bench)"


@pytest.mark.parametrize(
    ("share", "ends", "text"),
    [
        (0.912, (0.86, 0.944), "91 % of the gap (86 to 94 %)"),
        (0.9999, (0.9985, 1.01), "over 99 % of the gap (over 99 to 100 %)"),
        (0.9999, (0.9985, 0.9999), "over 99 % of the gap"),
        (4.56, (1.82, 4.56), "100 % of the gap"),
        (0.4, (-9.0, 1.4), "40 % of the gap (up to 100 %)"),
        (0.4, None, "40 % of the gap"),
    ],
)
def test_shares_of_a_gap_are_written_one_way(share, ends, text) -> None:
    assert wording.gap_share(share, ends, "of the gap") == text


@pytest.mark.parametrize(
    ("typed", "name"),
    [
        ({"model": "fits/monday/model.yaml"}, "monday"),
        ({"model": "fits/monday"}, "monday"),  # its folder
        ({"model@plant.model": "tuned.yaml"}, "tuned"),
    ],
)
def test_a_job_without_a_log_calls_its_model_as_its_log_would(typed, name) -> None:
    assert list(wording.typed_models({"model": "from_file"}, typed).values()) == [name]
    assert wording.typed_models({"model": "lqr"}, {"controller": "pid", "seed": 1}) == {}


_FIT = {"path": "fit/model.yaml"}


@pytest.mark.parametrize(
    ("choices", "config", "rig"),
    [
        ({"model": "newtonian"}, {}, "newtonian"),
        ({"model": "newtonian_vertical", "model@plant.model": None}, {}, "newtonian_vertical"),
        ({"model": "from_file"}, {"model": _FIT, "plant": {"model": _FIT}}, "fit"),
        ({"model": "from_file", "model@plant.model": "newtonian"}, {"model": _FIT}, "newtonian"),
        ({"model": "lagrangian", "model@plant.model": "from_file"},
         {"plant": {"model": _FIT}}, "fit"),
        ({"model": "narx_2dof", "model@model.rig": "newtonian"}, {}, "newtonian"),
    ],
)  # fmt: skip
def test_a_simulated_rig_is_called_by_the_equations_it_has(choices, config, rig) -> None:
    shown = wording.choice_labels({"controller": "lqr", "plant": "simulated"} | choices, config)
    assert wording.headline(shown, follows=False).endswith(f"plant simulated ({rig})")


@pytest.mark.parametrize(
    ("plant", "config", "shown"),
    [
        ({"effect": "none"}, {}, "simulated (newtonian)"),
        ({"effect": "yaw_coulomb_friction, tail_dead_zone"}, {"prior_seed": 3},
         "simulated (newtonian + yaw_coulomb_friction + tail_dead_zone, prior_seed 3)"),
        ({}, {"parameters": {"k_g": 0.05}}, "simulated (newtonian, k_g 0.05)"),
        ({}, {"parameters": {"k_g": 1, "k_ov": 2, "k_oh": 3}},
         "simulated (newtonian, 3 own parameters)"),
        ({"plant": "bench", "effect": "none"}, {}, "bench"),
    ],
)  # fmt: skip
def test_the_header_says_which_plant_acts(plant, config, shown) -> None:
    choices = {"plant": "simulated", "model": "fit", "model@plant.model": "newtonian"} | plant
    assert wording.plant_in_full(choices, config) == shown
    assert f"model fit · plant {shown}" in wording.headline(choices, plant=config)
