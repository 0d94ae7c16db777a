"""Gains that wander: their columns against a simulation, their sizes, and what they are not."""

from dataclasses import replace

import numpy as np
import pytest

from tests.gap.recorded import recording
from trms_cli.gap.competing_model import nominal_parameters, refit
from trms_cli.gap.discrepancy import TrajectoryLinearisation
from trms_cli.gap.free_runs import free_run_errors
from trms_cli.gap.gain_drift import LEAST_DRIFT, WanderingGains, gain_drift
from trms_cli.identification.greybox.windows import Windows
from trms_cli.identification.problem import FitProblem, with_values
from trms_cli.models.newtonian import Newtonian
from trms_cli.simulation.rollout import Rollout

#: Parameters that do what a drive's gain does.
DRIVES = ("k_uv", "k_uh")


def test_columns_are_what_a_gain_changes_in_the_outputs():
    dataset = recording(seconds=20.0)
    windows = Windows(FitProblem(model=Newtonian(), datasets=(dataset,), window_length=10.0))
    p = windows.problem.model.parameters.values
    starts = windows.starts(p)
    drift = gain_drift(windows, TrajectoryLinearisation(windows).along(p, starts))
    knots = len(drift.drive) // 2
    assert drift.drive.tolist() == [0] * knots + [1] * knots
    small = 1e-4
    times = np.linspace(0.0, len(dataset) - 1, knots)
    for k in (0, knots + 1):
        hat = np.interp(np.arange(len(dataset)), times, np.arange(knots) == k % knots)
        commands = dataset.commands.copy()
        commands[:, drift.drive[k]] *= 1 + small * hat
        rollout = Rollout(windows.problem.model, dataset.sample_time)
        outputs = [
            rollout.outputs(u, windows.first, windows.count, windows.with_memory(p, starts), p).y
            for u in (commands, dataset.commands)
        ]
        change = (outputs[0] - outputs[1]) / small
        columns = drift.columns[windows.inside][..., k]
        np.testing.assert_allclose(columns, change, atol=0.02 * np.abs(change).max())


def test_sizes_are_those_of_the_coefficients_and_never_nothing():
    drift = WanderingGains(np.zeros((1, 1, 1, 40)), np.repeat([0, 1], 20), np.full(40, 1 / 20))
    gains = np.concatenate([np.tile([0.03, -0.03], 10), np.zeros(20)])
    sizes = drift.likely_sizes(gains, np.zeros(40))
    assert sizes[0] == pytest.approx(0.03, rel=0.1)
    assert LEAST_DRIFT < sizes[1] < 0.01
    # beyond the usual it is owed for, within it not
    assert drift.excess(gains, sizes, np.array([0.01, 0.01])) > 50
    assert drift.excess(gains, sizes, np.array([0.05, 0.05])) == pytest.approx(0.0)


def test_a_gain_that_wanders_moves_no_parameter():
    dataset = recording(seconds=60.0)
    wander = 1 + 0.03 * np.sin(2 * np.pi * dataset.time / 50.0)
    # what is recorded is the command; the drive made more or less of it
    measured = replace(dataset, commands=dataset.commands / wander[:, None])
    fitted = refit(Newtonian(), nominal_parameters(Newtonian()), (measured,), 10.0)
    assert np.all(fitted.metric.drift_sizes > 0.01)
    assert np.all(fitted.metric.shares < 0.02)
    away = [
        abs(v - f.prior_mean) / f.prior_sd
        for v, f in zip(fitted.fit.theta, fitted.structure.problem.free, strict=True)
    ]
    assert max(away) < 2.0


def test_a_model_has_the_mean_of_the_gains_that_were_fitted_beside_it():
    """A search ends anywhere on the ridge of gains and drives' parameters, the model does not."""
    dataset, other = recording(seconds=60.0), recording(seconds=40.0, seed=2)
    fitted = refit(Newtonian(), nominal_parameters(Newtonian()), (dataset,), 10.0)
    names = fitted.structure.problem.names
    theta, gains = fitted.fit.theta.copy(), fitted.fit.gains + 0.008
    theta[[names.index(drive) for drive in DRIVES]] *= 1 - 0.008
    elsewhere = replace(fitted, fit=replace(fitted.fit, theta=theta, gains=gains))
    best, own, raw = (
        free_run_errors(m, [other], [(0, 0, len(other))], horizons=[2.0])
        for m in (fitted.model, elsewhere.model, with_values(Newtonian(), elsewhere.values))
    )
    for speed in ("omega_v", "omega_h"):
        assert own[speed][2.0].rms < 1.02 * best[speed][2.0].rms
        assert raw[speed][2.0].rms > 1.05 * best[speed][2.0].rms
    # without a spread of the parameters there is nothing to go by
    bare = replace(elsewhere, fit=replace(elsewhere.fit, evidence=None))
    np.testing.assert_array_equal(bare.at_mean_gains, theta)


def test_gains_that_no_parameter_has_are_left_beside_the_model():
    dataset = recording(seconds=40.0)
    fitted = refit(Newtonian(), nominal_parameters(Newtonian())[:1], (dataset,), 10.0)
    evidence = fitted.fit.evidence
    assert evidence is not None
    shifted = replace(fitted.fit, gains=fitted.fit.gains + 0.2)
    np.testing.assert_array_equal(replace(fitted, fit=shifted).at_mean_gains, fitted.fit.theta)
