"""The study of every effect in the loop: its effects, when a reference is still, what is worse."""

import numpy as np
import pytest

from experiments.gap.every_effect import (
    CORRECTED,
    NOMINAL,
    EffectRun,
    comparisons,
    has_been_still,
    library_effects,
    tables,
)


def test_effects_that_explain_something_are_compared() -> None:
    effects = library_effects()
    assert {"yaw_coulomb_friction", "pitch_quantisation", "tail_input_delay"} <= set(effects)
    assert not {"yaw_residual_force", "yaw_model_form", "yaw_constant_torque"} & set(effects)


def test_a_reference_is_still_long_after_a_change_and_not_where_the_next_is_in_view() -> None:
    reference = np.zeros((1000, 2))
    reference[500:, 1] = 1.0
    still = has_been_still(reference, 0.02, previewed=False)
    assert not still[:350].any() and still[350:500].all()  # nobody knows what was before
    assert not still[500:850].any() and still[850:].all()
    ahead = has_been_still(reference, 0.02, previewed=True)
    assert not ahead[300:500].any() and ahead[850:].all()


def _runs(nominal: list[float], corrected: list[float], holding: float = 0.005) -> list[EffectRun]:
    return [
        EffectRun("effect", "pid", "square", model, seed, error, holding)
        for model, errors in ((NOMINAL, nominal), (CORRECTED, corrected))
        for seed, error in enumerate(errors)
    ]


def test_ratios_have_an_interval_over_seeds_and_the_worse_are_told() -> None:
    (one,) = comparisons(_runs([0.1, 0.1], [0.11, 0.112]))
    assert one.ratio == pytest.approx(1.11, abs=0.002) and one.is_worse
    low, high = one.ratio_interval
    assert low < 1.1 and high > 1.12
    (better,) = comparisons(_runs([0.1], [0.09]))
    assert not better.is_worse and np.isnan(better.ratio_interval[0])
    rows = tables([one, better], {("effect", "pid", "square")})
    assert [row[0] for row in rows["every_effect_worse"]] == ["effect", "`effect`"]
    assert rows["every_effect"][1][-1] == "1"
    assert [row[-1] for row in rows["every_effect_worse"]] == ["a diagnosis warns", "yes"]
    assert tables([one], ())["every_effect_worse"][1][-1] == "no"
