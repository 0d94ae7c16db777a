"""Multiple shooting on simulated rigs: recovers, settles, stops, repeats, says what it knows."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.identification.greybox.rigs import recording
from tests.identification.watched import Watched
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.multiple_shooting import MultipleShooting
from trms_cli.identification.problem import (
    FitOutcome,
    FitProblem,
    FitResult,
    SilentProgress,
    free_parameters,
)
from trms_cli.models.driven_model import DrivenModel
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian

RANGES = [(0.4, 1.5)]
FREE = ("k_fvp", "k_ov", "J_mr", "k_uv", "l_cb")
HIDDEN = {"k_fvp": 1.70e-5, "k_ov": 0.0045, "J_mr": 1.60e-4, "k_uv": 8.8, "l_cb": 0.28}


def vertical(**values: float) -> Model:
    return Newtonian(freedom="vertical", parameters=values)


@pytest.fixture(scope="module")
def measured() -> Dataset:
    return recording(vertical(**HIDDEN), ranges=RANGES, seconds=40.0)[0]


def problem(model: Model, *datasets: Dataset, free: Any = FREE, **settings: Any) -> FitProblem:
    chosen = free_parameters(model.parameters, free, bounds=settings.pop("bounds", None))
    return FitProblem(model=model, datasets=datasets, free=chosen, jobs=1, **settings)


def fit(asked: FitProblem, **settings: Any) -> FitResult:
    return MultipleShooting(**({"starts": 1} | settings)).fit(asked, SilentProgress())


def errors(result: FitResult, truth: Mapping[str, float]) -> np.ndarray:
    """In reported standard deviations."""
    assert result.covariance is not None
    sd = np.sqrt(np.diag(result.covariance))
    return (result.theta - np.array([truth[name] for name in result.values])) / sd


@pytest.fixture(scope="module")
def fitted(measured: Dataset) -> FitResult:
    return fit(problem(vertical(), measured))


def test_recovers_hidden_parameters_within_their_intervals_and_again(
    measured: Dataset, fitted: FitResult
) -> None:
    assert fitted.outcome is FitOutcome.CONVERGED
    assert np.all(np.abs(errors(fitted, HIDDEN)) < 4)
    assert fitted.values["k_fvp"] == pytest.approx(HIDDEN["k_fvp"], rel=0.01)
    assert fitted.values["k_ov"] == pytest.approx(HIDDEN["k_ov"], rel=0.01)
    assert fit(problem(vertical(), measured)).values == fitted.values


@pytest.mark.parametrize("continuity", ["penalty", "equality"])
def test_joined_windows_recover_as_well(
    measured: Dataset, fitted: FitResult, continuity: str
) -> None:
    joined = fit(problem(vertical(), measured), continuity=continuity)
    assert np.all(np.abs(errors(joined, HIDDEN)) < 4)
    assert joined.covariance is not None and fitted.covariance is not None
    # The ends of the windows say something of the parameters too.
    if continuity == "equality":
        assert np.all(np.diag(joined.covariance) < 1.2 * np.diag(fitted.covariance))


def test_closed_loop_data_serve_as_well() -> None:
    # Against the angle the loop would be unstable: the rotor lags by a second.
    closed, _ = recording(vertical(**HIDDEN), ranges=RANGES, seconds=40.0, feedback=-0.3)
    result = fit(problem(vertical(), closed))
    assert np.all(np.abs(errors(result, HIDDEN)) < 4)
    assert result.values["k_ov"] == pytest.approx(HIDDEN["k_ov"], rel=0.02)


def test_samples_may_be_missing_and_wrong(measured: Dataset) -> None:
    generator = np.random.default_rng(0)
    y = measured.measurements.copy()
    y[generator.random(len(y)) < 0.2] = np.nan
    y[generator.random(len(y)) < 0.01, 0] += 0.5  # outliers of half a radian
    result = fit(problem(vertical(), replace(measured, measurements=y)))
    assert result.values["k_fvp"] == pytest.approx(HIDDEN["k_fvp"], rel=0.01)
    plain = fit(problem(vertical(), replace(measured, measurements=y), robust=None))
    k_ov = [r.values["k_ov"] - HIDDEN["k_ov"] for r in (result, plain)]
    assert abs(k_ov[0]) < abs(k_ov[1])


def test_several_recordings_of_one_rig_narrow_the_intervals(
    measured: Dataset, fitted: FitResult
) -> None:
    other, _ = recording(vertical(**HIDDEN), ranges=RANGES, seconds=40.0, seed=7)
    both = fit(problem(vertical(), measured, other))
    assert both.covariance is not None and fitted.covariance is not None
    assert np.diag(both.covariance)[1] < np.diag(fitted.covariance)[1]
    assert np.all(np.abs(errors(both, HIDDEN)) < 4)


@pytest.mark.parametrize("length", [4.0, 10.0])
def test_overlapping_windows_do_not_narrow_the_intervals(measured: Dataset, length: float) -> None:
    """They hold the same samples again, and these say no more the second time."""

    def deviations(stride: float | None) -> np.ndarray:
        asked = problem(vertical(), measured, window_length=length, window_stride=stride)
        covariance = fit(asked).covariance
        assert covariance is not None
        found: np.ndarray = np.sqrt(np.diag(covariance))
        return found

    ratios = np.array([deviations(length / k) for k in (2, 8)]) / deviations(None)
    # They need not be alike: windows have starts of their own, and other ones see other things.
    assert np.all((ratios > 0.75) & (ratios < 1.33))


def test_a_parameter_may_end_on_its_bound_and_says_so(measured: Dataset) -> None:
    asked = problem(vertical(), measured, bounds={"k_ov": (0.005, 0.02)})
    result = fit(asked)
    assert result.values["k_ov"] == pytest.approx(0.005)
    assert result.details["on_bounds"] == ["k_ov"]


def test_a_prior_decides_where_the_data_are_silent(measured: Dataset) -> None:
    result = fit(problem(vertical(), measured, free=("k_fvp", "k_fvn")))
    assert result.values["k_fvn"] == Newtonian().parameters["k_fvn"].value
    judged = result.details["identifiability"]
    assert judged["silent"] == ("k_fvn",)
    assert judged["prior_remaining"]["k_fvn"] == pytest.approx(1.0)
    assert judged["prior_remaining"]["k_fvp"] < 0.5


def test_parameters_that_act_as_one_are_named(measured: Dataset) -> None:
    """R and kφ act through k_uv/R, kφ/R and kφ²/R alone."""
    result = fit(problem(vertical(), measured, free=("R", "kphi", "k_uv", "B_mr")))
    worst = result.details["identifiability"]["confounded"][0]
    assert {"R", "k_uv"} <= set(worst["names"])


def test_dry_friction_is_found() -> None:
    def rubbing(torque: float) -> Model:
        friction = CoulombFriction(axis="pitch", torque=torque)
        return extend_model(vertical(), {"pitch_coulomb_friction": friction})

    measured, _ = recording(rubbing(0.004), ranges=RANGES, seconds=40.0)
    asked = problem(rubbing(0.0005), measured, free=("k_ov", "k_fvp", "*.torque"))
    result = fit(asked, starts=2)
    assert result.values["pitch_coulomb_friction.torque"] == pytest.approx(0.004, rel=0.03)
    assert result.values["k_ov"] == pytest.approx(0.006, rel=0.1)
    assert len(result.details["starts"]) == 2


def test_a_model_driven_by_measured_rotors_is_fitted(measured: Dataset) -> None:
    driven = ("omega_v",)
    model = DrivenModel(vertical(), driven)
    result = fit(problem(model, measured.driven_by(driven), free=("k_fvp", "k_ov", "l_cb")))
    # The tacho's noise is in the input now, and blurs what the intervals know nothing of.
    assert result.values["k_fvp"] == pytest.approx(HIDDEN["k_fvp"], rel=0.03)
    assert result.values["k_ov"] == pytest.approx(HIDDEN["k_ov"], rel=0.05)


def test_the_profile_of_a_near_parabola_has_its_width(measured: Dataset) -> None:
    result = fit(problem(vertical(), measured), profiles=("k_ov",))
    found = result.details["profiles"]["k_ov"]
    assert result.covariance is not None
    i = list(result.values).index("k_ov")
    sd = np.sqrt(result.covariance[i, i])
    low, high = found["interval_95"]
    assert (high - low) / 2 == pytest.approx(1.96 * sd, rel=0.1)
    assert min(found["rise"]) == pytest.approx(0.0, abs=0.05)


def test_an_interrupted_fit_keeps_the_best_so_far_and_goes_on_from_there(
    measured: Dataset, fitted: FitResult
) -> None:
    first = Watched(6)
    result = MultipleShooting(starts=1).fit(problem(vertical(), measured), first)
    assert result.outcome is FitOutcome.INTERRUPTED
    assert np.isfinite(result.theta).all()
    assert len(first.fractions) == 6
    assert all(0 <= fraction <= 1 for fraction in first.fractions)
    second = Watched(kept=first.kept)
    result = MultipleShooting(starts=1).fit(problem(vertical(), measured), second)
    assert result.outcome is FitOutcome.CONVERGED
    np.testing.assert_allclose(result.theta, fitted.theta, rtol=1e-4)
    assert len(second.fractions) < len(fitted.history) + len(first.fractions)


def test_a_profile_of_what_is_not_free_and_unlike_sample_times_are_refused(measured: Dataset):
    with pytest.raises(ConfigurationError, match="k_g"):
        fit(problem(vertical(), measured), profiles=("k_g",))
    other = replace(measured, sample_time=0.01)
    with pytest.raises(ConfigurationError, match="sample times"):
        fit(problem(vertical(), measured, other))


def test_a_model_that_diverges_is_told(measured: Dataset) -> None:
    y = replace(measured, commands=np.full_like(measured.commands, 1e200))
    result = fit(problem(vertical(), y))
    assert result.outcome is FitOutcome.FAILED
    assert result.covariance is None
