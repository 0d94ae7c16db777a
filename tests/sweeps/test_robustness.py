"""What drawn runs say: shares with their intervals, spreads, correlations, who is best."""

import numpy as np
import pytest
from scipy import stats

from trms_cli.sweeps.figures import canonical, figure_of, unit_of
from trms_cli.sweeps.samplers.drawing import Robustness
from trms_cli.sweeps.samplers.random import Random
from trms_cli.sweeps.space import Choice, PriorOfKey, RunResult, Space, short_keys

PARAMETERS = tuple(
    PriorOfKey(f"plant.parameters.{name}", 1.0, 0.1, 0.75, 1.25) for name in ("k", "unimportant")
)
CONTROLLERS = Choice("controller", ("pid", "lqr"))


def run(point, noise=0.0):
    """lqr is better by 0.05; a large k is bad, and ends runs of pid."""
    k = point.values["plant.parameters.k"]
    pid = point.values.get("controller") == "pid"
    if pid and k > 1.2:
        return RunResult(point.number, "failed", problem="diverged")
    figure = k + 0.05 * pid + noise * hash_of(point)
    return RunResult(point.number, "done", {"rmse_alpha_h": figure})


def hash_of(point):
    return float(np.random.default_rng(point.number).standard_normal())


def told(samples=200, choices=(CONTROLLERS,), work=run, seed=1, **config):
    proposals = Random(samples=samples, seed=seed, figures=("rmse_yaw",), **config).start(
        Space((), choices, PARAMETERS)
    )
    points = proposals.more([], proposals.total)
    results = {point.number: work(point) for point in points}
    return proposals.summary(results), points, results


def test_failures_are_counted_with_an_interval_that_holds():
    summary, points, results = told()
    pid, lqr = summary["groups"]
    failed = sum(results[p.number].state == "failed" for p in points)
    assert pid["choices"] == {"controller": "pid"} and 0 < failed == pid["failures"]["count"]
    expected = stats.binomtest(failed, 200).proportion_ci(0.95, "exact")
    assert (pid["failures"]["low"], pid["failures"]["high"]) == (expected.low, expected.high)
    assert pid["failures"]["low"] < stats.norm.sf(2.0) < pid["failures"]["high"]
    assert lqr["failures"]["count"] == 0 and 0.01 < lqr["failures"]["high"] < 0.02


def test_a_limit_makes_failures_of_runs():
    summary, points, results = told(limits={"rmse_yaw": 1.1})
    lqr = summary["groups"][1]
    figures = [figure_of(results[p.number], "rmse_alpha_h") for p in points]
    beyond = sum(f is not None and f > 1.1 for f in figures[1::2])
    assert lqr["failures"]["beyond"] == {"rmse_alpha_h": beyond}
    assert lqr["failures"]["count"] == beyond > 10


def test_correlations_name_what_matters():
    summary, _, _ = told(work=lambda p: run(p, noise=0.03))
    for group in summary["groups"]:
        first, second = group["sensitivity"]
        assert first["key"] == "plant.parameters.k" and first["rho"] > 0.9 and first["p"] < 1e-9
        assert abs(second["rho"]) < 0.25


def test_what_does_not_matter_is_rarely_called_correlated():
    """One in twenty is expected; of 40 more than 7 would come about once in 500 times."""
    called = 0
    for seed in range(40):
        summary, _, _ = told(60, (), work=lambda p: run(p, noise=0.03), seed=seed)
        [group] = summary["groups"]
        called += next(e for e in group["sensitivity"] if "unimportant" in e["key"])["p"] < 0.05
    assert called <= 7


def test_spreads_and_the_best_are_those_of_the_runs():
    summary, points, results = told()
    lqr = summary["groups"][1]["figures"]["rmse_alpha_h"]
    figures = [results[p.number].figures["rmse_alpha_h"] for p in points[1::2]]
    assert lqr["median"] == pytest.approx(np.median(figures))
    assert (lqr["min"], lqr["max"]) == (min(figures), max(figures))
    assert lqr["percentiles"][95] == lqr["q95"]
    shares = [group["figures"]["rmse_alpha_h"]["best_share"] for group in summary["groups"]]
    assert shares == [0.0, 1.0]


def test_a_rig_with_other_channels_is_told_by_its_own():
    def cart(point):
        return RunResult(point.number, "done", {"rmse_position": 0.1, "effort": 2.0})

    proposals = Random(samples=3, seed=1, figures=("rmse_yaw", "effort")).start(
        Space((), (), PARAMETERS)
    )
    points = proposals.more([], proposals.total)
    summary = proposals.summary({point.number: cart(point) for point in points})
    # an effort that is the sum over inputs of another rig is not in V² s
    assert summary["figures"] == {"rmse_position": {"unit": ""}, "effort": {"unit": ""}}
    assert unit_of("effort", ("rmse_alpha_v",)) == "V² s" and unit_of("solve_p99", ("x",)) == "ms"


def test_runs_of_one_draw_count_once():
    seeds = Choice("seed", ("1", "2", "3"))
    once, _, _ = told()
    thrice, _, _ = told(choices=(CONTROLLERS, seeds))
    for one, three in zip(once["groups"], thrice["groups"], strict=True):
        assert three["runs"] == 3 * one["runs"]
        assert three["failures"] == one["failures"]
        assert three["figures"]["rmse_alpha_h"]["sd"] == pytest.approx(
            one["figures"]["rmse_alpha_h"]["sd"]
        )


def test_lost_and_interrupted_runs_say_nothing_of_a_controller():
    def work(point):
        state = {0: "lost", 1: "interrupted"}.get(point.number % 20 // 2, "done")
        return RunResult(point.number, state, {"rmse_alpha_h": 1.0} if state == "done" else {})

    summary, _, _ = told(samples=100, work=work)
    for group in summary["groups"]:
        assert (group["runs"], group["lost"], group["failures"]["count"]) == (80, 10, 0)
        assert group["sensitivity"] == []  # the figure is the same everywhere


def test_a_command_without_scores_is_told_by_its_figure_of_merit():
    def work(point):
        return RunResult(point.number, "done", {}, objective=point.values["plant.parameters.k"])

    summary, _, _ = told(work=work)
    assert list(summary["figures"]) == ["merit"]
    assert Robustness(("rmse_alpha_h",)).summary(Space((), (), PARAMETERS), [], {})["groups"] == []


@pytest.mark.parametrize(
    ("said", "meant"),
    [("rmse_yaw", "rmse_alpha_h"), ("effort", "effort"), ("rmse_phi_elbow", "rmse_phi_elbow")],
)
def test_figures_by_any_of_their_names(said, meant):
    assert canonical(said, "here") == meant


def test_short_keys_are_told_apart():
    keys = ["controller.state_weights.alpha_v", "controller.rate_weights.alpha_v", "seed"]
    names = ["state_weights.alpha_v", "rate_weights.alpha_v", "seed"]
    assert list(short_keys(keys).values()) == names
    both = ["plant.parameters.k_g", "plant.parameters.R", "model.parameters.R"]
    assert list(short_keys(both).values()) == ["k_g", "plant.parameters.R", "model.parameters.R"]
