"""Free runs over windows: the model alone, started from before each window."""

from dataclasses import replace

import numpy as np
import pytest

from tests.identification.greybox.rigs import dataset_of
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.free_runs import error_figures, window_runs
from trms_cli.identification.problem import acting_parameters, with_values
from trms_cli.models.driven_model import DrivenModel
from trms_cli.models.newtonian import Newtonian
from trms_cli.simulation.rollout import Rollout

STEP, SAMPLES = 0.02, 800


@pytest.fixture(scope="module")
def model() -> Newtonian:
    return Newtonian(freedom="vertical")


@pytest.fixture(scope="module")
def dataset(model) -> Dataset:
    """Of the model itself, with a little noise."""
    generator = np.random.default_rng(0)
    commands = np.repeat(generator.uniform(0.3, 1.5, SAMPLES // 80), 80)[:, None]
    rollout = Rollout(model, STEP)
    start = rollout.initial(model.rest(), np.zeros(1))
    y = rollout.outputs(commands, [0], [SAMPLES], start[None]).y
    sd = np.array([1e-4, 0.5])
    measured = y + sd * generator.standard_normal(y.shape)
    return dataset_of(model, commands, measured, sd, step=STEP)


def figures(model, dataset) -> dict:
    return error_figures(window_runs(model, [dataset], 5.0))


def test_the_right_model_strays_by_little_more_than_the_noise(model, dataset):
    (run,) = window_runs(model, [dataset], 5.0)
    table = error_figures([run])
    assert table["alpha_v"]["rmse"] < 5e-4 and table["alpha_v"]["fit_percent"] > 99
    assert table["omega_v"]["rmse"] < 1.0
    # Two seconds are needed for the first start; two windows of five follow, and a shorter one.
    assert run.window.tolist() == [100, 350, 600]
    assert np.isnan(run.simulated[:100]).all() and np.isfinite(run.simulated[100:]).all()


def test_nothing_of_a_window_is_seen(model, dataset):
    (run,) = window_runs(model, [dataset], 5.0)
    later = dataset.measurements.copy()
    later[360:] += 1.0
    (other,) = window_runs(model, [replace(dataset, measurements=later)], 5.0)
    # All starts are sought at once, to a tolerance: the number of steps is common to them.
    assert np.allclose(run.simulated[100:600], other.simulated[100:600], rtol=0, atol=1e-3)
    assert not np.allclose(run.simulated[600:], other.simulated[600:], rtol=0, atol=0.1)


def test_a_wrong_model_strays_and_one_that_overflows_has_no_figures(model, dataset):
    wrong = with_values(model, {"k_fvp": 1.1 * model.parameters["k_fvp"].value})
    right, off = (figures(m, dataset)["alpha_v"]["rmse"] for m in (model, wrong))
    assert off > 20 * right
    table = figures(with_values(model, {"k_ov": -1e4}), dataset)
    assert table["alpha_v"]["rmse"] is None and table["alpha_v"]["max_abs_error"] is None


def test_missing_samples_and_too_short_a_recording_are_left_out(model, dataset):
    holed = dataset.measurements.copy()
    holed[400:450] = np.nan
    assert figures(model, replace(dataset, measurements=holed))["alpha_v"]["rmse"] < 5e-4
    assert window_runs(model, [dataset.part(0, 150)], 5.0) == []


def test_a_locked_axis_and_a_prescribed_rotor_leave_parameters_without_a_part(model):
    assert {"k_fhp", "k_oh", "k_chp"}.isdisjoint(acting_parameters(model))
    assert {"k_fvp", "k_ov", "l_cb", "J_mr", "k_uv"} <= acting_parameters(model)
    driven = acting_parameters(DrivenModel(model, ["omega_v"]))
    assert {"k_fvp", "k_ov"} <= driven and {"J_mr", "k_uv", "kphi"}.isdisjoint(driven)
