"""The loop: a search's way is a function of its seed and costs, however often it is stopped."""

import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.cma_es import CmaEs, CmaSearch
from trms_cli.identification.genetic import Genetic, GeneticSearch
from trms_cli.identification.population import Journal, evolve, on_threads

N = 4
TARGET = np.array([0.2, 0.8, 0.55, 0.4])


def bowl(point: np.ndarray) -> float:
    """A narrow valley with its least value 0 at TARGET; fails beyond a corner."""
    if point.sum() > 3.5:
        return np.nan
    d = point - TARGET
    return float(d @ d + 30 * (d[0] - d[1]) ** 2)


def genetic(seed: int = 1, **changes) -> GeneticSearch:
    first = np.random.default_rng(seed).uniform(size=(20, N))
    return GeneticSearch(first, seed, Genetic(mutation_sd=0.1, **changes))


def cma(seed: int = 1, restarts: int = 0) -> CmaSearch:
    settings_ = CmaEs(initial_step=0.2, restarts=restarts, tolerance=1e-10)
    return CmaSearch(np.full(N, 0.5), seed, settings_)


SEARCHES = {"genetic": genetic, "cma": cma, "cma restarted": lambda seed=1: cma(seed, 2)}


def run(search, evaluations=200, journal=None, watch=None, cost=bowl, jobs=1):
    return evolve(
        search, on_threads(cost, jobs), evaluations=evaluations, dimension=N, journal=journal,
        watch=watch,
    )  # fmt: skip


@pytest.mark.parametrize("make", SEARCHES.values(), ids=SEARCHES)
class TestSearch:
    def test_points_lie_in_the_box_and_costs_never_rise(self, make):
        seen = []

        def cost(point):
            seen.append(point)
            return bowl(point)

        found = run(make(), cost=cost)
        assert np.min(seen) >= 0 and np.max(seen) <= 1
        best = [least for least, _ in found.costs]
        assert all(b <= a for a, b in pairwise(best))
        assert found.cost == bowl(found.best) == np.nanmin([bowl(p) for p in seen])

    def test_the_seed_decides_and_the_threads_do_not(self, make):
        one, two, other = run(make()), run(make(), jobs=2), run(make(5))
        assert one.cost == two.cost and one.costs == two.costs
        assert np.array_equal(one.best, two.best)
        assert one.costs != other.costs
        # A larger budget goes the same way farther.
        longer = run(make(), 300)
        assert longer.costs[: len(one.costs)] == one.costs

    @settings(max_examples=4, deadline=None)
    @given(stops=st.lists(st.integers(1, 9), min_size=1, max_size=2))
    def test_stopped_and_resumed_is_never_stopped(self, make, stops):
        whole = run(make())
        saved = None
        for after in stops:
            journal = Journal({"a": (1, 2)}, saved)
            count = [0]

            def watch(found, count=count, after=after):
                count[0] += 1
                return count[0] < after

            run(make(), journal=journal, watch=watch)
            saved = json.loads(json.dumps(journal.state))
        simulated = [0]

        def cost(point):
            simulated[0] += 1
            return bowl(point)

        resumed = run(make(), journal=Journal({"a": (1, 2)}, saved), cost=cost)
        assert resumed.costs == whole.costs
        assert np.array_equal(resumed.best, whole.best)
        known = sum(len(entry["costs"]) for entry in saved["generations"])
        assert simulated[0] == whole.evaluations - known


class TestFinding:
    def test_cma_finds_the_bottom_and_says_so_and_restarts_spend_what_is_left(self):
        found = run(cma(), 4000)
        assert found.stop_reason.startswith("converged")
        assert found.best == pytest.approx(TARGET, abs=1e-3)
        once, twice = run(cma(), 9000), run(cma(restarts=1), 9000)
        assert once.evaluations < twice.evaluations < 9000

    @pytest.mark.parametrize("crossover", ["simulated_binary", "uniform", "two_point"])
    @pytest.mark.parametrize("mutation", ["polynomial", "gaussian"])
    def test_operators_of_the_genetic_algorithm_lower_the_cost(self, crossover, mutation):
        first = min(bowl(p) for p in np.random.default_rng(1).uniform(size=(20, N)))
        found = run(genetic(crossover=crossover, mutation=mutation), 600)
        assert found.cost < 0.3 * first

    def test_failed_simulations_are_survived(self):
        found = run(genetic(), 100, cost=lambda point: np.inf)
        assert found.cost == np.inf and found.evaluations >= 100


def test_a_journal_of_another_search_is_refused():
    settings_ = {"seed": 1, "method.individuals": 20}
    journal = Journal(settings_)
    run(genetic(), 60, journal=journal)
    with pytest.raises(ConfigurationError, match="individuals was 20 and is 30"):
        Journal({"seed": 1, "method.individuals": 30}, journal.state)
    with pytest.raises(ConfigurationError, match="generation 1 does not come out"):
        run(genetic(2), 60, journal=Journal(settings_, journal.state))
    with pytest.raises(ConfigurationError, match="another method or version"):
        Journal({}, {"weights": [1.0]})
