"""Advice on the next experiment: what it promises, and that its command can be typed."""

import contextlib
import io
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.identification.greybox.rigs import recording
from trms_cli.commands.excite import main
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.gap.competing_model import Refit, refit
from trms_cli.gap.diagnosis import NextExperiment
from trms_cli.gap.diagnosis_result import _kin
from trms_cli.gap.experiments import experiments
from trms_cli.gap.next_experiment import (
    advise,
    between,
    predicted_recordings,
    signatures,
    visibility,
    with_rows,
)
from trms_cli.gap.problem import CandidateEffect, applicable_candidates
from trms_cli.identification.problem import free_parameters
from trms_cli.models.newtonian import Newtonian
from trms_cli.simulation.rollout import Rollout

from .recorded import effect

MODEL = Newtonian()
EFFECTS = (
    "main_input_delay",
    "main_actuator_lag",
    "tail_dead_zone",
    "tail_rotor_friction",
    "tail_thrust_curve",
    "yaw_disturbance",
)
FITTED = {
    "main_input_delay.delay": 0.04,
    "main_actuator_lag.time_constant": 0.04,
    "tail_dead_zone.width": 0.05,
}
FAST, SLOW = "fast switching between two levels", "slow rises and falls through zero"
SHARES = np.full(4, 0.01)  # of the equations


@pytest.fixture(scope="module")
def candidates() -> dict[str, CandidateEffect]:
    candidates_by_name, _ = applicable_candidates(MODEL, {name: effect(name) for name in EFFECTS})
    return candidates_by_name


@pytest.fixture(scope="module")
def plain() -> Refit:
    """Of a recording in which the tail rotor never stops."""
    dataset, _ = recording(MODEL, seconds=24.0, ranges=[(1.0, 1.4), (0.4, 0.9)], substeps=1)
    free = free_parameters(MODEL.parameters, ["k_uv", "k_fvp"])
    return refit(MODEL, free, [dataset], 8.0)


@pytest.fixture(scope="module")
def recordings(plain: Refit) -> dict:
    return {e.words: r for e, r in predicted_recordings(plain, SHARES, "newtonian")}


def advised(plain: Refit, candidates: dict[str, CandidateEffect], **options) -> NextExperiment:
    advice = advise(refit=plain, candidates=candidates, model_name="newtonian", **options)
    assert advice is not None
    return advice


def test_a_fast_excitation_tells_delay_from_lag_better_than_a_slow_one(
    recordings, candidates
) -> None:
    pair = [with_rows(candidates[name], FITTED) for name in EFFECTS[:2]]
    fast, slow = (
        between(signatures(recordings[words], pair), *EFFECTS[:2], EFFECTS[:2])
        for words in (FAST, SLOW)
    )
    assert fast > 5 * slow
    assert fast > 3


def test_crossing_zero_tells_a_dead_zone_from_rotor_friction(
    plain: Refit, candidates: dict
) -> None:
    advice = advised(
        plain, candidates, apart=["tail_dead_zone", "tail_rotor_friction"], shares=SHARES
    )
    assert "tail_dead_zone from tail_rotor_friction by" in advice.why
    assert "no nats in the 24 s recorded" in advice.why


FRICTIONS = ("yaw_coulomb_friction", "yaw_stribeck_friction")
#: Of a third of a millinewton metre.
SMALL_FRICTION = {
    "yaw_coulomb_friction.torque": 0.0004,
    "yaw_stribeck_friction.torque": 0.0003,
    "yaw_stribeck_friction.excess": 0.5,
    "yaw_stribeck_friction.velocity": 0.03,
}


def test_small_levels_tell_whether_a_small_friction_is_larger_at_rest(plain: Refit) -> None:
    frictions, _ = applicable_candidates(MODEL, {name: effect(name) for name in FRICTIONS})
    pair = [with_rows(frictions[name], SMALL_FRICTION) for name in FRICTIONS]
    nats = {"small": 0.0, "": 0.0}
    for experiment, predicted in predicted_recordings(plain, SHARES / 2, "newtonian", rest=True):
        kind = "small" if "small" in experiment.words else ""
        own = between(signatures(predicted, pair), *FRICTIONS, FRICTIONS)
        nats[kind] = max(nats[kind], own)
    assert nats["small"] > 2 * nats[""]
    assert nats["small"] > 2


def test_a_fit_of_a_special_case_does_not_say_how_the_two_differ() -> None:
    """An excess on its lower bound is Coulomb friction, of which Coulomb friction differs not."""
    frictions, _ = applicable_candidates(MODEL, {name: effect(name) for name in FRICTIONS})
    coulomb, stribeck = (frictions[name] for name in FRICTIONS)
    assert coulomb.apart_from_special_case(SMALL_FRICTION) == SMALL_FRICTION
    assert stribeck.apart_from_special_case(SMALL_FRICTION) == SMALL_FRICTION
    assert stribeck.apart_from_special_case({}) == {}  # not fitted
    bound = {**SMALL_FRICTION, f"{FRICTIONS[1]}.excess": 0.05, f"{FRICTIONS[1]}.velocity": 0.005}
    sizes = stribeck.apart_from_special_case(bound)
    assert sizes[f"{FRICTIONS[1]}.torque"] == 0.0003
    assert sizes[f"{FRICTIONS[1]}.excess"] == pytest.approx(0.1**0.5)
    assert sizes[f"{FRICTIONS[1]}.velocity"] == pytest.approx(0.001**0.5)


def test_a_cause_that_is_not_sure_is_told_from_its_next_of_kin() -> None:
    kin = {n: effect(n) for n in (*FRICTIONS, "pitch_stribeck_friction", "main_input_delay")}
    frictions, _ = applicable_candidates(MODEL, kin)
    assert _kin(FRICTIONS[0], frictions) == list(FRICTIONS)
    assert _kin(FRICTIONS[1], frictions) == list(reversed(FRICTIONS))
    assert _kin("main_input_delay", frictions) == ["main_input_delay"]
    assert _kin("unknown", frictions) == []


def test_a_thrust_in_reverse_becomes_visible(
    plain: Refit, recordings: dict, candidates: dict
) -> None:
    name = "tail_thrust_curve"
    curve = candidates[name]
    reverse = replace(curve, variants=curve.variants[curve.variants[:, 1] != 0])
    visibilities = {w: visibility(signatures(r, [reverse]), name) for w, r in recordings.items()}
    assert visibilities["random levels with rotors that reverse"] > 12.5
    advice = advised(plain, {name: reverse}, untested=[name], shares=SHARES)
    assert "makes visible" in advice.why
    assert f"{name} " in advice.why and "against no nats in what is recorded" in advice.why


def test_the_angles_stay_within_their_bounds(recordings: dict) -> None:
    assert len(recordings) == 6
    for recording_ in recordings.values():
        windows = recording_.structure.windows
        angles = np.abs(windows.target[..., :2])
        assert (np.nanmax(angles, axis=(0, 1)) < [0.8 * 1.05, 0.8 * 2.8]).all()


def test_noise_from_outside_is_told_by_what_does_not_repeat(plain: Refit, candidates: dict) -> None:
    advice = advised(plain, candidates, apart=["tail_dead_zone", "yaw_disturbance"])
    assert "excitation.periods=4" in advice.command
    # Nothing is advised where nothing is known.
    assert advise(refit=plain, candidates={}, model_name="newtonian") is None


@pytest.mark.parametrize("name", ["newtonian_horizontal", "tras", "quanser_aero"])
def test_other_models_have_experiments(name: str) -> None:
    text = (config_folder() / "model" / f"{name}.yaml").read_text(encoding="utf-8")
    model = build(yaml.safe_load(text), "model")
    rollout = Rollout(model, 0.02)
    designs = list(experiments(rollout, [model.parameters.values], 0.02, name))
    limits = [model.input_limits[signal.name] for signal in model.inputs]
    assert designs
    for experiment in designs:
        assert experiment.commands.shape == (2000, model.n_u)
        assert (np.abs(experiment.commands) <= limits).all()
        assert f"model={name}" in experiment.command


def test_a_command_makes_the_commands_that_were_predicted(tmp_path: Path) -> None:
    rollout = Rollout(MODEL, 0.02)
    values = [MODEL.parameters.values]
    designs = list(experiments(rollout, values, 0.02, "newtonian"))
    again = list(experiments(rollout, values, 0.02, "newtonian", rest=True, seed=3))
    small = [experiment for experiment in again if "small" in experiment.words]
    assert {e.words.split("of the ")[1] for e in small} == {
        f"{rotor} rotor, the other {state}"
        for rotor in ("main", "tail")
        for state in ("steady", "off")
    }
    assert all("seed=3" in experiment.command for experiment in small)
    for k, experiment in enumerate([*designs, small[-1]]):
        program, command, *words = shlex.split(experiment.command)
        assert program == "trms"
        if "prbs" not in experiment.command and "reversals" not in experiment.command:
            continue  # one about an operating point, in a band of its own, and some about zero
        assert command == "excite"
        out = tmp_path / str(k)
        with contextlib.redirect_stdout(io.StringIO()):
            assert main([*words, f"out={out}", "picture=false", "rigs=0"]) == 0
        table = np.loadtxt(out / "excitation.csv", delimiter=",", skiprows=4)
        assert np.allclose(table[:, 1:], experiment.commands, atol=1e-5)
