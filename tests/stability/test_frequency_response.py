"""The measured frequency response of a loop, against linear algebra where the law is linear."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import AT, COARSE, MODEL, PERIOD, POINT, Changed, loop_of, lqr

from trms_cli.controllers.controller import Command, ControlSetup
from trms_cli.controllers.pid import Pid
from trms_cli.controllers.pid_tuning import PidDesign
from trms_cli.effects.extended_model import extended
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.discretisation import discretise
from trms_cli.models.operating_point import operating_point
from trms_cli.stability.loops.frequency_response import (
    Analyser,
    FrequencyResponse,
    NoLoopError,
    NoResponse,
    multisine,
)
from trms_cli.stability.loops.margins import MarginResult
from trms_cli.stability.study import silent


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
    @pytest.mark.parametrize("seed", [0, 1])
    def test_has_power_on_its_lines_alone_up_to_half_the_rate(self, seed):
        probe = multisine(0.1, 0.2, 1.1, seed)
        assert probe.period == pytest.approx(2 * np.pi / 0.2, rel=0.01)
        assert np.sqrt(np.mean(probe.values**2)) == pytest.approx(1.0)
        spectrum = np.abs(np.fft.rfft(probe.values))
        assert np.all(spectrum[probe.lines] > 1.0)
        assert np.delete(spectrum, probe.lines) == pytest.approx(0.0, abs=1e-9)
        assert probe.omega[-1] == pytest.approx(np.pi / 0.1)

    def test_is_not_peaky(self):
        assert np.abs(multisine(0.1, 0.1, 1.06).values).max() < 3.5

    def test_what_lies_between_the_lines_is_told(self):
        probe = multisine(0.1, 0.2, 1.1)
        between = np.setdiff1d(np.arange(1, probe.length // 2), probe.lines)[0]
        tone = np.cos(2 * np.pi * between * np.arange(probe.length) / probe.length)
        power = probe.beside((probe.values + 0.1 * tone)[:, None])
        assert power == pytest.approx(0.01 * 0.5, rel=0.03)


class TestALinearLaw:
    def test_has_the_response_of_linear_algebra(self, plain):
        assert alike(plain.L, regulated(plain.omega))

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

    def test_is_measured_without_doubt(self, plain):
        assert plain.drift < 1e-4 and plain.nonlinearity < 2e-3 and plain.beside < 1e-5
        assert plain.statuses == {"ok": sum(plain.statuses.values())}
        assert plain.limited == 0 and plain.reversed == ()
        assert np.abs(plain.rest).max() < 1e-3
        assert np.abs(plain.S + plain.T - np.eye(2)).max() < 1e-12

    @pytest.mark.parametrize("gain", [(0.6, 1.6)])
    def test_scales_with_its_gain(self, plain, gain):
        scaled = measured(Changed(lqr(), gain=gain))
        assert alike(scaled.L, np.diag(gain) @ plain.L)

    def test_turns_by_a_period_of_delay(self, plain):
        late = measured(Changed(lqr(), late=1))
        turned = plain.L * np.exp(-1j * plain.omega * PERIOD)[:, None, None]
        assert alike(late.L, turned)

    @pytest.mark.slow
    def test_turns_by_a_delay_in_the_rig_that_it_does_not_know(self, plain):
        rig = extended(MODEL, {"late": InputDelay(rotor="tail", delay=PERIOD)})
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
    def test_grows_with_the_signal(self, plain):
        large = Analyser(lowest=0.4, ratio=1.2, amplitude=0.01, periods=20)
        assert measured(lqr(), analyser=large).nonlinearity > 20 * plain.nonlinearity

    def test_shows_where_a_rotor_reverses_which_is_named(self):
        level = operating_point(MODEL, {"alpha_v": 0.0, "alpha_h": 0.0})
        brief = Analyser(lowest=0.4, ratio=1.2, amplitude=0.001, periods=3)
        found = brief.measure(MODEL, loop_of(lqr()), level, silent)
        assert isinstance(found, NoResponse) and not found.leaves
        assert found.reversed == ("omega_h",)
        assert "still changes by" in found.words


def test_a_loop_that_does_not_hold_its_point_has_no_response():
    found = COARSE.measure(MODEL, loop_of(Changed(lqr(), late=4)), POINT, silent)
    assert isinstance(found, NoResponse)
    assert found.leaves and "rad away after" in found.words


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
