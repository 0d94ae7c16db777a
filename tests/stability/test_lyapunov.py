"""study=lyapunov: what it claims holds, what does not hold is shown, and bad requests are told; the
table of docs/stability-lyapunov.md is what the program finds.

Bounds that the proofs rest on: they hold, and the levels they give are right where known. V̇ derived
by sympy from the equations as docs/model.md states them, in all parameters and states, for one
direction of each rotor and of the cable; the forms are then compared with CasADi's V̇ along the
models' own equations.
"""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.core.findings import Findings
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.inflow import Inflow
from trms_cli.effects.sensor_bias import SensorBias
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import operating_point
from trms_cli.models.tras import Tras
from trms_cli.models.twin_rotor import TwinRotor
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.intervals.interval import Interval
from trms_cli.stability.lyapunov.candidate import (
    EnergyCandidate,
    decay_level,
    definite,
    rays,
    stop_level,
    wells_of,
)
from trms_cli.stability.lyapunov.certificate import (
    LyapunovCertificate,
    StabilityClaim,
    certify,
    identity_residual,
    motions,
    on_level,
    rig_of,
)
from trms_cli.stability.lyapunov.energy import Energy, EnergyWeights
from trms_cli.stability.studies.lyapunov import Lyapunov, data, lead
from trms_cli.stability.study import silent
from trms_cli.stability.subject import Subject

#: Enough for the claims; the study itself takes more boxes.
BUDGET = 600
MODELS = {
    "horizontal": lambda: Newtonian(freedom="horizontal"),
    "vertical": lambda: Newtonian(freedom="vertical"),
    "newtonian": lambda: Newtonian(),
    "lagrangian": lambda: Lagrangian(),
    "rahideh": lambda: Newtonian(parameter_set="rahideh"),
}


@cache
def certificate_of(
    name: str, at: tuple[tuple[str, float], ...], function: str = "auto", budget: int = BUDGET
) -> LyapunovCertificate:
    rig = rig_of(Subject(MODELS[name](), name))
    point = operating_point(rig.model, dict(at))
    return certify(rig, point, function, budget, 0, silent)


def run(model: Model, **options: object) -> Findings:
    study = Lyapunov(**({"budget": BUDGET, "starts": 3, "duration": 5.0} | options))  # type: ignore[arg-type]
    return study.run(Subject(model, "model"), silent)


HOVER = (("alpha_v", 0.0),)
VERTICAL = Newtonian(freedom="vertical")


def test_horizontal_is_globally_stable_and_the_vertical_well_ends_at_its_saddle() -> None:
    for yaw in (0.0, 0.3, -0.8):
        found = certificate_of("horizontal", (("alpha_h", yaw),))
        assert found.holds and found.everywhere and math.isinf(found.outer)
        assert found.bounded_by.startswith("the stop alpha_h")
    found = certificate_of("vertical", HOVER)
    assert found.holds and not found.everywhere
    # docs/model.md: G sin(α + 0.6194) = l_m F, so that the other side of the crest is α_s.
    below, above = found.search.wells.saddles or (0.0, 0.0)
    assert above == pytest.approx(math.pi - 2 * 0.6194, abs=2e-4)
    assert below == pytest.approx(-math.pi - 2 * 0.6194, abs=2e-4)
    G, tilt = 0.2646, 0.6194
    barrier = G * (2 * math.cos(tilt)) - G * math.sin(tilt) * (above - 0.0)
    assert found.outer == pytest.approx(barrier, rel=1e-3)
    # The set within the stops ends where the well is as high as at the nearer stop.
    at_stop = G * (math.cos(tilt) - math.cos(1.05 + tilt) - math.sin(tilt) * 1.05)
    assert found.inner == pytest.approx(0.999 * at_stop, rel=1e-3)
    assert found.bounded_by == "the stop alpha_v = 1.05 rad"
    # A hanging beam's well is as deep as it is high.
    assert certificate_of("vertical", ()).outer == pytest.approx(2 * G, rel=1e-3)


def test_thesis_values_fail_at_a_high_pitch_and_the_counterexample_is_one() -> None:
    found = certificate_of("rahideh", (("alpha_v", 0.4),))
    assert not found.holds and found.outer == 0.0 and found.rising is not None
    falls = next(claim for claim in found.claims if claim.name == "falls")
    assert falls.how == "failed"
    candidate = found.search.candidate
    # By the model's own equations and differences of V, not by the derivative that was searched.
    field = VectorField(candidate.energy.model)
    rates = field.rates(found.rising.x, candidate.energy.u)
    step = 1e-5
    after, before = (
        candidate.value(candidate.motions(found.rising.x + side * step * rates))[0]
        for side in (1, -1)
    )
    assert (after - before) / (2 * step) == pytest.approx(found.rising.derivative, rel=1e-3)
    assert found.rising.derivative > 0.0


@pytest.mark.parametrize(
    ("name", "at"), [("vertical", HOVER), ("horizontal", (("alpha_h", 0.3),)), ("newtonian", HOVER)]
)
def test_no_motion_leaves_the_inner_set(name: str, at: tuple[tuple[str, float], ...]) -> None:
    found = certificate_of(name, at)
    candidate, wells = found.search.candidate, found.search.wells
    starts = on_level(candidate, wells, found.inner, rays(candidate, 6, 7))
    assert len(starts) >= 5
    assert candidate.value(starts) == pytest.approx(found.inner, rel=1e-6)
    seen = motions(candidate, candidate.energy.model, starts, found.inner, 10.0)
    assert np.all(np.diff(seen.value, axis=0) <= 1e-7 * found.inner)
    assert seen.value.max() <= found.inner * (1.0 + 1e-6)
    angles = seen.y[:, :, 2 * candidate.energy.k :]
    stops = [candidate.energy.model.stops[f"alpha_{a}"] for a in candidate.energy.axes]
    assert np.all(np.abs(angles) <= stops)


def test_v_falls_at_random_states_of_the_outer_set() -> None:
    for name in ("newtonian", "lagrangian", "vertical"):
        found = certificate_of(name, HOVER)
        candidate, wells = found.search.candidate, found.search.wells
        directions = rays(candidate, 150, 2)
        places = [
            on_level(candidate, wells, share * found.outer, directions[i::3])
            for i, share in enumerate((0.1, 0.6, 0.999))
        ]
        y = np.concatenate(places)
        assert np.all(candidate.derivative(candidate.states(y)) < 0.0)


def test_the_findings_carry_sets_claims_and_figures_and_sensors_change_nothing() -> None:
    bias = {"pitch_sensor_bias": SensorBias(axis="pitch", bias=0.1)}
    found, biased = (
        run(model, at={"alpha_v": 0.0}) for model in (VERTICAL, extend_model(VERTICAL, bias))
    )
    assert found.results == biased.results
    data = found.results
    assert data["function"] == "energy" and data["holds"]
    assert data["N"]["level"] > data["N_prime"]["level"] > 0
    low, high = data["N_prime"]["extent"]["alpha_v"]
    assert -1.05 <= low < 0 < high <= 1.05
    assert {c["name"] for c in data["claims"]} >= {"positive", "falls", "kept", "attracts", "seen"}
    drawn = {chart.name for chart in found.charts}
    assert drawn == {"lyapunov_well", "lyapunov_sets", "lyapunov_decay"}
    assert all(real < 0 for real, _ in data["eigenvalues"])


def test_what_an_unstable_point_a_failing_function_and_dry_friction_lead_to() -> None:
    unstable = run(Newtonian(parameter_set="rahideh"), at={"alpha_v": 0.4})
    assert any("No other function" in line for line in unstable.lead)
    assert unstable.results["N"]["level"] == 0.0 and not unstable.results["holds"]
    stable = run(Lagrangian(), at={"alpha_v": 0.0, "alpha_h": 0.3}, function="energy")
    assert any("region_of_attraction" in line for line in stable.lead)
    friction = {"pitch_coulomb_friction": CoulombFriction(axis="pitch", torque=0.002)}
    found = run(extend_model(VERTICAL, friction), at={"alpha_v": 0.0})
    assert found.results["holds"]
    assert "friction holds it" in found.lead[1]
    assert [m.label for m in found.measures] == ["claims that hold", "N: V <", "N′: V ≤"]
    attracts = next(c for c in found.results["claims"] if c["name"] == "attracts")
    assert "F_c" in attracts["detail"]
    with pytest.raises(ConfigurationError, match="strict function"):
        run(extend_model(Newtonian(), friction), at={"alpha_v": 0.0, "alpha_h": 0.3})


INFLOW = {"main_inflow": Inflow(rotor="main", coefficient=0.1)}


@pytest.mark.parametrize(
    ("model", "at", "kind", "words"),
    [
        (Tras(), {}, ModelError, "is not stated here"),
        (Newtonian(currents="dynamic"), {}, ModelError, "quasi-static"),
        (Newtonian(parameters={"k_ov": 0.0}), {}, ModelError, "viscous friction of pitch"),
        (Lagrangian(parameters={"k_chn": 0.0}), {}, ModelError, "yaw rests anywhere"),
        (extend_model(Newtonian(), INFLOW), {}, ModelError, "main_inflow"),
        (VERTICAL, {"alpha_v": 1.0}, ModelError, "crest"),  # a saddle
    ],
)
def test_what_has_no_energy_or_no_stable_rest_is_told(model, at, kind, words) -> None:
    with pytest.raises(kind, match=words):
        run(model, at=at)


@pytest.mark.parametrize("pitch", [0.93, 0.95])
def test_beside_the_fold_the_saddle_ends_the_sets_and_not_a_stop_beyond_it(pitch: float) -> None:
    found = certificate_of("vertical", (("alpha_v", pitch),))
    assert found.holds and found.bounded_by == "the saddle"
    assert 0.0 < found.inner < found.outer
    # G [cos β − cos(β + d) − sin β d] at the crest, β = ᾱ + δ, d = π − 2β.
    gravity = found.search.candidate.energy.gravity
    beta = pitch + math.atan2(-gravity[0], -gravity[1])
    d = math.pi - 2 * beta
    barrier = math.hypot(*gravity) * (2 * math.cos(beta) - math.sin(beta) * d)
    assert found.outer <= barrier
    # The well is taken to end 1e-4 rad before the crest.
    assert found.outer == pytest.approx(barrier, rel=0.02)


def test_the_derivation_is_checked_at_rest_and_a_wrong_one_fails_and_states_map_back() -> None:
    found = certificate_of("vertical", ())
    assert found.holds
    candidate = found.search.candidate
    assert identity_residual(candidate, 0) < 1e-10
    other = candidate.weighted(candidate.weights)
    wrong = replace(candidate.weights, rotor_v=candidate.weights.rotor_v * (1 + 1e-6))
    other.derivative = candidate.weighted(wrong).derivative  # type: ignore[method-assign]
    assert identity_residual(other, 0) > 1e-8
    model = Lagrangian()
    point = operating_point(model, {"alpha_v": 0.1})
    candidate = EnergyCandidate(Energy(model, point.u), point.x, EnergyWeights())
    states = point.x + np.random.default_rng(0).normal(size=(20, 6)) * [30, 1, 1, 30, 1, 1]
    assert np.allclose(candidate.states(candidate.motions(states)), states, atol=1e-10)


def test_the_lead_says_first_what_does_not_hold_and_that_there_is_no_inner_set() -> None:
    sound = certificate_of("vertical", ())
    rig = rig_of(Subject(MODELS["vertical"](), "vertical"))
    point = operating_point(rig.model, {})
    assert "is a Lyapunov function on N" in lead(sound, rig, point, -1.0)[0]
    failed = StabilityClaim("seen", "V falls", "failed", "")
    said = lead(sound, rig, point, -1.0, (failed,))
    assert "not shown" in said[0] and "“V falls” (failed)" in said[0]
    assert not any("no motion leaves" in line for line in said)
    none = replace(sound, inner=0.0, bounded_by="the stop alpha_v = 1.05 rad")
    assert any("There is no N′" in line for line in lead(none, rig, point, -1.0))
    inner = data(none, point, np.array([-1.0 + 0j]), ())["N_prime"]
    assert inner["level"] is None and inner["extent"] is None


PAGE = Path(__file__).parents[2] / "docs" / "stability-lyapunov.md"
LEVEL = {"alpha_v": 0.0}
#: The first cell of each row: the model, where it rests.
ROWS: dict[str, tuple[Any, dict[str, Any], dict[str, float]]] = {
    "horizontal, α_h = 0.3": (Newtonian, {"freedom": "horizontal"}, {"alpha_h": 0.3}),
    "vertical, rest (−0.619)": (Newtonian, {"freedom": "vertical"}, {}),
    "vertical, hover": (Newtonian, {"freedom": "vertical"}, LEVEL),
    "vertical, u_v = 2.2 V": (Newtonian, {"freedom": "vertical"}, {"u_v": 2.2}),
    "Lagrangian, hover": (Lagrangian, {}, LEVEL),
    "Lagrangian, hover, α_h = 0.3": (Lagrangian, {}, {"alpha_v": 0.0, "alpha_h": 0.3}),
    "Lagrangian, `tastemirov`, level": (Lagrangian, {"parameter_set": "tastemirov"}, LEVEL),
    "Newtonian, hover": (Newtonian, {}, LEVEL),
    "Newtonian, rest": (Newtonian, {}, {}),
    "Newtonian, hover, α_h = 0.3": (Newtonian, {}, {"alpha_v": 0.0, "alpha_h": 0.3}),
    "Newtonian, `rahideh`, hover": (Newtonian, {"parameter_set": "rahideh"}, LEVEL),
    "Newtonian, `rahideh`, α_v = 0.4": (Newtonian, {"parameter_set": "rahideh"}, {"alpha_v": 0.4}),
    "Lagrangian, `rahideh`, hover": (Lagrangian, {"parameter_set": "rahideh"}, LEVEL),
}
#: Rows that take more than a second or two.
LONG = ("Newtonian", "Lagrangian")


def rows() -> list[list[str]]:
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("| model, equilibrium"))
    found = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        found.append([cell.strip() for cell in line.strip("|").split("|")])
    return found


def test_every_row_is_known() -> None:
    assert len(rows()) >= 14
    assert {row[0] for row in rows()} == set(ROWS)


@pytest.mark.parametrize(
    "row",
    [
        pytest.param(
            row, id=f"{row[0]} {row[1]}", marks=[pytest.mark.slow] * row[0].startswith(LONG)
        )
        for row in rows()
    ],
)
def test_a_row_is_what_is_found(row: list[str]) -> None:
    kind, options, at = ROWS[row[0]]
    model: TwinRotor = kind(**options)
    function = row[1].split(",")[0]
    rig, point = rig_of(Subject(model, "model")), operating_point(model, at)
    found = certify(rig, point, function, Lyapunov().budget, 0, silent)
    assert (found.search.candidate.weights.strict) == (function == "strict")
    if "γ" in row[1]:
        assert found.search.candidate.weights.yaw == float(row[1].split("=")[1])
    depth, outer, inner = (cell.strip("*") for cell in row[2:5])
    assert found.everywhere == (outer == "all states")
    levels = found.search.wells.depth, found.outer, found.inner
    for cell, value in zip((depth, outer, inner), levels, strict=True):
        if cell == "none":
            assert value == 0.0
        elif cell not in ("–", "all states"):
            digits = len(cell.split(".")[1])
            assert value == pytest.approx(float(cell), abs=0.51 * 10.0**-digits)
    if "state with V̇ > 0 at" in row[5]:
        assert found.rising is not None
        assert found.rising.value == pytest.approx(float(row[5].split(" at ")[1]), rel=0.03)
    for stop in ("stop α_v = −1.05", "stop α_v = 1.05", "stop α_h = −2.8", "stop α_h = 2.8"):
        if stop in row[5]:
            plain = stop.replace("α", "alpha").replace("−", "-")
            assert found.bounded_by == f"the {plain} rad"


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
    values, matrices = candidate.values(boxes), candidate.matrices(boxes)
    slopes = candidate.slopes(boxes)
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
    inside = on_level(candidate, wells, level, rays(candidate, 120, 1))
    assert len(inside) > 80
    assert np.all((inside >= box.lower) & (inside <= box.upper))
    rest = candidate.motions(candidate.x[None])[0]
    assert np.all(candidate.rest.contains(rest) | (np.abs(rest) < 1e-9))
    assert candidate.rest.width.max() < 1e-6


def disc(boxes: Interval) -> Interval:
    """V = y1² + y2²."""
    squares = boxes.square()
    return squares[:, 0] + squares[:, 1]


def diagonal(boxes: Interval) -> Interval:
    """Q = [[1, y1], [y1, 1]]: definite where |y1| < 1."""
    swap = np.array([[0.0, 1.0], [1.0, 0.0]])
    lower, upper = (np.eye(2) + y[:, :1, None] * swap for y in (boxes.lower, boxes.upper))
    return Interval(lower, upper)


def test_the_level_up_to_which_a_matrix_is_definite_is_found_between_bounds() -> None:
    box = Interval.of([-3.0, -3.0], [3.0, 3.0])
    found = decay_level(diagonal, disc, box, 9.0, 20_000)
    assert 0.95 < found.level <= 1.0 <= found.fails < 1.05
    assert found.point is not None and abs(found.point[0]) >= 1.0
    # Little budget proves less; a level below that is proved all over.
    assert 0.0 <= decay_level(diagonal, disc, box, 9.0, 20).level < 0.95
    inner = Interval.of([-0.9, -0.9], [0.9, 0.9])
    found = decay_level(diagonal, disc, inner, 0.81, 20_000)
    assert found.level == np.inf and found.fails == np.inf and found.point is None


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


k_oh, k_ov, k_c, l_t, l_m, k_m, k_t, k_g = sp.symbols("k_oh k_ov k_c l_t l_m k_m k_t k_g")
J_v, D, E, F, H, G, delta = sp.symbols("J_v D E F H G delta", positive=True)
c_h, c_v, gamma, e_h, e_v = sp.symbols("c_h c_v gamma e_h e_v")
w_h, S_h, a_h, w_v, S_v, a_v = sp.symbols("w_h S_h a_h w_v S_v a_v", real=True)
b_h, b_v, d_h, d_v, f_h, f_v, W_h, W_v, A_h, A_v = sp.symbols(
    "b_h b_v d_h d_v f_h f_v W_h W_v A_h A_v", real=True
)


def settling(w: sp.Expr, b: sp.Expr, d: sp.Expr, rest: sp.Expr) -> sp.Expr:
    """s of a rotor that turns forwards, with its drive written by the speed at rest."""
    return b * w + d * w**2 - (b * rest + d * rest**2)


def stored(w: sp.Expr, b: sp.Expr, d: sp.Expr, rest: sp.Expr) -> sp.Expr:
    t = sp.Symbol("t")
    return sp.integrate(settling(t, b, d, rest), (t, rest, w))


s_h, s_v = settling(w_h, b_h, d_h, W_h), settling(w_v, b_v, d_v, W_v)
F_h, F_v = f_h * w_h**2, f_v * w_v**2
F_h0, F_v0 = f_h * W_h**2, f_v * W_v**2


def along(V: sp.Expr, rates: dict[sp.Symbol, sp.Expr]) -> sp.Expr:
    return sum((sp.diff(V, x) * rate for x, rate in rates.items()), sp.Integer(0))


def vanishes(expression: sp.Expr) -> bool:
    """Whether it is zero for all values, with sin² + cos² = 1 as the only relation."""
    c, s, C0 = sp.symbols("c s C0")
    plain = sp.expand_trig(expression)
    plain = plain.subs({sp.cos(a_v): c, sp.sin(a_v): s, sp.cos(A_v): C0})
    assert not plain.has(sp.cos) and not plain.has(sp.sin)
    numerator, _ = sp.fraction(sp.together(plain))
    _, rest = sp.reduced(sp.expand(numerator), [s**2 + c**2 - 1], s, c)
    return bool(sp.expand(rest) == 0)


def test_the_energy_of_one_axis_falls_by_friction_and_the_lacking_thrust() -> None:
    J = sp.Symbol("J", positive=True)
    thrust = k_c * A_h / (l_t * W_h**2)  # the balance at the equilibrium: l_t F̄ = k_c ᾱ
    V = J * S_h**2 / 2 + k_c * (a_h - A_h) ** 2 / 2 + c_h * stored(w_h, b_h, d_h, W_h)
    moment = l_t * F_h - k_oh * S_h - k_c * a_h
    rates = {w_h: -s_h, S_h: moment / J, a_h: S_h}
    claimed = -k_oh * S_h**2 + l_t * (F_h - F_h0) * S_h - c_h * s_h**2
    assert sp.simplify((along(V, rates) - claimed).subs(f_h, thrust)) == 0
    # The vertical axis, with gravity in place of the cable.
    U = G * (sp.cos(A_v + delta) - sp.cos(a_v + delta) - sp.sin(A_v + delta) * (a_v - A_v))
    V = J_v * S_v**2 / 2 + U + c_v * stored(w_v, b_v, d_v, W_v)
    moment = l_m * (F_v - F_v0) + G * sp.sin(A_v + delta) - G * sp.sin(a_v + delta) - k_ov * S_v
    rates = {w_v: -s_v, S_v: moment / J_v, a_v: S_v}
    claimed = -k_ov * S_v**2 + l_m * (F_v - F_v0) * S_v - c_v * s_v**2
    assert sp.simplify(along(V, rates) - claimed) == 0


def test_the_square_is_complete_and_lacking_thrust_is_bounded_by_settling() -> None:
    """With F − F̄ = ψ s: V̇ = −(√k Ω − l ψ s / 2√k)² − (c − (l ψ)²/4k) s²."""
    k, level, psi, s, rate, c = sp.symbols("k l psi s Omega c", positive=True)
    form = -k * rate**2 + level * psi * s * rate - c * s**2
    square = -((sp.sqrt(k) * rate - level * psi * s / (2 * sp.sqrt(k))) ** 2)
    assert sp.simplify(form - square + (c - (level * psi) ** 2 / (4 * k)) * s**2) == 0
    # F'/s' = 2 k_f ω/(b + 2 d ω) rises to k_f/d and never reaches it.
    w, b, d, f = sp.symbols("w b d f", positive=True)
    ratio = sp.diff(f * w**2, w) / sp.diff(b * w + d * w**2, w)
    assert sp.simplify(f / d - ratio - f * b / (d * (b + 2 * d * w))) == 0
    assert sp.limit(ratio, w, sp.oo) == f / d


#: Inertia of yaw, and the rates of the angles.
J = D * sp.cos(a_v) ** 2 + E * sp.sin(a_v) ** 2 + F
O_h, O_v = S_h + k_m * w_v * sp.cos(a_v) / J, S_v + k_t * w_h / J_v


def newtonian() -> tuple[sp.Expr, sp.Expr]:
    """V̇ derived and as it is claimed, with cross terms, of the Newtonian model."""
    x_h, x_v = a_h - A_h, a_v - A_v
    # Restoring moments: any functions of their own angle, U' = g(α) − g(ᾱ).
    g_v, U_v = sp.Symbol("g_v"), sp.Function("U_v")(a_v)
    tilt = k_c * A_h  # = l_t F̄_h cos ᾱ_v at the equilibrium
    kinetic = gamma * J * O_h**2 / 2 + J_v * O_v**2 / 2
    wells = gamma * k_c * x_h**2 / 2 + U_v
    crossed = gamma * e_h * x_h * J * O_h + e_v * x_v * J_v * O_v
    held = gamma * e_h * k_oh * x_h**2 / 2 + e_v * k_ov * x_v**2 / 2
    rotors = c_h * stored(w_h, b_h, d_h, W_h) + c_v * stored(w_v, b_v, d_v, W_v)
    V = kinetic + wells + crossed + held + rotors
    swing = -H * O_h**2 * sp.sin(2 * a_v) / 2
    pitch = l_m * (F_v - F_v0) - g_v + k_g * F_v * O_h * sp.cos(a_v) - k_ov * O_v + swing
    yaw = l_t * F_h * sp.cos(a_v) - l_t * F_h0 * sp.cos(A_v) + tilt - k_oh * O_h - k_c * a_h
    rates = {w_h: -s_h, S_h: yaw / J, a_h: O_h, w_v: -s_v, S_v: pitch / J_v, a_v: O_v}
    turning = k_m * w_v * sp.diff(sp.cos(a_v) / J, a_v) * J
    J_slope = sp.diff(J, a_v)
    lack_h = l_t * (F_h - F_h0) * sp.cos(a_v) - k_m * sp.cos(a_v) * s_v
    lack_v = l_m * (F_v - F_v0) - k_t * s_h
    bent = l_t * F_h0 * (sp.cos(a_v) - sp.cos(A_v))
    cross = k_g * F_v * sp.cos(a_v)
    spent = -gamma * k_oh * O_h**2 - k_ov * O_v**2 - c_h * s_h**2 - c_v * s_v**2
    lacking = gamma * lack_h * O_h + lack_v * O_v + gamma * bent * O_h
    moving = (gamma * turning + cross) * O_h * O_v
    moving += (gamma * J_slope - H * sp.sin(2 * a_v)) * O_h**2 * O_v / 2
    # the cross terms
    rates_of = gamma * e_h * J * O_h**2 + e_v * J_v * O_v**2
    yaw_of = -k_c * x_h + bent + lack_h + (turning + J_slope * O_h) * O_v
    pitch_of = -g_v + lack_v + (cross - H * sp.sin(2 * a_v) * O_h / 2) * O_h
    claimed = spent + lacking + moving + rates_of
    claimed += gamma * e_h * x_h * yaw_of + e_v * x_v * pitch_of
    V_slope = {sp.Derivative(U_v, a_v): g_v}
    return along(V, rates).subs(V_slope), claimed


def test_two_axes_newtonian_with_cross_terms_of_which_one_does_not_cancel() -> None:
    derived, claimed = newtonian()
    assert vanishes(derived - claimed)
    # What is left over, ½ (E − D − H) sin 2α Ω_h² Ω_v, is all that H does; it would be gone with
    # H = D − E and the moment −J_h' Ω_v Ω_h, which that model lacks.
    left = (E - D - H) * sp.sin(2 * a_v) * O_h**2 * O_v / 2
    energy = claimed.subs({gamma: 1, e_h: 0, e_v: 0})
    assert vanishes(sp.diff(energy - left, H))
    assert not vanishes(left.subs(H, D - E))
    power_of_what_lacks = -sp.diff(J, a_v) * O_v * O_h * O_h
    assert vanishes(left.subs(H, D - E) + power_of_what_lacks)


FORMS: list[Any] = [
    pytest.param(kind, freedom, at, weights, id=f"{kind.__name__}-{freedom}-{name}")
    for kind in (Newtonian, Lagrangian)
    for freedom, at in (
        ("horizontal", {"alpha_h": 0.3}),
        ("vertical", {"alpha_v": -0.2}),
        ("both", {"alpha_v": 0.1, "alpha_h": -0.4}),
    )
    for name, weights in (
        ("energy", EnergyWeights(2e-3, 1e-3)),
        ("strict", EnergyWeights(2e-3, 1e-3, 1.0, 0.05, 0.03)),
    )
]


@pytest.mark.parametrize(("kind", "freedom", "at", "weights"), FORMS)
def test_the_form_is_the_derivative_along_the_models_own_equations(kind, freedom, at, weights):
    parameters = "bench" if kind is Newtonian else "tastemirov"
    model = kind(freedom=freedom, parameter_set=parameters)
    point = operating_point(model, at)
    candidate = EnergyCandidate(Energy(model, point.u), point.x, weights)
    assert identity_residual(candidate, seed=3, states=60) < 1e-8


def test_a_saturated_interface_is_part_of_the_rotor_and_yaw_may_be_weighed() -> None:
    model = Newtonian(main_voltage_limit=8.0)
    point = operating_point(model, {"u_v": 1.4})
    assert point.x[model.state_index("alpha_v")] < -0.2  # 8 V of the 11.9 V asked for
    candidate = EnergyCandidate(Energy(model, point.u), point.x, EnergyWeights(2e-3, 1e-3))
    assert identity_residual(candidate, seed=3, states=60) < 1e-8
    model = Newtonian()
    point = operating_point(model, {"alpha_v": 0.2})
    energy = Energy(model, point.u)
    assert energy.weighted and not Energy(Lagrangian(), point.u).weighted
    candidate = EnergyCandidate(energy, point.x, EnergyWeights(2e-3, 1e-3, 3.0, 0.05, 0.03))
    assert identity_residual(candidate, seed=3, states=60) < 1e-8
