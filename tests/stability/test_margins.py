"""Margins read off a loop, against closed forms, python-control and brute force; the study."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_cases import AT, MODEL, POINT, Changed, loop_of, lqr, subject_of

from trms_cli.cli import main
from trms_cli.controllers.controller import Status
from trms_cli.controllers.lqr import Lqr
from trms_cli.controllers.open_loop import OpenLoop
from trms_cli.controllers.pid import Pid
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extended
from trms_cli.models.newtonian import Newtonian
from trms_cli.references.constant import Constant
from trms_cli.stability.closed_loop import run_loop
from trms_cli.stability.loops.frequency_response import held_by_friction
from trms_cli.stability.loops.margins import (
    DiskMargin,
    classical_margins,
    continuous,
    diagonal_mu,
    disk_margin,
    interpolated,
)
from trms_cli.stability.studies.margins import Margins
from trms_cli.stability.study import silent
from trms_cli.stability.subject import Subject

OMEGA = np.geomspace(0.01, 100, 4000)
S = 1j * OMEGA
MARKERS = ("triangle", "square")


class TestOneLoop:
    def test_an_integrator_loses_ninety_degrees_at_the_most(self):
        found = classical_margins(OMEGA, 2.0 / S)
        assert found.up is None and found.down is None
        assert found.crossover == pytest.approx(2.0, rel=1e-4)
        assert found.phase.value == pytest.approx(math.pi / 2, rel=1e-4)
        assert found.delay.value == pytest.approx(math.pi / 4, rel=1e-4)

    @pytest.mark.parametrize("gain", [0.5, 2.0])
    def test_three_lags_have_the_margin_of_hurwitz(self, gain):
        # k/(s + 1)³ is unstable from k = 8 on, and swings at √3 rad/s
        found = classical_margins(OMEGA, gain / (S + 1) ** 3)
        assert found.up.value == pytest.approx(8 / gain, rel=1e-4)
        assert found.up.omega == pytest.approx(math.sqrt(3), rel=1e-4)
        assert found.down is None

    def test_an_unstable_rig_has_a_least_gain_too(self):
        # k (s + 2)²/(s − 1)³ closed: s³ + (k − 3)s² + (4k + 3)s + 4k − 1, stable by Hurwitz where
        # (k − 3)(4k + 3) > 4k − 1
        k = np.roots([4.0, -13.0, -8.0])
        least = float(k[k > 0][0])
        found = classical_margins(OMEGA, 6.0 * (S + 2) ** 2 / (S - 1) ** 3)
        assert found.down.value == pytest.approx(least / 6.0, rel=1e-3)
        assert found.up is None

    def test_a_sampled_loop_ends_at_half_the_rate(self):
        omega = np.geomspace(0.01, math.pi / 0.1, 2000)
        found = classical_margins(omega, 0.5 * np.exp(-0.1j * omega))
        assert found.up.value == pytest.approx(2.0, rel=1e-3)
        assert found.up.omega == pytest.approx(math.pi / 0.1)

    def test_the_first_of_several_loci_counts(self):
        loci = np.column_stack([2.0 / (S + 1) ** 3, 4.0 / (S + 1) ** 3])
        assert classical_margins(OMEGA, loci).up.value == pytest.approx(2.0, rel=1e-4)

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

    def test_one_loop_has_its_own_size(self):
        assert diagonal_mu(np.array([[[3 - 4j]]]))[0] == pytest.approx(5.0)

    def test_factors_within_the_disk_are_stood_and_one_on_its_edge_is_not(self):
        loop = 4.0 / (S * (S + 1) * (S / 5 + 1))
        loop *= 0.5
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

    def test_a_disk_of_two_holds_every_gain(self):
        assert DiskMargin(2.0, 1.0).gain_up == math.inf
        assert DiskMargin(2.5, 1.0).gain_down == 0.0
        assert DiskMargin(1.0, 1.0).gain_up == pytest.approx(3.0)
        assert DiskMargin(1.0, 1.0).gain_down == pytest.approx(1 / 3)


def test_loci_are_followed_where_their_order_changes():
    first, second = 1 / (S + 1), 2 / (S + 3) * np.exp(-0.1 * S)
    loci = np.column_stack([first, second])
    mixed = loci.copy()
    mixed[1000:2000] = mixed[1000:2000, ::-1]
    followed = continuous(mixed)
    assert np.abs(np.diff(followed, axis=0)).max() <= np.abs(np.diff(loci, axis=0)).max() + 1e-12


def test_between_the_lines_the_sensitivity_is_interpolated():
    few = np.geomspace(0.1, 30, 90)

    def sensitivity(omega):
        s = 1j * omega
        loop = 8.0 * (s + 1) / (s * (s**2 + 0.1 * s + 3.3) * (s / 12 + 1))
        return 1 / (1 + loop)

    fine = np.geomspace(0.1, 30, 2000)
    guess = interpolated(few, sensitivity(few)[:, None, None], fine)[:, 0, 0]
    assert np.abs(guess - sensitivity(fine)).max() < 0.01


STUDY = Margins(at=AT, lowest=0.2, ratio=1.15, amplitude=0.0005, periods=10)


@pytest.fixture(scope="module")
def findings():
    return STUDY.run(subject_of(lqr()), silent)


class TestTheStudy:
    def test_tells_the_margins_of_each_command(self, findings):
        assert findings.results["holds"]
        assert set(findings.results["loops"]) == {"u_v", "u_h"}
        assert not findings.warnings
        drawn = [chart.name.removeprefix("margins_") for chart in findings.charts]
        assert drawn == ["bode", "nyquist", "sensitivity"]
        json.dumps(findings.results, allow_nan=False)

    def test_a_regulator_has_what_regulators_have(self, findings):
        """Sampling takes some of the 60° and the factor 1/2 that continuous ones guarantee."""
        for loop in findings.results["loops"].values():
            assert loop["gain_up"] > 2 and math.degrees(loop["phase"]) > 35
            assert loop["modulus_margin"] == pytest.approx(1 / loop["peak_sensitivity"])

    def test_no_disk_is_larger_than_what_it_bounds(self, findings):
        results = findings.results
        assert results["disk_any"]["alpha"] <= results["disk_each"]["alpha"] + 1e-12
        for loop in results["loops"].values():
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
    @pytest.mark.parametrize(("axis", "angle"), [("pitch", "alpha_v"), ("yaw", "alpha_h")])
    def test_holds_its_axis(self, axis, angle):
        rig = extended(MODEL, {"dry": CoulombFriction(axis=axis, torque=0.001)})
        assert held_by_friction(rig, POINT) == (angle,)
        assert held_by_friction(MODEL, POINT) == ()

    def test_is_left_out_of_the_margins_and_that_is_told(self, findings):
        rig = extended(MODEL, {"dry": CoulombFriction(axis="yaw", torque=0.003)})
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
        ({}, None, 0.02, "no controller is chosen"),
    ],
)
def test_what_makes_no_sense_is_refused(keys, controller, clock, says):
    loop = None if controller is None else replace(loop_of(controller), sample_time=clock)
    with pytest.raises(ConfigurationError, match=says) as refused:
        replace(STUDY, **keys).run(Subject(MODEL, "newtonian", loop), silent)
    assert "lowest" not in keys or refused.value.where == "lowest"


class TestLoopsWithoutMargins:
    def test_a_loop_that_does_not_hold(self):
        findings = STUDY.run(subject_of(Changed(lqr(), late=4)), silent)
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
