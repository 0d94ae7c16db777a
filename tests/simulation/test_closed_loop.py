"""The loop itself, with plugins made for it: what passes between them, and what never passes."""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from trms_cli.controllers.controller import (
    Command,
    ControlSample,
    ControlSetup,
    Prediction,
    Status,
)
from trms_cli.core.errors import ConfigurationError, SimulationError
from trms_cli.core.invocation import notes_to
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.steady_state import SteadyState
from trms_cli.observers.full_state import FullState
from trms_cli.plants.sensors import Sensors
from trms_cli.plants.simulated import SimulatedRig
from trms_cli.references.constant import Constant
from trms_cli.references.square import Square
from trms_cli.references.trajectory import ReferenceTrajectory
from trms_cli.simulation.closed_loop import Experiment, Loop

from .looping import looped, started

MODEL = Newtonian()
NOWHERE = ReferenceTrajectory(alpha_v=Constant(offset=math.nan), alpha_h=Constant())


@dataclass(frozen=True)
class Scripted:
    """Answers with the commands that it was given, and keeps what it was told."""

    commands: Any  # of the number of the control step
    sample_time: float | None = None
    ahead: int = 0
    seen: list[ControlSample] = field(default_factory=list)

    def preview(self, setup: ControlSetup) -> int:
        return self.ahead

    def init(self, setup: ControlSetup) -> list[int]:
        return [0]

    def step(self, state: list[int], sample: ControlSample, *, want_prediction: bool) -> Command:
        self.seen.append(replace(sample, reference=sample.reference.copy()))
        u = self.commands(state[0])
        state[0] += 1
        return Command(np.asarray(u, dtype=float))


def experiment(controller: Any, **changes: Any) -> Experiment:
    settings: dict[str, Any] = {
        "model": MODEL,
        "plant": SimulatedRig(model=MODEL, sensors=Sensors()),
        "observer": FullState(),
        "controller": controller,
        "reference": ReferenceTrajectory(
            alpha_v=Constant(offset=0.1), alpha_h=Square(amplitude=0.5, frequency=1.0)
        ),
        "duration": 1.0,
        "sample_time": 0.02,
    }
    return Experiment(**(settings | changes))


def run(controller: Any, **changes: Any) -> Loop:
    return looped(experiment(controller, **changes))


@dataclass(frozen=True)
class Reusing(Scripted):
    """Plans in the same arrays at each step, as a controller that saves memory does."""

    plan: Prediction = field(
        default_factory=lambda: Prediction(np.zeros(3), np.zeros((3, MODEL.n_x)), np.zeros((3, 2)))
    )

    def step(self, state: list[int], sample: ControlSample, *, want_prediction: bool) -> Command:
        command = super().step(state, sample, want_prediction=want_prediction)
        self.plan.time[:] = self.plan.states[:] = self.plan.inputs[:] = state[0]
        return replace(command, prediction=self.plan if want_prediction else None)


def test_a_prediction_is_logged_as_it_was_when_it_was_made() -> None:
    loop = run(Reusing(lambda k: (0.0, 0.0)), prediction_every=10)
    columns = loop.history.columns("/prediction")
    for name, plans in columns.items():
        assert [plan.tolist() for plan in plans] == [[k] * 3 for k in (1, 11, 21, 31, 41)], name


def kinds(loop: Loop) -> list[tuple[str, str]]:
    return [(kind, source) for _, kind, source, _, _ in loop.history.events]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_command_that_is_not_finite_never_reaches_the_plant(value: float) -> None:
    loop = run(Scripted(lambda k: (value, 0.3) if k >= 10 else (0.5, 0.2)))
    applied = loop.history.columns("/command")
    assert np.all(applied["u_v"] == 0.5)  # the last finite one is held
    assert np.all(applied["u_h"][10:] == 0.3)  # and the other input is not punished
    assert all(
        np.isfinite(column).all() for column in loop.history.columns("/plant/state").values()
    )


def test_commands_that_are_not_finite_are_told_once_a_spell_and_count_as_failures() -> None:
    script = Scripted(lambda k: (math.nan if k in (3, 4, 9) else 0.5, 0.0))
    loop = run(script)
    assert kinds(loop) == [("fault", "controller"), ("fault_end", "controller")] * 2
    acted = np.flatnonzero(loop.history.columns("/controller")["fallback"])
    assert acted.tolist() == [3, 4, 9]


def test_the_limits_are_the_rig_s_and_each_saturation_has_begin_and_end() -> None:
    lower, upper = MODEL.input_bounds()
    loop = run(Scripted(lambda k: (9.0, -9.0) if 5 <= k < 20 else (0.1, 0.1)))
    applied = loop.history.columns("/command")
    assert applied["u_v"].max() == upper[0]
    assert applied["u_h"].min() == lower[1]
    assert kinds(loop) == [
        ("saturation_begin", "u_v"),
        ("saturation_begin", "u_h"),
        ("saturation_end", "u_v"),
        ("saturation_end", "u_h"),
    ]
    begun = [time for time, kind, *_ in loop.history.events if kind == "saturation_begin"]
    assert begun == [100_000_000, 100_000_000]


@pytest.mark.parametrize("u", [(0.1,), (0.1, 0.2, 0.3), ((0.1, 0.2),)])
def test_a_command_of_another_shape_is_refused_in_words(u: Any) -> None:
    with pytest.raises(SimulationError, match="shape") as caught:
        run(Scripted(lambda k: u))
    assert caught.value.where == "controller"


def test_a_slower_controller_is_asked_at_its_own_rate_with_a_preview_and_its_command_held() -> None:
    controller = Scripted(lambda k: (0.1 * k, 0.0), sample_time=0.1, ahead=4)
    loop = run(controller)
    assert [sample.time for sample in controller.seen] == pytest.approx(np.arange(10) * 0.1)
    held = loop.history.columns("/command")["u_v"].reshape(10, 5)
    assert np.all(held == held[:, :1])
    assert held[:, 0] == pytest.approx(0.1 * np.arange(10))
    # the preview reaches over the end
    logged = loop.history.columns("/reference")["alpha_h"]
    for sample in controller.seen:
        assert sample.reference.shape == (5, 2)
        at = round(sample.time / 0.02)
        within = logged[at : at + 21 : 5]
        assert np.array_equal(sample.reference[: len(within), 1], within)


def test_the_controller_sees_the_command_as_it_was_applied() -> None:
    controller = Scripted(lambda k: (99.0, math.nan))
    run(controller)
    _, upper = MODEL.input_bounds()
    assert controller.seen[-1].previous_command.tolist() == [upper[0], 0.0]


def test_two_runs_are_equal_to_the_bit_and_share_nothing() -> None:
    one = experiment(Scripted(lambda k: (1.0 + 0.1 * math.sin(k), -0.2)), seed=4)
    first, second = started(one), started(one)
    second.run()
    first.run()
    for topic in ("/plant/state", "/command"):
        a, b = first.history.columns(topic), second.history.columns(topic)
        assert all(np.array_equal(a[name], b[name]) for name in a)


def test_progress_is_told_each_simulated_second() -> None:
    told: list[float] = []
    loop = started(experiment(Scripted(lambda k: (0.0, 0.0)), duration=3.0))
    loop.run(lambda time, error: told.append(time))
    assert told == pytest.approx([1.0, 2.0, 3.0])


def test_an_interrupted_loop_keeps_what_is_done() -> None:
    def stop_at_30(k: int) -> tuple[float, float]:
        if k == 30:
            raise KeyboardInterrupt
        return 0.1, 0.1

    loop = started(experiment(Scripted(stop_at_30)))
    with pytest.raises(KeyboardInterrupt):
        loop.run()
    assert loop.completed_samples == 30
    assert len(loop.history.times("/command")) == 30
    assert len(loop.history.columns("/command")["u_v"]) == 30


def test_nothing_is_kept_of_a_plugin_that_refuses() -> None:
    @dataclass(frozen=True)
    class Refusing(Scripted):
        def init(self, setup: ControlSetup) -> list[int]:
            raise ConfigurationError("no", where="controller")

    with pytest.raises(ConfigurationError, match="no"):
        Loop.start(
            experiment(Refusing(lambda k: (0, 0))),
            lambda plant: pytest.fail("a folder would have been made"),
        )


@pytest.mark.parametrize(
    ("changes", "where"),
    [
        ({"sample_time": 0.0}, "sim.sample_time"),
        ({"sample_time": math.nan}, "sim.sample_time"),
        ({"duration": -1.0}, "sim.duration"),
        ({"duration": math.inf}, "sim.duration"),
        ({"duration": 1e12}, "sim.duration"),
        ({"duration": 0.001}, "sim.duration"),
        ({"controller": Scripted(None, sample_time=0.03)}, "controller.sample_time"),
        ({"controller": Scripted(None, sample_time=0.01)}, "controller.sample_time"),
        ({"reference": NOWHERE}, "ref.alpha_v"),
    ],
)
def test_what_cannot_be_run_names_its_key(changes: dict[str, Any], where: str) -> None:
    changes = {"controller": Scripted(lambda k: (0.0, 0.0))} | changes
    with pytest.raises(ConfigurationError) as caught:
        started(experiment(**changes))
    assert caught.value.where == where
    assert caught.value.remedy


def test_every_status_has_words() -> None:
    assert all(status.meaning and status.label for status in Status)


def remarks(controller: Any, **changes: Any) -> list[str]:
    """What is said before the first sample."""
    said: list[str] = []
    with notes_to(said.append):
        started(experiment(controller, **changes))
    return said


def test_a_level_that_no_command_holds_is_told_before_the_run() -> None:
    script = Scripted(lambda k: (0.5, 0.2))
    high = ReferenceTrajectory(alpha_v=Constant(offset=0.95), alpha_h=Constant(offset=0.2))
    weak = Newtonian(main_voltage_limit=8.5 * 2.0)
    rig = SimulatedRig(model=weak, sensors=Sensors())
    (words,) = remarks(script, reference=high, duration=10.0, model=weak, plant=rig)
    assert "the reference of alpha_v stands at 0.95 rad from 0 s on" in words
    nearest = float(words.rsplit("at ", 1)[1].removesuffix(" rad"))
    holding = SteadyState(MODEL).solve(np.array([nearest, 0.2]))
    assert holding.exact and holding.u[0] == pytest.approx(2.0, abs=1e-3)


def test_what_is_held_or_passes_by_is_not_remarked() -> None:
    script = Scripted(lambda k: (0.5, 0.2))
    low = ReferenceTrajectory(alpha_v=Constant(offset=0.3), alpha_h=Constant(offset=0.2))
    assert remarks(script, reference=low, duration=10.0) == []
    swings = ReferenceTrajectory(
        alpha_v=Square(amplitude=0.95, frequency=0.5), alpha_h=Constant(offset=0.2)
    )
    assert remarks(script, reference=swings, duration=10.0) == []
