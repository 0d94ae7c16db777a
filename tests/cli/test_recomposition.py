"""Values varied inside a choice of options that is composed once: equal to composing afresh."""

import json
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.composition import composer, hydra_composition
from trms_cli.composition.composer import Composer, compose
from trms_cli.composition.overrides import read_request
from trms_cli.core.errors import TrmsError

CHOICES = [
    [],
    ["controller=pid"],
    ["controller=lqr", "observer=kalman"],
    ["model=lagrangian", "plant=ideal"],
    ["effect=[yaw_coulomb_friction,main_input_delay]"],
    ["ref=square", "signal@ref.alpha_v=sine"],
    ["experiment=disturbed_rig", "fault=yaw_outliers"],
    ["model@plant.model=newtonian_full"],
]
NUMBERS = st.one_of(
    st.integers(-1000, 1000).map(str),
    st.floats(1e-9, 1e9).map(repr),
    st.sampled_from(["1e-3", "1E5", ".5", "1.", "1_000", "-0", "0.10", "inf", "nan", "007"]),
)
WORDS = st.sampled_from(
    [
        *("true", "False", "null", "a", "'a b'", '"x=y"', "a b", "a/b.c", "''"),
        *("[1,2.5,a]", "[]", "{a:1}"),
    ]
)
VALUES = st.one_of(
    st.tuples(
        st.sampled_from(
            [
                *("sim.duration", "seed", "sim.sample_time", "plant.prior_seed", "model.name"),
                *("plant.parameters.k_g", "model.parameters.k_g", "++plant.parameters.h_v"),
                *("ref.alpha_v.amplitude", "effect.yaw_coulomb_friction.torque"),
                *("controller.sample_time", "plant.sensors.noise_sd.omega_v"),
            ]
        ),
        NUMBERS,
    ),
    st.tuples(st.sampled_from(["out", "picture", "sim", "supervisor.x", "seed"]), WORDS),
    st.just(("sim.duration", "${sim.sample_time}")),
).map("=".join)


def _outcome(composing):
    try:
        found = composing()
    except TrmsError as error:
        return type(error), error.problem, error.where, error.remedy
    return repr(found.config), found.choices, found.overrides, found.config_dirs


@pytest.fixture(scope="module")
def known() -> Composer:
    return Composer("run")


@pytest.mark.slow
@settings(max_examples=6, deadline=None)
@given(data=st.data())
def test_equals_composing_afresh(known, data):
    _is_equal(known, data.draw(st.sampled_from(CHOICES)), data)


@pytest.mark.slow
@pytest.mark.parametrize("choices", CHOICES, ids=" ".join)
@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_equals_composing_afresh_for_many(known, choices, data):
    _is_equal(known, choices, data)


def _is_equal(known, choices, data):
    values = data.draw(st.lists(VALUES, max_size=4))
    words = data.draw(st.permutations([*choices, *values]))
    again, afresh = _outcome(lambda: known.compose(words)), _outcome(lambda: _afresh(known, words))
    assert again == afresh


def _afresh(known, words):
    """By Hydra alone, without what `known` has kept."""
    return known.from_start(read_request(words))


@pytest.mark.parametrize(
    "words",
    [
        ["sim.duration=1", "plant.parameters.k_g=0.19", "seed=4"],
        ["controller=pid", "picture=false", "out='a b'", "model.parameters.k_g=0.2"],
        ["effect=yaw_coulomb_friction", "effect.yaw_coulomb_friction.torque=1e-3"],
        ["ref=square", "signal@ref.alpha_v=sine", "ref.alpha_v.amplitude=0.1"],
    ],
)
def test_what_sweeps_vary_is_not_composed_again(known, monkeypatch, words):
    known.compose(words)  # the choices are known from here on

    def refuse(*_):
        raise AssertionError("composed from the start")

    monkeypatch.setattr(hydra_composition, "compose_by_hydra", refuse)
    again = known.compose([*words, "sim.prediction_every=3"], job=7)
    assert again.job == 7 and again.config["sim"]["prediction_every"] == 3


def test_a_configuration_is_the_caller_s_own(known):
    words = ["controller=pid", "seed=3", "model.parameters.k_g=0.123"]
    first = known.compose(words)
    first.config["sim"]["duration"] = -1.0
    first.config["plant"]["model"]["name"] = "spoilt"
    again, afresh = known.compose(words), _afresh(known, words)
    assert json.dumps(again.config) == json.dumps(afresh.config)
    assert again.yaml == afresh.yaml
    # the rig follows the model that is varied
    assert again.config["plant"]["model"]["parameters"] == {"k_g": 0.123}


def test_a_second_call_composes_the_same_options_no_more(monkeypatch):
    compose(["controller=pid", "seed=1"])
    monkeypatch.setattr(hydra_composition, "compose_by_hydra", None)
    assert compose(["controller=pid", "seed=2"]).config["seed"] == 2


def test_a_file_or_folder_of_the_user_s_is_read_again(tmp_path, monkeypatch):
    """As in a notebook, where one is edited between two calls, or the folder changed."""
    option = tmp_path / "ref" / "mine.yaml"
    option.parent.mkdir()
    for last in (1.0, 2.0):
        option.write_text(f"_target_: trms_cli.references.step.Step\nfinal: {last}\n", "utf-8")
        assert compose(["ref=mine"], config_dirs=(tmp_path,)).config["ref"]["final"] == last
    for name in ("first", "second"):
        place = tmp_path / name
        place.mkdir()
        (place / "fit.yaml").write_text("{}\n", "utf-8")
        monkeypatch.chdir(place)
        path = compose(["model=fit.yaml"]).config["model"]["path"]
        assert Path(path).resolve() == (place / "fit.yaml").resolve()


def test_what_is_kept_is_bounded(monkeypatch):
    monkeypatch.setattr(composer, "_MOST_BASES", 2)
    kept = Composer("run")
    for name in ("pid", "lqr", "linear_mpc"):
        kept.compose([f"controller={name}"])
    assert len(kept._bases) == 2


def test_a_tenth_of_the_time(known):
    """As a ratio in one process: what a composition from the start costs, and a value varied."""
    words = ["controller=pid", "plant.parameters.k_g=0.19"]
    known.compose(words)

    def cost(make, times):
        begin = time.process_time()
        for seed in range(times):
            make([*words, f"seed={seed}"])
        return (time.process_time() - begin) / times

    assert cost(known.compose, 50) < 0.1 * cost(lambda words: _afresh(known, words), 3)
