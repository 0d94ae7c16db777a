"""What is generated as C: the same values, with fewer slow operations."""

from collections import Counter

import casadi as ca
import numpy as np
import pytest

from trms_cli.core.c_source import (
    SettingField,
    generate_source,
    share_slow_operations,
    struct_content,
)
from trms_cli.models.discretisation import discretise
from trms_cli.models.newtonian import Newtonian


def count(function: ca.Function, kind: int) -> int:
    return sum(function.instruction_id(k) == kind for k in range(function.n_instructions()))


def divisions(function: ca.Function) -> int:
    kinds = Counter(function.instruction_id(k) for k in range(function.n_instructions()))
    return kinds[ca.OP_DIV] + kinds[ca.OP_INV]


def test_what_divides_often_divides_once() -> None:
    model = Newtonian()
    slopes = discretise(model, 0.1, 1).slopes()
    shared = share_slow_operations(slopes)
    assert divisions(shared) < 0.1 * divisions(slopes)
    draw = np.random.default_rng(0)
    for _ in range(20):
        x, u = model.rest() + 0.3 * draw.standard_normal(6), draw.uniform(-2, 2, 2)
        arguments = (x, u, model.parameters.values, 1e-3 * draw.standard_normal(4))
        for before, after in zip(slopes(*arguments), shared(*arguments), strict=True):
            np.testing.assert_allclose(np.array(after), np.array(before), rtol=1e-11, atol=1e-13)


def test_sine_of_a_double_angle_comes_from_those_of_the_angle() -> None:
    x = ca.SX.sym("x", 2)
    lone = ca.sin(2 * x[1])  # nobody needs sine and cosine of this angle
    results = ca.cse([ca.vertcat(ca.sin(x[0]), ca.cos(x[0]), ca.sin(2 * x[0]), lone)])
    function = ca.Function("f", [x], results)
    shared = share_slow_operations(function)
    assert (count(function, ca.OP_SIN), count(shared, ca.OP_SIN)) == (3, 2)
    for angle in np.linspace(-4.0, 4.0, 41):
        values = (np.array(f(ca.DM([angle, 0.3]))) for f in (shared, function))
        np.testing.assert_allclose(*values, rtol=0, atol=1e-15)


def test_outputs_without_an_element_and_matrix_functions_stay() -> None:
    x = ca.SX.sym("x", 2)
    function = ca.Function("f", [x], [ca.SX(0, 1), x[0] / x[1] + 1 / x[1]])
    shared = share_slow_operations(function)
    assert shared.size_out(0) == (0, 1)
    assert float(shared(ca.DM([3.0, 4.0]))[1]) == pytest.approx(1.0)
    y = ca.MX.sym("y")
    matrix = ca.Function("g", [y], [1 / y])
    assert share_slow_operations(matrix) is matrix
    assert ca.GlobalOptions.getSimplificationOnTheFly()


def test_arguments_are_read_without_asking_whether_they_are_there() -> None:
    x = ca.SX.sym("x", 2)
    source = generate_source({"mpc_f": ca.Function("f", [x], [x[0] * x[1]])}).source
    assert "arg[0][1]" in source
    assert "? arg[" not in source


def test_a_struct_is_filled_up_at_its_end_and_an_empty_array_has_room() -> None:
    fields = [
        SettingField("a", "[3]", np.array([1.0, 2.0, 3.0]), ""),
        SettingField("none", "[MPC_ROOM(0)][2]", np.zeros(0), "", least=2),
        SettingField("n", "", np.array([7]), "", is_whole=True),
    ]
    content = struct_content(fields)
    assert len(content) == 8 * 6
    assert np.frombuffer(content[:40]).tolist() == [1.0, 2.0, 3.0, 0.0, 0.0]
    assert np.frombuffer(content[40:44], dtype=np.intc)[0] == 7
    assert [field.value for field in fields] == ["{1.0, 2.0, 3.0}", "{{0.0, 0.0}}", "7"]
