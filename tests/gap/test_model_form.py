"""A model whose own laws are of another form: told, and causes weighed beside them."""

import pytest

from tests.gap.recorded import effect, recording
from trms_cli.gap.beginning import begins_at
from trms_cli.gap.competing_model import nominal_parameters, refit
from trms_cli.gap.diagnosis import LawDeparture
from trms_cli.gap.model_form import departures, leads, refit_with_free_form
from trms_cli.gap.problem import applicable_candidates, divide, with_noise
from trms_cli.gap.race import Effort, Race, run_race
from trms_cli.gap.signatures import effect_traces
from trms_cli.gap.wording import laws_in_words
from trms_cli.models.newtonian import Newtonian

MODEL = Newtonian()
NAMES = (
    "tail_input_delay",
    "pitch_mass_imbalance",
    "yaw_quadratic_damping",
    "yaw_coulomb_friction",
    "yaw_cable_stiffness",
)
EFFORT = Effort(4, 3, 2, 3)
LAWS = {
    "pitch_model_form": effect("pitch_model_form", damping=-0.15, thrust=0.06, inertia=0.08),
    "yaw_model_form": effect("yaw_model_form", damping=-0.15, spring=-0.05, inertia=-0.08),
}


def raced(rig, seconds=60.0):
    """The plain race, the model with free laws, and the race beside these."""
    dataset = with_noise(recording(rig, seconds=seconds, values={"k_fvp": 1.66e-5}, seed=3))
    candidates, _ = applicable_candidates(MODEL, {name: effect(name) for name in NAMES})
    parts = divide((dataset,), 10.0, 0.25, MODEL.stops)
    nominal = refit(MODEL, nominal_parameters(MODEL), parts.fitted, parts.block)
    traces = effect_traces(nominal, list(candidates.values()))
    plain = run_race(nominal, candidates, traces, EFFORT)
    laws = refit_with_free_form(plain)
    beside = None if laws is None else run_race(laws.nominal, candidates, traces, EFFORT)
    return plain, laws, beside


def best(race: Race):
    return max(race.entries, key=lambda entry: entry.fit.score)


@pytest.mark.slow
def test_a_cause_is_found_beside_laws_of_another_form():
    """Without free laws three effects that mimic them explain the recording better than it does."""
    delay = effect("tail_input_delay", delay=0.05)
    plain, laws, beside = raced(LAWS | {"tail_input_delay": delay})
    assert len(best(plain).names) > 1
    assert laws is not None and beside is not None and leads(beside, plain)
    assert best(beside).names == ("tail_input_delay",) and begins_at(best(beside)) is None
    assert best(beside).values["tail_input_delay.delay"] == pytest.approx(0.05, rel=0.05)
    law_departures = departures(best(beside))
    true_values = {f"{n}.{p.name}": p.value for n, law in LAWS.items() for p in law.parameters()}
    assert law_departures.keys() == true_values.keys()
    for name in ("pitch_model_form.inertia", "yaw_model_form.damping", "yaw_model_form.spring"):
        law = law_departures[name]
        assert law.value == pytest.approx(true_values[name], abs=max(4 * law.sd, 0.01))
        assert abs(law.value) > 4 * law.sd
    words = laws_in_words(law_departures)
    assert any(
        w.startswith("yaw damping goes with a lower power of the rate (by 0.1") for w in words
    )
    assert any(w.startswith("yaw is pulled back") and "% less at 1 rad" in w for w in words)


def test_laws_that_are_the_model_s_are_left_alone():
    plain, laws, beside = raced({"tail_input_delay": effect("tail_input_delay", delay=0.05)}, 50.0)
    assert best(plain).names == ("tail_input_delay",)
    assert laws is None or (beside is not None and not leads(beside, plain))
    assert departures(best(plain)) == {}
    small = LawDeparture(value=0.01, sd=0.001, unit="1", words="hardly")
    assert laws_in_words({"yaw_model_form.damping": small}) == []
