"""Ranking of runs: pairing, failures, intervals, and what names a run."""

import math
from dataclasses import replace

import numpy as np
import pytest

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.findings import plain
from trms_cli.scoring.comparison import ranking as ranking_module
from trms_cli.scoring.comparison.findings import pair, pair_findings, ranking_findings
from trms_cli.scoring.comparison.ranking import FAILED_RATIO, figures_of, group, matching_runs, rank
from trms_cli.scoring.comparison.runs import (
    ComparisonRun,
    RunCollection,
    State,
    complete_coordinates,
    differences,
)


def run(controller, rmse=0.1, ref="square", rig="nominal", **more):
    """A run whose two channels share an error, and whose effort is 10 times that."""
    score = {
        "duration_s": 40.0,
        "channels": {
            name: {"rmse": rmse / 2, "iae": 2 * rmse, "unit": "rad"}
            for name in ("alpha_v", "alpha_h")
        },
        "inputs": {n: {"effort": 5 * rmse, "total_variation": 1.0} for n in ("u_v", "u_h")},
        "solver": {"time_ms": {"median": 0.1, "p99": 0.2, "max": 0.3}, "failures": 2},
        "constraint_violations": {},
        "degraded": {"share": {"degraded": 0.1, "landing": 0.05}},
    }
    made = ComparisonRun(
        path=f"{controller}/{ref}/{rig}",
        coordinates={"controller": controller, "ref": ref, "rig": rig},
        score=score,
    )
    return replace(made, **more)


def failed(controller, **where):
    """One that ended in an error."""
    return run(controller, state=State.FAILED, message="it broke", **where)


def standing(ranking, name):
    return next(each for each in ranking.standings if each.name == name)


class TestRanking:
    def test_is_by_the_error_over_the_best_in_the_same_condition(self):
        # a is better by a third on the easy rig, b by a tenth on the hard one, whose errors are
        # larger: the mean of errors would put b first
        runs = [
            run("a", 0.3, rig="easy"),
            run("b", 0.4, rig="easy"),
            run("a", 3.3, rig="hard"),
            run("b", 3.0, rig="hard"),
        ]
        ranking = rank(group(runs))
        assert [each.name for each in ranking.standings] == ["a", "b"]
        assert ranking.first.ratio == pytest.approx(math.sqrt(1.0 * 1.1))
        assert standing(ranking, "b").ratio == pytest.approx(math.sqrt(4 / 3))
        assert standing(ranking, "b").against_first == pytest.approx(math.sqrt(4 / 3 / 1.1))

    def test_does_not_depend_on_the_order_of_the_runs(self):
        generator = np.random.default_rng(1)
        runs = [
            run(c, float(generator.uniform(0.1, 0.3)), rig=str(r)) for c in "abc" for r in range(8)
        ]
        forth = {s.name: (s.rank, s.ratio) for s in rank(group(runs)).standings}
        back = {s.name: (s.rank, s.ratio) for s in rank(group(runs[::-1])).standings}
        assert forth.keys() == back.keys()
        for name, (place, ratio) in forth.items():
            assert back[name] == (place, pytest.approx(ratio))

    def test_a_failed_run_counts_as_the_worst_and_at_least_ten_times_the_best(self):
        runs = [run("a", 0.1), failed("b"), run("c", 0.1 * 3 * FAILED_RATIO)]
        ranking = rank(group(runs))
        assert standing(ranking, "b").ratio == pytest.approx(3 * FAILED_RATIO)
        assert standing(rank(group(runs[:2])), "b").ratio == pytest.approx(FAILED_RATIO)
        told = figures_of(standing(ranking, "b"))
        assert told.failed == 1
        assert math.isnan(told.error_mean)

    def test_an_incomplete_run_does_not_count_and_a_failure_hides_behind_no_repetition(self):
        short = run("c", 0.01, state=State.INCOMPLETE)
        ranking = rank(group([run("a"), run("b", 0.2), short]))
        assert [each.name for each in ranking.standings] == ["a", "b"]
        again = replace(run("b"), path="again")
        beside = rank(group([run("a"), again, failed("b")]))
        assert figures_of(standing(beside, "b")).failed == 1

    def test_outsiders_have_no_rank_and_are_not_the_best(self):
        runs = [run("a", 0.2), run("b", 0.3), run("seer", 0.1, outside="knows what comes")]
        ranking = rank(group(runs))
        assert ranking.first.name == "a"
        assert ranking.first.ratio == 1.0
        assert standing(ranking, "seer").rank is None
        assert standing(ranking, "seer").ratio == pytest.approx(0.5)

    def test_one_run_that_lacks_costs_nobody_the_rank_but_the_condition(self):
        runs = [run(c, 0.1 if c == "a" else 0.2, rig=str(r)) for c in "ab" for r in range(10)]
        ranking = rank(group([each for each in runs if each.path != "a/square/3"]))
        assert [each.rank for each in ranking.standings] == [1, 2]
        assert ranking.first.name == "a"
        assert ranking.left_out == 1
        assert all(len(each.runs) == 9 for each in ranking.standings)

    def test_who_was_in_few_conditions_has_no_rank_but_is_held_against(self):
        runs = [run(c, 0.2, rig=r) for c in "ab" for r in "12"] + [run("c", 0.1, rig="1")]
        ranking = rank(group(runs))
        assert standing(ranking, "c").rank is None
        assert standing(ranking, "a").ratio == pytest.approx(math.sqrt(2.0))
        assert standing(ranking, "c").against_first == pytest.approx(0.5)
        assert standing(ranking, "c").shared == 1

    def test_another_metric_ranks_otherwise(self):
        one, other = run("a", 0.1), run("b", 0.2)
        other.score["channels"]["alpha_v"]["iae"] = 0.0
        other.score["channels"]["alpha_h"]["iae"] = 0.01
        assert rank(group([one, other])).first.name == "a"
        assert rank(group([one, other]), "iae").first.name == "b"


class TestIntervals:
    def field(self, factor, spread, rigs=30, seed=3, **how):
        generator = np.random.default_rng(seed)
        made = []
        for r in range(rigs):
            hard = float(generator.uniform(0.1, 1.0))  # rigs differ much more than entrants do
            noise = float(np.exp(spread * generator.standard_normal()))
            made += [run("a", hard, rig=str(r)), run("b", factor * hard * noise, rig=str(r))]
        return rank(group(made), **how)

    def test_pairing_tells_a_small_difference_apart_on_very_different_rigs(self):
        found = standing(self.field(1.03, 0.02), "b")
        assert found.different
        low, high = found.against_interval.low, found.against_interval.high
        assert low < found.against_first < high
        assert low > 1.0 and high < 1.06

    def test_no_difference_and_few_rigs_are_not_told_apart(self):
        ranking = self.field(1.0, 0.02)
        second = ranking.standings[1]
        assert second.different is False
        found = self.field(1.03, 0.02, rigs=4)
        assert found.first.interval is None
        assert found.standings[1].different is None

    def test_references_on_one_rig_are_not_independent(self):
        # many references on few rigs make no more rigs
        runs = [
            run(c, 0.1 if c == "a" else 0.2, ref=str(k), rig=r)
            for c in "ab"
            for k in range(20)
            for r in "12"
        ]
        ranking = rank(group(runs))
        assert ranking.clusters == 2
        assert ranking.first.interval is None

    def test_cover_the_truth_as_often_as_they_say(self):
        truth, hits = 1.05, 0
        for seed in range(60):
            found = self.field(truth, 0.1, rigs=40, seed=seed, resamples=400).standings[1]
            sign = 1 if found.name == "b" else -1
            low, high = found.against_interval.low, found.against_interval.high
            hits += low <= truth**sign <= high
        assert 52 <= hits <= 60  # 95 % of 60 is 57; fewer than 52 has a chance of 1 in 500

    def test_of_very_many_rigs_are_those_that_drawing_again_gives(self, monkeypatch):
        resampled = self.field(1.03, 0.3, rigs=1200)
        monkeypatch.setattr(ranking_module, "_MANY_CLUSTERS", 1000)
        for one, other in zip(
            resampled.standings, self.field(1.03, 0.3, rigs=1200).standings, strict=True
        ):
            for drawn, known in (
                (one.interval, other.interval),
                (one.against_interval, other.against_interval),
            ):
                if drawn is None:
                    assert known is None
                    continue
                ends = [drawn.low, drawn.high]
                assert [known.low, known.high] == pytest.approx(ends, abs=0.1 * np.ptp(ends))


def test_figures_add_up():
    runs = [run("a", 0.1 * (k + 1), rig=str(k)) for k in range(4)]
    others = [run("b", 1.0, rig=str(k)) for k in range(4)]
    told = figures_of(rank(group(runs + others)).first)
    assert told.error_mean == pytest.approx(0.25)
    assert told.error_worst == pytest.approx(0.4)
    assert told.effort == pytest.approx(2.5)
    assert told.fallbacks == 8
    assert told.degraded_s == pytest.approx(4 * 0.15 * 40.0)
    assert told.degraded_runs == 4
    assert told.non_finite is None


class TestCoordinates:
    def with_config(self, horizon, effort=0.0, controller="mpc"):
        made = run(controller)
        config = {
            "controller": {"horizon": horizon, "effort": effort},
            "sim": {"duration": 40.0},
            "out": str(horizon),
        }
        return replace(made, config=config)

    def test_settings_in_which_runs_differ_name_them(self):
        runs = complete_coordinates([self.with_config(10), self.with_config(20)])
        assert [each.coordinates["controller.horizon"] for each in runs] == ["10", "20"]
        assert "out" not in runs[0].coordinates
        assert group(runs).entrants == ("mpc + horizon=10", "mpc + horizon=20")
        # settings of another option are no difference
        runs = complete_coordinates([self.with_config(10), self.with_config(20, controller="pid")])
        assert group(runs).entrants == ("mpc", "pid")
        one, other = self.with_config(10).config, self.with_config(20).config
        assert differences(one, other) == [("controller.horizon", "10", "20")]

    def test_a_job_without_a_log_is_told_apart_by_what_was_typed(self):
        lost = replace(
            failed("mpc"), score=None, typed={"controller.horizon": "-1", "sim.duration": "40.0"}
        )
        runs = complete_coordinates([self.with_config(10), lost])
        assert group(runs).entrants == ("mpc + horizon=10", "mpc + horizon=-1")
        assert "sim.duration" not in runs[0].coordinates

    def test_options_of_an_option_are_implied_by_it(self):
        square = replace(run("a"), coordinates={"ref": "square", "signal@ref.alpha_v": "square"})
        sine = replace(run("a"), coordinates={"ref": "sine", "signal@ref.alpha_v": "sine"})
        assert all(
            list(each.coordinates) == ["ref"] for each in complete_coordinates([square, sine])
        )
        mixed = replace(run("a"), coordinates={"ref": "square", "signal@ref.alpha_v": "step"})
        assert "signal@ref.alpha_v" in complete_coordinates([square, mixed])[0].coordinates

    def test_by_names_another_entrant_and_what_there_is_not_is_refused(self):
        runs = [run(c, ref=r) for c in "ab" for r in ("square", "sine")]
        found = group(runs, ["ref"])
        assert set(found.entrants) == {"ref square", "ref sine"}
        assert found.given_by == ("controller",)
        runs = [run("a"), run("b")]
        with pytest.raises(ConfigurationError, match="kontroller"):
            group(runs, ["kontroller"])
        with pytest.raises(ConfigurationError, match="there are: nominal"):
            matching_runs(runs, {"rig": ["draw*"]})
        assert [each.path for each in matching_runs(runs, {"controller": ["a*", "x"]})] == [
            runs[0].path
        ]


def test_a_pair_lists_every_figure_and_what_differs():
    one = replace(run("a"), config={"controller": {"gain": 1}, "sim": {"duration": 40.0}})
    other = replace(run("b", 0.2), config={"controller": {"k": 2}, "sim": {"duration": 80.0}})
    told = pair_findings(pair(one, other))
    given, compared = told.tables
    assert given.rows == [["controller", "a", "b"], ["sim.duration", "40.0", "80.0"]]
    first = [plain(cell) for cell in compared.rows[0]]
    assert first == ["alpha_v RMSE [rad]", 0.05, 0.1, 0.05, "+100.0 %"]
    assert told.results["schema"] == "trms.compare_pair/1"


def _title_and_notes(runs):
    """The head of a comparison, and the words under its first table."""
    ranking = rank(group(runs))
    found = ranking_findings(ranking, RunCollection(tuple(runs)), ranking.standings)
    return found.title, found.sections[0].blocks[0].caption, found.results


def test_many_drawn_parameters_of_the_rig_are_named_once_and_one_condition_by_nothing():
    keys = [f"plant.parameters.k_{i}" for i in range(25)]
    runs = []
    for draw in range(3):
        for who, rmse in (("a", 0.1), ("b", 0.2)):
            made = run(who, rmse + 0.1 * draw)
            drawn = {key: str(draw + i) for i, key in enumerate(keys)}
            runs.append(replace(made, coordinates={**made.coordinates, **drawn}))
    title, notes, data = _title_and_notes(runs)
    assert title.endswith("3 conditions by the rig's parameters (25 of plant.parameters)")
    assert "k_3" not in title + notes and "Worst of b: rig 1 (" in notes
    assert data["conditions_by"] == keys
    title, _, _ = _title_and_notes([run("a"), run("b", 0.2)])
    assert title == "2 runs: 2 entrants by controller, 1 condition"


@pytest.mark.parametrize(("own", "differ"), [(True, True), (False, False)])
def test_rigs_that_each_took_their_own_model_are_told(own, differ):
    runs = []
    for model in ("fit", "newtonian"):
        rig = {"path": model if own else "newtonian"}
        made = run("lqr", config={"plant": {"model": rig}})
        runs.append(replace(made, coordinates={**made.coordinates, "model": model}))
    _, notes, data = _title_and_notes(runs)
    assert data["rigs_differ_by_model"] is differ
    assert ("The rigs differ" in notes) is differ


def test_a_rig_that_is_chosen_to_be_what_it_was_is_no_difference():
    """``trms run --from first model=fit`` after a run that chose no equations for its rig."""
    equations = [{"a": 1, "b": 2}, {"b": 2, "a": 1}]  # composed in another order
    runs = []
    for model, own, rig in zip(("newtonian", "fit"), ("none", "newtonian"), equations, strict=True):
        made = run("lqr", config={"plant": {"model": rig}})
        chosen = {"model": model, "model@plant.model": own}
        runs.append(replace(made, coordinates={**made.coordinates, **chosen}))
    title, notes, data = _title_and_notes(complete_coordinates(runs))
    assert "2 entrants by model, 1 condition" in title and "plant.model" not in title
    assert data["rigs_differ_by_model"] is False and "The rigs differ" not in notes
    assert [row[0] for row in pair(*runs).settings] == ["model"]
