"""Delay of any fraction of a sample."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.effects.input_delay import InputDelay

STEP = 0.02


def delay(seconds, longest=0.1, rotor="tail"):
    return {"delay": InputDelay(rotor=rotor, delay=seconds, longest=longest)}


@pytest.mark.parametrize("steps", [1, 3, 5])
def test_a_delay_of_whole_samples_is_a_shifted_input(rig, steps):
    u = rig.rich_input(600)
    shifted = u.copy()
    shifted[:, 1] = np.concatenate([np.zeros(steps), u[:-steps, 1]])
    model = rig.extended(rig.newtonian(), delay(steps * STEP))
    x = rig.simulate(model, u)[:, :6]
    np.testing.assert_allclose(x, rig.simulate(rig.newtonian(), shifted), atol=1e-9)


@given(seconds=st.floats(0, 0.1), seed=st.integers(0, 100), substeps=st.sampled_from([1, 3, 4]))
@settings(max_examples=60, deadline=None)
def test_a_delay_of_any_fraction_gives_the_exact_momentum(rig, seconds, seed, substeps):
    """A turntable's rate is the integral of the command that arrived so far."""
    u = np.random.default_rng(seed).normal(size=(40, 2))
    model = rig.extended(rig.turntable(inertia=0.05), delay(0.05))
    model.parameters = model.parameters.replaced({"delay.delay": seconds})
    rate = rig.simulate(model, u, substeps=substeps)[:, 3]
    t = np.arange(41) * STEP
    integral = np.interp(t - seconds, t, np.concatenate([[0], np.cumsum(u[:, 1] * STEP)]))
    np.testing.assert_allclose(rate, integral / 0.05, atol=1e-10)


def test_the_derivative_in_the_delay_is_exact(rig):
    u = np.random.default_rng(0).normal(size=(40, 2))
    rates = []
    for seconds in (0.033 - 1e-6, 0.033 + 1e-6):
        rates.append(rig.simulate(rig.extended(rig.turntable(), delay(seconds)), u)[:, 3])
    slope = (rates[1] - rates[0]) / 2e-6
    arriving = np.concatenate([np.zeros(2), u[:, 1]])[:41]  # the command of 33 ms ago
    np.testing.assert_allclose(slope, -arriving / 0.05, rtol=1e-5, atol=1e-6)


def test_the_other_rotor_is_not_delayed(rig):
    u = np.column_stack([rig.rich_input(50)[:, 0], np.zeros(50)])
    model = rig.extended(rig.newtonian(), delay(0.06))
    np.testing.assert_array_equal(rig.simulate(model, u)[:, :6], rig.simulate(rig.newtonian(), u))
