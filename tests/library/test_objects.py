"""Parts may be objects; the log says what they were, and does not pretend to hold them."""

import json
import re

import numpy as np
import pytest

from trms_cli import ConfigurationError, Experiment, Interrupted, TrmsError, build, load, run
from trms_cli.cli import main

from .own_parts import Raising, Steady

SHORT = {"sim": {"duration": 1}, "picture": False}


@pytest.fixture(scope="module")
def steady(tmp_path_factory):
    folder = tmp_path_factory.mktemp("objects") / "steady"
    return run("seed=2", controller=Steady((1.2, 0.1)), ref="square", out=folder, **SHORT)


def test_the_loop_takes_it_and_the_log_tells_of_it(steady):
    assert (steady["/command"].to_numpy()[1:] == [1.2, 0.1]).all()
    assert steady.choices["controller"] == "Steady(volts=(1.2, 0.1))"
    node = steady.config["controller"]
    assert node["kind"].endswith("own_parts.Steady") and "1.2" in node["words"]
    assert steady.logged.run["command"].startswith("Python: run('ref=square'")
    assert "seed=2" in json.loads(steady.logged.run["overrides"])


def test_it_cannot_be_repeated_from_the_log_alone(steady, here, capsys):
    assert main(["run", "--from", str(steady.log), "out=again"]) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "Steady(volts=(1.2, 0.1)" in told and "an object in a Python session" in told
    assert not (here / "again").exists()
    with pytest.raises(ConfigurationError, match="controller was Steady"):
        load(steady.folder).again()


def test_again_keeps_the_object_while_it_is_there(steady, here):
    again = steady.again(sim={"duration": 0.5})
    assert len(again["/command"]) == 25 and again.choices == steady.choices
    other = steady.again(controller="lqr")
    assert other.choices["controller"] == "lqr" and other.config["seed"] == 2
    third = other.again(controller=Steady(), out="third")
    assert third.choices["controller"] == "Steady"


def test_a_model_is_also_the_rigs_unless_that_is_chosen(here):
    model = build("model", "newtonian", parameters={"k_g": 0.1})
    both = run(model=model, controller="lqr", **SHORT)
    parameters = both.logged.attachments["parameters.yaml"].decode()
    assert parameters.count("k_g:\n    value: 0.1\n") == 2
    own = run("model@plant.model=newtonian_full", model=model, controller="lqr", **SHORT)
    assert len(own["/plant/state"].columns) == 8 and len(both["/plant/state"].columns) == 6


@pytest.mark.slow
def test_again_with_another_model_keeps_the_rig(here):
    def gains(made) -> list[str]:
        return re.findall(
            r"k_g:\n    value: (.*)\n", made.logged.attachments["parameters.yaml"].decode()
        )

    light, heavy = (build("model", "newtonian", parameters={"k_g": k}) for k in (0.1, 0.3))
    first = run(model=light, controller="lqr", **SHORT)
    assert gains(first.again(model=heavy, out="objects")) == ["0.3", "0.1"]  # the model, the rig
    assert gains(first.again(model="newtonian", out="name"))[1] == "0.1"
    named = run("model.parameters.k_g=0.2", controller=Steady(), **SHORT)
    assert gains(named.again(model=heavy, out="own")) == ["0.3", "0.2"]
    plain = run("model.parameters.k_g=0.2", controller="lqr", **SHORT)
    assert gains(load(plain.folder).again(model=heavy, out="loaded")) == ["0.3", "0.2"]
    assert gains(plain.again(model="lagrangian", out="another"))[1] == "0.2"


def test_effects_and_references_of_ones_own(here):
    delay = build("effect", "main_input_delay", delay=0.1)
    made = run(
        effect={"yaw_coulomb_friction": {"torque": 0.01}, "slow": delay},
        ref={"alpha_h": lambda t: 0.2 * np.sin(t), "alpha_v": lambda t: 0.1 if t > 0.5 else 0.0},
        controller="lqr",
        **SHORT,
    )
    assert made.choices["effect"] == ["yaw_coulomb_friction", "slow"]
    reference = made["/reference"]
    np.testing.assert_allclose(reference.alpha_h, 0.2 * np.sin(reference.index))
    assert set(reference.alpha_v) == {0.0, 0.1}
    plain = run(effect={"yaw_coulomb_friction": {"torque": 0.01}}, controller="lqr", **SHORT)
    state, other = made["/plant/state"], plain["/plant/state"]
    assert not np.allclose(state.alpha_v, other.alpha_v)


def test_a_whole_experiment(here):
    experiment = Experiment(
        model=build("model", "newtonian"),
        plant=build("plant", "simulated"),
        observer=build("observer", "ukf"),
        controller=Steady(),
        reference=build("ref", "sine"),
        duration=1.0,
        sample_time=0.02,
        seed=2,
    )
    whole = run(experiment, picture=False)
    named = run(controller=Steady(), ref="sine", seed=2, **SHORT)
    assert whole["/plant/state"].equals(named["/plant/state"])
    with pytest.raises(ConfigurationError, match="experiment"):
        run(experiment, controller=Steady())


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"controller": object()}, "lacks"),
        ({"ref": {"alpha_q": lambda t: t}}, "did you mean"),
        ({"ref": {"alpha_h": lambda t: np.zeros(3)}}, "one value for each time"),
        ({"nowhere.at.all": Steady()}, "nowhere"),
    ],
)
def test_what_does_not_fit_is_told(keys, words, here):
    with pytest.raises(ConfigurationError, match=words):
        run(**{"controller": "lqr", **keys}, **SHORT)
    assert not (here / "outputs").exists()


def test_a_mistake_in_it_is_shown_with_its_own_trace(here):
    with pytest.raises(TrmsError, match=r"Raising failed at 0\.50 s") as caught:
        run(controller=Raising(), **SHORT)
    shown = "\n".join(caught.value._render_traceback_())
    assert "ZeroDivisionError: mine" in shown and "--debug" not in shown


def test_ctrl_c_keeps_what_was_done(here):
    with pytest.raises(KeyboardInterrupt) as caught:
        run(controller=Raising(error=KeyboardInterrupt), out="kept", **SHORT)
    assert isinstance(caught.value, Interrupted)
    kept = load(caught.value.folder)
    assert kept.outcome == "interrupted" and 0.4 < kept["/command"].index[-1] <= 0.5
