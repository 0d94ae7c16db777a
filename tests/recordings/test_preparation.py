"""Resampling, outliers, gaps and shifts: what is done is right, said, and done on request only."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trms_cli.core.errors import RecordingError
from trms_cli.identification.loop_state import find_loop
from trms_cli.identification.rotor_delays import estimate_delays
from trms_cli.recordings.preparation import (
    Preparation,
    fill_gaps,
    resample,
    shift_channels,
    split_at_gaps,
)
from trms_cli.recordings.recording import Recording
from trms_cli.recordings.summary import outliers, summarise

from .played_rig import BENCH, STEP, play

UNITS = {"u_v": "V", "alpha_v": "rad", "r_v": "rad"}


def made(time, u=None, alpha=None, **metadata) -> Recording:
    time = np.asarray(time, dtype=float)
    channels = {
        "u_v": np.sin(time) if u is None else np.asarray(u, dtype=float),
        "alpha_v": np.cos(time) if alpha is None else np.asarray(alpha, dtype=float),
        "r_v": np.round(time),
    }
    return Recording(time, channels, UNITS, metadata, Path("made.csv"))


class TestResampling:
    def test_a_slow_sine_passes_unchanged_and_without_delay(self):
        time = np.arange(0, 20, 0.002)
        result = resample(made(time, alpha=np.sin(2 * np.pi * 0.5 * time)), 0.02)
        assert result.sample_time == pytest.approx(0.02)
        expected = np.sin(2 * np.pi * 0.5 * result.time)
        inside = (result.time > 0.5) & (result.time < 19.5)
        np.testing.assert_allclose(result.channels["alpha_v"][inside], expected[inside], atol=1e-3)

    @pytest.mark.parametrize("frequency", [30.0, 60.0, 140.0])
    def test_what_would_alias_is_gone(self, frequency):
        time = np.arange(0, 20, 0.002)
        result = resample(made(time, alpha=np.sin(2 * np.pi * frequency * time)), 0.02)
        inside = (result.time > 0.5) & (result.time < 19.5)
        assert np.abs(result.channels["alpha_v"][inside]).max() < 2e-3  # -54 dB

    def test_commands_keep_their_impulse_and_never_look_ahead(self):
        time = np.arange(0, 4, 0.01)
        u = np.where((time >= 1.005) & (time < 2.0), 1.0, 0.0)  # rises at the row of 1.01 s
        result = resample(made(time, u=u), 0.02)
        held = result.channels["u_v"]
        assert np.sum(held) * 0.02 == pytest.approx(np.sum(u) * 0.01, abs=1e-9)
        assert held[50] == pytest.approx(0.5) and held[49] == 0.0 and held[51] == 1.0

    def test_a_finer_rate_holds_commands_and_joins_measurements(self):
        result = resample(made([0, 0.1, 0.2], u=[1, 2, 3], alpha=[0, 1, 0]), 0.05)
        assert result.channels["u_v"].tolist() == [1, 1, 2, 2, 3]
        np.testing.assert_allclose(result.channels["alpha_v"], [0, 0.5, 1, 0.5, 0])

    def test_missing_stays_missing_across_gaps_and_empty_cells(self):
        time = np.concatenate([np.arange(0, 2, 0.01), np.arange(3, 5, 0.01)])
        alpha = np.cos(time)
        alpha[(time > 0.5) & (time < 0.8)] = np.nan
        result = resample(made(time, alpha=alpha), 0.02)
        missing = np.isnan(result.channels["alpha_v"])
        t = result.time
        assert missing[(t > 2.0) & (t < 2.99)].all() and missing[(t > 0.51) & (t < 0.79)].all()
        assert not missing[(t < 0.5) | ((t > 0.81) & (t < 1.98)) | (t > 3.01)].any()
        np.testing.assert_allclose(result.channels["alpha_v"][~missing], np.cos(t[~missing]),
                                   atol=5e-3)  # fmt: skip
        assert np.isnan(result.channels["u_v"][(t > 2.03) & (t < 2.97)]).all()

    def test_uneven_rows_come_onto_the_grid(self):
        generator = np.random.default_rng(0)
        time = np.sort(generator.uniform(0, 10, 2000))
        result = resample(made(time, alpha=np.sin(2 * time)), 0.02)
        assert np.ptp(np.diff(result.time)) < 1e-9
        seen = result.channels["alpha_v"]
        good = np.isfinite(seen)
        assert good.mean() > 0.9
        np.testing.assert_allclose(seen[good], np.sin(2 * result.time[good]), atol=0.02)

    def test_the_same_rate_changes_nothing_but_says_so_and_absurd_ones_are_refused(self):
        recording = made(np.arange(100) * 0.02)
        result = resample(recording, 0.02)
        assert result.channels["alpha_v"] is recording.channels["alpha_v"]
        assert "already" in result.remarks[-1]
        for absurd in (50.0, 1e-9):
            with pytest.raises(RecordingError, match="samples at"):
                resample(recording, absurd)


class TestOutliers:
    @pytest.mark.parametrize("kind", ["prbs", "multilevel", "closed"])
    @pytest.mark.parametrize("seed", range(2))
    def test_a_good_recording_has_hardly_any(self, kind, seed):
        recording = play(kind, seed=seed, duration=40.0)
        for name in recording.names("output"):
            assert outliers(recording.channels[name]).sum() <= 2, name

    @pytest.mark.parametrize("seed", range(4))
    def test_spikes_are_found_where_they_are(self, seed):
        recording = play("multilevel", seed=seed, duration=40.0)
        generator = np.random.default_rng(seed)
        for name, size in (("alpha_v", 0.1), ("omega_h", 150.0)):
            values = recording.channels[name].copy()
            at = 20 + 90 * np.arange(20)
            values[at] += size * generator.choice([-1, 1], len(at))
            found = np.flatnonzero(outliers(values))
            assert set(at) <= set(found) and len(found) <= len(at) + 2

    def test_runs_of_two_are_found_and_steps_missing_samples_and_short_channels_are_none(self):
        values = np.random.default_rng(0).normal(0, 0.01, 500)
        values[250:] += 1.0
        assert not outliers(values).any()
        values[100:102] += 1.0
        assert np.flatnonzero(outliers(values)).tolist() == [100, 101]
        assert not outliers(np.full(100, np.nan)).any()
        assert not outliers(np.array([0.0, 5.0, 0.0])).any()


class TestGaps:
    def test_parts_between_gaps(self):
        time = np.concatenate([np.arange(50) * 0.02, 3 + np.arange(30) * 0.02, [9.0, 9.02]])
        parts = split_at_gaps(made(time))
        assert [len(p) for p in parts] == [50, 30]
        assert "1 of fewer" in parts[0].remarks[-1]
        recording = made(np.arange(50) * 0.02)
        assert split_at_gaps(recording) == [recording]
        with pytest.raises(RecordingError, match="none of the"):
            split_at_gaps(made([0, 0.02, 0.04, 1.0, 1.02, 1.04, 3.0, 3.02]))

    def test_short_holes_are_filled_and_long_ones_stay(self):
        time = np.delete(np.arange(100) * 0.02, [10, 11, *range(40, 60)])
        alpha = np.linspace(0, 1, 100)[np.round(time / 0.02).astype(int)]
        alpha[5] = np.nan
        result = fill_gaps(made(time, alpha=alpha), 0.1, 0.2)
        assert len(result) == 80
        np.testing.assert_allclose(
            result.channels["alpha_v"],
            np.linspace(0, 1, 100)[np.round(result.time / 0.02).astype(int)],
        )
        assert result.channels["u_v"][10] == result.channels["u_v"][9]  # held
        assert "alpha_v 3" in result.remarks[-1]


class TestDelays:
    @pytest.mark.parametrize("kind", ["prbs", "multilevel", "multisine", "closed"])
    @pytest.mark.parametrize("late", [0, 1, 3])
    def test_a_late_command_is_found_from_the_tail_rotor(self, kind, late):
        found = estimate_delays(play(kind, seed=late + 1, late=late, prior_seed=late))
        tail = next(d for d in found if d.effect == "omega_h")
        assert tail.seconds / STEP == pytest.approx(late, abs=0.35)
        assert tail.clear == (late > 0)

    def test_no_delay_is_called_clear_on_rigs_without_one(self):
        clear = [
            delay
            for seed in range(5)
            for delay in estimate_delays(play("multilevel", seed=seed, prior_seed=seed))
            if delay.clear
        ]
        assert len(clear) <= 1  # of 20

    def test_the_shift_undoes_the_delay(self):
        recording = play("prbs", duration=30.0)
        late = dict(recording.channels)
        late["omega_h"] = np.concatenate([np.full(4, late["omega_h"][0]), late["omega_h"][:-4]])
        mended = shift_channels(replace(recording, channels=late), {"omega_h": 4 * STEP})
        assert len(mended) == len(recording) - 4
        for name in recording.channels:
            np.testing.assert_array_equal(mended.channels[name], recording.channels[name][:-4])
        assert mended.time[0] == recording.time[0]

    def test_a_part_of_a_sample_is_interpolated_for_what_is_measured(self):
        time = np.arange(200) * 0.02
        result = shift_channels(made(time, alpha=time), {"alpha_v": 0.013})
        np.testing.assert_allclose(result.channels["alpha_v"], result.time + 0.013, atol=1e-9)

    def test_a_part_of_a_sample_of_a_command_an_unknown_channel_and_too_long_a_delay_are_refused(
        self,
    ):
        with pytest.raises(RecordingError, match="held from row to row"):
            shift_channels(made(np.arange(100) * 0.02), {"u_v": 0.013})
        with pytest.raises(RecordingError, match="no 'alpha'"):
            shift_channels(made(np.arange(100) * 0.02), {"alpha": 0.02})
        with pytest.raises(RecordingError, match="leave nothing"):
            shift_channels(made(np.arange(100) * 0.02), {"alpha_v": 3.0})


class TestLoop:
    @pytest.mark.parametrize("seed", range(2))
    @pytest.mark.parametrize("kind", ["prbs", "multilevel", "multisine", "closed"])
    def test_a_controller_is_noticed_where_there_is_one(self, kind, seed):
        loop = find_loop(play(kind, seed=seed, prior_seed=seed))
        assert loop.state == ("closed" if kind == "closed" else "open")

    def test_what_the_recording_says_wins_and_too_little_is_not_told(self):
        recording = play("closed", duration=20.0)
        loop = find_loop(replace(recording, metadata={"loop": "open"}))
        assert loop.declared and loop.state == "open" and max(loop.answered.values()) > 0.1
        assert find_loop(made(np.arange(50) * 0.02)).state == "unknown"


class TestFindings:
    def test_constant_and_dead_channels_and_saturation_are_said(self):
        recording = play("multilevel", duration=30.0)
        channels = dict(recording.channels)
        channels["alpha_h"] = np.zeros(len(recording))
        channels["omega_h"] = np.full(len(recording), np.nan)
        channels["u_v"] = np.clip(channels["u_v"] + np.linspace(0, 1e-3, len(recording)), -0.4, 0.4)
        found = summarise(replace(recording, channels=channels))
        words = " | ".join(found.sentences)
        assert "alpha_h is constant at 0 rad" in words
        assert "omega_h: not a single value" in words
        assert "u_v is at its largest, " in words
        assert found.channels["alpha_h"].constant and found.channels["alpha_h"].rest_share == 1

    def test_reversals_and_rest_are_counted(self):
        time = np.arange(0, 40, 0.02)
        alpha = 0.3 * np.sin(2 * np.pi * 0.25 * np.minimum(time, 20))  # ten periods, then rest
        noise = np.random.default_rng(0).normal(0, 2e-4, len(time))
        found = summarise(made(time, alpha=alpha + noise)).channels["alpha_v"]
        assert found.turns == pytest.approx(10, abs=1)
        assert found.rest_share == pytest.approx(0.5, abs=0.05)

    def test_quanta_are_those_of_the_sensors(self):
        found = summarise(play("prbs", duration=30.0)).channels
        assert found["alpha_v"].quantum == pytest.approx(BENCH.quantum["alpha_v"], rel=1e-3)
        assert found["omega_h"].quantum == pytest.approx(0.49, rel=1e-3)


def test_outliers_left_in_are_said_and_everything_else_is_done_on_request():
    recording = play("prbs", duration=20.0)
    (result,) = Preparation().apply(recording)
    assert result.channels is recording.channels and result.time is recording.time
    recording.channels["alpha_v"][500] += 1.0
    (kept,) = Preparation().apply(recording)
    assert any("alpha_v: 1 outlier" in remark for remark in kept.remarks)
    assert np.isfinite(kept.channels["alpha_v"]).all()
    (marked,) = Preparation(outliers="mark").apply(recording)
    assert np.flatnonzero(np.isnan(marked.channels["alpha_v"])).tolist() == [500]
    assert any("made missing" in remark for remark in marked.remarks)
    everything = Preparation(outliers="mark", gaps=0.2, delays={"omega_v": STEP}, resample=0.04)
    (result,) = everything.apply(recording)
    assert result.sample_time == pytest.approx(0.04)
    assert np.abs(result.channels["alpha_v"]).max() < 1.3
    assert np.isfinite(result.channels["alpha_v"]).all()
    for word in ("made missing", "moved", "filled", "resampled"):
        assert any(word in remark for remark in result.remarks), word
