"""Effects on the thrust: another power, inflow, ground effect."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.core.errors import ModelError
from trms_cli.effects.ground_effect import GroundEffect
from trms_cli.effects.inflow import Inflow
from trms_cli.effects.thrust_curve import ThrustCurve
from trms_cli.models.tras import Tras

AXIS = {"main": "pitch", "tail": "yaw"}
SPEED = {"main": "omega_v", "tail": "omega_h"}


def added_torque(rig, base, effect, state):
    """Torque on pitch and yaw that an effect adds at a state, N m, and the base's quantities."""
    at = base.rest()
    for name, value in state.items():
        at[base.state_index(name)] = value
    quantities = rig.quantities(base, at)
    slopes = [
        rig.right_hand_side(m)(at, np.zeros(base.n_u), np.zeros(base.n_w))
        for m in (base, rig.extended(base, {"e": effect}))
    ]
    change = slopes[1] - slopes[0]
    return (
        change[base.state_index("S_v")] * quantities["inertia_pitch"],
        change[base.state_index("S_h")] * quantities["inertia_yaw"],
        quantities,
    )


@pytest.fixture(params=["newtonian", "tras"])
def base(rig, request):
    return rig.newtonian() if request.param == "newtonian" else Tras()


@pytest.mark.parametrize("rotor", ["main", "tail"])
@given(
    speed=st.floats(-300, 300),
    exponent=st.floats(-0.5, 0.5),
    reverse=st.floats(-0.5, 0.5),
    pitch=st.floats(-0.8, 0.8),
)
@settings(max_examples=12, deadline=None)
def test_the_thrust_follows_the_power_and_the_ratio(rig, rotor, speed, exponent, reverse, pitch):
    model = rig.newtonian()
    effect = ThrustCurve(rotor=rotor, exponent=exponent, reverse=reverse, reference=200.0)
    on_pitch, on_yaw, known = added_torque(
        rig, model, effect, {SPEED[rotor]: speed, "alpha_v": pitch}
    )
    size = max(abs(speed), 1e-3)
    factor = (size / 200.0) ** exponent * (1 + reverse * (speed < 0))
    expected = known[f"arm_{rotor}"] * known[f"thrust_{rotor}"] * (factor - 1)
    got, other = (on_pitch, on_yaw) if rotor == "main" else (on_yaw, on_pitch)
    assert got == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert other == 0.0


def test_typical_sizes_take_the_share_of_thrust_that_rigs_show(rig):
    """Of the exponent 5 to 7 % of full thrust, at the speed where it is largest."""
    model = rig.newtonian()
    effect = rig.effect("main_thrust_curve")
    full = added_torque(rig, model, effect, {"omega_v": 230.0})[2]["thrust_main"]
    losses = []
    for speed in np.linspace(20, 230, 12):
        on_pitch, _, known = added_torque(rig, model, effect, {"omega_v": speed})
        losses.append(abs(on_pitch) / known["arm_main"] / full)
    assert 0.02 < max(losses) < 0.08
    state = {"omega_v": 196.0, "S_v": 0.5}
    on_pitch, _, known = added_torque(rig, model, rig.effect("main_inflow"), state)
    assert 0.01 < -on_pitch / (known["arm_main"] * known["thrust_main"]) < 0.08


@pytest.mark.parametrize("rotor", ["main", "tail"])
@given(speed=st.floats(-300, 300), rate=st.floats(-2, 2), coefficient=st.floats(0, 100))
@settings(max_examples=12, deadline=None)
def test_inflow_is_a_damping_that_grows_with_the_speed(rig, rotor, speed, rate, coefficient):
    model = rig.newtonian()
    momentum = {"main": "S_v", "tail": "S_h"}[rotor]
    state = {SPEED[rotor]: speed, momentum: rate}
    effect = Inflow(rotor=rotor, coefficient=coefficient)
    on_pitch, on_yaw, known = added_torque(rig, model, effect, state)
    got = on_pitch if rotor == "main" else on_yaw
    # A tail rotor's speed is part of the momentum of the pitch and the other way round: the rates
    # here are those of the own axis, whose momentum holds the other rotor's speed of zero.
    arm = known[f"arm_{rotor}"]
    if abs(speed) > 1e-3:
        expected = -coefficient * arm * rate / speed * known[f"thrust_{rotor}"] * arm
        assert got == pytest.approx(expected, rel=1e-9, abs=1e-15)
    assert got * rate <= 1e-15


def test_ground_effect_is_the_cushion_s_share_of_the_thrust(rig, base):
    effect = GroundEffect(gain=0.3, scale=0.1, level_height=0.2)
    for speed, pitch in ((150.0, -0.5), (150.0, 0.3), (-150.0, -0.5), (0.0, -0.5)):
        on_pitch, on_yaw, known = added_torque(
            rig, base, effect, {"omega_v": speed, "alpha_v": pitch}
        )
        height = 0.2 + known["arm_main"] * np.sin(pitch)
        thrust = max(known["thrust_main"], 0.0)
        expected = known["arm_main"] * thrust * 0.3 * np.exp(-height / 0.1)
        assert on_pitch == pytest.approx(expected, rel=1e-9, abs=1e-15)
        assert on_yaw == 0.0


def test_a_model_that_does_not_name_its_thrust_is_refused(rig):
    with pytest.raises(ModelError, match="speed of the main rotor"):
        rig.extended(rig.turntable(), {"e": Inflow(rotor="main", coefficient=1.0)})
