"""acados as a peer: a stand-in checks the names of what is stated to it, and solves it."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.options import Options
from benchmarks.peers import acados_peer
from benchmarks.peers.acados_peer import FULL_CONDENSING, PARTIAL_CONDENSING, Acados, missing_part
from benchmarks.setups import FULL_STATE, experiment, newton_horizon, newton_of
from benchmarks.subjects import acados as subject
from tests.benchmarks import acados_stand_in
from trms_cli.controllers.controller import ControlSetup, Status
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.core.errors import ConfigurationError
from trms_cli.simulation.closed_loop import Experiment


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "acados_template", acados_stand_in)
    monkeypatch.setattr(acados_peer, "missing_part", lambda: "")


def _experiment(*overrides: str) -> Experiment:
    return experiment(
        "controller=newton_mpc",
        "ref=square",
        "ref.alpha_v.amplitude=0.05",
        "ref.alpha_h.amplitude=0.1",
        *FULL_STATE,
        *newton_horizon(15),
        "sim.duration=1.5",
        *overrides,
    )


def _setup(chosen: Experiment) -> ControlSetup:
    return ControlSetup(chosen.model, newton_of(chosen).sample_time, np.zeros(chosen.model.n_u))


@pytest.mark.usefixtures("stand_in")
@pytest.mark.parametrize("is_met", [True, False], ids=["end met", "end relaxed"])
def test_acados_is_posed_the_problem_of_newton_mpc(is_met: bool) -> None:
    """Also where the end is out of reach: its price decides then how far it is missed."""
    far = ("ref.alpha_v.amplitude=0.4", "ref.alpha_h.amplitude=0.6", *newton_horizon(8))
    chosen = _experiment(*(() if is_met else far))
    # With weights that the default leaves at zero.
    problem = replace(newton_of(chosen), input_weights={"u_v": 0.003, "u_h": 0.001})
    if is_met:
        peer = Acados(problem, FULL_CONDENSING, 1)
    else:
        weights = {"alpha_v": 1.2, "alpha_h": 1.0, "omega_v": 1e-5}
        problem = replace(problem, state_weights=weights)
        peer = Acados(problem, PARTIAL_CONDENSING, 50)
    (along,) = subject.race(chosen, {"newton_mpc": replace(problem, max_iterations=100)})
    assert (along.answers[10].status is Status.RELAXED) != is_met
    apart = subject.command_differences(along, problem, peer, samples=11)
    assert len(apart) == 11
    # Here and there each finds a minimum of its own.
    assert np.median(apart) < 1e-6  # V


@pytest.mark.usefixtures("stand_in")
def test_a_real_time_iteration_goes_the_way_of_newton_mpc() -> None:
    chosen = _experiment("sim.duration=4")
    problem = newton_of(chosen)
    newton, peer = subject.race(
        chosen,
        {
            "newton_mpc": replace(problem, max_iterations=1),
            "acados": Acados(problem, PARTIAL_CONDENSING, 1),
        },
    )
    assert peer.failures == 0 and peer.iterations == 1
    ours, theirs = (entrant.closed_loop_objective(problem) for entrant in (newton, peer))
    assert theirs == pytest.approx(ours, rel=0.02)


@pytest.mark.usefixtures("stand_in")
def test_what_is_not_stated_to_acados_is_refused() -> None:
    chosen = _experiment("controller.input_rate_limits={u_v: 3.0}")
    with pytest.raises(ConfigurationError, match="not stated to acados"):
        Acados(newton_of(chosen), FULL_CONDENSING, 1).init(_setup(chosen))


@pytest.mark.usefixtures("stand_in")
def test_a_failed_solve_holds_the_command_and_starts_afresh(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    chosen = _experiment()
    problem: NewtonMpc = newton_of(chosen)
    peer = Acados(problem, FULL_CONDENSING, 1)
    solve = acados_stand_in.AcadosOcpSolver.solve
    statuses = iter([4])
    monkeypatch.setattr(
        acados_stand_in.AcadosOcpSolver, "solve", lambda self: next(statuses, None) or solve(self)
    )
    (entrant,) = subject.race(chosen, {"acados": peer})
    assert entrant.failures == 1 and entrant.answers[0].status is Status.FAILED
    assert "status 4" in entrant.answers[0].message
    np.testing.assert_array_equal(entrant.commands[0], entrant.plant.first_command)


@pytest.mark.usefixtures("stand_in")
def test_an_acados_without_flat_setters_is_too_old(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(acados_stand_in.AcadosOcpSolver, "set_flat")
    chosen = _experiment()
    with pytest.raises(ConfigurationError, match="older"):
        Acados(newton_of(chosen), FULL_CONDENSING, 1).init(_setup(chosen))


@pytest.fixture
def quick(tmp_path: Path) -> Options:
    return Options(quick=True, out=tmp_path)


def _cases(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subject, "_CASES", ((15, 1),))
    monkeypatch.setattr(subject, "_COMPARED", 5)


@pytest.mark.usefixtures("stand_in")
def test_the_rows_beside_acados(quick: Options, monkeypatch: pytest.MonkeyPatch) -> None:
    _cases(monkeypatch)
    (table,) = subject.run(quick)
    ours, *others = table.rows
    assert ours["solver"] == "newton_mpc" and "ratio" not in ours
    assert [row["solver"] for row in others] == list(subject._QP_SOLVERS)
    for row in others:
        assert row["ratio"] == pytest.approx(ours["median"] / row["median"])
        assert row["inside"] == pytest.approx(100.0)  # µs, as the stand-in says
        assert row["failures"] == 0


def test_where_acados_is_missing_its_row_says_what_to_install(
    quick: Options, monkeypatch: pytest.MonkeyPatch
) -> None:
    _cases(monkeypatch)
    monkeypatch.setitem(sys.modules, "acados_template", None)
    monkeypatch.setattr(acados_peer.importlib.util, "find_spec", lambda name: None)
    (table,) = subject.run(quick)
    ours, other = table.rows
    assert float(str(ours["median"])) > 0
    assert other["solver"] == "acados" and "median" not in other
    assert "not installed (acados_template)" in str(other["remark"])
    assert acados_peer.INSTALLATION in str(other["remark"])


def test_an_acados_that_does_not_run_says_so_in_its_row(
    quick: Options, monkeypatch: pytest.MonkeyPatch
) -> None:
    _cases(monkeypatch)
    monkeypatch.setitem(sys.modules, "acados_template", acados_stand_in)
    monkeypatch.setattr(acados_peer, "missing_part", lambda: "")

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("a long story\nrendering failed")

    monkeypatch.setattr(acados_stand_in.AcadosOcpSolver, "__init__", fail)
    (table,) = subject.run(quick)
    assert [row.get("remark") for row in table.rows] == [
        None,
        *["does not run here: rendering failed"] * 2,
    ]


def test_what_is_missing_of_acados_is_told_part_by_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The package, then the library, then the renderer of templates, in acados' own tree."""
    monkeypatch.delenv("ACADOS_SOURCE_DIR", raising=False)
    monkeypatch.delenv("TERA_PATH", raising=False)
    package = tmp_path / "interfaces" / "acados_template" / "acados_template"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    monkeypatch.syspath_prepend(str(package.parent))
    monkeypatch.delitem(sys.modules, "acados_template", raising=False)
    assert "library is missing" in missing_part() and "is not set" in missing_part()
    monkeypatch.setenv("ACADOS_SOURCE_DIR", str(tmp_path))
    assert str(tmp_path) in missing_part() and "is not set" not in missing_part()
    for folder, file in (("lib", "libacados.so"), ("bin", "t_renderer")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / file).touch()
        if folder == "lib":
            assert "t_renderer is missing" in missing_part()
    assert missing_part() == ""
