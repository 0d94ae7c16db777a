"""What a study is about: effects inside and outside the equations, loops, refusals."""

from dataclasses import fields
from pathlib import Path

import pytest

from trms_cli.composition.composer import compose
from trms_cli.controllers.open_loop import OpenLoop
from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.core.findings import json_data
from trms_cli.core.plugins import build
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.dead_zone import DeadZone
from trms_cli.effects.extended_model import effect_names, extend_model
from trms_cli.effects.rotor_reaction import RotorReaction
from trms_cli.effects.sensor_bias import SensorBias
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.parameters import ParameterSet
from trms_cli.stability.studies.controllability import Controllability
from trms_cli.stability.studies.equilibria import Equilibria
from trms_cli.stability.studies.hunting import Hunting
from trms_cli.stability.studies.limit_cycles import LimitCycles
from trms_cli.stability.studies.local import Local
from trms_cli.stability.studies.lyapunov import Lyapunov
from trms_cli.stability.studies.margins import Margins
from trms_cli.stability.studies.phase_portrait import PhasePortrait
from trms_cli.stability.studies.region_of_attraction import RegionOfAttraction
from trms_cli.stability.studies.root_locus import RootLocus
from trms_cli.stability.studies.tolerance import Tolerance
from trms_cli.stability.study import Study, silent
from trms_cli.stability.subject import LoopParts, Subject

EFFECTS = {
    "zone": DeadZone(rotor="main", width=0.1),
    "drag": RotorReaction(rotor="main", drag=3e-7, inertia=0.0),
    "bias": SensorBias(axis="pitch", bias=0.1),
    "dry": CoulombFriction(axis="pitch", torque=0.01),
}
MODEL = extend_model(Newtonian(), EFFECTS)
STUDIES = [
    path.stem for path in sorted((Path(__file__).parents[2] / "configs/study").glob("*.yaml"))
]
#: Studies of a model alone; of equations.
OF_A_MODEL = Equilibria(), LimitCycles(), Local(), Lyapunov(), RootLocus(), Controllability()
OF_A_LOOP = Hunting(), Margins(), Tolerance()
OF_EQUATIONS = Equilibria(), LimitCycles(), Lyapunov(), PhasePortrait(), RegionOfAttraction()


def test_the_equations_are_those_of_what_moves_with_values_changed_later_and_others_are_told():
    model = Subject(MODEL, "newtonian").require_equations("a study")
    assert effect_names(model) == ("drag", "dry")
    whole = Subject(MODEL, "newtonian").require_equations("a study", command_path=True)
    assert whole is MODEL
    # Nothing is made anew without need.
    moving = extend_model(Newtonian(), {"drag": EFFECTS["drag"]})
    assert Subject(moving, "newtonian").require_equations("a study") is moving
    subject = Subject(MODEL, "newtonian")
    assert subject.dry == ("dry",)
    assert subject.on_commands == ("zone",) and subject.on_sensors == ("bias",)
    assert set(subject.left_out_of_equations()) == {"dry", "zone", "bias"}
    model = extend_model(Newtonian(), EFFECTS)
    model.parameters = model.parameters.replaced({"k_g": 0.05, "drag.drag": 1e-7})
    assert isinstance(model.parameters, ParameterSet)
    moving = Subject(model, "newtonian").require_equations("a study")
    found = {p.name: p.value for p in moving.parameters}
    assert found["k_g"] == 0.05 and found["drag.drag"] == 1e-7


def test_a_loop_keeps_its_delays_and_sensors_and_one_that_plays_commands_is_none():
    loop = LoopParts(Newtonian(), None, None, 0.02, {"controller": "lqr"})  # type: ignore[arg-type]
    subject = Subject(MODEL, "newtonian", loop)
    assert subject.require_equations("a study") is MODEL
    assert subject.require_loop("a study") is loop
    for study in OF_A_LOOP:
        with pytest.raises(ConfigurationError, match="no controller is chosen"):
            study.run(Subject(MODEL, "newtonian"), silent)
    Subject(MODEL, "newtonian").require_no_loop("a study")
    for study in OF_A_MODEL:
        with pytest.raises(ConfigurationError, match="about the model alone"):
            study.run(Subject(Newtonian(), "newtonian", loop), silent)
    loop = LoopParts(Newtonian(), OpenLoop(), None, 0.02, {"controller": "played"})  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match=r"controller=played .* there is no loop") as error:
        Subject(MODEL, "newtonian", loop)
    assert error.value.where == "controller"


def test_a_model_that_only_steps():
    model = Newtonian()
    model.sample_time = 0.02
    with pytest.raises(ModelError, match="only steps from sample to sample") as caught:
        Subject(model, "net").require_equations("a study", "ask another")
    assert caught.value.remedy.startswith("ask another; or ")
    for study in OF_EQUATIONS:
        with pytest.raises(ModelError, match="only steps from sample to sample"):
            study.run(Subject(model, "net"), silent)


@pytest.mark.parametrize("name", STUDIES)
def test_the_keys_of_a_study_are_those_of_its_yaml(name):
    config = compose([f"study={name}"], "stability").config["study"]
    study = build(config, "study")
    assert isinstance(study, Study)
    assert json_data(study) == json_data(type(study)())
    assert set(config) - {"_target_"} == {field.name for field in fields(study)}
