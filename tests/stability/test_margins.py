"""Margins read off a loop, against closed forms, python-control and brute force; the study; the
measured frequency response, against linear algebra where the law is linear.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.cli import main
from trms_cli.controllers.controller import Command, ControlSetup, Status
from trms_cli.controllers.lqr import Lqr
from trms_cli.controllers.open_loop import OpenLoop
from trms_cli.controllers.pid import Pid
from trms_cli.controllers.pid_tuning import PidDesign
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.discretisation import discretise
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import operating_point
from trms_cli.references.constant import Constant
from trms_cli.stability.closed_loop import run_loop
from trms_cli.stability.loops.frequency_response import (
    Analyser,
    DiskMargin,
    FrequencyResponse,
    MarginResult,
    NoLoopError,
    NoResponse,
    classical_margins,
    continuous,
    diagonal_mu,
    disk_margin,
    held_by_friction,
    interpolate_response,
    multisine,
)
from trms_cli.stability.studies.margins import Margins
from trms_cli.stability.study import silent
from trms_cli.stability.subject import Subject

from .loop_cases import AT, COARSE, MODEL, PERIOD, POINT, Changed, loop_of, lqr, subject_of

OMEGA = np.geomspace(0.01, 100, 4000)
S = 1j * OMEGA
MARKERS = ("triangle", "square")


class TestOneLoop:
    def test_an_integrator_loses_ninety_degrees_and_a_sampled_loop_ends_at_half_the_rate(self):
        found = classical_margins(OMEGA, 2.0 / S)
        assert found.up is None and found.down is None
        assert found.crossover == pytest.approx(2.0, rel=1e-4)
        assert found.phase.value == pytest.approx(math.pi / 2, rel=1e-4)
        assert found.delay.value == pytest.approx(math.pi / 4, rel=1e-4)
        omega = np.geomspace(0.01, math.pi / 0.1, 2000)
        found = classical_margins(omega, 0.5 * np.exp(-0.1j * omega))
        assert found.up.value == pytest.approx(2.0, rel=1e-3)
        assert found.up.omega == pytest.approx(math.pi / 0.1)
        # Of several loci the first counts.
        loci = np.column_stack([2.0 / (S + 1) ** 3, 4.0 / (S + 1) ** 3])
        assert classical_margins(OMEGA, loci).up.value == pytest.approx(2.0, rel=1e-4)

    def test_three_lags_have_the_margin_of_hurwitz_and_an_unstable_rig_a_least_gain_too(self):
        # k/(s + 1)³ is unstable from k = 8 on, and swings at √3 rad/s
        for gain in (0.5, 2.0):
            found = classical_margins(OMEGA, gain / (S + 1) ** 3)
            assert found.up.value == pytest.approx(8 / gain, rel=1e-4)
            assert found.up.omega == pytest.approx(math.sqrt(3), rel=1e-4)
            assert found.down is None
        # k (s + 2)²/(s − 1)³ closed: s³ + (k − 3)s² + (4k + 3)s + 4k − 1, stable by Hurwitz where
        # (k − 3)(4k + 3) > 4k − 1
        k = np.roots([4.0, -13.0, -8.0])
        least = float(k[k > 0][0])
        found = classical_margins(OMEGA, 6.0 * (S + 2) ** 2 / (S - 1) ** 3)
        assert found.down.value == pytest.approx(least / 6.0, rel=1e-3)
        assert found.up is None

    @pytest.mark.slow
    def test_python_control_agrees(self):
        import control

        plant = control.tf([3.0], [1.0, 1.2, 4.0, 0.5])
        loop = plant(1j * OMEGA)
        gains, phases, _, _, at_phase, _ = control.stability_margins(plant, returnall=True)
        found = classical_margins(OMEGA, loop)
        assert found.up.value == pytest.approx(min(g for g in gains if g > 1), rel=1e-3)
        least = int(np.argmin(np.abs(phases)))
        assert math.degrees(found.phase.value) == pytest.approx(abs(phases[least]), abs=0.05)
        lags = np.radians(np.asarray(phases) % 360) / at_phase
        assert found.delay.value == pytest.approx(lags.min(), rel=1e-3)
        disk = control.disk_margins(plant, OMEGA)[0]
        own = disk_margin(OMEGA, np.abs(1 / (1 + loop) - loop / (1 + loop)))
        assert own.alpha == pytest.approx(disk, rel=1e-3)


class TestDisks:
    @given(st.lists(st.complex_numbers(max_magnitude=3), min_size=4, max_size=4))
    def test_the_diagonal_mu_of_two_loops_is_exact(self, entries):
        """By definition: the largest spectral radius over the phases of the two factors."""
        M = np.array(entries).reshape(2, 2)
        turns = np.exp(1j * np.linspace(0, 2 * math.pi, 2001))
        turned = np.stack([np.ones_like(turns), turns], axis=1)[:, :, None] * M
        brute = np.abs(np.linalg.eigvals(turned)).max()
        # eigenvalues near a double one move by the square root of the grid's step
        assert diagonal_mu(M[None])[0] == pytest.approx(brute, rel=0.02, abs=1e-3)

    def test_factors_within_the_disk_are_stood_and_one_on_its_edge_is_not(self):
        loop = 2.0 / (S * (S + 1) * (S / 5 + 1))
        apart = (1 - loop) / (1 + loop)
        disk = disk_margin(OMEGA, np.abs(apart))
        worst = int(np.argmax(np.abs(apart)))
        delta = 2 / apart[worst] / 2  # δ/2 · (S − T) = 1 on the edge
        factor = (1 + delta) / (1 - delta)
        assert abs(2 * delta) == pytest.approx(disk.alpha)
        assert abs(1 + loop[worst] / factor) < 1e-9 or abs(1 + loop[worst] * factor) < 1e-9
        assert disk.gain_down < abs(factor) < disk.gain_up or abs(factor) == pytest.approx(
            disk.gain_up
        )
        # A disk of two holds every gain.
        assert diagonal_mu(np.array([[[3 - 4j]]]))[0] == pytest.approx(5.0)
        assert DiskMargin(2.0, 1.0).gain_up == math.inf
        assert DiskMargin(2.5, 1.0).gain_down == 0.0
        assert DiskMargin(1.0, 1.0).gain_up == pytest.approx(3.0)
        assert DiskMargin(1.0, 1.0).gain_down == pytest.approx(1 / 3)


def test_loci_are_followed_where_their_order_changes_and_between_the_lines_interpolated():
    first, second = 1 / (S + 1), 2 / (S + 3) * np.exp(-0.1 * S)
    loci = np.column_stack([first, second])
    mixed = loci.copy()
    mixed[1000:2000] = mixed[1000:2000, ::-1]
    followed = continuous(mixed)
    assert np.abs(np.diff(followed, axis=0)).max() <= np.abs(np.diff(loci, axis=0)).max() + 1e-12
    few = np.geomspace(0.1, 30, 90)

    def sensitivity(omega):
        s = 1j * omega
        loop = 8.0 * (s + 1) / (s * (s**2 + 0.1 * s + 3.3) * (s / 12 + 1))
        return 1 / (1 + loop)

    fine = np.geomspace(0.1, 30, 2000)
    guess = interpolate_response(few, sensitivity(few)[:, None, None], fine)[:, 0, 0]
    assert np.abs(guess - sensitivity(fine)).max() < 0.01


STUDY = Margins(at=AT, lowest=0.2, ratio=1.15, amplitude=0.0005, periods=10)


@pytest.fixture(scope="module")
def findings():
    return STUDY.run(subject_of(lqr()), silent)


class TestTheStudy:
    def test_tells_the_margins_of_each_command(self, findings):
        results = findings.results
        assert results["holds"] and not findings.warnings
        assert set(results["loops"]) == {"u_v", "u_h"}
        drawn = [chart.name.removeprefix("margins_") for chart in findings.charts]
        assert drawn == ["bode", "nyquist", "sensitivity"]
        json.dumps(results, allow_nan=False)
        assert results["disk_any"]["alpha"] <= results["disk_each"]["alpha"] + 1e-12
        for loop in results["loops"].values():
            # Sampling takes some of the 60° and the factor 1/2 of a continuous regulator.
            assert loop["gain_up"] > 2 and math.degrees(loop["phase"]) > 35
            assert loop["modulus_margin"] == pytest.approx(1 / loop["peak_sensitivity"])
            # No disk is larger than what it bounds.
            assert results["disk_each"]["alpha"] <= loop["disk"]["alpha"] + 1e-12
            assert loop["disk"]["gain_up"] <= loop["gain_up"]
            assert loop["disk"]["phase"] <= loop["phase"]

    def test_the_rig_swings_at_the_delay_that_is_foretold(self, findings):
        """In whole control periods the phase of a delay is exact."""
        foretold = findings.results["alike"]["delay"]
        for late in (1, 2, 3):
            loop = loop_of(Changed(lqr(), late=late))
            run = run_loop(MODEL, loop, POINT, 30.0, offset={"alpha_v": 0.001})
            pitch = np.abs(run.x[:, MODEL.state_index("alpha_v")])
            grows = pitch[-500:].max() > 0.001
            assert grows == (late * 0.1 > foretold)

    @pytest.mark.slow
    def test_one_axis_needs_no_point_of_the_other(self):
        vertical = Newtonian(freedom="vertical")
        loop = loop_of(Lqr(operating_point={"alpha_v": 0.0}, sample_time=0.1), vertical)
        findings = replace(STUDY, at={}).run(Subject(vertical, "vertical", loop), silent)
        assert set(findings.results["loops"]) == {"u_v"}
        assert len(findings.tables) == 2  # nothing is changed together


class TestDryFriction:
    def test_holds_its_axis_is_left_out_of_the_margins_and_that_is_told(self, findings):
        for axis, angle in (("pitch", "alpha_v"), ("yaw", "alpha_h")):
            rig = extend_model(MODEL, {"dry": CoulombFriction(axis=axis, torque=0.001)})
            assert held_by_friction(rig, POINT) == (angle,)
        assert held_by_friction(MODEL, POINT) == ()
        rig = extend_model(MODEL, {"dry": CoulombFriction(axis="yaw", torque=0.003)})
        stuck = STUDY.run(subject_of(lqr(), rig), silent)
        assert stuck.results["quality"]["held_by_dry_friction"] == ["alpha_h"]
        assert "Dry friction holds alpha_h" in stuck.lead[1]
        for name, loop in findings.results["loops"].items():
            gained = stuck.results["loops"][name]["gain_up"]
            assert gained == pytest.approx(loop["gain_up"], rel=1e-6)

    def test_a_loop_that_does_not_answer_has_no_margins(self):
        """Whatever holds the rig: a loop that gives nothing back is not called robust."""
        findings = STUDY.run(subject_of(Changed(lqr(), gain=(1.0, 1e-6))), silent)
        assert findings.results["holds"]
        assert any(said.startswith("u_h: no loop to speak of") for said in findings.lead)
        assert any("the loop of u_h does not answer" in said for said in findings.warnings)


SLOW = Lqr(operating_point=AT, sample_time=3.0)
BLIND = OpenLoop(u_v=Constant(offset=1.4), u_h=Constant(offset=0.3))


@pytest.mark.parametrize(
    ("keys", "controller", "clock", "says"),
    [
        ({"lowest": 40.0}, Pid(), 0.02, "ends at half its rate"),
        ({"lowest": 1000.0}, Pid(), 0.02, "ends at half its rate"),
        ({}, Pid(), 0.5, "slower than the rig moves"),
        ({}, Pid(), 5.0, "slower than the rig moves"),
        ({}, SLOW, 0.02, "the controller samples every 3 s"),
        ({}, BLIND, 0.02, "there is no loop"),
        ({"at": {"alpha_v": 1.4}}, lqr(), 0.02, "no equilibrium"),
    ],
)
def test_what_makes_no_sense_is_refused(keys, controller, clock, says):
    loop = replace(loop_of(controller), sample_time=clock)
    with pytest.raises(ConfigurationError, match=says) as refused:
        replace(STUDY, **keys).run(Subject(MODEL, "newtonian", loop), silent)
    assert "lowest" not in keys or refused.value.where == "lowest"


class TestLoopsWithoutMargins:
    def test_a_loop_that_does_not_hold(self):
        law = Changed(lqr(), late=4)
        found = COARSE.measure(MODEL, loop_of(law), POINT, silent)
        assert isinstance(found, NoResponse)
        assert found.leaves and "rad away after" in found.words
        findings = STUDY.run(subject_of(law), silent)
        assert findings.results["holds"] is False
        assert "does not hold this point" in findings.lead[0]
        assert [chart.name for chart in findings.charts] == ["margins_departure"]

    def test_yaw_where_the_tail_rotor_stands_still(self):
        level = replace(STUDY, at={"alpha_v": 0.0}, periods=3)
        findings = level.run(subject_of(lqr()), silent)
        assert any("study.at.alpha_h=0.3" in words for words in findings.warnings)

    @pytest.mark.slow
    def test_a_fall_back_is_not_the_law(self):
        findings = STUDY.run(subject_of(Changed(lqr(), status=Status.RELAXED)), silent)
        assert "relaxed" in findings.warnings[0]


def test_from_the_command_line(tmp_path, capsys):
    words = ["study=margins", "model=newtonian_vertical", "controller=lqr", "page=false"]
    keys = ["study.lowest=0.5", "study.ratio=1.2", "controller.operating_point.alpha_v=0"]
    out = tmp_path / "margins"
    assert main(["stability", *words, *keys, f"out={out}"]) == 0
    document = json.loads((out / "stability.json").read_text(encoding="utf-8"))
    assert document["study"] == "margins" and document["loop"]["controller"] == "lqr"
    assert document["results"]["loops"]["u_v"]["gain_up"] > 2
    assert "gain may grow" in capsys.readouterr().out


def test_the_nyquist_window_holds_the_circle_and_breaks_the_curve_outside(findings):
    chart = next(chart for chart in findings.charts if chart.name == "margins_nyquist")
    for panel in chart.panels:
        assert panel.equal
        (left, right), (low, high) = panel.x.limits, panel.y.limits
        assert left <= -2.2 and right > 1 and right - left == pytest.approx(high - low)
        parts = [m for m in panel.marks if getattr(m, "label", "").startswith("loop of")]
        assert parts[-1].arrow and np.all(np.isfinite(parts[-1].x))
        x, y = (np.concatenate([getattr(part, name) for part in parts]) for name in "xy")
        shown = np.isfinite(x)
        assert np.all(shown == np.isfinite(y))
        assert np.all((x[shown] >= left) & (x[shown] <= right) & (np.abs(y[shown]) <= high))
        marked = {m.label: m for m in panel.marks if getattr(m, "marker", "") in MARKERS}
        (re,), (im,) = marked["limit of the phase"].x, marked["limit of the phase"].y
        assert math.hypot(re, im) == pytest.approx(1, abs=0.01)
        assert marked["limit of the gain"].y[0] == pytest.approx(0, abs=0.01)


def measured(controller, rig=MODEL, analyser=COARSE, point=POINT) -> FrequencyResponse:
    found = analyser.measure(rig, loop_of(controller), point, silent)
    assert isinstance(found, FrequencyResponse)
    return found


@pytest.fixture(scope="module")
def plain() -> FrequencyResponse:
    return measured(lqr())


def sampled_rig(step: float) -> tuple[np.ndarray, np.ndarray]:
    """A and B of the rig over a control period, in the steps that the rig is simulated in."""
    discrete = discretise(MODEL, step, round(step / 0.005))
    p, w = MODEL.parameters.values, np.zeros(MODEL.n_w)
    _, A, B = (np.array(v) for v in discrete.slopes()(POINT.x, POINT.u, p, w))
    return A, B


def response(A: np.ndarray, B: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, B)


def regulated(omega: np.ndarray) -> np.ndarray:
    """Loop transfer of the LQR: u = −K x − K_i z, z⁺ = z + T C x, on the sampled rig."""
    law = lqr().init(ControlSetup(MODEL, PERIOD, POINT.u)).regulator
    A, B = sampled_rig(PERIOD)
    z = np.exp(1j * omega * PERIOD)
    rows = [MODEL.state_index(name) for name in MODEL.controlled]
    states = response(A, B, z)
    return law.K @ states + law.K_i @ (PERIOD * states[:, rows] / (z - 1)[:, None, None])


def alike(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether two loops differ by at most one part in a hundred at each line."""
    apart, size = (np.linalg.norm(m, axis=(1, 2)) for m in (first - second, second))
    return bool(np.all(apart < 0.01 * size))


class TestTheSignal:
    def test_has_power_on_its_lines_alone_up_to_half_the_rate_and_is_not_peaky(self):
        for seed in (0, 1):
            probe = multisine(0.1, 0.2, 1.1, seed)
            assert probe.period == pytest.approx(2 * np.pi / 0.2, rel=0.01)
            assert np.sqrt(np.mean(probe.values**2)) == pytest.approx(1.0)
            spectrum = np.abs(np.fft.rfft(probe.values))
            assert np.all(spectrum[probe.lines] > 1.0)
            assert np.delete(spectrum, probe.lines) == pytest.approx(0.0, abs=1e-9)
            assert probe.omega[-1] == pytest.approx(np.pi / 0.1)
        assert np.abs(multisine(0.1, 0.1, 1.06).values).max() < 3.5
        # What lies between the lines is told.
        between = np.setdiff1d(np.arange(1, probe.length // 2), probe.lines)[0]
        tone = np.cos(2 * np.pi * between * np.arange(probe.length) / probe.length)
        power = probe.beside((probe.values + 0.1 * tone)[:, None])
        assert power == pytest.approx(0.01 * 0.5, rel=0.03)


class TestALinearLaw:
    @pytest.mark.slow
    def test_has_the_margins_of_linear_algebra(self):
        found = MarginResult(measured(lqr(), analyser=Analyser()))
        S = np.linalg.inv(np.eye(2) + regulated(found.omega))
        exact = MarginResult(replace(found.response, omega=found.omega, S=S, T=np.eye(2) - S))
        for ours, theirs in zip(found.loops, exact.loops, strict=True):
            for name in ("up", "phase", "delay"):
                value = getattr(ours.margins, name).value
                assert value == pytest.approx(getattr(theirs.margins, name).value, rel=1e-3)
            assert ours.sensitivity.value == pytest.approx(theirs.sensitivity.value, rel=1e-3)
        assert found.together.delay.value == pytest.approx(exact.together.delay.value, rel=1e-3)
        assert found.disk_each.alpha == pytest.approx(exact.disk_each.alpha, rel=1e-3)
        assert found.disk_any.alpha == pytest.approx(exact.disk_any.alpha, rel=1e-3)

    def test_is_measured_without_doubt_and_has_the_response_of_linear_algebra(self, plain):
        assert plain.drift < 1e-4 and plain.nonlinearity < 2e-3 and plain.beside < 1e-5
        assert plain.statuses == {"ok": sum(plain.statuses.values())}
        assert plain.limited == 0 and plain.reversed == ()
        assert np.abs(plain.rest).max() < 1e-3
        assert np.abs(plain.S + plain.T - np.eye(2)).max() < 1e-12
        assert alike(plain.L, regulated(plain.omega))

    def test_scales_with_its_gain_and_turns_by_a_period_of_delay(self, plain):
        scaled = measured(Changed(lqr(), gain=(0.6, 1.6)))
        assert alike(scaled.L, np.diag((0.6, 1.6)) @ plain.L)
        late = measured(Changed(lqr(), late=1))
        turned = plain.L * np.exp(-1j * plain.omega * PERIOD)[:, None, None]
        assert alike(late.L, turned)

    @pytest.mark.slow
    def test_turns_by_a_delay_in_the_rig_that_it_does_not_know(self, plain):
        rig = extend_model(MODEL, {"late": InputDelay(rotor="tail", delay=PERIOD)})
        turn = np.ones((plain.omega.size, 2), dtype=complex)
        turn[:, 1] = np.exp(-1j * plain.omega * PERIOD)
        # the delay sits behind one input: that column of the loop transfer turns
        assert alike(measured(lqr(), rig).L, plain.L * turn[:, None, :])


@pytest.mark.slow
def test_pid_has_the_margins_that_it_was_tuned_with():
    """Yaw is tuned last, with the loop of pitch closed: the loop that is measured."""
    pid = Pid(operating_points=[AT])
    analyser = Analyser(lowest=0.2, ratio=1.1, amplitude=0.001)
    found = MarginResult(measured(pid, analyser=analyser)).loops[MODEL.controlled.index("alpha_h")]
    design = PidDesign(
        given={"pitch": pid.pitch, "yaw": pid.yaw},
        operating_points=pid.operating_points,
        max_sensitivity=pid.max_sensitivity,
        smoothness=pid.smoothness,
        derivative_filter=pid.derivative_filter,
        lead_filter=pid.lead_filter,
    ).of(MODEL, 0.02)["yaw"]
    asked = design.margins
    assert found.name == "u_h"
    assert found.margins.phase.value == pytest.approx(asked.phase_margin, rel=0.03)
    assert found.margins.up.value == pytest.approx(asked.gain_margin, rel=0.03)
    assert found.margins.crossover == pytest.approx(asked.crossover, rel=0.03)
    assert found.sensitivity.value == pytest.approx(asked.peak_sensitivity, rel=0.03)


class TestWhatIsNotLinear:
    def test_grows_with_the_signal_and_shows_where_a_rotor_reverses(self, plain):
        large = Analyser(lowest=0.4, ratio=1.2, amplitude=0.01, periods=20)
        assert measured(lqr(), analyser=large).nonlinearity > 20 * plain.nonlinearity
        level = operating_point(MODEL, {"alpha_v": 0.0, "alpha_h": 0.0})
        brief = Analyser(lowest=0.4, ratio=1.2, amplitude=0.001, periods=3)
        found = brief.measure(MODEL, loop_of(lqr()), level, silent)
        assert isinstance(found, NoResponse) and not found.leaves
        assert found.reversed == ("omega_h",)
        assert "still changes by" in found.words


def test_a_controller_that_does_not_look_closes_no_loop():
    class Blind:
        sample_time = PERIOD

        def preview(self, setup):
            return 0

        def init(self, setup):
            return None

        def step(self, state, sample, *, want_prediction):
            return Command(POINT.u + 0.01 * np.sin(sample.time))

    with pytest.raises(NoLoopError):
        COARSE.measure(MODEL, loop_of(Blind()), POINT, silent)
