"""First-order lag against its closed form."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from trms_cli.effects.actuator_lag import ActuatorLag
from trms_cli.effects.first_order import first_order


def lag(seconds, rotor="tail"):
    return {"lag": ActuatorLag(rotor=rotor, time_constant=seconds)}


@given(seconds=st.floats(1e-4, 0.5), substeps=st.sampled_from([1, 4]))
@settings(max_examples=40, deadline=None)
def test_a_step_arrives_as_an_exponential_with_exact_momentum(rig, seconds, substeps):
    model = rig.extended(rig.turntable(inertia=0.05), lag(0.1))
    model.parameters = model.parameters.replaced({"lag.time_constant": seconds})
    x = rig.simulate(model, np.tile([0, 1.0], (50, 1)), substeps=substeps)
    t = np.arange(51) * 0.02
    np.testing.assert_allclose(x[:, -1], 1 - np.exp(-t / seconds), atol=1e-12)
    momentum = t - seconds * (1 - np.exp(-t / seconds))
    np.testing.assert_allclose(x[:, 3], momentum / 0.05, atol=1e-10)


@pytest.mark.parametrize("rotor", ["main", "tail"])
def test_the_rig_behind_a_lag_equals_another_integration(rig, rotor):
    base = rig.newtonian()
    f = rig.right_hand_side(base)
    channel = {"main": 0, "tail": 1}[rotor]

    def slope(t, z):
        u = np.array([1.4, 0.5])
        u[channel] = z[6]
        return [*f(z[:6], u, [0, 0, 0, 0]), ([1.4, 0.5][channel] - z[6]) / 0.08]

    reference = solve_ivp(
        slope, (0, 4), [*base.rest(), 0], t_eval=np.arange(201) * 0.02, rtol=1e-10, atol=1e-12
    )
    x = rig.simulate(rig.extended(base, lag(0.08, rotor)), np.tile([1.4, 0.5], (200, 1)))
    np.testing.assert_allclose(x, reference.y.T, atol=2e-3, rtol=1e-5)
    np.testing.assert_allclose(x[:, 2:3], reference.y[2:3].T, atol=3e-6)


def test_without_a_time_constant_it_is_the_command_and_has_finite_slopes():
    v, u, tau = (ca.SX.sym(name) for name in ("v", "u", "tau"))
    mean, after = first_order(v, u, tau, 0.005)
    values = ca.Function("f", [v, u, tau], [mean, after])
    slopes = ca.Function(
        "J", [v, u, tau], [ca.jacobian(ca.vertcat(mean, after), ca.vertcat(v, u, tau))]
    )
    for command in (0.1, 1 / 3, -2.5):
        assert [float(v) for v in values(0.7, command, 0.0)] == [command, command]
    assert np.all(np.isfinite(np.asarray(slopes(0.7, 0.1, 0.0))))
    # The mean over the window falls short by the lag itself.
    np.testing.assert_allclose(float(slopes(0.7, 0.1, 0.0)[0, 2]), (0.7 - 0.1) / 0.005)
