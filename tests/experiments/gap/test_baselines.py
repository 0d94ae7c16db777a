"""Baselines on small simulated rigs: each answers in the form of a diagnosis, and as it should."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.gap.baselines import __main__ as command
from experiments.gap.baselines.baseline import Baseline
from experiments.gap.baselines.classifier import Request, _fitted, marks, rigs
from experiments.gap.baselines.fits import fit_problem, parts_of, refit
from experiments.gap.baselines.flexible_residual import FlexibleResidual
from experiments.gap.baselines.force_terms import columns
from experiments.gap.baselines.oracle import Oracle, RigTruth, TrueValues
from experiments.gap.baselines.parameter_refit import ParameterRefit
from experiments.gap.baselines.restoring_force import motion
from experiments.gap.baselines.run import (
    METHODS,
    _answer,
    arguments_of,
    baseline_of,
    bench_effects,
    run_baseline,
)
from experiments.gap.baselines.sparse_regression import SparseRegression
from experiments.gap.baselines.white_noise import WhiteNoiseBic
from tests.identification.greybox.rigs import measuring, recording
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.actuator_lag import ActuatorLag
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.dead_zone import DeadZone
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.model_file import load_model
from trms_cli.effects.quadratic_damping import QuadraticDamping
from trms_cli.gap.diagnosis import DiagnosisResult, document_of
from trms_cli.gap.problem import GapProblem
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model, names
from trms_cli.models.newtonian import Newtonian

RANGES = [(1.0, 1.5), (-0.8, 0.8)]
FREE = ("k_oh", "k_fhp", "k_fvp")
FRICTION = "yaw_coulomb_friction"
CANDIDATES = {
    FRICTION: CoulombFriction(axis="yaw", torque=0.005),
    "yaw_quadratic_damping": QuadraticDamping(axis="yaw", coefficient=0.01),
    "tail_actuator_lag": ActuatorLag(rotor="tail", time_constant=0.06),
    "tail_dead_zone": DeadZone(rotor="tail", width=0.1),
}


def few_free(*free_names: str) -> Model:
    """The bench's model with priors on these parameters only: the fits of a test are quick."""
    model = Newtonian()
    model.parameters = type(model.parameters)(
        (p if p.name in free_names else replace(p, prior_sd=None) for p in model.parameters),
        model.parameters.name,
    )
    return model


def problem_with(*effects: str, seed: int = 0) -> GapProblem:
    rig = extend_model(Newtonian(), {name: CANDIDATES[name] for name in effects})
    dataset: Dataset = recording(rig, seconds=50.0, ranges=RANGES, seed=seed, substeps=1)[0]
    return GapProblem(
        model=few_free(*FREE),
        model_name="newtonian",
        datasets=(dataset,),
        candidates=CANDIDATES,
        block=9.0,
        jobs=1,
    )


@pytest.fixture(scope="module")
def rubbing() -> GapProblem:
    return problem_with(FRICTION)


@pytest.fixture(scope="module")
def plain() -> GapProblem:
    return problem_with()


def shrunk(answer: DiagnosisResult, channel: str = "alpha_h", horizon: str = "2.0") -> float:
    fraction = answer.shrink[channel][horizon].fraction
    assert fraction is not None
    return fraction


def test_a_refit_leaves_the_friction(rubbing: GapProblem) -> None:
    answer = ParameterRefit().answer(rubbing)
    assert answer.verdict == "parameters_only"
    gap = answer.gap["alpha_h"]["2.0"]
    assert gap.floor < 0.2 * gap.refit and gap.refit < gap.raw
    assert gap.corrected == gap.refit
    assert set(answer.parameters) == set(FREE)
    assert '"parameters_only"' in json.dumps(document_of(answer), allow_nan=False)


@pytest.mark.slow
def test_bic_names_the_friction_and_says_its_size(rubbing: GapProblem) -> None:
    answer = WhiteNoiseBic().answer(rubbing)
    assert answer.verdict == "effect"
    assert answer.causes[0].effects == (FRICTION,)
    size = answer.causes[0].parameters[f"{FRICTION}.torque"]
    assert size.value == pytest.approx(0.005, rel=0.05) and 0 < size.sd < 0.001
    assert sum(cause.probability for cause in answer.causes) == pytest.approx(1.0, abs=1e-4)
    assert [share.location for share in answer.where] == ["yaw_moment"]
    assert shrunk(answer) > 0.9


def test_bic_finds_nothing_where_there_is_nothing(plain: GapProblem) -> None:
    few = replace(plain, candidates={FRICTION: CANDIDATES[FRICTION]})
    answer = WhiteNoiseBic().answer(few)
    assert answer.verdict == "no_gap"


@pytest.mark.slow
def test_the_oracle_closes_what_it_is_told(rubbing: GapProblem) -> None:
    answer = Oracle(effects=(FRICTION,)).answer(rubbing)
    assert answer.causes[0].effects == (FRICTION,)
    assert shrunk(answer) > 0.9
    blind = Oracle(effects=("something_else",)).answer(rubbing)
    assert blind.verdict == "none_of_these"
    assert shrunk(blind) == 0.0


@pytest.mark.slow
def test_true_values_are_not_fitted(rubbing: GapProblem) -> None:
    values = {
        **{p.name: p.value for p in rubbing.model.parameters},
        f"{FRICTION}.torque": 0.005,
        "other": 1.0,
    }
    answer = TrueValues(truth=RigTruth(effects=(FRICTION,), values=values)).answer(rubbing)
    assert answer.causes[0].effects == (FRICTION,)
    assert answer.causes[0].parameters[f"{FRICTION}.torque"].value == 0.005
    assert answer.parameters["k_oh"].fitted == values["k_oh"]
    assert shrunk(answer) > 0.9


def test_sparse_regression_names_the_friction_and_shrinks_the_gap(rubbing: GapProblem) -> None:
    answer = SparseRegression().answer(rubbing)
    assert answer.causes[0].effects == (FRICTION,)
    assert answer.where[0].location == "yaw_moment"
    assert shrunk(answer, horizon="0.5") > 0.6


@pytest.mark.slow
def test_sparse_regression_names_no_winner_of_a_pair_no_force_tells_apart() -> None:
    answer = SparseRegression().answer(problem_with("tail_actuator_lag"))
    assert answer.confusable == (("tail_input_delay", "tail_actuator_lag"),)


def test_sparse_regression_finds_no_term_where_there_is_nothing(plain: GapProblem) -> None:
    assert SparseRegression().answer(plain).verdict == "parameters_only"


@pytest.mark.slow
def test_a_learnt_force_shrinks_the_gap_without_a_name(rubbing: GapProblem) -> None:
    answer = FlexibleResidual().answer(rubbing)
    assert answer.verdict == "none_of_these"
    assert answer.where[0].location == "yaw_moment"
    assert shrunk(answer, horizon="0.5") > 0.2


@pytest.mark.slow
def test_nothing_is_learnt_where_there_is_nothing(plain: GapProblem) -> None:
    assert FlexibleResidual().answer(plain).verdict == "no_gap"


def test_the_restoring_force_is_the_torque_that_is_missing(rubbing: GapProblem) -> None:
    dataset = rubbing.datasets[0]
    moved = motion(Newtonian(), [dataset], (), 10.0)
    terms, values = columns(Newtonian(), moved)
    place = names(Newtonian().disturbances).index("yaw_moment")
    sign = next(k for k, t in enumerate(terms) if t.name == "sign(rate)" and "yaw" in t.location)
    turning = np.abs(values[:, sign]) > 0.99
    force = moved.force[turning, place] * values[turning, sign]
    assert np.median(force) == pytest.approx(-0.005, rel=0.1)
    # That of angles alone is the same.
    alone = motion(Newtonian(), [measuring(dataset, 2)], (), 10.0)
    assert np.corrcoef(moved.force[:, 1], alone.force[:, 1])[0, 1] > 0.85


@pytest.mark.slow
def test_marks_of_synthetic_rigs_tell_their_effects() -> None:
    outputs = names(Newtonian().outputs)
    few = {k: CANDIDATES[k] for k in (FRICTION, "tail_dead_zone")}
    marks_by_effect = [
        rigs(Request(Newtonian(), name, effect, outputs, 0.02, 8, seed))
        for seed, (name, effect) in enumerate(few.items())
    ]
    labels = [name for name, rows in zip(few, marks_by_effect, strict=True) for _ in rows]
    rows = np.concatenate(marks_by_effect)
    classifier = _fitted(labels, rows)
    predictions = np.argmax(classifier.probabilities(rows), axis=1)
    assert [classifier.classes[k] for k in predictions] == labels
    again = rigs(Request(Newtonian(), FRICTION, few[FRICTION], outputs, 0.02, 8, 0))
    np.testing.assert_array_equal(again, marks_by_effect[0])


def test_marks_are_as_many_for_any_length(rubbing: GapProblem) -> None:
    dataset = rubbing.datasets[0]
    long, short = (marks(few_free(*FREE), [d], 10.0) for d in (dataset, dataset.part(0, 1500)))
    assert long.shape == short.shape and np.isfinite(long).all()


def test_what_is_sealed_is_not_fitted(rubbing: GapProblem) -> None:
    parts = parts_of(rubbing)
    for number, first, last in parts.sealed:
        assert first >= len(parts.fitted[number]) and last == len(parts.whole[number])
    first = refit(rubbing, parts).values
    dataset = rubbing.datasets[0]
    changed = dataset.measurements.copy()
    changed[parts.sealed[0][1] :] += 1.0
    other = replace(rubbing, datasets=(replace(dataset, measurements=changed),))
    assert refit(other, parts_of(other)).values == first


@pytest.mark.slow
def test_a_model_without_priors_is_not_refitted(rubbing: GapProblem) -> None:
    fixed = replace(rubbing, model=few_free())
    assert not fit_problem(fixed, parts_of(fixed)).free
    assert ParameterRefit().answer(fixed).parameters == {}


def test_each_is_found_by_its_name_and_an_unknown_one_told(tmp_path: Path, capsys) -> None:
    for name in METHODS:
        baseline = baseline_of(name)
        assert isinstance(baseline, Baseline) and baseline.name == name
    assert set(CANDIDATES) <= set(bench_effects())
    with pytest.raises(ConfigurationError, match="no baseline"):
        baseline_of("guess")
    words = ["method=parameter_refit", f"in={tmp_path}", f"out={tmp_path / 'out'}"]
    assert command.main(words) == 2
    assert "no recordings" in capsys.readouterr().err
    assert command.main(["method=oracle", *words[1:]]) == 2
    assert "truth" in capsys.readouterr().err


@pytest.mark.slow
def test_a_set_is_answered_recording_by_recording(rubbing: GapProblem, tmp_path: Path) -> None:
    folder = tmp_path / "set" / "recordings"
    folder.mkdir(parents=True)
    for name in ("c1", "c2"):
        (folder / f"{name}.csv").touch()
    messages: list[str] = []
    out = tmp_path / "out"
    (out / "c1").mkdir(parents=True)
    (out / "c1" / "diagnosis.json").write_text("{}", encoding="utf-8")
    failed = run_baseline(
        "parameter_refit", folder.parent, out, 1, problem_of=small, tell=messages.append
    )
    assert not failed and len(messages) == 1 and "c2" in messages[0]
    document = json.loads((out / "c2" / "diagnosis.json").read_text(encoding="utf-8"))
    assert document["schema"] == "trms.diagnosis/1"
    assert document["verdict"] == "parameters_only"


def test_what_an_effect_is_made_with_can_be_written() -> None:
    for name, effect in bench_effects().items():
        arguments = arguments_of(effect)
        assert json.loads(json.dumps(arguments)) == arguments, name
        assert replace(effect, **arguments) == effect, name


@pytest.mark.slow
def test_an_answer_leaves_its_models(tmp_path: Path) -> None:
    summary = _answer("oracle", RigTruth(effects=(FRICTION,)), Path("c1.csv"), tmp_path, small)
    assert "yaw_coulomb_friction 1.00" in summary
    corrected = load_model(str(tmp_path / "c1" / "corrected_model.yaml"))
    assert corrected.parameters[f"{FRICTION}.torque"].value == pytest.approx(0.005, rel=0.05)
    before = load_model(str(tmp_path / "c1" / "refit_model.yaml"))
    assert f"{FRICTION}.torque" not in before.parameters
    assert before.parameters["k_oh"].value != corrected.parameters["k_oh"].value


def small(path: Path) -> GapProblem:
    return problem_with(FRICTION)
