"""Derating: the gain over time and over load."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.effects.supply_derating import SupplyDerating


def derating(depth=0.1, seconds=5.0, rotor="tail"):
    return {"supply": SupplyDerating(rotor=rotor, depth=depth, time_constant=seconds)}


def gains(rig, u, model):
    """Share of a constant command on yaw that reached the motor, per step."""
    x = rig.simulate(model, np.tile([0, u], (1000, 1)))
    return np.diff(x[:, 3]) * 0.05 / 0.02 / u, x[:, -1]


def test_full_load_warms_up_and_takes_the_gain_away(rig):
    gain, warmth = gains(rig, 2.5, rig.extended(rig.turntable(inertia=0.05), derating()))
    t = np.arange(1001) * 0.02
    np.testing.assert_allclose(warmth, 1 - np.exp(-t / 5.0), atol=1e-12)
    assert gain[0] > 0.999
    mean = 1 - 5.0 / 0.02 * np.diff(-np.exp(-t / 5.0))
    np.testing.assert_allclose(gain, 1 - 0.1 * mean, atol=1e-9)


@given(u=st.floats(0.1, 2.5), depth=st.floats(0, 0.3))
@settings(max_examples=25, deadline=None)
def test_a_sagging_supply_loses_gain_at_once_by_the_load(rig, u, depth):
    model = rig.extended(rig.turntable(inertia=0.05), derating())
    model.parameters = model.parameters.replaced(
        {"supply.depth": depth, "supply.time_constant": 0.0}
    )
    gain, _ = gains(rig, u, model)
    np.testing.assert_allclose(gain, 1 - depth * (u / 2.5) ** 2, atol=1e-7)


def test_it_cools_when_the_command_rests(rig):
    model = rig.extended(rig.turntable(), derating())
    u = np.concatenate([np.full(500, -2.5), np.zeros(500)])
    warmth = rig.simulate(model, np.column_stack([np.zeros(1000), u]))[:, -1]
    np.testing.assert_allclose(warmth[-1], (1 - np.exp(-2)) * np.exp(-2), rtol=1e-9)
