"""What a missing force looks like, on forces that are known: of the state, from outside, noise."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from trms_cli.gap.force.description import (
    all_conditions,
    change_time,
    nearest_round_number,
    regions,
)
from trms_cli.gap.force.exogenous import exogenous
from trms_cli.gap.force.laws import ForceRecord

from .recorded import STEP, Law, coloured, moved

SAMPLES = 6000
#: Torques on yaw.
LAWS: dict[str, Law] = {
    "coulomb": lambda t, a, r, p, wv, wh: -0.004 * np.tanh(r / 0.01),
    "quadratic": lambda t, a, r, p, wv, wh: -0.01 * r * abs(r),
    "stop": lambda t, a, r, p, wv, wh: -0.02 * (a - 0.8 * np.sign(a)) * (abs(a) > 0.8),
    "cubic": lambda t, a, r, p, wv, wh: -0.01 * a**3,
    "reverse": lambda t, a, r, p, wv, wh: 4e-8 * wh * abs(wh) * (wh < 0),
    "reaction": lambda t, a, r, p, wv, wh: 3e-7 * wv**2 * np.cos(p),
    "later": lambda t, a, r, p, wv, wh: -0.01 * r * (t > 61),
}


@cache
def under(name: str) -> ForceRecord:
    return moved(np.random.default_rng(1), LAWS[name])


@cache
def still() -> ForceRecord:
    return moved(np.random.default_rng(2))


def from_outside(seed: int, time: float) -> ForceRecord:
    """A force that has nothing to do with the motion, known exactly or nearly."""
    rng = np.random.default_rng(seed)
    force = coloured(rng, SAMPLES, time) if time > STEP else rng.normal(size=SAMPLES)
    return replace(still(), force=4e-3 * force, sd=np.full(SAMPLES, 1e-3))


def test_recordings_and_gaps_part_the_samples():
    with pytest.raises(ValueError, match="differ in shape"):
        replace(still(), sd=np.ones(3))
    record = still().subset(np.r_[0:1000, 1500:2500, 3000:4000])
    record = replace(record, recording=np.repeat([0, 0, 1], 1000))
    assert [part.stop for part in record.segments] == [1000, 2000, 3000]
    number = record.blocks(10.0)
    assert number[-1] == 5 and np.all(np.diff(number) >= 0)
    for part in record.segments:
        assert number[part.start] != number[part.start - 1]
    assert record.thinned(10.0).time.size == 600


def test_memory_of_coloured_noise():
    record = still()
    values = coloured(np.random.default_rng(3), SAMPLES, 0.5)
    assert record.correlation_time(values) == pytest.approx(1.0, rel=0.4)


@pytest.mark.parametrize(
    ("value", "rounded_value"),
    [(0.4817, 0.5), (-0.317, -0.3), (123.0, 120.0), (0.0, 0.0), (9.6, 10.0)],
)
def test_thresholds_are_round(value, rounded_value):
    assert nearest_round_number(value) == pytest.approx(rounded_value)


@pytest.mark.parametrize(
    ("name", "about", "of"),
    [
        ("coulomb", None, "yaw rate"),
        ("quadratic", "yaw moving fast", "yaw rate"),
        ("stop", "|alpha_h| >", None),
        ("cubic", "|alpha_h| >", "yaw angle"),
        ("reverse", None, "tail rotor speed"),
        ("reaction", "main rotor fast", "main rotor speed"),
        ("later", "after t = 61", None),
    ],
)
def test_a_function_of_the_state_has_a_region_and_is_predictable(name, about, of):
    if about is not None:
        force_regions = regions(under(name))
        assert 1 <= len(force_regions) <= 3
        assert force_regions[0].condition.startswith(about)
        assert force_regions[0].location == "yaw_moment"
        assert force_regions[0].share > 0.7
    if of is not None:
        judged = exogenous(under(name))
        low, high = judged.ci95
        assert judged.predictable_share > 0.5 and low <= judged.predictable_share <= high
        assert judged.p_value < 0.05
        assert judged.from_variables[0] == of


def test_thrust_in_reverse_lies_where_the_rotor_turns_backwards():
    rng = np.random.default_rng(11)
    record = moved(rng, lambda t, a, r, p, wv, wh: 4e-3 * (wh < -20))
    (first, *_) = regions(record)
    assert first.condition == "tail rotor turning backwards" and first.share > 0.95


@pytest.mark.parametrize("time", [0.0, 0.3, 1.0, 3.0])
def test_a_force_from_outside_has_no_region(time):
    regions_by_seed = [regions(from_outside(seed, time)) for seed in range(8)]
    assert sum(map(bool, regions_by_seed)) <= 1


def test_neither_a_constant_force_nor_noise_alone_has_a_region():
    noise = 1e-4 * np.random.default_rng(0).normal(size=SAMPLES)
    record = replace(still(), force=3e-3 + noise, sd=np.full(SAMPLES, 1e-4))
    assert regions(record) == ()
    record = from_outside(1, 0.1)
    assert regions(replace(record, sd=np.full(SAMPLES, 4e-3))) == ()


def test_change_time():
    assert change_time(under("later")) == pytest.approx(61, abs=1.5)
    assert change_time(under("quadratic")) is None
    assert change_time(from_outside(1, 0.3)) is None


def test_a_recording_of_its_own_is_a_region():
    record = from_outside(4, 0.3)
    number = np.repeat([0, 1, 2], SAMPLES // 3)
    record = replace(record, recording=number, force=record.force * (number == 1))
    (region,) = regions(replace(record, sd=record.sd / 10))
    assert region.condition == "recording 2" and region.share > 0.9


def test_one_degree_of_freedom_without_rotor_speeds():
    full = under("stop")
    record = replace(
        full,
        angles={"yaw": full.angles["yaw"]},
        rates={"yaw": full.rates["yaw"]},
        speeds={},
        commands={"tail": full.commands["tail"]},
    )
    assert regions(record)[0].condition.startswith("|alpha_h| >")
    assert exogenous(record).predictable_share > 0.5
    assert not any("alpha_v" in c.text or "main" in c.text for c in all_conditions(record))


@pytest.mark.parametrize(("size", "time"), [(0.003, 1.0), (0.01, 0.3), (0.01, 1.0), (0.01, 3.0)])
def test_a_draught_is_not_predictable_though_it_moves_the_rig(time, size):
    rng = np.random.default_rng(7)
    judged = exogenous(moved(rng, outside=size * coloured(rng, SAMPLES, time)))
    assert judged.predictable_share < 0.15
    assert judged.ci95[0] < 0.05


def test_a_draught_that_moves_nothing_is_not_predictable():
    shares = [exogenous(from_outside(seed, 1.0)).predictable_share for seed in range(3)]
    assert max(shares) < 0.15


def test_scaling_changes_no_share():
    record = under("cubic")
    scaled = replace(record, force=1e3 * record.force, sd=1e3 * record.sd)
    assert [r.condition for r in regions(scaled)] == [r.condition for r in regions(record)]
    assert [r.share for r in regions(scaled)] == pytest.approx([r.share for r in regions(record)])
    assert exogenous(scaled).predictable_share == pytest.approx(
        exogenous(record).predictable_share, abs=1e-6
    )


def test_the_same_seed_judges_the_same():
    assert exogenous(under("stop"), seed=3) == exogenous(under("stop"), seed=3)
