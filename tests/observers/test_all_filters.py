"""What every filter has to do on the rig's models, whatever it is; outliers are held back, and
nothing is held back for ever. The moving-horizon estimator: its bounds, its two ways to solve, and
what stands in.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build
from trms_cli.core.qp import Daqp, Qp
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.effects.quantisation import Quantisation
from trms_cli.models.discretisation import discretise
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model, names
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.models.vector_field import holds_at_rest
from trms_cli.observers import mhe
from trms_cli.observers.augmentation import FilterOptions, InitialSd, ProcessNoise
from trms_cli.observers.ekf import Ekf
from trms_cli.observers.filterpy_ukf import FilterpyUkf
from trms_cli.observers.kalman import Kalman
from trms_cli.observers.mhe import Mhe, MheState
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.recursive_filter import FilterState, Gate
from trms_cli.observers.state_dependent_ekf import StateDependentEkf
from trms_cli.observers.ukf import Ukf

from ..models.network_case import rig_like
from .observed_rigs import NOISE_SD, SAMPLE_TIME, Pendulum, Rig, commands, followed, setup_for

ALL = [Ukf, FilterpyUkf, Ekf, StateDependentEkf, Kalman, Mhe]
NONLINEAR = [Ukf, FilterpyUkf, Ekf, StateDependentEkf, Mhe]
"""Those that are to follow the rig far from any one point."""
UKF = "ukf.Ukf"
SD_EKF = "state_dependent_ekf.StateDependentEkf"
NEWTONIAN = Newtonian()


def made(kind: type[FilterOptions], **options: Any) -> Any:
    """An observer for rigs that have no mechanical stops."""
    return kind(**options, **({"within_stops": False} if kind is Mhe else {}))


def begun(kind: type[FilterOptions]) -> tuple[Any, Any, Rig]:
    """An observer of the Newtonian rig, its state, and the rig."""
    observer = made(kind)
    return observer, observer.init(setup_for(NEWTONIAN)), Rig(NEWTONIAN, names(NEWTONIAN.outputs))


def filter_of(state: Any) -> FilterState:
    """The recursive filter, of a moving horizon the one that it rests on."""
    return getattr(state, "arrival", state)


def covariance_of(state: Any) -> np.ndarray:
    return filter_of(state).function.inputs[1]


@pytest.mark.parametrize("kind", NONLINEAR)
@pytest.mark.parametrize(
    "outputs", [("alpha_v", "alpha_h", "omega_v", "omega_h"), ("alpha_h", "alpha_v")]
)
def test_errors_are_as_large_as_it_says(kind, outputs) -> None:
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
    observer = made(kind)
    state, rig = observer.init(setup_for(model)), Rig(model, names(model.outputs))
    for k, estimate in followed(observer, state, rig, commands(400, model.n_u)):
        if k > 50:
            assert np.all(np.abs(estimate.x - rig.x[: model.n_x]) < 6 * estimate.sd + 1e-9)
    assert filter_of(state).recoveries == getattr(state, "fallbacks", 0) == 0


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("torque", [0.01, -0.02])
def test_a_constant_torque_on_yaw_is_estimated_without_bias(kind, torque) -> None:
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


STICKING = extend_model(NEWTONIAN, {"dry": CoulombFriction(axis="yaw", torque=0.005)})


def _quantised(k: int, y: np.ndarray) -> np.ndarray:
    """Angles of an encoder of 4096 lines: what an axis at rest shows."""
    quantum = 2 * np.pi / 4096
    return np.concatenate([quantum * np.round(y[:2] / quantum), y[2:]])


@pytest.mark.parametrize("kind", [Ukf, FilterpyUkf, Ekf, StateDependentEkf, Mhe])
def test_a_torque_that_friction_takes_up_does_not_wander(kind: type[FilterOptions]) -> None:
    """At rest within the cone a torque is not observable: its estimate stays, and stays as sure."""
    observer = made(kind)
    rig = Rig(STICKING, names(STICKING.outputs))
    setup = setup_for(STICKING)
    setup = replace(setup, first_measurement=rig.measure())
    state = observer.init(setup)
    resting = np.tile([0.0, 0.0], (1500, 1))
    torques, spreads = [], []
    for k, estimate in followed(observer, state, rig, resting, spoil=_quantised):
        if k >= 100:
            torques.append(estimate.disturbance[1])
            spreads.append(estimate.disturbance_sd[1])
    assert np.ptp(torques) < 0.0003  # N m, of a cone of ±0.005
    assert spreads[-1] < 1.02 * spreads[0]


@pytest.mark.parametrize("kind", [Ukf, FilterpyUkf, Ekf, Mhe])
def test_a_torque_that_overcomes_friction_is_estimated(kind: type[FilterOptions]) -> None:
    observer = made(kind)
    state, rig = observer.init(setup_for(STICKING)), Rig(STICKING, names(STICKING.outputs))
    still, torque = np.tile([0.5, 0.3], (1000, 1)), np.array([0.0, 0.03, 0.0, 0.0])
    errors = []
    for k, estimate in followed(observer, state, rig, still, torque, spoil=_quantised):
        if k >= 100 and abs(estimate.x[1]) > 0.05:  # it turns
            errors.append(estimate.disturbance[1] - torque[1])
    assert len(errors) > 100
    assert abs(np.mean(errors)) < 0.002


def test_the_unscented_filters_agree_on_an_axis_with_friction() -> None:
    estimates = []
    for kind in (Ukf, FilterpyUkf):
        observer = made(kind)
        state, rig = observer.init(setup_for(STICKING)), Rig(STICKING, names(STICKING.outputs))
        run = followed(observer, state, rig, commands(300), spoil=_quantised)
        estimates.append([np.concatenate([e.x, e.disturbance, e.sd]) for _, e in run])
    np.testing.assert_allclose(*estimates, rtol=1e-6, atol=1e-9)


def test_friction_that_stops_nothing_is_propagated_point_by_point() -> None:
    """Of a model without dry friction, or with a regularised one, all filters are as they were."""
    for model in (NEWTONIAN, QuanserAero(), extend_model(QuanserAero(), {})):
        assert not holds_at_rest(model)
    assert holds_at_rest(STICKING)
    assert holds_at_rest(extend_model(STICKING, {"slow": InputDelay(rotor="main", delay=0.07)}))


@pytest.mark.parametrize("kind", NONLINEAR)
def test_a_rounding_sensor_is_taken_for_a_noisy_one(kind: type[FilterOptions]) -> None:
    """Within a quantum all points of a filter read alike: it would follow nothing for a while."""
    quantum = 0.006
    coarse = extend_model(NEWTONIAN, {"coarse": Quantisation(axis="pitch", quantum=quantum)})
    observer = made(kind)
    state, rig = observer.init(setup_for(coarse)), Rig(NEWTONIAN, names(NEWTONIAN.outputs))

    def rounded(k: int, y: np.ndarray) -> np.ndarray:
        return np.concatenate([quantum * np.round(y[:1] / quantum), y[1:]])

    errors = []
    for k, estimate in followed(observer, state, rig, commands(600), spoil=rounded):
        if k > 100:
            errors.append(estimate.x[5] - rig.x[5])
    assert np.sqrt(np.mean(np.square(errors))) < quantum / np.sqrt(12)


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
    first, second = (run(made(kind), clean, 80)[0] for _ in "ab")
    np.testing.assert_array_equal(first, second)


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


SAMPLES = 800


def run(observer: Any, spoil: Any, samples: int = SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the estimated state, (samples, 6), and what was rejected, (samples, 4)."""
    state = observer.init(setup_for(NEWTONIAN))
    rig, errors, rejected = Rig(NEWTONIAN, names(NEWTONIAN.outputs)), [], []
    for _, estimate in followed(observer, state, rig, commands(samples), spoil=spoil):
        errors.append(estimate.x - rig.x)
        rejected.append(estimate.rejected.copy())
    return np.array(errors), np.array(rejected)


def clean(k: int, y: np.ndarray) -> np.ndarray:
    return y


def with_outliers() -> Any:
    """Some samples of the angles are off by 0.3 rad."""
    random = np.random.default_rng(6)
    hit = random.random((SAMPLES, 2)) < 0.02
    sign = random.choice([-1.0, 1.0], (SAMPLES, 2))
    angles = [names(NEWTONIAN.outputs).index(name) for name in ("alpha_v", "alpha_h")]
    hit[:20] = False

    def spoil(k: int, y: np.ndarray) -> np.ndarray:
        y = y.copy()
        y[angles] += 0.3 * sign[k] * hit[k]
        return y

    spoil.hit = hit  # type: ignore[attr-defined]
    spoil.angles = angles  # type: ignore[attr-defined]
    return spoil


@pytest.mark.parametrize("kind", ALL)
def test_outliers_leave_no_trace_with_a_gate_and_a_clear_one_without(kind) -> None:
    spoil = with_outliers()

    def error(observer: Any, what: Any) -> np.ndarray:
        rows = run(observer, what)[0][50:]
        return np.sqrt(np.mean(rows[:, [2, 5]] ** 2, axis=0))

    undisturbed, gated = error(made(kind), clean), error(made(kind), spoil)
    believing = error(made(kind, gate=None), spoil)
    assert np.all(gated < 1.2 * undisturbed)
    assert np.all(believing > 3 * undisturbed)


@pytest.mark.parametrize("kind", NONLINEAR)
def test_exactly_the_outliers_are_rejected_and_their_innovation_is_told(kind) -> None:
    spoil = with_outliers()
    rejected = run(made(kind), spoil)[1]
    np.testing.assert_array_equal(rejected[:, spoil.angles] > 0, spoil.hit)
    assert not rejected[:, [i for i in range(4) if i not in spoil.angles]].any()
    observer, state, rig = begun(kind)
    for _ in range(30):
        observer.step(state, np.zeros(2), rig.measure(), None)
    y = rig.measure()
    y[0] += 0.3
    estimate = observer.step(state, np.zeros(2), y, None)
    assert estimate.rejected.tolist() == [1.0, 0.0, 0.0, 0.0]
    assert estimate.innovation[0] == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize("kind", ALL)
def test_a_channel_that_jumps_for_ever_is_believed_again(kind: type[FilterOptions]) -> None:
    """The encoder slips by a radian at 4 s: half a second later the estimate is with it."""
    yaw = names(NEWTONIAN.outputs).index("alpha_h")

    def slipped(k: int, y: np.ndarray) -> np.ndarray:
        y = y.copy()
        y[yaw] += 1.0 * (k >= 200)
        return y

    errors, rejected = run(made(kind), slipped, 400)
    patience = round(0.5 / SAMPLE_TIME)
    assert rejected[200 : 200 + patience, yaw].all()
    assert not rejected[200 + patience :, yaw].any()
    angle = NEWTONIAN.state_index("alpha_h")
    assert np.all(np.abs(errors[200 : 200 + patience - 1, angle]) < 0.1)
    assert np.all(np.abs(errors[200 + patience + 5 :, angle] - 1.0) < 0.02)
    others = [i for i in range(6) if i != angle]
    if kind is not Kalman:
        assert np.all(np.abs(errors[-1, others]) < [4.0, 0.1, 4.0, 0.1, 0.05])


def test_a_sensor_much_worse_than_declared_is_used_and_a_gate_changes_no_clean_step() -> None:
    """Noise a hundred times the declared one: after the first half second all is believed."""
    random = np.random.default_rng(0)

    def noisy(k: int, y: np.ndarray) -> np.ndarray:
        return y + np.array([0.05, 0.0, 0.0, 0.0]) * random.standard_normal(4)

    rejected = run(Ukf(gate=5.0), noisy)[1]
    assert rejected[:100, 0].mean() > 0.3
    assert rejected[SAMPLES // 2 :, 0].mean() < 0.2
    assert rejected[:, 1:].mean() < 0.02
    np.testing.assert_array_equal(run(Ukf(gate=None), clean)[0], run(Ukf(), clean)[0])


def test_the_gate_opens_after_its_patience_and_closes_after_as_long_an_agreement() -> None:
    squared, rejected = np.zeros(2), np.zeros(2)
    gate = Gate(5.0, 3, squared, rejected)
    assert squared.tolist() == [25.0, 25.0]
    assert gate.quiet()
    both, sd = np.ones(2, dtype=bool), np.ones(2)

    def sample(innovation: float, present: bool = True) -> bool:
        rejected[0] = float(present and innovation**2 > squared[0])
        here = both & np.array([present, True])
        return gate.follow(here, np.array([innovation, 0.0]), sd)

    assert [sample(9.0), sample(9.0), sample(0.0)] == [False, False, False]  # two in a row only
    assert gate.quiet()
    assert [sample(9.0), sample(9.0)] == [False, False]
    assert not sample(0.0, present=False)  # a missing sample neither counts nor breaks the run
    assert sample(9.0)  # the third: believed from now on, from a wide covariance
    assert squared.tolist() == [np.inf, 25.0]
    assert [sample(9.0), sample(0.0), sample(0.0), sample(9.0)] == [False] * 4
    assert not gate.quiet()
    assert squared[0] == np.inf
    assert [sample(0.0), sample(0.0), sample(0.0)] == [False] * 3
    assert squared.tolist() == [25.0, 25.0]
    assert gate.quiet()


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
def test_mistakes_are_reported_by_key(target, options, where, remedy) -> None:
    node = {"_target_": f"trms_cli.observers.{target}", **options}
    with pytest.raises(ConfigurationError) as caught:
        build(node, "observer").init(setup_for(NEWTONIAN))
    assert caught.value.where == where
    assert remedy in f"{caught.value.problem} {caught.value.remedy}"


def dense_step(state: MheState) -> np.ndarray:
    """The same step as a dense quadratic program: the trajectory within its bounds.

    In the normalised noises ξ (z_0 = ẑ_0 + L ξ_0, F's error √q ξ_k), whose Hessian is I + JᵀJ.
    """
    inputs, outputs, rows = state.inputs, state.outputs, state.rows
    Z, A, H = inputs["trajectory"], outputs["A"], outputs["H"]
    n, count = Z.shape
    slopes, centre = np.zeros((count, n, n * count)), np.empty((n, count))
    slopes[0, :, :n], centre[:, 0] = np.linalg.cholesky(inputs["P"]), inputs["arrival"]
    J, offset = [], []
    for k in range(count - 1):
        A_k, H_k = A[:, k * n : (k + 1) * n], H[:, k * n : (k + 1) * n]
        centre[:, k + 1] = outputs["moved"][:, k] + A_k @ (centre[:, k] - Z[:, k])
        slopes[k + 1] = A_k @ slopes[k]
        slopes[k + 1, np.arange(n), n * (k + 1) + np.arange(n)] += np.sqrt(inputs["q"])
        root = np.sqrt(inputs["believed"][:, k] / inputs["r"])
        seen = outputs["seen"][:, k] + H_k @ (centre[:, k + 1] - Z[:, k + 1])
        J.append(root[:, None] * (H_k @ slopes[k + 1]))
        offset.append(root * (inputs["y"][:, k] - seen))
    jacobian, limited = np.concatenate(J), slopes[:, rows].reshape(-1, n * count)
    free, around = np.full(n * count, np.inf), centre[rows].T.ravel()
    program = Qp(
        np.eye(n * count) + jacobian.T @ jacobian,
        -jacobian.T @ np.concatenate(offset),
        limited,
        np.concatenate([-free, np.tile(state.lower, count) - around]),
        np.concatenate([free, np.tile(state.upper, count) - around]),
        np.full(len(limited), np.inf),
        np.zeros(len(limited)),
    )
    result = Daqp().solve(Daqp().start(), program)
    assert result.solved
    return centre + (slopes @ result.z).T


@pytest.mark.parametrize(
    ("bounds", "lost"),
    [
        ({}, range(25, 29)),
        ({"alpha_v": (-0.02, 0.05)}, ()),
        ({"yaw_moment": (0.0, 1e-3), "omega_h": (-20.0, 5.0), "S_v": (-0.1, 0.2)}, range(25, 29)),
    ],
)
def test_a_step_is_the_quadratic_program_within_the_bounds(bounds, lost, monkeypatch) -> None:
    model, held, differences = Newtonian(), 0, []
    solve = mhe._within_bounds

    def compare(state: MheState) -> np.ndarray | None:
        nonlocal held
        trajectory = solve(state)
        assert trajectory is not None
        scale = np.sqrt(np.diag(state.covariances[0]))[:, None]
        differences.append(np.abs((trajectory - dense_step(state)) / scale).max())
        held += bool(state.inputs["held"].any())
        return trajectory

    monkeypatch.setattr(mhe, "_within_bounds", compare)
    observer = Mhe(horizon=0.16, within_stops=False, bounds=bounds)
    state, rig = observer.init(setup_for(model)), Rig(model, names(model.outputs))
    for _ in followed(observer, state, rig, commands(80), lost=lost):
        pass
    assert len(differences) > 60 and (held > 20) == bool(bounds)
    assert max(differences) < (1e-4 if bounds else 1e-9)  # standard deviations
    assert state.fallbacks == 0


def test_bounds_are_kept_and_used() -> None:
    """A torque that is known to push one way only: the estimate knows it too, and is better."""
    model = Pendulum()
    setup = ObserverSetup(
        model, SAMPLE_TIME, ("angle", "speed"), {"angle": 0.02, "speed": 0.1}, np.zeros(2),
        np.zeros(1),
    )  # fmt: skip
    told = {"disturbances": ("moment",)}
    bounds = {"moment": (0.0, 0.01)}
    free, within = Mhe(**told), Mhe(bounds=bounds, **told)
    estimates: dict[bool, np.ndarray] = {}
    for observer in (free, within):
        state, random = observer.init(setup), np.random.default_rng(2)
        rows = []
        for _ in range(300):
            y = np.array([0.02, 0.1]) * random.standard_normal(2)
            rows.append(observer.step(state, np.zeros(1), y, None).disturbance[0])
        estimates[observer is within] = np.array(rows)
        assert (state.bounded > 10) == (observer is within)
        assert state.fallbacks == 0
    assert estimates[False].min() < 0.0
    assert estimates[True].min() >= 0.0
    assert estimates[True].max() <= 0.01
    assert np.std(estimates[True]) < np.std(estimates[False])


def test_a_rig_at_its_stop_is_not_estimated_beyond_it() -> None:
    model = Newtonian(freedom="horizontal")
    stop = model.stops["alpha_h"]
    outputs = names(model.outputs)
    setup = ObserverSetup(
        model, SAMPLE_TIME, outputs, NOISE_SD, np.array([stop, 100.0]), np.array([2.0])
    )
    beyond = {}
    for observer in (Ekf(), Mhe()):
        state, random = observer.init(setup), np.random.default_rng(1)
        angles = []
        for _ in range(100):
            y = np.array([stop, 100.0]) + 5e-4 * random.standard_normal(2)
            angles.append(observer.step(state, np.array([2.0]), y, None).x[-1])
        beyond[type(observer)] = max(angles) - stop
    assert beyond[Ekf] > 1e-4
    assert beyond[Mhe] <= 0.0


def test_the_arrival_filter_stands_in_where_a_problem_is_not_solved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No step ends: the estimate is the filter's, cut to the bounds, and counted."""
    monkeypatch.setattr(mhe, "_ROUNDS", 0)
    model = Newtonian()
    observer = Mhe(bounds={"yaw_moment": (0.004, 0.006)})
    state, rig = observer.init(setup_for(model)), Rig(model, names(model.outputs))
    for k, estimate in followed(observer, state, rig, commands(200)):
        assert 0.004 <= estimate.disturbance[1] <= 0.006
        assert np.all(np.isfinite(estimate.x))
        if k > 50:
            assert abs(estimate.x[2] - rig.x[2]) < 0.05
    assert state.fallbacks > 100


def test_it_is_no_worse_than_its_arrival_filter() -> None:
    """Far from where both start, without tachos, where the models bend most."""
    model, channels, errors = Newtonian(), ("alpha_v", "alpha_h"), {}
    for observer in (Ekf(), Mhe(within_stops=False, iterations=2, arrival="ekf")):
        squares = []
        for seed in range(4):
            rig = Rig(model, channels, seed)
            state = observer.init(setup_for(model, channels))
            rig.x = rig.x + np.array([60.0, 0.3, 0.0, -60.0, -0.3, 0.0])
            for k, estimate in followed(observer, state, rig, commands(250)):
                if k >= 20:
                    squares.append((estimate.x - rig.x)[[0, 1, 3, 4]] ** 2)
        errors[type(observer)] = np.sqrt(np.mean(squares, axis=0))
    assert np.all(errors[Mhe] < 1.05 * errors[Ekf])
