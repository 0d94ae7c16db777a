"""The benchmark runs and says what it should. Nothing here looks at a time."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import benchmarks.__main__ as program
from benchmarks.document import SCHEMA, Column, Table, document, print_table
from benchmarks.lockstep import Entrant, race
from benchmarks.options import Options
from benchmarks.setups import FULL_STATE, experiment, newton_horizon
from benchmarks.subjects import (
    growth,
    identification,
    newton_time,
    objective,
    parts,
    peers,
    tracking,
)


@pytest.fixture
def quick(tmp_path: Path) -> Iterator[Options]:
    yield Options(quick=True, out=tmp_path)


def _settled(controller_overrides: tuple[str, ...] = ()) -> object:
    """A small problem: 0.8 s horizon, from near the target."""
    return experiment(
        "controller=newton_mpc",
        "ref=square",
        "ref.alpha_v.amplitude=0.05",
        "ref.alpha_h.amplitude=0.1",
        *FULL_STATE,
        *newton_horizon(30),
        "sim.duration=1",
        *controller_overrides,
    )


@pytest.mark.parametrize("solver", ["ipopt", "fatrop"])
def test_a_peer_and_converged_newton_go_the_same_way(solver: str) -> None:
    from benchmarks.peers.nlp import NlpMpc

    chosen = _settled()
    problem = replace(chosen.controller, max_iterations=100, tolerance=1e-7)
    entrants = race(
        chosen,
        {
            "newton": problem,
            "peer": NlpMpc(problem=problem, solver=solver, machine_code=False),  # type: ignore[arg-type]
        },
    )
    assert entrants[1].failures == 0
    newton, peer = (np.array(entrant.commands) for entrant in entrants)
    np.testing.assert_allclose(newton, peer, atol=2e-3)  # V


def test_do_mpc_goes_the_same_way() -> None:
    pytest.importorskip("do_mpc")
    from benchmarks.peers.do_mpc_peer import DoMpc

    chosen = _settled()
    problem = replace(chosen.controller, max_iterations=100, tolerance=1e-7)
    entrants = race(chosen, {"newton": problem, "peer": DoMpc(problem=problem)})
    assert entrants[1].failures == 0
    newton, peer = (np.array(entrant.commands) for entrant in entrants)
    np.testing.assert_allclose(newton, peer, atol=2e-3)  # V


def test_the_peers_problem_has_the_objective_of_newton_mpc() -> None:
    """At the same inputs, the NLP's objective is the horizon's merit."""
    import casadi as ca

    from benchmarks.peers.ocp import build

    chosen = experiment("controller=newton_mpc", *FULL_STATE)  # with the default's blocks
    entrant = Entrant("newton", chosen)
    entrant.sample(0)
    newton = entrant._state.newton
    ocp = build(chosen.controller, chosen.model, chosen.controller.sample_time)
    at = newton.horizon.arguments
    plan, blocks = newton.plan, newton.horizon.blocks
    at["z"][...] = plan
    newton.horizon.evaluate()
    merit = newton._merit(plan)
    trajectory = newton.horizon.evaluate.outputs[0]

    states = np.column_stack([at["x0"], trajectory])
    guess, block, period = [], -1, 0
    for kind, size in ocp.layout:
        if kind == "x":
            last = at["u_previous"] if period == 0 else plan[:, blocks[period - 1]]
            guess.append(np.concatenate([states[:, period], last])[:size])
            period += 1
        elif kind == "u":
            block += 1
            guess.append(plan[:, block])
        else:
            residual = (states[: chosen.model.n_x, -1] - at["x_s"]) / at["scale"]
            guess.append(np.concatenate([np.maximum(residual, 0), np.maximum(-residual, 0)]))
    x = np.concatenate(guess)
    p = np.concatenate(
        [at[name].ravel(order="F") for name in ("x0", "u_previous", "r", "x_s", "u_s", "w")]
    )
    functions = ca.Function("nlp", [ocp.nlp["x"], ocp.nlp["p"]], [ocp.nlp["f"], ocp.nlp["g"]])
    f, g = functions(x, p)
    assert float(f) == pytest.approx(merit, rel=1e-9)
    np.testing.assert_allclose(g.full().ravel(), 0.0, atol=1e-9)


@pytest.mark.parametrize("subject", [newton_time, parts, growth], ids=lambda s: s.__name__)
def test_a_subject_runs(subject: object, quick: Options) -> None:
    for table in subject.run(quick):  # type: ignore[attr-defined]
        assert table.rows
        print_table(table)
        for row in table.rows:
            assert row["median"] > 0
    if subject is growth:
        assert (quick.out / growth.FIGURE).stat().st_size > 5_000


@pytest.mark.slow
@pytest.mark.parametrize(
    "subject", [objective, peers, tracking, identification], ids=lambda s: s.__name__
)
def test_a_long_subject_runs(subject: object, quick: Options) -> None:
    for table in subject.run(quick):  # type: ignore[attr-defined]
        assert table.rows
        print_table(table)


def test_a_peer_that_is_missing_gets_a_row(quick: Options, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise ModuleNotFoundError("no such thing", name="do-mpc")

    monkeypatch.setattr(peers, "peers", lambda problem: {"do-mpc": missing})
    (table,) = peers.run(quick)
    row = table.rows[-1]
    assert row["solver"] == "do-mpc"
    assert "pip install" in str(row["remark"])


def test_the_document_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert program.main(["newton_time", "--quick", "--out", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "bench.json").read_text(encoding="utf-8"))
    assert content["schema"] == SCHEMA
    assert content["machine"]["versions"]["casadi"]
    (first, *_) = content["tables"]["newton_time"]["rows"]
    assert first["ratio"] == pytest.approx(first["median"] / first["limit"])
    assert "limits met" in capsys.readouterr().out


def test_an_unknown_subject_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
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
