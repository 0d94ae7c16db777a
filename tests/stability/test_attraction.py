"""Regions of attraction: what is called proved must hold, and known regions must come out; the
study as the command line asks for it.
"""

import json
import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from trms_cli.composition.composer import compose
from trms_cli.core.chart import as_data
from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.library.tasks import stability as request
from trms_cli.models.feedback_manual import FeedbackManual
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import operating_point
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.attraction.estimates import (
    Ellipsoid,
    estimates,
    from_lyapunov_equation,
    is_proved_attracted,
    largest_level,
    methods_for,
    optimise_ellipsoid,
)
from trms_cli.stability.attraction.level_set import (
    Rays,
    basis_of,
    proved_level,
    quadratic,
    sampled_level,
)
from trms_cli.stability.attraction.loop_region import LinearLawLoop, linear_law
from trms_cli.stability.attraction.region import SETTLED, ConfidenceShare, failures, fates, share_of
from trms_cli.stability.attraction.system import around, require_attractive
from trms_cli.stability.closed_loop import run_loop
from trms_cli.stability.intervals.interval import Interval, corners, decays, positive_definite
from trms_cli.stability.studies.region_of_attraction import percent
from trms_cli.stability.study import silent

from .planar_systems import Planar, at_origin, bent, reversed_van_der_pol

#: Without `integrals`: the rates of van der Pol are straight along the axes.
METHODS = ("lyapunov", "inclusion", "level_set", "quartic")


@pytest.fixture(scope="module")
def van_der_pol():
    model = reversed_van_der_pol()
    return around(model, at_origin(model))


@pytest.fixture(scope="module")
def found(van_der_pol):
    limits = np.array([3.0, 3.0])
    return estimates(van_der_pol, limits, METHODS, 20_000, silent)


def test_estimates_of_van_der_pol_cover_as_much_of_its_cycle_as_is_known(found, van_der_pol):
    from matplotlib.path import Path

    def forwards(t, x):
        return [x[1], -x[0] - (x[0] ** 2 - 1.0) * x[1]]

    # The limit cycle in reversed time, as a polygon.
    path = solve_ivp(forwards, (0.0, 60.0), [2.0, 0.0], rtol=1e-9, atol=1e-10, max_step=0.01)
    x, y = rim = path.y[:, path.t > 60.0 - 6.66328686]
    whole = 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))
    region = Path(rim.T)
    assert tuple(e.method for e in found) == METHODS
    for estimate in found:
        assert estimate.proved
        y = estimate.draw(2000, 0)
        assert len(y) == 2000
        assert region.contains_points(y).all(), estimate.method
    covered = {e.method: math.exp(e.log_volume) / whole for e in found}
    # The best quadratic is known to cover less than the polynomials of higher degree do.
    assert covered["lyapunov"] <= covered["inclusion"] * 1.001
    assert 0.3 < covered["level_set"] < covered["quartic"] < 1.0
    assert covered["quartic"] > 0.7
    # The simulated region is the true one.
    largest = max(found, key=lambda e: e.log_volume)
    box = np.array([3.0, 3.0])
    starts = np.random.default_rng(0).uniform(-1.0, 1.0, (1000, 2)) * box
    fate, _ = fates(van_der_pol, starts, largest.contains, 60.0, 4.0 * box)
    share = share_of(int((fate == SETTLED).sum()), 1000)
    assert share.lower < whole / 36.0 < share.upper


def test_a_wrong_estimate_is_caught_and_a_short_time_no_failure_of_a_right_one(van_der_pol, found):
    right = next(e for e in found if e.method == "level_set")
    wrong = replace(right, level=3.0 * right.level, frame=2.0 * right.frame)
    tested = failures(van_der_pol, [right, wrong], 100, 60.0, 0)
    assert tested[0] == (100, 0)
    assert tested[1][1] > 10
    assert failures(van_der_pol, [right], 100, 4.0, 0)[0][1] > 0
    cut = failures(van_der_pol, [right, wrong], 100, 4.0, 0, cut=True)
    assert cut[0][1] == 0 and cut[0][0] < 100  # those that are still on their way do not count
    assert cut[1][1] > 5


def test_no_level_above_the_sampled_one_is_proved(van_der_pol):
    candidate = quadratic(van_der_pol, from_lyapunov_equation(van_der_pol))
    rays = Rays.draw(candidate.P, np.array([3.0, 3.0]), 200, 0)
    level = sampled_level(candidate, rays)
    value, rate = candidate.at(level.at[None])
    assert value[0] == pytest.approx(level.level, rel=1e-3)
    assert abs(rate[0]) < 1e-3 * level.level
    inflated = replace(level, level=2.0 * level.level, edge=2.0 * level.edge)
    proof = proved_level(candidate, inflated, 20_000)
    assert not proof.complete
    assert proof.level <= level.level * (1.0 + 1e-9)


def test_all_of_a_linear_systems_box_is_proved():
    model = bent()
    system = around(model, at_origin(model))
    limits = np.array([5.0, 0.5])
    assert system.curved == ()
    walls = np.diag(1.0 / limits)
    P = from_lyapunov_equation(system)
    shape = largest_level(system, P, walls)
    touching = (shape.extents / limits).max()
    assert 0.98 < touching <= 1.0
    best = optimise_ellipsoid(system, walls, first=shape)
    # The largest ellipse in a box touches all of its sides, if the flow allows; it may not leave.
    assert np.all(best.extents <= limits * (1.0 + 1e-6))
    assert best.log_volume >= shape.log_volume - 1e-6


@given(
    st.lists(st.floats(-2.0, 2.0), min_size=4, max_size=4), st.floats(0.2, 1.0), st.floats(0.1, 3.0)
)
@settings(max_examples=8, deadline=None)
def test_what_is_proved_of_random_systems_comes_to_rest(entries, decay, bend):
    a = np.array(entries).reshape(2, 2)
    a -= (np.linalg.eigvals(a).real.max() + decay) * np.eye(2)
    model = bent(a, bend)
    system = around(model, at_origin(model))
    shape = largest_level(system, from_lyapunov_equation(system), np.eye(2) / 10.0)
    assume(shape is not None)
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    root = np.linalg.inv(np.linalg.cholesky(shape.P / shape.level)).T
    field = ca.Function("f", [y := ca.SX.sym("y", 2)], [system.function(y, ca.DM.zeros(2))])
    for direction in np.column_stack([np.cos(angle), np.sin(angle)]) * 0.999:
        start = root @ direction
        path = solve_ivp(lambda t, x: np.array(field(x)).ravel(), (0.0, 20.0), start, rtol=1e-8)
        values = np.einsum("ij,ik,kj->j", path.y, shape.P, path.y)
        assert np.all(np.diff(values) < 1e-6 * shape.level)
        assert values[-1] < 0.2 * values[0]


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_corners_and_definiteness(seed):
    random = np.random.default_rng(seed)
    n = int(random.integers(1, 5))
    middle = random.normal(size=(n, n))
    radius = random.uniform(0.0, 0.3, (n, n)) * (random.uniform(size=(n, n)) < 0.5)
    bounds = Interval.of(middle - radius, middle + radius)
    spanning = corners(bounds)
    assert np.all(spanning.lower >= bounds.lower) and np.all(spanning.upper <= bounds.upper)
    square = middle @ middle.T + random.uniform(-0.5, 0.5) * np.eye(n)
    whole = Interval.of(square - radius, square + radius)
    if positive_definite(whole[None])[0]:
        for _ in range(20):
            m = random.uniform(whole.lower, whole.upper)
            assert np.linalg.eigvalsh(0.5 * (m + m.T))[0] > 0.0
    assert not positive_definite(Interval.point(np.diag([1.0, -1e-9]))[None])[0]
    if decays(np.eye(n), bounds):
        for _ in range(20):
            m = random.uniform(bounds.lower, bounds.upper)
            assert np.linalg.eigvalsh(m + m.T)[-1] < 0.0


def test_with_rotors_that_are_not_settled_slopes_hold_the_rates_and_a_proof_is_found():
    model = Newtonian(freedom="both")
    system = around(model, operating_point(model, {"u_v": 1.8}))
    # Slopes over a box bound the rates along each segment from the equilibrium.
    random = np.random.default_rng(0)
    radii = np.array([20.0, 0.3, 0.3, 20.0, 0.3, 0.3])
    bounds = system.hull(radii)
    for y in random.uniform(-1.0, 1.0, (50, 6)) * radii:
        one, other = bounds.lower * y, bounds.upper * y
        lower, upper = np.minimum(one, other).sum(axis=1), np.maximum(one, other).sum(axis=1)
        rate = system.rates(y[None])[0]
        assert np.all(lower - 1e-9 <= rate) and np.all(rate <= upper + 1e-9)
    P = from_lyapunov_equation(system)
    unit = Ellipsoid(P, 1.0).extents[system.names.index("alpha_v")]
    # The stiffness of the cable jumps where yaw is zero: both values are covered.
    assert is_proved_attracted(system, Ellipsoid(P, (0.02 / unit) ** 2))
    assert not is_proved_attracted(system, Ellipsoid(P, (0.2 / unit) ** 2))


def test_the_pitch_region_stays_below_the_saddle():
    model = Newtonian(freedom="vertical")
    system = around(model, operating_point(model, {"u_v": 1.8}), ["alpha_v"])
    assert system.names == ("S_v", "alpha_v") and system.settled == ("omega_v",)
    limits = np.array([3.0, 3.0])
    found = estimates(system, limits, ("integrals",), 20_000, silent)
    assert all(e.proved for e in found)
    (wide,) = found
    # sin(alpha_v + 0.6194) is the same at the saddle: pi - 2*(0.2706 + 0.6194) away.
    saddle = np.array([0.0, math.pi - 2.0 * (0.2706 + 0.6194)])
    assert not wide.contains(saddle[None])[0]
    assert 0.9 < wide.extents[1] < saddle[1]
    assert wide.contains(np.array([[0.0, 0.6 * saddle[1]]]))[0]
    assert failures(system, found, 50, 214.0, 0) == [(50, 0)]


def test_rotors_and_a_free_yaw_are_left_out_and_jumps_and_undamped_axes_refused():
    model = Newtonian(freedom="both")
    point = operating_point(model, {"u_v": 1.8})
    assert around(model, point, ["omega_h"]).settled == ("omega_v",)
    system = around(model, point, ["alpha_v"])
    assert system.settled == ("omega_h", "omega_v")
    assert methods_for(system) == ("lyapunov", "inclusion", "level_set")  # none of many weights
    with pytest.raises(ConfigurationError, match="alpha_x"):
        around(model, point, ["alpha_x"])
    jumping = Planar(lambda x, y, u: (2 * y - x, u - 2 * x - y - 0.1 * ca.sign(y)))
    with pytest.raises(ModelError, match="jumps"):
        around(jumping, at_origin(jumping))
    manual = FeedbackManual()
    system = around(manual, operating_point(manual, {}))
    assert [manual.state_names[i] for i in system.neutral] == ["alpha_h"]
    require_attractive(system)
    model = Newtonian(freedom="vertical", parameters={"k_ov": 0.0})
    rest = around(model, operating_point(model, {"u_v": 1.0}))
    with pytest.raises(ModelError, match="marginal"):
        require_attractive(rest)


def test_integrals_of_the_rates_hold_the_potential_energy():
    model = Newtonian(freedom="vertical")
    system = around(model, operating_point(model, {"u_v": 1.8}), ["alpha_v"])
    basis = basis_of(system, 2, integrals=True)
    assert basis.names[-1] == "∫S_v' dalpha_v"
    y = np.linspace(-1.5, 1.5, 7)
    found = basis.at(np.column_stack([0.0 * y, y]))[0][:, -1]
    # J_v S_v' = G [sin(ᾱ + .6194) − sin(α + .6194)], integrated by hand; k from the slope A.
    at = 0.27064 + 0.61941
    scale = -system.A[0, 1] / math.cos(at)
    by_hand = scale * (np.sin(at) * y + np.cos(at + y) - np.cos(at))
    assert found == pytest.approx(by_hand, abs=2e-4)


def test_shares_and_their_confidence_are_told_with_enough_digits():
    assert share_of(0, 100).lower == 0.0
    assert share_of(0, 100).upper == pytest.approx(0.0362, abs=1e-4)  # 1 - 0.025^(1/100)
    assert share_of(100, 100).lower == pytest.approx(0.9638, abs=1e-4)
    half = share_of(50, 100)
    assert (half.lower, half.upper) == pytest.approx((0.398, 0.602), abs=1e-3)
    for hits in (2000, 1999, 1990, 1500, 3):
        share = share_of(hits, 2000)
        low, high = percent(share).split("(")[1].removesuffix(" %)").split("–")
        assert low != high
        assert float(low) < 100.0 and (high == "100") == (share.upper == 1.0)
    assert percent(share_of(2000, 2000)) == "100 % (99.8–100 %)"
    assert percent(ConfidenceShare(5e-9, 1e-10, 2e-8)) == "5e-07 % (1e-08–2e-06 %)"  # hardly known
    assert percent(ConfidenceShare(5e-9, 4e-9, 6e-9)) == "5e-07 %"


def test_a_kink_is_covered_and_gives_no_integral():
    def cabled(x, y, u):
        """A spring whose stiffness changes away from the equilibrium, at x = −0.3."""
        slack = x + 0.3
        spring = ca.if_else(slack >= 0, 1.0, 3.0) * slack - 0.3
        return y, -spring - 0.4 * y + u

    model = Planar(cabled)
    system = around(model, at_origin(model))
    assert not any("∫" in name for name in basis_of(system, 2, integrals=True).names)
    limits = np.array([2.0, 2.0])
    found = estimates(system, limits, ("lyapunov", "level_set"), 20_000, silent)
    assert [e.proved for e in found] == [True, True]
    for estimate, (count, failed) in zip(found, failures(system, found, 60, 60.0, 0), strict=True):
        assert (count, failed) == (60, 0)
        y = estimate.draw(3000, 2)
        assert np.all(estimate.candidate.at(y)[1] < 0.0)


FEW = ("study.samples=100", "study.grid=9")
PITCH, LYAPUNOV = "model=newtonian_vertical", "study.methods=[lyapunov]"


def answered(*overrides):
    composition = compose(["study=region_of_attraction", *overrides], "stability")
    return request.findings_of(request.request_of(composition), silent)


@pytest.mark.slow
def test_the_answer_for_pitch_and_its_figure():
    pitch = answered(PITCH, "study.methods=[lyapunov,integrals]", "study.boxes=20000", *FEW)
    data = json.loads(json.dumps(pitch.results, allow_nan=False))
    assert data["states"] == ["S_v", "alpha_v"] and data["settled"] == ["omega_v"]
    assert data["point"]["alpha_v"] == pytest.approx(0.271, abs=5e-4)  # check value, 1.8 V
    kinds = {e["method"]: e for e in data["estimates"] if e["proved"]}
    assert kinds["integrals"]["volume"] > 5.0 * kinds["lyapunov"]["volume"]
    for estimate in kinds.values():
        assert estimate["failed"] == 0 and estimate["simulated"] > 0
        share = estimate["share_of_true_region"]
        assert 0.0 < share["lower"] <= share["value"] <= share["upper"]
    saddle = next(e for e in data["other_equilibria"] if not e["stable"])
    assert saddle["deviation"]["alpha_v"] == pytest.approx(1.3615, abs=1e-3)
    # The largest set goes further towards the saddle than away from it.
    best = max(kinds.values(), key=lambda e: e["volume"])
    low, high = best["extent"]["alpha_v"]
    assert low < 0.0 < high and high > -1.3 * low
    assert max(-low, high) == pytest.approx(best["half_widths"]["alpha_v"])
    assert "no box" in pitch.lead[0] and "half-widths" not in pitch.lead[0]
    assert pitch.measures[0].label == "proved set" and "none" not in str(pitch.measures[0].value)
    assert "alpha_v −0.7" in pitch.lead[0] and "±" not in pitch.lead[0]
    chart = next(c for c in pitch.charts if c.name == "region_of_attraction")
    wide, near = ({getattr(m, "label", "") for m in panel.marks} for panel in chart.panels)
    assert {"comes to rest (simulated)", "saddle", "with integrals of the rates"} <= wide
    assert as_data(chart)["panels"]
    assert "Lyapunov equation" in near
    assert not near & {"with integrals of the rates", "saddle", "motions that do not"}


#: The eigenvalue is that of the mean of both sides of yaw zero, as study=local has it.
UNSTABLE = r"unstable.*0\.0234 \+ 1\.27j.*no region of attraction"


@pytest.mark.parametrize(
    ("overrides", "kind", "words"),
    [
        (["model=rahideh", "study.at={alpha_v: 0.4}"], ModelError, UNSTABLE),
        ([PITCH, "study.box={alpha_x: 1.0}"], ConfigurationError, "alpha_x"),
        ([PITCH, "study.states=[alpha_x]"], ConfigurationError, "alpha_x"),
        ([PITCH, "study.plane=[alpha_v, omega_v]"], ConfigurationError, "omega_v"),
    ],
)
def test_bad_requests_are_told(overrides, kind, words):
    with pytest.raises(kind, match=words):
        answered(LYAPUNOV, *FEW, *overrides)


def test_the_lqr_law_as_equations_moves_as_the_sampled_loop():
    composition = compose(["study=region_of_attraction", PITCH, "controller=lqr"], "stability")
    subject = request.request_of(composition).subject
    point = operating_point(subject.model, {"alpha_v": 0.0})
    law = linear_law(subject.model, subject.loop, point)
    loop = LinearLawLoop(subject.model, law)
    run = run_loop(subject.model, subject.loop, point, 6.0, offset={"alpha_v": -0.3})
    matrix, offset = loop.starts()
    start = loop.point.x + matrix @ np.array([0.0, 0.0, -0.3]) + offset
    path = VectorField(loop).motions(start, loop.point.u, 6.0, 0.02)[: len(run.x), 0, :3]
    # The law holds its command over 20 ms; the equations do not.
    assert np.abs(path[:, 1:] - run.x[:, 1:]).max() < 0.01
    assert np.abs(run.x[:, 2] - point.x[2]).max() == pytest.approx(0.3, rel=1e-6)


@pytest.mark.slow
def test_an_lqr_loop_is_proved_and_run():
    found = answered(
        PITCH,
        "controller=lqr",
        "study.methods=[lyapunov,inclusion]",
        "study.loop_starts=3",
        "study.duration=12",
        *FEW,
    )
    law = found.results["law"]
    assert law["states"][-1] == "xi_alpha_v"
    best = max(law["estimates"], key=lambda e: e["volume"])
    assert best["proved"] and best["failed"] == 0 and best["half_widths"]["alpha_v"] > 0.1
    assert all(found.results["runs_in_proved_set"]["recovered"])
    assert len(found.results["runs"]["recovered"]) == 3


@pytest.mark.slow
def test_rotors_may_deviate_too_and_a_box_that_is_given_is_kept_to():
    found = answered(PITCH, "study.states=all", "study.methods=[inclusion]", *FEW)
    assert found.results["states"] == ["omega_v", "S_v", "alpha_v"]
    estimate = found.results["estimates"][0]
    assert estimate["proved"] and estimate["half_widths"]["omega_v"] > 3.0
    assert estimate["failed"] == 0
    found = answered(PITCH, LYAPUNOV, "study.box={alpha_v: 0.05, S_v: 0.6}", *FEW)
    assert found.results["box"] == {"S_v": 0.6, "alpha_v": 0.05}
    assert found.results["estimates"][0]["half_widths"]["alpha_v"] <= 0.05


def test_another_controller_is_only_run():
    found = answered(
        PITCH,
        "controller=pid",
        "study.loop_starts=3",
        "study.box={alpha_v: 0.3, S_v: 0.2}",
        "study.duration=30",
    )
    assert found.results["law"] is None
    assert any("Nothing is proved for pid" in warning for warning in found.warnings)
    assert found.results["runs"]["recovered"] == [True, True, True]


@pytest.mark.slow
def test_a_cut_duration_is_told_and_proofs_and_simulations_are_of_the_same_rig():
    found = answered("model=rahideh", "study.at={alpha_v: 0.343}", LYAPUNOV, *FEW)
    assert found.results["duration"] == 120.0
    assert any("what had not arrived is undecided" in sentence for sentence in found.warnings)
    share, undecided = found.results["true_share_of_box"], found.results["undecided"]
    assert undecided > 0 and share["upper"] >= share["value"] + undecided / 100.0
    assert all(e["failed"] == 0 for e in found.results["estimates"])
    assert not any("contradict" in sentence for sentence in found.lead)
    found = answered(PITCH, "effect=main_dead_zone", "study.at.u_v=1.0", LYAPUNOV, *FEW)
    assert [e["failed"] for e in found.results["estimates"]] == [0]
    assert any("main_dead_zone" in sentence for sentence in found.warnings)
