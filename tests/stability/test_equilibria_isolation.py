"""Branch and prune: what it calls proved is true, and what it cannot decide it does not claim."""

from __future__ import annotations

import casadi as ca
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.stability.equilibria.proof import Roots, isolate
from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval


class Equations:
    """Any expression in the place of a block of a rig."""

    def __init__(self, expression: ca.SX, z: ca.SX, q: ca.SX) -> None:
        self.n = z.numel()
        slopes = ca.densify(ca.jacobian(expression, z))
        self._values = Enclosure(ca.Function("values", [z, q], [expression]))
        self._both = Enclosure(ca.Function("both", [z, q], [expression, slopes]))

    def values(self, own: Interval, given_: Interval) -> Interval:
        return self._values(own, given_)[0]

    def with_slopes(self, own: Interval, given_: Interval) -> tuple[Interval, Interval]:
        g, slopes = self._both.matrices(own, given_)
        return g[:, :, 0], slopes


Z, Q = ca.SX.sym("z", 1), ca.SX.sym("q", 1)
ZZ = ca.SX.sym("zz", 2)


def solved(
    expression: ca.SX, z: ca.SX, bounds: tuple[float, float], given_: Interval | None = None
) -> Roots:
    n = z.numel()
    box = Interval.of([bounds[0]] * n, [bounds[1]] * n)
    point = Interval.point([[0.0]]) if given_ is None else given_
    return isolate(Equations(expression, z, Q), box, point, np.full(n, 1e-9))  # type: ignore[arg-type]


@settings(max_examples=15, deadline=None)
@given(st.lists(st.integers(-19, 19), min_size=1, max_size=4, unique=True))
def test_all_roots_of_a_polynomial_are_found_and_proved(places: list[int]) -> None:
    roots = sorted(place / 10.0 + 0.003 for place in places)
    expression = ca.SX(1)
    for root in roots:
        expression = expression * (Z - root)
    found = solved(expression, Z, (-2.0, 2.0))
    assert found.unique.all()
    assert len(found.owner) == len(roots)
    for k, root in enumerate(roots):
        assert found.box.lower[k, 0] <= root + 1e-12 and root - 1e-12 <= found.box.upper[k, 0]
        assert found.box.width[k, 0] < 1e-9


def test_a_root_on_the_border_of_two_boxes_is_one_root() -> None:
    found = solved(Z * (Z**2 + 1), Z, (-4.0, 4.0))
    assert found.unique.tolist() == [True]
    assert found.box.contains(0.0).all()


def test_a_double_root_is_not_called_one_root() -> None:
    found = solved(Z**2 * (Z - 1), Z, (-2.0, 2.0))
    assert found.unique.tolist() == [False, True]
    assert abs(found.box.middle[0, 0]) < 1e-6
    assert not found.exists[0]


def test_thrust_at_zero_exists_but_is_not_proved_unique() -> None:
    found = solved(Z * ca.fabs(Z), Z, (-2.0, 2.0))
    assert found.exists.tolist() == [True]
    assert found.unique.tolist() == [False]


def test_nothing_is_found_where_there_is_nothing() -> None:
    assert len(solved(Z**2 + 0.01, Z, (-2.0, 2.0)).owner) == 0


def test_two_unknowns_of_a_circle_and_a_line() -> None:
    expression = ca.vertcat(ZZ[0] ** 2 + ZZ[1] ** 2 - 1, ZZ[0] - ZZ[1] * 2)
    found = solved(expression, ZZ, (-2.0, 2.0))
    assert found.unique.tolist() == [True, True]
    reached = np.sort(found.box.middle[:, 1])
    np.testing.assert_allclose(reached, [-1 / np.sqrt(5), 1 / np.sqrt(5)], rtol=1e-9)


def test_a_tangent_is_left_undecided() -> None:
    expression = ca.vertcat(ZZ[0] ** 2 + ZZ[1] ** 2 - 1, ZZ[0] - 1)
    found = solved(expression, ZZ, (-2.0, 2.0))
    assert len(found.owner) >= 1
    assert not found.unique.any()
    np.testing.assert_allclose(found.box.middle[0], [1.0, 0.0], atol=1e-4)


def test_no_bounds_at_all() -> None:
    far = solved(Z * ca.fabs(Z) + Z - 1e8, Z, (-np.inf, np.inf))
    assert far.unique.tolist() == [True] and not far.open_ended
    assert abs(far.box.middle[0, 0] - 9999.5) < 0.1
    beyond = solved(Z - 1e7, Z, (-np.inf, np.inf))
    assert len(beyond.owner) == 0 and beyond.open_ended


def test_what_is_given_as_an_interval_is_proved_for_all_of_it() -> None:
    given_ = Interval.of([[0.9], [-0.1], [-2.0]], [[1.1], [0.1], [-1.0]])
    found = solved(Z**2 - Q, Z, (-3.0, 3.0), given_)
    assert found.owner[found.unique].tolist() == [0, 0]
    np.testing.assert_allclose(found.box.upper[1, 0], np.sqrt(1.1), rtol=0.02)
    assert found.box.lower[1, 0] <= np.sqrt(0.9) <= np.sqrt(1.1) <= found.box.upper[1, 0]
    assert 1 in found.owner and not found.unique[found.owner == 1].any()
    assert 2 not in found.owner


def test_a_root_outside_the_box_is_not_counted() -> None:
    assert len(solved(Z - 2.05, Z, (-2.0, 2.0)).owner) == 0
    assert solved(Z - 2.0, Z, (-2.0, 2.0)).unique.tolist() in ([True], [False])


def test_a_kink_has_the_slopes_of_both_sides() -> None:
    found = solved(ca.if_else(Z >= 0, 1.0, 5.0) * Z + 0.5, Z, (-2.0, 2.0))
    assert found.unique.tolist() == [True]
    np.testing.assert_allclose(found.box.middle, [[-0.1]], atol=1e-12)
