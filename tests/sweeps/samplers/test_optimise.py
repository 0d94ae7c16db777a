"""The search finds what there is to be found, proposes the same again, and tells it honestly."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from trms_cli.core.errors import ConfigurationError
from trms_cli.sweeps.samplers.objectives import Aims, TrialOutcome, front, hypervolumes
from trms_cli.sweeps.samplers.optimise import Optimise
from trms_cli.sweeps.space import Choice, PriorOfKey, Range, RunResult, Space

WEIGHTS = tuple(Range(f"w.{i}", 1e-2, 1e2, logarithmic=True, now=50.0) for i in range(3))
RIG = PriorOfKey("plant.parameters.k", 1.0, 0.1, 0.75, 1.25)
REFERENCES = Choice("ref", ("sine", "square"))
SPACE = Space(("controller=lqr",), (REFERENCES,), WEIGHTS)
TWO = ("rmse_yaw", "effort")


def bowls(point):
    """Two bowls about 10^±1/2 in each weight: the front lies between them."""
    logs = np.log10([point.values.get(each.key, each.now) for each in WEIGHTS])
    rig = point.values.get(RIG.key, 1.0)
    merit = float(((logs - 0.5) ** 2).sum()) * rig + (point.values["ref"] == "sine")
    figures = {"rmse_alpha_h": merit, "effort": float(((logs + 0.5) ** 2).sum())}
    return RunResult(point.number, "done", figures, merit)


def with_failures(point):
    if point.values["w.0"] > 10 and "w.0=" in " ".join(point.overrides):
        return RunResult(point.number, "failed", problem="diverged")
    return bowls(point)


def searched(config, space=SPACE, work=bowls, known=(), results=(), workers=3, stop=None):
    """Make a search; `stop` ends it after so many points, the last batch half done."""
    proposals = config.start(space, known)
    points, told = list(known), {result.number: result for result in results}
    told |= {p.number: work(p) for p in points if p.number not in told}
    news = list(told.values())
    while more := proposals.more(news, workers):
        points += more
        if stop is not None and len(points) > stop:
            half = [work(p) for p in more[: len(more) // 2]]
            return proposals, points, told | {r.number: r for r in half}
        # The order in which runs end is nobody's choice.
        news = [work(p) for p in more][:: 1 if workers % 2 else -1]
        told |= {result.number: result for result in news}
    return proposals, points, told


class TestFinding:
    def test_a_known_optimum_is_found_better_than_by_chance(self):
        best = {}
        for method in ("tpe", "random"):
            found = []
            for seed in range(3):
                config = Optimise(trials=45, method=method, seed=seed, baseline=False)
                proposals, _, results = searched(config)
                summary = proposals.summary(results)
                [chosen] = [t for t in summary["trials"] if t["trial"] == summary["best"]]
                found.append(chosen["figures"]["merit"] - 0.5)  # the optimum's is 0.5
            best[method] = np.median(found)
        assert best["tpe"] < 0.1
        assert best["tpe"] < 0.3 * best["random"]

    @pytest.mark.parametrize("method", ["tpe", "nsga2"])
    def test_a_front_dominates_more_than_one_by_chance(self, method):
        fronts = []
        for each in (method, "random"):
            config = Optimise(trials=60, method=each, objectives=TWO, seed=1)
            proposals, _, results = searched(config)
            trials = proposals.summary(results)["trials"]
            fronts.append([list(t["figures"].values()) for t in trials])
        volumes = hypervolumes(np.array(fronts[1] + fronts[0]))
        assert volumes is not None
        assert volumes[-1] > 1.1 * volumes[len(fronts[1]) - 1]

    def test_what_is_more_can_be_better(self):
        config = Optimise(trials=40, objectives=("rmse_yaw",), maximise=("rmse_yaw",))
        proposals, _, results = searched(config)
        summary = proposals.summary(results)
        most = max(t["figures"]["rmse_alpha_h"] for t in summary["trials"])
        [best] = [t for t in summary["trials"] if t["trial"] == summary["best"]]
        assert best["figures"]["rmse_alpha_h"] == most == summary["history"][-1]
        assert most > 15  # 2.5² in each weight and 0.5 are the most there is, 19.25


class TestConditions:
    def test_all_trials_see_the_same(self):
        space = Space((), (REFERENCES,), (*WEIGHTS, RIG))
        _, points, _ = searched(Optimise(trials=10, draws=3), space)
        seen: dict[int, list[tuple]] = {}
        for point in points:
            drawn = (point.values[RIG.key], point.values["ref"])
            seen.setdefault(point.trial, []).append(drawn)
        assert len(seen) == 10 and len(set(seen[0])) == 6
        assert all(conditions == seen[0] for conditions in seen.values())

    @pytest.mark.parametrize(("how", "expected"), [("mean", 1.5), ("worst", 2.0)])
    def test_an_objective_is_the_mean_or_the_worst_unless_a_run_failed(self, how, expected):
        aims = Aims(("effort",), worst=how == "worst")
        results = [RunResult(i, "done", {"effort": value}) for i, value in enumerate((1.0, 2.0))]
        assert aims.outcome(results).figures["effort"] == expected
        lost = aims.outcome([*results, RunResult(2, "lost", problem="gone")])
        assert lost == TrialOutcome(problem="gone") and lost.failed

    def test_limits_hold_in_every_condition(self):
        aims = Aims(("rmse_alpha_h",), limits={"solve_p99": 20.0})
        slow = [
            RunResult(i, "done", {"rmse_alpha_h": 0.1, "solve_p99": value})
            for i, value in enumerate((5.0, 25.0))
        ]
        assert aims.excess(aims.outcome(slow)) == [pytest.approx(0.25)]
        assert not aims.is_feasible(aims.outcome(slow))
        assert aims.is_feasible(aims.outcome(slow[:1]))


class TestBaseline:
    def test_the_first_trial_is_the_configuration_as_it_is(self):
        _, points, _ = searched(Optimise(trials=3))
        first = points[:2]
        assert [p.overrides for p in first] == [
            ("controller=lqr", "ref=sine"),
            ("controller=lqr", "ref=square"),
        ]
        assert first[0].values["w.0"] == 50.0

    def test_it_is_tried_also_where_it_lies_outside_of_the_ranges(self):
        outside = Space((), (REFERENCES,), (Range("w.0", 1.0, 2.0, now=9.0), *WEIGHTS[1:]))
        proposals, _, results = searched(Optimise(trials=20), outside)
        summary = proposals.summary(results)
        assert summary["trials"][0]["values"]["w.0"] == 9.0
        assert len(summary["trials"]) == 20
        assert all(1.0 <= t["values"]["w.0"] <= 2.0 for t in summary["trials"][1:])


class TestFailures:
    def test_failed_trials_are_never_the_best_and_are_avoided(self):
        config = Optimise(trials=60, objectives=TWO, seed=2)
        proposals, _, results = searched(config, work=with_failures)
        summary = proposals.summary(results)
        failed = {t["trial"] for t in summary["trials"] if "problem" in t}
        assert failed and not failed & set(summary["pareto"])
        early = sum(n < 13 for n in failed) / 13
        late = sum(n >= 30 for n in failed) / 30
        assert late < early

    def test_nothing_that_works(self):
        def broken(point):
            return RunResult(point.number, "failed", problem="no")

        proposals, _, results = searched(Optimise(trials=20, confirm=2), work=broken)
        summary = proposals.summary(results)
        assert summary["pareto"] == [] and summary["best"] is None
        assert summary["history"] == [None] * 20

    def test_beyond_a_limit_is_no_best(self):
        config = Optimise(trials=60, objectives=("rmse_yaw",), limits={"effort": 1.0})
        proposals, _, results = searched(config)
        summary = proposals.summary(results)
        [best] = [t for t in summary["trials"] if t["trial"] == summary["best"]]
        assert best["figures"]["worst effort"] <= 1.0
        least = min(t["figures"]["rmse_alpha_h"] for t in summary["trials"])
        assert best["figures"]["rmse_alpha_h"] > least


class TestResuming:
    @pytest.mark.parametrize("method", ["tpe", "nsga2", "random"])
    @pytest.mark.parametrize("objectives", [(), TWO], ids=["one", "two"])
    def test_goes_on_with_the_same_points(self, method, objectives):
        space = Space(("controller=lqr",), (REFERENCES,), (*WEIGHTS, RIG))
        config = Optimise(
            trials=24, method=method, objectives=objectives, batch=6, draws=2, confirm=2
        )
        whole, points, results = searched(config, space)
        for stop in (10, 70):
            _, known, half = searched(config, space, stop=stop)
            again, resumed, others = searched(
                config, space, known=known, results=half.values(), workers=8
            )
            assert resumed == points
            assert again.summary(others) == whole.summary(results)

    def test_another_space_is_refused(self):
        _, known, half = searched(Optimise(trials=30), stop=30)
        narrower = Space(SPACE.fixed, SPACE.choices, WEIGHTS[:2])
        with pytest.raises(ConfigurationError, match="another when the sweep began"):
            searched(Optimise(trials=30), narrower, known=known, results=half.values())

    def test_nothing_is_proposed_while_a_batch_is_at_work(self):
        proposals = Optimise(trials=30).start(SPACE)
        first = proposals.more([], 100)
        assert len(first) == 2 * 13
        assert proposals.more([bowls(p) for p in first[:-1]], 100) == []
        assert len(proposals.more([bowls(first[-1])], 100)) == 2 * 4


class TestConfirmation:
    def test_the_best_are_run_again_under_fresh_seeds_and_rigs(self):
        seeds = Choice("seed", ("1", "4"))
        space = Space(("x=1",), (REFERENCES, seeds), (*WEIGHTS, RIG))
        config = Optimise(trials=20, draws=2, confirm=3)
        proposals, points, results = searched(config, space)
        tried, again = points[: 20 * 8], points[20 * 8 :]
        summary = proposals.summary(results)
        assert {p.trial for p in again} == {0, summary["best"]}
        assert len(again) == 2 * 3 * 2 == len(points) - 160 == proposals.total - 160
        assert {p.values["seed"] for p in again} == {"2", "3", "5"}
        assert not {p.values[RIG.key] for p in again} & {p.values[RIG.key] for p in tried}
        [best] = [t for t in summary["trials"] if t["trial"] == summary["best"]]
        own = [results[p.number].objective for p in again if p.trial == summary["best"]]
        assert best["confirmed"]["runs"] == 6 and best["confirmed"]["failed"] == 0
        assert best["confirmed"]["figures"]["merit"] == pytest.approx(np.mean(own))


class TestFront:
    @given(
        hnp.arrays(
            float,
            st.tuples(st.integers(0, 25), st.integers(1, 3)),
            elements=st.integers(0, 6).map(float),
        )
    )
    @settings(max_examples=60)
    def test_equals_brute_force(self, losses):
        def dominates(a, b):
            return all(a <= b) and any(a < b)

        expected = [
            i for i, row in enumerate(losses) if not any(dominates(other, row) for other in losses)
        ]
        assert front(losses).tolist() == expected

    def test_hypervolume_of_a_staircase_and_of_one_point(self):
        """Two corners of the unit square: each alone has 1.1·0.1, together one 0.1² less than 2."""
        volumes = hypervolumes(np.array([[0.0, 1.0], [1.0, 0.0], [2.0, 2.0]]))
        assert volumes == pytest.approx([0.11, 0.21, 0.21])
        assert hypervolumes(np.array([[0.0, 0.0], [1.0, 1.0]])) is None


class TestBadInput:
    def test_nothing_to_search_and_objectives_that_are_none(self):
        with pytest.raises(ConfigurationError, match="nothing is searched"):
            Optimise().start(Space((), (REFERENCES,), (RIG,)))
        with pytest.raises(ConfigurationError, match="rmse_yaww") as caught:
            Optimise(objectives=("rmse_yaww",)).start(SPACE)
        assert "did you mean rmse_yaw" in caught.value.remedy
        assert len(caught.value.remedy) < 120
        with pytest.raises(ConfigurationError, match="is no objective"):
            Optimise(objectives=("rmse_yaw",), maximise=("effort",)).start(SPACE)

    @pytest.mark.parametrize(
        ("asked", "where"),
        [
            ({"objectives": ("settling_time_yaw", "effort")}, "sampler.objectives"),
            ({"limits": {"settling_time_yaw": 3.0}}, "sampler.limits"),
        ],
    )
    def test_what_the_configuration_as_it_is_lacks_is_told_at_once(self, asked, where):
        proposals = Optimise(trials=30, **asked).start(SPACE)
        points = proposals.more([], 4)
        assert proposals.more([bowls(points[0])], 4) == []  # one of its two conditions
        with pytest.raises(ConfigurationError) as caught:
            proposals.more([bowls(points[1])], 4)
        assert caught.value.where == where
        assert "of the configuration as it is has a figure 'settling_time_yaw'" in str(caught.value)
        assert "alpha_h" not in str(caught.value)
        assert len(caught.value.remedy) < 160 and "baseline=false" in caught.value.remedy

    @pytest.mark.parametrize("method", ["tpe", "random"])
    def test_without_the_configuration_as_it_is_a_few_trials_tell(self, method):
        config = Optimise(trials=30, method=method, baseline=False, objectives=("iterations",))
        proposals = config.start(SPACE)
        points = proposals.more([], 4)
        proposals.more([bowls(point) for point in points[:7]], 4)
        with pytest.raises(ConfigurationError, match="none of the 8 runs of 4 trials"):
            proposals.more([bowls(points[7])], 4)

    def test_a_figure_that_some_runs_lack(self):
        """It counts as that of a run that failed, and the search goes on."""

        def work(point):
            found = bowls(point)
            settles = point.values["w.0"] < 1 or not any("w.0=" in t for t in point.overrides)
            figures = {**found.figures, **({"settling_time_alpha_h": 1.0} if settles else {})}
            return RunResult(point.number, "done", figures, found.objective)

        config = Optimise(trials=40, objectives=("effort", "settling_time_yaw"))
        proposals, _, results = searched(config, work=work)
        trials = proposals.summary(results)["trials"]
        without = {t["trial"] for t in trials if "problem" in t}
        assert 0 < len(without) < 20 and len(trials) == 40
        assert {t["problem"] for t in trials if t["trial"] in without} == {
            "a run has no settling_time_yaw"
        }
        assert not without & set(proposals.summary(results)["pareto"])
        assert all(trials[n]["values"]["w.0"] >= 1 for n in without)
