"""The studies of recordings that may be absent: they skip without, and find a rig that is known."""

import importlib
from pathlib import Path

import numpy as np
import pytest

from experiments.aero.study import fit_model, parts_of, problem_of, read_study, recording
from experiments.tras import study as tras
from trms_cli.identification.problem import Prior, free_parameters
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.simulation.rollout import Rollout


@pytest.mark.parametrize("study", ["aero", "tras"])
def test_skips_where_there_is_no_record(study, tmp_path, capsys) -> None:
    main = importlib.import_module(f"experiments.{study}.__main__").main
    assert main([str(tmp_path)]) == 0
    assert "skipped" in capsys.readouterr().err


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, QuanserAero]:
    """A recording in the shape of the real one, of a rig whose parameters are known."""
    truth = QuanserAero(
        parameter_set="quanser_aero_record",
        parameters={"F_1": 0.002, "F_2": 0.004, "J_r": 2.2e-5, "d_x": 0.014},
        rotor_speeds=False,
    )
    t = 0.002 * np.arange(6001)
    on = t >= 5.0
    u = np.column_stack([9.5 * on - 28 * (on & (t < 5.4)), 12.0 * on + 24 * (on & (t < 5.15))])
    u[t >= 6.5] -= [1.0, 4.0]
    y = Rollout(truth, 0.002).outputs(u, [0], [len(u)], np.zeros((1, 6))).y
    folder = tmp_path_factory.mktemp("aero")
    np.savetxt(
        folder / "nominal_a.csv", np.column_stack([t, u, y]), fmt="%.6f", delimiter=",",
        header="t[s],u_v[V],u_h[V],alpha_v[rad],alpha_h[rad]", comments="",
    )  # fmt: skip
    return folder, truth


def test_it_finds_what_made_a_recording(rig: tuple[Path, QuanserAero]) -> None:
    folder, truth = rig
    settings = {**read_study(), "starts": 1}
    first, rest = parts_of(recording(folder, "nominal_a.csv", settings), settings)
    assert first.duration == pytest.approx(4.0, abs=0.02)
    assert rest.duration == pytest.approx(4.0, abs=0.02)
    model_fit = fit_model(problem_of((first,), settings), settings)
    assert {p.name for p in model_fit.problem.free} == set(settings["free"])
    assert model_fit.result.covariance is not None
    names = [p.name for p in model_fit.problem.free]
    sd = dict(zip(names, np.diag(model_fit.result.covariance) ** 0.5, strict=True))
    for name in ("J_r", "F_2", "tau_v", "d_x"):
        true = truth.parameters[name].value
        assert abs(model_fit.result.values[name] - true) < 3 * sd[name], name
    assert sd["J_r"] < 0.1 * truth.parameters["J_r"].value


@pytest.mark.parametrize("name", ["rotors", "commands"])
def test_its_free_parameters_exist(name: str) -> None:
    settings = tras.read_study()
    fit = {**settings["fits"][name], "curves": False}
    model = tras.model_of(Path(), settings, fit)
    priors = {key: Prior(relative_sd=share) for key, share in fit["priors"].items()}
    free = free_parameters(model.parameters, fit["free"], priors=priors)
    assert len(free) == len(fit["free"])
