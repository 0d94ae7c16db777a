"""Genetic algorithm and CMA-ES on a recording whose parameters are known."""

from dataclasses import replace

import numpy as np
import pytest

from tests.identification.watched import Watched
from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.cma_es import CmaEs
from trms_cli.identification.genetic import Genetic
from trms_cli.identification.population import Box, SimulationCost
from trms_cli.identification.problem import FitOutcome, SilentProgress

SMALL = Genetic(individuals=12, generations=8)


def truth(rig) -> np.ndarray:
    """The true values in the order of the free parameters."""
    return np.array([rig.true[name] for name in rig.problem().names])


@pytest.fixture(scope="module")
def cost(rig) -> SimulationCost:
    return SimulationCost(rig.problem())


class TestSimulationCost:
    def test_is_least_where_the_recording_was_made(self, rig, cost):
        problem = rig.problem()
        true = truth(rig)
        least = cost(true)
        for i, scale in enumerate(problem.scales):
            for change in (-0.3, 0.3):
                other = true.copy()
                other[i] += change * scale
                assert cost(other) > least + 5
        # Where the noise is as declared it is half the squares.
        gap = (true - problem.prior_means) / problem.scales
        samples = np.isfinite(rig.dataset.measurements).sum()
        assert least - 0.5 * gap @ gap == pytest.approx(samples / 2, rel=0.06)

    def test_missing_samples_do_not_count(self, rig, cost):
        true, measured = truth(rig), rig.dataset.measurements.copy()
        measured[100:160] = np.nan
        gappy = replace(rig.dataset, measurements=measured)
        fewer = SimulationCost(rig.problem(datasets=(gappy,)))(true)
        assert fewer == pytest.approx(cost(true) - 60, abs=25)

    def test_without_an_estimate_of_the_misfit_it_grows_with_its_square(self, rig):
        plain = SimulationCost(rig.problem(discrepancy="none", robust=None))
        estimated = SimulationCost(rig.problem())
        start = rig.problem().starts
        assert plain(start) > 1.5 * estimated(start)

    def test_a_simulation_that_overflows_costs_infinitely_much(self, rig, cost):
        theta = truth(rig)
        theta[rig.problem().names.index("k_ov")] = -1e9
        assert cost(theta) == np.inf


class TestBox:
    def test_values_and_points_are_inverse(self, rig):
        box = Box(rig.problem(), 3.0)
        points = np.random.default_rng(0).uniform(size=(5, box.dimension))
        assert box.point(box.values(points)) == pytest.approx(points)

    def test_draws_begin_at_the_start_and_follow_the_priors(self, rig):
        problem = rig.problem()
        box = Box(problem, 3.0)
        drawn = box.values(box.draw(4000, np.random.default_rng(0)))
        assert drawn[0] == pytest.approx(problem.starts)
        assert drawn.mean(axis=0) == pytest.approx(problem.prior_means, rel=0.03)
        assert drawn.std(axis=0) == pytest.approx(problem.scales, rel=0.06)
        # It needs a free parameter.
        with pytest.raises(ConfigurationError, match="no parameter is free"):
            Box(rig.problem(free=()), 3.0)


class TestFit:
    def test_cma_finds_the_parameters(self, rig):
        result = CmaEs(evaluations=600).fit(rig.problem(), SilentProgress())
        assert result.outcome is FitOutcome.CONVERGED
        for name, true in rig.true.items():
            assert result.values[name] == pytest.approx(true, rel=0.02)

    def test_the_genetic_algorithm_comes_nearer(self, rig):
        problem = rig.problem()
        cost = SimulationCost(problem)
        progress = Watched()
        result = SMALL.fit(problem, progress)
        assert result.outcome is FitOutcome.BUDGET_SPENT
        true = cost(truth(rig))
        # The cost is logarithmic in the misfit: half of it is the greater part of the error.
        assert result.cost - true < 0.5 * (cost(problem.starts) - true)
        assert result.cost == cost(result.theta)
        assert result.evaluations == 96 == result.history[-1].evaluations
        assert progress.fractions == sorted(progress.fractions) and progress.fractions[-1] == 1.0

    def test_threads_change_nothing(self, rig):
        small = replace(SMALL, generations=3)
        one = small.fit(rig.problem(jobs=1), SilentProgress())
        two = small.fit(rig.problem(jobs=2), SilentProgress())
        assert one.values == two.values and one.cost == two.cost

    @pytest.mark.parametrize("method", [SMALL, CmaEs(evaluations=96)])
    def test_goes_on_bit_for_bit(self, rig, method):
        whole = method.fit(rig.problem(), SilentProgress())
        stopped = Watched(3)
        first = method.fit(rig.problem(), stopped)
        assert first.outcome is FitOutcome.INTERRUPTED and first.evaluations < whole.evaluations
        resumed = method.fit(rig.problem(), Watched(kept=stopped.kept))
        assert resumed.values == whole.values
        assert [p.cost for p in resumed.history] == [p.cost for p in whole.history]

    def test_another_seed_is_another_search(self, rig):
        stopped = Watched(2)
        SMALL.fit(rig.problem(), stopped)
        with pytest.raises(ConfigurationError, match="seed was 0 and is 1"):
            SMALL.fit(rig.problem(seed=1), Watched(kept=stopped.kept))
