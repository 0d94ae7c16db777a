"""Rates of references: those of what moves smoothly, and none of jumps."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.controllers.reference_forecast import smooth_rates
from trms_cli.models.newtonian import Newtonian

T, N = 0.1, 12


def rates(values: np.ndarray) -> np.ndarray:
    r = ca.MX.sym("r", 1, len(values))
    function = ca.Function("rates", [r], [smooth_rates(r, T)])
    return np.asarray(function(values[None, :]))[0]


def test_ramps_sines_and_constants_have_their_rates() -> None:
    t = T * np.arange(1, N + 1)
    np.testing.assert_allclose(rates(0.3 * t), 0.3)
    assert not rates(np.full(N, 0.4)).any()
    found = rates(np.sin(0.8 * t))
    np.testing.assert_allclose(found[1:], np.diff(np.sin(0.8 * t)) / T)


@pytest.mark.parametrize("at", range(1, N))
def test_a_jump_has_none_wherever_it_is(at: int) -> None:
    assert not rates(np.where(np.arange(N) < at, -0.2, 0.5)).any()


def test_a_ramp_that_stops_keeps_its_rate_until_then() -> None:
    r = np.minimum(np.arange(N), 6) * 0.02
    np.testing.assert_allclose(rates(r), [0.2] * 7 + [0.0] * 5)


def test_the_weight_on_rates_does_not_hold_back_from_a_ramp(close_loop) -> None:
    """However large it is: what it weighs is the rate beside the reference's."""

    def ramp(times: np.ndarray) -> np.ndarray:
        return np.column_stack([0.05 * times - 0.3, 0.08 * times])

    model = Newtonian()
    errors = []
    for weight in (0.1, 3.0):
        mpc = NewtonMpc(rate_weights={"alpha_v": weight, "alpha_h": weight})
        ran = close_loop(mpc, model, ramp, 12.0)
        angles = ran.states[: len(ran.inputs), [5, 2]]
        errors.append(np.abs(angles - ramp(0.1 * np.arange(len(angles))))[-20:].max())
    assert max(errors) < 0.01
