"""Linear models from a recording to a closed loop: fit, judge, control."""

import json

import pytest

from tests.program import in_process

pytestmark = pytest.mark.slow
OPEN_LOOP = (
    "controller=open_loop", "observer=full_state",
    "signal@controller.u_v=multilevel", "controller.u_v.amplitude=0.4", "controller.u_v.offset=1.3",
    "signal@controller.u_h=multilevel", "controller.u_h.amplitude=0.5", "controller.u_h.offset=0.6",
    "controller.u_h.seed=5", "sim.duration=120", "picture=false",
)  # fmt: skip
SQUARE = (
    "ref=square", "ref.alpha_v.amplitude=0.1", "ref.alpha_h.amplitude=0.1",
    "ref.alpha_h.offset=0.5", "sim.duration=60", "picture=false",
)  # fmt: skip
#: Of the fits that are judged and control here: one of each kind.
FITS = {
    "arx": ("method.output_order=6", "method.input_order=1"),
    "armax": ("method.output_order=2", "method.input_order=1"),
    "subspace": ("method.order=8",),
}


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    folder = tmp_path_factory.mktemp("linear")
    in_process(folder, "run", *OPEN_LOOP, "out=rig")
    for name, keys in FITS.items():
        words = (f"method={name}", *keys, "real=rig/run.mcap", "picture=false", f"out={name}")
        in_process(folder, "identify", *words)
    return folder


def test_a_fit_says_what_it_is_of_and_how_far_it_foretells(laboratory):
    for name in FITS:
        document = json.loads((laboratory / name / "identification.json").read_text())
        assert document["method"] == name and document["outcome"] == "converged"
        held_out = document["errors"]["held_out"]["after"]
        assert held_out["omega_v"]["fit_percent"] > 80  # the rotor is all but linear
        assert held_out["alpha_h"]["fit_percent"] > 50
        assert document["details"]["static_gain"]["alpha_v by u_v"]["sd"] > 0


def test_models_are_validated_beside_each_other(laboratory):
    models = ",".join(f"{name}/model.yaml" for name in FITS)
    words = (f"model=[newtonian,{models}]", "real=rig/run.mcap", "data.start=90", "page=false")
    in_process(laboratory, "validate", *words, "out=judged")
    document = json.loads((laboratory / "judged" / "validation.json").read_text())
    assert len(document["models"]) == 4


def test_lqr_and_the_kalman_filter_take_a_linear_model(laboratory):
    words = ("model=subspace/model.yaml", "model@plant.model=newtonian", *SQUARE)
    words = (*words, "controller=lqr", "observer=kalman", "out=lqr")
    in_process(laboratory, "run", *words, TRMS_COMPILE="0")
    score = json.loads((laboratory / "lqr" / "score.json").read_text())
    for channel in ("alpha_v", "alpha_h"):
        assert abs(score["channels"][channel]["steady_state_error"]) < 0.01


@pytest.mark.parametrize("observer", ["kalman", "ukf"])
@pytest.mark.parametrize("name", list(FITS))
def test_linear_mpc_tracks_a_small_square(laboratory, name, observer):
    words = (f"model={name}/model.yaml", "model@plant.model=newtonian", *SQUARE)
    folder = f"{name}_{observer}"
    words = (*words, "controller=linear_mpc", f"observer={observer}", f"out={folder}")
    in_process(laboratory, "run", *words)
    score = json.loads((laboratory / folder / "score.json").read_text())
    assert score["solver"]["failures"] == 0
    for channel in ("alpha_v", "alpha_h"):
        assert abs(score["channels"][channel]["steady_state_error"]) < 0.03
