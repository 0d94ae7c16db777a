"""PID: how well it follows, that it starts without a bump, and how it tunes itself. What it is told
beforehand: the curve of a rotor, the inverse of an axis, the coupling.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.controllers.pid import Pid, PidState
from trms_cli.controllers.pid_feed_forward import (
    INVERTED,
    PiecewiseLinear,
    decoupling,
    friction_torques,
    holding_torques,
    inverse,
    is_rotor_before_axis,
    path_memories,
    rotor_lag,
    rotor_tables,
    torque_curve,
)
from trms_cli.controllers.pid_law import STATE, AxisExpressions, AxisLaw, LawLayout, law
from trms_cli.controllers.pid_tuning import (
    AxisPlant,
    Filters,
    Gains,
    closed_loop,
    load_costs,
    margins,
)
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.plugins import build
from trms_cli.effects.cable_hysteresis import CableHysteresis
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.gyroscopic_coupling import GyroscopicCoupling
from trms_cli.effects.input_delay import InputDelay
from trms_cli.effects.rotor_reaction import RotorReaction
from trms_cli.effects.stribeck_friction import StribeckFriction
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.models.steady_state import SteadyState

from .closed_loop_case import SAMPLE_TIME, close_loop, sample_of, setup_of, squares, state_with

BOTH = Newtonian()


def started(controller: Pid, u: np.ndarray | None = None) -> PidState:
    return controller.init(setup_of(BOTH, SAMPLE_TIME, u))


Term = Callable[[AxisExpressions, ca.MX], Sequence[ca.MX]]


class Stepped:
    """A term of the law of one axis by itself, stepped with what it remembers."""

    def __init__(self, axis: AxisLaw, term: Term) -> None:
        value, p = ca.MX.sym("value"), ca.MX.sym("p", axis.layout.size)
        state = ca.MX.sym("state", axis.layout.states)
        expressions = AxisExpressions(axis.layout, p, 0, state)
        results = ca.vertcat(*term(expressions, value))
        self._function = ca.Function("term", [value, state, p], [results, expressions.after()])
        self._numbers, self._memory = axis.numbers(), np.zeros(axis.layout.states)

    def __call__(self, value: float) -> tuple[float, ...]:
        results, memory = self._function(value, self._memory, self._numbers)
        self._memory = np.array(memory)[:, 0]
        return tuple(np.array(results)[:, 0].tolist())

    def remembered(self, name: str) -> float:
        return float(self._memory[STATE.index(name)])


def sines(times: np.ndarray) -> np.ndarray:
    phase = 2 * math.pi * 0.05 * times
    return np.column_stack([0.3 * np.sin(phase), 0.5 * np.cos(phase)])


def rms_after(trajectory, angle: str, begin: float) -> float:
    """rad; ``begin``: s."""
    return float(np.sqrt(np.mean(trajectory.error(angle)[round(begin / SAMPLE_TIME) :] ** 2)))


def test_sines_are_followed_and_squares_by_another_rig_than_the_model() -> None:
    """Far better than by standing still, with an RMSE of 0.21 and 0.35 rad."""

    trajectory = close_loop(Pid(), BOTH, sines, 60.0)
    for angle, bound in (("alpha_v", 0.15), ("alpha_h", 0.16)):
        assert np.sqrt(np.mean(trajectory.error(angle) ** 2)) < bound
    rig = Newtonian(parameters={"k_fvp": 1.4e-5, "l_cb": 0.265, "k_chp": 0.02, "k_oh": 0.022})
    trajectory = close_loop(Pid(), BOTH, squares(BOTH), 80.0, rig=rig)
    for angle, step in (("alpha_v", 0.6), ("alpha_h", 1.0)):
        assert max(np.abs(e[-100:]).max() for e in trajectory.levels(angle)) < 0.04 * step


@pytest.mark.parametrize("feed_forward", [True, False])
def test_it_takes_over_without_a_bump(feed_forward: bool) -> None:
    controller = Pid(feed_forward=feed_forward, setpoint_weight=0.5)
    u = np.array([1.2, -0.3])
    state = started(controller, u)
    sample = sample_of(BOTH, [0.1, -0.2], state_with(BOTH, alpha_v=0.1, alpha_h=-0.2), u)
    command = controller.step(state, sample, want_prediction=False)
    np.testing.assert_allclose(command.u, u, atol=1e-9)


def plant() -> AxisPlant:
    """A lightly damped second-order axis behind a lag, sampled."""
    T = 0.02
    A = np.eye(3) + T * np.array([[-1.5, 0, 0], [2.0, -0.1, -3.0], [0, 1, 0]])
    return AxisPlant(A, T * np.array([1.5, 0, 0]), np.array([0.0, 0, 1]), T)


FILTERS = Filters(0.05, 0.5, 0.1)


def test_the_closed_loop_is_the_law_that_runs() -> None:
    """The transition matrix of tuning against the law stepped by itself on the linear plant."""
    axis, gains = plant(), Gains(0.4, 0.3, 0.6)
    A, row = (part[0] for part in closed_loop(axis, np.array([[0.4, 0.3, 0.6]]), FILTERS))
    T, keep, slow = axis.step, 0.05 / (0.05 + axis.step), 0.1 / (0.1 + axis.step)
    x, integral, derivative, last, lagged = np.array([0.1, 0.2, -0.3]), 0.5, 0.0, -0.3, 0.2
    state = np.array([*x, integral, derivative, last, lagged])
    for _ in range(50):
        y = axis.c @ x
        derivative = keep * derivative - gains.kd * (1 - keep) / T * (y - last)
        last = y
        v = -gains.kp * y + integral + derivative
        lagged = slow * lagged + (1 - slow) * v
        u = lagged + 5.0 * (v - lagged)
        assert row @ state == pytest.approx(u, abs=1e-12)
        integral += gains.ki * T * (0 - y)
        x = axis.A @ x + axis.b * u
        state = A @ state
        np.testing.assert_allclose(state, [*x, integral, derivative, last, lagged], atol=1e-12)


def test_the_cost_of_a_load_is_the_sum_along_its_response() -> None:
    axis, gains = plant(), np.array([[0.1, 0.1, 0.1]])
    A, u = (part[0] for part in closed_loop(axis, gains, FILTERS))
    n, T = 3, axis.step
    state, total = np.eye(n + 4)[n] + np.eye(n + 4)[n + 3], 0.0
    for _ in range(20_000):
        rate = (axis.c @ (axis.A - np.eye(n)) @ state[:n]) / T
        total += T * ((axis.c @ state[:n]) ** 2 + 4.0 * rate**2 + 0.05**2 * (u @ state) ** 2)
        state = A @ state
    assert load_costs(axis, gains, FILTERS, 2.0, 0.05)[0] == pytest.approx(total, rel=1e-6)
    assert load_costs(axis, np.array([[0.0, 50.0, 0.0]]), FILTERS, 2.0, 0.05)[0] == math.inf


def test_tuned_loops_keep_their_margins_which_are_where_they_become_unstable() -> None:
    controller = Pid(max_sensitivity=1.8)
    for loop in started(controller).margins.values():
        assert loop.peak_sensitivity < 1.8 * 1.02
        # what the peak implies
        assert loop.gain_margin > 1.8 / 0.8 * 0.97
        assert loop.phase_margin > 2 * math.asin(1 / (2 * 1.8)) * 0.97
        assert 0.5 < loop.crossover < 5.0
    # Any loop becomes unstable at its gain margin.
    axis, gains = plant(), Gains(0.4, 0.3, 0.6)
    margin = margins(axis, gains, Filters(0.05)).gain_margin

    def radius(factor: float) -> float:
        row = factor * np.array([[gains.kp, gains.ki, gains.kd]])
        return float(np.abs(np.linalg.eigvals(closed_loop(axis, row, Filters(0.05))[0][0])).max())

    assert radius(0.98 * margin) < 1.0 < radius(1.02 * margin)


def test_given_gains_are_taken_as_they_are_and_the_others_tuned() -> None:
    given = {"pitch": {"kp": 0.1, "ki": 0.2, "kd": 0.3}, "sample_time": 0.04}
    controller = build({"_target_": "trms_cli.controllers.pid.Pid", **given}, "controller")
    assert controller.sample_time == 0.04
    pitch, yaw = started(controller).axes
    assert pitch.gains == Gains(0.1, 0.2, 0.3)
    assert yaw.gains.ki > 0
    # Even where they are of no use: kd is 0 unless given, and pitch hardly damps itself.
    pitch, yaw = started(Pid(pitch=Gains(0.1, 0.05), yaw=Gains(0.05, 0.02))).axes
    assert (pitch.gains, yaw.gains) == (Gains(0.1, 0.05, 0.0), Gains(0.05, 0.02, 0.0))


@pytest.fixture(scope="module")
def steady() -> SteadyState:
    return SteadyState(BOTH)


@pytest.mark.parametrize(("axis", "channel", "lever"), [("pitch", 0, 0.246), ("yaw", 1, 0.282)])
def test_the_curve_is_the_thrust_of_the_rotor(steady, axis, channel, lever) -> None:
    """Against the rotor's equations: B ω + k_t ω|ω| = kφ (k_u u − kφ ω)/R, F = k_f ω|ω|."""
    curve, p = torque_curve(BOTH, axis, channel, steady), BOTH.parameters
    v = "v" if axis == "pitch" else "h"

    def thrust_and_input(omega: float) -> tuple[float, float]:
        sign = "p" if omega >= 0 else "n"
        friction = p["B_mr" if v == "v" else "B_tr"].value * omega
        drag = p[f"k_t{v}{sign}"].value * omega * abs(omega)
        back = p["kphi"].value * omega
        u = ((friction + drag) * p["R"].value / p["kphi"].value + back) / p[f"k_u{v}"].value
        return lever * p[f"k_f{v}{sign}"].value * omega * abs(omega), u

    pairs = np.array([thrust_and_input(omega) for omega in np.linspace(-500, 500, 4001)])
    free = np.interp(curve.at(0.0), pairs[:, 1], pairs[:, 0])
    for torque in np.linspace(curve.x[1], curve.x[-2], 40).tolist():
        wanted = np.interp(torque + free, pairs[:, 0], pairs[:, 1])
        assert curve.at(torque) == pytest.approx(wanted, abs=0.11)
    assert np.all(np.diff(curve.x) > 0) and np.all(np.diff(curve.y) > 0)
    assert (curve.y[0], curve.y[-1]) == pytest.approx((-2.5, 2.5))


def test_tables_are_linear_and_hold_an_axis_by_the_input_of_its_steady_state(
    steady: SteadyState,
) -> None:
    curve = torque_curve(BOTH, "yaw", 1, steady)
    holding = holding_torques(BOTH, "yaw", 1, steady, curve.inverse())
    for angle in (-1.0, -0.25, 0.5, 1.25):
        exact = steady.solve(np.array([0.0, angle])).u[1]
        assert curve.at(holding.at(angle)) == pytest.approx(exact, abs=1e-6)
    table = PiecewiseLinear([0.0, 1.0, 3.0], [0.0, 2.0, 4.0])
    assert [table.at(v) for v in (-1.0, 0.5, 2.0, 9.0)] == [0.0, 1.0, 3.0, 4.0]
    assert table.inverse().at(3.0) == 2.0
    assert table.slope(0.5) == 2.0 and table.slope(7.0) == 1.0


def test_the_tables_are_kept_by_model(steady, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("TRMS_CACHE", str(tmp_path / "functions"))
    channels = {"pitch": 0, "yaw": 1}
    first = rotor_tables(BOTH, channels, steady)
    monkeypatch.setattr("trms_cli.controllers.pid_feed_forward.torque_curve", None)
    assert rotor_tables(BOTH, channels, steady) == first
    for other in (Newtonian(parameters={"l_cb": 0.25}), Newtonian(currents="dynamic")):
        with pytest.raises(TypeError):  # is computed anew
            rotor_tables(other, channels, steady)


def test_the_inverse_of_a_rotor_before_an_axis_is_exact_and_the_coupling_undone() -> None:
    s = 1j * INVERTED
    wanted = np.polymul([0.4, 1.0], [0.06, 0.02, 0.1])[::-1]  # (1 + 0.4 s)(0.1 + 0.02 s + 0.06 s²)
    found = inverse([1 / np.polyval(wanted[::-1], s)], INVERTED)
    np.testing.assert_allclose(found, wanted, rtol=1e-9)
    assert rotor_lag(found) == pytest.approx(0.4)
    assert is_rotor_before_axis(found)
    assert not is_rotor_before_axis(np.array([-2e-4, 5e-3, 8e-3, -2e-3]))  # a root at 4/s
    own = 1 / (0.06 * s**2 + 0.02 * s + 0.1)
    cross = own * 0.13 * s / (1 + 0.1 * s)
    other = 1 / (0.07 * s**2 + 0.01 * s + 0.15)
    assert decoupling([cross], [own], [other], INVERTED, 0.1) == pytest.approx(-0.13)


def test_the_reference_asks_for_no_more_than_the_rotor_has() -> None:
    """A step of 2 rad in yaw: uncut, the filter would ask for 0.6 N m; the rotor has 0.1.

    Half of it is for the feedback.
    """
    axis = started(Pid()).axes[1]
    still = (ca.MX(0.0), ca.MX(0.0))
    guided = Stepped(axis, lambda law, reference: law.guided(reference, still))
    followed, torques = zip(*(guided(2.0) for _ in range(500)), strict=True)
    assert min(torques) >= axis.least / 2 and max(torques) <= axis.most / 2 + 1e-12
    assert max(torques) > 0.4 * axis.most
    assert followed[-1] == pytest.approx(2.0, abs=1e-3)
    assert max(followed) < 2.1


def test_the_friction_of_the_model_is_fed_forward() -> None:
    dry = extend_model(BOTH, {"dry": CoulombFriction(axis="yaw", torque=0.005)})
    friction = friction_torques(dry, "yaw")
    assert friction is not None
    for rate in (-0.4, -0.001, 0.001, 0.03, 0.7):
        assert friction.at(rate) == pytest.approx(math.copysign(0.005, rate), rel=1e-3)
    assert friction.at(0.0) == 0.0
    assert friction_torques(dry, "pitch") is None and friction_torques(BOTH, "yaw") is None


def test_an_axis_with_friction_follows_and_gets_to_its_reference() -> None:
    """Knowing the friction it follows; not knowing it, it waits for the integral at each turn."""
    dry = extend_model(BOTH, {"dry": CoulombFriction(axis="yaw", torque=0.005)})
    known, unknown = (close_loop(Pid(), model, sines, 40.0, rig=dry) for model in (dry, BOTH))
    assert rms_after(known, "alpha_h", 10.0) < 0.3 * rms_after(unknown, "alpha_h", 10.0)
    levels = close_loop(Pid(), dry, squares(BOTH), 80.0, rig=dry).levels("alpha_h")
    assert np.sqrt(np.mean([e[-300:] ** 2 for e in levels])) < 0.003


def test_friction_that_falls_with_the_rate_is_not_overcompensated() -> None:
    """Given more than resists it, an axis swings about its reference instead of sticking."""
    sticky = StribeckFriction(axis="yaw", torque=0.003, excess=1.0, velocity=0.03)
    friction = friction_torques(extend_model(BOTH, {"sticky": sticky}), "yaw")
    assert friction is not None
    right = [friction.at(rate) for rate in (0.001, 0.01, 0.1, 1.0)]
    assert right == sorted(right) and right[0] == pytest.approx(0.003, rel=0.01)


def test_a_delay_does_not_slow_the_reference() -> None:
    """Its lag is the rotor's, of which a delay is no part."""
    late = extend_model(BOTH, {"late": InputDelay(rotor="tail", delay=0.06)})
    prompt, delayed = (Pid().init(setup_of(model, SAMPLE_TIME)).axes for model in (BOTH, late))
    for one, other in zip(prompt, delayed, strict=True):
        assert other.reference_rate == pytest.approx(one.reference_rate, rel=1e-3)


def test_a_smooth_reference_is_followed_without_the_lags_of_the_filter() -> None:
    for follows, low, high in ((True, 0.0, 0.01), (False, 0.09, 0.2)):
        trajectory = close_loop(Pid(reference_rates=follows), BOTH, sines, 40.0)
        for angle in ("alpha_v", "alpha_h"):
            assert low <= rms_after(trajectory, angle, 10.0) < high


def test_a_jump_of_the_reference_is_no_rate() -> None:
    axis = started(Pid()).axes[1]
    derivatives, of_hops = (Stepped(axis, AxisExpressions.derivatives) for _ in range(2))
    ramp = 0.1 * SAMPLE_TIME * np.arange(10)
    jumped = [*ramp, *(ramp + 0.5), *([1.5] * 5)]
    rates, accelerations = zip(*(derivatives(r) for r in jumped), strict=True)
    np.testing.assert_allclose(rates[2:21], 0.1, rtol=1e-9)  # through the jump at 10
    assert np.abs(accelerations[2:]).max() < 1e-9
    np.testing.assert_allclose(rates[22:], 0.0, atol=1e-9)
    # A reference that only jumps has no rate.
    hopping = [of_hops(1.5 + 0.1 * (k % 2))[0] for k in range(6)]
    np.testing.assert_allclose(hopping[3:], 0.0, atol=1e-9)


def test_the_lead_is_of_the_input_and_limits_tell_the_torque_that_is_left() -> None:
    axis = started(Pid()).axes[1]
    rotor = Stepped(axis, AxisExpressions.through_rotor)
    for _ in range(200):
        u, torque = rotor(0.03)
    assert (u, torque) == (pytest.approx(axis.curve.at(0.03)), 0.03)
    u, torque = rotor(-0.03)  # the rotor turns round
    volts = axis.curve.at(-0.03)
    lagged = rotor.remembered("lagged")
    uncut = lagged + axis.lead * (volts - lagged)
    assert uncut < -2.5 and u == -2.5 and -0.03 < torque < 0.03


@given(
    st.lists(st.floats(-3, 3).map(lambda x: round(x, 6)), min_size=2, max_size=40, unique=True),
    st.lists(st.floats(-4, 4), min_size=5, max_size=20),
    st.randoms(use_true_random=False),
)
def test_tables_of_the_compiled_law_are_the_tables(points, values, random) -> None:
    """Between the points, on them and beyond them."""
    curve = PiecewiseLinear(sorted(points), sorted(random.uniform(-2, 2) for _ in points))
    axis = replace(started(Pid()).axes[1], curve=curve)
    read = Stepped(axis, lambda law, value: [law.curve(value)])
    steepest = max(abs(curve.slope(x)) for x in curve.x)
    for value in [*values, *curve.x]:
        assert read(value)[0] == pytest.approx(curve.at(value), abs=1e-12 * (1 + steepest))


def test_the_law_without_a_compiler_is_the_same() -> None:
    """Interpreted to the last bit but one as compiled; rigs of other numbers share the code."""
    cable = CableHysteresis(axis="yaw", torque=0.005, width=0.15)
    dry = CoulombFriction(axis="pitch", torque=0.002)
    model = extend_model(BOTH, {"cable": cable, "dry": dry})
    state = Pid().init(setup_of(model, SAMPLE_TIME))
    layout = LawLayout((model.n_x, 2, 2), tuple(axis.layout for axis in state.axes), True)
    plain = BufferedFunction(law(layout)["sample"], compile=False)
    assert plain.function is not state.sample.function
    rng = np.random.default_rng(3)
    for _ in range(50):
        for own, other in zip(state.sample.inputs[:4], plain.inputs[:4], strict=True):
            own[:] = other[:] = rng.normal(0.0, 0.3, own.shape)
        plain.inputs[4][:] = state.sample.inputs[4]
        state.sample()
        plain()
        for own, other in zip(state.sample.outputs, plain.outputs, strict=True):
            np.testing.assert_allclose(own, other, rtol=1e-12, atol=1e-12)
    other = Pid().init(setup_of(extend_model(BOTH, {"cable": cable, "dry": dry}), SAMPLE_TIME))
    assert other.sample.function is state.sample.function


def test_a_cable_that_remembers_its_path_is_held_and_fed_forward() -> None:
    """Robust with the memory as a spring and without it; the loop is closed in simulation."""
    cable = extend_model(BOTH, {"cable": CableHysteresis(axis="yaw", torque=0.005, width=0.15)})
    state = Pid().init(setup_of(cable, SAMPLE_TIME))
    assert all(margin.peak_sensitivity < 1.6 * 1.02 for margin in state.margins.values())
    (memory,) = path_memories(cable, "yaw")
    assert path_memories(cable, "pitch") == path_memories(BOTH, "yaw") == ()
    for z in (-0.8, 0.0, 0.6):
        assert memory.torque.at(z) == pytest.approx(0.005 * z, abs=1e-9)
        fullness = (abs(z) + z) / 2  # β = 1/2: (|z| + z)/2 where the angle grows
        assert memory.rise.at(z) == pytest.approx((1 - fullness) / 0.15, rel=1e-6)
        assert memory.fall.at(z) == pytest.approx((1 - (abs(z) - z) / 2) / 0.15, rel=1e-6)
    known, unknown = (close_loop(Pid(), model, sines, 40.0, rig=cable) for model in (cable, BOTH))
    assert rms_after(known, "alpha_h", 10.0) < 0.3 * rms_after(unknown, "alpha_h", 10.0)
    levels = close_loop(Pid(), cable, squares(BOTH), 60.0, rig=cable).levels("alpha_h")
    assert max(np.abs(e[-50:]).max() for e in levels) < 0.01


def test_the_drag_of_the_main_rotor_is_fed_forward_to_yaw(steady: SteadyState) -> None:
    reaction = RotorReaction(rotor="main", drag=1.5e-7, inertia=0.0)
    dragged = extend_model(BOTH, {"reaction": reaction})
    knowing = Pid().init(setup_of(dragged, SAMPLE_TIME)).axes
    (burden,) = knowing[1].burdens
    level = SteadyState(dragged)
    at = {angle: level.solve(np.array([angle, 0.0])) for angle in (0.0, 0.25)}
    speed = dragged.state_index("omega_v")
    drag = [1.5e-7 * float(at[angle].x[speed]) ** 2 for angle in at]
    torque = knowing[0].torque_of.at(float(at[0.25].u[0]))
    assert abs(burden.at(torque)) == pytest.approx(abs(drag[1] - drag[0]), rel=0.05)
    assert np.abs(started(Pid()).axes[1].burdens[0].y).max() < 1e-6  # the model has no such drag
    known, unknown = (
        close_loop(Pid(), model, sines, 40.0, rig=dragged) for model in (dragged, BOTH)
    )
    assert rms_after(known, "alpha_h", 10.0) < 0.6 * rms_after(unknown, "alpha_h", 10.0)


def test_models_that_hardly_differ_get_gains_that_hardly_differ() -> None:
    spun = extend_model(BOTH, {"gyro": GyroscopicCoupling(inertia=1e-5, lean=0.0)})
    for one, other in zip(
        started(Pid()).axes, Pid().init(setup_of(spun, SAMPLE_TIME)).axes, strict=True
    ):
        for name in ("kp", "ki", "kd"):
            assert getattr(other.gains, name) == pytest.approx(getattr(one.gains, name), rel=0.1)


def test_friction_and_a_delay_that_are_known_leave_an_axis_at_rest() -> None:
    """With all of the friction to close an error it swung by 20 mrad about its reference."""
    effects = {
        "dry": CoulombFriction(axis="yaw", torque=0.005),
        "late": InputDelay(rotor="tail", delay=0.06),
    }
    sticky = extend_model(BOTH, effects)
    levels = close_loop(Pid(), sticky, squares(BOTH), 60.0, rig=sticky).levels("alpha_h")
    assert max(np.abs(e[-100:]).max() for e in levels) < 0.008


@pytest.mark.parametrize("pitch", [0.5, 0.8, 1.0])
def test_a_level_that_takes_most_of_the_torque_is_reached(pitch: float) -> None:
    """What holds the axis is no part of what a reference may ask for besides."""
    trajectory = close_loop(
        Pid(), BOTH, lambda time: np.broadcast_to([pitch, 0.5], (*np.shape(time), 2)), 30.0
    )
    assert trajectory.angles[-1, 0] == pytest.approx(pitch, abs=5e-3)


@pytest.mark.slow
def test_rotors_that_turn_both_axes_do_not_make_each_other_swing() -> None:
    """The pitch loop bends yaw's response: its inverse had a lag of 1.7 s for a rotor of 0.1 s.

    Leads of 24 then held both commands at their limits, and the axes swung by half a radian.
    """
    aero = QuanserAero()
    points = ({"alpha_v": 0.2, "alpha_h": 0.0}, {"alpha_v": 0.4, "alpha_h": 0.0})
    controller = Pid(operating_points=points)
    axes = controller.init(setup_of(aero, SAMPLE_TIME)).axes
    assert max(axis.lead for axis in axes) < 3.0
    trajectory = close_loop(controller, aero, squares(aero), 40.0)
    for angle, size in (("alpha_v", 0.6), ("alpha_h", 1.0)):
        for level in trajectory.levels(angle):
            assert np.abs(level[-250:]).max() < 0.1 * size
