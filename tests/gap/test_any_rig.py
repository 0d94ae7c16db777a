"""Diagnoses of rigs with names of their own: a servo drive, and a cart-pole that falls over."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from trms_cli.core.chart import RigDiagram
from trms_cli.effects.extended_model import ExtendedModel
from trms_cli.effects.residual import ResidualForce, term_names
from trms_cli.gap import competing_model
from trms_cli.gap.competing_model import nominal_parameters, refit
from trms_cli.gap.diagnose import diagnose
from trms_cli.gap.force.description import description, regions
from trms_cli.gap.force.laws import ForceRecord, explained_shares
from trms_cli.gap.force.short_law import short_law_of
from trms_cli.gap.free_runs import expected_errors
from trms_cli.gap.problem import (
    GapProblem,
    finest_step,
    horizons_of,
    poor_excitation,
    quantum_of,
)
from trms_cli.gap.worth import reference_words, sine_within
from trms_cli.identification.dataset import Dataset
from trms_cli.library.tasks.diagnose import candidates_of
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.rig_parts import BEAM, diagram_rows, parts_of
from trms_cli.models.scales import longest_run
from trms_cli.reporting.rig_diagram import diagram

EXAMPLES = Path(__file__).parents[2] / "examples"
sys.path[:0] = [str(EXAMPLES / "servo_drive"), str(EXAMPLES / "cart_pole")]

from cart_pole.model import CartPole  # noqa: E402
from servo_drive.model import ServoDrive  # noqa: E402

STEP, SUBSTEPS = 0.01, 20
SERVO, POLE = ServoDrive(), CartPole()


def levels(random: np.random.Generator, samples: int, size: float) -> np.ndarray:
    holds = random.integers(10, 70, samples // 10)
    return np.repeat(random.uniform(-size, size, len(holds)), holds)[:samples]


def servo_recording(seconds: float, friction: float, seed: int = 1) -> Dataset:
    """Random levels of current and a weak loop; friction is set-valued at rest."""
    random = np.random.default_rng(seed)
    samples, h = round(seconds / STEP), STEP / SUBSTEPS
    asked, x, v = levels(random, samples, 2.0), 0.0, 0.0
    u, y = np.zeros(samples), np.zeros(samples)
    for k in range(samples):
        y[k] = 1e-5 * np.round((x + 2e-5 * random.standard_normal()) / 1e-5)
        u[k] = asked[k] - 3.0 * y[k]
        for _ in range(SUBSTEPS):
            free = v + h * (40.0 * u[k] - 60.0 * v) / 12.3
            before, v = v, np.sign(free) * max(abs(free) - h * friction / 12.3, 0.0)
            x += h * (v + before) / 2
    return recording(SERVO, u, y[:, None], [3e-5])


def pole_recording(
    seconds: float, friction: float, seed: int = 1, spring: float = 0.0, scale: float = 1.0
) -> Dataset:
    """Held upright by a feedback of its states, whose rates are differences of readings.

    ``spring``: at the joint, N m/rad. ``scale``: of the encoder of the angle.
    """
    random = np.random.default_rng(seed)
    samples, h = round(seconds / STEP), STEP / SUBSTEPS
    gain = np.array([-20.0, -14.5, -64.4, -10.6])  # places the poles left of -3
    x, rates, before = np.array([0.0, 0.0, 0.02, 0.0]), np.zeros(2), np.array([0.0, 0.02])
    moves, pushes = levels(random, samples, 0.06), levels(random, samples, 0.6)
    u, readings = np.zeros(samples), np.zeros((samples, 2))
    for k in range(samples):
        y = np.array([x[0], scale * x[2]]) + np.array([1e-4, 3e-4]) * random.standard_normal(2)
        rates, before = 0.6 * rates + 0.4 * (y - before) / STEP, y
        readings[k] = y
        u[k] = -gain @ np.array([y[0] - moves[k], rates[0], y[1], rates[1]]) + pushes[k]
        for _ in range(SUBSTEPS):
            _, v, angle, rate = x
            coupling = 0.045 * np.cos(angle)
            mass = np.linalg.inv(np.array([[0.95, coupling], [coupling, 0.0135]]))
            forces = [u[k] - 2.0 * v + 0.045 * np.sin(angle) * rate**2]
            gravity = 0.15 * 9.81 * 0.3 * np.sin(angle)
            forces.append(gravity - spring * angle - 0.002 * rate)
            after = np.array([v, rate]) + h * mass @ np.array(forces)
            impulse = np.clip(-after[0] / mass[0, 0], -h * friction, h * friction)
            after += mass[:, 0] * impulse
            x += h * np.array([(v + after[0]) / 2, 0.0, (rate + after[1]) / 2, 0.0])
            x[[1, 3]] = after
    assert np.abs(readings[:, 1]).max() < 0.3, "it fell"
    return recording(POLE, u, readings, [1e-4, 3e-4])


def recording(model, u: np.ndarray, y: np.ndarray, noise: list[float]) -> Dataset:
    return Dataset(
        "rig", "rig.csv", "0" * 64, STEP, STEP * np.arange(len(u)), model.inputs, model.outputs,
        u[:, None], y, np.array(noise),
    )  # fmt: skip


def drive_recording(seconds: float, friction: float, offset: float, seed: int) -> Dataset:
    """An industrial drive in its position loop, from rest to rest; a constant force acts on it."""
    random, samples, fine = np.random.default_rng(seed), round(seconds / 0.005), 5
    goals = np.zeros(samples)
    place, k = 0.0, 0
    while k < samples:
        goal, moving = random.uniform(-0.12, 0.12), int(random.integers(160, 400))
        s = np.linspace(0.0, 1.0, moving)
        path = place + (goal - place) * s**3 * (10 - 15 * s + 6 * s**2)
        resting = np.full(int(random.integers(20, 120)), goal)
        move = np.concatenate([path, resting])[: samples - k]
        goals[k : k + len(move)] = move
        place, k = goal, k + len(move)
    x, v, before, rate, h = 0.0, 0.0, 0.0, 0.0, 0.005 / fine
    u, y = np.zeros(samples), np.zeros(samples)
    for k, goal in enumerate(goals):
        y[k] = 1e-6 * np.round(x / 1e-6)
        rate, before = 0.5 * rate + 0.5 * (y[k] - before) / 0.005, y[k]
        u[k] = np.clip(40.0 * (goal - y[k]) - 4.0 * rate, -10.0, 10.0)
        for _ in range(fine):
            free = v + h * (35.4 * u[k] + offset - 209.0 * v) / 92.0
            last, v = v, np.sign(free) * max(abs(free) - h * friction / 92.0, 0.0)
            x += h * (v + last) / 2
    drive = replace(recording(SERVO, u, y[:, None], [1e-6]), sample_time=0.005)
    return replace(drive, time=0.005 * np.arange(samples))


def answer_of(model, dataset: Dataset, *candidates: str, effort="quick"):
    problem = GapProblem(
        model=model, model_name=model.name, datasets=(dataset,), effort=effort, advise=False,
        candidates=candidates_of(candidates or ("all",), model).effects, jobs=1,
    )  # fmt: skip
    return diagnose(problem)


def test_friction_of_a_servo_drive_is_told_in_newton():
    names = ("carriage_coulomb_friction", "carriage_quadratic_damping", "current_delay")
    answer = answer_of(SERVO, servo_recording(40.0, 10.0), *names)
    assert answer.verdict == "effect" and answer.where[0].location == "carriage_force"
    top = answer.causes[0]
    size = top.parameters["carriage_coulomb_friction.torque"]
    assert top.effects == ("carriage_coulomb_friction",) and top.probability > 0.9
    assert size.unit == "N" and size.value == pytest.approx(10.0, rel=0.1)
    assert (
        "carriage Coulomb friction causes it" in answer.sentence and "force 9." in answer.sentence
    )
    assert "N m" not in answer.sentence and not answer.excitation


@pytest.mark.slow
def test_a_servo_drive_without_a_gap_has_no_effect():
    answer = answer_of(SERVO, servo_recording(60.0, 0.0), effort="normal")
    assert answer.verdict in ("no_gap", "parameters_only")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("friction", "offset", "seed"), [(21.0, -2.6, 100), (8.0, -3.7, 4), (21.5, -4.84, 1)]
)
def test_friction_is_named_where_a_constant_force_beside_it_makes_others_fit_better(
    friction, offset, seed
):
    """A dead zone with a lag looks more like friction with an offset than friction alone does."""
    drive = ServoDrive(parameters={"M": 93.0, "K": 35.0, "F_v": 200.0})
    answer = answer_of(drive, drive_recording(25.0, friction, offset, seed), effort="normal")
    best = answer.causes[0]
    assert set(best.effects) == {"carriage_coulomb_friction", "current_bias"}
    assert best.probability > 0.8
    sizes = [best.parameters[f"{name}.{size}"].value for name, size in (
        ("carriage_coulomb_friction", "torque"), ("current_bias", "bias")
    )]  # fmt: skip
    assert sizes == pytest.approx([friction, offset / 35.4], rel=0.1)


@pytest.mark.slow
def test_friction_of_a_cart_whose_pole_falls_over():
    answer = answer_of(POLE, pole_recording(60.0, 0.5), effort="normal")
    top = answer.causes[0]
    assert answer.verdict == "effect" and answer.where[0].location == "cart_force"
    assert set(top.effects) <= {"cart_coulomb_friction", "cart_stribeck_friction"}
    assert set(answer.gap["angle"]) == {"0.1", "0.5"} and "at 0.5 s" in answer.sentence
    assert answer.shrink["all"]["0.5"].fraction > 0.8


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rig", "cause"),
    [({"spring": 0.055}, "joint_stiffness"), ({"scale": 1.15}, "angle_scale")],
)
def test_what_does_the_same_to_the_motion_is_told_apart_by_the_parameters(rig, cause):
    """Upright, a spring or a wrong scale of either encoder are one, with other parameters each."""
    names = ("joint_stiffness", "angle_scale", "position_scale")
    answer = answer_of(POLE, pole_recording(40.0, 0.0, **rig), *names)
    assert answer.causes[0].effects == (cause,)
    assert answer.causes[0].probability > 0.5


@pytest.mark.parametrize(("score", "kept"), [(1.0, False), (3.0, True)])
def test_the_better_of_a_fit_and_that_in_its_own_metric_is_kept(monkeypatch, score, kept):
    """Of friction on a cart the second was 50 nats worse, and a spring was told beside it."""
    own = SimpleNamespace(fit=SimpleNamespace(score=score))
    monkeypatch.setattr(competing_model, "_alternating_fit", lambda *_, **__: own)
    metric = SimpleNamespace(discrepancy=None, shares=None)
    structure = SimpleNamespace(problem=SimpleNamespace(model=SERVO))
    before = SimpleNamespace(metric=metric, structure=structure, fit=SimpleNamespace(score=2.0))
    assert (competing_model.FittedModel.in_own_metric(before) is own) is kept
    structure.problem.model = Newtonian()  # a bench is weighed as it ended
    assert competing_model.FittedModel.in_own_metric(before) is own


def test_a_zero_within_a_step_is_a_nuisance_where_the_motion_hangs_on_it():
    def fitted(model, dataset: Dataset, step: float, zero: float, quanta=None):
        rounded = step * np.round(dataset.measurements / step)
        rounded[:, -1] += zero
        dataset = replace(dataset, measurements=rounded)
        return refit(model, nominal_parameters(model), (dataset,), 0.5, quanta=quanta)

    step = 5e-4
    pole, zero = pole_recording(40.0, 0.0), 0.4 * step
    plain, shifted, biased = (fitted(POLE, pole, step, value) for value in (0.0, zero, 3 * step))
    # gravity tells where the angle is zero; of the cart's place nothing does
    assert shifted.metric.drift.zeros == pytest.approx([step / np.sqrt(12)], rel=1e-3)
    assert shifted.fit.gains[-1] - plain.fit.gains[-1] == pytest.approx(zero, rel=0.1)
    assert abs(plain.fit.gains[-1]) < 0.2 * step
    assert biased.fit.gains[-1] == pytest.approx(step)  # the rest is an effect
    # a zero is set by the step that is declared, though a finer one is read
    declared = fitted(POLE, pole, step, 3 * step, {"angle": 8 * step})
    assert declared.metric.drift.zeros == pytest.approx([8 * step / np.sqrt(12)])
    assert declared.fit.gains[-1] - plain.fit.gains[-1] == pytest.approx(3 * step, rel=0.1)
    servo = fitted(SERVO, servo_recording(20.0, 0.0), 1e-5, 0.0)
    assert len(servo.metric.drift.zeros) == 0


def test_runs_of_what_falls_over_are_short():
    assert longest_run(SERVO) == np.inf and longest_run(Newtonian()) == np.inf
    assert horizons_of(SERVO) == (0.1, 0.5, 2.0, 10.0)
    # e^3.5-fold by √((M + m) g/(M l)) = 6.2 1/s, slowed a little by the cart's friction
    assert 0.5 < longest_run(POLE) < 0.62 and horizons_of(POLE) == (0.1, 0.5)


def test_the_floor_of_what_falls_over_grows_with_the_horizon_as_its_errors_do():
    dataset = pole_recording(12.0, 0.0)
    floor = expected_errors(POLE, [dataset], [(0, 600, 1200)], horizons=horizons_of(POLE))
    angle = {horizon: errors.rms for horizon, errors in floor["angle"].items()}
    assert 2e-4 < angle[0.1] < 1e-3 and angle[0.1] < angle[0.5] < 0.02


def servo_record() -> ForceRecord:
    """Dry friction on a motion that is given."""
    random = np.random.default_rng(4)
    time = STEP * np.arange(6000)
    rate = 0.2 * np.cumsum(random.standard_normal((6, 6000)), axis=1).mean(axis=0) * 0.05
    rate += 0.2 * np.sin(3.0 * time)
    force = -8.0 * np.tanh(rate / 0.005)
    return ForceRecord(
        location="carriage_force", unit="N", time=time, recording=np.zeros(6000, dtype=np.int64),
        force=force + random.standard_normal(6000), sd=np.ones(6000), parts=parts_of(SERVO),
        angles={"carriage": STEP * np.cumsum(rate)}, rates={"carriage": rate},
        commands={"current": random.standard_normal(6000)},
    )  # fmt: skip


def test_a_force_is_described_by_the_models_own_words():
    record = servo_record()
    assert list(record.variables) == ["carriage position", "carriage velocity", "current command"]
    assert (record.axis, record.kind, record.drive) == ("carriage", "moment", "current")
    shares = explained_shares(record)
    assert max(shares, key=shares.get) == "sign_of_rate" and shares["thrust"] == 0.0
    text = " ".join((*description(record, 0.9), *short_law_of(record)))
    assert "sign of the carriage velocity (dry friction)" in text and "sgn velocity" in text
    assert "per metre of travel" in text and "positions, velocities and commands" in text
    text += " ".join(region.condition for region in regions(record))
    assert not [word for word in ("rad", "pitch", "yaw", "rotor", " V") if word in text]


def test_parts_of_the_beam_are_those_of_its_models():
    parts = parts_of(Newtonian())
    assert (parts.tilting, parts.beam) == (BEAM.tilting, BEAM.beam) == ("pitch", "pitch")
    assert dict(parts.axes) == dict(BEAM.axes) and dict(parts.drives) == dict(BEAM.drives)
    assert parts.axis_at("main_motor") == "pitch" and parts.kind_of("main_motor") == "motor"
    assert (
        parts.rate_symbol("yaw") == "Ω_h" and parts_of(SERVO).rate_symbol("carriage") == "velocity"
    )


def test_the_diagram_has_the_places_of_the_model():
    servo, cart = (diagram_rows(parts_of(model)) for model in (SERVO, POLE))
    assert [list(row.places.values()) for row in servo] == [
        ["current_actuator", "carriage_force", "carriage_sensor"]
    ]
    assert [row.places.get("moment") for row in cart] == ["cart_force", "joint_torque"]
    assert [(row.command, row.output) for row in cart] == [("force", "position"), ("", "angle")]
    texts = [t.get_text() for t in diagram(RigDiagram("rig", {}, (), "", cart)).axes[0].texts]
    assert {"joint torque", "cart sensor", "position", "angle"} <= set(texts)


def test_a_residual_of_any_axis_has_terms_of_the_models_own_variables():
    names = term_names(SERVO, "carriage_force")
    assert "carriage_velocity_sign" in names and "current_command_cube" in names
    assert not [name for name in names if "sine" in name]  # nothing turns
    assert "joint_angle_sine_3" in term_names(POLE, "joint_torque")
    effect = ResidualForce(equation="carriage_force", terms=(("carriage_velocity_sign", -8.0),))
    assert ExtendedModel(SERVO, "carriage_residual_force", effect).n_x == 2


def test_scales_of_what_is_read_off_a_recording():
    values = 1e-7 * np.round(1e7 * 1e-4 * np.random.default_rng(0).standard_normal(2000))
    assert quantum_of(values, "m") == pytest.approx(1e-7, rel=1e-6)
    assert quantum_of(values) == 0.0  # of an angle, these are digits
    long = replace(servo_recording(1.0, 0.0), sample_time=0.001)
    assert finest_step(SERVO, [long]) < 0.001 < finest_step(Newtonian(), [long])
    resting = replace(long, measurements=np.full((len(long), 1), 0.1))
    (words,) = poor_excitation(SERVO, [resting])
    assert "carriage is held at one point (0.1 m" in words and "a force on such an axis" in words


def test_a_reference_within_what_was_recorded():
    dataset = servo_recording(4.0, 0.0)
    sines = sine_within([dataset], ("position",))
    low, high = np.quantile(dataset.measurements, (0.05, 0.95))
    assert sines["position"][0] == pytest.approx((high - low) / 2, rel=0.05)
    assert f"ref.position.amplitude={sines['position'][0]:g}" in reference_words("sine", sines)
