"""What sealed sets hold."""

from collections import Counter

import numpy as np
import pytest

from experiments.gap.blind import severity
from experiments.gap.blind.cases import SETS, plan
from experiments.gap.blind.nominal import relative_sds
from experiments.gap.blind.recording import Timing, record
from experiments.gap.blind.truths import GROUPS, LIBRARY, OUTSIDE, TRUTHS, UNSEEN
from trms_cli.core.resources import config_folder
from trms_cli.gap.diagnosis import LOCATIONS


@pytest.mark.parametrize("name", SETS)
def test_a_set_holds_all_kinds_in_its_shares_and_follows_its_seed(name: str) -> None:
    cases = plan(name, 1)
    assert cases == plan(name, 1) and cases != plan(name, 2)
    assert len(cases) == SETS[name].cases
    kinds = Counter(case.kind for case in cases)
    for kind, share in SETS[name].shares.items():
        assert abs(kinds[kind] - share * len(cases)) <= 2
        assert kinds[kind] > 0


def test_kinds_have_what_they_are_about() -> None:
    for case in plan("development", 5):
        effects = set(case.effects)
        if case.kind in ("null", "offset"):
            assert not effects
            assert bool(case.parameters) == (case.kind == "offset")
            continue
        assert case.locations
        assert set(case.locations) <= set(LOCATIONS)
        assert len(effects) == (2 if case.kind == "pair" else 1)
        assert effects <= set(OUTSIDE if case.kind == "outside" else LIBRARY)
        if case.kind == "unexcited":
            assert case.drive == "poor"
            assert effects <= set(UNSEEN)
        if case.kind == "matched":
            assert case.group in GROUPS


def test_offsets_stay_within_their_priors_and_twins_differ_in_the_effect_alone() -> None:
    twins: dict[int, list] = {}
    for case in (*plan("final", 2), *plan("development", 1)):
        deviations = np.array(list(case.parameters.values()))
        assert set(case.parameters) <= set(relative_sds())
        assert (np.abs(deviations) < 2.6).all()
    for case in plan("development", 1):
        if case.twin:
            twins.setdefault(case.twin, []).append(case)
    assert twins
    for one, other in twins.values():
        assert set(one.effects) != set(other.effects)
        assert one.group == other.group
        for same in ("parameters", "excitation", "centre", "amplitude", "channels", "drive"):
            assert getattr(one, same) == getattr(other, same)


def test_the_final_set_has_what_development_lacks() -> None:
    def seen(name: str) -> tuple[set[str], set[tuple[str, str, float]]]:
        cases = [case for seed in (1, 2, 3) for case in plan(name, seed)]
        outside = {e for case in cases if case.kind == "outside" for e in case.effects}
        forms = {
            (effect, size, value)
            for case in cases
            for effect, sizes in case.effects.items()
            for size, value in sizes.items()
            if size not in TRUTHS[effect].grows
        }
        return outside, forms

    (outside, forms), (final_outside, final_forms) = seen("development"), seen("final")
    assert len(final_outside - outside) >= 2
    assert len({effect for effect, _, _ in final_forms - forms}) > 5
    assert {case.jitter for case in plan("final", 1)} != {case.jitter for case in plan("small", 1)}
    highest = max(case.centre for case in plan("final", 1))
    assert highest <= min(case.centre for case in plan("development", 1))


def test_every_effect_of_the_library_can_be_a_truth_of_any_severity_within_reason() -> None:
    options = {file.stem for file in (config_folder() / "effect").glob("*.yaml")}
    assert options == set(LIBRARY)
    assert set(severity.table()) >= set(TRUTHS)
    assert not set(LIBRARY) & set(OUTSIDE)
    for effect in TRUTHS:
        factors = [severity.factor_of(effect, level) for level in severity.LEVELS]
        assert 0 < factors[0] <= factors[1] <= factors[2] <= severity.LARGEST
        assert (
            severity.levels_reached(effect)
            == tuple(severity.LEVELS)[: len(severity.levels_reached(effect))]
        )


def test_the_file_says_what_its_measured_points_say() -> None:
    for effect, entry in severity.table().items():
        factors, ratios = np.array(entry["measured"]).T
        for level, found in severity.interpolate_levels(factors, ratios).items():
            assert {key: entry[level][key] for key in found} == found
            assert entry[level]["sizes"] == TRUTHS[effect].sized(found["factor"])


def test_sizes_between_measured_ones() -> None:
    factors = np.array([0.5, 1.0, 2.0])
    levels = severity.interpolate_levels(
        factors, np.sqrt(1 + factors**2)
    )  # a gap as large as the size
    for level, ratio in severity.LEVELS.items():
        right = min(np.sqrt(ratio**2 - 1), severity.LARGEST)
        assert levels[level]["factor"] == pytest.approx(right, rel=1e-3)
        assert levels[level]["ratio"] == pytest.approx(np.sqrt(1 + right**2), rel=1e-3)
    # What cannot be reached is not claimed.
    levels = severity.interpolate_levels(np.array([1.0, 3.0]), np.array([1.01, 1.1]))
    assert levels["strong"]["factor"] == severity.LARGEST
    assert levels["strong"]["ratio"] < 1.2


def test_second_recordings_are_others_of_the_same_rigs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.gap.blind.recording._SETTLING", 0.1)
    cases = [case for case in plan("small", 1) if case.drive != "poor"][:3]
    timing = Timing(duration=0.4)
    _, first = record(cases, timing, 1)
    _, again = record(cases, timing, 1)
    _, fresh = record(cases, timing, 1, fresh=True)
    np.testing.assert_array_equal(first.measured, again.measured)
    assert (np.ptp(first.commands - fresh.commands, axis=1) > 0).any()
