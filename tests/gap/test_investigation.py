"""Investigations: when they end, how large commands may be, what is kept; diagnoses by hand."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.gap.diagnosis_case import FRICTION, diagnosis
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.gap import diagnosis as results
from trms_cli.gap.diagnosis import (
    Cause,
    DiagnosisResult,
    NextExperiment,
    OpenLoopExperiment,
    PredictedExperiment,
    SizeEstimate,
)
from trms_cli.gap.investigation import (
    SHARES,
    Ensemble,
    ExperimentRecord,
    Investigation,
    RigLimits,
    document_of,
    ending_of,
    fitted_plan,
    posterior_ensemble,
    prior_ensemble,
    read_document,
    wants_excitation,
)
from trms_cli.models.newtonian import Newtonian
from trms_cli.plants.envelope import Bound, Envelope

STEP, RIVAL = 0.02, "yaw_stribeck_friction"
LIMITS = RigLimits(np.full(2, -2.5), np.full(2, 2.5))


def advice(nats: float, *, apart: bool = True, longer: bool = False) -> NextExperiment:
    levels = np.random.default_rng(2).uniform(-1, 1, (40, 2)) * [0.3, 0.6] + [0.8, 0.0]
    experiment = OpenLoopExperiment(
        words="steps",
        commands=np.repeat(levels, 50, axis=0),
        command="trms run",
        centre=np.zeros(2),
        first=0,
    )
    prediction = PredictedExperiment(
        experiment=experiment,
        apart=(FRICTION, RIVAL) if apart else (),
        nats=nats,
        longer=longer,
    )
    return NextExperiment(why="to tell", command="trms run", prediction=prediction)


def believed(first: float, **changes: Any) -> DiagnosisResult:
    """A diagnosis in which friction has this probability and Stribeck friction the rest."""
    size = SizeEstimate(value=0.005, sd=1e-4, unit="N*m")
    causes = (
        Cause(effects=(FRICTION,), probability=first, parameters={f"{FRICTION}.torque": size}),
        Cause(effects=(RIVAL,), probability=1 - first),
    )
    return diagnosis(causes=causes, **changes)


def recorded(seconds: float) -> Investigation:
    experiment = ExperimentRecord(
        number=1,
        words="multilevel",
        why="a first look",
        log="experiment-1/run.mcap",
        seconds=seconds,
        recorded=seconds,
        share=1.0,
    )
    return Investigation(budget=300.0, sure=0.95, experiments=[experiment])


def test_one_sure_answer_ends_it_whatever_it_is():
    ending = ending_of(recorded(70), believed(0.96, next_experiment=advice(50.0)))
    assert ending is not None and ending[0] == "sure" and "96" in ending[1]
    nothing = diagnosis(
        causes=(
            Cause(effects=("none_of_these",), probability=0.97),
            Cause(effects=(FRICTION,), probability=0.03),
        )
    )
    assert ending_of(recorded(70), nothing)[0] == "sure"


def test_it_goes_on_while_an_experiment_tells_the_rest_apart():
    assert ending_of(recorded(70), believed(0.6, next_experiment=advice(5.0))) is None


@pytest.mark.parametrize(("spent", "nats", "goes_on"), [(70, 1.0, True), (270, 1.0, False)])
def test_what_several_experiments_tell_together_counts_as_far_as_the_budget(spent, nats, goes_on):
    # 3 nats are odds of 20 to 1; 230 s hold five experiments of 40 s, 30 s none
    ending = ending_of(recorded(spent), believed(0.6, next_experiment=advice(nats)))
    assert (ending is None) == goes_on
    if ending is not None:
        assert ending[0] == "not_told_apart" and "yaw Coulomb friction" in ending[1]


def test_without_a_predicted_experiment_it_ends():
    assert ending_of(recorded(70), believed(0.6, next_experiment=None))[0] == "no_experiment"


def test_a_longer_recording_is_another_excitation():
    longer = believed(0.6, next_experiment=advice(0.2, longer=True))
    assert ending_of(recorded(70), longer) is None
    assert wants_excitation(longer)
    assert not wants_excitation(believed(0.6, next_experiment=advice(5.0)))
    # among several it may be the others that tell more than an excitation like the first
    again = replace(longer, recordings=longer.recordings * 2)
    assert not wants_excitation(again)


def test_the_budget_counts_all_rig_time():
    investigation = recorded(262.0)
    assert not investigation.allows(40.0)
    assert investigation.allows(38.0)


def test_commands_are_made_smaller_until_all_rigs_stay_within_bounds():
    model = Newtonian()
    time = np.arange(1000) * STEP
    commands = np.column_stack([np.zeros(1000), 2.0 * np.sign(np.sin(2 * np.pi * 0.1 * time))])
    free = prior_ensemble(model, LIMITS, STEP, 0)
    tight_bound = Envelope(readings={"alpha_h": Bound(lower=-0.3, upper=0.3)})
    tight = prior_ensemble(model, RigLimits(LIMITS.lower, LIMITS.upper, tight_bound), STEP, 0)
    wide = fitted_plan("steps", "", commands, np.zeros(2), 0, free)
    small = fitted_plan("steps", "", commands, np.zeros(2), 0, tight)
    assert wide is not None and small is not None
    assert small.share < wide.share
    assert small.rigs == 9
    low, high = small.ranges["alpha_h"]
    assert low > -0.3 and high < 0.3
    np.testing.assert_allclose(small.commands, small.share * commands)
    larger = SHARES[SHARES.index(small.share) - 1]
    assert tight.ranges(larger * commands) is None


def test_where_no_amplitude_will_do_nothing_is_played():
    never = Envelope(readings={"alpha_v": Bound(lower=-0.01, upper=0.01)})  # rest lies beyond
    ensemble = prior_ensemble(Newtonian(), RigLimits(LIMITS.lower, LIMITS.upper, never), STEP, 0)
    assert fitted_plan("", "", np.zeros((100, 2)), np.zeros(2), 0, ensemble) is None


def test_commands_keep_the_envelope_and_its_slew():
    bounds = Envelope(
        commands={"u_v": Bound(lower=-1.0, upper=1.0, action="clamp")}, slew={"u_h": 1.0}
    )
    limits = RigLimits(LIMITS.lower, LIMITS.upper, bounds)
    commands = np.zeros((50, 2))
    commands[10:] = [2.0, 1.0]
    applied = limits.limited(commands, Newtonian(), STEP)
    assert applied[:, 0].max() == 1.0
    assert np.abs(np.diff(applied[:, 1])).max() == pytest.approx(STEP)


def test_the_ensemble_has_every_possible_cause_drawn_within_its_errors():
    model = Newtonian()
    effects = {FRICTION: CoulombFriction(axis="yaw", torque=0.005)}
    ensemble = posterior_ensemble(believed(0.7), model, effects, LIMITS, STEP, 0)
    assert isinstance(ensemble, Ensemble)
    assert len(ensemble) == 10  # two causes, each as fitted and four times drawn
    sure = posterior_ensemble(believed(0.99), model, effects, LIMITS, STEP, 0)
    assert len(sure) == 5


def test_an_investigation_is_kept_and_read_again():
    investigation = recorded(70.0)
    investigation.experiments[0].diagnosed(believed(0.7))
    investigation.end("budget", "is over")
    document = json.loads(json.dumps(document_of(investigation)))
    assert document["schema"] == "trms.investigation/1"
    assert document["rig_time_s"] == 70.0
    assert document["experiments"][0]["probabilities"][FRICTION] == 0.7
    assert read_document(document) == investigation
    with pytest.raises(ConfigurationError, match="schema"):
        read_document({"schema": "trms.diagnosis/1"})


def test_recordings_too_short_to_tell_anything_are_left_out():
    assert recorded(5.0).recordings == []
    assert recorded(70.0).recordings == ["experiment-1/run.mcap"]


def test_what_is_predicted_is_not_in_the_file():
    document = results.document_of(believed(0.7, next_experiment=advice(5.0)))
    assert document["next_experiment"] == {"why": "to tell", "command": "trms run"}
