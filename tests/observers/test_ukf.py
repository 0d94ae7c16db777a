"""The UKF is the Kalman filter on linear plants, and gives filterpy's estimates."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints
from observed_rigs import NOISE_SD, SAMPLE_TIME, TRIM, Rig, commands, followed, setup_for

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build
from trms_cli.models.model import names
from trms_cli.models.newtonian import Newtonian
from trms_cli.observers.augmentation import ProcessNoise
from trms_cli.observers.filterpy_ukf import FilterpyUkf
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.recursive_filter import FilterState
from trms_cli.observers.ukf import SigmaPoints, Ukf


def mean_and_covariance(state: FilterState) -> tuple[np.ndarray, np.ndarray]:
    return state.function.inputs[0], state.function.inputs[1]


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
        rig.advance(u, np.zeros(4))
    assert held > 20 and state.recoveries == their_state.recoveries == 0


@pytest.mark.parametrize("torque", [0.01, -0.02])
def test_a_constant_torque_on_yaw_is_estimated_without_bias(torque: float) -> None:
    model = Newtonian()
    rig, observer = Rig(model, names(model.outputs)), Ukf()
    state = observer.init(setup_for(model))
    found, sds = [], []
    push = np.array([0.0, torque, 0.0, 0.0])
    for k, estimate in followed(observer, state, rig, commands(1500), push):
        if k > 500:
            found.append(estimate.disturbance.copy())
            sds.append(estimate.disturbance_sd.copy())
    mean, sd = np.mean(found, axis=0), np.mean(sds, axis=0)
    assert mean[1] == pytest.approx(torque, abs=0.3 * sd[1])
    for other in (0, 2, 3):
        assert mean[other] == pytest.approx(0.0, abs=0.3 * sd[other])
    assert sd[1] < 0.3 * abs(torque)


@pytest.mark.parametrize(
    ("channels", "estimated"),
    [
        (("alpha_v", "alpha_h", "omega_v", "omega_h"), [True, True, True, True]),
        (("alpha_v", "alpha_h"), [True, True, False, False]),
    ],
)
def test_there_are_as_many_integrators_as_channels(
    channels: tuple[str, ...], estimated: list[bool]
) -> None:
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
    P = mean_and_covariance(state)[1]
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
    at = model.symbols()
    f = ca.Function("f", list(at), [model.dynamics(*at)])
    rates = np.array(
        f(state.prior_mean[:6], [1.413, 0.5], model.parameters.values, np.zeros(4))
    ).ravel()
    moving = [model.state_index(name) for name in ("omega_h", "omega_v", "alpha_h", "alpha_v")]
    np.testing.assert_allclose(rates[moving], 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "where", "remedy"),
    [
        ({"disturbances": ["yaw_momentum"]}, "observer.disturbances", "did you mean yaw_moment?"),
        ({"measurement_noise": {"alpha": 1.0}}, "observer.measurement_noise", "alpha_v"),
        ({"process_noise": {"states": {"omega": 1.0}}}, "observer.process_noise.states", "omega_h"),
        ({"process_noise": {"angel": 1.0}}, "observer.process_noise.angel", "angle"),
        ({"alpha": 0.0}, "observer.alpha", ">"),
        ({"kappa": -11.0}, "observer.kappa", "above -10"),
    ],
)
def test_mistakes_are_reported_by_key(options: dict[str, object], where: str, remedy: str) -> None:
    node = {"_target_": "trms_cli.observers.ukf.Ukf", **options}
    with pytest.raises(ConfigurationError) as caught:
        build(node, "observer").init(setup_for(Newtonian()))
    error = caught.value
    assert error.where == where
    assert remedy in f"{error.problem} {error.remedy}"


def test_a_channel_without_declared_noise_is_refused() -> None:
    model = Newtonian()
    setup = ObserverSetup(model, SAMPLE_TIME, ("alpha_v",), {}, np.zeros(1), np.zeros(2))
    with pytest.raises(ConfigurationError, match="noise of 'alpha_v'"):
        Ukf().init(setup)
