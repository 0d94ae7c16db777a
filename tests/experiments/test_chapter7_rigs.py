"""Chapter 7: rigs of the blind sets as plants, side by side and over the wire; free prediction."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from experiments.chapter7.blind_rig import BlindRig, RigsSideBySide
from experiments.chapter7.observers.free_prediction import free_errors
from experiments.chapter7.over_the_wire import run_over_the_wire, split
from experiments.chapter7.side_by_side import run_side_by_side
from experiments.chapter7.study import jobs_of, read_study
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.discretisation import discretise
from trms_cli.models.newtonian import Newtonian
from trms_cli.plants.disturbance import ScheduledDisturbance
from trms_cli.plants.plant import PlantSetup
from trms_cli.references.step import Step

SETUP = PlantSetup(0.02, 50, 3)
EFFECTS = {"yaw_coulomb_friction": {"torque": 0.002}, "main_input_delay": {"delay": 0.04}}
QUIET = dict.fromkeys(("jitter", "drift", "flexibility", "speed_noise"), 0.0)


@dataclass(frozen=True)
class Loop:
    """What the loops have of an experiment."""

    plant: Any
    sample_time: float = SETUP.sample_time
    samples: int = SETUP.samples
    seed: int = SETUP.seed


def drive(place: int, loop: Loop, samples: int = 10) -> np.ndarray:
    run = loop.plant.init(PlantSetup(loop.sample_time, loop.samples, loop.seed))
    rows = []
    for k in range(samples + place):
        rows.append(run.measure())
        if (place, k) == (2, 4):
            raise ZeroDivisionError
        run.advance(np.array([1.5, 0.5 * place]))
    return np.array(rows)


class TestBlindRig:
    def test_moves_as_the_model_does_where_nothing_is_hidden(self):
        """Two codes that share the values of the parameters alone, momenta included."""
        rig = BlindRig(prior_scale=0.0, nuisances=QUIET)
        run, model = rig.init(SETUP), Newtonian()
        step = discretise(model, SETUP.sample_time, 4).step
        assert run.state == pytest.approx(model.rest(), abs=1e-3)  # which is told to a mrad
        x, p, w = run.state, model.parameters.values, np.zeros(model.n_w)
        for k in range(50):
            u = np.array([2.0 if k < 25 else -1.0, 1.5])
            run.advance(u)
            x = np.array(step(x, u, p, w)).ravel()
            scale = np.array([1e2 if "omega" in name else 1.0 for name in model.state_names])
            assert run.state / scale == pytest.approx(x / scale, abs=2e-4)
        assert np.ptp(run.measure()) > 50.0  # it has moved

    def test_is_pushed_when_it_is_said(self):
        push = ScheduledDisturbance(
            equation="yaw_moment", torque=Step(start=0.2, amplitude=0.05), known=False
        )
        pushed = BlindRig(nuisances=QUIET, disturbances={"push": push}).init(SETUP)
        free = BlindRig(nuisances=QUIET).init(SETUP)
        yaw = pushed.states.index(next(s for s in pushed.states if s.name == "alpha_h"))
        for k in range(20):
            assert (pushed.state[yaw] == free.state[yaw]) == (k <= 10)
            pushed.advance(np.zeros(2))
            free.advance(np.zeros(2))
        assert pushed.state[yaw] > free.state[yaw]

    @pytest.mark.parametrize(
        ("words", "where"),
        [
            ({"nuisances": {"jitters": 0.1}}, "plant.nuisances.jitters"),
            (
                {"disturbances": {"a": ScheduledDisturbance(
                    equation="main_motor", torque=Step(amplitude=1.0))}},
                "plant.disturbances.a.equation",
            ),
        ],
    )  # fmt: skip
    def test_what_it_does_not_have_is_refused(self, words, where):
        with pytest.raises(ConfigurationError) as refusal:
            BlindRig(**words)
        assert refusal.value.where == where


class TestSideBySide:
    def test_a_loop_meets_what_it_would_meet_alone(self):
        rigs = [BlindRig(sizes=EFFECTS), BlindRig(prior_seed=2), BlindRig(), BlindRig(sizes={})]
        results = run_side_by_side([Loop(rig) for rig in rigs], drive)  # type: ignore[list-item]
        for place in (0, 1, 3):
            alone = drive(place, Loop(rigs[place]))
            assert results[place] == pytest.approx(alone, abs=1e-9)
            assert len(alone) == 10 + place
        # One that fails does not keep the others waiting.
        assert isinstance(results[2], ZeroDivisionError)

    def test_each_rig_has_random_numbers_of_its_own(self):
        setups = [dataclasses.replace(SETUP, seed=seed) for seed in (1, 2, 1)]
        rigs = RigsSideBySide([BlindRig()] * 3, setups)
        speeds = rigs.measured[:, 2:]
        assert (speeds[0] == speeds[2]).all() and (speeds[0] != speeds[1]).any()


class TestOverTheWire:
    def test_the_rig_goes_to_one_side_and_the_loop_to_the_other(self):
        job = next(job for job in jobs_of(read_study()) if job.case == "force without friction")
        rig, loop = split(job.overrides)
        assert rig == [
            "plant=blind_rig",
            "disturbance@plant.disturbances=[yaw_push]",
            "plant.sizes.yaw_coulomb_friction.torque=0",
            "plant.sizes.pitch_coulomb_friction.torque=0",
        ]
        assert "controller=newton_mpc" in loop and "sim.duration=120.0" in loop

    @pytest.mark.slow
    def test_a_case_is_closed_over_udp(self):
        job = next(j for j in jobs_of(read_study()) if j.is_blind and j.case == "step")
        words = [word for word in job.overrides if not word.startswith("sim.duration")]
        # beside other tests the rig lives slower than the clock, and samples come late: it has time
        words += ["sim.duration=15", "sim.late.land_after=1000"]
        outcome = run_over_the_wire(dataclasses.replace(job, overrides=tuple(words)), 1.0)
        assert not outcome.problem
        pitch = outcome.traces["alpha_v"]
        told = {name: outcome.traces[name] for name in ("time", "alpha_v", "r_alpha_v", "u_v")}
        assert pitch[0] == pytest.approx(-0.6, abs=0.15) and pitch[-1] > 0.1, told
        assert outcome.figures["alpha_v"]["estimate_rmse"] is None  # the truth stays with the rig


class TestFreePrediction:
    def series(self, torque: float) -> dict[str, np.ndarray]:
        """A rig that is the model, pushed by a torque, and estimates that are exact."""
        model, rows, commands = Newtonian(), [], []
        step = discretise(model, 0.02).step
        x, p = model.rest(), model.parameters.values
        w = np.array([torque if s.name == "yaw_moment" else 0.0 for s in model.disturbances])
        for k in range(100):
            u = np.array([1.0 + 0.5 * np.sin(0.2 * k), 0.3])
            rows.append(x)
            commands.append(u)
            x = np.array(step(x, u, p, w)).ravel()
        states = dict(zip(model.state_names, np.array(rows).T, strict=True))
        inputs = dict(zip(("u_v", "u_h"), np.array(commands).T, strict=True))
        return {**states, **inputs, **{f"y_{name}": column for name, column in states.items()}}

    def errors(self, series: dict[str, np.ndarray]) -> dict[str, dict[str, float]]:
        return free_errors(Newtonian(), 0.02, series, ["alpha_h", "u_x"], [0.2, 1.0], 0.1, 0.2)

    def test_is_right_where_the_estimate_is(self):
        errors = self.errors(self.series(0.0))
        assert set(errors) == {"alpha_h"}
        assert errors["alpha_h"]["1"] < 1e-9

    def test_a_torque_that_is_not_estimated_shows_seconds_ahead(self):
        series = self.series(0.01)
        unknown = self.errors(series)["alpha_h"]
        # α = τ/J over t²/2: twenty-five times as far after five times the time
        assert unknown["1"] / unknown["0.2"] == pytest.approx(25.0, rel=0.2)
        estimated = self.errors(series | {"yaw_moment": np.full(100, 0.01)})["alpha_h"]
        assert estimated["1"] < 1e-9
