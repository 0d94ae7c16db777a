"""The supervisor: modes are declared, the rig is landed, whichever fault and controller."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trms_cli.controllers.controller import Command, Status
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.resources import config_folder
from trms_cli.library.tasks.run import score_of
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import names
from trms_cli.models.newtonian import Newtonian
from trms_cli.plants.landing import Landing
from trms_cli.simulation.supervisor import Mode, Supervisor, SupervisorSetup, WatchingRun

from .looping import composed, looped

T = 0.02
CHANNELS = ("alpha_v", "alpha_h", "omega_v", "omega_h")


def setup_with(landing: Landing | None = None) -> SupervisorSetup:
    model = Newtonian()
    ramp = (landing or Landing()).init(names(model.inputs), model.input_bounds(), T)
    return SupervisorSetup(model, T, CHANNELS, ramp)


class Watched:
    """A supervisor that is shown made-up samples."""

    def __init__(self, **changes: float) -> None:
        self.told: list[tuple[str, str]] = []
        setup = setup_with()
        self.run: WatchingRun = Supervisor(**changes).init(setup)
        self._generator = np.random.default_rng(0)

    def sample(self, y: list[float] | None = None, share: float = 1.0) -> np.ndarray:
        """One sample; innovations of ``share`` times their deviation."""
        values = self._generator.standard_normal(4) if y is None else np.array(y)
        seen = self.run.screen(values)
        nothing = np.zeros(6)
        innovation = np.where(np.isnan(seen), np.nan, share)
        estimate = Estimate(nothing, nothing, nothing, nothing, seen, innovation, np.ones(4))
        self.run.judge(estimate, lambda kind, source, words: self.told.append((kind, source)))
        return seen

    def seconds(self, time: float, y: list[float] | None = None, share: float = 1.0) -> None:
        for _ in range(round(time / T)):
            self.sample(y, share)


def test_a_normal_run_is_left_alone() -> None:
    watched = Watched()
    y = np.arange(4.0)
    assert watched.run.screen(y) is y
    watched.seconds(10.0)
    assert watched.run.mode is Mode.NORMAL
    assert watched.told == []


def test_a_reading_that_should_move_is_left_out_until_it_does_but_not_at_rest() -> None:
    watched = Watched()
    still = [0.1, 0.2, 190.0, 10.0]
    watched.seconds(10.0, still, share=1.0)
    assert watched.run.mode is Mode.NORMAL
    watched = Watched(land_after=100.0, innovation_limit=100.0)
    watched.seconds(0.5, still, share=10.0)
    assert ("degraded_begin", "alpha_h") in watched.told
    assert np.isnan(watched.sample(still)).all()
    assert np.isfinite(watched.sample([0.1, 0.3, 190.0, 10.0])[1])


def test_a_missing_angle_degrades_then_lands_and_the_controller_comes_back() -> None:
    watched = Watched()
    rng = np.random.default_rng(1)

    def some(time: float, missing: bool) -> None:
        for _ in range(round(time / T)):
            y = rng.standard_normal(4)
            watched.sample([*y[:1], np.nan if missing else y[1], *y[2:]])

    some(0.08, True)
    assert watched.run.mode is Mode.NORMAL
    some(0.1, True)
    assert watched.run.mode is Mode.DEGRADED
    assert watched.run.reasons() == "missing alpha_h"
    some(2.1, True)
    assert watched.run.mode is Mode.LANDING
    some(0.3, False)
    assert watched.run.mode is Mode.LANDING  # not yet clear for long enough
    some(0.5, False)
    assert watched.run.mode is Mode.NORMAL
    kinds = [kind for kind, _ in watched.told]
    assert kinds == ["degraded_begin", "landing_begin", "degraded_end", "landing_end"]
    # a missing rotor speed never lands the rig
    watched = Watched()
    for _ in range(500):
        y = rng.standard_normal(4)
        watched.sample([y[0], y[1], np.nan, y[3]])
    assert watched.run.mode is Mode.DEGRADED


def test_a_controller_that_fails_degrades_and_lands_and_gets_another_chance() -> None:
    watched = Watched()
    failed = Command(np.zeros(2), Status.FAILED, fallback="hold")
    for _ in range(80):
        watched.run.note_command(failed)
        watched.sample()
    assert watched.run.mode is Mode.DEGRADED
    for _ in range(30):
        watched.run.note_command(failed)
        watched.sample()
    assert watched.run.mode is Mode.LANDING
    watched.seconds(0.6)  # it is not asked while the rig is landed
    assert watched.run.mode is Mode.NORMAL


def test_innovations_far_beyond_their_deviation_are_said_but_change_nothing() -> None:
    watched = Watched()
    watched.seconds(4.0, share=20.0)
    assert watched.run.mode is Mode.DEGRADED
    assert watched.run.reasons().startswith("inconsistent alpha_v")


def test_landing_goes_to_its_command_at_its_rate_and_stays_there_if_the_rig_can() -> None:
    setup = setup_with(Landing(command={"u_v": 0.5}, rate=2.0))
    run = Supervisor().init(setup)
    u = np.array([1.5, -0.7])
    path = [u := run.landed(u) for _ in range(100)]
    moves = np.abs(np.diff([[1.5, -0.7], *path], axis=0))
    assert moves.max() <= 2.0 * T + 1e-12
    np.testing.assert_allclose(path[-1], [0.5, 0.0])
    with pytest.raises(ConfigurationError, match="9 given"):
        setup_with(Landing(command={"u_v": 9.0}))
    with pytest.raises(ConfigurationError, match="no input"):
        setup_with(Landing(command={"u_w": 0.0}))


FAULTS = sorted(path.stem for path in Path(config_folder(), "fault").glob("*.yaml"))
CONTROLLERS = ("newton_mpc", "lqr", "pid")
#: s; the faults of the library begin at 5 to 21 s, the square steps at 20 s.
DURATION = 40.0
#: Two control periods late is where newton_mpc's loop ends to be stable: it swings, within its
#: limits, for as long as that lasts.
SWINGS = {("delayed_commands", "newton_mpc")}


class Ran:
    """A run in memory: its score, its commands, where it ended."""

    def __init__(self, *overrides: str) -> None:
        with np.errstate(all="ignore"):
            self.loop = looped(
                composed(*overrides, f"sim.duration={DURATION}", "sim.prediction_every=0")
            )
        self.score: dict[str, Any] = score_of(self.loop, Path("x"), complete=True)
        history = self.loop.history
        self.commands = np.column_stack(list(history.columns("/command").values()))
        self.variation = float(np.abs(np.diff(self.commands, axis=0)).sum())  # of all inputs, V
        state = history.columns("/plant/state")
        self.late_error = max(
            float(np.abs(np.asarray(state[n])[-100:] - np.asarray(r)[-100:]).max())
            for n, r in history.columns("/reference").items()
        )


ran = cache(Ran)


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_ends_in_a_declared_mode_and_never_in_a_wild_input(fault, controller):
    healthy = ran(f"controller={controller}")
    assert healthy.score["degraded"]["first_s"] is None
    hurt = Ran(f"controller={controller}", f"fault={fault}")
    told = [(kind, time) for time, kind, *_ in hurt.loop.history.events]
    assert any(kind == "fault_injected" for kind, _ in told)
    assert hurt.score["degraded"]["first_s"] is not None
    assert np.isfinite(hurt.commands).all()
    assert np.abs(hurt.commands).max() <= 2.5
    # A landing and the way back cost some; not a multiple.
    if (fault, controller) not in SWINGS:
        assert hurt.variation <= 2.0 * healthy.variation + 20.0
    if fault not in ("pitch_encoder_dead", "yaw_encoder_slipped"):
        assert hurt.late_error < 0.05
    if fault == "pitch_encoder_dead":
        assert hurt.score["degraded"]["landings"] == 1
        assert np.all(hurt.commands[-1] == 0.0)


def test_a_solver_that_fails_for_long_lands_the_rig_and_for_short_does_not():
    short = Ran("qp_solver@controller.qp=failing", "controller.qp.count=5")
    assert short.score["degraded"]["landings"] == 0
    assert short.score["solver"]["failures"] == 5
    assert short.score["degraded"]["reasons_s"]["controller"] > 0
    long = Ran("qp_solver@controller.qp=failing", "controller.qp.count=100000")
    assert long.score["degraded"]["landings"] >= 1
    assert np.isfinite(long.commands).all()


@pytest.mark.parametrize("controller", ["newton_mpc", "lqr"])
def test_a_reference_out_of_reach_is_declared_and_approached(controller):
    far = Ran(f"controller={controller}", "ref=constant", "ref.alpha_v.offset=2.0")
    assert far.score["degraded"]["reasons_s"]["reference"] > 30.0
    assert far.score["degraded"]["landings"] == 0
    assert np.abs(far.commands).max() <= 2.5


def test_without_a_supervisor_nothing_is_declared():
    alone = Ran("supervisor=none", "fault=yaw_encoder_lost")
    assert alone.score["degraded"]["first_s"] is None
