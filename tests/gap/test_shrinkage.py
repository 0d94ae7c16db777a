"""How far a correction closes the gap, and how sure that is with few sealed blocks."""

from dataclasses import replace

import numpy as np
import pytest

from tests.gap.recorded import effect, recording
from trms_cli.gap.competing_model import nominal_parameters, refit
from trms_cli.gap.free_runs import HorizonErrors
from trms_cli.gap.problem import Parts, applicable_candidates
from trms_cli.gap.shrinkage import _in_turn, _Pair, _pooled_shrink, harm
from trms_cli.models.newtonian import Newtonian


def test_harm_is_that_of_the_channel_that_fares_worst_at_the_longest_horizon() -> None:
    def errors(pitch: float, yaw: float):
        return {
            name: {
                2.0: HorizonErrors(np.full(4, 1e6), np.arange(4)),
                10.0: HorizonErrors(np.full(4, rms**2), np.arange(4)),
            }
            for name, rms in (("alpha_v", pitch), ("alpha_h", yaw))
        }

    floor, stray = errors(1.0, 1.0), {"alpha_v": 0.0, "alpha_h": 0.0}
    assert harm(errors(8, 4), errors(2, 6), floor, stray) == pytest.approx(np.log(1.5))
    assert harm(errors(8, 4), errors(2, 2), floor, stray) < 0  # all fare better
    # near the floor, and below what any rig strays by, no error is worse than another
    assert harm(errors(0.5, 4), errors(1.2, 4), floor, stray) == 0.0
    assert harm(errors(2, 4), errors(4, 4), floor, {"alpha_v": 5.0, "alpha_h": 0.0}) == 0.0
    # a run that diverges is a ruin, and a number; where both diverge, none is worse
    ruin = harm(errors(2, 2), errors(np.inf, 2), floor, stray)
    assert np.log(100) < ruin < np.inf
    assert harm(errors(np.inf, 2), errors(np.inf, 2), floor, stray) == 0.0
    assert harm(errors(np.inf, 2), errors(3, 2), floor, stray) <= 0.0


#: A channel that hardly differs between recordings.
TACHO, ANGLE = [True], [False]  # whether the channel is a rotor's speed


def pair(before: np.ndarray, after: np.ndarray, block: np.ndarray) -> _Pair:
    """A channel's squared errors with a floor of one."""
    return _Pair.of(HorizonErrors(before, block), HorizonErrors(after, block), 1.0)


def test_the_interval_of_a_shrink_comes_from_blocks() -> None:
    block = np.repeat(np.arange(6), 10)
    after = np.where(block < 3, 1.0, 26.0)  # three blocks closed entirely, three by half
    shrink = _pooled_shrink([pair(np.full(60, 101.0), after, block)], TACHO, 0)
    assert shrink.fraction == pytest.approx(1 - (np.sqrt(13.5) - 1) / (np.sqrt(101) - 1))
    assert shrink.ci95 is not None
    assert shrink.ci95[0] < shrink.fraction < shrink.ci95[1] <= 1.0
    none = _pooled_shrink([pair(np.ones(60), np.ones(60), block)], TACHO, 0)
    assert none.fraction is None and none.ci95 is None


def test_runs_that_diverge_count_where_they_are() -> None:
    block = np.repeat(np.arange(2), 5)
    fine, gone = np.full(10, 26.0), np.full(10, np.inf)
    sealed = pair(np.full(10, 101.0), fine, block)
    alone = _pooled_shrink([sealed], TACHO, 0)
    beside = _pooled_shrink([sealed.beside(pair(np.full(10, 101.0), gone, block))], TACHO, 0)
    assert beside.fraction == alone.fraction  # of the sealed part
    assert beside.ci95 is not None and beside.ci95[0] < -1
    lost = _pooled_shrink([pair(np.full(10, 101.0), gone, block)], TACHO, 0)
    assert lost.fraction is not None and lost.fraction < -1


def test_blocks_sealed_in_turn_tell_how_few_sealed_ones_scatter() -> None:
    """Of many parts as short as the sealed one, the interval holds what the whole would show."""
    random = np.random.default_rng(4)
    few, many = np.repeat(np.arange(2), 5), np.repeat(np.arange(8), 5)
    coverage_count, coverage_count_alone, width = 0, 0, []
    for trial in range(60):
        squared_errors = random.lognormal(2.0, 0.8, 10)  # squares that a block leaves
        after = np.repeat(squared_errors, 5)
        truth = 1 - (np.sqrt(np.exp(2.0 + 0.32)) - 1) / (np.sqrt(101) - 1)
        sealed = pair(np.full(10, 101.0), after[:10], few)
        turns = pair(np.full(40, 101.0), after[10:], many)
        shrink, alone = (
            _pooled_shrink([sealed.beside(turns)], TACHO, trial),
            _pooled_shrink([sealed], TACHO, trial),
        )
        assert shrink.fraction == alone.fraction  # what is told is of the sealed part
        assert shrink.ci95 is not None and alone.ci95 is not None
        coverage_count += shrink.ci95[0] <= truth <= shrink.ci95[1]
        coverage_count_alone += alone.ci95[0] <= truth <= alone.ci95[1]
        width.append(shrink.ci95[1] - shrink.ci95[0])
    assert coverage_count >= 50 > coverage_count_alone
    assert max(width) < 1.0


def test_the_interval_holds_what_another_recording_shows() -> None:
    """Whose drives wander otherwise: errors of an angle differ by a third, of both models alike."""
    random = np.random.default_rng(5)
    block = np.repeat(np.arange(6), 10)
    coverage_count, coverage_count_still, width = 0, 0, []
    for trial in range(60):
        squares = random.lognormal(0.0, 0.1, 60)
        both, one, other = np.array([0.3, 0.35, 0.35]) * random.standard_normal(3)
        before, after = (v * np.exp(both + e) for v, e in ((10.0, one), (3.0, other)))
        truth = 1 - (after - 1) / (before - 1)
        pairs = [pair(100 * squares, 9 * squares, block)]
        shrink, still = (
            _pooled_shrink(pairs, ANGLE, trial),
            _pooled_shrink(pairs, TACHO, trial),
        )
        assert shrink.ci95 is not None and still.ci95 is not None
        coverage_count += shrink.ci95[0] <= truth <= shrink.ci95[1]
        coverage_count_still += still.ci95[0] <= truth <= still.ci95[1]
        width.append(shrink.ci95[1] - shrink.ci95[0])
    assert coverage_count >= 54 > coverage_count_still + 10
    assert np.median(width) < 1.5
    # a correction that changes nothing does so on any recording
    same = np.full(60, 16.0)
    nothing = _pooled_shrink([pair(same, same, block)], ANGLE, 0)
    assert nothing.fraction == 0.0 and nothing.ci95 == pytest.approx((0.0, 0.0), abs=1e-12)


def test_a_block_is_foretold_by_the_others() -> None:
    """To first order the values without a block are those of a fit without it."""
    model = Newtonian()
    rubbing = effect("yaw_coulomb_friction", torque=0.004)
    dataset = recording({"yaw_coulomb_friction": rubbing}, seconds=40.0)
    free = tuple(p for p in nominal_parameters(model) if p.name in ("k_oh", "k_fhp", "k_fvp"))
    fitted = refit(model, free, (dataset,), 10.0)
    silent = dataset.measurements.copy()
    silent[: round(10.0 / dataset.sample_time)] = np.nan
    again = refit(model, free, (replace(dataset, measurements=silent),), 10.0)
    sd = dict(zip(fitted.structure.problem.names, fitted.fit.sd, strict=True))
    without = fitted.without(0).parameters

    def apart(one, other) -> float:
        return max(abs(one[name] - other[name]) / sd[name] for name in again.values)

    foretold = {name: without[name].value for name in again.values}
    assert apart(foretold, again.values) < 0.5 * apart(fitted.values, again.values)


def test_fitted_blocks_are_sealed_in_turn_where_the_sealed_part_is_short() -> None:
    model = Newtonian()
    rubbing = effect("yaw_coulomb_friction", torque=0.004)
    dataset = recording({"yaw_coulomb_friction": rubbing}, seconds=40.0)
    cut = round(30.0 / dataset.sample_time)
    fitted = dataset.part(0, cut)
    free = tuple(p for p in nominal_parameters(model) if p.name in ("k_oh", "k_fhp", "k_fvp"))
    plain = refit(model, free, (fitted,), 10.0)
    candidates, _ = applicable_candidates(model, {"yaw_coulomb_friction": rubbing})
    richer = plain.structure.with_effects(*candidates.values())
    corrected = richer.fit(
        plain.metric, [(richer.theta(plain.values), plain.fit.starts)], centres=plain.centres
    )
    parts = Parts((fitted,), (dataset,), ((0, cut, len(dataset)),), 10.0)
    turns = _in_turn(parts, plain, corrected, 1)
    assert turns is not None
    before, after = (errors["alpha_h"][2.0] for errors in turns)
    assert sorted(set(before.block.tolist())) == [0, 1, 2]
    assert after.rms < 0.5 * before.rms
    # a long sealed part tells its own scatter
    assert _in_turn(replace(parts, sealed=((0, 0, len(dataset)),)), plain, corrected, 1) is None
