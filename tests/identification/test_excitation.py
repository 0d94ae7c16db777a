"""Excitation design: low peaks, unlike inputs, bands of the model, amplitudes that fit."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.excitation.chirp import ChirpExcitation
from trms_cli.identification.excitation.design import (
    ExcitationDesign,
    ExcitationRequest,
    band_of,
    design,
    linearise_model,
)
from trms_cli.identification.excitation.excitation import Plan, crest_factor
from trms_cli.identification.excitation.findings import spectra_of, summary
from trms_cli.identification.excitation.multilevel import MultilevelExcitation
from trms_cli.identification.excitation.multisine import (
    MultisineExcitation,
    low_crest_phases,
    schroeder_phases,
)
from trms_cli.identification.excitation.prbs import PrbsExcitation
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.tras import Tras

MODEL = Newtonian()
PLAN = Plan(6000, 0.02, 0.02, 1.5, 2)
KINDS = {
    "multisine": MultisineExcitation(lines=15, iterations=5),
    "prbs": PrbsExcitation(),
    "multilevel": MultilevelExcitation(),
    "chirp": ChirpExcitation(),
}
every_kind = pytest.mark.parametrize("kind", KINDS)


def sum_of(harmonics: np.ndarray, phases: np.ndarray, points: int = 8192) -> np.ndarray:
    cycles = np.arange(points) / points
    return np.cos(2 * np.pi * np.outer(cycles, harmonics) + phases).sum(axis=1)


class TestShapes:
    @every_kind
    def test_unit_peaks_unlike_inputs_and_power_in_the_band(self, kind):
        values, again = (KINDS[kind].shape(PLAN).values for _ in range(2))
        np.testing.assert_array_equal(values, again)
        assert values.shape == (6000, 2)
        np.testing.assert_allclose(np.abs(values).max(axis=0), 1.0)
        assert abs(np.corrcoef(values.T)[0, 1]) < 0.1
        power = np.abs(np.fft.rfft(values - values.mean(axis=0), axis=0)) ** 2
        frequency = np.fft.rfftfreq(6000, 0.02)
        inside = (frequency >= 0.9 * PLAN.lowest) & (frequency <= 1.1 * PLAN.highest)
        # Levels that are drawn have some power below any band.
        share = 0.5 if kind == "multilevel" else 0.7
        assert np.all(power[inside].sum(axis=0) > share * power.sum(axis=0))
        assert KINDS[kind].shape(Plan(6000, 0.02, 0.02, 1.5, 1)).values.shape == (6000, 1)

    @every_kind
    @pytest.mark.parametrize(
        "plan", [Plan(6000, 0.02, 0.02, 24.0, 2), Plan(6000, 0.02, 0.001, 1.0, 2),
                 Plan(6000, 0.02, 1.0, 0.5, 2)]
    )  # fmt: skip
    def test_bands_that_cannot_be_played_are_refused(self, kind, plan):
        with pytest.raises(ConfigurationError) as error:
            KINDS[kind].shape(plan)
        assert error.value.remedy


class TestMultisine:
    def test_the_inputs_share_no_frequency_and_are_orthogonal(self):
        shape = KINDS["multisine"].shape(PLAN)
        first, second = shape.about["frequencies_hz"]
        assert not set(first) & set(second)
        assert abs(shape.values[:, 0] @ shape.values[:, 1]) < 1e-9 * 6000

    def test_periods_repeat_and_too_few_harmonics_are_refused(self):
        values = MultisineExcitation(periods=3, iterations=0).shape(PLAN).values
        np.testing.assert_allclose(values[:2000], values[2000:4000], atol=1e-9)
        with pytest.raises(ConfigurationError, match="harmonics"):
            MultisineExcitation(periods=60).shape(PLAN)

    def test_31_flat_harmonics_come_near_the_published_crest_factor(self):
        """Guillaume et al. 1991 report 1.405 for 31 harmonics of equal amplitude."""
        harmonics = np.arange(1, 32)
        start = schroeder_phases(31)
        found = low_crest_phases(harmonics, start, 200)
        assert crest_factor(sum_of(harmonics, start)) > 1.7
        assert crest_factor(sum_of(harmonics, found)) < 1.42

    @pytest.mark.parametrize("seed", range(3))
    def test_the_search_never_makes_it_worse_and_keeps_the_amplitudes(self, seed):
        generator = np.random.default_rng(seed)
        harmonics = np.sort(generator.choice(np.arange(1, 150), 25, replace=False))
        start = generator.uniform(0, 2 * np.pi, 25)
        found = low_crest_phases(harmonics, start, 30)
        before, after = (crest_factor(sum_of(harmonics, p)) for p in (start, found))
        assert after < before
        lines = np.abs(np.fft.rfft(sum_of(harmonics, found)))[harmonics] * 2 / 8192
        np.testing.assert_allclose(lines, 1.0, atol=1e-9)


def test_the_band_spans_the_models_poles_within_what_can_be_played():
    system = linearise_model(MODEL, MODEL.rest(), np.zeros(2))
    # Eigenvalues at rest as published for this form: 0.208 ± 0.509j … 0.047 ± 2.028j.
    lowest, highest = band_of(system, 0.02, 300.0)
    assert highest == pytest.approx(5 * 2.03 / (2 * np.pi), rel=0.03)
    assert 0.2 * 0.2 / (2 * np.pi) < lowest < 0.2 * 0.55 / (2 * np.pi)
    assert band_of(system, 0.5, 20.0) == (1 / 20.0, 0.8)
    steady = system.response(np.array([1e-9]))[0]
    direct = -system.c @ np.linalg.solve(system.a, system.b) + system.d
    np.testing.assert_allclose(steady.real, direct, rtol=1e-6, atol=1e-9)


QUICK = ExcitationRequest(duration=30.0, lead_in=10.0, rigs=0)
LONG = ExcitationRequest(duration=40.0, rigs=0)
#: Of the sensors.
NOISE = {"alpha_v": 4e-4, "alpha_h": 4e-4, "omega_v": 1.6, "omega_h": 1.6}


@lru_cache
def quick(kind: str) -> ExcitationDesign:
    """The quick design of a kind, made once."""
    return design(Newtonian(), KINDS[kind], QUICK)


class TestDesign:
    @every_kind
    def test_the_simulated_rig_stays_within_bounds_and_limits(self, kind):
        model, found = Newtonian(), quick(kind)
        for name, limit in found.bounds.items():
            low, high = found.ranges[name]
            assert max(-low, high) <= limit
        assert np.all(np.abs(found.commands) <= 0.8 * model.input_bounds()[1] + 1e-9)
        # As large as possible: either a bound or a limit is nearly met.
        use = [max(map(abs, found.ranges[n])) / b for n, b in found.bounds.items()]
        reach = np.abs(found.commands).max(axis=0) / (0.8 * model.input_bounds()[1])
        assert max(*use, *reach) > 0.9

    def test_smaller_bounds_give_smaller_amplitudes_and_given_ones_stand(self):
        request = replace(QUICK, bounds={"alpha_v": 0.7, "alpha_h": 0.5})
        narrow = design(MODEL, KINDS["prbs"], request)
        assert np.all(narrow.amplitude < quick("prbs").amplitude)
        assert max(map(abs, narrow.ranges["alpha_h"])) <= 0.5
        request = replace(LONG, lead_in=10.0, amplitude={"u_v": 0.1, "u_h": 0.3})
        assert design(MODEL, KINDS["prbs"], request).amplitude.tolist() == [0.1, 0.3]

    def test_reversals_turn_both_rotors_round(self):
        request = replace(LONG, lead_in=0.0, reversals=True)
        found = design(Newtonian(), KINDS["multilevel"], request)
        for name in ("omega_v", "omega_h"):
            low, high = found.ranges[name]
            assert low < -20 and high > 20

    def test_the_same_request_gives_the_same_design(self):
        first, again = quick("multilevel"), design(Newtonian(), KINDS["multilevel"], QUICK)
        np.testing.assert_array_equal(first.commands, again.commands)

    @pytest.mark.parametrize(
        "asked",
        [
            {"bounds": {"alpha_v": 0.1}},
            {"bounds": {"alpha_v": 0.5}, "lead_in": 0.0},
            {"bounds": {"alpha": 0.1}},
            {"operating_point": {"alpha": 0.0}},
            {"operating_point": {"alpha_v": 0.0}, "reversals": True},
            {"share": 0.2},
        ],
        ids=str,
    )
    def test_what_does_not_fit_is_refused_with_what_would(self, asked):
        with pytest.raises(ConfigurationError) as error:
            design(Newtonian(), KINDS["prbs"], replace(LONG, **asked))
        assert error.value.where and error.value.remedy

    def test_an_axis_that_drifts_has_an_answer(self):
        with pytest.raises(ConfigurationError, match="no amplitude") as error:
            design(Tras(), KINDS["chirp"], replace(LONG, duration=300.0))
        assert "under control" in error.value.remedy

    def test_rigs_drawn_from_the_priors_have_wider_ranges(self):
        request = replace(LONG, lead_in=10.0, rigs=3)
        found = design(Newtonian(), KINDS["multisine"], request)
        assert found.rig_count == 3 and 0 <= found.lost_rig_count <= 3
        low, high = found.drawn_ranges["omega_h"]
        assert high - low > 0.9 * np.ptp(found.ranges["omega_h"])


def test_signal_over_noise_is_that_of_the_definition_and_tells_how_far_outputs_are_seen():
    found = quick("multisine")
    spectra = spectra_of(found, NOISE)
    assert spectra.noise[2] == pytest.approx(2 * 1.6**2 * 0.02)
    # Parseval: the density, times the width of what each band holds, adds up to the variance;
    # the periods of this signal are whole, so that hardly any of it lies beyond the bands.
    signal = found.outputs[found.first :, 3]
    step = 1 / (0.02 * len(signal))
    frequency = step * np.arange(1, len(signal) // 2 + 1)
    half = 2 ** (1 / 6)
    held = [
        np.sum((frequency >= middle / half) & (frequency < middle * half))
        for middle in spectra.frequencies
    ]
    variance = np.sum(spectra.outputs[:, 3] * held) * step
    assert variance == pytest.approx(np.var(signal), rel=0.005)
    seen = summary(found, spectra)["predicted"]["omega_h"]["seen_up_to_hz"]
    assert seen is not None and seen <= found.plan.highest
    deaf = {name: 1e6 * sd for name, sd in NOISE.items()}
    blind = summary(found, spectra_of(found, deaf))
    assert blind["predicted"]["omega_h"]["seen_up_to_hz"] is None
