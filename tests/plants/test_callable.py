"""A rig behind two functions: what they are given, what is said where they do not keep to it."""

import inspect
import math
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trms_cli.core.errors import ConfigurationError, SimulationError, TrmsError
from trms_cli.core.plugins import build
from trms_cli.plants.callable_rig import CallableRig
from trms_cli.plants.hardware import RestCheck, RigLost
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.wiring import Wire

SETUP = PlantSetup(0.02, 100, 0)
LIMITS = {"u_v": (-2.5, 2.5)}


class Card:
    """A card with a tacho in rpm, an angle in degrees with an offset, and an output in percent."""

    def __init__(self) -> None:
        self.calls: list[Any] = []
        self.reading: Any = {"pitch": 45.0, "speed": 60.0, "spare": "text"}
        self.error: Exception | None = None

    def read(self) -> Any:
        if self.error is not None:
            raise self.error
        return self.reading

    def write(self, values: dict[str, float]) -> None:
        self.calls.append(values)
        if self.error is not None:
            raise self.error

    def open(self) -> None:
        self.calls.append("open")

    def close(self) -> None:
        self.calls.append("close")

    def rig(self, **more: Any) -> CallableRig:
        wiring = {
            "alpha_v": Wire(channel="pitch", sign=-1, unit="deg", offset=90.0),
            "omega_v": Wire(channel="speed", sign=1, unit="rpm"),
            "u_v": Wire(channel="duty", sign=1, scale=0.025),
        }
        given = {"read": self.read, "write": self.write, "limits": LIMITS} | more
        return CallableRig(**{"wiring": wiring} | given)


@pytest.fixture
def card() -> Card:
    return Card()


def connected(card: Card, **more: Any) -> Any:
    run = card.rig(**more).init(SETUP)
    run.connect()
    return run


def test_readings_and_commands_go_through_the_wiring(card):
    run = connected(card, open=card.open, close=card.close)
    assert run.measure() == pytest.approx([math.pi / 4, 2 * math.pi])
    run.advance(np.array([1.25]))
    run.disarm()
    run.close("completed")
    assert card.calls == ["open", {"duty": pytest.approx(50.0)}, {"duty": 0.0}, "close"]


def test_what_was_not_opened_is_not_closed(card):
    def fails() -> None:
        raise OSError("no such card")

    run = card.rig(open=fails, close=card.close).init(SETUP)
    with pytest.raises(SimulationError, match=r"plant\.open failed: OSError: no such card"):
        run.connect()
    run.close("failed")
    assert card.calls == []


@pytest.mark.parametrize(
    ("reading", "words", "remedy"),
    [
        ([45.0, 60.0], r"returned \[45.0, 60.0\], no dictionary", "{'pitch': …, 'speed': …}"),
        (None, "returned None, no dictionary", "{'pitch': …, 'speed': …}"),
        ({"pich": 1.0, "speed": 2.0}, "no 'pitch', the channel of alpha_v", "did you mean pich"),
        ({"pitch": "45", "speed": 2.0}, "returned '45' for 'pitch'", "a number by channel"),
        ({"pitch": None, "speed": 2.0}, "returned None for 'pitch'", "NaN where there is none"),
        ({"pitch": [1, 2], "speed": 2.0}, r"returned \[1, 2\] for 'pitch'", "a number"),
        ({"pitch": True, "speed": 2.0}, "returned True for 'pitch'", "a number"),
    ],
)
def test_what_is_no_reading_is_told_with_file_and_line(card, reading, words, remedy):
    card.reading = reading
    line = inspect.getsourcelines(Card.read)[1]
    with pytest.raises(ConfigurationError, match=words) as first:
        connected(card)
    card.reading = Card().reading
    run = connected(card)
    card.reading = reading
    with pytest.raises(SimulationError, match=words) as later:
        run.measure()
    for error in (first.value, later.value):
        assert error.where == f"{__file__}, line {line}, in read"
        assert remedy in error.remedy


@pytest.mark.parametrize("way", ["read", "write"])
def test_an_exception_is_told_with_the_user_s_own_line(card, way):
    run = connected(card)
    card.error = ValueError("card is off")
    with pytest.raises(
        SimulationError, match=rf"plant\.{way} failed: ValueError: card is off"
    ) as e:
        run.measure() if way == "read" else run.advance(np.zeros(1))
    lines, first = inspect.getsourcelines(getattr(Card, way))
    line = first + next(i for i, text in enumerate(lines) if "raise" in text)
    assert e.value.where == f"{__file__}, line {line}, in {way}"
    assert isinstance(e.value.__cause__, ValueError)


def test_the_line_is_the_user_s_also_where_a_library_failed_below(card):
    def read() -> Any:
        return {"pitch": Path("/there/is/no/such/device").read_text()}

    with pytest.raises(SimulationError) as error:
        connected(card, read=read)
    assert error.value.where.startswith(__file__) and error.value.where.endswith("in read")


def test_a_lost_sample_is_nan_and_a_silence_gives_the_rig_up(card):
    run = connected(card, lost_after=0.05)
    card.reading = {"pitch": math.nan, "speed": 60.0}
    y = run.measure()
    assert math.isnan(y[0]) and y[1] == pytest.approx(2 * math.pi)
    card.reading = {"pitch": math.nan, "speed": math.nan}
    assert np.isnan(run.measure()).all()
    run._pause(0.06)
    with pytest.raises(RigLost, match="has not answered"):
        run.measure()


def test_a_rig_that_moves_is_not_armed(card):
    def read() -> dict[str, float]:
        card.reading = card.reading | {"pitch": card.reading["pitch"] + 5.0}
        return card.reading

    run = connected(card, read=read, rest=RestCheck(duration=0.05))
    with pytest.raises(ConfigurationError, match="alpha_v moved by"):
        run.check()


def test_a_command_that_is_no_number_becomes_the_safe_one(card):
    run = connected(card)
    run.advance(np.array([math.nan]))
    assert card.calls == [{"duty": 0.0}]


def test_channels_are_keys_and_functions_are_functions(card):
    with pytest.raises(ConfigurationError, match="0 given") as error:
        card.rig(wiring={"alpha_v": Wire(channel=0, sign=1), "u_v": Wire(channel="a", sign=1)})
    assert error.value.where == "wiring.alpha_v.channel"
    with pytest.raises(ConfigurationError, match="3 given") as error:
        card.rig(read=3)
    assert error.value.where == "plant.read"
    with pytest.raises(ConfigurationError, match="None given"):
        card.rig(write=None)


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """A module of a user's, not yet allowed."""
    module = types.ModuleType("bench_of_mine")
    code = """
        import math
        from os import system
        def read(): return {"pitch": math.nan}
        def write(values): pass
        class Driver: pass
        number = 3
        """
    exec(inspect.cleandoc(code), module.__dict__)
    monkeypatch.setitem(sys.modules, "bench_of_mine", module)
    monkeypatch.setenv("TRMS_ALLOW", "")
    return module


def built(read: str) -> Any:
    """A plant of a configuration, whose read is named so."""
    return build(
        {
            "_target_": "trms_cli.plants.callable_rig.CallableRig",
            "wiring": {
                "alpha_v": {"channel": "pitch", "sign": 1},
                "u_v": {"channel": "duty", "sign": 1},
            },
            "limits": {"u_v": [-1.0, 1.0]},
            "read": read,
            "write": "bench_of_mine.write",
        },
        "plant",
    )


def test_functions_by_name_are_those_of_an_allowed_package_alone(module, monkeypatch):
    with pytest.raises(ConfigurationError, match="which you have not allowed to run") as error:
        built("bench_of_mine.read")
    assert error.value.where == "plant.read" and "--allow bench_of_mine" in error.value.remedy
    monkeypatch.setenv("TRMS_ALLOW", "bench_of_mine")
    assert built("bench_of_mine.read").function("read") is module.read


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("os.system", "is a part of Python"),
        ("bench_of_mine.system", "is no class of bench_of_mine"),  # imported from elsewhere
        ("bench_of_mine.Driver", "is no function of yours"),
        ("bench_of_mine.number", "is no class of bench_of_mine"),
        ("bench_of_mine.reed", "has no 'reed'"),
        ("read", "is not a dotted name"),
        ("trms_cli.core.yaml_data.load_yaml", "is no plugin"),
        ("trms_cli.effects.model_file.load_model", "is no function of yours"),
    ],
)
def test_what_is_no_such_function_is_refused(module, monkeypatch, name, words):
    monkeypatch.setenv("TRMS_ALLOW", "bench_of_mine")
    with pytest.raises(TrmsError, match=words) as error:
        built(name)
    assert error.value.where == "plant.read"
