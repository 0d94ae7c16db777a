"""Chapter 7: what its study consists of, what its figures are, and that its page is its own."""

import math

import numpy as np
import pytest

from experiments.chapter7.__main__ import PAGE, rounded
from experiments.chapter7.comparison import deviations
from experiments.chapter7.observers.comparison import cells_of, ratio_of
from experiments.chapter7.observers.records import STATES, Outcome, run_job
from experiments.chapter7.observers.study import Job
from experiments.chapter7.observers.study import jobs_of as observer_jobs
from experiments.chapter7.observers.study import read_study as read_observer_study
from experiments.chapter7.runs import run_batch
from experiments.chapter7.runs import run_job as run_case
from experiments.chapter7.study import CONFIGS, jobs_of
from trms_cli.composition.composer import compose


class TestStudy:
    def test_has_the_cases_of_the_thesis(self, study):
        kinds = {
            name: sorted(case.partition(" ")[0] for case in part.cases if "friction" not in case)
            for name, part in study.parts.items()
        }
        assert kinds == {
            "simulation": ["sawtooth", "sine", "sine", "square", "square", "square"],
            "experiment": ["sawtooth", "sine", "sine", "square", "square", "step", "step"],
        }
        # Every pair runs every case.
        jobs = jobs_of(study)
        assert len({job.key for job in jobs}) == len(jobs) == 14 * len(study.pairs)
        assert len(jobs_of(study, all_pairs=True)) == 14 * (
            len(study.pairs) + len(study.more_pairs)
        )

    def test_the_rig_of_the_experiment_is_withheld_from_the_controller(self, study):
        job = next(j for j in jobs_of(study) if j.part == "experiment")
        config = compose(list(job.overrides), config_dirs=(CONFIGS,)).config
        # Of another code than the controller's model, with other parameters.
        assert config["plant"]["_target_"] == "experiments.chapter7.blind_rig.BlindRig"
        assert config["plant"]["prior_seed"] is not None
        assert len(config["plant"]["sizes"]) == 3
        assert not config["model"]["parameters"] and not config.get("effect")
        assert all(j.is_blind == (j.part == "experiment") for j in jobs_of(study))

    @pytest.mark.parametrize(
        ("name", "key", "other_rig"),
        [
            ("chapter7_force", "experiment/step with force", True),
            ("chapter7_sine", "simulation/sine 2", False),
        ],
    )
    def test_a_case_can_be_run_by_name(self, study, name, key, other_rig):
        job = next(j for j in jobs_of(study) if j.key == f"{key}/newton_mpc with ukf")
        by_name = compose([f"experiment={name}", *study.every]).config
        config = compose(list(job.overrides), config_dirs=(CONFIGS,)).config
        if other_rig:  # of the library, for whoever has no study at hand: what happens is the same
            disturbances = [c.pop("plant")["disturbances"] for c in (by_name, config)]
            assert disturbances[0] == disturbances[1]
            by_name.pop("effect", None), config.pop("effect", None)
        assert by_name == config


class TestFigures:
    def test_the_beginning_of_some_cases_is_as_expected(self, study, expected):
        """A quick look at one case in simulation; the slow tests run more."""
        for job in jobs_of(study, quick=True):
            if job.case == "square 1" and not job.is_blind:
                outcome = run_case(job, study.last)
                assert not outcome.problem
                now = {job.key: rounded(outcome.figures)}
                was = {job.key: expected["quick"][job.key]}
                assert list(deviations(was, now, study.tolerances)) == []

    @pytest.mark.slow
    def test_the_experiment_begins_as_expected_with_others_beside(self, study, expected):
        jobs = [j for j in jobs_of(study, quick=True) if j.is_blind and j.case.startswith("s")]
        outcomes = run_batch(jobs[:4], study.last)
        now = {outcome.job.key: rounded(outcome.figures) for outcome in outcomes}
        was = {key: expected["quick"][key] for key in now}
        assert list(deviations(was, now, study.tolerances)) == []

    def test_the_force_is_rejected_without_offset(self, study, expected):
        """In the figures that the page shows: less than a step of the encoder on average."""
        for pair in study.pairs:
            sticks = expected["full"][f"experiment/step with force/{pair}"]["alpha_h"]
            glides = expected["full"][f"experiment/force without friction/{pair}"]["alpha_h"]
            assert abs(sticks["last_mean_error"]) < study.encoder_step
            assert abs(glides["last_mean_error"]) < 0.5 * study.encoder_step
        # Nothing fails and no limit is exceeded.
        for figures in expected["full"].values():
            assert figures["failures"] == figures["violations"] == 0

    def test_a_deviation_is_found_whether_a_figure_moved_or_is_gone(self):
        was = {"a": {"rmse": 0.1, "other": 1.0}, "b": {"rmse": 0.2}}
        tolerances = {"rmse": 0.01}
        assert not list(deviations(was, {"a": {"rmse": 0.105}, "b": {"rmse": 0.2}}, tolerances))
        figure_deviations = list(deviations(was, {"a": {"rmse": 0.12}}, tolerances))
        assert [one.key for one in figure_deviations] == ["a.rmse", "b.rmse"]
        assert list(deviations(was, {"a": {"rmse": math.nan}, "b": {"rmse": 0.2}}, tolerances))

    def test_the_page_has_a_place_for_each_table(self):
        text = PAGE.read_text(encoding="utf-8")
        for mark in (
            "simulation",
            "experiment",
            "steady state",
            "observer tally",
            "recordings",
            "free prediction",
        ):
            assert f"<!-- {mark}: begin -->" in text


class TestObservers:
    @pytest.mark.slow
    def test_every_observer_gets_the_same_record(self):
        study = read_observer_study()
        job = Job("short", 1, (*study.maker, "ref=square", "sim.duration=6"), ("estimated",))
        outcome = run_job(study, job)
        assert not outcome.problem
        errors = outcome.errors["all", "estimated"]
        assert set(errors) == set(study.observers)
        for of in errors.values():
            assert set(of) == set(STATES)
            assert all(0 < value < 50 for value in of.values())
        again = run_job(study, job)
        assert again.errors == outcome.errors

    def test_the_conditions_make_records_of_their_own(self):
        study = read_observer_study()
        jobs = observer_jobs(study)
        assert len(jobs) == study.seeds * len(study.conditions)
        assert len({job.overrides for job in jobs}) == len(jobs)
        for job in jobs[:: study.seeds]:
            compose(list(job.overrides))

    def test_the_interval_of_a_ratio_covers_it_as_often_as_promised(self):
        random = np.random.default_rng(3)
        covered = []
        for _ in range(400):
            base = np.exp(random.standard_normal(9))
            errors = 1.2 * base * np.exp(0.1 * random.standard_normal(9))
            ratio = ratio_of(errors, base)
            covered.append(ratio.low < 1.2 < ratio.high)
            assert ratio.verdict == "worse" or ratio.low <= 1.0
        assert 0.92 < np.mean(covered) < 0.98

    def test_cells_pair_observers_by_record(self):
        def outcome(seed: int, factor: float) -> Outcome:
            job = Job("rig", seed, (), ("estimated",))
            of = {"ukf": dict.fromkeys(STATES, factor), "ekf": dict.fromkeys(STATES, 2 * factor)}
            key = ("all", "estimated")
            return Outcome(job, {key: of}, {key: {"ukf": 10.0, "ekf": 5.0}})

        (cell,) = cells_of([outcome(1, 0.1), outcome(2, 7.0)], ["ukf", "ekf"], "ukf")
        assert cell.records == 2
        assert cell.ratios["ekf"]["S_h"].mean == pytest.approx(2.0)
        assert cell.ratios["ekf"]["S_h"].verdict == "worse"
