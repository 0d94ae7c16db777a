"""Root loci: crossings, exact sensitivities, loops, the map, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.inflow import Inflow
from trms_cli.models.feedback_manual import FeedbackManual
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.newtonian import Newtonian, geometry
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.stability.local.sensitivity import (
    EntryShare,
    Sensitivity,
    entry_words,
    loops_through,
    moves,
    sensitivity,
    share_chart,
    state_words,
)
from trms_cli.stability.local.sweep import OperatingPath, crossings, sweep_eigenvalues, tracks_of
from trms_cli.stability.studies.root_locus import RootLocus, stability_map
from trms_cli.stability.study import silent

from .study_cases import RAHIDEH, answer

RANGE = (0.0123, 0.2)


def locus(at, over, span, side="mean", points=21, model=None):
    path = OperatingPath(model or Newtonian(), at, over, side)
    sweep = sweep_eigenvalues(path, *span, points)
    return path, sweep, crossings(path, sweep)


def test_the_thesis_value_of_k_g_destabilises_pitch_above_the_published_angle():
    # model.md: above 0.34 rad. The slopes of the upper side give it exactly, the mean 0.347.
    _, _, found = locus({}, "alpha_v", (-0.5, 0.8), "upper", 31, RAHIDEH)
    assert found[0].value == pytest.approx(0.3396, abs=5e-4)
    assert found[0].unstable_above and found[0].kind == "Hopf"
    _, _, found = locus({}, "alpha_v", (-0.5, 0.8), "mean", 31, RAHIDEH)
    assert found[0].value == pytest.approx(0.3468, abs=5e-4)


def test_the_crossing_over_k_g_is_on_the_axis_and_between_the_sides():
    values = {}
    for side in ("lower", "mean", "upper"):
        path, _, (found,) = locus({"alpha_v": 0.4}, "k_g", RANGE, side)
        values[side] = found.value
        a = path.linear.a(found.place.point.x, found.place.point.u, side, found.place.held.p)
        pair = max(np.linalg.eigvals(a), key=lambda v: v.real)
        assert abs(pair.real) < 1e-9
        assert found.frequency == pytest.approx(abs(pair.imag))
    assert values["upper"] < values["mean"] < values["lower"]
    assert values["mean"] == pytest.approx(0.148, abs=1e-3)


@pytest.mark.parametrize(
    ("at", "over", "span"),
    [
        ({"alpha_v": 0.4}, "k_g", RANGE),
        ({"alpha_v": 0.2, "alpha_h": 0.3}, "l_cb", (0.26, 0.30)),
        ({}, "alpha_v", (-0.2, 0.5)),
        ({"u_h": 0.5}, "u_v", (1.0, 1.9)),
    ],
)
def test_sensitivities_are_those_of_finite_differences(at, over, span):
    path, sweep, _ = locus(at, over, span, points=5, model=RAHIDEH)
    place = sweep.places[2]
    h = 1e-6 * (span[1] - span[0])
    for track in range(path.model.n_x):
        found = sensitivity(path, place, track)
        up, down = (path.following(place, place.value + step) for step in (h, -h))
        slope = (up.spectrum.values[track] - down.spectrum.values[track]) / (2 * h)
        assert found.total == pytest.approx(slope, rel=1e-4, abs=1e-4)
        assert sum(s.part for s in found.shares) == pytest.approx(found.total)


def test_the_crossing_over_k_g_is_of_the_gyroscopic_moment_in_a_loop_over_pitch_and_yaw():
    path, _, (found,) = locus({"alpha_v": 0.4}, "k_g", RANGE)
    why = sensitivity(path, found.place, found.track)
    first = why.shares[0]
    assert entry_words(path.model, first.row, first.column) == "pitch moment per yaw rate"
    assert first.part.real > 0.5 * why.total.real > 0
    # dA/dk_g = F_v cos α_v / J_v, as it stands in the equation of pitch.
    p = {parameter.name: parameter.value for parameter in path.model.parameters}
    thrust = p["k_fvp"] * found.place.point.x[path.model.state_index("omega_v")] ** 2
    assert first.change == pytest.approx(thrust * np.cos(0.4) / geometry(p)["J_v"])
    # The strongest loop through that moment.
    a = path.linear.a(found.place.point.x, found.place.point.u, "mean", found.place.held.p)
    row, column = (path.model.state_index(name) for name in ("S_v", "S_h"))
    strongest = loops_through(a, row, column, 1j * found.frequency)[0]
    words = {state_words(path.model, k) for k in strongest.states}
    assert words == {"pitch rate", "pitch angle", "yaw rate"}
    # It is that of a model built with the value.
    for factor, stable in ((0.98, True), (1.02, False)):
        model = Newtonian(parameters={"k_g": factor * found.value})
        place = OperatingPath(model, {"alpha_v": 0.4}, "alpha_v").first(0.4, 0.4)
        assert (place.spectrum.values.real.max() < 0) == stable
    # It needs both couplings, in product.
    _, _, (over_k_m,) = locus({"alpha_v": 0.4}, "k_m", (0.0, 4e-4), model=RAHIDEH)
    product = over_k_m.value * RAHIDEH.parameters["k_g"].value
    assert product == pytest.approx(found.value * p["k_m"], rel=1e-6)


def test_the_lagrangian_form_has_no_such_instability():
    model = Lagrangian(parameter_set="rahideh")
    path, sweep, found = locus({}, "alpha_v", (-0.6, 0.94), points=31, model=model)
    assert found == () and sweep.eigenvalues.real.max() < 0
    # Its yaw moment depends on the pitch rate, which the Newtonian form's does not.
    for form, expected in ((model, -0.186), (RAHIDEH, 0.0)):
        path = OperatingPath(form, {}, "alpha_v")
        point = path.first(0.4, 0.4).point
        row, column = (form.state_index(name) for name in ("S_h", "S_v"))
        assert path.linear.a(point.x, point.u)[row, column] == pytest.approx(expected, abs=1e-3)


def test_gains_of_loops_are_those_of_masons_rule():
    # Two states in a ring: det(sI − A) = (s − a)(s − d)(1 − L), so L = 1 at an eigenvalue.
    a = np.array([[-1.0, 2.0], [-3.0, -0.5]])
    s = np.linalg.eigvals(a)[0]
    (loop,) = loops_through(a, 0, 1, s)
    assert loop.gain == pytest.approx(1.0)
    three = np.array([[-1.0, 0, 2.0], [0.5, -0.3, 0], [0, 1.5, -2.0]])
    (loop,) = loops_through(three, 0, 2, np.linalg.eigvals(three)[0])
    assert len(loop.states) == 3 and loop.gain == pytest.approx(1.0)


def test_the_size_of_an_effect_can_be_varied():
    model = extend_model(Newtonian(), {"main_inflow": Inflow(rotor="main", coefficient=10.0)})
    path, sweep, _ = locus({"alpha_v": 0.0}, "main_inflow.coefficient", (0.0, 60.0), model=model)
    assert path.unit == "rad/m"
    pitch = np.argmax(np.abs(sweep.eigenvalues[0].imag))
    damping = sweep.eigenvalues[:, pitch].real
    assert np.all(np.diff(damping) < 0)  # inflow damps


def test_the_map_has_the_boundary_of_the_loci_and_holes_where_there_is_no_operating_point():
    path = OperatingPath(Newtonian(), {"alpha_v": 0.4}, "k_g")
    found = stability_map(path, "alpha_v", RANGE, (0.3, 0.5), (7, 5), silent)
    assert found.largest_growth_1_s.shape == (5, 7)
    row = np.flatnonzero(np.isclose(found.boundary[:, 1], 0.4))
    assert found.boundary[row, 0] == pytest.approx([0.1481], abs=2e-4)
    assert np.all(np.diff(found.largest_growth_1_s, axis=1) > 0)  # more k_g, less stable
    path = OperatingPath(FeedbackManual(), {"alpha_v": -0.5}, "K_gy")
    found = stability_map(path, "alpha_v", (0.01, 0.05), (-0.4, 0.2), (3, 5), silent)
    assert np.isfinite(found.largest_growth_1_s[0]).all()
    assert np.isnan(found.largest_growth_1_s[-1]).all()


def test_a_locus_over_a_command_ends_at_the_fold_and_so_does_its_map():
    asked = RootLocus(over="u_v", range=(1.5, 2.5), against="u_h", points=9, map_points=3)
    findings = answer(asked)
    values = findings.results["locus"]["values"]
    assert values[-1] == pytest.approx(2.23, abs=5e-3)
    assert "ends" in findings.results["locus"]["ended_high"]
    assert findings.results["map"]["along_against"][0]["over"] == 1.5


def test_the_study_says_where_and_why():
    findings = answer(RootLocus(points=21, map_points=5))
    assert "k_g = 0.14813" in findings.lead[0]
    sentences = " ".join(findings.lead)
    assert "pitch moment per yaw rate" in sentences
    assert "loop" in sentences
    results = findings.results
    assert results["crossings"][0]["kind"] == "Hopf"
    assert results["crossings_by_side"]["upper"][0] == pytest.approx(0.1413, abs=1e-3)
    (at_model, *_) = [e for e in results["map"]["along_against"] if e["over"] == 0.2]
    assert at_model["crossings"][0]["value"] == pytest.approx(0.347, abs=2e-3)
    drawn = {"root_locus", "root_locus_range", "root_locus_why", "root_locus_map"}
    assert {chart.name for chart in findings.charts} == drawn
    # Numbers have units.
    assert "At alpha_v = 0.4 rad the pitch swing" in sentences
    assert "unstable above alpha_v = 0.3468 rad" in sentences
    commands = answer(RootLocus(over="k_g", at={"u_v": 1.0}, points=5))
    assert "At u_v = 1 V, k_g" in commands.lead[0]


def test_at_a_kink_it_is_said_where_and_what_the_growth_rate_does_over_the_range():
    findings = answer(RootLocus(points=41), Newtonian(freedom="horizontal"))
    sentences = " ".join(findings.lead)
    assert "does not move the growth rate" not in sentences
    assert "The tail rotor comes closest to the axis at alpha_h = 0 rad" in sentences
    assert "between −3.45 and −1.69 1/s" in sentences
    # The table of shares would be one of rounding.
    assert not [t for s in findings.sections if s.heading == "Why" for t in s.blocks[:-1]]


def test_at_an_extreme_rounding_is_no_cause():
    findings = answer(RootLocus(points=21), QuanserAero())
    assert abs(findings.results["why"][0]["dlambda"][0]) < 1e-6
    sentences = " ".join(findings.lead)
    assert "comes closest to the axis at alpha_v = 0 rad" in sentences and "e-" not in sentences
    (why,) = [s for s in findings.sections if s.heading == "Why"]
    assert all(type(block).__name__ == "Chart" for block in why.blocks)


@pytest.mark.parametrize(
    ("parts", "moved"),
    [((1e-10,), False), ((-4.5e-32,), False), ((3e3, -3e3 + 1e-6), False), ((1e-3,), True)],
)
def test_what_cancels_but_for_rounding_moves_nothing(parts, moved):
    shares = tuple(EntryShare(0, k, 1.0, complex(part)) for k, part in enumerate(parts))
    total = complex(sum(parts))
    assert moves(Sensitivity(total, total, shares)) is moved


def test_a_number_that_moves_nothing_is_told_as_such():
    # The cable's stiffness on the other side of the yaw.
    findings = answer(RootLocus(over="k_chp", at={"alpha_h": -0.3}, points=5))
    assert "k_chp moves no growth rate" in " ".join(findings.lead)
    assert findings.results["why"] == []


def test_the_chart_of_a_jump_breaks_its_curves_there():
    path = OperatingPath(Newtonian(freedom="horizontal"), {}, "alpha_h")
    sweep = sweep_eigenvalues(path, -1.0, 1.0, 41)
    tracks = tracks_of(path.model, sweep)
    rotor = next(t for t in tracks if t.name == "tail rotor")
    chart = share_chart("why", path, sweep, rotor.members[0], rotor.name)
    together = next(m for m in chart.panels[0].marks if getattr(m, "label", "") == "together")
    gaps = np.isnan(together.y)
    # At the jump itself, and where the derivative grows beyond bounds beside it.
    assert np.any(np.abs(sweep.values[gaps]) < 1e-9)
    assert np.all(np.abs(sweep.values[gaps]) < 0.01)
