"""Why not the others: bounds from traces, and reasons in words."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trms_cli.gap.diagnosis import NotTestable, SizeEstimate
from trms_cli.gap.rejection import inclusion, rejected_effects, upper_bound
from trms_cli.gap.signatures import Signatures


def traces(rows: dict[str, tuple[float, float, float]]) -> Signatures:
    """One row an effect: its size, what is left of its trace, and where that points."""
    size, projected_energy, towards = (
        np.array(column) for column in zip(*rows.values(), strict=True)
    )
    sizes = tuple(np.array([value]) for value in size)
    return Signatures(
        tuple(rows), sizes, projected_energy, projected_energy, towards, np.eye(len(rows))
    )


def candidate(name: str, lower: float = 0.0, upper: float = 1.0, simulated: bool = True) -> Any:
    free = SimpleNamespace(name=f"{name}.size", unit="N*m", lower=lower, upper=upper)
    return SimpleNamespace(name=name, free=(free,), simulated=simulated)


def entry(names: tuple[str, ...], score: float) -> Any:
    fit = SimpleNamespace(score=score, predictive=np.array([score]))
    sizes = {f"{name}.size": SizeEstimate(value=0.004, sd=0.001, unit="N*m") for name in names}
    return SimpleNamespace(names=names, fit=fit, sizes=sizes)


@pytest.mark.parametrize(
    ("row", "lower", "bound"),
    [
        ((0.01, 100.0, 200.0), 0.0, 0.01 * (2 + 0.1645)),  # well above zero: as a normal law
        ((0.01, 100.0, 0.0), 0.0, 0.01 * 0.196),  # half of a normal law
        ((0.01, 100.0, -1000.0), 0.0, 0.01 * 0.001 * 2.9957),  # far on the other side: exponential
        ((-0.01, 100.0, -200.0), -1.0, 0.01 * (2 + 0.1645)),  # of its amount, where it has a sign
        ((0.01, 1e-4, 0.0), 0.0, 1.0),  # nothing bounds what the recordings do not show
    ],
)
def test_the_upper_bound_is_a_quantile(row, lower, bound) -> None:
    estimate = upper_bound(traces({"x": row}), candidate("x", lower))
    assert estimate is None if bound == 1.0 else estimate == pytest.approx(bound, rel=0.02)


def test_each_suspect_has_its_reason_and_the_nearest_comes_first() -> None:
    names = ("friction", "stribeck", "damping", "lag", "wrong", "hidden", "draught")
    rows = dict.fromkeys(names[:4], (0.01, 100.0, 50.0))
    rows |= {"wrong": (0.01, 100.0, -50.0), "hidden": (0.01, 1.0, 0.1)}
    signs = traces(rows)
    entries = [
        entry(("friction",), 500.0), entry(("stribeck",), 499.0), entry(("damping",), 300.0),
        entry(("damping", "friction"), 502.0),
    ]  # fmt: skip
    refit = SimpleNamespace(fit=SimpleNamespace(predictive=np.array([0.0])))
    race: Any = SimpleNamespace(refit=refit, entries=entries, signatures=signs, tight=signs)
    probabilities = {("friction",): 0.9, ("stribeck",): 0.1, ("draught",): 0.0}
    posterior: Any = SimpleNamespace(
        probabilities=probabilities, confusable=(("friction", "stribeck"),), verdict="effect"
    )
    candidates = {n: candidate(n, simulated=n != "draught") for n in names}
    unseen = [NotTestable(effect="hidden", reason="was not excited"),
              NotTestable(effect="known", reason="the nominal model has it already")]  # fmt: skip
    rejections = rejected_effects(race, posterior, candidates, signs, unseen)
    reasons = {row.effect: row.reason for row in rejections}
    assert list(reasons)[:2] == ["stribeck", "damping"] and "friction" not in reasons
    assert reasons["stribeck"].startswith("not told apart from friction: explains as much")
    assert reasons["damping"] == "explains 200 nats less than friction, and adds nothing beside it"
    assert reasons["lag"].startswith("its trace explains at most 12 nats of what friction leaves")
    assert reasons["wrong"] == "its trace points the other way than what friction leaves"
    assert reasons["hidden"] == "was not excited"
    assert reasons["known"] == "the nominal model has it already"
    assert "comes and goes" in reasons["draught"]
    by = {row.effect: row for row in rejections}
    assert by["stribeck"].score == 499.0 and by["stribeck"].size is not None
    # What is not told apart from the answer is bounded alone, what is rejected beside the answer.
    assert by["stribeck"].upper_bound == pytest.approx(0.004 + 1.645 * 0.001)
    assert by["damping"].upper_bound == pytest.approx(0.01 * (0.5 + 0.1645), rel=0.02)
    assert by["lag"].score is None and by["lag"].unit == "N*m"


def test_beside_what_was_not_fitted_nothing_is_judged() -> None:
    signs = traces({"damping": (0.01, 100.0, 50.0), "lag": (0.01, 100.0, 50.0)})
    refit = SimpleNamespace(fit=SimpleNamespace(predictive=np.array([0.0])))
    entries = [entry(("damping",), 300.0)]
    race: Any = SimpleNamespace(refit=refit, entries=entries, signatures=signs, tight=signs)
    features = SimpleNamespace(names=(("damping",),), behind=1000.0, behinds=np.array([800.0]))
    posterior: Any = SimpleNamespace(
        probabilities={("draught",): 0.6, ("none_of_these",): 0.4},
        confusable=(), verdict="effect", features=features,
    )  # fmt: skip
    rejections = rejected_effects(
        race, posterior, {n: candidate(n) for n in ("damping", "lag")}, signs, ()
    )
    # the fit's own bound: there is nothing beside which it could be smaller
    assert rejections[0].upper_bound == pytest.approx(0.004 + 1.645 * 0.001)
    assert [row.reason for row in rejections] == [
        "explains 300 nats more than other parameters alone and leaves 80 % of the gap",
        "its trace explains at most 12 nats of what the refitted model leaves",
    ]


def test_an_effect_is_part_of_all_answers_that_hold_it() -> None:
    probabilities = inclusion({("a", "b"): 0.5, ("none_of_these",): 0.2, ("b",): 0.2, ("c",): 0.1})
    assert probabilities == {"b": pytest.approx(0.7), "a": 0.5, "c": 0.1}
    assert list(probabilities) == ["b", "a", "c"]
