"""Margins read off a loop, against closed forms, python-control and brute force; the study; the
measured frequency response, against linear algebra where the law is linear.

What a loop tolerates: the loop run from any state with its commands changed on the way, the parts
of the search, and the study against the linear margins.
"""

import json
import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.cli import main
from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Status
from trms_cli.controllers.lqr import Lqr
from trms_cli.controllers.open_loop import OpenLoop
from trms_cli.controllers.pid import Pid
from trms_cli.controllers.pid_design import PidDesign
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import effect_names, extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.effects.rotor_reaction import RotorReaction
from trms_cli.models.discretisation import discretise
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import operating_point
from trms_cli.observers.full_state import FullState
from trms_cli.references.constant import Constant
from trms_cli.stability.closed_loop import Enough, LoopRun, run_loop
from trms_cli.stability.loops.frequency_response import (
    Analyser,
    DiskMargin,
    FrequencyResponse,
    MarginResult,
    NoResponse,
    classical_margins,
    continuous,
    diagonal_mu,
    disk_margin,
    held_by_friction,
    interpolate_response,
    multisine,
)
from trms_cli.stability.loops.tolerance import (
    Bounds,
    CommandDelay,
    Impairment,
    ImpairmentLimits,
    RunVerdict,
    TrialRun,
    find_failure,
    impairments_of,
)
from trms_cli.stability.studies.margins import Margins
from trms_cli.stability.studies.tolerance import Tolerance, _sentence
from trms_cli.stability.study import silent
from trms_cli.stability.subject import LoopParts, Subject

MODEL = Newtonian()
AT = {"alpha_v": 0.0, "alpha_h": 0.3}
POINT = operating_point(MODEL, AT)
PERIOD = 0.1
#: Coarse, for speed: exact at its lines all the same.
COARSE = Analyser(lowest=0.4, ratio=1.2, amplitude=0.0001, periods=20)


def lqr(**keys: Any) -> Lqr:
    return Lqr(operating_point=AT, sample_time=PERIOD, **keys)


def loop_of(controller: Any, model: Any = MODEL) -> LoopParts:
    names = {"controller": type(controller).__name__.lower(), "observer": "full_state"}
    return LoopParts(model, controller, FullState(), 0.02, names)


def subject_of(controller: Any, rig: Any = MODEL) -> Subject:
    return Subject(rig, "newtonian", loop_of(controller))


@dataclass(frozen=True)
class Changed:
    """A controller with a gain around a point, whole periods late, or with another status."""

    controller: Any
    gain: tuple[float, ...] = (1.0, 1.0)
    late: int = 0
    status: Status = Status.OK
    centre: np.ndarray = field(default_factory=lambda: POINT.u)

    @property
    def sample_time(self) -> float:
        return float(self.controller.sample_time)

    def preview(self, setup: ControlSetup) -> int:
        return int(self.controller.preview(setup))

    def init(self, setup: ControlSetup) -> Any:
        past = [setup.first_command.copy() for _ in range(self.late)]
        return [self.controller.init(setup), past]

    def step(self, state: Any, sample: ControlSample, *, want_prediction: bool) -> Command:
        command = self.controller.step(state[0], sample, want_prediction=want_prediction)
        u = self.centre + np.array(self.gain) * (command.u - self.centre)
        state[1].append(u)
        return replace(command, u=state[1].pop(0), status=self.status)


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
    @pytest.mark.slow
    def test_a_loop_that_does_not_hold_or_does_not_answer_or_a_rotor_that_stands_still(self):
        law = Changed(lqr(), late=4)
        found = COARSE.measure(MODEL, loop_of(law), POINT, silent)
        assert isinstance(found, NoResponse)
        assert found.leaves and "rad away after" in found.words
        findings = STUDY.run(subject_of(law), silent)
        assert findings.results["holds"] is False
        assert "does not hold this point" in findings.lead[0]
        assert [chart.name for chart in findings.charts] == ["margins_departure"]
        # Whatever holds the rig: a loop that gives nothing back is not called robust.
        findings = STUDY.run(subject_of(Changed(lqr(), gain=(1.0, 1e-6))), silent)
        assert findings.results["holds"]
        assert any(said.startswith("u_h: no loop to speak of") for said in findings.lead)
        assert any("the loop of u_h does not answer" in said for said in findings.warnings)
        level = replace(STUDY, at={"alpha_v": 0.0}, periods=3)
        findings = level.run(subject_of(lqr()), silent)
        assert any("study.at.alpha_h=0.3" in words for words in findings.warnings)

    @pytest.mark.slow
    def test_a_fall_back_is_not_the_law(self):
        findings = STUDY.run(subject_of(Changed(lqr(), status=Status.RELAXED)), silent)
        assert "relaxed" in findings.warnings[0]


def test_from_the_command_line_one_axis_needs_no_point_of_the_other(tmp_path, capsys):
    words = ["study=margins", "model=newtonian_vertical", "controller=lqr", "page=false"]
    keys = ["study.lowest=0.5", "study.ratio=1.2", "controller.operating_point.alpha_v=0"]
    out = tmp_path / "margins"
    assert main(["stability", *words, *keys, f"out={out}"]) == 0
    document = json.loads((out / "stability.json").read_text(encoding="utf-8"))
    assert document["study"] == "margins" and document["loop"]["controller"] == "lqr"
    assert set(document["results"]["loops"]) == {"u_v"}
    assert len(document["tables"]) == 2  # nothing is changed together
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


def regulated(omega: np.ndarray) -> np.ndarray:
    """Loop transfer of the LQR: u = −K x − K_i z, z⁺ = z + T C x, on the sampled rig."""
    law = lqr().init(ControlSetup(MODEL, PERIOD, POINT.u)).regulator
    # In the steps that the rig is simulated in.
    slopes = discretise(MODEL, PERIOD, round(PERIOD / 0.005)).slopes()
    p, w = MODEL.parameters.values, np.zeros(MODEL.n_w)
    _, A, B = (np.array(part) for part in slopes(POINT.x, POINT.u, p, w))
    z = np.exp(1j * omega * PERIOD)
    rows = [MODEL.state_index(name) for name in MODEL.controlled]
    states = np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, B)
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
        requested_gains={"pitch": pid.pitch, "yaw": pid.yaw},
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

    with pytest.raises(ConfigurationError, match="there is no loop"):
        COARSE.measure(MODEL, loop_of(Blind()), POINT, silent)


BOUNDS = Bounds(rest=0.02, swing=0.002, chatter=0.02)
TIME = np.arange(0, 40, 0.02)
STILL = np.zeros((TIME.size, 1))


def kind(errors: np.ndarray, commands: np.ndarray = STILL, ended: bool = False) -> str:
    return BOUNDS.verdict(errors.reshape(TIME.size, -1), commands, ended).kind


def swing(decay: float) -> np.ndarray:
    return 0.1 * np.exp(-decay * TIME) * np.cos(1.8 * TIME)


class TestVerdicts:
    @pytest.mark.parametrize(
        ("error", "told"),
        [
            (swing(0.3), "settles"),
            (swing(0.06), "dies out"),
            (swing(0.0), "swings"),
            (swing(-0.05), "swings"),
            # An error that stays.
            (0.03 + 0.1 * np.exp(-TIME), "rests beside"),
            (0.01 + 0.1 * np.exp(-TIME), "settles"),
            (0.3 * np.exp(-0.08 * TIME), "dies out"),
            # One that shrinks too slowly is no rest.
            (0.3 * np.exp(-0.03 * TIME), "still creeping"),
            (0.05 + 0.3 * np.exp(-0.1 * TIME), "still creeping"),
            (0.05 + 0.3 * np.exp(-0.5 * TIME), "rests beside"),
            (-0.3 * np.exp(0.01 * TIME), "rests beside"),
            (0.4 + 0.15 * np.exp(-0.02 * TIME) * np.cos(0.23 * TIME), "rests beside"),
            # A slip is no swing.
            (np.where(TIME < 33, 0.015, -0.005), "dies out"),
        ],
    )
    def test_of_one_angle(self, error, told):
        assert kind(error) == told

    def test_of_commands_at_their_limit_that_chatter_and_of_a_run_that_ended(self):
        assert kind(0.3 * np.exp(-0.03 * TIME), np.ones_like(STILL)) == "rests beside"
        fast = 0.1 * np.sign(np.cos(np.pi * np.arange(TIME.size)))[:, None]
        assert kind(1e-5 * np.cos(TIME), fast) == "chatters"
        assert kind(np.exp(0.1 * TIME), ended=True) == "is lost"
        assert BOUNDS.verdict(np.ones((1, 2)), np.ones((1, 2)), True).axis == 0

    def test_names_the_angle_that_fails(self):
        both = np.column_stack([0.3 * np.exp(-0.03 * TIME), 0.05 * np.ones_like(TIME)])
        found = BOUNDS.verdict(both, STILL, False)
        assert found.kind == "rests beside" and found.axis == 1
        assert found.calm and not found.back
        both = np.column_stack([0.015 * np.ones_like(TIME), 0.01 * np.cos(TIME)])
        found = BOUNDS.verdict(both, STILL, False)
        assert found.kind == "swings" and found.axis == 1 and not found.calm and not found.back


def tried(size: float, good: bool) -> TrialRun:
    told = "settles" if good else "swings"
    run = LoopRun(np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)))
    return TrialRun(size, run, RunVerdict(told, np.zeros(1), np.zeros(1), 0))


def search(sizes, stood, precision=1.1, nothing=0.0):
    return find_failure(
        sizes,
        tried(nothing, True),
        lambda size: tried(size, stood(size)),
        precision,
        lambda one: not one.verdict.calm,
    )


class TestTheSearch:
    @given(st.floats(0.011, 0.79), st.floats(1.01, 1.5))
    def test_closes_in_on_a_limit(self, limit, precision):
        found = search((0.05, 0.1, 0.2, 0.4, 0.8), lambda size: size < limit, precision)
        assert found.below.size < limit <= found.above.size
        assert found.above.size <= precision * found.below.size
        assert found.below.size < found.limit < found.above.size
        assert found.again == ()

    def test_tells_that_all_is_stood_that_a_loop_recovers_and_that_nothing_is_stood(self):
        found = search((0.1, 0.2), lambda size: True)
        assert found.above is None and found.limit is None and found.below.size == 0.2
        found = search((1.5, 3.0, 6.0, 12.0), lambda size: size < 2 or size > 10, nothing=1.0)
        assert 1.9 < found.limit < 2.1
        assert found.again == (12.0,)
        found = search((0.1,), lambda size: size <= 0)
        assert found.below.size == 0 and found.above.size == pytest.approx(0.1 / 2**10)


class TestWhatGoesWrong:
    @pytest.mark.parametrize("delay", [0.0, 0.04, 0.05])
    def test_a_delay_is_that_of_the_effect(self, delay):
        rig = MODEL
        for rotor in ("main", "tail"):
            rig = extend_model(rig, {f"{rotor}_late": InputDelay(rotor=rotor, delay=delay)})
        loop, offset = loop_of(lqr()), {"alpha_v": -0.05, "alpha_h": -0.05}
        path = Impairment("delay").path(MODEL, POINT, 0.02, delay)
        ours = run_loop(MODEL, loop, POINT, 8.0, offset=offset, path=path)
        theirs = run_loop(rig, loop, POINT, 8.0, offset=offset)
        # of a whole number of samples it is the same, else the mean over a sample differs a little
        assert np.abs(ours.x - theirs.x)[:, -1].max() < (1e-9 if delay != 0.05 else 2e-4)

    def test_before_the_first_command_the_points_own_is_in_force(self):
        delayed = CommandDelay(2.25, np.array([1.0]))
        given = [delayed(k, np.array([float(k + 2)]))[0] for k in range(5)]
        # u(k − 2) and u(k − 3), three parts to one
        assert given == pytest.approx([1.0, 1.0, 0.75 * 2 + 0.25 * 1, 2.75, 3.75])

    def test_a_gain_acts_on_all_of_a_command_within_its_limits(self):
        large = Impairment("gain", "u_h", up=True).path(MODEL, POINT, 0.02, 3.0)
        assert large(0, np.array([1.0, 0.5])) == pytest.approx([1.0, 1.5])
        assert large(0, np.array([1.0, -1.0])) == pytest.approx([1.0, -2.5])
        small = Impairment("gain", "u_v")
        assert small.display_size(4.0) == 0.25
        assert small.path(MODEL, POINT, 0.02, 4.0)(0, np.ones(2)) == pytest.approx([0.25, 1.0])
        changed = Impairment("gain", "u_v", up=True, of_changes=True)
        changes = changed.path(MODEL, POINT, 0.02, 2.0)
        assert changes(0, POINT.u + 0.1) == pytest.approx(POINT.u + np.array([0.2, 0.1]))

    def test_friction_is_an_effect_on_the_rig_and_each_rig_has_its_own(self):
        rig = Impairment("friction", "pitch").rig(MODEL, 0.004)
        assert effect_names(rig) == ("added_friction_pitch",)
        assert rig.parameters["added_friction_pitch.torque"].value == 0.004
        keys = [one.key for one in impairments_of(Newtonian(freedom="vertical"))]
        assert keys == ["delay", "gain_up_u_v", "gain_down_u_v", "friction_pitch"]


#: Close to the point the rig is linear, and the simulated limit has to be the foretold one.
NEAR = Tolerance(
    at=AT,
    offset={"alpha_v": -0.002, "alpha_h": -0.002},
    duration=30.0,
    rest=0.002,
    swing=0.00005,
    chatter=0.0005,
    delays=(0.1, 0.2),
    gains=(),
    frictions=(),
    precision=1.02,
)


class TestTheStudyOfTolerance:
    @pytest.mark.parametrize("gain", [1.0, pytest.param(0.7, marks=pytest.mark.slow)])
    def test_near_its_point_a_loop_stands_the_delay_that_its_margins_foretell(self, gain):
        findings = NEAR.run(subject_of(Changed(lqr(), gain=(gain, gain))), silent)
        found = findings.results["tolerances"]["delay"]
        # the hold of a fraction of a control period is not the phase of a delay, but nearly
        assert found["calm"]["limit"] == pytest.approx(found["linear"], rel=0.06)
        assert found["compared"] == "as foretold"

    @pytest.mark.slow
    def test_far_from_it_tells_all_limits(self):
        study = replace(
            NEAR,
            offset={"alpha_v": -0.2, "alpha_h": -0.2},
            rest=0.02,
            swing=0.002,
            chatter=0.02,
            gains=(2.0, 8.0),
            frictions=(0.003,),
            precision=1.5,
        )
        findings = study.run(subject_of(lqr()), silent)
        told = findings.results["tolerances"]
        json.dumps(findings.results, allow_nan=False)
        assert set(told) == {
            *("delay", "gain_up_u_v", "gain_down_u_v", "gain_up_u_h", "gain_down_u_h"),
            *("friction_pitch", "friction_yaw"),
        }
        # 1.41 V hold the point: a gain below 1.41/2.5 cannot
        share = float(POINT.u[0]) / 2.5
        down = told["gain_down_u_v"]["back"]
        assert down["above"] <= share and down["below"] > 0.8 * share
        assert down["verdict"] == "rests beside"
        assert f"below {share:.2g}" in told["gain_down_u_v"]["compared"]
        assert told["friction_pitch"]["linear"] is None
        drawn = {chart.name for chart in findings.charts}
        assert drawn == {"tolerance_overview", "tolerance_responses"}
        assert len(findings.lead) == 8
        assert len(findings.measures) == 7 and findings.measures[0].label == "delay of all commands"

    def test_its_margins_are_those_of_the_other_study(self):
        """Both studies measure by the same defaults."""
        ours, theirs = Tolerance(), Margins()
        assert ours.at == theirs.at
        assert math.isclose(theirs.lowest, 0.1) and theirs.periods == 6


def test_a_gain_too_small_is_stood_down_to_a_factor():
    impairment = Impairment("gain", "u_v")
    found = search((2.0, 4.0), lambda size: size < 1.8, nothing=1.0)
    told = _sentence(ImpairmentLimits(impairment, found, found, None, True))
    assert "stood down to ×0." in told and "up to" not in told
    found = search((2.0, 4.0), lambda size: True, nothing=1.0)
    told = _sentence(ImpairmentLimits(impairment, found, found, None, True))
    assert "stood down to ×0.25, the most tried" in told
    told = _sentence(ImpairmentLimits(replace(impairment, up=True), found, found, None, True))
    assert "stood up to ×4" in told


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"delays": ()}, "no sizes"),
        ({"offset": {"alpha_x": 0.1}}, "alpha_x"),
        ({"offset": {"alpha_v": -2.0}}, "counts as lost"),
        pytest.param(
            {"duration": 1.0, "swing": 1e-9, "rest": 1e-9},
            "with nothing wrong",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_what_makes_no_sense_to_tolerate_is_refused(keys, says):
    with pytest.raises(ConfigurationError, match=says):
        replace(NEAR, **keys).run(subject_of(lqr()), silent)


@pytest.mark.slow
def test_a_loop_that_does_not_hold_tolerates_nothing():
    findings = NEAR.run(subject_of(Changed(lqr(), late=4)), silent)
    assert findings.results["holds"] is False


LOOP = loop_of(Lqr())
PITCH = MODEL.state_index("alpha_v")


def test_the_loop_rests_at_its_point_comes_back_to_it_goes_to_another_and_repeats_itself():
    run = run_loop(MODEL, LOOP, POINT, 2.0)
    assert run.time.shape == (100,) and run.x.shape == (100, 6) and run.u.shape == (100, 2)
    assert np.abs(run.x - POINT.x).max() < 1e-6 and not run.stop_reason and not run.failures
    assert run.statuses == {"ok": 100}
    run = run_loop(MODEL, LOOP, POINT, 20.0, offset={"alpha_v": 0.1})
    assert run.x[0, PITCH] == pytest.approx(0.1, abs=1e-9)
    assert np.abs(run.x[-1] - POINT.x).max() < 0.01
    run = run_loop(MODEL, LOOP, POINT, 20.0, reference={"alpha_v": 0.2})
    assert run.x[-1, PITCH] == pytest.approx(0.2, abs=0.01)
    first, second = (run_loop(MODEL, LOOP, POINT, 3.0, offset={"alpha_h": 0.1}) for _ in "ab")
    assert np.array_equal(first.x, second.x) and np.array_equal(first.u, second.u)


def test_what_reaches_the_motors_and_the_rig_may_be_unknown_and_a_run_may_end():
    run = run_loop(MODEL, LOOP, POINT, 1.0, path=lambda k, u: u + (0.1 if k == 10 else 0.0))
    assert run.applied[10] == pytest.approx(run.u[10] + 0.1)
    assert np.delete(run.applied, 10, 0) == pytest.approx(np.delete(run.u, 10, 0))
    assert np.abs(run.x[:11] - POINT.x).max() < 1e-6 < np.abs(run.x[12:] - POINT.x).max()
    rig = extend_model(MODEL, {"reaction": RotorReaction(rotor="main", drag=3e-7, inertia=1e-4)})
    known, other = (run_loop(model, LOOP, POINT, 20.0) for model in (MODEL, rig))
    assert np.abs(other.x - known.x).max() > 0.01

    def enough(k, u):
        if k == 20:
            raise Enough("seen")
        return u

    by_path = run_loop(MODEL, LOOP, POINT, 2.0, path=enough)
    assert (
        by_path.stop_reason == "seen" and by_path.x.shape == (20, 6) and by_path.u.shape == (20, 2)
    )
    at_once = run_loop(MODEL, LOOP, POINT, 2.0, until=lambda x: "here")
    assert at_once.stop_reason == "here" and at_once.x.shape == (0, 6) and at_once.u.shape == (0, 2)
