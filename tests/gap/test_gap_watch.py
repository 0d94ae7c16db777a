"""The gap watch: what it learns, what it says of changes, and that it is quiet without any."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from trms_cli.core.compilation import BufferedFunction
from trms_cli.gap.watch import filter_step
from trms_cli.gap.watch.filter_step import FilterArrays, SignatureArrays
from trms_cli.gap.watch.gap_watch import GapWatch
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model, names
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.rest import resting_state
from trms_cli.observers.observer import ObserverSetup
from trms_cli.simulation.gap_watch import GapAlarm, NoGapWatch

SAMPLE = 0.02  # s
OUTPUTS = ("alpha_v", "alpha_h", "omega_v", "omega_h")
QUANTUM = 2 * np.pi / 4096
NOISE_SD = dict(zip(OUTPUTS, (QUANTUM / 12**0.5, QUANTUM / 12**0.5, 1.6, 1.6), strict=True))
NO_FORCE = np.zeros(4)

Force = Callable[[float, np.ndarray], np.ndarray]  # of time (s) and rates (2,), N m


@dataclass(frozen=True)
class Rig:
    """A simulated rig: the model itself, what acts on it, and what its sensors add."""

    model: Model = field(default_factory=Newtonian)
    force: Force = lambda time, rates: NO_FORCE
    shift: Callable[[float], np.ndarray] = lambda time: NO_FORCE
    duration: float = 60.0
    seed: int = 0

    def record(self) -> tuple[np.ndarray, np.ndarray]:
        """Commands (n, 2) and readings (n, 4)."""
        random = np.random.default_rng(self.seed)
        samples = round(self.duration / SAMPLE)
        time = SAMPLE * np.arange(samples)
        u = np.column_stack(
            [
                1.25 + sum(0.08 * np.sin(w * time + p) for w, p in ((0.7, 0), (2.1, 1), (5.0, 2))),
                sum(0.25 * np.sin(w * time + p) for w, p in ((0.5, 3), (1.3, 4), (3.7, 5))),
            ]
        )
        discrete = discretise(self.model, SAMPLE, 2)
        step, p = BufferedFunction(discrete.step), self.model.parameters.values
        measure = BufferedFunction(discrete.measurement)
        x = resting_state(self.model, {}, u[0])
        angles = [self.model.state_index(name) for name in OUTPUTS[:2]]
        y, before = np.empty((samples, 4)), x[angles]
        for k in range(samples):
            noise = np.array([0, 0, 1.6, 1.6]) * random.standard_normal(4)
            y[k] = measure.evaluate(x, u[k], p)[0] + noise + self.shift(time[k])
            rates, before = (x[angles] - before) / SAMPLE, x[angles].copy()
            x = step.evaluate(x, u[k], p, self.force(time[k], rates))[0].copy()
        y[:, :2] = QUANTUM * np.round(y[:, :2] / QUANTUM)
        return u, y


def watch(
    u: np.ndarray,
    y: np.ndarray,
    config: GapWatch | None = None,
    *,
    model: Model | None = None,
    outputs: tuple[str, ...] = OUTPUTS,
):
    """The run at the end, and all alarms."""
    run = (config or GapWatch()).init(
        ObserverSetup(model or Newtonian(), SAMPLE, outputs, NOISE_SD, y[0], u[0])
    )
    alarms: list[GapAlarm] = []
    for k in range(len(y)):
        alarms += run.step(u[max(k - 1, 0)], y[k])
    return run, alarms


@pytest.fixture(scope="module")
def still() -> tuple[np.ndarray, np.ndarray]:
    return Rig().record()


def test_a_rig_that_is_as_the_model_raises_no_alarm(still):
    run, alarms = watch(*still)
    assert not alarms
    assert run.latest.statistic < 30
    assert np.abs(run.tests.levels - 1).max() < 1.6


def test_innovations_are_white_and_of_unit_variance(still):
    u, y = still
    run = GapWatch().init(ObserverSetup(Newtonian(), SAMPLE, OUTPUTS, NOISE_SD, y[0], u[0]))
    z = []
    for k in range(len(y)):
        run.step(u[max(k - 1, 0)], y[k])
        z.append(run._predictor.arrays.z.copy())
    z = np.array(z[1000:])
    assert np.allclose(z.var(axis=0), 1.0, atol=0.12)
    following = (z[1:, 2:] * z[:-1, 2:]).mean(axis=0)
    assert np.all(np.abs(following) < 4 / len(z) ** 0.5)


@pytest.mark.parametrize(
    ("equation", "size"),
    [("pitch_moment", 0.005), ("yaw_moment", -0.001), ("main_motor", -1e-3), ("tail_motor", 4e-4)],
)
def test_a_constant_force_is_found_with_place_size_and_onset(equation, size):
    place = names(Newtonian().disturbances).index(equation)
    rig = Rig(force=lambda t, rates: size * np.eye(4)[place] * (t >= 40.0))
    _, alarms = watch(*rig.record())
    alarm = alarms[0]
    assert (alarm.kind, alarm.location, alarm.unit) == ("change", equation, "N*m")
    assert abs(alarm.since - 40.0) <= 1.0
    assert 42.0 <= alarm.time <= 46.0
    assert abs(abs(alarm.size) - abs(size)) < max(4 * alarm.sd, 0.1 * abs(size))
    assert alarm.statistic > alarm.threshold


def test_friction_is_told_by_its_form():
    def friction(t: float, rates: np.ndarray) -> np.ndarray:
        return np.array([0.0, -0.003 * np.tanh(rates[1] / 0.01), 0.0, 0.0]) * (t >= 40.0)

    # the axis has to turn round before friction is anything else than a force
    _, alarms = watch(*Rig(force=friction).record(), GapWatch(confirmation=6.0))
    assert (alarms[0].location, alarms[0].form) == ("yaw_moment", "against_motion")
    assert alarms[0].size == pytest.approx(0.003, rel=0.2)
    assert abs(alarms[0].since - 40.0) < 1.0


@pytest.mark.parametrize(("channel", "size"), [("alpha_v", 0.03), ("alpha_h", -0.02)])
def test_a_sensor_that_slips_is_found(channel, size):
    place = OUTPUTS.index(channel)
    rig = Rig(shift=lambda t: size * np.eye(4)[place] * (t >= 35.5))
    _, alarms = watch(*rig.record())
    assert len(alarms) == 1  # once; then it is usual
    assert alarms[0].location == {"alpha_v": "pitch_sensor", "alpha_h": "yaw_sensor"}[channel]
    assert (alarms[0].form, alarms[0].unit) == ("bias", "rad")
    assert alarms[0].size == pytest.approx(size, abs=QUANTUM)
    assert alarms[0].since == pytest.approx(35.5, abs=0.05)


def test_after_an_alarm_the_next_change_is_found():
    rig = Rig(force=lambda t, rates: np.array([0.01 * (int(t >= 30) + int(t >= 60)), 0, 0, 0]))
    _, alarms = watch(*replace(rig, duration=80.0).record())
    assert [round(alarm.since) for alarm in alarms] == [30, 60]
    assert {alarm.location for alarm in alarms} == {"pitch_moment"}


def test_what_slips_while_it_is_learnt_what_is_usual_is_told_after_it():
    rig = Rig(shift=lambda t: np.array([0.0, 0.1, 0.0, 0.0]) * (t >= 12.0))
    _, (alarm,) = watch(*rig.record())
    assert (alarm.kind, alarm.location) == ("change", "yaw_sensor")
    assert alarm.since == pytest.approx(12.0, abs=0.05)
    assert alarm.size == pytest.approx(0.1, abs=0.003)


def test_spikes_and_missing_samples_are_no_change(still):
    u, y = still
    y = y.copy()
    y[1500:1502, 1] += 0.5
    y[2000, 0] = -0.7
    y[2200:2230, 2] = np.nan
    y[2400] = np.nan
    run, alarms = watch(u, y)
    assert not alarms
    assert np.isfinite(run._predictor.x).all()


def test_a_mechanical_stop_is_no_change():
    """The beam is held at its stop for a while, against the thrust that falls."""
    stop = Newtonian().stops["alpha_v"]
    u, y = Rig().record()
    rig_at_stop = (np.arange(len(y)) > 1500) & (np.arange(len(y)) < 2000)
    held = y.copy()
    held[rig_at_stop, 0] = -stop
    _, alarms = watch(u, held)
    assert not [alarm for alarm in alarms if alarm.since < 1999 * SAMPLE]


def test_a_model_that_does_not_fit_is_told_once_and_changes_are_found_all_the_same():
    truth = Newtonian(parameters={"k_fvp": 1.62e-5 * 1.2, "k_ov": 0.012})
    rig = Rig(truth, shift=lambda t: np.array([0.0, 0.03, 0.0, 0.0]) * (t >= 40.0))
    _, alarms = watch(*rig.record())
    assert [alarm.kind for alarm in alarms] == ["misfit", "change"]
    assert alarms[0].time < 20.0
    assert (alarms[0].location, alarms[0].since) == ("pitch_moment", 0.0)
    assert "from the beginning" in alarms[0].words
    assert alarms[1].location == "yaw_sensor"
    assert "yaw_sensor by 0.0" in alarms[1].words


def test_angles_alone_are_watched_by_the_axes_equations(still):
    u, y = still
    run, alarms = watch(u, y[:, :2], outputs=OUTPUTS[:2])
    assert not alarms
    places = {test.location for test in run.tests.tests}
    assert places == {"pitch_moment", "yaw_moment", "pitch_sensor", "yaw_sensor"}


def test_two_runs_of_one_configuration_share_nothing(still):
    u, y = still
    config = GapWatch()
    alone, _ = watch(u[:500], y[:500], config)
    watch(u[500:1000], y[500:1000], config)
    again, _ = watch(u[:500], y[:500], config)
    assert np.array_equal(alone._predictor.x, again._predictor.x)
    assert alone.latest == again.latest


def test_nobody_watches_without():
    run = NoGapWatch().init(
        ObserverSetup(Newtonian(), SAMPLE, OUTPUTS, NOISE_SD, np.zeros(4), np.zeros(2))
    )
    assert not run.step(np.zeros(2), np.full(4, np.nan))


def _filled(random: np.random.Generator) -> SignatureArrays:
    """Arrays of some filter with five states, two of which stay."""
    own = FilterArrays(3, 5, 2)
    tests = SignatureArrays(own, 3, 16)
    for array in (own.f, own.h, own.e, tests.signature, tests.on_state, tests.on_outputs):
        array[...] = random.standard_normal(array.shape)
    root = random.standard_normal((5, 5))
    own.p[...] = root @ root.T
    own.q[:], own.r[:] = 0.1, 0.3
    tests.live[:10] = 1.0
    return tests


@pytest.mark.parametrize("state", [(1, 1), (0, 1), (2, 1)])
def test_c_and_numpy_are_one_arithmetic(monkeypatch, state):
    results = []
    for compiled in (True, False):
        if not compiled:
            monkeypatch.setattr(filter_step, "_library", lambda outputs: None)
        tests = _filled(np.random.default_rng(3))
        own = tests.filter
        own.state[:] = state
        assert own.update(advance=True, gate=1.0)
        tests.carry()
        results.append((own, tests))
    (a, s), (b, t) = results
    assert a.state.tolist() == b.state.tolist()
    for one, other in (
        *(
            (getattr(a, name), getattr(b, name))
            for name in ("p", "root", "w", "z", "dx", "remainder")
        ),
        *((getattr(s, name), getattr(t, name)) for name in ("signature", "product", "energy")),
    ):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


def test_a_signature_is_what_a_change_does_to_the_innovations():
    """By linearity: what a filter is off by of a rig that was pushed, and else would not be."""
    random = np.random.default_rng(5)
    tests = _filled(random)
    own = tests.filter
    own.f[:, :3] *= 0.3
    tests.clear()
    tests.begin(4)
    estimate, error = np.zeros(5), np.zeros(5)  # of the rig that was pushed by test 0
    whole_f = np.vstack([own.f, np.hstack([np.zeros((2, 3)), np.eye(2)])])
    h = own.h.copy()
    for _ in range(12):
        error = whole_f @ error
        error[:3] += tests.on_state[0]
        estimate = whole_f @ estimate
        own.h[...] = h
        own.e[:] = h @ (error - estimate) + tests.on_outputs[0]
        own.state[:] = FilterArrays.believed
        assert own.update(advance=True, gate=1.0)
        estimate += own.dx
        tests.carry()
        np.testing.assert_allclose(
            tests.product[0, 4], tests.energy[0, 4], rtol=1e-9
        )  # the size is one
        np.testing.assert_allclose(
            tests.signature[0, 0, :, 4], error - estimate, rtol=1e-7, atol=1e-9
        )
