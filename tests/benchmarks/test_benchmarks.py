"""The benchmark runs and says what it should. Nothing here looks at a time."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import benchmarks.__main__ as program
from benchmarks.document import SCHEMA, Column, Table, document, print_table
from benchmarks.lockstep import race
from benchmarks.options import Options
from benchmarks.setups import FULL_STATE, experiment, newton_horizon
from benchmarks.subjects import (
    exported,
    growth,
    identification,
    linear_time,
    objective,
    parts,
    peers,
    run_overhead,
    tracking,
)
from trms_cli.controllers.nmpc import Nmpc


@pytest.fixture
def quick(tmp_path: Path) -> Options:
    return Options(quick=True, out=tmp_path)


def _settled() -> object:
    """A small problem: 0.8 s horizon, from near the target."""
    return experiment(
        "controller=newton_mpc",
        "ref=square",
        "ref.alpha_v.amplitude=0.05",
        "ref.alpha_h.amplitude=0.1",
        *FULL_STATE,
        *newton_horizon(30),
        "sim.duration=1",
    )


@pytest.mark.parametrize("solver", ["ipopt", "fatrop", "do_mpc"])
def test_a_peer_and_converged_newton_go_the_same_way(solver: str) -> None:
    chosen = _settled()
    problem = replace(chosen.controller, max_iterations=100, tolerance=1e-7)
    if solver == "do_mpc":
        pytest.importorskip("do_mpc")
        from benchmarks.peers.do_mpc_peer import DoMpc

        other = DoMpc(problem=problem)
    else:
        other = Nmpc.of(problem, solver=solver, machine_code=False)
    entrants = race(chosen, {"newton": problem, "peer": other})
    assert entrants[1].failures == 0
    newton, peer = (np.array(entrant.commands) for entrant in entrants)
    np.testing.assert_allclose(newton, peer, atol=2e-3)  # V


LONG = [linear_time, objective, peers, tracking, identification, exported, growth]


@pytest.mark.parametrize(
    "subject",
    [parts, *(pytest.param(subject, marks=pytest.mark.slow) for subject in LONG)],
    ids=lambda s: s.__name__,
)
def test_a_subject_runs(subject: object, quick: Options) -> None:
    for table in subject.run(quick):
        assert table.rows
        print_table(table)
        assert subject is not parts or all(row["median"] > 0 for row in table.rows)
    if subject is growth:
        assert (quick.out / growth.FIGURE).stat().st_size > 5_000


def test_a_peer_that_is_missing_gets_a_row(quick: Options, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise ModuleNotFoundError("no such thing", name="do-mpc")

    monkeypatch.setattr(peers, "peers", lambda problem: {"do-mpc": missing})
    table = peers._peers(quick)
    row = table.rows[-1]
    assert row["solver"] == "do-mpc"
    assert "pip install" in str(row["remark"])


def test_the_document_is_written_and_an_unknown_subject_refused(tmp_path, capsys):
    assert program.main(["newton_time", "--quick", "--out", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "bench.json").read_text(encoding="utf-8"))
    assert content["schema"] == SCHEMA
    assert content["machine"]["versions"]["casadi"]
    rows = content["tables"]["newton_time"]["rows"]
    assert rows[0]["ratio"] == pytest.approx(rows[0]["median"] / rows[0]["limit"])
    assert all(row["median"] > 0 for row in rows)
    assert "limits met" in capsys.readouterr().out
    with pytest.raises(SystemExit) as exit_:
        program.main(["speed"])
    assert exit_.value.code == 2
    assert "newton_time" in capsys.readouterr().err


def test_figures_that_do_not_exist_are_null() -> None:
    table = Table("t", "t", [Column("a", "a", "s"), Column("limit", "l"), Column("ratio", "r")])
    table.add(a=math.inf)
    table.add_limited("a", 2.0, 1.0)
    rows = document({}, "", [table])["tables"]["t"]["rows"]
    assert rows[0] == {"a": None}
    assert rows[1]["met"] is False and len(table.misses) == 1
    with pytest.raises(KeyError):
        table.add(b=1.0)


def test_publishing_replaces_what_stands_between_the_marks(tmp_path: Path) -> None:
    from benchmarks.machine import describe
    from benchmarks.publish import publish

    page = tmp_path / "page.md"
    page.write_text("above <!-- figures: begin --> old <!-- figures: end --> below")
    table = Table("t", "A title", [Column("who", "who"), Column("a", "a", "s")])
    table.add(who="ours", a=0.125)
    publish([table], describe(), tmp_path, page)
    text = page.read_text(encoding="utf-8")
    assert text.startswith("above") and text.endswith("below")
    assert "| ours | 0.125 |" in text and " old " not in text
    page.write_text("no marks")
    with pytest.raises(ValueError, match="figures: begin"):
        publish([table], describe(), tmp_path, page)


def test_what_a_run_costs_besides_its_loop_adds_up_to_the_run(quick: Options) -> None:
    (table,) = run_overhead.run(quick)
    time = {str(row["part"]): float(str(row["time"])) for row in table.rows}
    parts = list(time)[:5]
    assert all(math.isfinite(value) for value in time.values())
    # Medians of few short runs do not add up exactly.
    assert sum(time[part] for part in parts) == pytest.approx(time["a run in all"], rel=0.5)
    assert [row["part"] for row in table.rows if "met" in row] == [
        "all but loop and log",
        "a run in all",
    ]
