"""Bounds that the proofs rest on: they hold, and the levels they give are right where known."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import operating_point
from trms_cli.stability.intervals.interval import Interval
from trms_cli.stability.lyapunov.candidate import EnergyCandidate
from trms_cli.stability.lyapunov.energy import Energy, EnergyWeights
from trms_cli.stability.lyapunov.level_search import decay_level, definite, stop_level, wells_of
from trms_cli.stability.lyapunov.motions import on_level, random_directions

RNG = np.random.default_rng(5)


@cache
def candidate_of(kind: type, freedom: str, strict: bool) -> EnergyCandidate:
    model = kind(freedom=freedom)
    at = {"alpha_v": 0.1, "alpha_h": 0.3}
    point = operating_point(model, {k: v for k, v in at.items() if k in model.controlled})
    cross = (0.03, 0.02) if strict else (0.0, 0.0)
    weights = EnergyWeights(2e-3, 1e-3, 1.0, *cross)
    return EnergyCandidate(Energy(model, point.u), point.x, weights)


CASES = [
    (kind, freedom, strict)
    for kind in (Newtonian, Lagrangian)
    for freedom in ("horizontal", "vertical", "both")
    for strict in (False, True)
]


@pytest.mark.parametrize(("kind", "freedom", "strict"), CASES)
def test_bounds_over_boxes_hold_at_points_in_them(kind: type, freedom: str, strict: bool) -> None:
    candidate = candidate_of(kind, freedom, strict)
    k, n = candidate.energy.k, 15
    sizes = np.repeat([1.0, 60.0, 0.8], k)
    first = candidate.centre + sizes * RNG.normal(size=(n, 3 * k))
    second = first + sizes * RNG.uniform(0, 0.5, size=(n, 3 * k))
    # Wells rise, as their bounds take it, between their ends.
    ends = wells_of(candidate).ends
    for side in (first, second):
        side[:, 2 * k :] = np.clip(side[:, 2 * k :], ends.lower, ends.upper)
    boxes = Interval(first, second)
    values, matrices, slopes = (
        candidate.values(boxes),
        candidate.matrices(boxes),
        candidate.slopes(boxes),
    )
    size = matrices.lower.shape[1]
    weights = candidate.weights.array()
    for _ in range(2):
        y = RNG.uniform(first, second)
        v = candidate.value(y)
        assert np.all(values.lower <= v + 1e-12) and np.all(v <= values.upper + 1e-12)
        for i in range(n):
            theta = np.array(candidate.energy.slopes_between(y[i], candidate.centre)).ravel()
            slack = 1e-6 * (np.abs(theta) + 1e-6)  # the equilibrium is known to some 1e-9
            assert np.all(slopes.lower[i] <= theta + slack)
            assert np.all(theta - slack <= slopes.upper[i])
            q = np.array(candidate.energy.decay(y[i], theta, weights))[:size, :size]
            slack = 1e-6 * (np.abs(q) + 1e-9)
            assert np.all(matrices.lower[i] <= q + slack)
            assert np.all(q - slack <= matrices.upper[i])


@pytest.mark.parametrize(("kind", "freedom", "strict"), CASES)
def test_a_level_set_lies_in_its_extent(kind: type, freedom: str, strict: bool) -> None:
    candidate = candidate_of(kind, freedom, strict)
    wells = wells_of(candidate)
    assert wells.rise
    level = 0.02
    box = candidate.extent(level, wells.ends)
    inside = on_level(candidate, wells, level, random_directions(candidate, 120, 1))
    assert len(inside) > 80
    assert np.all((inside >= box.lower) & (inside <= box.upper))


def test_the_equilibrium_lies_within_its_bounds() -> None:
    for case in CASES[::2]:
        candidate = candidate_of(*case)
        y = candidate.motions(candidate.x[None])[0]
        assert np.all(candidate.rest.contains(y) | (np.abs(y) < 1e-9))
        assert candidate.rest.width.max() < 1e-6


def disc(boxes: Interval) -> Interval:
    """V = y1² + y2²."""
    squares = boxes.square()
    return squares[:, 0] + squares[:, 1]


def diagonal(boxes: Interval) -> Interval:
    """Q = [[1, y1], [y1, 1]]: definite where |y1| < 1."""
    one = Interval.point(np.ones(len(boxes.lower)))
    rows = [one, boxes[:, 0], boxes[:, 0], one]
    shape = (len(boxes.lower), 2, 2)
    return Interval(
        np.stack([r.lower for r in rows], -1).reshape(shape),
        np.stack([r.upper for r in rows], -1).reshape(shape),
    )


def test_the_level_up_to_which_a_matrix_is_definite_is_found_between_bounds() -> None:
    box = Interval.of([-3.0, -3.0], [3.0, 3.0])
    found = decay_level(diagonal, disc, box, 9.0, 20_000)
    assert 0.95 < found.level <= 1.0 <= found.fails < 1.05
    assert found.point is not None and abs(found.point[0]) >= 1.0


def test_a_level_below_that_is_proved_all_over() -> None:
    box = Interval.of([-0.9, -0.9], [0.9, 0.9])
    found = decay_level(diagonal, disc, box, 0.81, 20_000)
    assert found.level == np.inf and found.fails == np.inf and found.point is None


def test_little_budget_proves_less() -> None:
    box = Interval.of([-3.0, -3.0], [3.0, 3.0])
    little = decay_level(diagonal, disc, box, 9.0, 20)
    assert 0.0 <= little.level < 0.95


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 5), st.integers(0, 10_000), st.floats(0.0, 0.4))
def test_definite_matrices_are_definite(n: int, seed: int, width: float) -> None:
    random = np.random.default_rng(seed)
    root = random.normal(size=(4, n, n))
    middle = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(n)
    half = width * random.uniform(size=middle.shape) * np.abs(middle)
    half = 0.5 * (half + half.transpose(0, 2, 1))
    proved, _ = definite(Interval(middle - half, middle + half))
    for sign in (-1.0, 1.0):
        ends = middle + sign * half
        assert np.all(np.linalg.eigvalsh(ends)[proved, 0] > 0.0)
    if width == 0.0:
        assert proved.all()


def test_an_indefinite_matrix_is_never_proved() -> None:
    proved, seems = definite(Interval.point(np.array([[[1.0, 2.0], [2.0, 1.0]]])))
    assert not proved[0] and not seems[0]


def test_stops_and_wells_of_the_vertical_model() -> None:
    candidate = candidate_of(Newtonian, "vertical", False)
    level, name = stop_level(candidate)
    assert name == "alpha_v = 1.05 rad"
    y = candidate.centre.copy()
    y[candidate.energy.index("alpha", "v")] = 1.05
    assert level == pytest.approx(float(candidate.value(y)[0]))
    wells = wells_of(candidate)
    assert wells.saddles is not None
    for saddle in wells.saddles:
        y[candidate.energy.index("alpha", "v")] = saddle
        moved = y + np.array([[0.0, 0.0, -1e-4], [0.0, 0.0, 1e-4]])
        slope = float(np.diff(candidate.value(moved))[0]) / 2e-4
        assert slope == pytest.approx(0.0, abs=1e-7)
