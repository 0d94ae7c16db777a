"""A rig's life around a run: the order of its calls, and that every ending lands and closes it."""

import contextlib
import math
import os
import signal
import socket
import threading
import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError, Termination
from trms_cli.models.discretisation import discretise
from trms_cli.models.estimate import Estimate
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.one_step_ahead import OneStepAhead
from trms_cli.observers.ekf import Ekf
from trms_cli.plants.envelope import Bound, Envelope
from trms_cli.plants.heartbeat import Heartbeat
from trms_cli.plants.landing import Landing
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.simulated import SimulatedRig
from trms_cli.references.constant import Constant
from trms_cli.references.trajectory import ReferenceTrajectory
from trms_cli.simulation.closed_loop import Experiment, Loop
from trms_cli.simulation.history import History
from trms_cli.simulation.pace import LatePolicy, VirtualClock
from trms_cli.simulation.rig_life import RigLanded
from trms_cli.simulation.stop import StopRequest

T = 0.02


@dataclass(frozen=True, kw_only=True)
class Bench:
    """A simulated rig that takes down what is done with it."""

    calls: list[Any] = field(default_factory=list)
    landing: Landing = field(default_factory=lambda: Landing(rate=5.0, hold=0.04))
    envelope: Envelope = field(default_factory=Envelope)
    first_command: float = 0.0
    real_time: bool = True
    fails_on: str = ""  #: A call that raises
    readings: dict[int, float] = field(default_factory=dict)  #: Of pitch, by reading

    def init(self, setup: PlantSetup) -> "BenchRun":
        return BenchRun(self, setup)


class BenchRun:
    def __init__(self, bench: Bench, setup: PlantSetup) -> None:
        self.bench = bench
        self._run = SimulatedRig(model=Newtonian()).init(setup)
        self._readings = 0
        self.first_command = np.array([bench.first_command, 0.0])
        self.states: tuple[Any, ...] = ()
        self.state = np.zeros(0)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._run, name)

    def _did(self, what: Any) -> None:
        self.bench.calls.append(what)
        if self.bench.fails_on == what:
            raise OSError(f"{what} fails")

    def connect(self) -> None:
        self._did("connect")

    def check(self) -> None:
        self._did("check")

    def arm(self) -> None:
        self._did("arm")

    def disarm(self) -> None:
        self._did("disarm")

    def close(self, reason: str) -> None:
        self._did(f"close {reason}")

    def measure(self) -> np.ndarray:
        y = self._run.measure()
        self._readings += 1
        y[0] = self.bench.readings.get(self._readings, y[0])
        return y

    def advance(self, command: np.ndarray) -> None:
        self._did(tuple(command.tolist()))
        self._run.advance(command)


@dataclass(frozen=True, kw_only=True)
class Law:
    """A constant command; ``act`` is called with each sample's number, and may do anything."""

    u: tuple[float, float] = (1.0, 0.5)
    act: Any = None
    sample_time: float | None = None
    delay: str = "none"

    def preview(self, setup: ControlSetup) -> int:
        return 0

    def init(self, setup: ControlSetup) -> dict[str, Any]:
        return {}

    def step(self, state: Any, sample: ControlSample, *, want_prediction: bool) -> Command:
        if self.act is not None:
            self.act(round(sample.time / T), sample)
        return Command(np.array(self.u))


def experiment(bench: Bench, law: Law, duration: float = 0.2, **changes: Any) -> Experiment:
    reference = ReferenceTrajectory(alpha_v=Constant(offset=0.0), alpha_h=Constant(offset=0.0))
    return Experiment(
        model=Newtonian(),
        plant=bench,
        observer=Ekf(),
        controller=law,
        reference=reference,
        duration=duration,
        sample_time=T,
        prediction_every=0,
        **changes,
    )


def ran(bench: Bench, law: Law, clock: VirtualClock | None = None, **changes: Any) -> Loop:
    fields = {"/landing": ("u_v", "u_h", "alpha_v", "alpha_h", "omega_v", "omega_h")}
    fields["/timing"] = (
        *("due_s", "lateness_s", "reading_s", "command_s", "observer_s", "controller_s"),
        "log_s",
    )
    fields["/command"] = ("u_v", "u_h")
    fields["/event"] = ("kind", "source", "message", "value")
    units = {topic: dict.fromkeys(names, "1") for topic, names in fields.items()}
    stop = changes.pop("stop", None)
    loop = Loop.start(
        experiment(bench, law, **changes),
        lambda plant: History(units, None),
        clock or VirtualClock(),
        confirm=lambda question: True,
    )
    loop.run(stop=stop)
    return loop


def commands(bench: Bench) -> list[tuple[float, float]]:
    return [call for call in bench.calls if isinstance(call, tuple)]


def words(bench: Bench) -> list[str]:
    return [call for call in bench.calls if isinstance(call, str)]


def assert_landed(bench: Bench, reason: str) -> None:
    """The last command is the safe one, by a ramp; then disarmed and closed, once."""
    assert words(bench)[-2:] == ["disarm", f"close {reason}"]
    assert sum(word.startswith("close") for word in words(bench)) == 1
    sent = np.array(commands(bench))
    assert tuple(sent[-1]) == (0.0, 0.0)
    assert bench.calls.index("disarm") > max(
        i for i, call in enumerate(bench.calls) if isinstance(call, tuple)
    )


def test_a_rig_is_connected_checked_armed_ramped_looped_landed_disarmed_and_closed() -> None:
    bench = Bench(first_command=0.6)
    loop = ran(bench, Law())
    assert words(bench) == ["connect", "check", "arm", "disarm", "close completed"]
    sent = np.array(commands(bench))
    up = sent[: bench.calls.index((1.0, 0.5)) - 3]
    np.testing.assert_allclose(up[:, 0], [0.1, 0.2, 0.3, 0.4, 0.5, 0.6], atol=1e-12)  # 5 V/s
    in_run = np.flatnonzero(np.all(sent == (1.0, 0.5), axis=1))
    assert in_run.size == loop.experiment.samples
    down = sent[in_run[-1] + 1 :]
    np.testing.assert_allclose(down[0], [0.9, 0.4])
    assert np.abs(np.diff(down, axis=0)).max() <= 5.0 * T + 1e-12
    assert np.count_nonzero(~down.any(axis=1)) >= 1 + 2  # reached, and held for 0.04 s
    assert_landed(bench, "completed")
    landing = loop.history.columns("/landing")
    assert len(landing["u_v"]) == len(down) - 1  # the very last repeats the safe command
    assert loop.history.times("/landing")[0] > loop.history.times("/command")[-1]


@pytest.mark.parametrize("call", ["check", "arm"])
def test_a_rig_that_fails_before_the_run_is_closed(call: str) -> None:
    bench = Bench(fails_on=call)
    with pytest.raises(OSError, match=call):
        ran(bench, Law())
    assert words(bench)[-1] == "close failed"
    assert not any(any(command) for command in commands(bench))


def test_a_rig_that_cannot_be_reached_is_closed_and_left_alone() -> None:
    bench = Bench(fails_on="connect")
    with pytest.raises(OSError, match="connect"):
        ran(bench, Law())
    assert bench.calls == ["connect", "close failed"]


def test_a_rig_that_nobody_confirms_does_not_move() -> None:
    bench = Bench()

    class Asking(BenchRun):
        confirmation = "the rig will move"

    @dataclass(frozen=True, kw_only=True)
    class AskingBench(Bench):
        def init(self, setup: PlantSetup) -> Asking:
            return Asking(self, setup)

    bench = AskingBench()
    with pytest.raises(ConfigurationError, match="nobody confirmed"):
        Loop.start(experiment(bench, Law()), lambda plant: pytest.fail("a log"), VirtualClock())
    # no command went out, not even a safe one
    assert bench.calls == ["connect", "check", "disarm", "close failed"]


def test_a_controller_that_raises_lands_the_rig() -> None:
    def act(k: int, sample: ControlSample) -> None:
        if k == 4:
            raise ZeroDivisionError

    bench = Bench()
    with pytest.raises(ZeroDivisionError):
        ran(bench, Law(act=lambda k, s: act(k, s) if s.previous_command.any() else None))
    assert_landed(bench, "failed")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_lands_the_rig_within_one_sample_though_the_law_swallows_exceptions(
    number: signal.Signals,
) -> None:
    def act(k: int, sample: ControlSample) -> None:
        if k == 4 and sample.previous_command.any():
            with contextlib.suppress(BaseException):  # as a solver in C++ does
                os.kill(os.getpid(), number)

    bench = Bench()
    expected = Termination if number == signal.SIGTERM else KeyboardInterrupt
    with StopRequest() as stop, pytest.raises(expected):
        ran(bench, Law(act=act), stop=stop)
    sent = commands(bench)
    assert sent.count((1.0, 0.5)) == 5  # samples 0 to 4, and no other
    assert_landed(bench, "interrupted")


def test_a_second_signal_stops_without_the_ramp() -> None:
    def act(k: int, sample: ControlSample) -> None:
        if k == 4 and sample.previous_command.any():
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)

    bench = Bench()
    with StopRequest() as stop, pytest.raises(KeyboardInterrupt):
        ran(bench, Law(act=act), stop=stop)
    sent = commands(bench)
    assert sent[sent.index((1.0, 0.5)) :] == [(1.0, 0.5)] * 4 + [(0.0, 0.0)]
    assert_landed(bench, "interrupted")


def test_signals_are_given_back() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with StopRequest():
        pass
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_readings_that_no_rig_can_give_are_left_out_and_land_where_they_last() -> None:
    bench = Bench(readings={5: math.inf, 6: -math.inf})
    loop = ran(bench, Law())
    kinds = [kind for _, kind, *_ in loop.history.events]
    assert kinds.count("impossible_begin") == kinds.count("impossible_end") == 1
    assert loop.completed_samples == loop.experiment.samples
    for value in (math.inf, 40.0):
        bench = Bench(readings=dict.fromkeys(range(5, 99), value))
        with pytest.raises(RigLanded, match="no rig can show"):
            ran(bench, Law(), duration=1.0)
        assert commands(bench).count((1.0, 0.5)) <= 4 + 6  # 0.1 s of them, and the one that lands
        assert_landed(bench, "landed")


def test_bounds_warn_or_land_and_commands_are_cut() -> None:
    warn = Envelope(readings={"alpha_v": Bound(lower=-0.5, action="warn")})
    loop = ran(Bench(envelope=warn), Law())
    assert loop.completed_samples == loop.experiment.samples
    assert [k for _, k, *_ in loop.history.events].count("envelope_begin") == 1
    bench = Bench(envelope=Envelope(readings={"alpha_v": Bound(lower=-0.5)}))
    with pytest.raises(RigLanded, match="reading of alpha_v"):
        ran(bench, Law())
    assert_landed(bench, "landed")
    bench = Bench(
        envelope=Envelope(commands={"u_v": Bound(upper=0.7, action="clamp")}, slew={"u_h": 5.0})
    )
    ran(bench, Law())
    sent = np.array(commands(bench))
    assert sent[:, 0].max() == 0.7
    assert np.abs(np.diff(sent[:, 1])).max() <= 0.1 + 1e-12
    bench = Bench(envelope=Envelope(commands={"u_v": Bound(upper=0.7)}))
    with pytest.raises(RigLanded, match="command of u_v"):
        ran(bench, Law())
    assert max(u for u, _ in commands(bench)) <= 0.7


def test_a_reference_beyond_the_stops_is_refused_for_a_real_rig_before_it_moves() -> None:
    bench = Bench()
    far = ReferenceTrajectory(alpha_v=Constant(offset=0.0), alpha_h=Constant(offset=50.0))
    e = experiment(bench, Law())
    with pytest.raises(ConfigurationError, match="50 rad"):
        Loop.start(replace(e, reference=far), lambda plant: History({}, None), VirtualClock())
    assert bench.calls == []


class TestPace:
    def busy(self, clock: VirtualClock, at: int, duration: float) -> Any:
        def act(k: int, sample: ControlSample) -> None:
            if k == at and sample.previous_command.any():
                clock.sleep_until(clock.now() + duration)

        return act

    def test_deadlines_are_absolute(self) -> None:
        clock = VirtualClock()
        loop = ran(Bench(), Law(act=self.busy(clock, 3, 0.03)), clock)
        lateness = loop.history.columns("/timing")["lateness_s"]
        np.testing.assert_allclose(lateness[:4], 0.0, atol=1e-12)
        np.testing.assert_allclose(lateness[4], 0.01, atol=1e-12)  # 0.03 less the sample's 0.02
        np.testing.assert_allclose(lateness[5:], 0.0, atol=1e-12)

    def test_a_sample_a_period_late_holds_the_command_or_is_left_out(self) -> None:
        clock = VirtualClock()
        asked: list[int] = []

        def act(k: int, sample: ControlSample) -> None:
            asked.append(k)
            self.busy(clock, 3, 0.07)(k, sample)

        loop = ran(Bench(), Law(act=act), clock)
        assert loop.completed_samples == loop.experiment.samples
        assert not {4, 5} & set(asked[2:])  # they came 0.05 and 0.03 s late
        assert len(loop.history.times("/timing")) == loop.experiment.samples
        clock = VirtualClock()
        loop = ran(
            Bench(), Law(act=self.busy(clock, 3, 0.07)), clock, late=LatePolicy(policy="skip")
        )
        assert loop.completed_samples == loop.experiment.samples
        assert len(loop.history.times("/timing")) == loop.experiment.samples - 2
        assert "skipped" in [kind for _, kind, *_ in loop.history.events]

    def test_a_loop_that_never_keeps_up_lands(self) -> None:
        clock = VirtualClock()
        law = Law(act=lambda k, sample: clock.sleep_until(clock.now() + 0.25))
        bench = Bench()
        with pytest.raises(RigLanded, match="in a row"):
            ran(bench, law, clock, duration=2.0, late=LatePolicy(land_after=5))
        assert_landed(bench, "landed")


def test_with_a_delay_the_command_of_a_sample_is_the_answer_to_the_one_before() -> None:
    seen: list[tuple[float, float]] = []

    def act(k: int, sample: ControlSample) -> None:
        seen.append((sample.time, float(sample.previous_command[0])))

    bench = Bench(real_time=False, landing=Landing(after_run=False))
    loop = ran(bench, Law(delay="one_sample", act=act))
    sent = [u for u, _ in commands(bench)]
    assert sent == [0.0] + [1.0] * (loop.experiment.samples - 1)
    assert [round(time / T) for time, _ in seen] == list(range(1, loop.experiment.samples + 1))
    assert [u for _, u in seen] == sent


def test_the_delayed_law_plans_from_the_state_it_will_meet() -> None:
    """The estimate that a delayed law gets is what one step of the model makes of the present."""
    model = Newtonian()
    x = model.rest() + 0.1
    u, w = np.array([1.0, -0.5]), np.zeros(model.n_w)
    ahead = OneStepAhead(model, T, np.zeros(2))(Estimate(x, x, w, w), u)
    step = BufferedFunction(discretise(model, T, 20).step)
    exact = step.evaluate(x, u, model.parameters.values, w)[0].ravel()
    np.testing.assert_allclose(ahead.x, exact, rtol=1e-6, atol=1e-9)


def test_a_heartbeat_that_stops_lands_the_rig() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    silent = Envelope(heartbeat=Heartbeat(port=port, timeout=0.05))
    bench = Bench(envelope=silent)
    with pytest.raises(ConfigurationError, match="no heartbeat"):
        ran(bench, Law())
    assert "arm" not in words(bench)
    stopped = threading.Event()

    def beat() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not stopped.wait(0.005):
                sender.sendto(b"x", ("127.0.0.1", port))

    def act(k: int, sample: ControlSample) -> None:
        if k >= 5 and sample.previous_command.any():
            stopped.set()
            time.sleep(0.02)

    sender = threading.Thread(target=beat)
    sender.start()
    bench = Bench(envelope=silent)
    try:
        with pytest.raises(RigLanded, match="no heartbeat"):
            ran(bench, Law(act=act), duration=2.0)
    finally:
        stopped.set()
        sender.join()
    assert 5 <= commands(bench).count((1.0, 0.5)) < 20
    assert_landed(bench, "landed")


def test_the_ramp_into_a_run_is_watched_as_the_run_is() -> None:
    stop = StopRequest()

    @dataclass(frozen=True, kw_only=True)
    class Impatient(Bench):
        def init(self, setup: PlantSetup) -> BenchRun:
            run = BenchRun(self, setup)
            send = run.advance

            def advance(command: np.ndarray) -> None:
                send(command)
                if command[0] > 0.25:
                    stop.request()

            run.advance = advance  # type: ignore[method-assign]
            return run

    bench = Impatient(first_command=1.0)
    with pytest.raises(KeyboardInterrupt):
        ran(bench, Law(), stop=stop)
    assert max(u for u, _ in commands(bench)) == pytest.approx(0.3)
    assert_landed(bench, "interrupted")
    bench = Bench(first_command=1.0, readings=dict.fromkeys(range(3, 99), math.inf))
    with pytest.raises(RigLanded, match="no rig can show"):
        ran(bench, Law())
    assert max(u for u, _ in commands(bench)) < 1.0
    assert_landed(bench, "landed")


def test_a_simulated_rig_by_the_clock_has_its_first_command_in_force_already() -> None:
    bench = Bench(first_command=1.0, landing=Landing(after_run=False))
    loop = ran(bench, Law())
    assert commands(bench) == [(1.0, 0.5)] * loop.experiment.samples
    assert words(bench)[-1] == "close completed"


def test_bounds_of_a_reading_and_of_its_rate_wait_each_for_their_own_time() -> None:
    envelope = Envelope(
        readings={"alpha_v": Bound(lower=-0.5, after=0.1)},
        rates={"alpha_v": Bound(upper=1e3, action="warn")},
    )
    bench = Bench(envelope=envelope)
    with pytest.raises(RigLanded, match="reading of alpha_v"):
        ran(bench, Law(), duration=1.0)
    assert commands(bench).count((1.0, 0.5)) == 5  # 0.1 s of them


def test_a_first_reading_that_is_infinite_is_a_missing_one() -> None:
    bench = Bench(readings={1: math.inf})
    loop = ran(bench, Law())
    assert loop.completed_samples == loop.experiment.samples
