"""Which parameters moved: against all subsets counted out, and the words for a change."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from trms_cli.gap import moved_parameters as moved
from trms_cli.gap.competing_model import nominal_parameters
from trms_cli.gap.moved_parameters import change_in_words, gravity_in_words, sampled_moves
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.quanser_aero import QuanserAero

MODEL = Newtonian()


def posterior(slopes: np.ndarray, truth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of standard normal parameters, seen through slopes with unit noise."""
    y = slopes @ truth + np.random.default_rng(seed).standard_normal(len(slopes))
    covariance = np.linalg.inv(slopes.T @ slopes + np.eye(len(truth)))
    return covariance @ slopes.T @ y, covariance


def counted(z: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """The probabilities by their definition, over all subsets."""
    precision = np.linalg.inv(covariance)
    towards, likelihood = precision @ z, precision - np.eye(len(z))
    total, inclusion_weights = 0.0, np.zeros(len(z))
    for subset in product([False, True], repeat=len(z)):
        variances = np.where(subset, moved._MOVED, moved._STAYED) ** 2.0
        inner = likelihood + np.diag(1 / variances)
        weight = 0.5 * (towards @ np.linalg.solve(inner, towards) - np.linalg.slogdet(inner)[1])
        weight -= 0.5 * np.log(variances).sum()
        weight += np.log(np.where(subset, moved._BEFORE, 1 - moved._BEFORE)).sum()
        inclusion_weights += np.exp(weight) * np.array(subset)
        total += np.exp(weight)
    return inclusion_weights / total


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_sampler_finds_what_counting_finds(seed) -> None:
    slopes = 1.5 * np.random.default_rng(seed).standard_normal((8, 4))
    slopes[:, 3] = slopes[:, 2] + 0.1 * slopes[:, 3]  # two that are hard to tell apart
    z, covariance = posterior(slopes, np.array([0.1, 2.0, 1.2, 0.0]), seed)
    moves = sampled_moves(z, covariance, np.ones(4, dtype=bool))
    assert moves.probability == pytest.approx(counted(z, covariance), abs=0.06)


def test_the_one_that_moved_is_found_with_its_size_and_what_was_not_seen_says_nothing() -> None:
    slopes = 6.0 * np.random.default_rng(5).standard_normal((40, 6))
    slopes[:, 5] = 0.0
    z, covariance = posterior(slopes, np.array([0.0, 0.1, -3.0, 0.1, 0.0, 0.0]), 1)
    moves = sampled_moves(z, covariance, np.ones(6, dtype=bool))
    assert moves.probability[2] > 0.99
    assert np.all(np.delete(moves.probability, 2) < 0.15)
    assert moves.mean[2] == pytest.approx(-3.0, abs=4 * moves.sd[2])
    assert moves.probability[5] == pytest.approx(moved._BEFORE, abs=1e-6)


def test_a_parameter_that_the_parabola_takes_beyond_its_bound_is_at_it() -> None:
    """A viscous friction below zero is none, and ends no diagnosis."""
    free = tuple(p for p in nominal_parameters(MODEL) if p.name in ("B_mr", "k_tvp"))
    scales = np.array([p.scale for p in free])
    covariance = np.diag((0.9 * scales) ** 2)  # little is known but by the priors
    theta = np.array([0.3 * p.prior_mean for p in free])
    fit = SimpleNamespace(theta=theta, evidence=SimpleNamespace(covariance=covariance))
    refit = SimpleNamespace(fit=fit, structure=SimpleNamespace(problem=SimpleNamespace(free=free)))
    moves = {m.parameter: m for m in moved.moved_parameters(refit, MODEL, 0.0)}  # type: ignore[arg-type]
    assert moves["B_mr"].change == -MODEL.parameters["B_mr"].value


def test_a_change_in_words() -> None:
    damping = MODEL.parameters["k_oh"]
    assert change_in_words(MODEL, damping, -0.4 * damping.value, 0.0) == (
        "viscous friction of yaw −40 % (0.0185 → 0.0111 N m s)"
    )
    # What is zero has no share to change by.
    aero = QuanserAero()
    friction = aero.parameters["F_1"]
    assert change_in_words(aero, friction, 0.002, 0.0) == "dry friction of pitch 0 → 0.002 N m"


@pytest.mark.parametrize("pitch", [-0.4, 0.0, 0.3])
def test_a_mass_at_the_nose_is_told_as_itself(pitch) -> None:
    shield = MODEL.parameters["m_ms"].value
    heavier = gravity_in_words(MODEL, {"m_ms": shield + 0.014}, pitch)
    assert heavier.startswith("gravity moment of the beam ")
    assert heavier.endswith("%, as 14 g at the nose would")
    assert gravity_in_words(MODEL, {"m_ms": shield - 0.014}, pitch).endswith(
        "%, as 14 g less at the nose would"
    )
    # What leaves gravity alone says nothing of it, nor does a model that turns on the level.
    assert gravity_in_words(MODEL, {"k_ov": 0.01}, pitch) == ""
    assert gravity_in_words(Newtonian(freedom="horizontal"), {"k_oh": 0.01}, pitch) == ""
