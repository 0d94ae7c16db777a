"""A residual without a name: found, told from a draught, put into a formula and into a model."""

import re
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest
import yaml

from tests.gap.recorded import STEP, coloured, effect, moved, recording
from trms_cli.core.plugins import build
from trms_cli.effects.effect import Effect, EffectContext
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.model_file import load_model
from trms_cli.effects.residual import term_names
from trms_cli.gap import belief
from trms_cli.gap import diagnose as diagnosing
from trms_cli.gap.belief import Features, calibration, probabilities_of
from trms_cli.gap.competing_model import nominal_parameters, refit
from trms_cli.gap.diagnosis import Shrink
from trms_cli.gap.flexible import fit_flexible, node_of, short_law
from trms_cli.gap.force.laws import ForceRecord
from trms_cli.gap.force.short_law import short_law_of
from trms_cli.gap.problem import GapProblem, divide
from trms_cli.gap.residuals import locate, smoothed_forces
from trms_cli.gap.shrinkage import Shrinkage
from trms_cli.identification.model_writer import ModelOrigin, model_document
from trms_cli.library.tasks.diagnose import candidates_of
from trms_cli.models.model import Signal
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.parameters import Parameter
from trms_cli.simulation.rollout import Rollout

MODEL = Newtonian()
DETENT = (("yaw_angle_sine_8", 0.0015),)


@dataclass(frozen=True)
class Draught(Effect):
    """A torque on yaw that knows nothing of the rig: many waves of time alone."""

    size: float  #: N m

    def parameters(self) -> tuple[Parameter, ...]:
        return ()

    def states(self) -> tuple[Signal, ...]:
        return (Signal("clock", "s"),)

    def derivative(self, at: EffectContext) -> ca.SX:
        return ca.SX(1)

    def disturbance(self, at: EffectContext) -> ca.SX:
        random = np.random.default_rng(3)
        waves = [
            ca.sin(w * at.own[0] + phase)
            for w, phase in zip(random.uniform(0.3, 2.5, 16), random.uniform(0, 6, 16), strict=True)
        ]
        return at.on("yaw_moment", self.size * ca.sum1(ca.vertcat(*waves)) / np.sqrt(8))


def fitted(rig: dict[str, Effect]):
    """Refit, forces and the flexible competitor on a recording of a minute."""
    dataset = recording(rig, seconds=60.0)
    parts = divide((dataset,), 10.0, 0.2, MODEL.stops)
    free = [p for p in nominal_parameters(MODEL) if p.name in ("k_chp", "k_chn", "k_fhp", "k_oh")]
    nominal = refit(MODEL, free, parts.fitted, parts.block)
    place = locate(nominal, {})
    forces = smoothed_forces(nominal, nominal)
    return nominal, forces, fit_flexible(nominal, place, forces)


@pytest.fixture(scope="module")
def detent():
    return fitted({"yaw_residual_force": effect("yaw_residual_force", terms=DETENT)})


def test_a_detent_is_foretold_and_put_into_a_formula(detent):
    nominal, forces, flexible = detent
    assert flexible.fitted.names == ("yaw_residual_force",)
    assert flexible.score > nominal.fit.score + 50
    assert flexible.foretold > 0.8
    sizes = dict(flexible.effects["yaw_residual_force"].terms)
    assert max(sizes, key=lambda name: abs(sizes[name])) == "yaw_angle_sine_8"
    assert sizes["yaw_angle_sine_8"] == pytest.approx(0.0015, rel=0.1)
    # Priors leave few of the 66 coefficients: those that the data decide.
    own = zip(flexible.fitted.structure.problem.free, flexible.fitted.fit.sd, strict=False)
    decided = sum(1 - (sd / p.prior_sd) ** 2 for p, sd in own if "." in p.name)
    assert decided < 20
    (law,) = short_law(nominal, flexible, forces)
    assert "sin(8 α_h" in law and "N m" in law


def test_the_fitted_residual_is_an_effect_of_a_model_file(detent, tmp_path):
    _, _, flexible = detent
    (name, residual), *_ = flexible.effects.items()
    node = node_of(residual)
    assert build(node, name) == residual
    model = flexible.fitted.model
    base = MODEL
    nominal = {p.name: model.parameters[p.name].value for p in base.parameters}
    document = model_document(
        "rig",
        extend_model(base, {name: residual}),
        ModelOrigin(option="newtonian", effects={name: node}),
        values=nominal,
        deviations={},
        free=(),
        source="a test",
    )
    path = tmp_path / "corrected_model.yaml"
    path.write_text(yaml.safe_dump(document), encoding="utf-8")
    again = load_model(str(path))
    u = recording(seconds=20.0).commands
    free = Rollout(model, STEP)
    start = free.initial(model.rest(), u[0])
    expected = free.outputs(u, [0], [len(u)], start[None]).y
    y = Rollout(again, STEP).outputs(u, [0], [len(u)], start[None]).y
    np.testing.assert_allclose(y, expected, atol=1e-9)


@pytest.mark.slow
def test_a_residual_that_makes_free_runs_worse_is_left_out(monkeypatch):
    assert not Shrinkage({}, {"all": {}}, ()).leaves_more
    for fraction, leaves_more in ((0.3, False), (-0.3, True), (None, False)):
        shrink = {"all": {"2.0": Shrink(fraction=fraction, ci95=None)}}
        assert Shrinkage({}, shrink, ()).leaves_more is leaves_more

    monkeypatch.setattr(diagnosing, "diagnose_onset", lambda problem, watch: None)
    rig = {"yaw_residual_force": effect("yaw_residual_force", terms=DETENT)}
    problem = GapProblem(
        model=MODEL,
        model_name="newtonian",
        datasets=(recording(rig, seconds=50.0),),
        candidates={"main_input_delay": effect("main_input_delay")},
        jobs=1,
        advise=False,
    )
    kept = diagnosing.diagnose(problem)
    assert kept.verdict == "none_of_these" and set(kept.residual) == {"yaw_residual_force"}
    assert not kept.warnings and kept.shrink["all"]["2.0"].fraction > 0.5
    monkeypatch.setattr(Shrinkage, "leaves_more", property(lambda shrinkage: True))
    plain = diagnosing.diagnose(problem)
    assert plain.verdict == "none_of_these" and not plain.residual
    assert plain.shrink["all"]["2.0"].fraction == 0.0
    assert "yaw moment" in plain.warnings[0] and "left out" in plain.warnings[0]


def test_a_draught_is_not_foretold():
    _, _, flexible = fitted({"draught": Draught(0.002)})
    assert flexible.location == "yaw_moment"
    assert flexible.foretold < 0.2


def test_no_gap_needs_no_residual():
    assert fitted({})[2] is None


def features(score: float, flexible: float = np.nan, remaining_gap: float = 0.0) -> Features:
    return Features(
        gained=500.0,
        behind=1000.0,
        names=(("a",),),
        scores=np.array([score]),
        behinds=np.array([remaining_gap]),
        sizes=np.array([1]),
        surprises=np.zeros(1),
        errors=np.ones(1),
        flexible=flexible,
    )


def test_a_name_has_to_reach_the_residual_without_one(monkeypatch):
    monkeypatch.setattr(belief, "LAPSE", 0.0)  # by what the weights say
    constants = calibration().weights
    alone = probabilities_of(features(500.0), constants)
    assert alone["a",] > 0.9
    assert probabilities_of(features(500.0, 450.0), constants)["a",] > 0.9
    beaten = probabilities_of(features(500.0, 700.0), constants)
    assert beaten["none_of_these",] > 0.99
    # One that fails itself is no reason to believe a name that leaves nearly everything.
    probabilities = probabilities_of(features(20.0, -5.0, 980.0), constants)
    assert next(iter(probabilities)) == ("none_of_these",)


def test_a_residual_is_no_candidate_unless_it_is_asked_for():
    everything = candidates_of(("all",), MODEL).effects
    assert "yaw_coulomb_friction" in everything and "yaw_residual_force" not in everything
    effects = candidates_of(("yaw_residual_force", "yaw_dis*"), MODEL).effects
    assert set(effects) == {"yaw_residual_force", "yaw_disturbance"}


@pytest.mark.parametrize("place", ["pitch_moment", "yaw_moment", "main_motor", "pitch_sensor"])
def test_no_term_stands_twice(place):
    terms = term_names(MODEL, place)
    assert len(terms) == len(set(terms)) > 20


def law_of(record: ForceRecord, force: np.ndarray, location: str = "yaw_moment") -> str:
    sd = 0.1 * float(force.std())
    noise = sd * coloured(np.random.default_rng(2), len(force), 0.2)
    noisy = replace(record, location=location, force=force + noise, sd=np.full(len(force), sd))
    return " ".join(short_law_of(noisy))


def test_short_laws_are_told_with_their_sizes():
    record = moved(np.random.default_rng(5), samples=5000)
    yaw, speed = record.angles["yaw"], record.speeds["tail"]
    load = record.commands["tail"] * record.commands["main"] ** 2
    turned = law_of(record, -0.004 * np.sin(6 * yaw + 0.3))
    assert "sin(6 α_h" in turned and " 0.004 N m" in turned and "% of the missing yaw" in turned
    lost = law_of(record, -2e-7 * speed * np.abs(speed) * np.sin(yaw) ** 2)
    assert "−2.0e−07 N m/(rad²/s²) · ω_h|ω_h| sin² α_h" in lost
    # the size itself to a few percent
    assert re.search(
        "−(6.[89]|7.[01])e−04 N m/V³ · u_h u_v²", law_of(record, -7e-4 * load, "tail_motor")
    )
    caught = law_of(record, -0.01 * np.sign(yaw) * np.maximum(np.abs(yaw) - 0.5, 0))
    assert "beyond |α_h|" in caught
    assert law_of(record, coloured(np.random.default_rng(7), 5000, 0.5)) == ""
