"""The unscented and the extended filter give filterpy's estimates; how the first starts."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints

from trms_cli.core.errors import ConfigurationError
from trms_cli.models.discretisation import discretise
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model, names
from trms_cli.models.newtonian import Newtonian
from trms_cli.observers.augmentation import ProcessNoise
from trms_cli.observers.ekf import Ekf
from trms_cli.observers.filterpy_ukf import FilterpyUkf
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.ukf import SigmaPoints, Ukf

from ..models.simulate import rates
from .observed_rigs import NOISE_SD, SAMPLE_TIME, TRIM, Rig, commands, setup_for


@pytest.mark.parametrize(("alpha", "beta", "kappa"), [(1.0, 2.0, 0.0), (0.3, 2.0, 1.0)])
def test_sigma_points_and_weights_are_filterpys(alpha: float, beta: float, kappa: float) -> None:
    n = 5
    random = np.random.default_rng(3)
    root = random.standard_normal((n, n))
    mean, covariance = random.standard_normal(n), root @ root.T + np.eye(n)
    ours = SigmaPoints(n, alpha, beta, kappa)
    theirs = MerweScaledSigmaPoints(n, alpha, beta, kappa)
    np.testing.assert_allclose(ours.mean_weights, theirs.Wm, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(ours.covariance_weights, theirs.Wc, rtol=1e-12, atol=1e-14)
    m, P = ca.SX.sym("m", n), ca.SX.sym("P", n, n)
    points = ca.Function("points", [m, P], [ours.around(m, P)])(mean, covariance)
    np.testing.assert_allclose(
        np.array(points).T, theirs.sigma_points(mean, covariance), rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize("currents", ["quasi_static", "dynamic"])
def test_filterpys_filter_gives_the_same_estimates(currents: str) -> None:
    """To 1e-8 of a standard deviation, also where samples are missing or held back."""
    model = Newtonian(currents=currents)
    setup = setup_for(model)
    ours, theirs = Ukf(), FilterpyUkf()
    state, their_state = ours.init(setup), theirs.init(setup)
    rig, before, held = Rig(model, names(model.outputs)), np.zeros(2), 0.0
    for k, u in enumerate(commands(300)):
        y = rig.measure()
        if 100 <= k < 120:
            y[1:3] = np.nan
        if k == 150 or 200 <= k < 240:  # an outlier; a jump until the channel is believed again
            y[0] += 0.3
        one, other = ours.step(state, before, y, None), theirs.step(their_state, before, y, None)
        for name, scale in (
            *(("x", one.sd), ("sd", one.sd), ("predicted", one.innovation_sd)),
            *(("innovation", one.innovation_sd), ("innovation_sd", one.innovation_sd)),
            *(("disturbance", one.disturbance_sd), ("disturbance_sd", one.disturbance_sd)),
        ):
            apart = np.abs(getattr(one, name) - getattr(other, name)) / scale
            assert np.nanmax(apart) < 1e-8, (k, name)
        np.testing.assert_array_equal(one.rejected, other.rejected)
        held += one.rejected.sum()
        before = u
        rig.advance(u)
    assert held > 20 and state.recoveries == their_state.recoveries == 0


@pytest.mark.parametrize(
    "model",
    [Newtonian(), Newtonian(currents="dynamic"), Lagrangian()],
    ids=["newtonian", "currents", "lagrangian"],
)
def test_filterpys_extended_filter_gives_the_same_estimates(model: Model) -> None:
    outputs, observer = names(model.outputs), Ekf(disturbances=("pitch_moment", "yaw_moment"))
    state = observer.init(setup_for(model))
    linearised, p = discretise(model, SAMPLE_TIME).linearised(), model.parameters.values
    rows = [model.state_index(name) for name in outputs]
    n_x, n = model.n_x, model.n_x + 2
    H = np.eye(n)[rows]
    theirs = ExtendedKalmanFilter(n, 4)
    theirs.x, theirs.P = state.prior_mean.copy(), state.prior_covariance.copy()
    inputs = dict(zip(state.function.function.name_in(), state.function.inputs, strict=True))
    theirs.Q = np.diag(inputs["q"])
    theirs.R = np.diag([NOISE_SD[name] ** 2 for name in outputs])
    rig, u_before = Rig(model, outputs), np.zeros(2)
    for k, u in enumerate(commands(150)):
        y = rig.measure()
        if k > 0:
            w = np.array([*theirs.x[n_x:], 0.0, 0.0])
            after, A, _, _, G = (
                np.array(value) for value in linearised(theirs.x[:n_x], u_before, p, w)
            )
            theirs.F = np.eye(n)
            theirs.F[:n_x, :n_x], theirs.F[:n_x, n_x:] = A, G[:, :2]
            # filterpy's prediction of the mean is linear: the model's own step stands in
            theirs.x = np.concatenate([after[:, 0], theirs.x[n_x:]])
            theirs.P = theirs.F @ theirs.P @ theirs.F.T + theirs.Q
        theirs.update(y, lambda z: H, lambda z: H @ z)
        estimate = observer.step(state, u_before, y, None)
        scale = np.sqrt(np.diag(theirs.P))
        for found, mean, sd in (
            (estimate.x, theirs.x[:n_x], scale[:n_x]),
            (estimate.disturbance[:2], theirs.x[n_x:], scale[n_x:]),
        ):
            np.testing.assert_allclose(found / sd, mean / sd, rtol=0, atol=1e-6)
        np.testing.assert_allclose(estimate.sd, scale[:n_x], rtol=1e-6)
        u_before = u
        rig.advance(u)


@pytest.mark.parametrize(
    ("channels", "estimated"),
    [
        (("alpha_v", "alpha_h", "omega_v", "omega_h"), [True, True, True, True]),
        (("alpha_v", "alpha_h"), [True, True, False, False]),
    ],
)
def test_there_are_as_many_integrators_as_channels(channels, estimated) -> None:
    observer = Ukf()
    state = observer.init(setup_for(Newtonian(), channels))
    estimate = observer.step(state, TRIM, np.zeros(len(channels)), None)
    assert (estimate.disturbance_sd > 0).tolist() == estimated


def test_the_covariance_stays_positive_definite_in_long_runs() -> None:
    model = Newtonian()
    observer = Ukf(process_noise=ProcessNoise(angle=0.0, momentum=0.0, rotor=0.0, disturbance=0.0))
    state = observer.init(setup_for(model))
    rig = Rig(model, names(model.outputs))
    y, u = rig.x[rig.rows], np.zeros(2)
    for _ in range(100_000):
        observer.step(state, u, y, None)
    assert state.recoveries == 0
    P = state.function.inputs[1]
    np.testing.assert_array_equal(P, P.T)
    scale = np.sqrt(np.diag(P))
    assert np.linalg.eigvalsh(P / np.outer(scale, scale)).min() > 0


def test_it_starts_from_measurements_and_from_rotors_that_turn_as_commanded() -> None:
    model = Newtonian()
    first = np.array([0.1, 0.2])
    state = Ukf().init(
        ObserverSetup(
            model, SAMPLE_TIME, ("alpha_v", "alpha_h"), NOISE_SD, first, np.array([1.413, 0.5])
        )
    )
    x = dict(zip(model.state_names, state.prior_mean, strict=False))
    assert (x["alpha_v"], x["alpha_h"]) == (0.1, 0.2)
    assert x["omega_v"] == pytest.approx(196.3, abs=0.1)
    speeds = rates(model, state.prior_mean[:6], [1.413, 0.5])
    moving = [model.state_index(name) for name in ("omega_h", "omega_v", "alpha_h", "alpha_v")]
    np.testing.assert_allclose(speeds[moving], 0.0, atol=1e-6)


def test_a_channel_without_declared_noise_is_refused() -> None:
    model = Newtonian()
    setup = ObserverSetup(model, SAMPLE_TIME, ("alpha_v",), {}, np.zeros(1), np.zeros(2))
    with pytest.raises(ConfigurationError, match="noise of 'alpha_v'"):
        Ukf().init(setup)
