"""The loop of rigs with names of their own: references, controllers and observers as they stand.

A servo drive (one current, one position) and a cart that carries a pendulum (unstable, and nobody
controls its angle). What only rigs with rotors have says so.
"""

from collections.abc import Callable
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from trms_cli.composition.composer import compose
from trms_cli.controllers.controller import ControlSetup
from trms_cli.controllers.pid import Pid
from trms_cli.controllers.pid_design import loops_of
from trms_cli.core.errors import ConfigurationError, TrmsError
from trms_cli.library.tasks.experiment import experiment_of
from trms_cli.models.model import Model, RigAxis, Signal
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.parameters import ParameterSet
from trms_cli.models.state_scales import bench_ratios, state_scales
from trms_cli.observers.augmentation import ProcessNoise, augment
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.ukf import Ukf
from trms_cli.plants.landing import Landing
from trms_cli.references.sine import Sine
from trms_cli.references.square import Square
from trms_cli.simulation.closed_loop import Experiment
from trms_cli.simulation.preparation import farthest_command, long_period, reference_of

from .looping import looped

EXAMPLES = Path(__file__).parents[2] / "examples"
OBSERVERS = ("ekf", "kalman", "mhe", "filterpy_ukf", "state_dependent_ekf", "full_state")
#: A tilt to begin with, and a control period for the pendulum's short time constants.
TILTED = ("plant.initial={angle: 0.05}", "sim.duration=6")
FAST = "controller.sample_time=0.04"

Compose = Callable[..., Experiment]


@pytest.fixture
def rig(monkeypatch) -> Compose:
    """The experiment of an example with the program's own options."""
    monkeypatch.setenv("TRMS_ALLOW", "servo_drive,cart_pole")

    def composed(name: str, *overrides: str) -> Experiment:
        words = [f"model={name}", "sim.duration=3", "controller=lqr", *overrides]
        return experiment_of(compose(words, config_dirs=[EXAMPLES / name / "configs"]).config)

    return composed


def tracking(experiment: Experiment) -> float:
    """RMSE of the position over the last second, on the true state."""
    history = looped(experiment).history
    last = round(1.0 / experiment.sample_time)
    state, goal = (history.columns(t)["position"] for t in ("/plant/state", "/reference"))
    return float(np.sqrt(np.mean((state - goal)[-last:] ** 2)))


@pytest.fixture
def newtonian() -> Model:
    """A small bench with two rotors."""
    return Newtonian()


class Carriages(Model):
    """Two masses, each pulled by the other's drive more than by its own."""

    name = "carriages"

    def __init__(self) -> None:
        self.states = tuple(
            Signal(n, u) for n, u in zip(("a", "v_a", "b", "v_b"), ("m", "m/s") * 2, strict=True)
        )
        self.inputs = (Signal("one", "A"), Signal("two", "A"))
        self.outputs = (self.states[0], self.states[2])
        self.disturbances = (Signal("on_a", "N"), Signal("on_b", "N"))
        self.parameters = ParameterSet([], "carriages")
        self.controlled = ("a", "b")
        self.input_limits = {"one": 2.0, "two": 4.0}
        self.axes = {"left": RigAxis("a", "on_a"), "right": RigAxis("b", "on_b")}

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        return ca.vertcat(
            x[1], 3 * u[1] + u[0] - x[1] + w[0], x[3], 4 * u[0] + u[1] - 2 * x[3] + w[1] / 2
        )


def test_a_reference_is_a_share_of_the_range_of_what_follows_it(rig):
    servo = rig("servo_drive")
    reference = reference_of(servo.model, servo.reference)
    assert reference.axes == ("position",)
    assert reference.others["position"] == Square(amplitude=0.3 * 0.4, frequency=0.025)
    cart = rig("cart_pole", "ref=sine")
    assert reference_of(cart.model, cart.reference).others["position"].amplitude == 0.3 * 0.5


def test_a_reference_is_typed_by_the_name_of_what_follows_it(rig):
    def of(*words: str) -> object:
        servo = rig("servo_drive", *words)
        return reference_of(servo.model, servo.reference).others["position"]

    assert of("ref.position.amplitude=0.1") == Square(amplitude=0.1, frequency=0.025)
    assert of("signal@ref.position=sine", "ref.position.frequency=1") == Sine(
        amplitude=pytest.approx(0.12), frequency=1.0
    )
    own = rig("servo_drive", "ref=servo_drive")  # of the rig's own folder: as it stands
    assert reference_of(own.model, own.reference).others["position"].amplitude == 0.1


@pytest.mark.parametrize(
    ("words", "where", "remedy"),
    [
        ("ref.positon.amplitude=0.1", "ref.positon", "did you mean position?"),
        ("signal@ref.positon=sine", "ref.positon", "did you mean position?"),
        ("ref.position.amplitud=0.1", "ref.position.amplitud", "did you mean amplitude?"),
        ("controller.output_weights={positon: 1}", "controller.output_weights", "did you mean pos"),
        ("controller.input_weights.curent=1", "controller.input_weights", "did you mean current?"),
        ("observer.process_noise.states.velocty=1", "observer.process_noise", "did you mean velo"),
    ],
)
def test_a_name_that_the_model_does_not_have_is_refused_with_the_nearest(rig, words, where, remedy):
    with pytest.raises(ConfigurationError) as caught:
        looped(rig("servo_drive", words))
    assert where.endswith(caught.value.where) or caught.value.where.startswith(where)
    assert remedy in caught.value.remedy


def test_weights_are_given_by_the_model_s_names_and_change_what_it_does(rig):
    given = ("controller.input_weights={current: 10}", "controller.output_weights.position=1e3")
    usual, calm = (
        looped(rig("servo_drive", *words)).history.columns("/command")["current"]
        for words in ((), given)
    )
    assert np.abs(calm).max() < 0.5 * np.abs(usual).max()


@pytest.mark.parametrize(
    "controller", ["pid", "linear_mpc", "newton_mpc", "dmc", "tube_mpc", "min_max_mpc"]
)
def test_every_law_moves_the_servo_drive_to_its_reference(rig, controller):
    assert tracking(rig("servo_drive", f"controller={controller}")) < 0.004


@pytest.mark.parametrize("controller", ["lqr", "linear_mpc", "newton_mpc"])
def test_laws_that_see_all_states_hold_the_pendulum_and_follow(rig, controller):
    cart = rig("cart_pole", f"controller={controller}", FAST, *TILTED)
    assert tracking(cart) < 0.004


@pytest.mark.parametrize("name", ["servo_drive", "cart_pole"])
@pytest.mark.parametrize("observer", OBSERVERS)
def test_every_observer_tells_the_loop_what_it_needs(rig, name, observer):
    more = TILTED if name == "cart_pole" else ()
    noise = "plant.sensors.noise_sd.position=2e-4"
    assert tracking(rig(name, f"observer={observer}", noise, *more)) < 0.01


def test_noises_follow_the_scales_of_a_model_until_they_are_given(rig):
    model = rig("servo_drive").model
    setup = ObserverSetup(model, 0.02, ("position",), {"position": 1e-4}, np.zeros(1), np.zeros(1))
    angle, momentum, torque = ProcessNoise().angle, ProcessNoise().momentum, 0.002
    # of a travel of 0.4 m, of that in a time constant of 0.2 s, and of 200 N beside 0.1 N m
    expected = np.array([0.4 * angle, 0.4 / 0.2 / 2 * momentum, 2000 * torque])
    in_time = np.sqrt(0.02 * 0.5 / 0.2)
    assert np.sqrt(augment(setup, Ukf()).q) == pytest.approx(expected * in_time, rel=0.02)
    given = augment(setup, Ukf(process_noise=ProcessNoise(momentum=0.3, states={"position": 0.1})))
    assert np.sqrt(given.q[:2] / 0.02) == pytest.approx([0.1, 0.3])


def test_what_only_rigs_with_rotors_have_says_so_and_what_to_take(rig):
    with pytest.raises(TrmsError, match="rotor"):
        looped(rig("servo_drive", "controller=feedback_linearisation"))
    with pytest.raises(ConfigurationError, match="unstable at rest") as caught:
        looped(rig("cart_pole", "controller=pid"))
    assert "lqr" in caught.value.remedy


def test_pid_pairs_each_axis_with_the_input_that_moves_it_most():
    model = Carriages()
    assert loops_of(model, 0.02) == {"left": 1, "right": 0}
    state = Pid().init(ControlSetup(model, 0.02, np.zeros(2)))
    assert [axis.channel for axis in state.axes] == [1, 0]
    assert all(margins.gain_margin > 2 for margins in state.margins.values())


def test_a_gain_of_pid_is_given_by_the_axis_and_an_axis_too_many_refused(rig):
    gains = "controller.loops={carriage: {kp: 1000, ki: 500, kd: 100}}"
    servo = rig("servo_drive", "controller=pid", gains)
    state = servo.controller.init(ControlSetup(servo.model, 0.02, np.zeros(1)))
    assert state.axes[0].gains.ki == pytest.approx(500.0)
    crowded = Carriages()
    crowded.inputs = crowded.inputs[:1]
    with pytest.raises(ConfigurationError, match="1 inputs for 2"):
        loops_of(crowded, 0.02)


def test_commands_in_open_loop_are_shares_of_full_command(rig):
    servo = rig("servo_drive", "controller=open_loop", "signal@controller.current=constant",
                "controller.current.offset=0.4")  # fmt: skip
    assert np.all(looped(servo).history.columns("/command")["current"] == 0.4)
    usual = looped(rig("servo_drive", "controller=open_loop")).history.columns("/command")
    assert np.abs(usual["current"]).max() == pytest.approx(0.5 / 2.5 * 5.0)


def test_scales_are_of_travel_force_and_time_and_one_on_small_benches(rig, newtonian):
    scales = state_scales(rig("servo_drive").model)
    assert scales.states == pytest.approx([0.4, 2.0])  # m, m/s: the travel in a time constant
    assert scales.inputs == pytest.approx([5.0])
    assert scales.disturbances == pytest.approx([200.0])
    assert scales.time == pytest.approx(0.2)
    assert np.all(bench_ratios(newtonian).states == 1.0)


def test_a_landing_lasts_as_long_whatever_the_unit_of_the_command(rig, newtonian):
    cart = rig("cart_pole").model
    landing = Landing()
    assert landing.rates(("force",), cart.input_bounds()) == pytest.approx([4.0])  # N/s
    assert farthest_command(cart, landing) == farthest_command(newtonian, landing) == 5.0
    assert Landing(rate=2.0).rates(("force",), cart.input_bounds()) == pytest.approx([2.0])


def test_a_control_period_that_is_long_for_the_model_is_remarked(rig):
    [words] = long_period(rig("cart_pole", "controller=newton_mpc"))
    assert "try controller.sample_time=0.04" in words
    assert not [*long_period(rig("servo_drive", "controller=newton_mpc"))]


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("pitch", "{kp: 1000, ki: 500, kd: 100}", "has no axis 'pitch'"),
        ("operating_points", "[{alpha_v: 0.2}]", "'alpha_v' is not controlled"),
        ("operating_points", "[{posiion: 0.2}]", "did you mean position?"),
        ("operating_points", "[{position: 9}]", "cannot rest at position=9 m"),
    ],
)
def test_pid_refuses_names_that_the_rig_does_not_have(rig, key, value, words):
    composed = rig("servo_drive", "controller=pid", f"controller.{key}={value}")
    with pytest.raises(ConfigurationError) as caught:
        looped(composed)
    assert caught.value.where.startswith(f"controller.{key}")
    assert words in f"{caught.value.problem} {caught.value.remedy}"
