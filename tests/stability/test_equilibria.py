"""Equilibria of the rigs: the check values of the design, folds, proofs, friction. Branch and
prune: what it calls proved is true, and what it cannot decide it does not claim. The study as it is
asked for and told.
"""

import json
import re
from collections.abc import Iterable
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from trms_cli.core.chart import Note, as_data
from trms_cli.core.errors import ModelError, TrmsError
from trms_cli.core.findings import Findings
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.dead_zone import DeadZone
from trms_cli.effects.disturbance import Disturbance
from trms_cli.effects.extended_model import ExtendedModel
from trms_cli.effects.rotor_reaction import RotorReaction
from trms_cli.models.driven_model import DrivenModel
from trms_cli.models.feedback_manual import FeedbackManual
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian, geometry
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.models.tras import Tras
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.equilibria.proof import Proof, Prover, Roots, isolate, over_range
from trms_cli.stability.equilibria.rest_system import rest_system
from trms_cli.stability.equilibria.survey import (
    Survey,
    SurveySetting,
    bounds_of,
    complete_curves,
    named_points,
    setting_of,
    survey,
)
from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval
from trms_cli.stability.studies.equilibria import Equilibria
from trms_cli.stability.studies.local import Local
from trms_cli.stability.study import Study, silent
from trms_cli.stability.subject import Subject

NEWTONIAN = Newtonian()


def prover_of(model: Model, over: str, held: dict[str, float] | None = None) -> tuple[Prover, int]:
    system = rest_system(model, {over}, held)
    box, scale = bounds_of(system, {})
    return Prover(system, box, scale), system.known_index(over)


def proofs_at(one: tuple[Prover, int], values: Iterable[float]) -> list[Proof]:
    """Proofs at some values of one input, the others and all torques zero."""
    prover, index = one
    rows = np.zeros((len(list(values)), len(prover.system.knowns)))
    rows[:, index] = list(values)
    return prover.at(rows)


def surveyed(model: Model, over: str, points: int = 6, whole: bool = False) -> Survey:
    limit = model.input_limits[over]
    setting = setting_of(model, over, (-limit, limit), {})
    return survey(model, setting, {}, np.linspace(-limit, limit, points), whole, silent)


def resting(u: float) -> tuple[float, list[float]]:
    """Speed of the main rotor and the pitch angles of the box that rest, in closed form."""
    c = C

    def torque(omega: float) -> float:
        side = "p" if omega >= 0 else "n"
        current = (c["k_uv"] * u - c["kphi"] * omega) / c["R"]
        drag = c["B_mr"] * omega + c[f"k_tv{side}"] * omega * abs(omega)
        return float(c["kphi"] * current - drag)

    omega = float(brentq(torque, -2000.0, 2000.0, xtol=1e-12))
    lift = c["l_m"] * c["k_fvp" if omega >= 0 else "k_fvn"] * omega * abs(omega)
    if abs(lift) > WEIGHT:
        return omega, []
    turn = np.arcsin(lift / WEIGHT)
    both = (turn - TILT, np.pi - turn - TILT)
    return omega, [angle for angle in both if abs(angle) <= 1.57]


def asked(model: object, **keys: object) -> Findings:
    study = Equilibria(**({"proof_range": False, "proof_points": 5, "map": False} | keys))  # type: ignore[arg-type]
    assert isinstance(study, Study)
    return study.run(Subject(model, "tested"), silent)  # type: ignore[arg-type]


#: Parameters, the largest moment of gravity on pitch (N m), and the angle at which it is none.
C = {parameter.name: parameter.value for parameter in NEWTONIAN.parameters}
G = geometry(C)
WEIGHT, TILT = C["g"] * np.hypot(G["B"] - G["A"], G["C"]), np.arctan2(G["B"] - G["A"], G["C"])


def analytic_fold() -> float:
    """u_v where the thrust's moment is as large as gravity's can be, by the motor's equation."""
    c, weight = C, WEIGHT
    omega = np.sqrt(weight / (c["l_m"] * c["k_fvp"]))
    torque = c["B_mr"] * omega + c["k_tvp"] * omega**2
    return float((c["R"] * torque / c["kphi"] + c["kphi"] * omega) / c["k_uv"])


@pytest.mark.parametrize("model", [NEWTONIAN, Lagrangian()], ids=["newtonian", "lagrangian"])
def test_what_rests_in_closed_form_and_by_the_table_of_the_page_is_proved(model: Model) -> None:
    page = (Path(__file__).parents[2] / "docs" / "model.md").read_text(encoding="utf-8")
    cells = re.findall(r"^\| (−?[\d.]+) \| (−?[\d.]+) \| (−?[\d.]+) \|$", page, re.MULTILINE)
    table = np.array([[value.replace("−", "-") for value in row] for row in cells], dtype=float)
    assert len(table) == 8
    proofs = proofs_at(prover_of(model, "u_v"), table[:, 0])
    for (u, *printed), proof in zip(table.tolist(), proofs, strict=True):
        omega, pitches = resting(u)
        assert np.all(np.abs(np.array([omega, min(pitches)]) - printed) < [0.051, 6e-4])
        assert proof.complete and proof.count == len(pitches)
        lowest = min(proof.proved, key=lambda one: one.x.middle[model.state_index("alpha_v")])
        assert abs(lowest.x.middle[model.state_index("omega_v")] - omega) < 1e-4
        assert abs(lowest.x.middle[model.state_index("alpha_v")] - min(pitches)) < 1e-6
        assert np.all(lowest.x.width < 1e-6)


def test_rest_hover_and_yaw_at_hover() -> None:
    rest, hover = named_points(NEWTONIAN, {})[0]
    assert abs(rest.x[NEWTONIAN.state_index("alpha_v")] + 0.6194) < 5e-5
    assert abs(hover.u[0] - 1.413) < 5e-4
    assert abs(hover.x[NEWTONIAN.state_index("omega_v")] - 196.3) < 0.05
    assert abs(hover.quantities["thrust_main"] - 0.624) < 5e-4
    assert abs(hover.quantities["current_main"] - 1.01) < 5e-3
    assert not rest.unstable and not hover.unstable
    yaws = {0.2: 0.10, 0.5: 0.50, 1.0: 1.56, -0.5: -0.85}
    proofs = proofs_at(prover_of(NEWTONIAN, "u_h", {"alpha_v": 0.0}), yaws)
    row = NEWTONIAN.state_index("alpha_h")
    for proof, yaw in zip(proofs, yaws.values(), strict=True):
        assert proof.count == 1
        assert abs(proof.enclosed[0].x.middle[row] - yaw) < 6e-3
        assert abs(proof.enclosed[0].u.middle[0] - 1.413) < 5e-4


def test_curves_over_u_v_agree_with_proofs_up_to_the_fold_where_gravity_is_exhausted() -> None:
    over_u_v = surveyed(NEWTONIAN, "u_v", 11, whole=True)
    assert all(check.agree and check.proof.complete for check in over_u_v.checks)
    assert over_u_v.late == 0
    by_input = {round(check.input, 6): check.proof.count for check in over_u_v.checks}
    assert by_input[2.0] == 2 and by_input[1.0] == 1 and by_input[2.5] == 0
    # The range is proved but for slivers around its changes.
    pieces = over_u_v.pieces
    untold = sum(piece.upper - piece.lower for piece in pieces if piece.count is None)
    assert 0.0 < untold < 0.01
    assert (pieces[0].lower, pieces[-1].upper) == (-2.5, 2.5)
    assert max(p.upper for p in pieces if p.count == 2) <= analytic_fold()
    assert min(p.lower for p in pieces if p.count == 0 and p.lower > 0) >= analytic_fold()
    assert [p.count for p in pieces if p.count is not None] == [0, 1, 2, 0]
    (fold,) = [one for one in over_u_v.landmarks if one.kind == "fold"]
    assert abs(fold.y[-1] - 2.23) < 5e-3
    assert abs(fold.y[-1] - analytic_fold()) < 1e-8
    slopes, _ = VectorField(NEWTONIAN).linearised(fold.at.x, fold.at.u)
    assert np.abs(np.linalg.eigvals(slopes)).min() < 1e-6
    # The upper branch is unstable and the lower is not.
    row = NEWTONIAN.state_index("alpha_v")
    for curve in over_u_v.curves:
        for point in curve.points:
            if abs(point.x[row] - 0.9514) > 1e-3:
                assert (point.unstable > 0) == (point.x[row] > 0.9514)
    # A curve that the search misses is found by the proof, and many starts lead to the same.
    proofs = [check.proof for check in over_u_v.checks if abs(check.input) < 0.1]
    curves, late = complete_curves(over_u_v.equations, [], proofs)
    assert late == len(curves) == 1
    seeds = over_u_v.equations.starts(np.linspace(-2.0, 2.1, 4), 4)
    assert len(seeds) >= 4
    assert len(over_u_v.equations.curves_through(seeds)) == 1


@settings(max_examples=8, deadline=None)
@given(st.floats(-2.4, 2.4), st.floats(1e-5, 0.02))
def test_a_number_over_an_interval_is_never_wrong(centre: float, width: float) -> None:
    prover, index = SHARED
    lower = np.zeros((1, len(prover.system.knowns)))
    upper = lower.copy()
    lower[0, index], upper[0, index] = centre - width, centre + width
    (count,) = prover.counts(lower, upper)
    if count is not None:
        for u in (centre - width, centre, centre + width):
            assert count == len(resting(u)[1])


SHARED = prover_of(NEWTONIAN, "u_v")


def test_main_reaction_on_yaw_asks_for_the_tail_rotor() -> None:
    drag = NEWTONIAN.parameters["k_tvp"].value
    reaction = RotorReaction(rotor="main", drag=drag, inertia=0.0)
    model = ExtendedModel(NEWTONIAN, "reaction", reaction)
    found = surveyed(model, "u_h")
    (balanced,) = [one for one in found.landmarks if one.kind == "level"]
    assert abs(balanced.y[-1] + 0.776) < 5e-4
    (idle,) = [one for one in found.landmarks if one.kind == "zero"]
    assert abs(idle.at.x[model.state_index("alpha_h")] - 1.23) < 5e-3
    hover = next(point for point in named_points(model, {})[0] if point.name == "hover")
    assert abs(hover.u[1] + 0.776) < 5e-4


def test_each_change_of_stability_is_told_and_no_fold_moves_with_what_pitch_does_not_know() -> None:
    drag = RotorReaction(rotor="main", drag=1.5e-7, inertia=0.0)
    found = surveyed(ExtendedModel(NEWTONIAN, "reaction", drag), "u_v", 3)
    (curve,) = found.curves
    changes = np.flatnonzero(np.diff([point.unstable for point in curve.points]))
    told = [one for one in curve.landmarks if one.kind in ("fold", "oscillation", "exchange")]
    assert len(told) == len(changes) == 3
    for one in told:
        rightmost = one.at.eigenvalues[np.argsort(np.abs(one.at.eigenvalues.real))[0]]
        assert abs(rightmost.real) < 1e-6
    drift = Disturbance(axis="yaw", torque=0.005, time=1.0)
    found = surveyed(ExtendedModel(NEWTONIAN, "drift", drift), "u_v", 3)
    (fold,) = [one for one in found.landmarks if one.kind == "fold"]
    assert abs(fold.y[-1] - analytic_fold()) < 1e-8


def test_changes_of_stability_on_the_switch_are_those_of_the_local_study() -> None:
    model = Newtonian(parameter_set="rahideh")
    found = surveyed(model, "u_v")
    kinds = [one.kind for one in found.landmarks]
    angles = [one.at.x[5] for one in found.landmarks if one.kind == "oscillation"]
    local = Local(over="alpha_v").run(Subject(model, "rahideh"), silent).results["crossings"]
    pairs = [one for one in local if one["frequency_rad_s"] > 1e-6]
    assert len(pairs) == 2  # 0.3468 rad, and 0.9522 rad just beyond the fold
    for one in pairs:
        assert min(abs(angle - one["value"]) for angle in angles) < 1e-6
    assert kinds[-2:] == ["fold", "oscillation"]
    growing = {p.unstable for p in found.curves[0].points if p.u[0] > 1.0 or p.x[5] > 0.5}
    assert {0, 2, 1} <= growing <= {0, 2, 3, 1}


def test_equations_solved_one_by_one_are_the_models_own() -> None:
    for model in (NEWTONIAN, Newtonian(currents="dynamic"), Lagrangian(), Tras()):
        system = rest_system(model, {"u_v"})
        assert [len(block.rows) for block in system.blocks] == [1] * system.n
        field, limit = VectorField(model), model.input_limits["u_v"]
        proofs = proofs_at(prover_of(model, "u_v"), [-0.52 * limit, 0.0, 0.42 * limit])
        for one in (one for proof in proofs for one in proof.proved):
            rates = field.rates(one.x.middle, one.u.middle)
            steepest = np.abs(field.linearised(one.x.middle, one.u.middle)[0]).max()
            assert np.abs(rates).max() < 1e-9 * max(1.0, steepest)


def test_a_yaw_that_nothing_pulls_back_is_free_marginal_and_its_input_follows() -> None:
    system = rest_system(Tras(), {"u_v"})
    assert (system.free, system.released) == (("alpha_h",), ("u_h",))
    found = surveyed(Tras(), "u_v", 3)
    at_zero = found.checks[1]
    # The tail rotor's thrust ω|ω| has no slope at zero: one is there, not proved to be the only.
    assert at_zero.proof.count is None
    assert [one.exists for one in at_zero.proof.undecided] == [True]
    assert at_zero.agree and len(at_zero.points) == 1
    found = asked(Tras(), over=("u_v",))
    assert "(marginal)" in found.lead[0] and "(stable)" not in " ".join(found.lead)
    assert {point["verdict"] for point in found.results["named"]} == {"marginal"}


def test_a_dead_zone_is_part_of_rest_and_a_curve_goes_around_its_corners() -> None:
    model = ExtendedModel(NEWTONIAN, "dead", DeadZone(rotor="main", width=0.2))
    both = proofs_at(prover_of(model, "u_v"), [0.19, 1.2]), proofs_at(SHARED, [0.0, 1.0])
    for one, other in zip(*both, strict=True):
        np.testing.assert_allclose(one.enclosed[0].x.middle, other.enclosed[0].x.middle, atol=1e-9)
    # It leaves no rounding in hover.
    hover = asked(model, over=("u_v",)).results["named"][1]
    assert hover["inputs"]["u_h"] == 0.0
    assert abs(hover["quantities"]["current_tail"]) < 1e-12
    # A curve goes around its corners.
    model = ExtendedModel(NEWTONIAN, "dead", DeadZone(rotor="tail", width=0.1))
    found = surveyed(model, "u_h", 9)
    assert all(check.agree and check.proof.complete for check in found.checks)
    assert found.late == 0 and len(found.curves) == 1
    assert not [one for one in found.landmarks if one.kind == "level"]


def test_coulomb_friction_holds_a_band_and_that_of_the_makers_model_its_free_yaw() -> None:
    torque = 0.01
    model = ExtendedModel(NEWTONIAN, "friction", CoulombFriction(axis="pitch", torque=torque))
    rest = named_points(model, {})[0][0]
    (band,) = rest.bands
    half = np.arcsin(torque / WEIGHT)
    assert abs(band.torque - torque) < 1e-7
    assert band.lower is not None and band.upper is not None
    np.testing.assert_allclose([band.lower, band.upper], [-TILT - half, -TILT + half], atol=1e-6)
    assert named_points(NEWTONIAN, {})[0][0].bands == ()
    points, missing = named_points(FeedbackManual(), {})
    assert [point.name for point in points] == ["rest"] and "hover" in missing[0]
    yaw = next(band for band in points[0].bands if band.axis == "yaw")
    assert yaw.lower is None and yaw.command is not None
    assert yaw.command[0] == "u_h" and yaw.command[1] < 0.0 < yaw.command[2]


def test_settings_hold_the_pitch_over_the_tail_rotor_and_slivers_are_told_as_unknown() -> None:
    assert setting_of(NEWTONIAN, "u_h", (-1.0, 1.0), {}) == SurveySetting(
        "u_h", (-1.0, 1.0), {}, {"alpha_v": 0.0}
    )
    given_ = setting_of(NEWTONIAN, "u_h", (-1.0, 1.0), {"u_v": 1.0})
    assert (given_.inputs, given_.held_angles) == ({"u_v": 1.0}, {})
    prover, index = SHARED
    pieces = over_range(prover, np.zeros(len(prover.system.knowns)), index, (2.0, 2.4), 0.4)
    assert any(piece.count is None for piece in pieces)


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


def test_roots_on_borders_outside_at_kinks_and_double_ones() -> None:
    found = solved(Z * (Z**2 + 1), Z, (-4.0, 4.0))
    assert found.unique.tolist() == [True]
    assert found.box.contains(0.0).all()
    assert len(solved(Z**2 + 0.01, Z, (-2.0, 2.0)).owner) == 0  # nothing where there is nothing
    # Outside the box, and on its edge.
    assert len(solved(Z - 2.05, Z, (-2.0, 2.0)).owner) == 0
    assert solved(Z - 2.0, Z, (-2.0, 2.0)).unique.tolist() in ([True], [False])
    # A kink has the slopes of both sides.
    found = solved(ca.if_else(Z >= 0, 1.0, 5.0) * Z + 0.5, Z, (-2.0, 2.0))
    assert found.unique.tolist() == [True]
    np.testing.assert_allclose(found.box.middle, [[-0.1]], atol=1e-12)
    # A double root is not called one root.
    found = solved(Z**2 * (Z - 1), Z, (-2.0, 2.0))
    assert found.unique.tolist() == [False, True]
    assert abs(found.box.middle[0, 0]) < 1e-6
    assert not found.exists[0]
    thrust = solved(Z * ca.fabs(Z), Z, (-2.0, 2.0))  # at zero it exists, and is not proved unique
    assert thrust.exists.tolist() == [True] and thrust.unique.tolist() == [False]


def test_two_unknowns_no_bounds_at_all_and_what_is_given_as_an_interval() -> None:
    # A circle and a line have two roots, and a tangent is left undecided.
    circle = ZZ[0] ** 2 + ZZ[1] ** 2 - 1
    found = solved(ca.vertcat(circle, ZZ[0] - ZZ[1] * 2), ZZ, (-2.0, 2.0))
    assert found.unique.tolist() == [True, True]
    reached = np.sort(found.box.middle[:, 1])
    np.testing.assert_allclose(reached, [-1 / np.sqrt(5), 1 / np.sqrt(5)], rtol=1e-9)
    found = solved(ca.vertcat(circle, ZZ[0] - 1), ZZ, (-2.0, 2.0))
    assert len(found.owner) >= 1
    assert not found.unique.any()
    np.testing.assert_allclose(found.box.middle[0], [1.0, 0.0], atol=1e-4)
    # Without bounds.
    far = solved(Z * ca.fabs(Z) + Z - 1e8, Z, (-np.inf, np.inf))
    assert far.unique.tolist() == [True] and not far.open_ended
    assert abs(far.box.middle[0, 0] - 9999.5) < 0.1
    beyond = solved(Z - 1e7, Z, (-np.inf, np.inf))
    assert len(beyond.owner) == 0 and beyond.open_ended
    given_ = Interval.of([[0.9], [-0.1], [-2.0]], [[1.1], [0.1], [-1.0]])
    found = solved(Z**2 - Q, Z, (-3.0, 3.0), given_)
    assert found.owner[found.unique].tolist() == [0, 0]
    np.testing.assert_allclose(found.box.upper[1, 0], np.sqrt(1.1), rtol=0.02)
    assert found.box.lower[1, 0] <= np.sqrt(0.9) <= np.sqrt(1.1) <= found.box.upper[1, 0]
    assert 1 in found.owner and not found.unique[found.owner == 1].any()
    assert 2 not in found.owner


def test_the_study_of_both_commands_as_figures_and_as_json() -> None:
    found = asked(NEWTONIAN, map=True)
    charts = {chart.name: chart for chart in found.charts}
    assert list(charts) == ["equilibria_u_v", "equilibria_u_h", "equilibria_map"]
    drawn = as_data(charts["equilibria_u_v"])
    assert [panel["y"]["label"] for panel in drawn["panels"]] == ["α_v", "ω_v"]
    labels = {mark.get("label") for mark in drawn["panels"][0]["marks"]}
    assert {"stable", "unstable", "proved", "fold", "stop"} <= labels
    notes = {m.text: m for m in charts["equilibria_u_v"].panels[0].marks if isinstance(m, Note)}
    assert notes["hover"].x > 1.413 and notes["hover"].y < -0.1  # beneath a curve that rises
    results = json.loads(json.dumps(found.results, allow_nan=False))
    survey = results["surveys"][0]
    assert survey["over"] == "u_v" and len(survey["proofs"]) == 5
    assert all(proof["complete"] and proof["agrees_with_curves"] for proof in survey["proofs"])
    fold = next(one for one in survey["landmarks"] if one["kind"] == "fold")
    assert abs(fold["input"] - 2.2272) < 1e-4
    assert [point["name"] for point in results["named"]] == ["rest", "hover"]
    (warning,) = set(found.warnings)
    assert "mean of both" in warning and "α_h = 0" in warning
    curve = survey["curves"][0]
    assert len(curve["states"]["alpha_v"]) == len(curve["growing"]) == len(curve["inputs"]["u_v"])


def test_special_points_and_ranges_of_ones_own_and_rest_and_hover_outside_the_box() -> None:
    found = asked(
        Newtonian(freedom="vertical"),
        special={"nose up": {"alpha_v": 0.4}},
        range={"u_v": (0.0, 2.3)},
        box={"alpha_v": (-0.7, 1.0)},
    )
    named = {point["name"]: point for point in found.results["named"]}
    assert abs(named["nose up"]["states"]["alpha_v"] - 0.4) < 1e-9
    survey = found.results["surveys"][0]
    assert survey["range"] == [0.0, 2.3]
    assert survey["box"]["alpha_v"] == [-0.7, 1.0]
    assert survey["curves"][0]["ends"] == ["end of the range", "alpha_v = 1 rad"]
    found = asked(NEWTONIAN, box={"alpha_v": (2.0, 3.0)})
    assert not found.results["named"]
    told = " ".join(found.warnings)
    assert "rest lies outside the box" in told and "hover lies outside the box" in told
    assert "held at α_v = 0 rad, outside the box" in told


def test_a_beam_driven_by_its_rotors_speeds_and_an_upright_one_in_the_box() -> None:
    model = DrivenModel(NEWTONIAN, ("omega_v", "omega_h"))
    with pytest.raises(ModelError, match="have no limits"):
        asked(model)
    found = asked(model, over=("omega_v",), range={"omega_v": (0.0, 300.0)})
    fold = next(one for one in found.results["surveys"][0]["landmarks"] if one["kind"] == "fold")
    assert abs(fold["input"] - 257.654) < 1e-2
    with pytest.raises(ModelError, match="may be singular"):
        asked(Lagrangian(), box={"alpha_v": (-1.6, 1e9)}, over=("u_v",))
    with pytest.raises(ModelError, match="beam upright") as refused:
        asked(QuanserAero(), box={"alpha_v": (-3.0, 3.0)})
    assert refused.value.where == "study.box.alpha_v"


@pytest.mark.parametrize(
    ("keys", "where"),
    [
        ({"over": ("u_x",)}, "study.over"),
        ({"over": ()}, "study.over"),
        ({"range": {"u_v": (1.0, 1.0)}}, "study.range.u_v"),
        ({"range": {"uv": (0.0, 1.0)}}, "study.range"),
        ({"at": {"alpha_h": 0.0}}, "study.at"),
        ({"box": {"alpha_h": (-1.0, 1.0)}}, "study.box.alpha_h"),
        ({"at": {"alpha_v": 5.0}}, "study.at.alpha_v"),
        ({"box": {"alpha_v": (1.0, -1.0)}}, "study.box.alpha_v"),
        ({"special": {"far": {"alpha_v": 2.0}}}, "study.special.far"),
    ],
)
def test_what_makes_no_sense_is_refused(keys: dict[str, object], where: str) -> None:
    with pytest.raises(TrmsError) as refused:
        asked(Newtonian(freedom="vertical"), **keys)
    assert refused.value.where == where
    assert refused.value.remedy
