"""Interval arithmetic on models: nothing that a point of a box gives lies outside its bounds; and
proofs over boxes: true claims are proved, false ones refuted, hard ones left open.
"""

from functools import cache

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.models.feedback_manual import FeedbackManual
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.models.tras import Tras
from trms_cli.stability.intervals.branch_and_bound import prove_negative
from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval

MODELS = {
    "newtonian": Newtonian(),
    "newtonian_full": Newtonian(currents="dynamic"),
    "lagrangian": Lagrangian(),
    "tras": Tras(),
    "quanser_aero": QuanserAero(),
    "feedback_manual": FeedbackManual(),
}
#: Reach of a box by the unit of its state.
REACH = {"rad/s": 20.0, "rad": 1.5, "A": 3.0}

x = ca.SX.sym("x", 2)
a, b = x[0], x[1]
UNARY = {
    "neg": -a,
    "twice": 2 * a,
    "square": a**2,
    "sqrt": ca.sqrt(ca.fabs(a)),
    "inverse": 1 / (4 + a),
    "abs": ca.fabs(a),
    "sign": ca.sign(a),
    "sin": ca.sin(3 * a),
    "cos": ca.cos(3 * a),
    "tan": ca.tan(a / 4),
    "exp": ca.exp(a),
    "expm1": ca.expm1(a),
    "log": ca.log(4 + a),
    "log1p": ca.log1p(3.5 + a),
    "atan": ca.atan(a),
    "sinh": ca.sinh(a),
    "tanh": ca.tanh(a),
    "floor": ca.floor(2 * a),
    "ceil": ca.ceil(2 * a),
    "cube": a**3,
    "seventh": a**7,
    "minus_two": (4 + a) ** (-2),
    "root": ca.fabs(a) ** 1.7,
}
BINARY = {
    "add": a + b,
    "sub": a - b,
    "mul": a * b,
    "div": a / (4 + b),
    "min": ca.fmin(a, b),
    "max": ca.fmax(a, b),
    "less": a < b,
    "at_most": a <= b,
    "not": ca.logic_not(a < b),
    "and": ca.logic_and(a < 1, b < 1),
    "or": ca.logic_or(a < -1, b < -1),
    "switch": ca.if_else(a >= b, 2 * a, -3 * b),
    "by_direction": ca.if_else(a >= 0, 2.0, 5.0) * a * ca.fabs(a),
    "nested": ca.if_else(a >= 0, ca.if_else(b >= 0, a, a * b), ca.if_else(b >= 0, b, 1.0)),
    "clipped": ca.fmin(ca.fmax(a * b, -1.0), 1.0),
}


def of(expression: ca.SX, *symbols: ca.SX) -> ca.Function:
    return ca.Function("tested", list(symbols), [expression])


FUNCTIONS = {name: of(expression, x) for name, expression in {**UNARY, **BINARY}.items()}
ENCLOSURES = {name: Enclosure(function) for name, function in FUNCTIONS.items()}
ends = st.floats(-3.0, 3.0, allow_nan=False)


def box_of(one: float, other: float, third: float, fourth: float) -> Interval:
    lower = [min(one, other), min(third, fourth)]
    return Interval.of([lower], [[max(one, other), max(third, fourth)]])


def points_of(box: Interval, count: int, seed: int) -> np.ndarray:
    """Random points of a box, its corners and its middle among them."""
    n = box.lower.shape[1]
    share = np.random.default_rng(seed).uniform(size=(count, n))
    share[0], share[1], share[2] = 0.0, 1.0, 0.5
    points = box.lower + share * (box.upper - box.lower)
    return np.clip(points, box.lower, box.upper)


def holds(bounds: Interval, values: np.ndarray) -> bool:
    return bool(np.all(bounds.lower <= values) and np.all(values <= bounds.upper))


@pytest.mark.parametrize("name", list(FUNCTIONS))
@settings(max_examples=25, deadline=None)
@given(corners=st.tuples(ends, ends, ends, ends), seed=st.integers(0, 999))
def test_each_operation_bounds_its_values(name, corners, seed) -> None:
    function = FUNCTIONS[name]
    box = box_of(*corners)
    values = np.array(function(points_of(box, 25, seed).T)).T
    assert holds(ENCLOSURES[name](box)[0], values)


@settings(max_examples=60, deadline=None)
@given(corners=st.tuples(ends, ends, ends, ends), seed=st.integers(0, 999))
def test_mean_value_form_bounds_and_is_no_wider(corners, seed) -> None:
    bent = ca.if_else(a >= 0, 2.0, 3.0) * a + b**3 - b
    function = of(ca.vertcat(ca.sin(a) * b - a * ca.fabs(a) + a, bent), x)
    enclosure = Enclosure(function)
    box = box_of(*corners)
    tight, natural = enclosure.mean_value(box), enclosure(box)[0]
    assert holds(tight, np.array(function(points_of(box, 40, seed).T)).T)
    assert np.all(tight.lower >= natural.lower) and np.all(tight.upper <= natural.upper)


def test_a_decided_switch_takes_its_branch_alone_and_small_boxes_have_tight_mean_values() -> None:
    box = Interval.of([[1.0, 0.0], [-2.0, 0.0], [-1.0, 0.0]], [[2.0, 1.0], [-1.0, 1.0], [1.0, 1.0]])
    bounds = Enclosure(of(ca.if_else(a >= 0, 10.0 + b, -10.0 + b), x))(box)[0]
    np.testing.assert_allclose(bounds.lower[:, 0], [10.0, -10.0, -10.0], atol=1e-12)
    np.testing.assert_allclose(bounds.upper[:, 0], [11.0, -9.0, 11.0], atol=1e-12)
    enclosure = Enclosure(of(ca.sin(a) - a + b * (b - 1), x))
    box = Interval.of([[0.40, 0.30]], [[0.41, 0.31]])
    natural, tight = enclosure(box)[0].width, enclosure.mean_value(box).width
    assert tight[0, 0] < 0.5 * natural[0, 0]


def test_infinite_bounds_stay_bounds_rounding_goes_outwards_and_sine_finds_its_crests() -> None:
    function = ca.Function("tested", [x], [a * b, 1 / a, a - a * ca.fabs(a)])
    box = Interval.of([[0.0, 1.0], [1e6, -np.inf]], [[np.inf, 2.0], [np.inf, 0.0]])
    product, inverse, fall = Enclosure(function)(box)
    assert product.lower[0, 0] <= 0.0 and product.upper[0, 0] == np.inf
    assert inverse.upper[0, 0] == np.inf
    assert inverse.lower[1, 0] <= 0.0 <= inverse.upper[1, 0] < 1e-5
    assert fall.upper[1, 0] == np.inf or fall.upper[1, 0] < 0.0
    assert not np.any(np.isnan([product.lower, product.upper, inverse.lower, inverse.upper]))
    third = Interval.point([1.0]) / Interval.point([3.0])
    # 3 · (1/3) is 1 in floating point; the bounds are on both sides of the number itself.
    back = third * Interval.point([3.0])
    assert third.lower[0] < third.upper[0]
    assert back.lower[0] < 1.0 < back.upper[0]
    tenth = Interval.point([0.1]) + Interval.point([0.2])
    assert tenth.lower[0] < 0.1 + 0.2 < tenth.upper[0]
    box = Interval.of([1.0, 1.6, -10.0, 4.0], [1.6, 3.0, 10.0, 5.0])
    sine = box.sine()
    assert sine.upper[0] == 1.0 and sine.lower[0] <= np.sin(1.0)
    assert sine.upper[1] < 1.0
    assert (sine.lower[2], sine.upper[2]) == (-1.0, 1.0)
    assert sine.lower[3] == -1.0


@pytest.mark.parametrize("name", list(MODELS))
@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10_000), log_size=st.floats(-3.0, 0.0))
def test_models_rates_lie_within_their_bounds(name: str, seed: int, log_size: float) -> None:
    model = MODELS[name]
    function, slopes = _field(name)
    draw = np.random.default_rng(seed)
    reach = np.array([REACH.get(signal.unit, 1.0) for signal in model.states])
    centre = draw.uniform(-1.0, 1.0, (1, model.n_x)) * reach
    half = 10.0**log_size * reach * draw.uniform(0.0, 1.0, (1, model.n_x))
    box = Interval.of(centre - half, centre + half)
    u = draw.uniform(-1.0, 1.0, model.n_u)
    enclosure, slope_bounds = _enclosures(name)
    points = points_of(box, 20, seed)
    values = np.array(function(points.T, np.tile(u[:, None], (1, len(points))))).T
    assert holds(enclosure(box, Interval.point(u))[0], values)
    assert holds(enclosure.mean_value(box, Interval.point(u)), values)
    bounds = slope_bounds(box, Interval.point(u))[0]
    for point in points[:5]:
        assert holds(bounds, np.array(slopes(point, u))[None])


@cache
def _field(name: str) -> tuple[ca.Function, ca.Function]:
    model = MODELS[name]
    state, u, p, w = model.symbols()
    at = (ca.DM(model.parameters.values), ca.DM.zeros(model.n_w))
    f = ca.substitute(model.dynamics(state, u, p, w), ca.vertcat(p, w), ca.vertcat(*at))
    slopes = ca.densify(ca.jacobian(f, state))
    return ca.Function("field", [state, u], [f]), ca.Function("slopes", [state, u], [slopes])


@cache
def _enclosures(name: str) -> tuple[Enclosure, Enclosure]:
    function, slopes = _field(name)
    return Enclosure(function), Enclosure(slopes)


def test_a_true_claim_is_proved_up_to_its_edge_and_a_false_one_has_a_state_where_it_fails() -> None:
    f = of(x[0] ** 2 + x[1] ** 2 - 2.001, x)
    proof = prove_negative(f, [-1.0, -1.0], [1.0, 1.0])
    assert proof.holds and len(proof.undecided.lower) == 0 and proof.point is None
    f = of(x[0] ** 2 + x[1] ** 2 - 1.99, x)
    proof = prove_negative(f, [-1.0, -1.0], [1.0, 1.0])
    assert proof.status == "counterexample"
    assert proof.point is not None and proof.value is not None
    assert float(f(proof.point)) >= 0.0
    assert proof.value == pytest.approx(float(f(proof.point)), abs=1e-12)


def test_the_budget_ends_the_search_and_tells_what_is_left() -> None:
    f = of(2 * x[0] * x[1] - x[0] ** 2 - x[1] ** 2 - 1e-9, x)
    proof = prove_negative(f, [-1.0, -1.0], [1.0, 1.0], budget=300)
    assert proof.status == "undecided" and proof.examined <= 300
    assert len(proof.undecided.lower) > 0
    # The claim is hard along the diagonal: what is left lies near it.
    middle = proof.undecided.middle
    assert np.all(np.abs(middle[:, 0] - middle[:, 1]) < 0.5)


def test_all_rows_must_be_negative_given_values_are_used_and_a_jump_is_not_smoothed_away() -> None:
    c = ca.SX.sym("c")
    f = of(ca.vertcat(x[0] - c, x[1] - 2 * c), x, c)
    assert prove_negative(f, [0.0, 0.0], [1.0, 1.5], given=[1.01]).holds
    assert not prove_negative(f, [0.0, 0.0], [1.0, 2.5], given=[1.01]).holds
    # Its derivative is zero everywhere: the mean value form alone would call it negative.
    f = of(ca.sign(x[0] - 0.4) - 0.5, x)
    assert prove_negative(f, [0.0, 0.0], [1.0, 1.0]).status == "counterexample"


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-2, 2), min_size=3, max_size=3), st.floats(-1.0, 1.0))
def test_proofs_and_counterexamples_agree_with_a_dense_search(coefficients, offset) -> None:
    a, b, c = coefficients
    expression = a * ca.sin(3 * x[0]) * x[1] + b * x[0] * ca.fabs(x[0]) + c * x[1] ** 3 + offset
    f = of(expression, x)
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41)), -1).reshape(-1, 2)
    largest = float(np.array(f(grid.T)).max())
    proof = prove_negative(f, [-1.0, -1.0], [1.0, 1.0], budget=20_000)
    if largest >= 0.0:
        assert not proof.holds
    elif proof.status == "counterexample":
        assert proof.point is not None and float(f(proof.point)) >= 0.0
    if largest < -0.05:
        assert proof.holds or proof.status == "counterexample"
