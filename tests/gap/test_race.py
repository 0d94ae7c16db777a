"""Refit, traces and race on rigs whose cause is known, with a few candidates."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.identification.greybox.rigs import QUANTUM, TACHO_NOISE
from trms_cli.gap.beginning import GatedWindows, beginning_at, begins_at, onset_of
from trms_cli.gap.competing_model import FittedModel, nominal_parameters, refit
from trms_cli.gap.diagnose import diagnose
from trms_cli.gap.diagnosis import GapTest
from trms_cli.gap.problem import (
    GapProblem,
    applicable_candidates,
    divide,
    poor_excitation,
    quantum_of,
    variants,
    with_noise,
)
from trms_cli.gap.race import EFFORTS, Checkpoint, Effort, Race, _Search, run_race
from trms_cli.gap.residuals import innovation_tests
from trms_cli.gap.signatures import effect_traces, project_traces
from trms_cli.identification.dataset import Dataset
from trms_cli.models.newtonian import Newtonian

from .changed import begins
from .recorded import effect, recording

NAMES = ("yaw_coulomb_friction", "yaw_quadratic_damping", "main_input_delay", "main_actuator_lag")
MODEL = Newtonian()


def raced(
    dataset,
    checkpoint: Checkpoint | None = None,
    names: Sequence[str] = NAMES,
    effort: Effort = EFFORTS["quick"],
) -> Race:
    candidates, exclusions = applicable_candidates(MODEL, {name: effect(name) for name in names})
    assert not exclusions
    parts = divide((dataset,), 10.0, 0.25, MODEL.stops)
    nominal = refit(MODEL, nominal_parameters(MODEL), parts.fitted, parts.block)
    traces = effect_traces(nominal, list(candidates.values()))
    return run_race(nominal, candidates, traces, effort, checkpoint=checkpoint)


def judged(fitted: FittedModel) -> tuple[GapTest, ...]:
    """Against errors as small as those of rigs without a gap."""
    calm = replace(fitted.metric, shares=np.minimum(fitted.metric.shares, 0.015))
    return innovation_tests(replace(fitted, metric=calm), draws=20)


def rubbing() -> Dataset:
    rig = {"yaw_coulomb_friction": effect("yaw_coulomb_friction", torque=0.003)}
    return recording(rig, seconds=50.0, values={"k_fvp": 1.66e-5})


@pytest.fixture(scope="module")
def friction() -> Race:
    return raced(rubbing())


def test_friction_is_told_with_its_size(friction):
    best = friction.entries[0]
    assert best.names == ("yaw_coulomb_friction",)
    assert best.values["yaw_coulomb_friction.torque"] == pytest.approx(0.003, rel=0.03)
    others = [e.fit.score for e in friction.entries if "yaw_coulomb_friction" not in e.names]
    assert all(best.fit.score > score + 30 for score in others)
    # What is left with the cause in the model is as on a rig without gap.
    yaw = [c.location for c in friction.refit.metric.discrepancy.channels].index("yaw_moment")
    assert friction.refit.metric.shares[yaw] > 0.03
    assert friction.entries[0].metric.shares[yaw] < 0.015


def test_searches_that_fit_as_well_elsewhere_leave_a_size_open(friction):
    best = friction.entries[0]
    name, theta = "yaw_coulomb_friction.torque", best.fit.theta
    at, sd = best.structure.problem.names.index(name), best.fit.sd
    assert not best.unresolved
    assert not replace(best, fit=replace(best.fit, others=theta[None] + sd)).unresolved
    elsewhere = theta.copy()
    elsewhere[at] *= 2
    unresolved = replace(best, fit=replace(best.fit, others=elsewhere[None]))
    assert unresolved.unresolved == {name: (elsewhere[at],)}
    # they are kept through a refit, and by a search that ends beside another
    assert unresolved.refitted(best.metric, iterations=0).unresolved == unresolved.unresolved
    beside = theta + 1e-3 * sd
    points = [(theta, best.fit.starts), (beside, best.fit.starts)]
    search = best.structure.fit(
        best.metric, points, centres=best.centres, gains=best.fit.gains, iterations=0
    )
    ends = {tuple(end) for end in (search.fit.theta, *search.fit.others)}
    assert ends == {tuple(theta), tuple(beside)}


def test_what_is_larger_than_usual_is_seen_until_the_cause_is_in_the_model(friction):
    before, after = judged(friction.refit), judged(friction.entries[0])
    assert "alpha_h" in {test.channel for test in before if test.rejected}
    assert not any(test.rejected for test in after)
    # Each says what still counts as usual.
    assert {test.name: test.margin for test in after} == {
        "variance": 1.25, "bands": 1.25, "whiteness": 0.05, "squares": 0.05, "inputs": 0.05
    }  # fmt: skip


def test_the_trace_of_the_cause_points_at_the_residual(friction):
    gains = {name: friction.tight.best(name)[0] for name in NAMES}
    assert max(gains, key=gains.__getitem__) == "yaw_coulomb_friction"
    assert gains["main_input_delay"] < 0.1 * gains["yaw_coulomb_friction"]
    # a refit can do little of what friction does
    before, after = friction.signatures.most_visible("yaw_coulomb_friction")
    assert 0.3 * before < after < before
    # Delay and lag leave nearly the same trace.
    assert friction.tight.alike("main_input_delay", "main_actuator_lag") > 0.9
    assert friction.tight.alike("main_input_delay", "yaw_coulomb_friction") < 0.5


def test_a_rig_without_a_gap_gives_no_candidate_a_lead():
    race = raced(recording(seconds=50.0, seed=3))
    own = race.refit.fit.score
    assert not any(test.rejected for test in judged(race.refit))
    assert all(e.fit.score < own + 6.0 for e in race.entries)
    assert np.all(race.refit.metric.shares[:4] < 0.015)


@pytest.mark.slow
def test_a_race_that_was_interrupted_ends_where_it_would_have(friction):
    checkpoint_state: dict = {}
    dataset = rubbing()
    raced(dataset, Checkpoint(None, checkpoint_state.update))
    assert any(key.startswith("final") for key in checkpoint_state)
    again = raced(dataset, Checkpoint(checkpoint_state))
    assert [e.names for e in again.entries] == [e.names for e in friction.entries]
    for one, other in zip(again.entries, friction.entries, strict=True):
        np.testing.assert_allclose(one.fit.theta, other.fit.theta, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_others_are_tried_in_the_stead_of_a_second_effect():
    """Beside a strong friction: a cable that hangs free off the middle is like a biased sensor."""
    names = ("yaw_coulomb_friction", "yaw_sensor_bias", "yaw_cable_stiffness")
    rig = {
        "yaw_coulomb_friction": effect("yaw_coulomb_friction", torque=0.004),
        "yaw_cable_stiffness": effect("yaw_cable_stiffness", stiffness=0.002, neutral=0.2),
    }
    race = raced(
        recording(rig, seconds=50.0), names=names, effort=replace(EFFORTS["normal"], pairs=1)
    )
    competitors = {e.names for e in race.entries}
    friction = "yaw_coulomb_friction"
    assert {tuple(sorted((friction, name))) for name in names[1:]} <= competitors


def test_a_partner_is_looked_for_beside_what_a_fit_takes_for_discrepancy(friction):
    """A friction that is excused as noise of the yaw promises little, until it is not excused."""
    name, refitted = "yaw_coulomb_friction", friction.refit
    candidates, _ = applicable_candidates(MODEL, {n: effect(n) for n in NAMES})
    shares = refitted.metric.shares * np.array([1.0, 40.0, 1.0, 1.0])
    excused = replace(refitted, metric=replace(refitted.metric, shares=shares))
    traces = effect_traces(refitted, list(candidates.values()))
    search = _Search(
        refitted, candidates, traces, EFFORTS["normal"], Checkpoint(), 1, lambda share, what: True
    )
    (place,) = (p for p in search._beside(excused, ()) if p.name == name)
    assert place.promise > 3 * project_traces(excused, traces).best(name)[0]


def test_a_law_that_is_a_simpler_one_at_its_sizes_races_as_that_one(friction):
    """Friction with hardly an excess beside a delay: the same with Coulomb friction is fitted."""
    names = ("yaw_coulomb_friction", "yaw_stribeck_friction", "main_input_delay")
    candidates, _ = applicable_candidates(MODEL, {n: effect(n) for n in names})
    refitted = friction.refit
    traces = effect_traces(refitted, list(candidates.values()))
    search = _Search(
        refitted, candidates, traces, EFFORTS["normal"], Checkpoint(), 1, lambda share, what: True
    )
    structure = refitted.structure.with_effects(*(candidates[n] for n in names[1:]))

    def at(excess: float, velocity: float) -> FittedModel:
        own = {"torque": 0.003, "excess": excess, "velocity": velocity}
        sizes = {f"yaw_stribeck_friction.{size}": value for size, value in own.items()}
        theta = structure.theta({**refitted.values, **sizes, "main_input_delay.delay": 0.005})
        point = [(theta, structure.starts(theta, refitted.fit.starts))]
        return structure.fit(refitted.metric, point, centres=refitted.centres, iterations=0)

    assert search.special_cases([at(0.5, 0.03)]) == []
    for small in (at(0.1, 0.03), at(0.5, 0.005)):
        (simpler,) = search.special_cases([small])
        assert simpler.names == ("main_input_delay", "yaw_coulomb_friction")
        assert simpler.values["yaw_coulomb_friction.torque"] == pytest.approx(0.003, rel=0.05)
        assert simpler.fit.score > small.fit.score - 1.0
        assert search.special_cases([small, simpler]) == []


def test_an_angle_off_the_middle_is_tried_on_both_sides():
    rows = variants(effect("yaw_cable_stiffness").parameters())
    assert {round(float(row[2]), 2) for row in rows} == {-0.15, 0.0, 0.15}


def test_noise_is_read_from_steps_and_ripple():
    dataset = recording(seconds=30.0)
    unknown = replace(dataset, noise_sd=np.full(4, 1e-6))
    read = with_noise(unknown).noise_sd
    assert read[:2] == pytest.approx(QUANTUM / np.sqrt(12), rel=1e-3)
    assert read[2:] == pytest.approx(TACHO_NOISE, rel=0.1)
    # what is declared counts where nothing can be read, and no sensor is believed without limit
    still = replace(dataset, measurements=np.where(np.arange(4) < 3, dataset.measurements, 0.0))
    assert with_noise(still).noise_sd[3] == pytest.approx(dataset.noise_sd[3])
    exact = replace(dataset, measurements=np.sin(dataset.time[:, None] * [0.3, 0.2, 0.3, 0.2]))
    assert with_noise(exact).noise_sd == pytest.approx(2e-4 / np.sqrt(2), rel=0.2)
    # A smooth signal has no step.
    random = np.random.default_rng(0)
    assert quantum_of(random.standard_normal(500)) == 0.0
    assert quantum_of(0.25 * np.round(random.standard_normal(500) / 0.25)) == pytest.approx(0.25)


def test_a_contact_with_a_stop_is_left_out():
    dataset = recording(seconds=40.0)
    measurements = dataset.measurements.copy()
    measurements[700:705, 1] = MODEL.stops["alpha_h"]
    parts = divide((replace(dataset, measurements=measurements),), 7.0, 0.25, MODEL.stops)
    lost = np.isnan(parts.fitted[0].measurements[:, 1])
    assert lost[700] and not lost[699]
    block = round(parts.block / 0.02)
    assert lost[700 : (700 // block + 1) * block].all()
    assert not lost[(700 // block + 1) * block :].any()
    assert any("stop" in remark for remark in parts.fitted[0].remarks)


def test_several_recordings_are_sealed_whole():
    dataset = recording(seconds=20.0)
    parts = divide((dataset,) * 4, 10.0, 0.25, MODEL.stops)
    assert len(parts.fitted) == 3
    assert parts.sealed == ((3, 0, len(dataset)),)


def test_each_of_several_experiments_is_sealed_at_its_end():
    dataset = recording(seconds=20.0)
    parts = divide((dataset,) * 4, 10.0, 0.25, MODEL.stops, of_each=True)
    assert len(parts.fitted) == 4
    assert [i for i, _, _ in parts.sealed] == [0, 1, 2, 3]
    assert all(end == len(dataset) and begin > len(dataset) / 2 for _, begin, end in parts.sealed)


@pytest.mark.slow
def test_a_cause_with_a_state_of_its_own_is_told_whole():
    cable = effect("yaw_cable_hysteresis", torque=0.008)
    diagnosis = diagnose(
        GapProblem(
            model=MODEL,
            model_name="newtonian",
            datasets=(recording({"yaw_cable_hysteresis": cable}, seconds=50.0),),
            candidates={
                "yaw_cable_hysteresis": cable,
                "pitch_quadratic_damping": effect("pitch_quadratic_damping"),
            },
            effort="quick",
            jobs=1,
        )
    )
    assert diagnosis.causes[0].effects == ("yaw_cable_hysteresis",)
    assert diagnosis.verdict == "effect"
    assert diagnosis.traces is not None and "yaw_moment" in diagnosis.traces.explained
    assert diagnosis.where[0].location == "yaw_moment"
    assert diagnosis.inclusion["yaw_cable_hysteresis"] == pytest.approx(
        diagnosis.causes[0].probability
    )
    assert [row.effect for row in diagnosis.rejected] == ["pitch_quadratic_damping"]
    assert "yaw_cable_hysteresis" not in {row.effect for row in diagnosis.not_testable}


@pytest.mark.slow
def test_friction_that_begins_is_found_with_its_moment_and_size():
    rubbing = {"yaw_coulomb_friction": effect("yaw_coulomb_friction", torque=0.002)}
    dataset = begins(rubbing, 27.0, values={"k_fvp": 1.66e-5}, seconds=70.0, seed=9)
    checkpoint_state: dict[str, object] = {}
    checkpoint = Checkpoint(keep=lambda everything: checkpoint_state.update(everything))
    first_race = raced(with_noise(dataset), checkpoint, effort=Effort(4, 3, 2, 2))
    best = max(first_race.entries, key=lambda entry: entry.fit.score)
    assert best.names == ("yaw_coulomb_friction",)
    assert begins_at(best) in (2, 3)  # of blocks of ten seconds
    assert best.values["yaw_coulomb_friction.torque"] == pytest.approx(0.002, rel=0.1)
    onset = onset_of(best)
    assert onset is not None and not onset.ends
    assert onset.time_s == pytest.approx(27.0, abs=0.5)
    assert onset.ci95[0] <= onset.time_s <= onset.ci95[1]
    # a race that goes on after its fits were kept ends alike
    again = raced(with_noise(dataset), Checkpoint(checkpoint_state), effort=Effort(4, 3, 2, 2))
    scores = [[e.fit.score for e in race.entries] for race in (first_race, again)]
    assert scores[1] == pytest.approx(scores[0], abs=1e-3)


@pytest.mark.slow
def test_an_encoder_that_slips_is_found_at_its_moment():
    """It shows in one sample; the moment missing there makes yaw look as if it were pushed."""
    slipped = {"yaw_sensor_bias": effect("yaw_sensor_bias", bias=-0.025)}
    dataset = begins(slipped, 23.4, values={"k_fvp": 1.66e-5}, seconds=50.0, seed=4)
    names = ("yaw_sensor_bias", "pitch_sensor_bias", "yaw_coulomb_friction")
    race = raced(with_noise(dataset), names=names, effort=Effort(2, 2, 0, 2))
    best = max(race.entries, key=lambda entry: entry.fit.score)
    assert best.names == ("yaw_sensor_bias",)
    assert best.values["yaw_sensor_bias.bias"] == pytest.approx(-0.025, rel=0.05)
    onset = onset_of(best)
    assert onset is not None
    assert onset.time_s == pytest.approx(23.4, abs=0.1)
    assert best.fit.score > race.refit.fit.score + 500


@pytest.mark.slow
def test_friction_throughout_has_no_beginning(friction):
    assert all(begins_at(entry) is None for entry in friction.entries)
    race = raced(rubbing(), effort=Effort(4, 3, 2, 2))
    best = max(race.entries, key=lambda entry: entry.fit.score)
    assert best.names == ("yaw_coulomb_friction",)
    assert begins_at(best) is None and onset_of(best) is None


def test_windows_before_a_beginning_are_those_without_the_effect(friction):
    """And the slopes of what is simulated from some sample on are those of differences."""
    entry = friction.entries[0]
    gated = beginning_at(entry.structure, 2).windows
    assert isinstance(gated, GatedWindows)
    p, starts = gated.problem.all_values(entry.fit.theta), entry.fit.starts
    gated_residuals = gated.residuals(p, starts, slopes=True)
    whole, without = (entry.structure.windows.residuals(v, starts) for v in (p, gated.without(p)))
    assert np.array_equal(gated_residuals.r[:2], without.r[:2])
    assert np.array_equal(gated_residuals.r[2:], whole.r[2:])
    size = gated.n_x + gated.problem.names.index("yaw_coulomb_friction.torque")
    assert gated_residuals.j is not None
    assert not gated_residuals.j[:2, ..., size].any() and gated_residuals.j[2:, ..., size].any()
    # all of a window with the effect, and none of it
    r, slopes = gated.joined_to_beginning(2, p, starts, [0, 130, int(gated.count[2])])
    assert r[0] == pytest.approx(whole.r[2], abs=1e-12)
    assert r[2] == pytest.approx(without.r[2], abs=1e-12)
    moved = starts.copy()
    moved[2, 0] += 1e-6
    ahead, _ = gated.joined_to_beginning(2, p, moved, [130])
    assert (ahead[0] - r[1]) / 1e-6 == pytest.approx(slopes[1, ..., 0], abs=1e-3)
    # from a sample within a window on: slopes in the size are those of differences, too
    within = beginning_at(entry.structure, 2, 130).windows
    inside = within.residuals(p, starts, slopes=True)
    assert inside.j is not None
    assert np.array_equal(inside.r[2], r[1]) and np.array_equal(inside.r[3], whole.r[3])
    more = p.copy()
    more[gated.problem.model.parameters.names.index("yaw_coulomb_friction.torque")] += 1e-7
    change = (within.residuals(more, starts).r - inside.r)[2] / 1e-7
    assert change == pytest.approx(inside.j[2, ..., size], rel=1e-2, abs=1e-2)
    assert not inside.j[2, :130, :, size].any()


def test_axes_that_are_held_are_told_in_one_sentence():
    moving = recording({}, seconds=20.0)
    assert poor_excitation(MODEL, [moving]) == ()
    yaw = moving.measurements.copy()
    yaw[:, 1] = 0.3
    (one,) = poor_excitation(MODEL, [replace(moving, measurements=yaw)])
    assert one.startswith("yaw is held at one point (0.3 rad for 100 % of the time): a torque")
    yaw[:, 0] = -0.5
    (both,) = poor_excitation(MODEL, [replace(moving, measurements=yaw)])
    assert both.startswith("pitch and yaw are each held at one point (−0.5 rad for 100 % of")


@pytest.mark.slow
def test_weak_friction_is_found_with_precise_sensors():
    """A search that trusts five microradians goes astray where friction is a tenth of the usual."""
    rig = {"yaw_coulomb_friction": effect("yaw_coulomb_friction", torque=0.0004)}
    dataset = begins(rig, 0.0, values={"k_fvp": 1.66e-5}, seconds=50.0, seed=5, precise=True)
    race = raced(with_noise(dataset))
    best = max(race.entries, key=lambda entry: entry.fit.score)
    assert best.names == ("yaw_coulomb_friction",)
    assert best.values["yaw_coulomb_friction.torque"] == pytest.approx(0.0004, rel=0.05)
    assert best.fit.score > race.refit.fit.score + 50


def test_dry_frictions_near_the_best_are_searched_on(monkeypatch):
    """Of a pendulum with friction a cogging was told beside it, whose search had come farther."""

    def entry(name, score, *, dry=True, bench=False, further=0.0):
        own = SimpleNamespace(overrides=lambda method: dry and method == "impulse")
        fitted = SimpleNamespace(
            names=(name,),
            fit=SimpleNamespace(score=score),
            model=SimpleNamespace(bench_sizes=bench),
            structure=SimpleNamespace(effects=[SimpleNamespace(effect=own)]),
            metric=None,
        )
        fitted.refitted = lambda metric, iterations: entry(name, score + further)
        return fitted

    search = object.__new__(_Search)
    search._jobs, search._watch = 1, lambda share, message: True
    monkeypatch.setattr(search, "_once", lambda key, structure, work: work(), raising=False)

    def scores(*entries):
        return {e.names[0]: e.fit.score for e in search.searched_on(entries)}

    near, far = entry("near", 900.0, further=130.0), entry("far", 100.0, further=130.0)
    worse, lag = entry("worse", 950.0, further=-5.0), entry("lag", 940.0, dry=False, further=9.0)
    best = entry("best", 1000.0)
    expected = {"near": 1030.0, "far": 100.0, "worse": 950.0, "lag": 940.0, "best": 1000.0}
    assert scores(near, far, worse, lag, best) == expected
    assert scores(near, entry("lag", 1001.0, dry=False))["near"] == 900.0
    assert scores(near, entry("best", 1000.0, bench=True))["near"] == 900.0
