"""On a linear plant every filter is the textbook's Kalman filter, and near a point they agree. The
unscented and the extended filter give filterpy's estimates; how the first starts.
"""

import casadi as ca
import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints
from scipy.linalg import solve_discrete_are

from trms_cli.core.errors import ConfigurationError
from trms_cli.models.discretisation import discretise
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model, names
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.steady_state import SteadyState
from trms_cli.observers.augmentation import InitialSd, ProcessNoise
from trms_cli.observers.ekf import Ekf
from trms_cli.observers.filterpy_ukf import FilterpyUkf
from trms_cli.observers.kalman import Kalman
from trms_cli.observers.mhe import Mhe
from trms_cli.observers.observer import Observer, ObserverSetup
from trms_cli.observers.state_dependent_ekf import StateDependentEkf
from trms_cli.observers.ukf import SigmaPoints, Ukf

from ..models.simulate import rates
from .observed_rigs import NOISE_SD, SAMPLE_TIME, TRIM, Pendulum, Rig, commands, setup_for

TOLD = {
    "disturbances": ("moment",),
    "process_noise": ProcessNoise(angle=0.01, momentum=0.1, rotor=0.2, disturbance=0.05),
    "measurement_noise": {"angle": 0.02, "speed": 0.1},
    "initial_sd": InitialSd(rotor=1.0),
    "gate": None,
}
SETUP = ObserverSetup(
    Pendulum(), SAMPLE_TIME, ("angle", "speed"), {}, np.array([0.1, np.nan]), np.array([0.2])
)


def textbook() -> tuple[np.ndarray, ...]:
    """A, B, H, Q, R of the pendulum with a torque, sampled."""
    linear = discretise(Pendulum(), SAMPLE_TIME).linearised()(np.zeros(3), 0.0, [], np.zeros(2))
    A, B = np.eye(4), np.zeros((4, 1))
    A[:3, :3], A[:3, 3:], B[:3] = np.array(linear[1]), np.array(linear[4])[:, :1], linear[2]
    H = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0]])
    R = np.diag([0.02**2, 0.1**2])
    Q = np.diag(np.array([0.01, 0.1, 0.2, 0.05]) ** 2) * SAMPLE_TIME
    return A, B, H, Q, R


def prior_of(observer: Observer) -> tuple[np.ndarray, np.ndarray]:
    state = observer.init(SETUP)
    state = getattr(state, "arrival", state)
    return state.prior_mean.copy(), state.prior_covariance.copy()


@pytest.mark.parametrize(
    "observer",
    [
        Ukf(**TOLD),
        Ukf(alpha=0.1, **TOLD),
        Ekf(**TOLD),
        StateDependentEkf(**TOLD),
        StateDependentEkf(origin={"angle": 0.3, "speed": 1.0}, origin_command={"u": 0.5}, **TOLD),
        Kalman(**TOLD),
        Kalman(operating_point={"angle": 0.2}, **TOLD),
        Mhe(horizon=0.6, within_stops=False, **TOLD),
        Mhe(horizon=0.02, **TOLD),
        Mhe(horizon=0.4, iterations=3, **TOLD),
        Mhe(horizon=0.1, arrival="ekf", **TOLD),
    ],
    ids=[
        *("ukf", "ukf, narrow", "ekf", "sd-ekf", "sd-ekf, far origin", "kalman"),
        *("kalman, elsewhere", "mhe, long", "mhe, one sample", "mhe, iterated", "mhe on ekf"),
    ],
)
def test_every_filter_is_the_kalman_filter(observer: Observer) -> None:
    """Also with missing samples."""
    A, B, H, Q, R = textbook()
    m, P = prior_of(observer)
    state = observer.init(SETUP)
    random = np.random.default_rng(1)
    for k in range(200):
        u, y = np.array([np.sin(0.1 * k)]), random.standard_normal(2)
        if k % 7 == 3:
            y[k % 2] = np.nan
        if k % 31 == 30:
            y[:] = np.nan
        if k > 0:
            m, P = A @ m + B @ u, A @ P @ A.T + Q
        expected = H @ m + np.array([0.1 * u[0], 0.0])
        seen = np.isfinite(y)
        h = H[seen]
        K = P @ h.T @ np.linalg.inv(h @ P @ h.T + R[np.ix_(seen, seen)])
        S_all = H @ P @ H.T + R
        m, P = m + K @ (y - expected)[seen], P - K @ h @ P
        estimate = observer.step(state, u, y, None)
        for got, want in (
            (estimate.predicted, expected),
            (estimate.innovation, y - expected),
            (estimate.innovation_sd, np.sqrt(np.diag(S_all))),
            (estimate.x, m[:3]),
            (estimate.sd, np.sqrt(np.diag(P))[:3]),
            (estimate.disturbance, [m[3], 0.0]),
            (estimate.disturbance_sd, [np.sqrt(P[3, 3]), 0.0]),
        ):
            np.testing.assert_allclose(got, want, rtol=0, atol=1e-8)
    assert getattr(state, "recoveries", 0) == getattr(state, "fallbacks", 0) == 0


def test_a_window_that_began_at_the_first_sample_smooths_all_of_them() -> None:
    """With a window as long as the run, its trajectory is the fixed-interval smoother's."""
    A, B, H, Q, R = textbook()
    observer = Mhe(horizon=20 * SAMPLE_TIME, **TOLD)
    m, P = prior_of(observer)
    state = observer.init(SETUP)
    random = np.random.default_rng(3)
    inputs, measured = random.standard_normal((21, 1)), random.standard_normal((21, 2))
    measured[5, 0] = measured[9, 1] = np.nan
    for u, y in zip(inputs, measured, strict=True):
        observer.step(state, u, y, None)
    # All samples at once, as one linear least-squares problem in x_0 and the noises.
    n, count = 4, 21
    slopes, centre = np.zeros((count, n, n * count)), np.zeros((count, n))
    slopes[0, :, :n], centre[0] = np.linalg.cholesky(P), m
    for k in range(1, count):
        slopes[k], centre[k] = A @ slopes[k - 1], A @ centre[k - 1] + B @ inputs[k]
        slopes[k, :, n * k : n * (k + 1)] += np.sqrt(Q)
    rows, targets = [np.eye(n * count)], [np.zeros(n * count)]
    for k in range(count):
        seen = np.isfinite(measured[k])
        root = np.sqrt(np.diag(R))[seen]
        expected = H @ centre[k] + np.array([0.1 * inputs[k, 0], 0.0])
        rows.append((H @ slopes[k])[seen] / root[:, None])
        targets.append((measured[k] - expected)[seen] / root)
    noises = np.linalg.lstsq(np.vstack(rows), np.concatenate(targets), rcond=None)[0]
    np.testing.assert_allclose(
        state.inputs["trajectory"], (centre + slopes @ noises).T, rtol=0, atol=1e-8
    )


def test_a_steady_gain_is_that_of_the_riccati_equation_of_what_is_all_seen() -> None:
    A, _, H, Q, R = textbook()
    observer = Kalman(gain="steady", **TOLD)
    state = observer.init(SETUP)
    P_prior = solve_discrete_are(A.T, H.T, Q, R)
    K = P_prior @ H.T @ np.linalg.inv(H @ P_prior @ H.T + R)
    np.testing.assert_allclose(state.settled, P_prior - K @ H @ P_prior, rtol=1e-8, atol=1e-12)
    for _ in range(3):
        estimate = observer.step(state, np.zeros(1), np.zeros(2), None)
    np.testing.assert_allclose(
        estimate.innovation_sd, np.sqrt(np.diag(H @ P_prior @ H.T + R)), rtol=1e-8
    )
    setup = ObserverSetup(
        Pendulum(), SAMPLE_TIME, ("speed",), {"speed": 0.1}, np.zeros(1), np.zeros(1)
    )
    both = {**TOLD, "disturbances": ("moment", "motor"), "measurement_noise": {}}
    with pytest.raises(ConfigurationError, match="does not settle"):
        Kalman(gain="steady", **both).init(setup)


def test_near_an_operating_point_linear_state_dependent_and_extended_filter_agree() -> None:
    """The smaller the motion, the closer: differences fall with its square."""
    model = Newtonian()
    target = SteadyState(model).solve(np.array([0.1, 0.5]))
    at = dict(zip(model.state_names, target.x.tolist(), strict=True))
    command = dict(zip(names(model.inputs), target.u.tolist(), strict=True))
    angles = dict(zip(model.controlled, (0.1, 0.5), strict=True))
    observers = [
        Ekf(),
        StateDependentEkf(origin=at, origin_command=command),
        Kalman(operating_point=angles),
        Mhe(horizon=0.2, arrival="ekf"),
        Ukf(),
    ]
    differences = []
    for size in (0.04, 0.01):
        estimates = []
        for observer in observers:
            rig = Rig(model, names(model.outputs))
            rig.sd = np.zeros(4)
            rig.x = target.x.copy()
            setup = ObserverSetup(
                model, SAMPLE_TIME, names(model.outputs), NOISE_SD, rig.measure(), target.u
            )
            state, rows, before = observer.init(setup), [], target.u
            for k in range(100):
                u = target.u + size * np.sin([0.1 * k, 0.17 * k])
                rows.append(observer.step(state, before, rig.measure(), None).x.copy())
                rig.advance(u)
                before = u
            estimates.append(np.array(rows))
        differences.append(
            [
                np.abs((rows - estimates[0]) / np.ptp(estimates[0], axis=0)).max()
                for rows in estimates
            ]
        )
    large, small = np.array(differences)[:, 1:]
    # Relative to the motion: a quarter of it, a quarter of the difference. The sigma points lie
    # as far out as the covariance says, however small the motion is.
    assert np.all(large < 0.05)
    assert np.all(small[:3] < 0.4 * large[:3])
    assert small[3] < 0.01


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


def test_it_starts_from_measurements_of_declared_noise_and_rotors_that_turn_as_commanded() -> None:
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
    setup = ObserverSetup(model, SAMPLE_TIME, ("alpha_v",), {}, np.zeros(1), np.zeros(2))
    with pytest.raises(ConfigurationError, match="noise of 'alpha_v'"):
        Ukf().init(setup)
