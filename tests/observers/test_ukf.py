"""The UKF is the Kalman filter on linear plants, and filterpy's UKF on the rig's model."""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca
import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extended
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Axis, Model, Signal, names
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.parameters import ParameterSet
from trms_cli.observers.noise_tables import InitialSd, ProcessNoise
from trms_cli.observers.observer import Estimate, ObserverSetup
from trms_cli.observers.recursive_filter import FilterState
from trms_cli.observers.sigma_points import SigmaPoints
from trms_cli.observers.ukf import Ukf

NOISE_SD = {"alpha_v": 5e-4, "alpha_h": 5e-4, "omega_v": 1.6, "omega_h": 1.6}
SAMPLE_TIME = 0.02
TRIM = np.array([1.413, 0.3])


class Pendulum(Model):
    """A linear rig: one axis with a spring and a damper, and a motor with lag."""

    def __init__(self) -> None:
        self.name = "pendulum"
        self.states = (
            Signal("angle", "rad"),
            Signal("momentum", "rad/s"),
            Signal("speed", "rad/s"),
        )
        self.inputs = (Signal("u", "V"),)
        self.outputs = (Signal("angle", "rad"), Signal("speed", "rad/s"))
        self.disturbances = (Signal("moment", "N*m"), Signal("motor", "N*m"))
        self.parameters = ParameterSet([], "pendulum")
        self.controlled = ("angle",)
        self.input_limits = {"u": 1.0}
        self.stops = {"angle": np.inf}
        self.axes = {"swing": Axis("angle", "moment")}
        self.rotors = {"motor": "u"}

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        return ca.vertcat(
            x[1], -2.0 * x[0] - 0.1 * x[1] + 0.5 * x[2] + 3.0 * w[0], 4.0 * (u - x[2]) + w[1]
        )

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        return ca.vertcat(x[0] + 0.1 * u[0], x[2])


def setup_for(model: Model, outputs: tuple[str, ...] | None = None) -> ObserverSetup:
    outputs = outputs or names(model.outputs)
    return ObserverSetup(
        model,
        SAMPLE_TIME,
        outputs,
        NOISE_SD,
        np.zeros(len(outputs)),
        np.array([TRIM[("u_v", "u_h").index(name)] for name in names(model.inputs)]),
    )


class Rig:
    """The model itself, disturbed as the filter believes it is."""

    def __init__(self, model: Model, outputs: tuple[str, ...], seed: int = 0) -> None:
        self.random = np.random.default_rng(seed)
        self.discrete = discretise(model, SAMPLE_TIME)
        self.step_function = BufferedFunction(self.discrete.step)
        self.rows = [model.state_index(name) for name in outputs]
        self.sd = np.array([NOISE_SD[name] for name in outputs])
        self.p = model.parameters.values
        self.x = self.discrete.initial(model.rest(), np.zeros(model.n_u))

    def measure(self) -> np.ndarray:
        return self.x[self.rows] + self.sd * self.random.standard_normal(len(self.rows))

    def advance(self, u: np.ndarray, w: np.ndarray, noise_sd: np.ndarray | float = 0.0) -> None:
        self.x = self.step_function.evaluate(self.x, u, self.p, w)[0].copy()
        self.x += noise_sd * self.random.standard_normal(self.x.size)


def followed(
    observer: Ukf,
    state: FilterState,
    rig: Rig,
    inputs: np.ndarray,
    torque: np.ndarray | float = 0.0,
    noise_sd: np.ndarray | float = 0.0,
    lost: range = range(0),
) -> Iterator[tuple[int, Estimate]]:
    """Run rig and observer; at each sample, before the rig moves on, the estimate is yielded."""
    w = np.zeros(rig.discrete.model.n_w) + torque
    u_before = inputs[0]
    for k, u in enumerate(inputs):
        y = rig.measure()
        if k in lost:
            y[:] = np.nan
        yield k, observer.step(state, u_before, y, None)
        rig.advance(u, w, noise_sd)
        u_before = u


def mean_and_covariance(state: FilterState) -> tuple[np.ndarray, np.ndarray]:
    return state.function.inputs[0], state.function.inputs[1]


def commands(samples: int, n_u: int = 2) -> np.ndarray:
    """Around the trim, different on each input, within the limits."""
    t = np.arange(samples) * SAMPLE_TIME
    columns = [TRIM[i % 2] + 0.3 * np.sin((1.3 + 0.7 * i) * t) for i in range(n_u)]
    return np.stack(columns, axis=1)


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


@pytest.mark.parametrize("alpha", [1.0, 0.1])
def test_on_a_linear_plant_it_is_the_kalman_filter(alpha: float) -> None:
    model = Pendulum()
    process = ProcessNoise(angle=0.01, momentum=0.1, rotor=0.2, disturbance=0.05)
    observer = Ukf(
        alpha=alpha,
        disturbances=("moment",),
        process_noise=process,
        measurement_noise={"angle": 0.02, "speed": 0.1},
        initial_sd=InitialSd(rotor=1.0),
    )
    setup = ObserverSetup(
        model, SAMPLE_TIME, ("angle", "speed"), {}, np.array([0.1, np.nan]), np.array([0.2])
    )
    state = observer.init(setup)
    n = 4
    linear = discretise(model, SAMPLE_TIME).linearised()(np.zeros(3), 0.0, [], np.zeros(2))
    A, B, G = np.eye(n), np.zeros((n, 1)), np.array(linear[4])[:, :1]
    A[:3, :3], A[:3, 3:], B[:3] = np.array(linear[1]), G, np.array(linear[2])
    H = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0]])
    R = np.diag([0.02**2, 0.1**2])
    Q = np.diag(np.array([0.01, 0.1, 0.2, 0.05]) ** 2) * SAMPLE_TIME
    m, P = (array.copy() for array in (state.prior_mean, state.prior_covariance))

    random = np.random.default_rng(1)
    for k in range(200):
        u = np.array([np.sin(0.1 * k)])
        y = random.standard_normal(2)
        if k % 7 == 3:
            y[k % 2] = np.nan
        if k % 31 == 30:
            y[:] = np.nan
        if k > 0:
            m, P = A @ m + B @ u, A @ P @ A.T + Q
        expected = H @ m + np.array([0.1 * u[0], 0.0])
        seen = np.isfinite(y)
        h = H[seen]
        S = h @ P @ h.T + R[np.ix_(seen, seen)]
        K = P @ h.T @ np.linalg.inv(S)
        all_S = H @ P @ H.T + R
        m, P = m + K @ (y - expected)[seen], P - K @ h @ P
        estimate = observer.step(state, u, y, None)
        np.testing.assert_allclose(estimate.predicted, expected, rtol=0, atol=1e-9)
        np.testing.assert_allclose(estimate.innovation, y - expected, rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            estimate.innovation_sd, np.sqrt(np.diag(all_S)), rtol=0, atol=1e-9
        )
        np.testing.assert_allclose(estimate.x, m[:3], rtol=0, atol=1e-9)
        np.testing.assert_allclose(estimate.sd, np.sqrt(np.diag(P))[:3], rtol=0, atol=1e-9)
        np.testing.assert_allclose(estimate.disturbance, [m[3], 0.0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            estimate.disturbance_sd, [np.sqrt(P[3, 3]), 0.0], rtol=0, atol=1e-9
        )
        np.testing.assert_allclose(mean_and_covariance(state)[1], P, rtol=0, atol=1e-9)
    assert state.recoveries == 0


@pytest.mark.parametrize("currents", ["quasi_static", "dynamic"])
def test_on_the_rigs_model_it_is_filterpys(currents: str) -> None:
    model = Newtonian(currents=currents)
    outputs = names(model.outputs)
    observer = Ukf(disturbances=("pitch_moment", "yaw_moment"))
    state = observer.init(setup_for(model))
    discrete = discretise(model, SAMPLE_TIME)
    step, p = BufferedFunction(discrete.step), model.parameters.values
    rows = [model.state_index(name) for name in outputs]
    n = model.n_x + 2

    def fx(z: np.ndarray, dt: float, u: np.ndarray) -> np.ndarray:
        w = np.array([*z[model.n_x :], 0.0, 0.0])
        return np.concatenate([step.evaluate(z[: model.n_x], u, p, w)[0], z[model.n_x :]])

    points = MerweScaledSigmaPoints(n, observer.alpha, observer.beta, observer.kappa)
    theirs = UnscentedKalmanFilter(n, 4, SAMPLE_TIME, lambda z: z[rows], fx, points)
    theirs.x, theirs.P = state.prior_mean.copy(), state.prior_covariance.copy()
    names_of_inputs = state.function.function.name_in()
    theirs.Q = np.diag(state.function.inputs[names_of_inputs.index("q")])
    theirs.R = np.diag([NOISE_SD[name] ** 2 for name in outputs])

    rig = Rig(model, outputs)
    u_before = np.zeros(2)
    for k, u in enumerate(commands(150)):
        y = rig.measure()
        if k > 0:
            theirs.predict(u=u_before)
        # filterpy does not draw the points anew after process noise is added
        theirs.sigmas_f = points.sigma_points(theirs.x, theirs.P)
        theirs.update(y)
        estimate = observer.step(state, u_before, y, None)
        scale = np.sqrt(np.diag(theirs.P))
        np.testing.assert_allclose(
            estimate.x / scale[: model.n_x],
            theirs.x[: model.n_x] / scale[: model.n_x],
            rtol=0,
            atol=1e-6,
        )
        np.testing.assert_allclose(estimate.sd, scale[: model.n_x], rtol=1e-6)
        np.testing.assert_allclose(
            estimate.disturbance[:2] / scale[model.n_x :],
            theirs.x[model.n_x :] / scale[model.n_x :],
            rtol=0,
            atol=1e-6,
        )
        u_before = u
        rig.advance(u, np.zeros(4))


@pytest.mark.parametrize(
    "outputs", [("alpha_v", "alpha_h", "omega_v", "omega_h"), ("alpha_h", "alpha_v")]
)
def test_errors_are_as_large_as_it_says(outputs: tuple[str, ...]) -> None:
    """NEES and NIS, averaged over time and seeds, lie where χ² puts them."""
    model = Newtonian()
    process = ProcessNoise(angle=1e-3, momentum=0.02, rotor=2.0, disturbance=0.0)
    observer = Ukf(
        process_noise=process, disturbances=(), initial_sd=InitialSd(angle=0.02, rotor=10.0)
    )
    kinds_sd = np.array([2.0, 0.02, 1e-3, 2.0, 0.02, 1e-3]) * np.sqrt(SAMPLE_TIME)
    nees, nis = [], []
    for seed in range(12):
        rig = Rig(model, outputs, seed)
        state = observer.init(setup_for(model, outputs))
        prior, spread = state.prior_mean, np.sqrt(np.diag(state.prior_covariance))
        rig.x = prior + spread * rig.random.standard_normal(model.n_x)
        for k, estimate in followed(observer, state, rig, commands(250), noise_sd=kinds_sd):
            if k >= 50:
                error = rig.x - estimate.x
                nees.append(error @ np.linalg.solve(mean_and_covariance(state)[1], error))
                nis.append(np.mean((estimate.innovation / estimate.innovation_sd) ** 2))
    # 2400 samples, correlated over a second or so: the effective count is a few hundred, and the
    # bounds are three standard deviations of a mean of 200 such squares.
    assert np.mean(nees) == pytest.approx(model.n_x, abs=3 * np.sqrt(2 * model.n_x / 200))
    assert np.mean(nis) == pytest.approx(1.0, abs=0.1)


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


def test_missing_samples_widen_and_heal() -> None:
    model = Newtonian()
    outputs = names(model.outputs)
    rig, observer = Rig(model, outputs), Ukf()
    state = observer.init(setup_for(model))
    widths = []
    for k, estimate in followed(observer, state, rig, commands(600), lost=range(200, 300)):
        assert np.isnan(estimate.innovation).all() == (200 <= k < 300)
        assert np.all(np.abs(estimate.x - rig.x) < 5 * estimate.sd)
        widths.append(estimate.sd.copy())
    assert np.all(widths[299] > widths[199])
    np.testing.assert_allclose(widths[599], widths[199], rtol=0.05)


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


@pytest.mark.parametrize("spoiled", ["covariance", "mean", "measurement", "command"])
def test_what_cannot_be_factorised_is_recovered_from(spoiled: str) -> None:
    model = Newtonian()
    observer = Ukf()
    state = observer.init(setup_for(model))
    rig = Rig(model, names(model.outputs))
    for _ in range(5):
        observer.step(state, np.zeros(2), rig.measure(), None)
    y, u = rig.measure(), np.zeros(2)
    if spoiled == "covariance":
        state.function.inputs[1][0, 0] = -1.0
    elif spoiled == "mean":
        state.function.inputs[0][:] = 1e200
    elif spoiled == "measurement":
        y[0] = 1e300
    else:
        u[0] = np.nan
    estimate = observer.step(state, u, y, None)
    assert state.recoveries > 0 or spoiled == "measurement"
    for array in (estimate.x, estimate.sd, estimate.disturbance, estimate.innovation_sd):
        assert np.all(np.isfinite(array))
    for _ in range(500):
        estimate = observer.step(state, np.zeros(2), rig.measure(), None)
    assert np.all(np.abs(estimate.x - rig.x) < 5 * estimate.sd)


def test_two_runs_in_one_process_are_equal() -> None:
    model = Newtonian()
    observer = Ukf()

    def run() -> np.ndarray:
        state = observer.init(setup_for(model))
        rig = Rig(model, names(model.outputs), seed=5)
        return np.array([e.x.copy() for _, e in followed(observer, state, rig, commands(100))])

    np.testing.assert_array_equal(run(), run())


@pytest.mark.parametrize(
    "model",
    [
        Newtonian(freedom="vertical"),
        Newtonian(freedom="horizontal", currents="dynamic"),
        extended(Newtonian(), {"slow": InputDelay(rotor="main", delay=0.07)}),
        extended(Newtonian(), {"dry": CoulombFriction(axis="yaw", torque=0.002)}),
    ],
    ids=["vertical", "horizontal", "delay", "friction"],
)
def test_every_model_is_followed(model: Model) -> None:
    outputs = names(model.outputs)
    observer = Ukf()
    state = observer.init(setup_for(model))
    rig = Rig(model, outputs)
    for k, estimate in followed(observer, state, rig, commands(500, model.n_u)):
        if k > 50:
            assert np.all(np.abs(estimate.x - rig.x[: model.n_x]) < 6 * estimate.sd + 1e-9)
    assert state.recoveries == 0


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
