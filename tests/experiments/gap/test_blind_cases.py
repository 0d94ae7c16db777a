"""What sealed sets hold."""

from collections import Counter

import numpy as np
import pytest

from experiments.gap.blind import severity
from experiments.gap.blind.cases import Case, plan
from experiments.gap.blind.nominal import relative_sds
from experiments.gap.blind.nuisances import curved_laws, draw_nuisances, imperfect_laws
from experiments.gap.blind.recording import Timing, record, references_of
from experiments.gap.blind.sets import SETS
from experiments.gap.blind.truths import (
    FINAL_SET_ONLY,
    GROUPS,
    LIBRARY,
    OUTSIDE,
    SUDDEN,
    TRUTHS,
    UNSEEN,
    same_equation,
)
from trms_cli.core.resources import config_folder
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.rig_parts import diagram_rows, parts_of


@pytest.mark.parametrize("name", SETS)
def test_a_set_holds_all_kinds_in_its_shares_and_follows_its_seed(name: str) -> None:
    cases = plan(name, 1)
    assert cases == plan(name, 1) and cases != plan(name, 2)
    assert len(cases) == SETS[name].cases
    kinds = Counter(case.kind for case in cases)
    whole = sum(SETS[name].shares.values())
    for kind, share in SETS[name].shares.items():
        assert abs(kinds[kind] - share / whole * len(cases)) <= 2
        assert kinds[kind] > 0


def test_kinds_have_what_they_are_about() -> None:
    rows = diagram_rows(parts_of(Newtonian()))
    places_of_the_rig = {place for row in rows for place in row.places.values()}
    for case in plan("development", 5):
        effects = set(case.effects)
        if case.kind in ("null", "offset"):
            assert not effects
            assert bool(case.parameters) == (case.kind == "offset")
            continue
        if case.kind == "against":
            assert case.references and case.standing and not set(case.standing) & effects
            assert len(effects) + len(case.moved) <= 1
            continue
        assert case.locations
        assert set(case.locations) <= places_of_the_rig
        assert len(effects) == {"pair": 2, "triple": 3}.get(case.kind, 1)
        places = [{p for at in TRUTHS[e].locations for p in same_equation(at)} for e in effects]
        assert len(set().union(*places)) == sum(map(len, places))
        assert effects <= set(OUTSIDE if case.kind == "outside" else LIBRARY)
        if case.kind == "unexcited":
            assert case.drive == "poor"
            assert effects <= set(UNSEEN)
        if case.kind == "matched":
            assert case.group in GROUPS
        if case.kind == "onset":
            ((effect, begins),) = case.onset.items()
            assert effect in SUDDEN and effects == {effect}
            assert 0.25 * case.duration < begins < 0.75 * case.duration
        else:
            assert not case.onset


def test_nuisances_are_drawn_for_each_rig_and_twins_share_them() -> None:
    cases = plan("final", 4)
    drawn = [case.nuisances for case in cases]
    noise = np.array([n["speed_noise"] for n in drawn])
    assert len({tuple(n.values()) for n in drawn}) == len(cases)
    assert noise.min() < 0.6 and noise.max() > 2.5
    assert {n["pitch_quantum"] for n in drawn} >= {0.25, 4.0}
    assert max(n["drift"] for n in drawn) > 0.015
    # an encoder that is coarser than the usual and than the other is an effect
    for case in cases:
        quanta = [case.nuisances[f"{axis}_quantum"] for axis in ("pitch", "yaw")]
        assert max(quanta) <= 1.0 or quanta[0] == quanta[1]
        if any(effect.endswith("_quantisation") for effect in case.effects):
            assert max(quanta) <= 1.0
    lengths = np.array([case.duration for case in cases])
    assert lengths.min() >= 20 and lengths.max() <= 600
    assert 0.02 < (lengths >= 300).mean() < 0.09 and 0.04 < (lengths <= 40).mean() < 0.16
    for kind in ("null", "pair", "outside"):
        assert {case.drive for case in cases if case.kind == kind} <= {"rich", "closed_loop"}
    assert {case.kind for case in cases if case.drive == "closed_loop"} > {"single", "pair"}
    for case in plan("imperfect", 1):
        assert case.imperfect and abs(case.nuisances["pitch_inertia"] - 1) == pytest.approx(0.08)
    assert not any(case.imperfect for case in cases)
    for case in plan("imperfect_curves", 1):
        assert case.imperfect and abs(case.nuisances["viscous_curve"]) == pytest.approx(0.25)
        assert 0.99 <= case.nuisances["pitch_inertia"] <= 1.01


def test_rigs_that_are_compared_differ_from_their_references_in_one_thing() -> None:
    cases = [case for case in plan("final", 4) if case.kind == "against"]
    changes = Counter(
        "effect" if case.effects else "parameter" if case.moved else "nothing" for case in cases
    )
    assert len(cases) == 30 and min(changes[c] for c in ("effect", "parameter", "nothing")) >= 6
    for case in cases:
        references = references_of(case)
        assert 1 <= len(references) == case.references <= 3
        assert len({c.excitation for c in (case, *references)}) == len(references) + 1
        for one in references:
            assert not one.effects and not one.moved
            for same in ("standing", "parameters", "nuisances", "drive", "channels", "duration"):
                assert getattr(one, same) == getattr(case, same)


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
        for same in (
            *("parameters", "excitation", "centre", "amplitude", "channels", "drive"),
            *("nuisances", "duration"),
        ):
            assert getattr(one, same) == getattr(other, same)


def test_the_final_set_has_what_development_lacks() -> None:
    def outside_and_forms(name: str) -> tuple[set[str], set[tuple[str, str, float]]]:
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

    (outside, forms), (final_outside, final_forms) = (
        outside_and_forms("development"),
        outside_and_forms("final"),
    )
    assert final_outside - outside >= set(FINAL_SET_ONLY)
    assert len(final_outside) >= 20 and len(outside) >= 12
    for name in set(SETS) - {"final"}:
        assert not set(SETS[name].outside) & set(FINAL_SET_ONLY)
    assert len({effect for effect, _, _ in final_forms - forms}) > 5
    highest = max(case.centre for case in plan("final", 1))
    assert highest <= min(case.centre for case in plan("development", 1))


def test_every_effect_of_the_library_can_be_a_truth_of_any_severity_within_reason() -> None:
    files = (config_folder() / "effect").glob("*.yaml")
    apart = ("_residual_", "_constant_torque", "_model_form")
    options = {file.stem for file in files if not any(word in file.stem for word in apart)}
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
        for level, figures in severity.interpolate_levels(factors, ratios).items():
            assert {key: entry[level][key] for key in figures} == figures
            assert entry[level]["sizes"] == TRUTHS[effect].sized(figures["factor"])


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
    for one, same, other in zip(first, again, fresh, strict=True):
        np.testing.assert_array_equal(one.measured, same.measured)
        assert np.ptp(one.commands - other.commands) > 0


def test_recordings_are_as_long_as_each_case_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.gap.blind.recording._SETTLING", 0.1)
    monkeypatch.setattr("experiments.gap.blind.recording._TOGETHER", (0.5, np.inf))
    lengths = (0.4, 0.8, 0.2, 0.6)
    cases = [Case(kind="null", duration=length, excitation=3) for length in lengths]
    simulated_cases, recordings = record(cases, Timing(), 1)
    assert [len(r.time) for r in recordings] == [20, 40, 10, 30]
    assert [case.duration for case in simulated_cases] == list(lengths)
    # the same commands, however long they last together
    np.testing.assert_array_equal(recordings[2].commands, recordings[0].commands[:10])
    short_cases, (short,) = record(cases[:1], Timing(duration=0.2), 1)
    assert len(short.time) == 10 and short_cases[0].duration == 0.2


#: Sizes that do not grow and act all the same, so large that they would show.
_LARGE = {"main_reaction_on_yaw": {"inertia": 5e-3}}


@pytest.mark.slow
def test_an_effect_begins_at_its_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.gap.blind.recording._SETTLING", 0.1)
    quiet = {"drift": 0.0, "jitter": 0.0}
    plain = Case(kind="null", duration=1.6, nuisances=quiet, excitation=3)
    cases = [
        Case(
            kind="onset",
            effects={effect: LIBRARY[effect].sized(3.0, **{**form, **_LARGE.get(effect, {})})},
            onset={effect: 0.8},
            duration=1.6,
            nuisances=quiet,
            excitation=3,
        )
        for effect in SUDDEN
        for form in ({}, *LIBRARY[effect].variants)
    ]
    _, (none, *begun) = record([plain, *cases], Timing(), 1)
    for case, then in zip(cases, begun, strict=True):
        apart = np.abs(none.measured - then.measured)[:, :2] > 1e-3
        (effect,) = case.effects
        assert not apart[:40].any(), effect
        assert apart[40:].any() or effect.endswith("supply_derating"), effect  # which is slow
    later = cases[0]
    (effect,) = later.effects
    shorter, _ = record([later], Timing(duration=0.8), 1)
    assert shorter[0].onset[effect] == 0.4
    # on a second recording it is there all the time
    _, (fresh,) = record([later], Timing(), 1, fresh=True)
    always = Case(kind="single", effects=later.effects, duration=1.6, nuisances=quiet, excitation=3)
    _, (same,) = record([always], Timing(), 1, fresh=True)
    np.testing.assert_array_equal(fresh.measured, same.measured)


@pytest.mark.slow
def test_each_nuisance_and_each_effect_outside_changes_what_is_seen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("experiments.gap.blind.recording._SETTLING", 0.1)
    usual = {"drift": 0.0, "jitter": 0.0, "flexibility": 0.0}
    names = tuple(draw_nuisances(np.random.default_rng(1)))
    assert set(names) > set(imperfect_laws(np.random.default_rng(1)))
    names += tuple(curved_laws(np.random.default_rng(1)))
    effects = {
        "yaw_coulomb_friction": {"torque": 0.01},
        "pitch_quadratic_damping": {"coefficient": 0.2},
        "yaw_cable_hysteresis": {"torque": 0.02, "width": 0.1},
        "tail_rotor_friction": {"torque": 0.002},
    }
    nuisance_values = {"drift": 0.3, "jitter": 8e-4, "flexibility": 0.6, "speed_noise": 3.0}
    nuisance_values |= {"angle_noise": 0.01, "damping_exponent": 1.5, "thrust_exponent": 0.1}
    nuisance_values |= {"cable_hardening": 5.0, "viscous_exponent": 0.7}
    nuisances = [{}] + [{n: nuisance_values.get(n, 0.5)} for n in names if n != "drift_time"]
    nuisances.append({"drift": 0.3, "drift_time": 1.0})
    cases = [
        Case(kind="single", effects=effects, duration=3.0, nuisances=usual | n) for n in nuisances
    ]
    cases += [
        Case(
            kind="outside",
            effects={e: OUTSIDE[e].sized(10.0)},
            duration=3.0,
            nuisances=usual,
            excitation=7,
        )
        for e in OUTSIDE
    ]
    cases.append(Case(kind="null", duration=3.0, nuisances=usual, excitation=7))
    _, recordings = record(cases, Timing(), 1)
    first, last, count = recordings[0], recordings[-1], len(nuisances)
    for nuisance, recording in zip(nuisances[1:], recordings[1:count], strict=True):
        assert (recording.measured != first.measured).any(), nuisance
    # in the first seconds the one rests, and the other has not been reached
    slow = {"pitch_sensor_drift", "pitch_encoder_hangs", "tail_early_limit", "main_early_limit"}
    slow |= {"yaw_one_way_damping", "pitch_one_way_damping"}
    for effect, recording in zip(OUTSIDE, recordings[count:], strict=False):
        noise = np.array([1e-3, 1e-3, 10, 10])
        apart = (np.abs(recording.measured - last.measured) > noise).any()
        assert apart or effect in slow, effect
