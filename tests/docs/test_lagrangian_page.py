"""The formulas on the page of the Lagrangian model are those that the program derives."""

import re
import unicodedata
from pathlib import Path

import casadi as ca
import pytest
import sympy as sp
from sympy.parsing.sympy_parser import (
    implicit_multiplication_application,
    parse_expr,
    standard_transformations,
)

from trms_cli.models.newtonian import geometry
from trms_cli.models.parameters import parameter_file
from trms_cli.models.rig_bodies import bodies, energies

from ..models.sympy_of_casadi import in_sympy

PAGE = Path(__file__).parents[2] / "docs" / "lagrangian.md"
NAMES = (
    *("m_t", "m_tr", "m_ts", "m_m", "m_mr", "m_ms", "m_b", "m_cb"),
    *("l_t", "l_m", "l_b", "l_cb", "r_ms", "r_ts", "g", "h"),
)
_MULTIPLIED = (*standard_transformations, implicit_multiplication_application)


def formula(text: str, known: dict[str, sp.Expr]) -> sp.Expr:
    """What a line of the page says, in sympy."""
    plain = text.replace("−", "-").replace("²", "**2")
    # Two names beside each other are a product.
    plain = re.sub(r"(?<=[\w)])\s+(?=[\w(])", " * ", plain)
    return parse_expr(plain, local_dict=known, transformations=_MULTIPLIED)


@pytest.fixture(scope="module")
def page() -> dict[str, sp.Expr]:
    """Every formula of the derived blocks by its name."""
    known: dict[str, sp.Expr] = {name: sp.Symbol(name, real=True) for name in (*NAMES, *"csab")}
    text = PAGE.read_text(encoding="utf-8")
    blocks = re.findall(r"<!-- derived: \w+ -->\n```text\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 3
    for line in "".join(blocks).splitlines():
        name, _, right = line.partition("=")
        known[name.strip()] = formula(right, known)
    return known


@pytest.fixture(scope="module")
def derived() -> dict[str, sp.Expr]:
    """M, C and G of the program, sine and cosine of the pitch as s and c."""
    symbols = {name: ca.SX.sym(name) for name in (*NAMES, "pitch", "a", "b")}
    rig = energies(bodies(symbols), symbols["g"])
    at = [ca.vertcat(0, symbols["pitch"]), ca.vertcat(symbols["a"], symbols["b"])]
    parts = ca.substitute(
        [rig.inertia, rig.coriolis(rig.inertia), rig.gravity],
        [rig.angles, rig.rates],
        [ca.densify(value) for value in at],
    )
    found = {}
    for letter, part in zip("MCG", parts, strict=True):
        matrix, own = in_sympy(part, symbols)
        for function, short in ((sp.cos, "c"), (sp.sin, "s")):
            matrix = matrix.subs({function(own["pitch"]): sp.Symbol(short, real=True)})
        for i in range(matrix.shape[0]):
            for j in range(matrix.shape[1]):
                name = f"{letter}{i + 1}" + (f"{j + 1}" if matrix.shape[1] > 1 else "")
                found[name] = matrix[i, j]
    return found


@pytest.mark.parametrize("name", ["M11", "M12", "M22", "C11", "C12", "C21", "C22", "G1", "G2"])
def test_a_formula_is_what_the_program_derives(name, page, derived) -> None:
    c, s = sp.Symbol("c", real=True), sp.Symbol("s", real=True)
    difference = sp.rem(sp.expand(page[name] - derived[name]), c**2 + s**2 - 1, s)
    assert sp.expand(difference) == 0


def test_the_bodies_of_the_page_are_the_programs() -> None:
    words = unicodedata.normalize("NFC", PAGE.read_text(encoding="utf-8"))
    named = {name: sp.Symbol(name) for name in NAMES}
    for body in bodies(named):
        mass = next(n for n in NAMES if named[n] == body.mass)
        (row,) = re.findall(rf"^\| ([^|]+) \| {mass} \|", words, re.MULTILINE)
        assert row.split(",")[0] == body.name


def test_figures_of_the_page(page) -> None:
    text = PAGE.read_text(encoding="utf-8")
    bench = {p.name: p.value for p in parameter_file("bench").parameter_set()}
    values = {sp.Symbol(n, real=True): v for n, v in bench.items()}

    def at(name: str, c: float) -> float:
        here = {sp.Symbol("c", real=True): c, sp.Symbol("s", real=True): (1 - c * c) ** 0.5}
        return float(page[name].subs(values).subs(here))

    tail, main = bench["m_ts"] * bench["r_ts"] ** 2, bench["m_ms"] * bench["r_ms"] ** 2
    # Printed: half of the tail shield too much in J1, and in J2 and J3 too little.
    level, upright = main / 2 - tail / 2, main / 2 + tail / 2
    assert f"printed M11 is {level:.4f} kg m² too small with the beam level" in text
    assert f"({100 * level / at('M11', 1.0):.0f} %) and {upright:.4f} too small" in text
    rest = -sp.atan(page["B1"] / page["B2"]).subs(values)
    assert f"= −{abs(float(rest)):.3f} rad" in text
    excess = geometry(bench)["H"] / float((page["J1"] - page["J2"]).subs(values))
    assert f"1/{excess:.2f} of it" in text
