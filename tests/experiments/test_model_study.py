"""The study of models: who takes part, how rigs meet them, the ranking, what the page says."""

import dataclasses
import json
import math
import re

import numpy as np
import pytest
from scipy import stats

from experiments.expected_figures import differences
from experiments.gap.driver import loop_of
from experiments.model_study import page, results
from experiments.model_study.__main__ import EXPECTED, PAGE, main
from experiments.model_study.fits import Fitted
from experiments.model_study.judgement import Judgement
from experiments.model_study.loops import LoopRun, Side, SideBySide
from experiments.model_study.ranking import choose, paired_ratio, rank
from experiments.model_study.record import RecordResult, form_words
from experiments.model_study.rigs import draw_rig, drive
from experiments.model_study.study import read_study
from trms_cli.composition.composer import compose
from trms_cli.core.errors import ModelError
from trms_cli.models.newtonian import Newtonian

STEP = 0.02


@pytest.fixture(scope="module")
def study():
    return read_study()


@pytest.fixture(scope="module")
def expected():
    return json.loads(EXPECTED.read_text(encoding="utf-8"))


class TestStudy:
    @pytest.mark.slow
    def test_every_word_of_it_is_one_of_the_program(self, study):
        words = [e.fit for e in (*study.models.values(), *study.record.models.values()) if e.fit]
        words += [form_words(name, study.record.forms) for name in study.record.forms.models]
        for fit in words:
            compose([*fit, "real=rig.csv"], "identify")
        for name, entrant in (*study.models.items(), *study.record.models.items()):
            if not entrant.fit:
                compose([f"model={entrant.model or name}"])
        for task in study.loops.tasks.values():
            loop_of(task.words)

    def test_all_kinds_of_the_question_take_part(self, study):
        fits = [" ".join(entrant.fit) for entrant in study.models.values()]
        for method in ("multiple_shooting", "genetic", "narx", "wavelet", "rbf", "arx", "armax",
                       "subspace"):  # fmt: skip
            assert any(f"method={method}" in fit for fit in fits)
            assert any(
                f"method={method}" in " ".join(entrant.fit)
                for entrant in study.record.models.values()
            )
        assert {"newtonian", "lagrangian"} <= set(study.models)
        assert len(study.rigs.seeds) >= 6

    def test_the_ranked_loops_have_one_law(self, study):
        laws = {type(loop_of(study.loops.tasks[t].words).controller) for t in study.loops.ranked}
        assert len(laws) == 1

    @pytest.mark.parametrize("text", ["", "[]", "rigs: x", "seed: 3"])
    def test_what_is_no_study_ends_with_a_message(self, text, tmp_path, capsys):
        file = tmp_path / "study.yaml"
        file.write_text(text)
        assert main(["--study", str(file), "--out", str(tmp_path / "out")]) == 2
        assert "no study" in capsys.readouterr().err


class TestRigs:
    def test_copies_of_a_rig_meet_the_same_noise(self, study):
        class Constant:
            def command(self, k, time, measured):
                return np.tile([1.0, 0.3], (len(measured), 1))

        first, second = (draw_rig(study, seed) for seed in study.rigs.seeds[:2])
        seeds = study.rigs.every
        alone = drive([first], Constant(), 0.1, STEP, among=seeds)
        copies = drive([first] * 3, Constant(), 0.1, STEP, among=seeds)
        for i in range(3):
            np.testing.assert_array_equal(copies.measured[i], alone.measured[0])
        both = drive([first, second, first], Constant(), 0.1, STEP, among=seeds)
        np.testing.assert_array_equal(both.measured[0], both.measured[2])
        assert np.any(both.measured[0] != both.measured[1])

    def test_no_rig_is_the_nominal_model(self, study):
        nominal = Newtonian().parameters
        for seed in study.rigs.seeds:
            rig = draw_rig(study, seed)
            assert any(p.value != nominal[p.name].value for p in rig.rig.parameters)
            assert abs(rig.nuisances["thrust_exponent"]) > 0
            again = draw_rig(study, seed)
            assert again.nuisances == rig.nuisances
            assert all(again.rig.parameters[p.name].value == p.value for p in rig.rig.parameters)


class _Refusing:
    """A controller that takes no model."""

    sample_time = None

    def preview(self, setup):
        raise ModelError("no equations", where="model", remedy="another")


class TestLoops:
    def test_a_loop_that_cannot_be_closed_leaves_those_beside_it_alone(self):
        loop = loop_of(["controller=pid"])
        refused = Side(dataclasses.replace(loop, controller=_Refusing()), Newtonian(), 10, STEP)
        assert "no equations" in refused.problem
        assert refused.references is None

        class Fixed:
            problem = ""

            def command(self, k, time, measured):
                return np.array([1.0, 2.0])

        commands = SideBySide([refused, Fixed()]).command(0, 0.0, np.zeros((2, 4)))
        assert commands.tolist() == [[0.0, 0.0], [1.0, 2.0]]

    def test_the_error_is_that_of_both_axes(self):
        run = LoopRun({"pitch": 3e-3, "yaw": 4e-3}, {}, 1.0)
        assert run.error == pytest.approx(5e-3)


class TestRanking:
    def test_ratios_are_paired_and_their_intervals_student_s(self):
        ones, others = [2.0, 4.0, 9.0], [1.0, 2.0, 3.0]
        logs = np.log([2.0, 2.0, 3.0])
        half = stats.t.ppf(0.975, 2) * np.std(logs, ddof=1) / math.sqrt(3)
        ratio = paired_ratio(ones, others)
        assert ratio.value == pytest.approx(np.exp(logs.mean()))
        assert (ratio.low, ratio.high) == pytest.approx(
            (np.exp(logs.mean() - half), np.exp(logs.mean() + half))
        )
        assert paired_ratio([2.0, math.inf], [1.0, 1.0]).value == pytest.approx(2.0)
        assert math.isnan(paired_ratio([math.inf], [1.0]).value)

    def test_who_breaks_off_comes_last(self):
        errors = {"a": [1.0, 1.1, 1.2], "b": [2.0, 2.1, 2.2], "c": [0.1, 0.1, math.inf]}
        assert [s.name for s in rank(errors)] == ["a", "b", "c"]
        assert rank(errors)[2].failures == 1

    def test_what_was_tried_on_some_rigs_takes_its_place_by_these(self):
        errors = {"a": [1.0, 1.0, 8.0], "b": [1.5, 1.5, 12.0], "c": [1.2, 1.2, math.nan]}
        standings = rank(errors)
        assert [s.name for s in standings] == ["a", "c", "b"]
        assert standings[1].against_first.value == pytest.approx(1.2)
        assert [s.rigs for s in standings] == [3, 2, 3]
        assert [s.is_first for s in standings] == [True, False, False]

    def test_the_least_effort_is_chosen_of_those_that_are_as_good(self):
        standings = rank(
            {"best": [1.0, 1.0, 1.0], "alike": [1.2, 0.9, 1.1], "worse": [2.0, 2.1, 1.9]}
        )
        effort = {"best": 10.0, "alike": 1.0, "worse": 0.0}
        assert choose(standings, effort, 0.1) == ("alike", ["best", "alike"])
        # a sure difference that no controller minds is none
        near = rank({"best": [1.0, 1.0, 1.0], "near": [1.04, 1.041, 1.039]})
        assert choose(near, {"best": 1.0, "near": 0.0}, 0.05)[0] == "near"
        assert choose(near, {"best": 1.0, "near": 0.0}, 0.01)[0] == "best"

    def test_free_runs_count_over_no_change_and_not_beyond_the_worst(self):
        judgement = Judgement(
            {"alpha_v": {"0.1": 1.0, "2.0": math.inf}},
            {"alpha_v": {"0.1": 4.0, "2.0": 1.0}},
            {},
            3,
            64,
        )
        assert judgement.relative(100.0) == pytest.approx(math.sqrt(0.25 * 100.0))
        assert judgement.relative(100.0, ["alpha_v"], "0.1") == 0.25


def _made_up(study):
    """Results of made-up numbers: everything but what is measured is real."""
    random = np.random.default_rng(1)
    horizons = [str(h) for h in study.horizons]
    channels = ("alpha_v", "alpha_h", "omega_v", "omega_h")
    time = np.arange(0.0, study.loops.duration, 0.1)

    def judgement(level):
        errors = {c: {h: level * random.uniform(0.9, 1.1) for h in horizons} for c in channels}
        return Judgement(errors, {c: dict.fromkeys(horizons, 0.1) for c in channels}, {}, 5, 64)

    def run(level):
        values = {"pitch": level, "yaw": 2 * level}
        traces = {
            "time": time,
            "reference": np.zeros((time.size, 2)),
            "angle": level * random.standard_normal((time.size, 2)),
        }
        return LoopRun(values, values, 1.0, "", traces)

    rigs = []
    for seed in study.rigs.seeds:
        levels = {n: 0.01 * (k + 1) * random.uniform(0.95, 1.05)
                  for k, n in enumerate(study.models)}  # fmt: skip
        rigs.append(
            results.RigResult(
                seed,
                0.5,
                {n: Fitted("m", 1.0 + len(e.fit), 10) for n, e in study.models.items()},
                {n: judgement(level) for n, level in levels.items()},
                {t: {n: run(lv) for n, lv in levels.items()} for t in study.loops.tasks},
            )
        )
    record = RecordResult(
        {}, {n: judgement(0.05) for n in study.record.models},
        {n: judgement(0.05) for n in study.record.forms.models}, {},
    )  # fmt: skip
    laws = {"newton_mpc": {"newtonian": "", "subspace": ""},
            "robust_mpc": {"newtonian": "", "subspace": "no equations"}}  # fmt: skip
    return results.Results(study, tuple(rigs), laws, record)


class TestPage:
    def test_every_table_has_its_place(self, study):
        text = PAGE.read_text(encoding="utf-8")
        tables = page.tables(_made_up(study))
        assert set(tables) == set(re.findall(r"<!-- (.+?): begin -->", text))
        rows = {len(row.split(" | ")) for row in tables["loops"].splitlines()[2:]}
        assert len(rows) == 1
        assert "| `robust_mpc` | yes | no | no equations |" in tables["acceptance"]

    def test_what_is_recorded_has_no_time_of_the_machine(self, study):
        figures = results.figures_of(_made_up(study))
        assert {"free_runs", "loops", "ranking", "acceptance", "record"} == set(figures)
        assert not [name for part in figures.values() for name in part if "second" in name]
        json.loads(results.document_of(figures, figures))

    @pytest.mark.slow
    def test_figures_are_drawn(self, study, tmp_path):
        from experiments.model_study.figures import draw

        draw(_made_up(study), tmp_path)
        names = ("ranking", "horizons", "responses", "price", "record")
        assert {path.stem for path in tmp_path.glob("*.png")} == set(names)


@pytest.mark.slow
def test_the_quick_study_is_what_was_recorded(expected):
    study = read_study(quick=True)
    figures = results.figures_of(results.compute(study, 1, None, lambda part: None))
    assert differences(figures, expected["quick"], study.tolerances) == []


class TestRecorded:
    def test_the_page_s_tables_are_the_recorded_figures(self, expected, study):
        text = PAGE.read_text(encoding="utf-8")
        ranking = expected["full"]["ranking"]
        table = text.partition("<!-- loops: begin -->")[2].partition("<!-- loops: end -->")[0]
        for name, entrant in study.models.items():
            (row,) = (line for line in table.splitlines() if f" {entrant.name} |" in line)
            value = float(row.split(" | ")[2].split(" [")[0])
            assert value == pytest.approx(ranking[f"loop/{name}"], abs=0.0051)

    def test_what_the_prose_claims(self, expected):
        figures = expected["full"]
        ranking, free, record = figures["ranking"], figures["free_runs"], figures["record"]
        # level in the loop: no interval of what has equations lies above 1
        for name in ("lagrangian", "newtonian_shooting", "lagrangian_shooting"):
            assert ranking[f"loop/{name}/low"] < 1.0 < ranking[f"loop/{name}"] < 1.1
        assert ranking["free_runs/newtonian/low"] > 1.0
        fitted = [free[n] for n in ("newtonian_shooting", "newtonian_genetic",
                                    "lagrangian_shooting")]  # fmt: skip
        learnt = ("narx", "nnoe", "wavelet", "rbf", "arx", "armax", "subspace")
        assert max(fitted) < min(free["newtonian"], *(free[name] for name in learnt))
        assert all(ranking[f"loop/{name}"] > 1.4 for name in learnt)
        assert all(value == "yes" for law, value in figures["acceptance"].items()
                   if not law.startswith("robust_mpc"))  # fmt: skip
        assert "no equations" in figures["acceptance"]["robust_mpc/subspace"]
        # on the real record: fitted equations, linear models, the maker's values, networks
        assert record["tras_effects"] < record["tras_shooting"] < record["arx"]
        assert record["subspace"] < record["tras"] < record["narx"] < record["rbf"]
        assert record["form/newtonian"] == pytest.approx(record["form/lagrangian"], rel=0.005)
