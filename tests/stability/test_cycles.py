"""Periodic orbits against oscillators whose cycles are known in closed form or to many digits."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import trapezoid
from scipy.special import ellipk

from trms_cli.models.model import Model, Signal
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import operating_point
from trms_cli.models.parameters import ParameterSet
from trms_cli.models.vector_field import has_impulses
from trms_cli.stability.cycles.absence import absence
from trms_cli.stability.cycles.branch import born_at, equilibria_over, follow_branch, hopf_points
from trms_cli.stability.cycles.orbits import (
    Shooting,
    continuum,
    half_widths,
    search_orbits,
    starts_in,
)


class Oscillator(Model):
    """Two states x, y and one input, its equations given."""

    name = "oscillator"
    states = (Signal("x", "1"), Signal("y", "1"))
    inputs = (Signal("u", "1"),)
    outputs = (Signal("x", "1"),)
    disturbances = ()
    controlled = ("x",)

    def __init__(self, equations) -> None:
        self.input_limits, self.stops, self.axes, self.rotors = {"u": 2.0}, {}, {}, {}
        self.parameters = ParameterSet([], "none")
        self._equations = equations

    def dynamics(self, x, u, p, w):
        return ca.vertcat(*self._equations(x[0], x[1], u[0]))

    def measurement(self, x, u, p):
        return x[0]


def van_der_pol() -> Oscillator:
    return Oscillator(lambda x, y, u: (y, (1 - x**2) * y - x))


def normal_form() -> Oscillator:
    """r' = u r + r³ − r⁵, φ' = 2: cycles at u = r⁴ − r², Hopf at 0, fold at u = −1/4, r² = 1/2."""

    def equations(x, y, u):
        r2 = x**2 + y**2
        growth = u + r2 - r2**2
        return growth * x - 2 * y, growth * y + 2 * x

    return Oscillator(equations)


VAN_DER_POL = Shooting(van_der_pol())
NORMAL_FORM = Shooting(normal_form(), steps=400)


def circle(r: float) -> np.ndarray:
    turn = 2 * np.pi * np.arange(10) / 10
    return r * np.stack([np.cos(turn), np.sin(turn)], axis=1)


def test_orbits_around_a_centre_are_a_continuum_and_those_at_a_fold_are_not():
    """A pendulum of energy 1 − cos a has the period 4 K(sin² a/2)."""
    pendulum = Oscillator(lambda x, y, u: (y, -ca.sin(x)))
    shooting = Shooting(pendulum, steps=400)
    starts = np.array([[a, 0.0] for a in (0.5, 1.0, 1.5)])
    found = search_orbits(pendulum, starts, np.zeros(1), 40.0, shooting)
    assert len(found.orbits) == 0 and len(found.continuum) == 3
    for orbit in found.continuum:
        a = orbit.path[:, 0].max()
        assert orbit.period == pytest.approx(4 * ellipk(np.sin(a / 2) ** 2), rel=1e-4)
    u = np.array([-0.25 + 1e-6])
    pair = [NORMAL_FORM.closed(circle(np.sqrt(0.5 + s * 1e-3)), np.pi, u) for s in (-1, 1)]
    assert all(abs(orbit.largest - 1) < 0.02 for orbit in pair)
    assert continuum(pair) == []


@pytest.fixture(scope="module")
def van_der_pol_search():
    starts = starts_in(np.zeros(2), np.array([3.0, 3.0]), 6)
    return search_orbits(van_der_pol(), starts, np.zeros(1), 60.0, VAN_DER_POL)


def test_the_cycle_of_van_der_pol_is_found_from_motions(van_der_pol_search):
    assert [motion.fate for motion in van_der_pol_search.motions] == ["cycle"] * 6
    (orbit,) = van_der_pol_search.orbits
    assert orbit.period == pytest.approx(6.66328686, abs=1e-6)
    assert orbit.path[:, 0].max() == pytest.approx(2.00861986, abs=1e-4)  # of 800 points a period
    assert orbit.stable and orbit.misfit < 1e-9 and orbit.trivial_error < 1e-6


def test_its_multiplier_is_the_exponential_of_the_divergence(van_der_pol_search):
    """Liouville: the product of all multipliers is exp ∮ div f dt, and one of them is 1."""
    (orbit,) = van_der_pol_search.orbits
    divergence = 1 - orbit.path[:, 0] ** 2
    expected = np.exp(trapezoid(divergence, orbit.time))
    assert orbit.largest.real == pytest.approx(expected, rel=1e-5)
    assert orbit.largest.real == pytest.approx(8.597e-4, rel=1e-3)


@settings(max_examples=15, deadline=None)
@given(r2=st.floats(0.05, 0.95), off=st.floats(-0.03, 0.03))
def test_cycles_of_the_normal_form(r2, off):
    """Radius, period and multiplier in closed form, unstable inside and stable outside."""
    if abs(r2 - 0.5) < 0.03:
        return  # at the fold two cycles meet
    u = np.array([r2**2 - r2])
    orbit = NORMAL_FORM.closed(circle(np.sqrt(r2) * (1 + off)), np.pi * (1 + off), u)
    assert orbit is not None
    assert orbit.period == pytest.approx(np.pi, rel=1e-8)
    assert np.hypot(*orbit.path.T) == pytest.approx(np.full(len(orbit.path), np.sqrt(r2)), rel=1e-6)
    slope = u[0] + 3 * r2 - 5 * r2**2
    assert orbit.largest.real == pytest.approx(np.exp(np.pi * slope), rel=1e-5)
    assert orbit.stable == (r2 > 0.5)


def test_from_a_guess_that_belongs_to_no_cycle_none_comes():
    assert NORMAL_FORM.closed(circle(0.1), np.pi, np.array([-1.0])) is None


def test_a_branch_from_its_hopf_point_around_the_fold():
    model = normal_form()
    curve = equilibria_over(model, np.zeros(2), np.array([-0.4]), 0)
    (hopf,) = hopf_points(model, curve, np.array([-0.4]), 0)
    assert hopf.u[0] == pytest.approx(0.0, abs=1e-8) and hopf.omega == pytest.approx(2.0)
    branch = born_at(NORMAL_FORM, hopf, 0, 60)
    assert not branch.orbits[0].stable and branch.orbits[-1].stable
    (fold,) = branch.changes(0, 0)
    assert fold.kind == "fold" and fold.command == pytest.approx(-0.25, abs=1e-3)
    assert fold.swing == pytest.approx(2 * np.sqrt(0.5), abs=0.01)
    for orbit in branch.orbits:
        r2 = orbit.swing[0] ** 2 / 4
        assert orbit.u[0] == pytest.approx(r2**2 - r2, abs=1e-4)


def test_a_branch_from_a_cycle_ends_at_the_hopf_point():
    u = np.array([0.25 - 0.5 + 0.05])
    small = (1 - np.sqrt(1 + 4 * u[0])) / 2
    first = NORMAL_FORM.closed(circle(np.sqrt(small)), np.pi, u)
    branch = follow_branch(NORMAL_FORM, first, 0, 60)
    assert "Hopf" in branch.ended
    assert abs(branch.orbits[-1].u[0]) < 0.02 < abs(branch.orbits[0].u[0])
    assert not any(orbit.stable for orbit in branch.orbits)


def proof_of(model, point):
    return absence(model, point.x, point.u, half_widths(model, point.x, {}))


@pytest.mark.parametrize("freedom", ["vertical", "horizontal"])
def test_one_axis_has_no_cycle_and_that_is_proved(freedom):
    model = Newtonian(freedom=freedom)
    point = operating_point(model, {model.controlled[0]: 0.2})
    proof = proof_of(model, point)
    assert proof.proved and proof.everywhere
    rotor, beam = proof.blocks
    assert len(rotor.states) == 1 and len(beam.states) == 2
    # The divergence of the beam is −k_o/J.
    geometry = {p.name: p.value for p in model.parameters}
    low, high = beam.divergence
    assert low <= high < 0
    if freedom == "vertical":
        from trms_cli.models.newtonian import geometry as inertia

        exact = -geometry["k_ov"] / inertia(geometry)["J_v"]
        assert low == pytest.approx(exact, rel=1e-12) and high - low < 1e-9


def test_both_axes_are_left_open():
    model = Newtonian()
    point = operating_point(model, {"alpha_v": 0.0, "alpha_h": 0.3})
    proof = proof_of(model, point)
    assert not proof.proved and len(proof.blocks[-1].states) == 4
    assert not proof.blocks[-1].constant
    # Close to the equilibrium areas shrink: there, none is proved.
    assert 0.1 < proof.blocks[-1].share < 0.5


def test_what_an_open_block_drives_is_open_too():
    """x, y cycle as van der Pol's, z settles towards x: a limit cycle in z too."""

    class Driven(Oscillator):
        states = (*Oscillator.states, Signal("z", "1"))

        def dynamics(self, x, u, p, w):
            return ca.vertcat(super().dynamics(x, u, p, w), x[0] - x[2])

    model = Driven(lambda x, y, u: (y, (1 - x**2) * y - x))
    proof = absence(model, np.zeros(3), np.zeros(1), 3 * np.ones(3))
    assert [(block.states, block.constant) for block in proof.blocks] == [
        (("x", "y"), False),
        (("z",), False),
    ]
    assert proof.blocks[1].driven


def test_nothing_is_proved_of_an_oscillator_that_cycles():
    assert not absence(van_der_pol(), np.zeros(2), np.zeros(1), 3 * np.ones(2)).proved
    # Within |x| < 1 the divergence 1 − x² is positive: no cycle lies there.
    inner = absence(van_der_pol(), np.zeros(2), np.zeros(1), 0.9 * np.ones(2))
    assert inner.proved and not inner.everywhere


class WithLag(Oscillator):
    """The normal form with a lag that acts back a little: one block of three states."""

    states = (*Oscillator.states, Signal("z", "1"))

    def __init__(self) -> None:
        super().__init__(normal_form()._equations)

    def dynamics(self, x, u, p, w):
        plane = super().dynamics(x, u, p, w)
        return ca.vertcat(plane[0] + 1e-3 * x[2], plane[1], x[0] - 3 * x[2])


@settings(max_examples=4, deadline=None)
@given(u=st.floats(-0.24, -0.02), width=st.floats(0.1, 1.5))
def test_no_box_that_is_proved_empty_holds_a_known_cycle(u, width):
    (block,) = absence(WithLag(), np.zeros(3), np.array([u]), np.full(3, width)).blocks
    radius = np.sqrt((1 - np.sqrt(1 + 4 * u)) / 2)  # of the unstable cycle, to the lag's 1e-3
    assert 0 < block.share <= 1 and not block.constant
    assert block.share * width < radius + 0.01


def test_a_block_whose_areas_shrink_everywhere():
    (block,) = absence(WithLag(), np.zeros(3), np.array([-1.0]), np.full(3, 0.3)).blocks
    assert block.share == 1.0


def test_impulses_are_told():
    from trms_cli.effects.coulomb_friction import CoulombFriction
    from trms_cli.effects.extended_model import extended
    from trms_cli.effects.quadratic_damping import QuadraticDamping

    model = Newtonian()
    assert not has_impulses(model)
    friction = {"f": CoulombFriction(axis="pitch", torque=0.01)}
    assert has_impulses(extended(model, friction))
    damping = {"d": QuadraticDamping(axis="pitch", coefficient=0.01)}
    assert not has_impulses(extended(model, damping))


def test_starts_fill_the_box_and_nothing_else():
    starts = starts_in(np.array([1.0, 5.0]), np.array([0.5, 0.0]), 50)
    assert starts.shape == (50, 2) and np.all(starts[:, 1] == 5.0)
    assert starts[:, 0].min() < 0.6 and starts[:, 0].max() > 1.4
    assert np.all(np.abs(starts[:, 0] - 1.0) <= 0.5)
