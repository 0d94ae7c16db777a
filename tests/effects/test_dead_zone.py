"""Dead zone: the map, and what reaches the motor."""

import casadi as ca
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.effects.dead_zone import DeadZone


def zone(width, rotor="main"):
    return {"zone": DeadZone(rotor=rotor, width=width)}


def reaching(model):
    u, p = ca.SX.sym("u", 2), ca.SX.sym("p", len(model.parameters))
    arriving, _ = model.input_path(ca.SX.zeros(0, 1), u, p, (0.0, 1.0), 0.02)
    return ca.Function("v", [u, p], [arriving])


@given(u=st.floats(-2.5, 2.5), width=st.floats(0, 1))
def test_the_map_is_continuous_and_odd_and_loses_the_width(rig, u, width):
    model = rig.extended(rig.newtonian(), zone(0.1))
    p = model.parameters.replaced({"zone.width": width}).values
    v = reaching(model)
    got = float(v([u, 0.3], p)[0])
    assert got == -float(v([-u, 0.3], p)[0])
    assert np.isclose(got, np.sign(u) * max(abs(u) - width, 0.0), atol=1e-15)
    assert float(v([u, 0.3], p)[1]) == 0.3


def test_below_its_width_the_rig_does_not_feel_a_command(rig):
    u = np.column_stack([0.1 * np.sin(np.arange(500)), 0.5 * np.cos(np.arange(500) / 30)])
    still = u * [0.0, 1.0]
    model = rig.extended(rig.newtonian(), zone(0.1))
    np.testing.assert_array_equal(rig.simulate(model, u), rig.simulate(rig.newtonian(), still))


def test_beyond_its_width_the_rig_feels_the_rest(rig):
    model = rig.extended(rig.newtonian(), zone(0.1))
    x = rig.simulate(model, np.tile([1.4, 0.2], (300, 1)))
    expected = rig.simulate(rig.newtonian(), np.tile([1.3, 0.2], (300, 1)))
    np.testing.assert_allclose(x, expected, atol=1e-10)
