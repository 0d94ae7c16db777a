"""The forecast of a reference: exact for what it knows, silent about what it does not."""

from collections.abc import Callable

import casadi as ca
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.controllers.reference_forecast import ReferenceForecast, smooth_rates
from trms_cli.models.newtonian import Newtonian

from .closed_loop_case import close_loop

T = 0.1


def forecast(signal: Callable[[np.ndarray], np.ndarray], samples: int, horizon: int) -> np.ndarray:
    """What is foreseen at the last of ``samples`` periods, (horizon + 1 or 1,)."""
    foresight = ReferenceForecast(horizon, 1)
    rows = np.zeros((1, 1))
    for value in signal(T * np.arange(samples)):
        rows = foresight.update(np.array([value]))
    return rows[:, 0]


@settings(max_examples=60, deadline=None)
@given(
    frequency=st.floats(0.02, 1.0), amplitude=st.floats(0.05, 1.0), phase=st.floats(-3.0, 3.0),
    offset=st.floats(-1.0, 1.0), samples=st.integers(8, 60),
)  # fmt: skip
def test_a_sine_with_an_offset_is_foreseen(frequency, amplitude, phase, offset, samples) -> None:
    def signal(t: np.ndarray) -> np.ndarray:
        return offset + amplitude * np.sin(2 * np.pi * frequency * t + phase)

    seen = forecast(signal, samples, 15)
    truth = signal(T * (samples - 1 + np.arange(16)))
    np.testing.assert_allclose(seen, truth, atol=1e-5 * amplitude)


def test_a_ramp_is_foreseen_and_each_axis_for_itself() -> None:
    seen = forecast(lambda t: 0.3 * t - 1.0, 10, 20)
    np.testing.assert_allclose(seen, 0.3 * T * (9 + np.arange(21)) - 1.0, atol=1e-9)
    foresight = ReferenceForecast(5, 2)
    rows = np.zeros((1, 2))
    for k in range(20):
        rows = foresight.update(np.array([0.1 * k, 0.5]))
    assert rows.shape == (6, 2)
    np.testing.assert_allclose(rows[:, 0], 1.9 + 0.1 * np.arange(6))
    assert np.all(rows[:, 1] == 0.5)


def test_a_constant_noise_and_the_first_samples_have_no_forecast() -> None:
    assert forecast(lambda t: np.full_like(t, 0.4), 20, 15).shape == (1,)
    assert forecast(np.sin, 6, 15).shape == (1,)
    noise = np.random.default_rng(0).standard_normal(40)
    assert forecast(lambda t: 0.01 * noise[: len(t)], 40, 15).shape == (1,)


def test_a_jump_is_never_carried_on_and_in_a_sine_stops_the_forecast_until_it_has_passed() -> None:
    # For as long as it is among the differences that are looked at.
    for after in range(1, 7):
        start = T * (20 - after) - 1e-9
        assert forecast(lambda t, start=start: 0.5 * (t >= start), 20, 15).shape == (1,)

    def signal(t: np.ndarray) -> np.ndarray:
        return np.sin(0.5 * t) + np.where(t >= 1.95, 0.3, 0.0)

    assert forecast(signal, 21, 15).shape == (1,)
    assert forecast(signal, 35, 15).shape == (16,)


N = 12


def rates(values: np.ndarray) -> np.ndarray:
    r = ca.MX.sym("r", 1, len(values))
    function = ca.Function("rates", [r], [smooth_rates(r, T)])
    return np.asarray(function(values[None, :]))[0]


def test_ramps_sines_and_constants_have_their_rates_and_jumps_have_none() -> None:
    t = T * np.arange(1, N + 1)
    np.testing.assert_allclose(rates(0.3 * t), 0.3)
    assert not rates(np.full(N, 0.4)).any()
    found = rates(np.sin(0.8 * t))
    np.testing.assert_allclose(found[1:], np.diff(np.sin(0.8 * t)) / T)
    r = np.minimum(np.arange(N), 6) * 0.02
    np.testing.assert_allclose(rates(r), [0.2] * 7 + [0.0] * 5)  # a ramp that stops, until then
    for at in range(1, N):
        assert not rates(np.where(np.arange(N) < at, -0.2, 0.5)).any()


def test_the_weight_on_rates_does_not_hold_back_from_a_ramp() -> None:
    """However large it is: what it weighs is the rate beside the reference's."""

    def ramp(times: np.ndarray) -> np.ndarray:
        return np.column_stack([0.05 * times - 0.3, 0.08 * times])

    for weight in (0.1, 3.0):
        mpc = NewtonMpc(rate_weights={"alpha_v": weight, "alpha_h": weight})
        assert np.abs(close_loop(mpc, Newtonian(), ramp, 12.0).errors[-20:]).max() < 0.01
