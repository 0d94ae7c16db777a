"""Hunting: the linear loop, its events, one harmonic, the simulation, and one against the other."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.controllers.controller import ControlSample, ControlSetup
from trms_cli.controllers.lqr import Lqr
from trms_cli.controllers.pid import Pid
from trms_cli.controllers.pid_tuning import AxisPlant, Filters, Gains, closed_loop
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.stribeck_friction import StribeckFriction
from trms_cli.models.estimate import Estimate
from trms_cli.models.linearisation import Linearisation
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import operating_point
from trms_cli.models.steady_state import SteadyState
from trms_cli.observers.full_state import FullState
from trms_cli.stability.cycles.hunting_runs import axis_run, slips, with_sizes
from trms_cli.stability.cycles.stick_slip import (
    FrictionLaw,
    FrictionLoop,
    HarmonicBalance,
    StickSlip,
    friction_loop,
    frictions_of,
    law_matrices,
    predict,
    sliding_cycle,
)
from trms_cli.stability.studies.hunting import Hunting
from trms_cli.stability.study import Study, silent
from trms_cli.stability.subject import LoopParts, Subject

GAINS = Gains(kp=0.2, ki=0.32, kd=0.27)
MODEL = Newtonian(freedom="vertical")
PID = Pid(pitch=GAINS)
LOOP = LoopParts(MODEL, PID, FullState(), 0.02, {"controller": "pid", "observer": "full_state"})
STICTION = StribeckFriction(axis="pitch", torque=0.02, excess=1.0, velocity=0.02)
RIG = extend_model(MODEL, {"friction": STICTION})
POINT = operating_point(RIG, {"alpha_v": 0.0})
RUBBING_TWICE = extend_model(RIG, {"more": CoulombFriction(axis="pitch", torque=0.01)})
LINEAR = friction_loop(RIG, LOOP, PID, POINT, "pitch")
LAW = frictions_of(RIG)[0].law


def test_the_friction_is_read_with_the_sizes_in_force():
    (friction,) = frictions_of(with_sizes(RIG, {"friction.torque": 0.007}))
    assert friction.axis == "pitch" and friction.law == FrictionLaw(0.007, 1.0, 0.02)
    assert frictions_of(MODEL) == ()


def test_the_law_as_matrices_is_the_law_as_it_is_computed():
    # Within a cell of the rotor's curve, which has a corner at the level beam's torque.
    point = operating_point(RIG, {"alpha_v": 0.03})
    state = PID.init(ControlSetup(MODEL, 0.02, point.u))
    axis = state.axes[0]
    F, g, h, d = law_matrices(axis)
    row = MODEL.state_index("alpha_v")
    rest = point.x[row]
    angles = rest + 1e-4 * np.sin(0.13 * np.arange(60)) * np.arange(60) / 60
    c, moments, expected = np.zeros(4), [], []
    u = point.u
    for angle in angles:
        x = point.x.copy()
        x[row] = angle
        estimate = Estimate(x, *(np.zeros(0),) * 6)
        sample = ControlSample(0.0, np.array([[rest]]), estimate, u)
        u = PID.step(state, sample, want_prediction=False).u
        moments.append(axis.torque_of.at(float(u[0])) - axis.torque_of.at(float(point.u[0])))
        expected.append(float(h @ c + d * (angle - rest)))
        c = F @ c + g * (angle - rest)
    assert np.abs(expected).max() > 1e-4
    assert moments == pytest.approx(expected, rel=2e-3, abs=1e-7)


def test_the_modes_of_the_linear_loop_are_those_of_the_sampled_one():
    at = Linearisation(MODEL, 0.02, SteadyState(MODEL)).at({"alpha_v": 0.0}, "at")
    axis = PID.init(ControlSetup(MODEL, 0.02, POINT.u)).axes[0]
    slope = axis.curve.slope(axis.torque_of.at(float(POINT.u[0])))
    plant = AxisPlant(at.A, at.B[:, 0] * slope, at.C[0], 0.02)
    filters = Filters(PID.derivative_filter, axis.lead * PID.lead_filter, PID.lead_filter)
    gains = np.array([[GAINS.kp, GAINS.ki, GAINS.kd]])
    values = np.linalg.eigvals(closed_loop(plant, gains, filters)[0][0]).astype(complex)
    slow = np.log(values[np.abs(values) > 0.8]) / 0.02
    modes = np.linalg.eigvals(LINEAR.A)
    assert len(slow) >= 5
    for mode in slow:
        assert np.abs(modes - mode).min() < 0.01 * abs(mode)
    assert LINEAR.stable()


def loop_of(A: list[list[float]]) -> FrictionLoop:
    """ż = A z + b τ of the states angle, rate and more, with an inertia of one."""
    angle, rate = np.eye(len(A))[:2]
    return FrictionLoop(np.array(A), rate, rate, angle)


@settings(max_examples=12, deadline=None)
@given(force=st.floats(0.01, 1.0), over=st.floats(1.05, 2.9))
def test_a_slip_of_a_mass_on_a_spring(force, over):
    """ẍ = −4x + τ: from x_0 > F/k it slips half a swing around F/k, in π/ω."""
    events = StickSlip(loop_of([[0.0, 1.0], [-4.0, 0.0]]), FrictionLaw(force))
    reach = force / 4.0
    end, time, direction = events.slip(np.array([over * reach, 0.0]))
    assert direction == -1.0 and time == pytest.approx(np.pi / 2, abs=1e-6)
    assert end == pytest.approx([(2 - over) * reach, 0.0], abs=1e-7 * over * reach + 1e-12)


def test_a_stick_lasts_until_the_breakaway_moment_and_slips_lie_between_sticks():
    """ẍ = −q + τ, q̇ = x: stuck at x, the moment q reaches F_s after (F_s − q_0)/x."""
    loop = loop_of([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    events = StickSlip(loop, FrictionLaw(1.0, 0.5, 0.1))
    broken, time = events.stick(np.array([0.2, 0.0, 0.3]))
    assert time == pytest.approx((1.5 - 0.3) / 0.2, rel=1e-9)
    assert broken == pytest.approx([0.2, 0.0, 1.5], rel=1e-9)
    assert events.stick(np.zeros(3)) is None
    assert events.ramp(0.2) == pytest.approx([0.2, 0.0, 1.5], rel=1e-9)
    time = np.arange(10) * 0.1
    angle = np.array([0.0, 0.0, 0.1, 0.2, 0.2, 0.2, 0.1, 0.0, 0.0, 0.0])
    stuck = np.array([1, 1, 0, 0, 1, 1, 0, 0, 1, 1], dtype=bool)
    assert slips(time, angle, stuck) == [
        (pytest.approx(0.1), pytest.approx(0.2)),
        (pytest.approx(0.5), pytest.approx(-0.2)),
    ]


def test_coulomb_friction_alone_does_not_hunt():
    # Its map is a straight line below the diagonal.
    events = StickSlip(LINEAR, FrictionLaw(0.02))
    ratios = [events.next_error(e) / e for e in (1e-3, 1e-2, 1e-1)]
    assert ratios == pytest.approx([ratios[0]] * 3, rel=1e-5)
    assert abs(ratios[0]) < 0.5
    found = predict(events)
    assert found.cycle is None and found.threshold is None
    rig = with_sizes(RIG, {"friction.excess": 0.0})
    for push in (0.02, 0.1):
        seen = axis_run(rig, LOOP, POINT, "pitch", push, 60.0)
        assert seen.verdict == "rest" and seen.swing < 1e-4


def test_the_predicted_cycle_attracts_and_stiction_hunts_as_predicted_above_its_threshold():
    events = StickSlip(LINEAR, LAW)
    prediction = predict(events)
    cycle = prediction.cycle
    half = events.half(cycle.half.start)
    assert half.end == pytest.approx(-cycle.half.start, rel=1e-5, abs=1e-9)
    assert cycle.stable and cycle.period == pytest.approx(2 * (half.stick + half.slip))
    # A disturbed stick comes back by the multiplier of half a period.
    e = cycle.swing / 2
    slope = (events.next_error(1.02 * e) - events.next_error(0.98 * e)) / (0.04 * e)
    assert slope**2 == pytest.approx(abs(cycle.multipliers[0]), rel=0.2)
    # In simulation it hunts as predicted.
    run = axis_run(RIG, LOOP, POINT, "pitch", 0.03, 120.0)
    assert run.hunts and cycle.swing == pytest.approx(run.swing, rel=0.03)
    assert cycle.period == pytest.approx(run.period, rel=0.04)
    assert cycle.stuck_share == pytest.approx(run.stuck_share, abs=0.05)
    # The threshold of the map, tried in simulation: a stick at an error is where a run begins.
    below, above = (
        axis_run(RIG, LOOP, POINT, "pitch", share * prediction.threshold, 160.0)
        for share in (0.6, 1.5)
    )
    assert not below.hunts and below.swing < 0.1 * cycle.swing
    assert above.hunts and above.swing == pytest.approx(cycle.swing, rel=0.03)


def test_the_study_says_it_all_and_of_another_controller_simulates_only():
    study = Hunting(duration=70.0, torques=(), integrals=(), push=0.03)
    assert isinstance(study, Study)
    findings = study.run(Subject(RIG, "newtonian_vertical", LOOP), silent)
    results = findings.results
    assert results["simulated"]["hunts"] and not results["coulomb"]["hunts"]
    assert results["predicted"]["swing"] == pytest.approx(results["simulated"]["swing"], rel=0.03)
    assert results["predicted"]["coulomb_factor"] < 0.5
    # One harmonic tells that there is a cycle, and little of its size.
    assert results["harmonic"]["swing"] > 1.5 * results["simulated"]["swing"]
    names = [chart.name for chart in findings.charts]
    assert names == ["hunting_history", "hunting_plane", "hunting_map", "hunting_nyquist"]
    assert findings.lead[0].startswith("The loop hunts")
    assert [m.label for m in findings.measures] == ["the loop", "swing", "period", "stuck"]
    names = {"controller": "lqr", "observer": "full_state"}
    loop = replace(LOOP, controller=Lqr(operating_point={"alpha_v": 0.0}), names=names)
    findings = Hunting(duration=40.0).run(Subject(RIG, "newtonian_vertical", loop), silent)
    assert findings.results["predicted"] is None and findings.results["levels"] == []
    assert any("controller=pid only" in words for words in findings.warnings)


@pytest.mark.slow
def test_other_levels_are_predicted_too():
    """From a push that ends at rest the study begins again on the predicted cycle."""
    study = Hunting(duration=200.0, torques=(0.6, 2.0), integrals=(0.5, 2.0), push=0.1)
    findings = study.run(Subject(RIG, "newtonian_vertical", LOOP), silent)
    levels = findings.results["levels"]
    assert [level["factor"] for level in levels] == [0.6, 1.0, 2.0, 0.5, 1.0, 2.0]
    for level in levels:
        assert level["simulated"]["hunts"]
        assert level["predicted_swing"] == pytest.approx(level["simulated"]["swing"], rel=0.05)
    assert findings.charts[-1].name == "hunting_over_friction"


@pytest.mark.parametrize(
    ("rig", "loop", "study", "where"),
    [
        (MODEL, LOOP, Hunting(), "effect"),
        (RIG, LOOP, Hunting(axis="yaw"), "effect"),
        (RUBBING_TWICE, LOOP, Hunting(), "axis"),
        (RIG, replace(LOOP, controller=Lqr()), Hunting(integrals=(2.0,)), "integrals"),
    ],
)
def test_what_makes_no_sense_is_told(rig, loop, study, where):
    with pytest.raises(ConfigurationError) as told:
        study.run(Subject(rig, "m", loop), silent)
    assert told.value.where == where and told.value.remedy


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


def spring_and_relay(damping: float) -> FrictionLoop:
    """J Ω̇ = −k α − d Ω + τ with a lagging spring: states α, Ω, and the spring behind its lag."""
    k, lag = 4.0, 0.3
    return loop_of([[0.0, 1.0, 0.0], [0.0, -damping, -1.0], [k / lag, 0.0, -1.0 / lag]])


def test_one_harmonic_balances_a_negative_damping_hardly_feels_friction_or_sticks():
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
    damped = sliding_cycle(spring_and_relay(5.0), FrictionLaw(0.05), np.geomspace(0.1, 30, 500))
    assert damped is None  # nothing crosses
    # An axis that is pushed hard hardly feels its friction, and too little sticks.
    loop = spring_and_relay(1.0)
    answer = HarmonicBalance(loop, FrictionLaw(1e-6)).answer(1.0, 3.0)
    assert answer.ratio == pytest.approx(1 / 3.0j, abs=2e-3)
    assert answer.swing == pytest.approx(2 / 9.0, rel=2e-3) and answer.stuck_share == 0.0
    stuck = HarmonicBalance(loop, FrictionLaw(1.0, 0.5, 0.1)).answer(1.4, 3.0)
    assert stuck.ratio == 0 and stuck.swing == 0 and stuck.stuck_share == 1.0
