"""Describing functions against Fourier integrals, and one harmonic against what is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.stability.cycles.stick_slip import (
    FrictionLaw,
    FrictionLoop,
    HarmonicBalance,
    sliding_cycle,
)

SIZES = st.floats(1e-3, 0.1)


@settings(max_examples=30)
@given(torque=SIZES, excess=st.floats(0.0, 2.0), velocity=SIZES, amplitude=st.floats(1e-4, 10.0))
def test_of_a_sine_of_the_rate(torque, excess, velocity, amplitude):
    """N(A) = (1/πA) ∫ F(A sin θ) sgn(sin θ) sin θ dθ over a turn."""
    law = FrictionLaw(torque, excess, velocity)
    nodes, weights = np.polynomial.legendre.leggauss(400)
    theta = 0.25 * np.pi * (nodes + 1)  # a quarter of a turn, the others are alike
    integral = (
        0.25 * np.pi * np.sum(weights * law.moment(amplitude * np.sin(theta)) * np.sin(theta))
    )
    assert law.describing(amplitude) == pytest.approx(4 * integral / (np.pi * amplitude), rel=1e-6)


@settings(max_examples=20)
@given(torque=SIZES, amplitude=SIZES)
def test_coulomb_is_the_relay(torque, amplitude):
    assert FrictionLaw(torque).describing(amplitude) == pytest.approx(
        4 * torque / (np.pi * amplitude), rel=1e-12
    )


def spring_and_relay(damping: float) -> FrictionLoop:
    """J Ω̇ = −k α − d Ω + τ with a lagging spring: states α, Ω, and the spring behind its lag."""
    k, lag = 4.0, 0.3
    A = np.array([[0.0, 1.0, 0.0], [0.0, -damping, -1.0], [k / lag, 0.0, -1.0 / lag]])
    return FrictionLoop(
        A, np.array([0.0, 1.0, 0.0]), np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    )


def test_an_axis_that_is_pushed_hard_hardly_feels_its_friction():
    loop = spring_and_relay(1.0)
    one = HarmonicBalance(loop, FrictionLaw(1e-6))
    answer = one.answer(1.0, 3.0)
    assert answer.ratio == pytest.approx(1 / 3.0j, abs=2e-3)
    assert answer.swing == pytest.approx(2 / 9.0, rel=2e-3) and answer.stuck == 0.0


def test_an_axis_that_is_pushed_too_little_sticks():
    answer = HarmonicBalance(spring_and_relay(1.0), FrictionLaw(1.0, 0.5, 0.1)).answer(1.4, 3.0)
    assert answer.ratio == 0 and answer.swing == 0 and answer.stuck == 1.0


def test_the_amplitude_at_which_friction_balances_a_negative_damping():
    """A lag in the spring drives the swing, Coulomb friction holds it: an unstable sliding cycle.

    With viscous damping N the characteristic polynomial is
    ``lag s³ + (1 + lag (d + N)) s² + (d + N) s + k``: at its limit ω² = k/(1 + lag (d + N)) and
    d + N = lag ω², whose positive root is known.
    """
    lag, k, d = 0.3, 4.0, 0.2
    needed = (-1 + np.sqrt(1 + 4 * lag * lag * k)) / (2 * lag)  # lag c² + c − lag k = 0
    amplitude, omega = sliding_cycle(
        spring_and_relay(d), FrictionLaw(0.05), np.geomspace(0.1, 30.0, 4000)
    )
    assert omega == pytest.approx(np.sqrt(needed / lag), rel=1e-6)
    assert amplitude == pytest.approx(4 * 0.05 / (np.pi * (needed - d)), rel=1e-6)


def test_without_a_crossing_there_is_no_sliding_cycle():
    assert (
        sliding_cycle(spring_and_relay(5.0), FrictionLaw(0.05), np.geomspace(0.1, 30, 500)) is None
    )
