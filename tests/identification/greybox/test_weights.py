"""The robust cost, and the parabola that least squares puts in its place."""

from __future__ import annotations

import numpy as np
import pytest

from trms_cli.identification.greybox.objective import ResidualWeights, sizes


def weights(robust: float | None) -> ResidualWeights:
    return ResidualWeights(np.full((2, 3), 0.5), np.array([1.0, 2.0, 8.0]), 0.5, robust)


@pytest.mark.parametrize("robust", [None, 1.5])
def test_parabola_touches_the_cost_and_lies_above(robust: float | None) -> None:
    generator = np.random.default_rng(0)
    at = generator.standard_normal((2, 30, 3)) * 2
    own = weights(robust)
    roots = own.roots(at)

    def parabola(r: np.ndarray) -> float:
        return 0.5 * float(np.sum((roots * r) ** 2) - np.sum((roots * at) ** 2))

    for _ in range(30):
        other = at + generator.standard_normal(at.shape)
        assert own.cost(other) - own.cost(at) <= parabola(other) + 1e-9
    step = 1e-6 * generator.standard_normal(at.shape)
    slope = (own.cost(at + step) - own.cost(at - step)) / 2
    assert slope == pytest.approx((parabola(at + step) - parabola(at - step)) / 2, rel=1e-4)


def test_an_outlier_counts_linearly() -> None:
    r = np.zeros((2, 30, 3))
    costs = []
    for size in (10.0, 20.0, 30.0):
        r[0, 0, 0] = size
        costs.append(weights(3.0).cost(r))
    assert costs[2] - costs[1] == pytest.approx(costs[1] - costs[0])


def test_sizes_do_not_follow_single_outliers() -> None:
    generator = np.random.default_rng(0)
    r = generator.standard_normal((4, 500, 2)) * [1.0, 3.0]
    measured = np.ones(r.shape, dtype=bool)
    r[0, :5, 0] = 1e4
    found = sizes(r, measured, np.ones((4, 2)))
    np.testing.assert_allclose(found, [1.0, 3.0], rtol=0.1)
