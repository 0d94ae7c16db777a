"""Replays: the observer over a recording is the observer of the run that was recorded."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.recordings.played_rig import play
from trms_cli.library.tasks.replay import _topics
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.tras import Tras
from trms_cli.observers.augmentation import InitialSd, ProcessNoise
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.ukf import Ukf
from trms_cli.plants.replay import RecordedRig
from trms_cli.plants.sensors import Sensors
from trms_cli.recordings.csv_recording import write_csv
from trms_cli.scoring.score import Series, innovation_table
from trms_cli.simulation.closed_loop import estimate_order, estimate_parts
from trms_cli.simulation.history import History
from trms_cli.simulation.replay import Replay

from .looping import units_of

SAMPLE_TIME = 0.02
#: White noise, no quanta: what the theory of innovations is about.
SENSORS = Sensors(noise_sd={"alpha_v": 0.002, "alpha_h": 0.002, "omega_v": 1.6, "omega_h": 1.6})
#: A filter that believes what is true of these rigs: no process noise, no disturbance.
CERTAIN = Ukf(
    disturbances=(),
    process_noise=ProcessNoise(angle=1e-7, momentum=1e-7, rotor=1e-5, disturbance=0.0),
)


def record(model: Model, path: Path) -> np.ndarray:
    """Shake a rig with random steps and write what was measured; returns the measurements."""
    scale = 0.4 * model.input_bounds()[1]
    recording = play("multilevel", model=model, seed=5, scale=scale, sensors=SENSORS)
    write_csv(recording, path)
    return np.column_stack([recording.channels[s.name] for s in model.outputs])


def replay(file: Path, model: Model, observer: Ukf = CERTAIN, **keys) -> Replay:
    rig = RecordedRig(file=str(file), sensors=SENSORS, **keys).load(model)
    units = units_of(_topics(model, rig))
    replay = Replay.start(model, rig, observer, lambda rig: History(units, None))
    replay.run()
    return replay


def figures(replay: Replay) -> dict[str, dict[str, float]]:
    history = replay.history
    tables = [
        Series(history.times(topic), history.columns(topic), history.units[topic])
        for topic in ("/estimate", "/measurement")
    ]
    outputs = replay.rig.outputs
    return innovation_table(*tables, [s.name for s in outputs], [s.unit for s in outputs])[
        "channels"
    ]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("replay") / "newtonian.csv"
    record(Newtonian(), path)
    return path


class TestTrueModel:
    @pytest.mark.parametrize("model", [Newtonian(), Tras()], ids=["newtonian", "tras"])
    def test_innovations_are_the_noise_of_the_sensors(self, model, tmp_path):
        record(model, tmp_path / "run.csv")
        for name, channel in figures(replay(tmp_path / "run.csv", model)).items():
            noise = SENSORS.noise_sd[name]
            assert channel["prediction_rmse"] == pytest.approx(noise, rel=0.1), name
            # χ² with 2700 degrees of freedom: ±4 standard deviations of its mean.
            assert channel["normalised_square"] == pytest.approx(1.0, abs=4 * (2 / 2700) ** 0.5)
            assert channel["within_2sd"] == pytest.approx(0.954, abs=0.02)
            assert channel["whiteness_p"] > 1e-3, name
            assert abs(channel["correlation"]) < 0.08

    def test_a_wrong_model_and_a_command_that_acts_later_are_seen(self, recorded):
        wrong = figures(replay(recorded, Newtonian(parameters={"k_fvp": 2.2e-5})))
        assert wrong["alpha_v"]["whiteness_p"] < 1e-6
        assert wrong["alpha_v"]["normalised_square"] > 1.5
        late = figures(replay(recorded, Newtonian(), command_delay=5))
        assert late["omega_h"]["whiteness_p"] < 1e-6


class TestTheSameObserver:
    def test_estimates_are_those_of_the_run(self, tmp_path):
        """What an observer says beside a rig, it says over its recording, bit for bit."""
        model, observer = Newtonian(), Ukf()
        measurements = record(model, tmp_path / "run.csv")
        again = replay(tmp_path / "run.csv", model, observer)
        rig = again.rig
        assert np.array_equal(rig.measurements, measurements)
        outputs = tuple(s.name for s in rig.outputs)
        setup = ObserverSetup(
            model, SAMPLE_TIME, outputs, rig.noise_sd, measurements[0], rig.commands[0]
        )
        state, u = observer.init(setup), rig.commands[0]
        rows = []
        for y, following in zip(measurements, rig.commands, strict=True):
            rows.append(np.concatenate(estimate_parts(observer.step(state, u, y, None))))
            u = following
        columns = again.history.columns("/estimate")
        order = estimate_order(list(columns), len(outputs))
        assert np.array_equal(np.array(rows)[:, order], np.column_stack(list(columns.values())))

    def test_twice_is_the_same(self, recorded):
        one, two = (replay(recorded, Newtonian()).history.columns("/estimate") for _ in range(2))
        assert all(np.array_equal(one[name], two[name], equal_nan=True) for name in one)


class TestMissing:
    def test_the_observer_predicts_across_a_gap(self, recorded, tmp_path):
        lines = recorded.read_text(encoding="utf-8").splitlines(keepends=True)
        path = tmp_path / "gap.csv"
        path.write_text("".join([*lines[:1501], *lines[1551:]]), encoding="utf-8")
        again = replay(path, Newtonian(), Ukf(initial_sd=InitialSd()))
        estimate = again.history.columns("/estimate")
        gap = slice(1500, 1550)
        assert np.isnan(estimate["innovation_alpha_v"][gap]).all()
        assert np.isfinite(estimate["alpha_v"]).all()
        spread = estimate["sd_alpha_v"]
        assert spread[1549] > 3 * spread[1499] and spread[1600] < 1.5 * spread[1499]
        ((time_ns, kind, *_),) = again.history.events
        assert (time_ns, kind) == (30_000_000_000, "gap")
        whole = replay(recorded, Newtonian(), Ukf()).history.columns("/estimate")
        # A second without a measurement may end anywhere within what the filter admits.
        off = np.abs(estimate["alpha_v"] - whole["alpha_v"])
        assert off[1549] < 4 * spread[1549]
        assert np.array_equal(off[:1500], np.zeros(1500))

    def test_times_before_zero_are_shifted_for_the_log(self, recorded):
        model = Newtonian()
        rig = RecordedRig(file=str(recorded), end=1.0).load(model)
        early = replace(rig, time=rig.time - 7.0)
        history = History({"/command": {"u_v": "V", "u_h": "V"}}, None)
        Replay.start(model, early, CERTAIN, lambda rig: history).run()
        assert history.times("/command")[0] == 0.0
        assert history.times("/command")[-1] == pytest.approx(1.0)
