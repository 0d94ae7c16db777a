"""Reaction and gyroscopic coupling: the published check values, energy, momentum."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.effects.gyroscopic_coupling import GyroscopicCoupling
from trms_cli.effects.rotor_reaction import RotorReaction
from trms_cli.models.model import RigRotor, Signal
from trms_cli.models.steady_state import SteadyState
from trms_cli.models.tras import Tras

from .conftest import Turntable


def reaction(rotor="main", drag=0.0, inertia=0.0):
    return {"reaction": RotorReaction(rotor=rotor, drag=drag, inertia=inertia)}


def test_hover_needs_the_tail_command_of_the_check_value_or_yaw_drifts_as_far_as_published(rig):
    base = rig.newtonian()
    model = rig.extended(base, reaction(drag=base.parameters["k_tvp"].value))
    target = SteadyState(model).solve(np.zeros(2), np.zeros(model.n_w), None)
    assert not target.projected
    u = dict(zip(("u_v", "u_h"), target.u, strict=True))
    assert u["u_h"] == pytest.approx(-0.776, abs=0.002)
    assert u["u_v"] == pytest.approx(1.413, abs=0.002)
    # Without a tail command:
    start = base.rest()
    start[base.state_index("alpha_v")] = 0.0
    start[base.state_index("omega_v")] = 196.3
    x = rig.simulate(model, np.tile([1.413, 0.0], (4000, 1)), start=start)
    assert x[-1, base.state_index("alpha_h")] == pytest.approx(1.23, abs=0.01)


@given(seed=st.integers(0, 1000), inertia=st.floats(-1e-4, 1e-4))
@settings(max_examples=8, deadline=None)
def test_its_inertia_is_that_of_the_model_s_own_coupling(rig, seed, inertia):
    """Adding J is adding to k_m (main) or k_t (tail), where the beam does not turn the rotor."""
    base = rig.newtonian()
    generator = np.random.default_rng(seed)
    x = generator.normal(size=6) * [100, 0.3, 0.3, 100, 0.3, 0.3]
    u = generator.normal(size=2)
    # Without a pitch rate: S_v = −k_t ω_h / J_v; then k_m meets ω̇ cos α alone.
    rates = rig.right_hand_side(base)
    x[base.state_index("S_v")] -= rates(x, u, np.zeros(4))[base.state_index("alpha_v")]
    k_m = base.parameters["k_m"].value
    changed = rig.newtonian(parameters={"k_m": k_m + inertia})
    with_effect = rig.extended(base, reaction("main", inertia=inertia))
    # the same rates, of which k_m ω is a part of the yaw's
    y = x.copy()
    f = rig.right_hand_side(changed)(x, u, np.zeros(4))
    row = base.state_index("alpha_h")
    y[base.state_index("S_h")] -= f[row] - rates(x, u, np.zeros(4))[row]
    np.testing.assert_allclose(
        rig.accelerations(with_effect)(x, u)[1],
        rig.accelerations(changed)(y, u)[1],
        rtol=1e-9,
        atol=1e-9,
    )


def test_the_tail_turns_the_pitch_on_any_rig_with_both_axes(rig):
    for base in (rig.newtonian(), Tras()):
        model = rig.extended(base, reaction("tail", drag=1e-7))
        start = base.rest()
        start[base.state_index("omega_h")] = 200.0
        both = [rig.right_hand_side(m)(start, np.zeros(2), np.zeros(4)) for m in (base, model)]
        change = both[1] - both[0]
        assert change[base.state_index("S_v")] > 0
        assert np.flatnonzero(change).tolist() == [base.state_index("S_v")]


class Spinner(Turntable):
    """Two free axes and a main rotor that keeps its speed."""

    def __init__(self) -> None:
        super().__init__(inertia=0.05)
        self.states = (*self.states, Signal("omega_v", "rad/s"))
        self.rotors = {"main": RigRotor("u_v", "omega_v", axis="pitch")}

    def dynamics(self, x, u, p, w):
        return ca.vertcat(super().dynamics(x, u, p, w), 0)


@given(
    lean=st.floats(-1.5, 1.5),
    inertia=st.floats(-1e-4, 1e-4),
    rates=st.tuples(st.floats(-2, 2), st.floats(-2, 2)),
)
@settings(max_examples=10, deadline=None)
def test_gyroscopic_torques_do_no_work_and_keep_the_angular_momentum(rig, lean, inertia, rates):
    model = rig.extended(Spinner(), {"g": GyroscopicCoupling(inertia=inertia, lean=lean)})
    start = [0.2, rates[0], 0.0, rates[1], 200.0]
    x = rig.simulate(model, np.zeros((100, 2)), start=start, substeps=8)
    energy = x[:, 1] ** 2 + x[:, 3] ** 2
    np.testing.assert_allclose(energy, energy[0], rtol=1e-7, atol=1e-12)
    # About the yaw axis: J Ω_yaw less what the rotor holds of it.
    momentum = 0.05 * x[:, 3] - inertia * 200.0 * np.cos(x[:, 0] + lean)
    np.testing.assert_allclose(momentum, momentum[0], atol=1e-7)


def test_with_the_reaction_it_is_the_model_s_own_coupling(rig):
    """k_m ω cos α of the Newtonian model is such a momentum, less what its J_h(α) adds to it."""
    k_m = rig.newtonian().parameters["k_m"].value
    base, without = rig.newtonian(), rig.newtonian(parameters={"k_m": 0.0})
    with_effect = rig.extended(
        without, {"g": GyroscopicCoupling(inertia=k_m, lean=0.0)} | reaction(inertia=k_m)
    )
    u, speed, alpha, step = np.array([1.5, 0.0]), 200.0, 0.4, 1e-6
    x = base.rest()
    for name, value in (("omega_v", speed), ("alpha_v", alpha), ("S_v", 1.0), ("S_h", 0.3)):
        x[base.state_index(name)] = value

    def inertia(at):
        return rig.quantities(base, at)["inertia_yaw"]

    same_rates = x.copy()
    same_rates[base.state_index("S_h")] -= k_m * speed * np.cos(alpha) / inertia(x)
    sides = [x.copy(), x.copy()]
    for side, sign in zip(sides, (1, -1), strict=True):
        side[base.state_index("alpha_v")] += sign * step
    turning = (1 / inertia(sides[0]) - 1 / inertia(sides[1])) / (2 * step)
    own = rig.accelerations(base)(same_rates, u)[1] - k_m * speed * np.cos(alpha) * turning
    assert rig.accelerations(with_effect)(x, u)[1] == pytest.approx(own, rel=1e-6)
    assert rig.accelerations(without)(x, u)[1] != pytest.approx(own, rel=1e-2)
