"""What every filter has to do on the rig's models, whatever it is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.discretisation import discretise
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model, names
from trms_cli.models.newtonian import Newtonian
from trms_cli.observers.augmentation import FilterOptions, InitialSd, ProcessNoise
from trms_cli.observers.ekf import Ekf
from trms_cli.observers.filterpy_ukf import FilterpyUkf
from trms_cli.observers.kalman import Kalman
from trms_cli.observers.mhe import Mhe
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.recursive_filter import FilterState
from trms_cli.observers.state_dependent_ekf import StateDependentEkf
from trms_cli.observers.ukf import Ukf

from ..models.network_case import rig_like
from .observed_rigs import NOISE_SD, SAMPLE_TIME, Rig, commands, followed, setup_for

ALL = [Ukf, FilterpyUkf, Ekf, StateDependentEkf, Kalman, Mhe]
NONLINEAR = [Ukf, FilterpyUkf, Ekf, StateDependentEkf, Mhe]
"""Those that are to follow the rig far from any one point."""
UKF = "ukf.Ukf"
SD_EKF = "state_dependent_ekf.StateDependentEkf"


def made(kind: type[FilterOptions], **options: Any) -> Any:
    """An observer for rigs that have no mechanical stops."""
    return kind(**options, **({"within_stops": False} if kind is Mhe else {}))


def begun(kind: type[FilterOptions], seed: int = 0) -> tuple[Any, Any, Rig]:
    """An observer of the Newtonian rig, its state, and the rig."""
    model, observer = Newtonian(), made(kind)
    return observer, observer.init(setup_for(model)), Rig(model, names(model.outputs), seed)


def filter_of(state: Any) -> FilterState:
    """The recursive filter, of a moving horizon the one that it rests on."""
    return getattr(state, "arrival", state)


def covariance_of(state: Any) -> np.ndarray:
    return filter_of(state).function.inputs[1]


@pytest.mark.parametrize("kind", NONLINEAR)
@pytest.mark.parametrize(
    "outputs", [("alpha_v", "alpha_h", "omega_v", "omega_h"), ("alpha_h", "alpha_v")]
)
def test_errors_are_as_large_as_it_says(
    kind: type[FilterOptions], outputs: tuple[str, ...]
) -> None:
    """NEES and NIS, averaged over time and seeds, lie where χ² puts them."""
    model = Newtonian()
    observer = made(
        kind,
        process_noise=ProcessNoise(angle=1e-3, momentum=0.02, rotor=2.0, disturbance=0.0),
        disturbances=(),
        initial_sd=InitialSd(angle=0.02, rotor=10.0),
    )
    kinds_sd = np.array([2.0, 0.02, 1e-3, 2.0, 0.02, 1e-3]) * np.sqrt(SAMPLE_TIME)
    nees, nis = [], []
    for seed in range(12):
        rig = Rig(model, outputs, seed)
        state = observer.init(setup_for(model, outputs))
        prior = filter_of(state)
        spread = np.sqrt(np.diag(prior.prior_covariance))
        rig.x = prior.prior_mean + spread * rig.random.standard_normal(model.n_x)
        for k, estimate in followed(observer, state, rig, commands(250), noise_sd=kinds_sd):
            if k >= 50:
                error = rig.x - estimate.x
                nees.append(error @ np.linalg.solve(covariance_of(state), error))
                nis.append(np.mean((estimate.innovation / estimate.innovation_sd) ** 2))
    # 2400 samples, correlated over a second or so: the effective count is a few hundred, and the
    # bounds are three standard deviations of a mean of 200 such squares.
    assert np.mean(nees) == pytest.approx(model.n_x, abs=3 * np.sqrt(2 * model.n_x / 200))
    assert np.mean(nis) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("kind", NONLINEAR)
@pytest.mark.parametrize(
    "model",
    [
        Newtonian(freedom="vertical"),
        Newtonian(freedom="horizontal", currents="dynamic"),
        Newtonian(currents="dynamic"),
        Lagrangian(),
        extend_model(Newtonian(), {"slow": InputDelay(rotor="main", delay=0.07)}),
        extend_model(Newtonian(), {"dry": CoulombFriction(axis="yaw", torque=0.002)}),
    ],
    ids=["vertical", "horizontal, currents", "currents", "lagrangian", "delay", "friction"],
)
def test_every_model_is_followed(kind: type[FilterOptions], model: Model) -> None:
    outputs = names(model.outputs)
    observer = made(kind)
    state = observer.init(setup_for(model))
    rig = Rig(model, outputs)
    for k, estimate in followed(observer, state, rig, commands(400, model.n_u)):
        if k > 50:
            assert np.all(np.abs(estimate.x - rig.x[: model.n_x]) < 6 * estimate.sd + 1e-9)
    assert filter_of(state).recoveries == getattr(state, "fallbacks", 0) == 0


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("torque", [0.01, -0.02])
def test_a_constant_torque_on_yaw_is_estimated_without_bias(
    kind: type[FilterOptions], torque: float
) -> None:
    observer, state, rig = begun(kind)
    found = []
    still = np.tile([0.5, 0.3], (1500, 1))
    for k, estimate in followed(observer, state, rig, still, np.array([0.0, torque, 0, 0])):
        if k > 1000:
            found.append(estimate.disturbance.copy())
    mean, sd = np.mean(found, axis=0), estimate.disturbance_sd
    # Also of the linear filter, far from where it was made linear: it tells the model's torque.
    assert mean[1] == pytest.approx(torque, abs=0.3 * sd[1])
    if kind is not Kalman:
        assert np.all(np.abs(mean[[0, 2, 3]]) < 0.3 * sd[[0, 2, 3]])
        assert sd[1] < 0.3 * abs(torque)
    settled = np.abs(np.array(estimate.x) - rig.x)[[2, 5]]
    assert np.all(settled < 4 * estimate.sd[[2, 5]])


@pytest.mark.parametrize("kind", ALL)
def test_missing_samples_widen_and_heal(kind: type[FilterOptions]) -> None:
    observer, state, rig = begun(kind)
    widths = []
    for k, estimate in followed(observer, state, rig, commands(600), lost=range(200, 300)):
        assert np.isnan(estimate.innovation).all() == (200 <= k < 300)
        if kind is not Kalman:
            assert np.all(np.abs(estimate.x - rig.x) < 5 * estimate.sd)
        assert np.all(np.isfinite(estimate.x))
        widths.append(estimate.sd.copy())
    assert np.all(widths[299] > widths[199])
    np.testing.assert_allclose(widths[599], widths[199], rtol=0.05)


def test_a_window_without_any_measurement_is_the_models_own_motion() -> None:
    """Longer than the horizon: all that the estimator has is what it knew before.

    Each window is solved anew, from another beginning: they agree to a thousandth of what is known.
    """
    model = Newtonian()
    observer = Mhe(horizon=0.2)
    state, rig = observer.init(setup_for(model)), Rig(model, names(model.outputs))
    free = Rig(model, names(model.outputs))
    for k, estimate in followed(observer, state, rig, commands(160), lost=range(100, 160)):
        if k == 109:  # the last measurement leaves the window
            free.x, torques = estimate.x.copy(), estimate.disturbance.copy()
        elif k > 109:
            free.advance(commands(160)[k - 1], torques)
            assert np.all(np.abs(estimate.x - free.x) < 1e-3 * estimate.sd)
    assert state.fallbacks == 0


@pytest.mark.parametrize("kind", ALL)
def test_two_runs_in_one_process_are_equal(kind: type[FilterOptions]) -> None:
    def run() -> np.ndarray:
        observer, state, rig = begun(kind, seed=5)
        return np.array([e.x.copy() for _, e in followed(observer, state, rig, commands(80))])

    np.testing.assert_array_equal(run(), run())


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("spoiled", ["covariance", "mean", "measurement", "command"])
def test_what_cannot_be_computed_is_recovered_from(kind: type[FilterOptions], spoiled: str) -> None:
    if kind is Kalman and spoiled == "mean":
        pytest.skip("nothing overflows in a linear model")
    observer, state, rig = begun(kind)
    for _ in range(40):
        observer.step(state, np.zeros(2), rig.measure(), None)
    y, u = rig.measure(), np.zeros(2)
    if spoiled == "covariance":
        covariance_of(state)[0, 0] = -1e9
    elif spoiled == "mean":
        filter_of(state).function.inputs[0][:] = 1e200
    elif spoiled == "measurement":
        y[0] = 1e300
    else:
        u[0] = np.nan
    estimate = observer.step(state, u, y, None)
    for array in (estimate.x, estimate.sd, estimate.disturbance, estimate.innovation_sd):
        assert np.all(np.isfinite(array))
    for _ in range(500):
        estimate = observer.step(state, np.zeros(2), rig.measure(), None)
    assert np.all(np.abs(estimate.x - rig.x)[[2, 5]] < 5 * estimate.sd[[2, 5]])


@pytest.mark.parametrize("kind", [Ekf, StateDependentEkf, Mhe])
def test_a_network_is_followed(kind: type[FilterOptions], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trms_cli.core.compilation.compiler", lambda: None)
    model = rig_like()
    observer = made(kind)
    # Twice the network's own step: its slopes follow by the chain rule.
    for sample_time in (0.02, 0.04):
        setup = ObserverSetup(
            model, sample_time, tuple(NOISE_SD), NOISE_SD, model.rest()[:4], np.zeros(2)
        )
        state = observer.init(setup)
        step, x = discretise(model, sample_time).step, model.rest()
        random, u = np.random.default_rng(2), np.zeros(2)
        for k in range(60):
            y = x[:4] + np.array(list(NOISE_SD.values())) * random.standard_normal(4)
            estimate = observer.step(state, u, y, None)
            if k > 20:
                assert np.all(np.abs(estimate.x[:4] - x[:4]) < 6 * estimate.sd[:4] + 1e-9)
            u = random.uniform(-0.5, 0.5, 2) if k % 10 == 0 else u
            x = np.array(step(x, u, [], np.zeros(4)))[:, 0]


@pytest.mark.parametrize(
    ("target", "options", "where", "remedy"),
    [
        ("ekf.Ekf", {"disturbances": ["yaw"]}, "observer.disturbances", "yaw_moment"),
        ("ekf.Ekf", {"gate": 0.0}, "observer.gate", ">"),
        ("mhe.Mhe", {"bounds": {"omega": [0, 1]}}, "observer.bounds", "omega_h"),
        ("mhe.Mhe", {"bounds": {"omega_h": [1, 0]}}, "observer.bounds.omega_h", "lower"),
        ("mhe.Mhe", {"horizon": -1.0}, "observer.horizon", ">"),
        ("mhe.Mhe", {"arrival": "pf"}, "observer.arrival", "ekf"),
        ("kalman.Kalman", {"operating_point": {"alpha": 0}}, "observer.operating_point", "alpha_v"),
        ("kalman.Kalman", {"operating_point": {"alpha_v": 3.0}}, "observer.operating_point", "rad"),
        (SD_EKF, {"origin": {"w": 1.0}}, "observer.origin", "omega_h"),
        (UKF, {"disturbances": ["yaw_momentum"]}, "observer.disturbances", "mean yaw_moment?"),
        (UKF, {"measurement_noise": {"alpha": 1.0}}, "observer.measurement_noise", "alpha_v"),
        (UKF, {"process_noise": {"states": {"w": 1}}}, "observer.process_noise.states", "omega_h"),
        (UKF, {"process_noise": {"angel": 1.0}}, "observer.process_noise.angel", "angle"),
        (UKF, {"alpha": 0.0}, "observer.alpha", ">"),
        (UKF, {"kappa": -11.0}, "observer.kappa", "above -10"),
    ],
)
def test_mistakes_are_reported_by_key(
    target: str, options: dict[str, object], where: str, remedy: str
) -> None:
    node = {"_target_": f"trms_cli.observers.{target}", **options}
    with pytest.raises(ConfigurationError) as caught:
        build(node, "observer").init(setup_for(Newtonian()))
    assert caught.value.where == where
    assert remedy in f"{caught.value.problem} {caught.value.remedy}"
