"""The table of docs/stability-lyapunov.md is what the program finds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import operating_point
from trms_cli.models.twin_rotor import TwinRotor
from trms_cli.stability.lyapunov.certificate import certify, rig_of
from trms_cli.stability.studies.lyapunov import Lyapunov
from trms_cli.stability.study import silent
from trms_cli.stability.subject import Subject

PAGE = Path(__file__).parents[2] / "docs" / "stability-lyapunov.md"
#: The first cell of each row: the model, where it rests.
ROWS: dict[str, tuple[Any, dict[str, Any], dict[str, float]]] = {
    "horizontal, α_h = 0.3": (Newtonian, {"freedom": "horizontal"}, {"alpha_h": 0.3}),
    "vertical, rest (−0.619)": (Newtonian, {"freedom": "vertical"}, {}),
    "vertical, hover": (Newtonian, {"freedom": "vertical"}, {"alpha_v": 0.0}),
    "vertical, u_v = 2.2 V": (Newtonian, {"freedom": "vertical"}, {"u_v": 2.2}),
    "Lagrangian, hover": (Lagrangian, {}, {"alpha_v": 0.0}),
    "Lagrangian, hover, α_h = 0.3": (Lagrangian, {}, {"alpha_v": 0.0, "alpha_h": 0.3}),
    "Lagrangian, `tastemirov`, level": (
        Lagrangian,
        {"parameter_set": "tastemirov"},
        {"alpha_v": 0.0},
    ),
    "Newtonian, hover": (Newtonian, {}, {"alpha_v": 0.0}),
    "Newtonian, rest": (Newtonian, {}, {}),
    "Newtonian, hover, α_h = 0.3": (Newtonian, {}, {"alpha_v": 0.0, "alpha_h": 0.3}),
    "Newtonian, `rahideh`, hover": (Newtonian, {"parameter_set": "rahideh"}, {"alpha_v": 0.0}),
    "Newtonian, `rahideh`, α_v = 0.4": (Newtonian, {"parameter_set": "rahideh"}, {"alpha_v": 0.4}),
    "Lagrangian, `rahideh`, hover": (Lagrangian, {"parameter_set": "rahideh"}, {"alpha_v": 0.0}),
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


def cases() -> list[Any]:
    return [
        pytest.param(
            row, id=f"{row[0]} {row[1]}", marks=[pytest.mark.slow] * row[0].startswith(LONG)
        )
        for row in rows()
    ]


def test_every_row_is_known() -> None:
    assert len(rows()) >= 14
    assert {row[0] for row in rows()} == set(ROWS)


@pytest.mark.parametrize("row", cases())
def test_a_row_is_what_is_found(row: list[str]) -> None:
    kind, options, at = ROWS[row[0]]
    model: TwinRotor = kind(**options)
    function = row[1].split(",")[0]
    found = certify(
        rig_of(Subject(model, "model")),
        operating_point(model, at),
        function,
        Lyapunov().budget,
        0,
        silent,
    )
    assert (found.search.candidate.weights.strict) == (function == "strict")
    if "γ" in row[1]:
        assert found.search.candidate.weights.yaw == float(row[1].split("=")[1])
    depth, outer, inner = (cell.strip("*") for cell in row[2:5])
    assert found.everywhere == (outer == "all states")
    for cell, value in (
        (depth, found.search.wells.depth),
        (outer, found.outer),
        (inner, found.inner),
    ):
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
