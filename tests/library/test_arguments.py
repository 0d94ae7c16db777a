"""What is given as arguments means what is typed."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli import compare, plot, report, run, score
from trms_cli.composition.arguments import arguments_of, text_of
from trms_cli.core.errors import ConfigurationError, SimulationError
from trms_cli.references.time_function import TimeFunction

from .own_parts import Steady


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"controller": "lqr"}, ["controller=lqr"]),
        ({"sim": {"duration": 20}}, ["sim.duration=20"]),
        ({"ref.alpha_h.amplitude": 0.3}, ["ref.alpha_h.amplitude=0.3"]),
        (
            {"ref": {"sine": {"alpha_h": {"amplitude": 0.3}}}},
            ["ref=sine", "ref.alpha_h.amplitude=0.3"],
        ),
        ({"ref": {"alpha_h": {"amplitude": 0.3}}}, ["ref.alpha_h.amplitude=0.3"]),
        ({"effect": "main_inflow"}, ["effect=[main_inflow]"]),
        ({"effect": ["main_inflow", "tail_inflow"]}, ["effect=[main_inflow,tail_inflow]"]),
        (
            {"effect": {"yaw_coulomb_friction": {"torque": 0.01}}},
            ["effect=[yaw_coulomb_friction]", "effect.yaw_coulomb_friction.torque=0.01"],
        ),
        ({"signal@ref.alpha_v": "sawtooth"}, ["signal@ref.alpha_v=sawtooth"]),
        ({"seed": np.int64(3), "picture": np.bool_(False)}, ["seed=3", "picture=false"]),
        ({"controller": None}, []),
        ({"plant": {"prior_seed": None}}, ["plant.prior_seed=null"]),
        ({"model": Path("fits/model.yaml")}, ["model=fits/model.yaml"]),
        ({"model": Path("model.yaml")}, ["model=./model.yaml"]),
    ],
)
def test_keywords_are_the_words_one_types(keys, words):
    assert list(arguments_of("run", (), keys).words) == words


@given(
    st.recursive(
        st.none()
        | st.booleans()
        | st.integers(-(10**12), 10**12)
        | st.floats(allow_nan=False, allow_infinity=False, width=32)
        | st.text(st.characters(codec="utf-8", exclude_characters="$\n\r"), max_size=12),
        lambda inner: st.lists(inner, max_size=3),
        max_leaves=5,
    )
)
def test_a_value_comes_through_the_grammar_as_it_was(value):
    from hydra.core.override_parser.overrides_parser import OverridesParser

    parsed = OverridesParser.create().parse_override(f"key={text_of(value)}").value()

    def plain(found):
        if isinstance(found, list):
            return [plain(item) for item in found]
        return found if found is None or isinstance(found, bool | int | float) else str(found)

    assert plain(parsed) == value
    assert type(plain(parsed)) is type(value)


@pytest.mark.parametrize(
    ("typed", "keys", "words"),
    [
        (["-m"], {}, "sweep"),
        (["--from"], {}, "the arguments"),
        ([3], {}, "3 given"),
        ([], {"controller": Steady}, "give an instance: Steady"),
        (["controller.gain=1"], {"controller": Steady()}, "controller is an object"),
        (["controller=pid"], {"controller": Steady()}, "controller is an object"),
        ([], {"signal@ref.alpha_h": Steady()}, "ref.alpha_h"),
    ],
)
def test_what_cannot_be_is_told(typed, keys, words):
    with pytest.raises(ConfigurationError) as caught:
        arguments_of("run", typed, keys)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("keys", "where", "remedy"),
    [
        ({"ref": lambda t: 0.1}, "ref", "name the axis: ref={'alpha_h'"),
        ({"ref": {"alpha_h": np.zeros(5)}}, "ref.alpha_h", "np.interp"),
        ({"controller": lambda t: 0.1}, "controller", "writing-a-plugin"),
        ({"out": 5}, "out", "path"),
        ({"config_dir": 5}, "config_dir", "path"),
    ],
)
def test_what_cannot_be_that_part_is_answered_with_what_can(keys, where, remedy):
    with pytest.raises(ConfigurationError) as told:
        run(**keys)
    assert told.value.where == where and remedy in told.value.remedy


@pytest.mark.parametrize(
    ("function", "problem"),
    [
        (lambda t: 0.2 if t < 0.5 else 1 / 0, "at 0.50 s: ZeroDivisionError"),
        (lambda t: "text", "'text' at 0.00 s, which is no number"),
    ],
)
def test_a_signal_that_fails_is_told_with_its_line_and_time(function, problem):
    with pytest.raises(SimulationError) as told:
        TimeFunction(function).sample(np.arange(10) / 10)
    assert problem in told.value.problem
    assert told.value.where.startswith(f"{__file__}, line {function.__code__.co_firstlineno}")


def test_what_is_no_run_is_refused(lqr):
    for judge in (compare, score, plot, report):
        with pytest.raises(ConfigurationError, match="3 given"):
            judge(3)
    with pytest.raises(ConfigurationError, match="trms plot LOG --what scene"):
        plot(lqr, what="scene")
