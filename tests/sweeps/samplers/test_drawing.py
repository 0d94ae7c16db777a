"""Draws keep to the distributions that they are drawn from, and to the design that draws them."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import stats

from trms_cli.core.errors import ConfigurationError
from trms_cli.models.parameters import DRAW_LIMIT_SD, Parameter, ParameterSet
from trms_cli.sweeps.samplers.drawing import quantiles
from trms_cli.sweeps.samplers.grid import Grid
from trms_cli.sweeps.samplers.latin_hypercube import LatinHypercube, hypercube
from trms_cli.sweeps.samplers.random import Random
from trms_cli.sweeps.samplers.sobol import Sobol
from trms_cli.sweeps.space import Choice, PriorOfKey, Range, Space

PRIOR = PriorOfKey(
    "plant.parameters.k", 2.0, 0.2, 2.0 - DRAW_LIMIT_SD * 0.2, 2.0 + DRAW_LIMIT_SD * 0.2
)
LINEAR = Range("a", -1.0, 3.0)
LOGARITHMIC = Range("b", 1e-3, 1e2, logarithmic=True)
WHOLE = Range("n", 1, 6, whole=True)
NARROW = Range("w", 1.23456781, 1.23456789)  # no number between has six digits
CONTROLLERS = Choice("controller", ("pid", "lqr", "newton_mpc"))
SPACE = Space(("sim.duration=1",), (CONTROLLERS,), (PRIOR, LINEAR, LOGARITHMIC, WHOLE))
DRAWING = [Random, LatinHypercube, Sobol]


def points_of(sampler, space, known=()):
    proposals = sampler.start(space, known)
    points = list(known)
    while more := proposals.more([], 7):
        points += more
    assert len(points) == proposals.total
    assert [point.number for point in points] == list(range(len(points)))
    return points


class TestLatinHypercube:
    @given(st.integers(1, 60), st.integers(1, 8), st.integers(0, 2**31), st.booleans())
    @settings(max_examples=40)
    @example(4, 2, 138, True)  # both columns are drawn in one order
    def test_each_share_of_each_column_is_drawn_once(self, samples, columns, seed, decorrelated):
        drawn = hypercube(samples, columns, seed, decorrelated)
        assert drawn.shape == (samples, columns)
        for column in drawn.T:
            assert sorted(np.floor(column * samples).astype(int)) == list(range(samples))

    def test_reordering_takes_chance_correlations_out(self):
        off = ~np.eye(20, dtype=bool)
        plain, better = (
            np.abs(stats.spearmanr(hypercube(100, 20, 3, decorrelated)).statistic)[off].max()
            for decorrelated in (False, True)
        )
        assert better < 0.3 * plain

    def test_its_mean_scatters_less_than_that_of_independent_draws(self):
        def scatter(sampler):
            means = []
            for seed in range(40):
                points = points_of(sampler(samples=16, seed=seed), Space((), (), (PRIOR, LINEAR)))
                means.append(np.mean([sum(point.values.values()) for point in points]))
            return np.std(means)

        assert scatter(LatinHypercube) < 0.3 * scatter(Random)


class TestMarginals:
    @pytest.mark.parametrize("sampler", DRAWING)
    def test_a_prior_is_drawn_as_prior_seed_draws_it(self, sampler):
        """The distribution is that of ``plant.prior_seed``, which is drawn 2000 times here."""
        table = ParameterSet([Parameter("k", 2.0, prior_sd=0.1)])
        theirs = [float(table.draw(seed).values[0]) for seed in range(2000)]
        space = Space((), (), (PRIOR,))
        ours = [p.values[PRIOR.key] for p in points_of(sampler(samples=2000, seed=1), space)]
        assert stats.ks_2samp(ours, theirs).pvalue > 0.01
        edge = np.mean(np.isclose(theirs, PRIOR.low) | np.isclose(theirs, PRIOR.high))
        assert np.mean(np.isin(ours, [PRIOR.low, PRIOR.high])) == pytest.approx(edge, abs=0.01)

    @pytest.mark.parametrize("sampler", DRAWING)
    def test_ranges_are_uniform_in_their_own_scale(self, sampler):
        points = points_of(sampler(samples=500, seed=1), Space((), (), (LINEAR, LOGARITHMIC)))
        linear, logarithmic = ([p.values[key] for p in points] for key in ("a", "b"))
        assert stats.kstest(linear, "uniform", (-1.0, 4.0)).pvalue > 0.05
        assert stats.kstest(np.log10(logarithmic), "uniform", (-3.0, 5.0)).pvalue > 0.05

    def test_whole_numbers_are_equally_frequent(self):
        points = points_of(LatinHypercube(samples=600), Space((), (), (WHOLE,)))
        values = [point.values["n"] for point in points]
        assert all(isinstance(value, int) for value in values)
        assert [values.count(n) for n in range(1, 7)] == [100] * 6

    @given(st.floats(0, 1), st.sampled_from([PRIOR, LINEAR, LOGARITHMIC, WHOLE, NARROW]))
    def test_no_draw_leaves_the_bounds(self, share, varied):
        [value] = quantiles(varied, np.array([share]))
        assert varied.low <= value <= varied.high

    @pytest.mark.parametrize(
        "varied",
        [
            PRIOR,
            PriorOfKey("m", 0.0740000123456, 0.00444, 0.06290000000000001, 0.0851000123456),
            Range("w", 1.23456789, 9.87654321),
            Range("l", 1.23456789e-5, 9.87654321, logarithmic=True),
            Range("negative", -9.87654321, -1.23456789),
        ],
        ids=lambda varied: varied.key,
    )
    def test_what_is_drawn_has_six_digits_also_at_the_bounds(self, varied):
        drawn = quantiles(varied, np.linspace(0, 1, 41))
        assert all(float(f"{value:.6g}") == value for value in drawn)
        assert all(varied.low <= value <= varied.high for value in drawn)


class TestCrossing:
    @pytest.mark.parametrize("sampler", DRAWING)
    def test_every_choice_sees_the_same_draws_and_what_is_typed_is_what_is_told(self, sampler):
        seen = {name: [] for name in CONTROLLERS.values}
        for point in points_of(sampler(samples=20), SPACE):
            assert point.overrides[0] == "sim.duration=1"
            typed = dict(text.split("=") for text in point.overrides[1:])
            assert typed == {key: str(value) for key, value in point.values.items()}
            assert all(float(typed[key]) == point.values[key] for key in "abn")
            drawn = tuple(value for key, value in point.values.items() if key != "controller")
            seen[point.values["controller"]].append(drawn)
        assert len(set(seen["pid"])) == 20
        assert seen["pid"] == seen["lqr"] == seen["newton_mpc"]

    def test_a_grid_is_nested_loops_and_of_nothing_one_run(self):
        seeds = Choice("seed", ("1", "2"))
        points = points_of(Grid(), Space((), (CONTROLLERS, seeds)))
        assert [tuple(p.values.values()) for p in points] == [
            (controller, seed) for controller in CONTROLLERS.values for seed in seeds.values
        ]
        [point] = points_of(Grid(), Space(("seed=3",), ()))
        assert point.overrides == ("seed=3",)


class TestResuming:
    @pytest.mark.parametrize("sampler", DRAWING)
    @pytest.mark.parametrize("known", [0, 1, 8, 60])
    def test_goes_on_with_the_same_points(self, sampler, known):
        config = sampler(samples=20, seed=5)
        whole = points_of(config, SPACE)
        assert points_of(config, SPACE, whole[:known]) == whole

    @pytest.mark.parametrize("sampler", [Random, Sobol])
    def test_fewer_draws_are_the_first_of_more(self, sampler):
        assert points_of(sampler(samples=8), SPACE) == points_of(sampler(samples=16), SPACE)[:24]

    @pytest.mark.parametrize("changed", [{"seed": 6}, {"samples": 10}])
    def test_another_configuration_is_refused(self, changed):
        known = points_of(LatinHypercube(samples=20, seed=5), SPACE)
        with pytest.raises(ConfigurationError, match="another when the sweep began"):
            LatinHypercube(**{"samples": 20, "seed": 5} | changed).start(SPACE, known)


class TestBadInput:
    @pytest.mark.parametrize("sampler", DRAWING)
    def test_nothing_to_draw(self, sampler):
        with pytest.raises(ConfigurationError, match="no range and no prior") as caught:
            sampler().start(Space((), (CONTROLLERS,)))
        assert "sampler=grid" in caught.value.remedy

    @pytest.mark.parametrize(("varied", "words"), [(LINEAR, "range"), (PRIOR, "prior")])
    def test_a_grid_has_no_ranges(self, varied, words):
        with pytest.raises(ConfigurationError, match=words) as caught:
            Grid().start(Space((), (CONTROLLERS,), (varied,)))
        assert caught.value.where == varied.key
        assert "sampler=latin_hypercube" in caught.value.remedy

    def test_figures_that_do_not_exist(self):
        with pytest.raises(ConfigurationError, match="rmse_yw") as caught:
            LatinHypercube(figures=("rmse_yw",)).start(SPACE)
        assert "did you mean rmse_yaw" in caught.value.remedy
