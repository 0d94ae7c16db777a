"""A fault or a disturbance that a run is too short for is told of."""

from __future__ import annotations

import pytest

from trms_cli.library.tasks.run import never_begun
from trms_cli.plants.disturbance import ScheduledDisturbance
from trms_cli.plants.faults.frozen_sensor import FrozenSensor
from trms_cli.references.constant import Constant
from trms_cli.references.step import Step


class _Rig:
    def __init__(self, faults, disturbances) -> None:
        self.faults, self.disturbances = faults, disturbances


@pytest.mark.parametrize(("duration", "told"), [(10.0, True), (21.0, True), (22.0, False)])
def test_what_begins_after_the_end_is_told(duration: float, told: bool) -> None:
    fault = FrozenSensor(channel="alpha_h", start=21.0, duration=3.0)
    push = ScheduledDisturbance(equation="yaw_moment", torque=Step(amplitude=0.01, start=21.0))
    said = list(never_begun(_Rig({"frozen": fault}, {"push": push}), duration))
    names = ["fault frozen begins at 21 s", "disturbance push begins at 21 s"]
    assert [words.partition(",")[0] for words in said] == (names if told else [])


def test_a_torque_that_is_there_before_it_begins_acts() -> None:
    torques = Step(amplitude=0.01, start=21.0, offset=0.02), Constant(offset=0.01)
    pushes = {
        str(i): ScheduledDisturbance(equation="yaw_moment", torque=torque)
        for i, torque in enumerate(torques)
    }
    assert not list(never_begun(_Rig({}, pushes), 10.0))


def test_a_run_says_it_before_it_begins(trms) -> None:
    done = trms("run", "fault=yaw_encoder_frozen", "sim.duration=0.2", "picture=false")
    assert done.returncode == 0, done.stderr
    words = "note   fault yaw_encoder_frozen begins at 21 s, after the end of the run (0.2 s)"
    assert words in done.stderr
