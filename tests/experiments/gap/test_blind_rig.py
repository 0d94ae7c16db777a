"""Rigs of the blind benchmark against the models and the effects: two codes, one physics.

The rigs share no equation with them, so each holds the other: a sign, a factor or an arm that is
wrong in one of the two shows here.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from experiments.gap.blind import rig
from experiments.gap.blind.drivers import (
    CascadedPid,
    OpenLoop,
    poor_excitation,
    rich_excitation,
    square_references,
)
from experiments.gap.blind.nominal import nominal
from experiments.gap.blind.rig import Nuisances, RigRecordings, Rigs
from trms_cli.composition.catalogue import read_yaml
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.model_form import ModelForm
from trms_cli.models.discretisation import discretise
from trms_cli.models.newtonian import Newtonian

SAMPLE, SAMPLES = 0.02, 200  # s
QUIET = Nuisances(jitter=0.0, drift=0.0, flexibility=0.0)

#: Share of an effect's own signature by which the two codes may differ. Frictions and the cable
#: follow other laws in the rigs, on purpose; inflow of the tail differs while it turns round.
OTHER_LAW = {
    "pitch_coulomb_friction": 0.06,
    "yaw_coulomb_friction": 0.06,
    "pitch_stribeck_friction": 0.15,
    "yaw_stribeck_friction": 0.10,
    "yaw_cable_hysteresis": 0.35,
    "main_rotor_friction": 0.03,
    "tail_rotor_friction": 0.03,
    "tail_inflow": 0.2,
}
SAME_LAW = 0.03
#: What a random draw or the encoder decides cannot be compared sample by sample; a residual and a
#: constant torque are no effects of a rig, and other laws are a nuisance of it.
NOT_COMPARED = (
    "disturbance",
    "quantisation",
    "residual_force",
    "residual_reading",
    "constant_torque",
    "model_form",
)


def nominals(n: int) -> dict[str, np.ndarray]:
    return {name: np.full(n, value) for name, value in nominal().items()}


LIBRARY: dict[str, dict[str, Any]] = {
    file.stem: read_yaml(file)[file.stem]
    for file in sorted((config_folder() / "effect").glob("*.yaml"))
    if not file.stem.endswith(NOT_COMPARED)
}


@pytest.fixture(scope="module")
def recorded() -> tuple[np.ndarray, dict[str | None, np.ndarray]]:
    """Commands, and what each rig measured with perfect sensors; None is the rig without effect."""
    names = [None, *LIBRARY]
    sizes: dict[str, np.ndarray] = {}
    for i, name in enumerate(names):
        for key, value in LIBRARY.get(name or "", {}).items():
            if isinstance(value, (int, float)):
                sizes.setdefault(f"{name}.{key}", np.zeros(len(names)))[i] = value
    commands = np.repeat(rich_excitation([5], SAMPLES, SAMPLE), len(names), axis=0)
    measured = with_perfect_sensors(Rigs(nominals(len(names)), sizes, QUIET), commands)
    return commands[0], dict(zip(names, measured, strict=True))


def with_perfect_sensors(rigs: Rigs, commands: np.ndarray) -> np.ndarray:
    """What rigs measure whose sensors have neither noise nor steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rig, "SPEED_NOISE", 0.0)
        patch.setattr(rig, "SPEED_QUANTUM", 1e-9)
        patch.setattr(rig, "PITCH_QUANTUM", 1e-12)
        patch.setattr(rig, "YAW_QUANTUM", 1e-12)
        return rigs.run(OpenLoop(commands), SAMPLES * SAMPLE, SAMPLE, settling=0.0).measured


def simulated(name: str | None, commands: np.ndarray) -> np.ndarray:
    return simulated_with({} if name is None else {name: build(LIBRARY[name], name)}, commands)


def simulated_with(effects: dict[str, Effect], commands: np.ndarray) -> np.ndarray:
    model = extend_model(Newtonian(), effects)
    discrete = discretise(model, SAMPLE, 4, sensors=True)
    p, start = model.parameters.values, model.rest()
    start[model.state_index("alpha_v")] = hanging(nominal())
    x = discrete.initial(start, np.zeros(2))
    # forty models, a few hundred steps each: not worth forty compilations
    steps = discrete.step.mapaccum(SAMPLES - 1)
    later = np.array(steps(x, commands[:-1].T, p, np.zeros(model.n_w)))
    states = np.column_stack([x, later])
    return np.asarray(discrete.measurement(states, commands.T, p)).T


def hanging(c: dict[str, float]) -> float:
    """The pitch angle at rest: all moments of gravity in balance."""
    a = (c["m_t"] / 2 + c["m_tr"] + c["m_ts"]) * c["l_t"]
    b = (c["m_m"] / 2 + c["m_mr"] + c["m_ms"]) * c["l_m"]
    return float(-np.arctan2(b - a, c["m_b"] * c["l_b"] / 2 + c["m_cb"] * c["l_cb"]))


def test_without_effects_it_is_the_nominal_model(recorded: Any) -> None:
    commands, runs = recorded
    difference = np.abs(runs[None] - simulated(None, commands)).max(axis=0)
    assert (difference < [5e-6, 5e-6, 5e-4, 5e-4]).all()
    assert np.ptp(runs[None], axis=0)[:2].min() > 0.1  # and it moved


@pytest.mark.parametrize("name", LIBRARY)
def test_an_effect_is_the_same_in_both_codes(name: str, recorded: Any) -> None:
    commands, runs = recorded
    plain, own = simulated(None, commands), simulated(name, commands)
    # in units of the sensors, so that the channel counts in which the effect shows
    units = np.array([0.0015, 0.0015, 1.6, 1.6])
    signature = np.sqrt(np.mean(((own - plain) / units) ** 2))
    difference = np.sqrt(np.mean(((own - runs[name]) / units) ** 2))
    assert signature > 0.03
    assert difference < OTHER_LAW.get(name, SAME_LAW) * signature


@pytest.mark.slow
def test_laws_of_another_form_are_the_same_in_both_codes() -> None:
    """Of the rigs of the set ``imperfect``, by the effect that says so of a model."""
    laws = {"viscous_exponent": 0.85, "thrust_exponent": 0.06, "cable_hardening": -0.05}
    inertias = {"pitch_inertia": 1.08, "yaw_inertia": 0.92}
    commands = rich_excitation([5], SAMPLES, SAMPLE)
    nuisances = replace(QUIET, **laws, **inertias)
    (measured,) = with_perfect_sensors(Rigs(nominals(1), {}, nuisances), commands)
    both = {"damping": -0.15, "thrust": 0.06}
    effects: dict[str, Effect] = {
        "pitch_model_form": ModelForm(axis="pitch", inertia=0.08, **both),
        "yaw_model_form": ModelForm(axis="yaw", spring=-0.05, inertia=-0.08, **both),
    }
    plain, own = (simulated_with(e, commands[0]) for e in ({}, effects))
    units = np.array([0.0015, 0.0015, 1.6, 1.6])
    signature = np.sqrt(np.mean(((own - plain) / units) ** 2))
    difference = np.sqrt(np.mean(((own - measured) / units) ** 2))
    assert signature > 1.0
    assert difference < 0.05 * signature


def run_with(
    driver: Any, n: int, nuisances: Nuisances | None = None, seed: int = 1
) -> RigRecordings:
    rigs = Rigs(nominals(n), {}, nuisances or Nuisances(), seed)
    return rigs.run(driver, 1.0, SAMPLE, settling=0.2)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_recording_with_small_nuisances_and_whole_quanta() -> None:
    table = rich_excitation([1, 2], 50, SAMPLE)
    first, again, other = (run_with(OpenLoop(table), 2, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.measured, again.measured)
    assert (first.measured != other.measured).any()
    quiet = run_with(OpenLoop(table), 2, nuisances=QUIET)
    difference = np.abs(first.measured - quiet.measured)[..., :2].max()
    assert 1e-3 < difference < 0.05
    measured = run_with(OpenLoop(poor_excitation([1], 50, SAMPLE)), 1).measured[0]
    for column, quantum in ((0, rig.PITCH_QUANTUM), (2, rig.SPEED_QUANTUM)):
        counts = measured[:, column] / quantum
        np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)


@pytest.mark.slow
def test_the_controller_follows() -> None:
    references = np.tile([-0.2, 0.4], (1, 400, 1))
    rigs = Rigs(nominals(1), {}, Nuisances(), 1)
    run = rigs.run(CascadedPid(references, SAMPLE), 8.0, SAMPLE, settling=0.0)
    error = np.abs(run.measured[0, :, :2] - references[0])
    assert (np.abs(run.commands) <= rig.COMMAND_LIMIT).all()
    assert (error[-50:].max(axis=0) < 0.5 * error[0]).all()
    # References are held and within reach.
    references = square_references([3, 4], 2000, SAMPLE)
    assert (np.abs(references) < [0.5, 0.8]).all()
    changes = np.abs(np.diff(references[0, :, 0])) > 0
    assert 2 <= changes.sum() <= 6
