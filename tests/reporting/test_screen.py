"""Findings on a terminal: no figure is lost, whatever the width."""

import io
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.core.findings import Datum, Findings, Measure, NextCommand, Section, Table
from trms_cli.reporting import screen

NAME = "outputs/2026-11-22/fits/newtonian_with_friction_and_everything/model.yaml"
TABLE = Table(
    ["model", "RMSE pitch [rad]", "RMSE yaw [rad]", "95 % interval", "VAF [%]", "NEES"],
    [[NAME, 0.1234, Datum(0.234, "best"), "0.1 to 0.2", 98.7, None], ["b", 0.3, 0.4, "–", 1.0, 2]],
    "Free runs.",
)


def printed(table: Table, width: int) -> str:
    stream = io.StringIO()
    screen.show_table(screen.Terminal(stream, width), table)
    return stream.getvalue()


@pytest.mark.parametrize("width", [40, 60, 80, 100, 140])
def test_a_table_keeps_every_figure_and_its_width(width):
    text = printed(TABLE, width)
    for figure in ("0.123", "0.234 ★", "0.1 to 0.2", "98.7", "0.3", "0.4", "NEES"):
        assert figure in text
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= width
    assert "newtonian" in text and "model.yaml" in text.replace("\n", "")


@given(st.lists(st.integers(1, 14), min_size=1, max_size=12), st.integers(30, 120))
def test_parts_hold_each_column_once_and_repeat_the_heads(widths, width):
    columns = ["name", *("x" * n for n in widths)]
    rows = [["a name", *("1" * n for n in widths)]]
    parts = screen.split_columns(columns, rows, 1, width)
    shown = [i for part in parts for i in part if i > 0]
    assert shown == list(range(1, len(columns)))
    assert all(next(iter(part)) == 0 for part in parts)
    assert all(part[i] >= len(rows[0][i]) for part in parts for i in part if i > 0)


NUMBERS = ["−0.176 ± 0.473j", "doubles in 0.35 s", "+1.24", "excess 0.005 of 7.71e−04 rad", "79.5%"]


@given(st.lists(st.sampled_from([*NUMBERS, "yaw friction", "a/b_c"]), min_size=1, max_size=6),
       st.integers(10, 60))  # fmt: skip
def test_a_number_is_never_broken(parts, width):
    text = " ".join(parts)
    lines = screen.fold(text, width).split("\n")
    assert max(map(len, lines)) <= width
    assert "".join(lines).replace(" ", "") == text.replace(" ", "")
    words = [word for line in lines for word in line.split()]
    for number in (word for part in parts for word in part.split() if any(map(str.isdigit, word))):
        assert number in words


@pytest.mark.parametrize("width", [40, 60, 80])
def test_a_number_in_a_cell_is_never_broken(width):
    rows = [[NAME, text, text] for text in NUMBERS]
    text = printed(Table(["model", "a mode of the loop", "what it does"], rows), width)
    for number in ("0.473j", "0.35", "+1.24", "0.005", "7.71e−04", "79.5%"):
        assert text.split().count(number) == 2


def test_findings_are_printed_answer_first(capsys):
    findings = Findings(
        "Comparison",
        ["**lqr** wins; see `run.mcap`."],
        [Section("Errors", blocks=[TABLE])],
        warnings=["one run failed"],
        measures=[Measure("RMSE pitch", 0.134, "rad", note="worst of 4")],
        files={"page": Path("a") / "page.html"},
        next=[NextCommand("trms report a", "all of it"), NextCommand("trms runs")],
    )
    screen.show(findings, "compare", "three runs")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "compare    Comparison · three runs"
    assert lines[2] == "lqr wins; see run.mcap."
    assert any(line.split()[:4] == ["RMSE", "pitch", "0.134", "rad"] for line in lines)
    assert "! one run failed" in lines
    assert lines[-2:] == ["next       trms report a    # all of it", "           trms runs"]
    assert "page       a/page.html" in lines


def test_signs_that_steer_a_terminal_are_shown_not_sent():
    text = printed(Table(["n"], [["evil\x1b[2Jname"]]), 60)
    assert "\x1b" not in text and "\\x1b" in text
