"""Every fault under several controllers: a declared mode, calm inputs, and the rig comes back."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trms_cli.core.resources import config_folder
from trms_cli.library.tasks.run import score_of
from trms_cli.scoring.score import Series

from .looping import composed, looped

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
        state = Series(np.array(history.times("/plant/state")), history.columns("/plant/state"))
        reference = history.columns("/reference")
        self.late_error = max(
            float(np.abs(np.asarray(state.columns[n])[-100:] - np.asarray(r)[-100:]).max())
            for n, r in reference.items()
        )

    @property
    def variation(self) -> float:
        """Total variation of all inputs, V."""
        return float(np.abs(np.diff(self.commands, axis=0)).sum())


@cache
def ran(*overrides: str) -> Ran:
    return Ran(*overrides)


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
