"""Outliers are held back, and nothing is held back for ever."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trms_cli.models.model import names
from trms_cli.models.newtonian import Newtonian
from trms_cli.observers.augmentation import FilterOptions
from trms_cli.observers.kalman import Kalman
from trms_cli.observers.recursive_filter import Gate
from trms_cli.observers.ukf import Ukf

from .observed_rigs import SAMPLE_TIME, Rig, commands, followed, setup_for
from .test_all_filters import ALL, NONLINEAR, made

MODEL = Newtonian()
SAMPLES = 800


def run(observer: Any, spoil: Any, samples: int = SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the estimated state, (samples, 6), and what was rejected, (samples, 4)."""
    state = observer.init(setup_for(MODEL))
    rig, errors, rejected = Rig(MODEL, names(MODEL.outputs)), [], []
    for _, estimate in followed(observer, state, rig, commands(samples), spoil=spoil):
        errors.append(estimate.x - rig.x)
        rejected.append(estimate.rejected.copy())
    return np.array(errors), np.array(rejected)


def clean(k: int, y: np.ndarray) -> np.ndarray:
    return y


def with_outliers(share: float = 0.02, size: float = 0.3) -> Any:
    """Some samples of the angles are off by 0.3 rad."""
    random = np.random.default_rng(6)
    hit = random.random((SAMPLES, 2)) < share
    sign = random.choice([-1.0, 1.0], (SAMPLES, 2))
    angles = [names(MODEL.outputs).index(name) for name in ("alpha_v", "alpha_h")]
    hit[:20] = False

    def spoil(k: int, y: np.ndarray) -> np.ndarray:
        y = y.copy()
        y[angles] += size * sign[k] * hit[k]
        return y

    spoil.hit = hit  # type: ignore[attr-defined]
    spoil.angles = angles  # type: ignore[attr-defined]
    return spoil


@pytest.mark.parametrize("kind", ALL)
def test_outliers_leave_no_trace_with_a_gate_and_a_clear_one_without(
    kind: type[FilterOptions],
) -> None:
    spoil = with_outliers()

    def error(observer: Any, what: Any) -> np.ndarray:
        rows = run(observer, what)[0][50:]
        return np.sqrt(np.mean(rows[:, [2, 5]] ** 2, axis=0))

    undisturbed, gated = error(made(kind), clean), error(made(kind), spoil)
    believing = error(made(kind, gate=None), spoil)
    assert np.all(gated < 1.2 * undisturbed)
    assert np.all(believing > 3 * undisturbed)


@pytest.mark.parametrize("kind", NONLINEAR)
def test_exactly_the_outliers_are_rejected_and_their_innovation_is_told(
    kind: type[FilterOptions],
) -> None:
    spoil = with_outliers()
    rejected = run(made(kind), spoil)[1]
    np.testing.assert_array_equal(rejected[:, spoil.angles] > 0, spoil.hit)
    assert not rejected[:, [i for i in range(4) if i not in spoil.angles]].any()
    observer = made(kind)
    state, rig = observer.init(setup_for(MODEL)), Rig(MODEL, names(MODEL.outputs))
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
    yaw = names(MODEL.outputs).index("alpha_h")

    def slipped(k: int, y: np.ndarray) -> np.ndarray:
        y = y.copy()
        y[yaw] += 1.0 * (k >= 200)
        return y

    errors, rejected = run(made(kind), slipped, 400)
    patience = round(0.5 / SAMPLE_TIME)
    assert rejected[200 : 200 + patience, yaw].all()
    assert not rejected[200 + patience :, yaw].any()
    angle = MODEL.state_index("alpha_h")
    assert np.all(np.abs(errors[200 : 200 + patience - 1, angle]) < 0.1)
    assert np.all(np.abs(errors[200 + patience + 5 :, angle] - 1.0) < 0.02)
    others = [i for i in range(6) if i != angle]
    if kind is not Kalman:
        assert np.all(np.abs(errors[-1, others]) < [4.0, 0.1, 4.0, 0.1, 0.05])


def test_a_sensor_much_worse_than_declared_is_used_all_the_same() -> None:
    """Noise a hundred times the declared one: after the first half second all is believed."""
    random = np.random.default_rng(0)

    def noisy(k: int, y: np.ndarray) -> np.ndarray:
        return y + np.array([0.05, 0.0, 0.0, 0.0]) * random.standard_normal(4)

    rejected = run(Ukf(gate=5.0), noisy)[1]
    assert rejected[:100, 0].mean() > 0.3
    assert rejected[SAMPLES // 2 :, 0].mean() < 0.2
    assert rejected[:, 1:].mean() < 0.02


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


def test_without_a_gate_the_steps_are_the_same_bit_for_bit() -> None:
    np.testing.assert_array_equal(run(Ukf(gate=None), clean)[0], run(Ukf(), clean)[0])


def test_outliers_are_told_in_the_log_and_counted() -> None:
    close_loop = pytest.importorskip("experiments.chapter7.runs").close_loop

    from trms_cli.scoring.score import score_tables

    fault = ["fault=[yaw_outliers]", "controller=lqr", "sim.duration=15", "supervisor=none"]
    tables, limits, duration = close_loop(fault)
    events = tables["/event"]
    told = events.columns["source"][np.asarray(events.columns["kind"] == "outlier", dtype=bool)]
    assert set(told) == {"alpha_h"}
    estimate = score_tables(tables, limits=limits, duration_s=duration)["estimate"]
    assert estimate["rejected_samples"] == estimate["innovations"]["alpha_h"]["rejected"]
    assert estimate["rejected_samples"] == len(told) > 3
    assert estimate["rmse"]["alpha_h"] < 1e-3
