"""What changed since a known state, and since when, on rigs whose change is known."""

from dataclasses import replace

import numpy as np
import pytest

from trms_cli.composition.composer import compose
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.rotor_reaction import RotorReaction
from trms_cli.gap.change import StateComparison, compare_with
from trms_cli.gap.change_result import change_result
from trms_cli.gap.competing_model import nominal_parameters
from trms_cli.gap.differences import NewRecordings, differences
from trms_cli.gap.evidence import ChangeEvidence, coarser_sensors, judge
from trms_cli.gap.findings import headline
from trms_cli.gap.known_state import ForceSeries, KnownState, StandingError, known_state
from trms_cli.gap.onset import diagnose_onset
from trms_cli.gap.problem import GapProblem, applicable_candidates
from trms_cli.gap.short_runs import ShortRuns
from trms_cli.gap.unnamed_force import law_evidence, with_random_torque
from trms_cli.gap.wording import cause_name
from trms_cli.library.tasks.diagnose import applied_cause
from trms_cli.models.newtonian import Newtonian

from .changed import begins
from .recorded import effect

MODEL = Newtonian()
#: A rig that is not quite as its parameters say.
VALUES = {"k_fvp": 1.66e-5, "k_oh": 0.011}
FREE = tuple(p for p in nominal_parameters(MODEL) if p.name in ("k_fvp", "k_oh", "k_ov", "l_cb"))
CANDIDATES, _ = applicable_candidates(
    MODEL, {n: effect(n) for n in ("yaw_coulomb_friction", "yaw_quadratic_damping")}
)


@pytest.fixture(scope="module")
def reference_state() -> KnownState:
    recorded = [begins({}, 0.0, values=VALUES, seconds=20.0, seed=seed) for seed in (11, 12)]
    return known_state(MODEL, FREE, recorded)


def compared(reference_state: KnownState, dataset) -> StateComparison:
    return compare_with(reference_state, [dataset], CANDIDATES, {})


def of(reference_state: KnownState, dataset):
    problem = GapProblem(
        model=MODEL,
        model_name="newtonian",
        datasets=(dataset,),
        candidates={n: c.effect for n, c in CANDIDATES.items()},
        against=reference_state.runs.windows.datasets,
    )
    return change_result(problem, compared(reference_state, dataset))


def test_parameters_of_the_known_state_are_fitted(reference_state):
    fitted = {f.name: reference_state.model.parameters[f.name].value for f in reference_state.free}
    assert fitted["k_fvp"] == pytest.approx(1.66e-5, rel=0.03)
    assert fitted["k_oh"] == pytest.approx(0.011, rel=0.1)


def test_another_recording_of_the_same_state_is_no_change(reference_state):
    diagnosis = of(reference_state, begins({}, 0.0, values=VALUES, seconds=20.0, seed=13))
    assert diagnosis.verdict == "no_change"
    assert diagnosis.causes[0].effects == ("no_change",)
    assert not diagnosis.where
    assert len(diagnosis.against) == 2
    assert all(
        row.corrected == row.refit for rows in diagnosis.gap.values() for row in rows.values()
    )
    assert diagnosis.shrink["all"]["2.0"].fraction in (None, 0.0)


def test_friction_that_was_there_from_the_beginning_has_no_onset(reference_state):
    rubbing = {"yaw_coulomb_friction": effect("yaw_coulomb_friction", torque=0.004)}
    diagnosis = of(reference_state, begins(rubbing, 0.0, values=VALUES, seconds=20.0, seed=14))
    assert diagnosis.verdict == "effect"
    assert diagnosis.causes[0].effects == ("yaw_coulomb_friction",)
    size = diagnosis.causes[0].parameters["yaw_coulomb_friction.torque"]
    assert size.value == pytest.approx(0.004, rel=0.1)
    assert diagnosis.causes[0].onset is None
    assert diagnosis.where[0].location == "yaw_moment"
    # on the part kept aside the model of the known state errs, and with the friction it does not
    gap = diagnosis.gap["alpha_h"]["2.0"]
    assert gap.corrected < 0.5 * gap.refit
    assert diagnosis.shrink["all"]["2.0"].fraction > 0.5


@pytest.mark.slow
def test_what_is_alike_at_one_angle_is_parted_at_two_others(reference_state):
    rubbing = {"yaw_coulomb_friction": effect("yaw_coulomb_friction", torque=0.004)}
    dataset = begins(rubbing, 0.0, values=VALUES, seconds=20.0, seed=14)
    parted = of(reference_state, dataset)
    assert parted.next_experiment is None
    comparison = compared(reference_state, dataset)
    kinds = [(j.difference.name, j.difference.kind) for j in comparison.judged]
    parameter = next(k for k, (_, kind) in enumerate(kinds) if kind == "parameter")
    torque = next(k for k, (name, _) in enumerate(kinds) if name == "yaw_disturbance")
    alike = replace(comparison, alike=[parameter, torque])
    problem = GapProblem(
        model=MODEL, model_name="newtonian", datasets=(dataset,), candidates={}, against=()
    )
    # frictions that are alike are not parted so
    other = next(k for k, (name, _) in enumerate(kinds) if name == "yaw_quadratic_damping")
    assert change_result(problem, replace(comparison, alike=[other])).next_experiment is None
    diagnosis = change_result(problem, alike)
    assert diagnosis.confusable
    assert diagnosis.next_experiment is not None
    words = diagnosis.next_experiment.command.split()
    assert words[:2] == ["trms", "run"]
    experiment = compose(words[2:]).config  # it can be typed
    assert experiment["ref"]["alpha_h"]["amplitude"] == 0.2
    assert experiment["ref"]["alpha_v"]["amplitude"] == 0


@pytest.mark.slow
def test_friction_that_begins_is_told_with_its_onset(reference_state):
    rubbing = {"yaw_coulomb_friction": effect("yaw_coulomb_friction", torque=0.004)}
    diagnosis = of(reference_state, begins(rubbing, 15.3, values=VALUES, seconds=30.0, seed=15))
    assert diagnosis.causes[0].effects == ("yaw_coulomb_friction",)
    onset = diagnosis.causes[0].onset
    assert onset is not None
    assert onset.time_s == pytest.approx(15.3, abs=1.0)
    assert onset.ci95[0] <= onset.time_s <= onset.ci95[1]


def onset_problem(onset: float, effects, ends: bool = False) -> GapProblem:
    """A recording of 60 s that is diagnosed by itself."""
    dataset = begins(effects, onset, values=VALUES, seconds=60.0, seed=21, ends=ends)
    return GapProblem(
        model=MODEL,
        model_name="newtonian",
        datasets=(dataset,),
        candidates={n: c.effect for n, c in CANDIDATES.items()},
    )


@pytest.mark.slow
def test_what_begins_within_a_recording_is_told_against_its_beginning():
    rubbing = {"yaw_coulomb_friction": effect("yaw_coulomb_friction", torque=0.004)}
    diagnosis = diagnose_onset(onset_problem(33.0, rubbing))
    assert diagnosis is not None
    assert diagnosis.verdict == "effect"
    assert diagnosis.causes[0].effects == ("yaw_coulomb_friction",)
    assert diagnosis.causes[0].onset is not None
    # counted from the recording's own beginning, not from where its rest begins
    assert diagnosis.causes[0].onset.time_s == pytest.approx(33.0, abs=1.0)
    low, high = diagnosis.causes[0].onset.ci95
    assert low <= diagnosis.causes[0].onset.time_s <= high
    assert not diagnosis.against
    assert any("the first 15 s, taken for the known state" in text for text in diagnosis.warnings)
    # friction throughout is in both parts
    assert diagnose_onset(onset_problem(0.0, rubbing)) is None


@pytest.mark.slow
def test_what_ends_within_a_recording_is_told_against_its_end():
    rubbing = {"yaw_coulomb_friction": effect("yaw_coulomb_friction", torque=0.004)}
    problem = onset_problem(27.0, rubbing, ends=True)
    diagnosis = diagnose_onset(problem)
    assert diagnosis is not None
    assert diagnosis.verdict == "effect"
    assert diagnosis.causes[0].effects == ("yaw_coulomb_friction",)
    onset = diagnosis.causes[0].onset
    assert onset is not None and onset.ends
    assert onset.time_s == pytest.approx(27.0, abs=1.0)
    assert "until" in diagnosis.sentence and "the end of the recording" in diagnosis.sentence
    # the rig is without it now, and nothing was kept aside
    assert applied_cause(diagnosis) is None and not diagnosis.gap


def test_the_missing_force_of_a_run_is_the_torque_that_acts():
    rubbing = {"yaw_coulomb_friction": effect("yaw_coulomb_friction", torque=0.004)}
    right, wrong = (begins(e, 0.0, seconds=20.0, seed=16) for e in ({}, rubbing))
    runs = [ShortRuns(MODEL, [dataset]) for dataset in (right, wrong)]
    yaw = [e.location for e in runs[0].equations].index("yaw_moment")
    force = [r.forces(MODEL.parameters.values).force[:, yaw] for r in runs]
    assert np.std(force[0]) < 5e-4
    assert np.std(force[1]) > 3 * np.std(force[0])


@pytest.mark.parametrize(
    ("name", "size", "value", "near"),
    [
        # gravity tells it, and what is constant may be the recording's own offset
        ("pitch_sensor_bias", "bias", -0.06, 0.025),
        ("pitch_sensor_delay", "delay", 0.06, 0.01),
        ("yaw_sensor_delay", "delay", 0.06, 0.015),
    ],
)
def test_a_sensor_that_went_wrong_is_found_with_its_size(reference_state, name, size, value, near):
    wrong = {name: effect(name, **{size: value})}
    dataset = begins(wrong, 0.0, values=VALUES, seconds=20.0, seed=16)
    effects = {n: effect(n) for n in (name, "yaw_coulomb_friction", "main_input_delay")}
    candidates, _ = applicable_candidates(MODEL, effects)
    comparison = compare_with(reference_state, [dataset], candidates, {})
    gains = dict(zip((j.difference.name for j in comparison.judged), comparison.gains, strict=True))
    assert max(gains, key=gains.__getitem__) == name
    assert gains[name] > 12.0
    (score,) = (j for j in comparison.judged if j.difference.name == name)
    assert score.value[0] == pytest.approx(value, abs=near)


def test_a_sensor_whose_error_is_corrected_leaves_the_beam_where_it_is():
    """Angle, rate and momenta are those of the corrected recording, not of the biased one."""
    bias = {"pitch_sensor_bias": effect("pitch_sensor_bias", bias=0.05)}
    right, wrong = (begins(e, 0.0, seconds=20.0, seed=16) for e in ({}, bias))
    p = MODEL.parameters.values
    shifted = wrong.measurements - [0.05 if s.name == "alpha_v" else 0.0 for s in wrong.outputs]
    corrected = ShortRuns(MODEL, [replace(wrong, measurements=shifted)]).forces(p).force
    missing = [ShortRuns(MODEL, [dataset]).forces(p).force for dataset in (right, wrong)]
    spread = [float(np.sqrt(np.mean(force[:, 0] ** 2))) for force in (*missing, corrected)]
    assert spread[2] < 1.3 * spread[0] < 0.5 * spread[1]


@pytest.mark.slow
def test_an_encoder_that_slips_is_found_with_its_moment(reference_state):
    slips = {"yaw_sensor_bias": effect("yaw_sensor_bias", bias=0.033)}
    dataset = begins(slips, 15.4, values=VALUES, seconds=30.0, seed=17)
    candidates, _ = applicable_candidates(
        MODEL, {n: effect(n) for n in ("yaw_sensor_bias", "yaw_coulomb_friction")}
    )
    comparison = compare_with(reference_state, [dataset], candidates, {})
    first = comparison.judged[0]
    assert first.difference.name == "yaw_sensor_bias"
    # one window shows it: by how much, and since which of its samples, go together
    assert first.value[0] == pytest.approx(0.033, abs=0.01)
    assert first.began is not None
    # a run's force is the same for two moments in it
    assert first.began.time_s == pytest.approx(15.4, abs=0.5)
    assert comparison.gains[0] > 15.0 > comparison.gains[1] + 10.0


@pytest.mark.slow
def test_a_torque_that_varies_is_told_from_a_law_that_nobody_wrote_down(reference_state):
    dataset = begins({}, 0.0, values=VALUES, seconds=60.0, seed=16)
    questioned = NewRecordings.of(reference_state, [dataset])
    runs = questioned.runs
    pitch = [e.location for e in runs.equations].index("pitch_moment")
    random = np.random.default_rng(3)
    forgets = np.zeros(len(runs))
    for k in range(1, len(runs)):
        forgets[k] = np.exp(-1.0) * forgets[k - 1] + 0.9 * random.standard_normal()
    angle = questioned.starts[:, MODEL.state_index("alpha_v")]
    evidence_gains = {}
    extras = {"none": 0.0 * angle, "torque": 5e-3 * forgets, "law": 8e-3 * np.sin(25 * angle)}
    for name, extra in extras.items():

        class Pulled(KnownState):
            def series(self, runs, forces, extra=extra):
                force_series = list(super().series(runs, forces))
                force_series[pitch] = replace(
                    force_series[pitch], force=force_series[pitch].force + extra
                )
                return tuple(force_series)

        evidence = ChangeEvidence(replace(questioned, known_state=Pulled(**vars(reference_state))))
        torque = next(differences(evidence.questioned, {}, only={"pitch_disturbance"}))
        score = with_random_torque(evidence, judge(evidence, torque))
        law = law_evidence(evidence)[pitch] - evidence.unchanged
        evidence_gains[name] = (score.evidence - evidence.unchanged, law, score)
    assert max(evidence_gains["none"][:2]) < 3.0
    gain, law, score = evidence_gains["torque"]
    assert gain > law + 10.0 and gain > 30.0
    assert score.varies and score.onset is None
    assert score.value[0] == pytest.approx(5e-3, rel=0.5)
    assert score.difference.labels == ("deviation",)
    gain, law, _ = evidence_gains["law"]
    assert law > gain + 10.0 and law > 30.0


@pytest.mark.parametrize("from_the_beginning", [True, False])
def test_a_law_of_the_rigs_build_is_hardly_believed_to_begin(reference_state, from_the_beginning):
    """A drag of the tail rotor on the body does not begin while a rig runs: a pull does."""
    assert RotorReaction.may_begin is False and CoulombFriction.may_begin is True
    name = "tail_reaction_on_pitch"
    candidates, _ = applicable_candidates(MODEL, {name: effect(name)})
    pulled = {name: replace(effect(name), drag=4e-7, inertia=0.0)}
    at = 0.0 if from_the_beginning else 15.3
    dataset = begins(pulled, at, values=VALUES, seconds=30.0, seed=15)
    evidence = ChangeEvidence(NewRecordings.of(reference_state, [dataset]))
    torque, drag = (
        judge(evidence, d)
        for d in differences(evidence.questioned, candidates, only={"pitch_disturbance", name})
    )
    assert torque.belief == 0.0
    if from_the_beginning:
        assert drag.began is None and drag.belief > -0.1
    else:
        assert drag.began is not None and drag.belief == pytest.approx(np.log(0.1), abs=0.01)


def test_a_sensor_that_rounds_coarser_than_before_is_read_from_its_steps(reference_state):
    """Rounding has no slope and looks like a torque; its steps alone tell it from one."""
    candidates, _ = applicable_candidates(
        MODEL, {n: effect(n) for n in ("yaw_quantisation", "pitch_quantisation")}
    )
    quantum = 6 * 2 * np.pi / 4096  # every sixth line of the encoder
    coarse = {"yaw_quantisation": replace(effect("yaw_quantisation"), quantum=quantum)}
    dataset = begins(coarse, 0.0, values=VALUES, seconds=20.0, seed=14)
    evidence = ChangeEvidence(NewRecordings.of(reference_state, [dataset]))
    (score,) = coarser_sensors(evidence, candidates)
    assert score.difference.name == "yaw_quantisation" and score.began is None
    assert score.value[0] == pytest.approx(quantum, rel=0.01)
    compared_state = compare_with(reference_state, [dataset], candidates, {})
    assert compared_state.probabilities[0] > 0.95
    assert compared_state.judged[0].difference.name == "yaw_quantisation"
    same = begins({}, 0.0, values=VALUES, seconds=20.0, seed=14)
    evidence = ChangeEvidence(NewRecordings.of(reference_state, [same]))
    assert coarser_sensors(evidence, candidates) == []
    # a file with fewer digits rounds, too, but by less than any encoder
    few_digits = replace(same, measurements=np.round(same.measurements, 3))
    evidence = ChangeEvidence(NewRecordings.of(reference_state, [few_digits]))
    assert coarser_sensors(evidence, candidates) == []


def test_a_gate_opens_at_its_onset():
    runs = ShortRuns(MODEL, [begins({}, 0.0, seconds=20.0, seed=16)])
    gate = runs.gate(np.array([-5.0, 7.5, 100.0]))
    np.testing.assert_allclose(gate[0], 1.0)
    np.testing.assert_allclose(gate[2], 0.0)
    assert np.all(gate[1][runs.begin + runs.length < 7.5] == 0.0)
    assert np.all((gate[1][7] > 0.0) & (gate[1][7] < 1.0))
    np.testing.assert_allclose(gate[1][8:], 1.0)


def test_recordings_that_differ_more_among_themselves_foretell_less():
    random = np.random.default_rng(0)
    count, each = 4, 20
    recording = np.repeat(np.arange(count), each)
    time = np.tile(np.arange(each, dtype=float), count)
    noise = 0.1 * random.standard_normal(count * each)
    offsets = np.array([1.0, -1.2, 0.8, -0.7])

    def series(force: np.ndarray) -> ForceSeries:
        is_observed = np.ones(len(force), dtype=bool)
        first = np.diff(recording, prepend=-1) != 0
        return ForceSeries(force, is_observed, np.zeros((len(force), 0)), recording, time, first)

    alike = StandingError.fit(series(noise), 1.0)
    apart = StandingError.fit(series(noise + offsets[recording]), 1.0)
    assert apart.sizes.offset > 5 * alike.sizes.offset
    assert apart.sizes.white == pytest.approx(0.1, rel=0.3)


def test_no_change_turns_the_sign_of_a_parameter_that_is_known(reference_state):
    recorded = [begins({}, 0.0, values=VALUES, seconds=20.0, seed=17)]
    value = reference_state.model.parameters["k_fvp"].value

    def reach(deviations: float) -> float:
        """The lowest value that is tried, where the prior is so many deviations from zero."""
        free = [
            replace(p, lower=-np.inf, prior_sd=value / deviations)
            for p in FREE
            if p.name == "k_fvp"
        ]
        questioned = NewRecordings.of(replace(reference_state, free=tuple(free)), recorded)
        (difference,) = differences(questioned, {}, only={"k_fvp"})
        return value + min(float(f.low.min()) for f in difference.families)

    assert 0 < reach(10.0) < 0.5 * value  # seven deviations, and not sixteen
    assert reach(2.0) < 0


def test_runs_of_a_single_second_have_no_onset(reference_state):
    """Pieces of a second, as a recording cut at its gaps leaves: there is no time to begin in."""
    whole = begins({}, 0.0, values=VALUES, seconds=20.0, seed=18)
    second = round(1.0 / whole.sample_time)
    pieces = [whole.part(k * second, (k + 1) * second) for k in range(5, 17)]
    comparison = compare_with(reference_state, pieces, CANDIDATES, {})
    assert all(j.onset is None for j in comparison.judged)
    assert comparison.unchanged > 0.5


def test_what_diverges_at_every_size_is_no_difference(reference_state):
    questioned = NewRecordings.of(
        reference_state, [begins({}, 0.0, values=VALUES, seconds=20.0, seed=17)]
    )
    runaway = effect("yaw_coulomb_friction", torque=0.004)
    candidates, _ = applicable_candidates(MODEL, {"yaw_coulomb_friction": runaway})

    def names_of(runs: ShortRuns) -> set[str]:
        candidate_differences = differences(replace(questioned, runs=runs), candidates)
        return {d.name for d in candidate_differences}

    assert "yaw_coulomb_friction" in names_of(questioned.runs)
    original = ShortRuns.forces

    def diverging(self, p, starts=None):
        forces = original(self, p, starts)
        if len(p) > len(MODEL.parameters.values):  # with an effect
            forces.force[3] = np.inf
        return forces

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ShortRuns, "forces", diverging)
        remaining_names = names_of(questioned.runs)
    assert "yaw_coulomb_friction" not in remaining_names and "k_oh" in remaining_names


def test_of_parameters_that_are_likelier_together_the_likeliest_is_the_answer(reference_state):
    """A torque may be first, and two parameters that are alike outweigh it together."""
    comparison = compared(
        reference_state, begins({}, 0.0, values={**VALUES, "l_cb": 0.235}, seconds=20.0, seed=19)
    )
    order = [j.difference.name for j in comparison.judged]
    torque = order.index("pitch_disturbance")
    first = [j for j in comparison.judged if j.difference.kind == "parameter"][:2]
    judged = (comparison.judged[torque], *first)
    altered_comparison = replace(
        comparison,
        judged=judged,
        gains=np.array([60.0, 59.0, 59.0]),
        probabilities=np.array([0.36, 0.32, 0.31]),
        unchanged=0.005,
        unnamed=0.005,
        alike=(1, 2),
    )
    dataset = reference_state.runs.windows.datasets[0]
    problem = GapProblem(
        model=MODEL,
        model_name="newtonian",
        datasets=(dataset,),
        candidates={},
        against=reference_state.runs.windows.datasets,
    )
    result = change_result(problem, altered_comparison)
    coarse, _ = applicable_candidates(MODEL, {"yaw_quantisation": effect("yaw_quantisation")})
    rounded = replace(altered_comparison, candidates={**altered_comparison.candidates, **coarse})
    assert result.verdict == "parameters_only"
    name = first[0].difference.name
    assert f"another {name}" in result.sentence
    # which parameter, in physical words; what was not reckoned is null
    words = next(m.words for m in result.moved if m.parameter == name)
    assert words.startswith("gravity moment of the beam")
    assert "g at the nose would" in words or "g less at the nose would" in words
    assert all(row.se is None and row.moved is None for row in result.race)
    assert "yaw_quantisation" in {row.effect for row in change_result(problem, rounded).rejected}
    changed = result.parameters[name].fitted - result.refit[name]
    assert changed == pytest.approx(first[0].value[0]) or first[0].began is not None
    # an effect that leads a group of effects is the answer where all parameters together are more
    effects = [j for j in comparison.judged if j.difference.kind == "effect"][:2]
    group = replace(
        altered_comparison,
        judged=(*effects, first[0]),
        probabilities=np.array([0.3, 0.25, 0.44]),
        alike=(1,),
    )
    result, name = change_result(problem, group), effects[0].difference.name
    assert result.verdict == "effect" and result.causes[0].effects == ("parameters_only",)
    assert headline(result).startswith(cause_name([name]))
    applied = applied_cause(result)
    assert applied is not None and applied.effects == (name,)


def test_nothing_that_is_seen_leaves_evidence_as_it_is(reference_state):
    questioned = NewRecordings.of(
        reference_state, [begins({}, 0.0, values=VALUES, seconds=20.0, seed=17)]
    )
    evidence = ChangeEvidence(questioned)
    none = np.zeros((1, *questioned.forces.force.shape))
    log_evidence, _, _ = evidence.of(none, none)
    assert log_evidence[0] == pytest.approx(evidence.unchanged)
