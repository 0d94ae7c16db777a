"""Covariance and identifiability from information made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from trms_cli.identification.greybox.information import (
    COLLINEAR,
    Information,
    correlations,
    identifiability,
)


def information(
    columns: np.ndarray, *, prior: float = 1.0, inflation: float = 1.0, trust: float = 1.0
) -> Information:
    """Of white residuals with these sensitivities (rows, n_f), in two outputs of equal share."""
    fisher = columns.T @ columns / 2
    n = columns.shape[1]
    return Information(
        curvature=np.array([fisher, fisher]),
        score=inflation * np.array([fisher, fisher]),
        trust=np.array([trust, trust]),
        prior=np.full(n, prior),
        scales=np.full(n, 2.0),
        size=np.ones(2),
    )


@pytest.fixture
def columns() -> np.ndarray:
    return np.random.default_rng(0).standard_normal((200, 4))


def test_white_residuals_give_the_inverse_curvature(columns: np.ndarray) -> None:
    wanted = 4.0 * np.linalg.inv(columns.T @ columns + np.eye(4))
    np.testing.assert_allclose(information(columns).covariance(), wanted, rtol=1e-9)


def test_correlated_residuals_widen_what_comes_from_the_data(columns: np.ndarray) -> None:
    """With φ times the variance of the score, and no prior, deviations grow by √φ."""
    white = information(columns, prior=0.0).covariance()
    wide = information(columns, prior=0.0, inflation=9.0).covariance()
    np.testing.assert_allclose(wide, 9 * white, rtol=1e-9)
    known = information(columns, prior=0.0, inflation=9.0).samples_per_sample()
    np.testing.assert_allclose(known, 9.0, rtol=1e-9)


def test_a_prior_is_never_widened(columns: np.ndarray) -> None:
    silent = information(0.0 * columns, inflation=50.0)
    np.testing.assert_allclose(silent.covariance(), 4.0 * np.eye(4))


def test_a_held_parameter_has_no_variance_and_passes_none_on(columns: np.ndarray) -> None:
    held = np.array([False, True, False, False])
    found = information(columns).covariance(held)
    assert not found[1].any() and not found[:, 1].any()
    free = ~held
    wanted = information(columns[:, free]).covariance()
    np.testing.assert_allclose(found[np.ix_(free, free)], wanted)


def judged(columns: np.ndarray) -> object:
    names = [f"p{i}" for i in range(columns.shape[1])]
    known = information(columns)
    return identifiability(known, names, known.covariance())


def test_independent_parameters_are_told_apart(columns: np.ndarray) -> None:
    found = judged(columns)
    assert found.confounded == () and found.silent == ()  # type: ignore[attr-defined]


def test_the_smallest_sets_are_named(columns: np.ndarray) -> None:
    columns[:, 1] = 3 * columns[:, 0] + 0.01 * columns[:, 1]
    found = judged(columns).confounded  # type: ignore[attr-defined]
    assert [c.names for c in found] == [("p0", "p1")]
    assert found[0].index > COLLINEAR


def test_three_that_imitate_each_other_only_together(columns: np.ndarray) -> None:
    columns[:, 2] = columns[:, 0] - columns[:, 1] + 0.01 * columns[:, 2]
    found = judged(columns).confounded  # type: ignore[attr-defined]
    assert [c.names for c in found] == [("p0", "p1", "p2")]


def test_a_parameter_without_effect_is_silent(columns: np.ndarray) -> None:
    columns[:, 3] = 0.0
    found = judged(columns)
    assert found.silent == ("p3",)  # type: ignore[attr-defined]
    assert found.prior_remaining["p3"] == pytest.approx(1.0)  # type: ignore[attr-defined]
    assert found.uninformed == ("p3",)  # type: ignore[attr-defined]


def test_a_parameter_that_the_data_hardly_narrow_is_uninformed(columns: np.ndarray) -> None:
    columns[:, 1] *= 0.01  # 200 samples of 0.01 against a prior of 1: 0.99 of its deviation stay
    found = judged(columns)
    assert found.silent == ()  # type: ignore[attr-defined]
    assert found.uninformed == ("p1",)  # type: ignore[attr-defined]


def test_correlations_are_between_minus_one_and_one(columns: np.ndarray) -> None:
    columns[:, 1] = -2 * columns[:, 0] + 0.001 * columns[:, 1]
    found = correlations(information(columns, prior=0.0).covariance())
    assert np.all(np.abs(found) <= 1 + 1e-12)
    assert found[0, 1] > 0.99  # what one takes the other gives
