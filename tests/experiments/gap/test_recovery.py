"""Effects that the diagnosis did not recover of their own simulation, by rigs of other code."""

from collections.abc import Sequence

import pytest

from experiments.gap.blind.truths import LIBRARY
from experiments.gap.recovery import (
    FACTORS,
    Recovery,
    cases_of,
    main,
    study,
    table_of,
    write_recordings,
)


def test_an_effect_is_recovered_where_size_and_score_are_the_rigs():
    def one(effect: str = "yaw_sensor_delay", **changed: object) -> Recovery:
        fit_fields = {"factor": 1.0, "size": 0.05, "estimate": 0.052, "sd": 1e-4, "score": 50.0}
        verdict_fields = {"is_named": True, "verdict": "effect"}
        return Recovery(effect, **(fit_fields | verdict_fields | changed))  # type: ignore[arg-type]

    assert one().recovered
    assert not one(estimate=0.06).recovered and one(estimate=0.06, sd=0.004).recovered
    assert not one(score=3.0).recovered
    assert not one(estimate=None, sd=None, score=None).recovered
    # noise is recovered where it is named, and a rig's other law has another size
    assert one("yaw_disturbance", estimate=None).recovered
    assert not one("yaw_disturbance", is_named=False).recovered
    assert one("yaw_cable_hysteresis", estimate=0.08).recovered
    assert "1 of 2 recovered" in table_of([one(), one(score=3.0)])
    assert len(cases_of(list(LIBRARY), seed=1)) == len(FACTORS) * len(LIBRARY) == 117
    with pytest.raises(SystemExit, match="2"):
        main(["nowhere", "yaw_friction"])


SEED = 20
#: At their typical sizes these hardly show in two minutes (a drive that warms up loses no more than
#: gains wander by): their sizes come out, or nothing is claimed.
HARDLY_VISIBLE = (
    "tail_supply_derating",
    "tail_inflow",
)


#: A quick diagnosis does not look long enough for these.
NEEDS_NORMAL_EFFORT = ("pitch_flexible_mode",)
#: Of two effects that differ in their axis or rotor alone, one is tried here; all of them with
#: ``python -m experiments.gap.recovery``.
TWINS = {"yaw": "pitch", "main": "tail"}


def _has_twin(name: str) -> bool:
    side, _, law = name.partition("_")
    return side in TWINS and f"{TWINS[side]}_{law}" in LIBRARY


@pytest.mark.slow
def test_every_law_is_recovered_of_its_own_simulation(tmp_path, capsys):
    late = "yaw_sensor_delay"  # at three sizes
    one_of_twins = [name for name in LIBRARY if not _has_twin(name)]
    # rigs are simulated in step with each other: all at once takes hardly longer than one
    cases = cases_of(one_of_twins, SEED, (1.0,)) | cases_of([late], SEED)
    write_recordings(cases, tmp_path / "recordings", SEED)

    def recoveries(names: list[str], factors: Sequence[float], effort: str) -> list[Recovery]:
        options = {"race": False, "seed": SEED, "jobs": 2}
        return study(tmp_path, names, factors=factors, effort=effort, **options)

    quick = [name for name in one_of_twins if name not in NEEDS_NORMAL_EFFORT]
    singles = recoveries(quick, (1.0,), "quick")
    singles += recoveries(list(NEEDS_NORMAL_EFFORT), (1.0,), "normal")
    assert {one.effect for one in singles} == set(one_of_twins)
    missed = [
        one
        for one in singles
        if not one.recovered
        and not (one.effect in HARDLY_VISIBLE and (one.near or not one.is_named))
    ]
    assert not missed, table_of(missed)
    sizes = recoveries([late], FACTORS, "quick")
    assert [one.factor for one in sizes] == list(FACTORS)
    assert all(one.recovered and one.is_named for one in sizes)
    # what is there is only read
    assert main([str(tmp_path), late, "--effort", "quick"]) == 0
    assert "3 of 3 recovered" in capsys.readouterr().out
