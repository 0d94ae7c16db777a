"""What a correction gains in the loop."""

from dataclasses import replace

import numpy as np
import pytest

from trms_cli.composition.composer import compose
from trms_cli.effects.extended_model import extend_model
from trms_cli.gap.diagnosis import LoopGain
from trms_cli.gap.worth import (
    _gain as judged,
)
from trms_cli.gap.worth import (
    gain_in_words,
    judged_references,
    loops_of,
    reference_words,
    sine_within,
    warning_of,
    worth_of,
)
from trms_cli.library.tasks.experiment import experiment_of
from trms_cli.models.newtonian import Newtonian

from .recorded import recording

NOISE = {"alpha_v": 4.4e-4, "alpha_h": 4.4e-4}


def test_the_reference_stays_in_the_range_of_the_recordings() -> None:
    dataset = recording(seconds=20.0)
    sines = sine_within([dataset], ("alpha_v", "alpha_h"))
    for i, (axis, most) in enumerate((("alpha_v", 0.3), ("alpha_h", 0.5))):
        amplitude, offset = sines[axis]
        low, high = np.quantile(dataset.measurements[:, i], [0.05, 0.95])
        assert 0.05 <= amplitude <= most
        assert low - 0.06 <= offset - amplitude and offset + amplitude <= high + 0.06
    # An angle that was not recorded has none.
    blind = replace(dataset, measurements=np.full_like(dataset.measurements, np.nan))
    assert sine_within([blind], ("alpha_v",)) == {}


def test_a_gain_in_words() -> None:
    before, after = {"alpha_v": 0.0044, "alpha_h": 0.0062}, {"alpha_v": 0.0040, "alpha_h": 0.0027}
    text = gain_in_words(before, after, NOISE, "newton_mpc")
    assert "pitch 4.4 → 4 mrad (about the same) and yaw 6.2 → 2.7 mrad (56 % less)" in text
    assert "make up for" in gain_in_words(before, before, NOISE, "newton_mpc")
    worse = gain_in_words(after, before, NOISE, "newton_mpc")
    assert "2.7 → 6.2 mrad (130 % more)" in worse and "does not suit" in worse


@pytest.mark.parametrize("wrong", [True, False])
def test_a_model_that_is_off_tracks_worse_than_the_rig_s_own(wrong) -> None:
    words = ["model=newtonian", "controller=newton_mpc", "ref=sine", "sim.duration=14",
             "ref.alpha_h.frequency=0.1", "ref.alpha_v.frequency=0.1"]  # fmt: skip
    experiment = experiment_of(compose(words).config)
    before = Newtonian(parameters={"k_fhp": 1.2e-6, "k_oh": 0.03} if wrong else {})
    worth = worth_of(experiment, before, controller="newton_mpc", command="trms run")
    assert worth is not None and worth.command == "trms run"
    if wrong:
        assert worth.after["alpha_h"] < 0.5 * worth.before["alpha_h"]
    else:
        assert worth.after == worth.before and "make up for" in worth.words


def _gain(controller: str, reference: str, before: float, after: float, worse: bool) -> LoopGain:
    return LoopGain(
        controller=controller, reference=reference, before=before, after=after, is_worse=worse
    )


def test_a_loop_that_the_correction_makes_worse_is_named_with_what_to_use() -> None:
    fine = _gain("newton_mpc", "rest", 0.005, 0.002, False)
    worse = _gain("pid", "rest", 0.012, 0.016, True)
    text = warning_of([fine, worse])
    assert "pid at rest 12 → 16 mrad" in text and "use controller=newton_mpc with it (2)" in text
    assert "keep the model as it was" in warning_of([worse])
    assert warning_of([fine]) == ""
    refused = _gain("pid", "sine", 0.1, np.inf, True)
    assert "pid on a sine cannot control with it: keep the model as it was" in warning_of([refused])


def test_a_loop_is_worse_where_its_errors_grow_for_sure_also_below_the_noise() -> None:
    def growing(*growth: float) -> LoopGain:
        return judged("pid", "sine", 0.004 * np.array([[1.0, 1 + g] for g in growth]), 0.001)

    assert growing(0.05, 0.06, 0.055).is_worse and not growing(0.05, 0.06, 0.055).is_visible
    assert not growing(0.10, -0.05, 0.05).is_worse  # by chance
    assert not growing(0.01, 0.011, 0.012).is_worse  # by too little
    assert growing(0.8).is_worse and growing(0.8).is_visible
    assert not growing(0.3).is_worse  # of one noise
    assert growing(np.inf).is_worse
    text = warning_of([growing(0.05, 0.06, 0.055)])
    assert "4 → 4.2 mrad (less than its sensors' noise)" in text


def test_loops_are_judged_on_a_sine_and_on_squares_and_at_rest() -> None:
    sines = {"alpha_v": (0.2, 0.0), "alpha_h": (0.5, -0.1)}
    assert reference_words("square", sines, 0.1) == [
        "ref=square", "ref.alpha_v.frequency=0.1", "ref.alpha_v.amplitude=0.2",
        "ref.alpha_h.frequency=0.1", "ref.alpha_h.offset=-0.1",
    ]  # fmt: skip
    common = ["model=newtonian", "controller=pid", "sim.duration=30"]
    experiments = {
        ("pid", name): experiment_of(compose([*common, *words]).config)
        for name, words in judged_references(sines, "pid").items()
    }
    gains = loops_of(experiments, Newtonian(parameters={"k_fhp": 1.2e-6, "k_oh": 0.03}))
    assert [(g.controller, g.reference) for g in gains] == [
        ("pid", "sine"), ("pid", "square"), ("pid", "rest"), ("pid", "limited_square"),
    ]  # fmt: skip
    assert all(0 < g.after < 1 and 0 < g.before < 1 for g in gains)
    _, whole, rest, limited = gains
    assert rest.after < 0.3 * whole.after and limited.after < 0.3 * whole.after
    preview = {"newton_mpc": True, "pid": False}
    for controller, known_ahead in preview.items():
        words = judged_references(sines, controller)["limited_square"]
        assert ("controller.preview_horizon=40" in words) == known_ahead


def test_a_controller_that_the_corrected_model_does_not_suit_is_worse_with_it() -> None:
    """A cable's memory is a mode that no input moves, and lqr refuses it."""
    words = [
        "effect=[yaw_cable_hysteresis]",
        "controller=lqr",
        "ref=sine",
        "sim.duration=12",
    ]
    experiment = experiment_of(compose(words).config)
    corrected = replace(experiment, model=extend_model(Newtonian(), experiment.plant.effects))
    (gain,) = loops_of({("lqr", "sine"): corrected}, Newtonian())
    assert gain.is_worse and gain.after == np.inf and 0 < gain.before < 1
