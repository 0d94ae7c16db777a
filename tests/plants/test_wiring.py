"""Wiring: numbers of an interface become SI and commands its numbers, and back."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tests.recordings.test_vocabulary import CART
from trms_cli.core.errors import ConfigurationError
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.udp import UdpRig
from trms_cli.plants.wiring import Wire, Wiring, check_wires, zeroed

UNITS = {"u_v": [None, "V", "mV"], "alpha_v": [None, "deg", "rad"], "omega_v": [None, "rpm"]}
sensible = st.floats(-1e3, 1e3, allow_nan=False)
scales = st.floats(1e-3, 1e3) | st.floats(-1e3, -1e-3)
signs = st.sampled_from([1, -1])


@st.composite
def straight(draw, name="u_v"):
    return Wire(
        channel=0,
        sign=draw(signs),
        scale=draw(scales),
        offset=draw(sensible),
        unit=draw(st.sampled_from(UNITS[name])),
    )


@st.composite
def tables(draw):
    """A table that rises in raw and in value."""
    count = draw(st.integers(2, 6))
    steps = st.lists(st.floats(0.01, 10.0), min_size=count, max_size=count)
    raw, values = np.cumsum(draw(steps)), np.cumsum(draw(steps))
    return Wire(
        channel=0, sign=draw(signs), table=tuple(zip(raw.tolist(), values.tolist(), strict=True))
    )


@given(straight() | tables(), st.floats(0.0, 1.0))
def test_raw_is_the_inverse_of_values(wire, share):
    """For commands; of a table between its ends."""
    if wire.table:
        ends = [pair[1] * wire.sign for pair in wire.table]
        value = ends[0] + share * (ends[-1] - ends[0])
    else:
        value = -5.0 + 10.0 * share
    wiring = Wiring({"u_v": wire}, ["u_v"], "plant.wiring")
    scale = abs(wire.offset * wire.scale) + 5.0
    assert wiring.values(wiring.raw([value])) == pytest.approx([value], abs=1e-9 * scale)


@given(straight("alpha_v"), sensible)
def test_a_reading_is_what_the_wire_s_own_words_say(wire, raw):
    factor = {None: 1.0, "rad": 1.0, "deg": math.pi / 180}[wire.unit]
    value = wire.sign * factor * (wire.scale * (raw - wire.offset))
    wiring = Wiring({"alpha_v": wire}, ["alpha_v"], "plant.wiring")
    assert wiring.values([raw]) == pytest.approx([value], rel=1e-9, abs=1e-9)


@given(straight("alpha_v"), sensible, st.floats(-7.0, 7.0))
def test_a_zeroed_wire_reads_the_rest_at_rest(wire, raw, rest):
    wiring = Wiring({"alpha_v": zeroed(wire, "alpha_v", raw, rest)}, ["alpha_v"], "plant.wiring")
    assert wiring.values([raw]) == pytest.approx([rest], abs=1e-6)


@given(straight(), st.floats(-5.0, 0.0), st.floats(0.1, 5.0), st.floats(-20.0, 20.0))
def test_commands_are_cut_to_their_limit(wire, low, width, value):
    limit = (low, low + width)
    cut = Wire(
        channel=0,
        sign=wire.sign,
        scale=wire.scale,
        offset=wire.offset,
        unit=wire.unit,
        limit=limit,
    )
    free = Wiring({"u_v": wire}, ["u_v"], "plant.wiring")
    wiring = Wiring({"u_v": cut}, ["u_v"], "plant.wiring")
    assert wiring.raw([value]) == free.raw([min(max(value, limit[0]), limit[1])])
    assert [bound.tolist() for bound in wiring.limits()] == [[limit[0]], [limit[1]]]


@given(st.floats(-10.0, 10.0))
def test_a_reading_beyond_its_limit_is_lost_and_an_infinite_one_is_kept_for_the_envelope(raw):
    wire = Wire(channel=0, sign=1, limit=(-1.0, 2.0))
    wiring = Wiring({"alpha_v": wire}, ["alpha_v"], "plant.wiring")
    (value,) = wiring.values([raw])
    assert value == raw if -1.0 <= raw <= 2.0 else math.isnan(value)
    assert wiring.values([math.inf])[0] == math.inf
    assert math.isnan(wiring.values([math.nan])[0])


@given(tables(), st.floats(-5.0, 80.0))
def test_a_table_is_held_at_its_ends(wire, raw):
    assume(math.isfinite(raw))
    (value,) = Wiring({"omega_v": wire}, ["omega_v"], "plant.wiring").values([raw])
    low, high = sorted(pair[1] * wire.sign for pair in (wire.table[0], wire.table[-1]))
    assert low - 1e-9 <= value <= high + 1e-9


def test_signals_stand_in_the_order_of_the_rig_and_in_si():
    wires = {
        "omega_h": Wire(channel=2, sign=1, unit="rpm"),
        "alpha_v": Wire(channel=7, sign=-1, unit="deg"),
        "u_v": Wire(channel=0, sign=1),
    }
    order = ("alpha_v", "alpha_h", "omega_v", "omega_h")
    wiring = Wiring(wires, order, "plant.wiring")
    assert wiring.names == ("alpha_v", "omega_h") and wiring.channels == [7, 2]
    assert [signal.unit for signal in wiring.signals] == ["rad", "rad/s"]
    assert wiring.values([180.0, 60.0]) == pytest.approx([-math.pi, 2 * math.pi])


def test_without_limits_there_are_none():
    low, high = Wiring({"u_v": Wire(channel=0, sign=1)}, ["u_v"], "").limits()
    assert low.tolist() == [-math.inf] and high.tolist() == [math.inf]


@pytest.mark.parametrize(
    ("keys", "where"),
    [
        ({"scale": 0.0}, "scale"),
        ({"scale": math.inf}, "scale"),
        ({"limit": (1.0, 1.0)}, "limit"),
        ({"table": ((0.0, 1.0),)}, "table"),
        ({"table": ((0.0, 1.0), (0.0, 2.0))}, "table"),
    ],
)
def test_a_wire_that_makes_no_sense_is_refused(keys, where):
    with pytest.raises(ConfigurationError) as error:
        Wire(channel=0, sign=1, **keys)
    assert error.value.where == where


@pytest.mark.parametrize(
    ("wires", "where", "words"),
    [
        (
            {"u_v": Wire(channel=0, sign=1), "u_h": Wire(channel=0, sign=1)},
            "w.u_h.channel",
            "that of u_v",
        ),
        ({"u_v": Wire(channel=0, sign=1, unit="deg")}, "w.u_v.unit", "does not fit"),
        ({"u_v": Wire(channel=0, sign=1, unit="voltz")}, "w.u_v.unit", "not known"),
        (
            {"u_v": Wire(channel=0, sign=1, table=((0.0, 2.0), (1.0, 1.0)))},
            "w.u_v.table",
            "no inverse",
        ),
    ],
)
def test_a_wiring_that_makes_no_sense_is_refused(wires, where, words):
    with pytest.raises(ConfigurationError, match=words) as error:
        Wiring(wires, ("u_v", "u_h"), "w")
    assert error.value.where == where


def test_a_signal_that_no_rig_has_is_refused_with_the_nearest():
    with pytest.raises(ConfigurationError, match="no signal 'alpha_w'") as error:
        check_wires({"alpha_w": Wire(channel=0, sign=1)}, "wiring", ("alpha_v", "u_v"))
    assert "did you mean alpha_" in error.value.remedy


UDP = {"host": "127.0.0.1", "port": 47800}


def test_a_rig_with_other_names_is_wired_by_its_model():
    rig = UdpRig(
        **UDP,
        wiring={
            "position": Wire(channel=1, sign=-1, scale=2.0, unit="mm"),
            "current": Wire(channel=0, sign=1, unit="mA"),
        },
        limits={"current": (-5.0, 5.0), "u_v": (-2.5, 2.5)},  # the other is the bench's
    )
    run = rig.init(PlantSetup(0.02, 10, 0, CART))
    assert [(s.name, s.unit) for s in (*run.outputs, *run.inputs)] == [
        ("position", "m"),
        ("current", "A"),
    ]
    assert run.input_limits[1].tolist() == [5.0] and run.noise_sd == {"position": 1e-6}
    for model, wrong, words in (
        (None, "position", "no signal 'position'"),
        (CART, "velocity", "no signal 'velocity'"),
        (CART, "current", "no readings are wired"),
    ):
        with pytest.raises(ConfigurationError, match=words) as error:
            wires = {wrong: Wire(channel=0, sign=1), "current": Wire(channel=1, sign=1)}
            UdpRig(**UDP, wiring=wires).init(PlantSetup(0.02, 10, 0, model))
        assert error.value.where.startswith("plant.wiring")
