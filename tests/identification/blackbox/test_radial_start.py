"""Placing radial units: selection, grids, clusters."""

from __future__ import annotations

import numpy as np
import pytest

from trms_cli.identification.blackbox.radial_fit import (
    Radial,
    clustered,
    dyadic,
    selected,
    with_linear_weights,
)


@pytest.fixture
def generator() -> np.random.Generator:
    return np.random.default_rng(0)


def test_orthogonal_least_squares_finds_the_columns_that_made_the_targets(generator):
    candidates = generator.standard_normal((200, 30))
    fixed = np.ones((200, 1))
    targets = candidates[:, [4, 17]] @ np.array([[3.0, 0.1], [0.5, 2.0]]) + 5.0
    assert set(selected(candidates, targets, fixed, 2)) == {4, 17}


def test_each_choice_is_the_one_that_leaves_the_least(generator):
    """The error reduction ratio against a least-squares fit with every candidate in turn."""
    candidates, targets = generator.standard_normal((60, 8)), generator.standard_normal((60, 2))
    fixed = generator.standard_normal((60, 2))

    def left(columns: list[int]) -> float:
        basis = np.hstack([fixed, candidates[:, columns]])
        return float(((targets - basis @ np.linalg.lstsq(basis, targets)[0]) ** 2).sum())

    chosen = selected(candidates, targets, fixed, 4)
    for count in range(4):
        rest = [c for c in range(8) if c not in chosen[:count]]
        assert chosen[count] == min(rest, key=lambda c: left([*chosen[:count], c]))


def test_a_column_that_says_nothing_new_is_not_chosen(generator):
    one = generator.standard_normal((50, 1))
    candidates = np.hstack([one, 2.0 * one])
    assert len(selected(candidates, one, np.ones((50, 1)), 2)) == 1


def test_dyadic_grids_halve_their_spacing_and_stay_where_data_are(generator):
    z = generator.uniform(-1, 1, (500, 2))
    centres, widths = dyadic(z, 3)
    for level, spacing in enumerate((2.0, 1.0, 0.5)):
        own = centres[np.isclose(widths, spacing * np.sqrt(2))]
        assert len(own), level
        assert own / spacing == pytest.approx(np.round(own / spacing))
        assert np.abs(own).max() <= 1.0 + 2 * spacing


def test_clusters_lie_among_their_data(generator):
    spots = np.array([[0.0, 0.0], [5.0, 0.0], [0.0, 5.0]])
    z = np.repeat(spots, 50, axis=0) + 0.1 * generator.standard_normal((150, 2))
    centres, widths = clustered(z, 3, 1.0, generator)
    distance = np.sqrt(((centres[:, None] - spots[None]) ** 2).sum(axis=2)).min(axis=0)
    assert distance.max() < 0.1
    assert np.all((widths > 4) & (widths < 8))


@pytest.mark.parametrize("kind", ["rbf", "wavelet"])
def test_linear_weights_solve_the_least_squares_problem(kind, generator):
    z, targets = generator.standard_normal((80, 2)), generator.standard_normal((80, 3))
    centres, widths = z[:5], np.full(5, 1.5)
    network = Radial(kind, 2, 3, 5)
    theta = with_linear_weights(network, centres, widths, z, targets, 0.0)
    residual = network.values(theta, z) - targets
    columns = np.hstack([network.units(centres, widths, z), z, np.ones((80, 1))])
    assert columns.T @ residual == pytest.approx(np.zeros((8, 3)), abs=1e-9)
