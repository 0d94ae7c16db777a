"""Periodic orbits against oscillators whose cycles are known in closed form or to many digits; the
study of limit cycles on the rig's models.
"""

import json

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import trapezoid
from scipy.special import ellipk

from trms_cli.core.chart import Curve
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.quadratic_damping import QuadraticDamping
from trms_cli.models.model import Signal
from trms_cli.models.newtonian import Newtonian, geometry
from trms_cli.models.operating_point import operating_point
from trms_cli.models.vector_field import VectorField, has_impulses
from trms_cli.stability.cycles.absence import absence
from trms_cli.stability.cycles.branch import born_at, equilibria_over, follow_branch, hopf_points
from trms_cli.stability.cycles.orbits import (
    Shooting,
    continuum,
    half_widths,
    search_orbits,
    starts_in,
)
from trms_cli.stability.local.linear import Linear
from trms_cli.stability.studies.limit_cycles import LimitCycles
from trms_cli.stability.study import silent
from trms_cli.stability.subject import Subject, not_level

from .planar_systems import Planar, van_der_pol


def normal_form() -> Planar:
    """r' = u r + r³ − r⁵, φ' = 2: cycles at u = r⁴ − r², Hopf at 0, fold at u = −1/4, r² = 1/2."""

    def equations(x, y, u):
        r2 = x**2 + y**2
        growth = u + r2 - r2**2
        return growth * x - 2 * y, growth * y + 2 * x

    return Planar(equations)


NORMAL_FORM = Shooting(normal_form(), steps=400)


def circle(r: float) -> np.ndarray:
    turn = 2 * np.pi * np.arange(10) / 10
    return r * np.stack([np.cos(turn), np.sin(turn)], axis=1)


def test_orbits_around_a_centre_are_a_continuum_and_those_at_a_fold_are_not():
    """A pendulum of energy 1 − cos a has the period 4 K(sin² a/2)."""
    pendulum = Planar(lambda x, y, u: (y, -ca.sin(x)))
    shooting = Shooting(pendulum, steps=400)
    starts = np.array([[a, 0.0] for a in (0.5, 1.0, 1.5)])
    found = search_orbits(pendulum, starts, np.zeros(1), 40.0, shooting)
    assert len(found.orbits) == 0 and len(found.continuum) == 3
    for orbit in found.continuum:
        a = orbit.path[:, 0].max()
        assert orbit.period == pytest.approx(4 * ellipk(np.sin(a / 2) ** 2), rel=1e-4)
    u = np.array([-0.25 + 1e-6])
    pair = [NORMAL_FORM.find_orbit(circle(np.sqrt(0.5 + s * 1e-3)), np.pi, u) for s in (-1, 1)]
    assert all(abs(orbit.largest - 1) < 0.02 for orbit in pair)
    assert continuum(pair) == []


def test_the_cycle_of_van_der_pol_is_found_from_motions_and_its_multiplier_by_liouville():
    starts = starts_in(np.zeros(2), np.array([3.0, 3.0]), 6)
    model = van_der_pol()
    found = search_orbits(model, starts, np.zeros(1), 60.0, Shooting(model))
    assert [motion.fate for motion in found.motions] == ["cycle"] * 6
    (orbit,) = found.orbits
    assert orbit.period == pytest.approx(6.66328686, abs=1e-6)
    assert orbit.path[:, 0].max() == pytest.approx(2.00861986, abs=1e-4)  # of 800 points a period
    assert orbit.stable and orbit.misfit < 1e-9 and orbit.trivial_error < 1e-6
    # Liouville: the product of all multipliers is exp ∮ div f dt, and one of them is 1.
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
    orbit = NORMAL_FORM.find_orbit(circle(np.sqrt(r2) * (1 + off)), np.pi * (1 + off), u)
    assert orbit is not None
    assert orbit.period == pytest.approx(np.pi, rel=1e-8)
    assert np.hypot(*orbit.path.T) == pytest.approx(np.full(len(orbit.path), np.sqrt(r2)), rel=1e-6)
    slope = u[0] + 3 * r2 - 5 * r2**2
    assert orbit.largest.real == pytest.approx(np.exp(np.pi * slope), rel=1e-5)
    assert orbit.stable == (r2 > 0.5)


def test_a_branch_from_its_hopf_point_goes_around_the_fold_and_from_a_cycle_ends_there():
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
    # From a cycle it ends at the Hopf point.
    u = np.array([0.25 - 0.5 + 0.05])
    small = (1 - np.sqrt(1 + 4 * u[0])) / 2
    first = NORMAL_FORM.find_orbit(circle(np.sqrt(small)), np.pi, u)
    branch = follow_branch(NORMAL_FORM, first, 0, 60)
    assert "Hopf" in branch.stop_reason
    assert abs(branch.orbits[-1].u[0]) < 0.02 < abs(branch.orbits[0].u[0])
    assert not any(orbit.stable for orbit in branch.orbits)
    # From a guess that belongs to no cycle none comes.
    assert NORMAL_FORM.find_orbit(circle(0.1), np.pi, np.array([-1.0])) is None


SHORT = {"starts": 6, "duration": 40.0, "orbits": 45}


def asked(model, **keys):
    return LimitCycles(**{**SHORT, **keys}).run(Subject(model, "m"), silent)


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
    values = {p.name: p.value for p in model.parameters}
    low, high = beam.divergence
    assert low <= high < 0
    if freedom == "vertical":
        exact = -values["k_ov"] / geometry(values)["J_v"]
        assert low == pytest.approx(exact, rel=1e-12) and high - low < 1e-9
    findings = asked(model)
    assert "no limit cycle" in findings.lead[0] and "proved" in findings.lead[0]
    assert (findings.measures[0].value, findings.measures[0].note) == (0, "proved")
    proof = findings.results["proof"]
    assert proof["no_cycle"] and proof["everywhere"]
    assert findings.results["cycles"] == [] and findings.results["over"]["hopf"] == []
    json.dumps(findings.results, allow_nan=False)


def test_of_both_axes_none_is_found_but_that_is_left_open():
    model = Newtonian()
    point = operating_point(model, {"alpha_v": 0.0, "alpha_h": 0.3})
    proof = proof_of(model, point)
    assert not proof.proved and len(proof.blocks[-1].states) == 4
    assert not proof.blocks[-1].constant
    # Close to the equilibrium areas shrink: there, none is proved.
    assert 0.1 < proof.blocks[-1].share < 0.5
    findings = asked(model)
    assert "not a proof" in findings.lead[0] and "certified" in findings.lead[1]
    assert findings.results["cycles"] == [] and findings.results["over"]["hopf"] == []
    assert not findings.results["proof"]["no_cycle"]


def test_nothing_is_proved_of_what_cycles_nor_of_what_that_drives_but_where_areas_shrink():
    """x, y cycle as van der Pol's, z settles towards x: a limit cycle in z too."""
    driven = WithLag(van_der_pol(), 1.0, 0.0)
    proof = absence(driven, np.zeros(3), np.zeros(1), 3 * np.ones(3))
    assert [(block.states, block.constant) for block in proof.blocks] == [
        (("x", "y"), False),
        (("z",), False),
    ]
    assert proof.blocks[1].is_driven
    assert not absence(van_der_pol(), np.zeros(2), np.zeros(1), 3 * np.ones(2)).proved
    # Within |x| < 1 the divergence 1 − x² is positive: no cycle lies there.
    inner = absence(van_der_pol(), np.zeros(2), np.zeros(1), 0.9 * np.ones(2))
    assert inner.proved and not inner.everywhere
    (block,) = absence(COUPLED, np.zeros(3), np.array([-1.0]), np.full(3, 0.3)).blocks
    assert block.share == 1.0


class WithLag(Planar):
    """A planar system with a lag behind x, and how much that acts back."""

    states = (*Planar.states, Signal("z", "1"))

    def __init__(self, plane: Planar, rate: float, back: float) -> None:
        super().__init__(plane._rates)
        self.rate, self.back = rate, back

    def dynamics(self, x, u, p, w):
        plane = super().dynamics(x, u, p, w)
        return ca.vertcat(plane[0] + self.back * x[2], plane[1], x[0] - self.rate * x[2])


COUPLED = WithLag(normal_form(), 3.0, 1e-3)  # one block of three states


@settings(max_examples=4, deadline=None)
@given(u=st.floats(-0.24, -0.02), width=st.floats(0.1, 1.5))
def test_no_box_that_is_proved_empty_holds_a_known_cycle(u, width):
    (block,) = absence(COUPLED, np.zeros(3), np.array([u]), np.full(3, width)).blocks
    radius = np.sqrt((1 - np.sqrt(1 + 4 * u)) / 2)  # of the unstable cycle, to the lag's 1e-3
    assert 0 < block.share <= 1 and not block.constant
    assert block.share * width < radius + 0.01


def test_starts_fill_the_box_and_nothing_else():
    starts = starts_in(np.array([1.0, 5.0]), np.array([0.5, 0.0]), 50)
    assert starts.shape == (50, 2) and np.all(starts[:, 1] == 5.0)
    assert starts[:, 0].min() < 0.6 and starts[:, 0].max() > 1.4
    assert np.all(np.abs(starts[:, 0] - 1.0) <= 0.5)


def test_without_losses_orbits_are_no_limit_cycles():
    """k_ov = 0: a pendulum, around whose rest orbits of all sizes lie."""
    model = Newtonian(freedom="vertical")
    model.parameters = model.parameters.replaced({"k_ov": 0.0})
    findings = asked(model)
    results = findings.results
    assert results["cycles"] == [] and len(results["continuum"]) >= 3
    assert results["over"]["hopf"] == [] and results["over"]["branches"] == []
    assert findings.lead[0].startswith("No limit cycle was found, but a continuum")
    assert "unstable" not in " ".join(findings.lead)
    periods = [orbit["period"] for orbit in results["continuum"]]
    assert periods == sorted(periods) and periods[-1] < 2 * periods[0]
    json.dumps(results, allow_nan=False)


def test_two_cycles_surround_a_stable_hover_on_a_branch_that_folds():
    """The set `rahideh`, k_g = 0.2."""
    model, at = Newtonian(parameter_set="rahideh"), {"alpha_v": 0.17, "alpha_h": 0.3}
    findings = asked(model, at=at, starts=8, duration=60.0, box={"alpha_v": 0.9})
    unstable, stable = findings.results["cycles"]
    assert findings.results["continuum"] == []
    assert not unstable["stable"] and stable["stable"]
    assert unstable["period"] == pytest.approx(4.302, abs=0.002)
    assert stable["period"] == pytest.approx(4.622, abs=0.002)
    # The unstable one lies within the stable one, and around the equilibrium.
    low, high = ([c["lowest"]["alpha_v"], c["highest"]["alpha_v"]] for c in (unstable, stable))
    assert high[0] < low[0] < 0.17 < low[1] < high[1]
    for cycle in (unstable, stable):
        assert cycle["trivial_error"] < 1e-6 and cycle["misfit"] < 1e-8
        # The rotors are driven by nothing but their commands: they stand still on a cycle.
        assert cycle["lowest"]["omega_v"] == pytest.approx(cycle["highest"]["omega_v"])
    json.dumps(findings.results, allow_nan=False)
    names = [chart.name for chart in findings.charts]
    assert names == ["limit_cycles", "floquet_multipliers", "cycles_over_command"]
    # The Hopf point is subcritical.
    over = findings.results["over"]
    (hopf,) = over["hopf"]
    assert hopf["x"][model.state_index("alpha_v")] == pytest.approx(0.29, abs=0.003)
    branch = over["branches"][0]
    assert not any(branch["stable"][:10]) and branch["u"][5] < hopf["u"]
    fold = branch["changes"][0]
    assert fold["kind"] == "fold" and fold["u"] == pytest.approx(1.645, abs=0.002)
    assert any("subcritical" in sentence for sentence in findings.lead)
    # The curves of stable and unstable cycles meet at the fold.
    chart = findings.charts[-1]
    for panel in chart.panels:
        curves = [mark for mark in panel.marks if isinstance(mark, Curve)]
        blue = [mark for mark in curves if mark.colour == "blue"]
        red = [mark for mark in curves if mark.colour == "vermilion"]
        assert blue and red
        for one, other in zip(blue, red, strict=True):
            drawn, beside = (np.isfinite(np.asarray(mark.y)) for mark in (one, other))
            # They share the changes alone.
            shared = np.asarray(one.x)[drawn & beside]
            assert np.all(np.isin(shared, [change["u"] for change in branch["changes"]]))
            assert fold["u"] in shared


def test_the_multipliers_have_the_product_of_liouville():
    """∏ μ = exp ∮ div f dt, along the orbit that a motion settles on."""
    model = Newtonian(parameter_set="rahideh")
    point = operating_point(model, {"alpha_v": 0.17, "alpha_h": 0.3})
    start = point.x.copy()
    start[model.state_index("alpha_v")] -= 0.8
    found = search_orbits(model, start[None], point.u, 60.0, Shooting(model))
    (orbit,) = [orbit for orbit in found.orbits if orbit.stable]
    field = VectorField(model)
    divergence = [np.trace(field.linearised(x, point.u)[0]) for x in orbit.path]
    expected = trapezoid(divergence, orbit.time)
    assert np.log(np.abs(np.prod(orbit.multipliers))) == pytest.approx(expected, rel=1e-4)


def test_on_the_cable_s_switch_the_hopf_point_is_that_of_the_mean():
    model = Newtonian(parameter_set="rahideh")
    findings = asked(model, at={"alpha_v": 0.17}, starts=1, orbits=12)
    (hopf,) = findings.results["over"]["hopf"]
    x, u = np.array(hopf["x"]), np.array([hopf["u"], findings.results["at"]["u"]["u_h"]])
    assert Linear(model).switches(x, u)
    growth = np.linalg.eigvals(Linear(model).a(x, u, "mean")).real
    assert np.abs(growth).min() < 1e-6
    for side in ("upper", "lower"):
        assert np.abs(np.linalg.eigvals(Linear(model).a(x, u, side)).real).min() > 1e-4
    assert any("mean of both sides" in words for words in findings.lead)
    # The multipliers of the smallest cycles are 1 within their accuracy: no fold.
    assert findings.results["over"]["branches"][0]["changes"] == []


def test_with_dry_friction_motions_alone_are_looked_at():
    model = Newtonian(freedom="vertical")
    rig = extend_model(model, {"friction": CoulombFriction(axis="pitch", torque=0.01)})
    damped = extend_model(model, {"d": QuadraticDamping(axis="pitch", coefficient=0.01)})
    assert [has_impulses(one) for one in (model, rig, damped)] == [False, True, False]
    findings = asked(rig)
    assert not findings.results["proof"]["no_cycle"] and "over" not in findings.results
    assert findings.results["motions"]["rest"] == 6
    assert any("no slopes" in words for words in findings.warnings)
    assert "Without the dry friction none exists, whatever the start: proved" in findings.lead[0]


def test_what_makes_no_sense_and_another_point_than_the_usual_one_are_told():
    model = Newtonian()
    for keys, where in (({"over": "u_x"}, "over"), ({"box": {"q": 1.0}}, "box.q")):
        with pytest.raises(ConfigurationError) as told:
            LimitCycles(**keys).run(Subject(model, "m"), silent)
        assert told.value.where == where and told.value.remedy
    model = Newtonian(freedom="vertical")
    rest = operating_point(model, {})
    level = operating_point(model, {"alpha_v": 0.0})
    assert not_level(model, {}, level) == () and not_level(model, {"u_v": 0.0}, rest) == ()
    (words,) = not_level(model, {}, rest)
    assert "no equilibrium at alpha_v = 0 rad" in words and "rest without command" in words
