"""Models held against recordings whose truth is known."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from tests.identification.greybox.rigs import SAMPLE, dataset_of, measuring
from tests.identification.validation.known_rig import QUANTUM, model, recording
from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.free_runs import measured_states
from trms_cli.identification.validation.document import document_of
from trms_cli.identification.validation.findings import (
    lead_of,
    quantity_words,
    remarks_on,
    remarks_on_comparison,
)
from trms_cli.identification.validation.validate import (
    ModelValidation,
    TestOptions,
    ValidationOptions,
    WindowOptions,
    calibrate_tests,
    matched_tail,
    validate_all,
)
from trms_cli.models.driven_model import DrivenModel
from trms_cli.models.model import Model, names
from trms_cli.models.narx_file import Narx
from trms_cli.models.network import NarxStructure, Network

OPTIONS = ValidationOptions()


def validated(
    candidate: Model, *datasets: Dataset, options: ValidationOptions = OPTIONS
) -> ModelValidation:
    return validate_all({"m": candidate}, {"m": list(datasets)}, options)[0]


def document(candidate: Model, *datasets: Dataset, **options: ValidationOptions) -> dict:
    return document_of([validated(candidate, *datasets, **options)])


@pytest.fixture(scope="module")
def rig() -> Model:
    return model()


@pytest.fixture(scope="module")
def data(rig) -> Dataset:
    return recording(rig)


@pytest.fixture(scope="module")
def right(rig, data) -> ModelValidation:
    return validated(rig, data)


@pytest.fixture(scope="module")
def wrong(data) -> ModelValidation:
    return validated(model(k_fvp=1.05), data)


class TestErrors:
    def test_the_right_model_errs_by_the_noise_at_every_horizon(self, right):
        figures = json.loads(json.dumps(document_of([right]), allow_nan=False))
        for channel, horizons in figures["error"].items():
            assert set(horizons) == {"0.1", "0.5", "2.0", "10.0"}
            for value in horizons.values():
                assert value == pytest.approx(right.noise_sd(channel), rel=0.1)

    def test_a_wrong_thrust_shows_in_pitch_and_grows(self, right, wrong):
        error = document_of([wrong])["error"]["alpha_v"]
        assert error["0.1"] < error["0.5"] < error["2.0"]
        assert error["2.0"] > 20 * right.noise_sd("alpha_v")
        assert document_of([wrong])["error"]["omega_v"]["2.0"] == pytest.approx(
            document_of([right])["error"]["omega_v"]["2.0"], rel=0.02
        )

    def test_no_window_sees_itself(self, rig, data, right):
        """What comes after a window's start does not move the window's start."""
        first = right.runs[0].windows[0.5]
        later = data.measurements.copy()
        cut = int(first.first[10])
        later[cut:] += 1.0
        factors = ValidationOptions(predictor=replace(OPTIONS.predictor, process_noise="nominal"))
        a = validated(rig, data, options=factors).runs[0].windows[0.5]
        b = validated(rig, replace(data, measurements=later), options=factors).runs[0].windows[0.5]
        upto = np.flatnonzero(a.first <= cut)
        simulated = [(x.measured - x.errors)[upto] for x in (a, b)]
        assert simulated[0] == pytest.approx(simulated[1], abs=1e-9)

    @pytest.mark.parametrize("start", ["moving_horizon", "fitted"])
    def test_other_starts(self, rig, data, right, start):
        options = ValidationOptions(windows=WindowOptions(start=start, stride=2.0))
        found = document(rig, data.part(0, 800), options=options)
        for channel, horizons in found["error"].items():
            noise = right.noise_sd(channel)
            assert horizons["2.0"] == pytest.approx(noise, rel=0.15)
            if start == "fitted" and channel.startswith("alpha"):  # two states, five samples
                assert horizons["0.1"] < noise

    def test_missing_samples_cost_nothing_but_themselves(self, rig, data, right):
        lost = data.measurements.copy()
        rng = np.random.default_rng(0)
        lost[rng.random(lost.shape) < 0.2] = np.nan
        lost[700:760] = np.nan
        found = document(rig, replace(data, measurements=lost))
        for channel, horizons in found["error"].items():
            assert horizons["2.0"] == pytest.approx(right.noise_sd(channel), rel=0.15)
        assert found["recordings"][0]["missing"]["alpha_v"] > 400

    def test_a_channel_that_was_not_measured_is_left_out(self, rig, data):
        found = document(rig, measuring(data, 2))
        assert list(found["error"]) == ["alpha_v", "alpha_h"]
        assert found["error"]["alpha_v"]["2.0"] < 2e-3

    def test_a_channel_that_never_moves_is_not_tested(self, rig, data):
        still = data.measurements.copy()
        still[:, 1] = 0.1
        found = document(rig, replace(data, measurements=still).part(0, 600))
        assert {t["channel"] for t in found["residual_tests"]["tests"]} == {
            "alpha_v", "omega_v", "omega_h",
        }  # fmt: skip
        assert found["fit_percent"]["alpha_h"] is None

    def test_driven_by_measured_rotors(self, rig, data):
        driven = ("omega_v", "omega_h")
        found = document(DrivenModel(rig, driven), data.driven_by(driven))
        assert list(found["error"]) == ["alpha_v", "alpha_h"]
        assert found["fit_percent"]["alpha_v"] > 90

    def test_several_recordings_are_pooled(self, rig, data, right):
        other = replace(recording(rig, 20.0, seed=5), name="second")
        both = validated(rig, data, other)
        found = document_of([both])
        alone = document_of([right])
        assert found["windows"]["2.0"] > alone["windows"]["2.0"]
        assert set(found["error_by_recording"]) == {"rig", "second"}
        assert found["error_by_recording"]["rig"] == alone["error"]

    def test_sample_times_must_agree(self, rig, data):
        other = replace(data, sample_time=0.04)
        with pytest.raises(ConfigurationError, match="sample time"):
            validated(rig, data, other)


class TestResidualTests:
    def test_a_right_model_passes_and_a_wrong_one_fails_where_it_is_wrong(self, right, wrong):
        """In spite of quantised angles; the rate over many is held in test_residual_tests.py."""
        assert document_of([right])["residual_tests"]["failed"] == 0
        assert wrong.tests.failures()[0].channel in ("alpha_v", "alpha_h")
        assert "input_u_v" in {t.name for t in wrong.tests.of("alpha_v") if t.failed()}

    def test_p_values_from_simulation_agree_with_the_limit_where_that_holds(self, rig, data):
        options = ValidationOptions(tests=TestOptions(simulations=12, calibration="simulated"))
        found = calibrate_tests(validated(rig, data.part(0, 1000), options=options), QUANTUM)
        assert not found.failures()
        assert len(found.tests) == 64

    @pytest.mark.slow
    def test_simulated_p_values_hold_their_level_on_quantised_recordings(self, rig):
        options = ValidationOptions(tests=TestOptions(simulations=50, calibration="simulated"))
        alarms = 0
        for seed in range(20):
            made = recording(rig, seed=100 + seed)
            found = calibrate_tests(validated(rig, made, options=options), QUANTUM)
            alarms += bool(found.failures())
        assert alarms <= 4  # of a binomial of 20 and 0.05, more has a probability of 0.003

    def test_a_matched_tail_is_the_chi_square_of_many_simulations(self):
        from scipy.stats import chi2

        simulated = chi2(7).rvs(4000, random_state=0) * 1.7
        for statistic in (5.0, 15.0, 25.0):
            exact = chi2(7).sf(statistic / 1.7)
            assert matched_tail(statistic, simulated, 7) == pytest.approx(exact, rel=0.15)

    def test_a_model_that_runs_away_cannot_be_simulated_along(self, data):
        small = replace(data, measurements=1e-3 * data.measurements, noise_sd=1e-3 * data.noise_sd)
        assert calibrate_tests(validated(model(), small), QUANTUM) is None


class TestWords:
    def test_say_what_is_good_and_what_is_not(self, right, wrong):
        figures = document_of([right])
        assert "down to the sensor's noise" in lead_of(figures)[0]
        assert {remark.judgement for remark in remarks_on(figures)} == {"good"}
        figures = document_of([wrong])
        text = " ".join(remark.value for remark in remarks_on(figures))
        assert "main command" in text
        assert "residual tests find something" in lead_of(figures)[1]

    def test_compare(self, right, wrong):
        figures = document_of([replace(right, name="right"), replace(wrong, name="wrong")])
        assert figures["ranking"][0]["model"] == "right"
        assert figures["comparison"][0]["differ"]
        assert lead_of(figures)[0].startswith("right foretells best")
        assert "more than chance" in remarks_on_comparison(figures)[0].value
        assert set(figures["models"]) == {"right", "wrong"}
        # A model against itself is alike.
        figures = document_of([replace(right, name="a"), replace(right, name="b")])
        assert not figures["comparison"][0]["differ"]
        assert figures["comparison"][0]["ratio"] == 1.0

    def test_figures_with_units(self):
        assert quantity_words(0.0123, "rad") == "12.3 mrad"
        assert quantity_words(1.5, "rad") == "1.5 rad"
        assert quantity_words(1.6, "rad/s") == "1.6 rad/s"
        assert quantity_words(1.6, "1/s") == "1.6 1/s"
        assert quantity_words(0.25, "1") == "0.25"
        assert quantity_words(None, "rad") == "–"


class TestBlackBox:
    @pytest.fixture
    def linear(self) -> Model:
        """y(k+1) = a y(k) + b y(k−1) + c u(k) + d u(k−1): a linear NARX model of one axis."""
        structure = NarxStructure(
            ("alpha_v",), ("u_v",), ("rad",), ("V",), (1, 2), (1, 2), SAMPLE, False, False
        )
        weights = {"W1": np.array([[1.7, -0.72, 0.01, 0.01]]), "b1": np.zeros(1)}
        network = Network("mlp", weights, np.zeros(4), np.ones(4), np.zeros(1), np.ones(1))
        return Narx(structure, network)

    @pytest.fixture
    def made(self, linear) -> Dataset:
        rng = np.random.default_rng(0)
        u = np.repeat(rng.uniform(-1, 1, 150), 10)
        driven = lfilter([0, 0.01, 0.01], [1], u) + 0.001 * rng.standard_normal(1500)
        y = lfilter([1], [1, -1.7, 0.72], driven)
        return dataset_of(linear, u[:, None], y[:, None], np.array([0.001]))

    def test_its_state_is_the_measured_past(self, linear, made):
        states = measured_states(linear, made)
        y, u = made.measurements[:, 0], made.commands[:, 0]
        assert np.array_equal(states[5], [y[5], y[4], u[4]])
        assert np.isnan(states[0]).any()
        assert measured_states(model(), made) is None

    def test_a_network_of_the_library(self):
        """Trained on the rig of one axis: near the noise, by one step from measured values."""
        beam = model("newtonian_vertical")
        network = model("narx_vertical")
        found = document(network, recording(beam, 20.0))
        assert "measured values" in found["predictor"]
        row = found["by_horizon"]["alpha_v"]["0.5"]
        assert row["rms"] == found["error"]["alpha_v"]["0.5"] < 0.2 * row["unchanged_rms"]

    def test_its_one_step_errors_are_the_noise_that_drove_it(self, linear, made):
        found = validated(linear, made)
        figures = document_of([found])
        assert figures["one_step"]["alpha_v"]["rms"] == pytest.approx(0.001, rel=0.06)
        assert figures["residual_tests"]["failed"] == 0
        assert "measured values" in figures["predictor"]
        assert names(found.channels) == ("alpha_v",)
