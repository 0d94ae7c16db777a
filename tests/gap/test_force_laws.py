"""The closest law and the sentences, on forces whose law is known.

The motion is one free run of a little rig; the forces are formulas of that motion with noise.
"""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter

from trms_cli.gap.force.description import description
from trms_cli.gap.force.laws import ForceRecord, explained_shares, hysteresis

from .recorded import STEP, coloured, moved

SAMPLES = 4000


def lag(values: np.ndarray, time: float) -> np.ndarray:
    share = STEP / time
    return lfilter([0, share], [1, share - 1], values, zi=values[:1])[0]


@cache
def motion() -> ForceRecord:
    """Both axes and both rotors under random steps, also in reverse; no force yet."""
    return moved(np.random.default_rng(5), samples=SAMPLES, lowest=-0.4, hold=100)


def of(location: str, force: np.ndarray, *, seed: int = 0) -> ForceRecord:
    """A force at a place, smoothed by 0.1 s, with noise of a third of it."""
    kernel = np.exp(-0.5 * (np.arange(-15, 16) / 5) ** 2)
    force = np.convolve(force, kernel / kernel.sum(), mode="same")
    sd = 0.3 * float(np.sqrt(np.mean(force**2)))
    noise = sd * coloured(np.random.default_rng(seed), SAMPLES, 0.2)
    return replace(motion(), location=location, force=force + noise, sd=np.full(SAMPLES, sd))


def forces() -> dict[str, tuple[str, str, np.ndarray]]:
    """By a name: the law, its place, and the force."""
    m = motion()
    a, p = m.angles["yaw"], m.angles["pitch"]
    r, q = m.rates["yaw"], m.rates["pitch"]
    wv, wh = m.speeds["main"], m.speeds["tail"]
    u_v, u_h = m.commands["main"], m.commands["tail"]
    cushion = np.exp(-(np.sin(p) + 0.6) / 0.25)
    return {
        "dry": ("sign_of_rate", "yaw_moment", -np.tanh(r / 5e-3)),
        "dry pitch": ("sign_of_rate", "pitch_moment", -np.tanh(q / 5e-3)),
        "damping": ("quadratic_damping", "yaw_moment", -r * np.abs(r)),
        "damping pitch": ("quadratic_damping", "pitch_moment", -q * np.abs(q)),
        "spring": ("cubic_stiffness", "yaw_moment", -a - a**3),
        "cable": ("hysteresis", "yaw_moment", -hysteresis(m, a)[2]),
        "mass": ("imbalance", "pitch_moment", np.cos(p)),
        "delay main": ("input_change", "main_actuator", np.r_[[u_v[0]] * 3, u_v[:-3]] - u_v),
        "delay tail": ("input_change", "tail_actuator", np.r_[[u_h[0]] * 2, u_h[:-2]] - u_h),
        "lag": ("input_change", "tail_actuator", lag(u_h, 0.06) - u_h),
        "dead zone": ("dead_zone", "tail_actuator", -np.clip(u_h, -0.12, 0.12)),
        "derating": ("derating", "main_actuator", -u_v * lag((u_v / 2.5) ** 2, 40.0)),
        "rotor friction": ("rotor_friction", "tail_motor", -np.sign(wh)),
        "exponent": ("thrust", "tail_thrust", wh * np.abs(wh) ** 1.2),
        "reverse": ("reverse_thrust", "main_thrust", wv * np.abs(wv) * (wv < 0)),
        "reaction": ("reaction", "yaw_moment", wv * np.abs(wv) * np.cos(p)),
        "reaction pitch": ("reaction", "pitch_moment", wh * np.abs(wh)),
        "gyroscopic": ("gyroscopic", "pitch_moment", wv * r * np.sin(p + 0.1)),
        "inflow main": ("inflow", "main_thrust", -np.abs(wv) * q),
        "inflow tail": ("inflow", "yaw_moment", -np.abs(wh) * r * np.cos(p)),
        "cushion": ("near_table", "main_thrust", np.maximum(wv, 0) ** 2 * cushion),
        "acceleration": ("spin_up", "main_tacho", -np.gradient(wv, STEP)),
    }


FORCES = forces()


@pytest.mark.parametrize("name", FORCES)
def test_the_law_of_a_force_comes_nearest(name):
    law, location, force = FORCES[name]
    shares = explained_shares(of(location, force))
    assert max(shares, key=shares.__getitem__) == law
    assert shares[law] > (0.65 if name == "mass" else 0.9)


@pytest.mark.parametrize(
    ("name", "law"), [("delay tail", "input_change"), ("dead zone", "dead_zone")]
)
@pytest.mark.parametrize("measured", [True, False])
def test_a_cause_in_the_drive_shows_in_the_moment(name, law, measured):
    """As torque of the thrust that the changed command makes, also without rotor speeds."""
    command = motion().commands["tail"]
    speed, nominal = (lag(200 * u, 0.3) for u in (command + FORCES[name][2], command))
    force = of("yaw_moment", speed * np.abs(speed) - nominal * np.abs(nominal))
    assert explained_shares(force if measured else replace(force, speeds={}))[law] > 0.6


@pytest.mark.parametrize("location", ["yaw_moment", "pitch_moment", "tail_actuator"])
@pytest.mark.parametrize("time", [0.1, 1.0])
def test_no_law_explains_a_force_from_outside(location, time):
    for seed in range(2):
        record = of(location, coloured(np.random.default_rng(seed), SAMPLES, time), seed=seed + 10)
        assert max(explained_shares(record).values()) < 0.3


def test_scaling_changes_no_share():
    record = of("yaw_moment", FORCES["damping"][2])
    scaled = replace(record, force=1e-4 * record.force, sd=1e-4 * record.sd)
    assert explained_shares(scaled) == pytest.approx(explained_shares(record), abs=1e-6)


def test_no_law_is_lost_to_the_units_of_another():
    """A rotor in milliradians a second makes columns a billion times those of the rates."""
    for name in ("damping", "cable", "exponent"):
        law, place, force = FORCES[name]
        record = of(place, force)
        fast = replace(record, speeds={k: 1e3 * v for k, v in record.speeds.items()})
        assert explained_shares(fast)[law] == pytest.approx(explained_shares(record)[law], abs=0.02)
        assert explained_shares(fast)[law] > 0.5


def test_hysteresis_stays_within_one_and_forgets_the_start():
    memory = np.array(hysteresis(motion(), motion().angles["yaw"]))
    assert np.abs(memory).max() <= 1 + 1e-12
    # Rising steadily by many widths it ends at one.
    ramp = np.linspace(0, 5, SAMPLES)
    assert hysteresis(motion(), ramp)[0][-1] == pytest.approx(1, abs=1e-6)


def description_text(record: ForceRecord) -> str:
    return "\n".join(description(record))


def test_friction_is_described():
    text = description_text(of("yaw_moment", 4e-3 * FORCES["dry"][2]))
    assert "opposes the motion" in text and "±0.004 N*m" in text
    assert "the rig's own doing: yaw rate" in text
    assert "dry friction" in text
    assert "constant offset" not in text and "drifts" not in text and "changes for good" not in text


def test_offset_drift_oscillation_and_a_change_are_described():
    m, noise = motion(), 1e-4 * coloured(np.random.default_rng(3), SAMPLES, 0.3)
    plain = replace(m, force=noise, sd=np.full(SAMPLES, 1e-5))
    assert "constant offset of 0.003 N*m" in description_text(replace(plain, force=3e-3 + noise))
    assert "drifts by 0.002 N*m per minute" in description_text(
        replace(plain, force=noise + 2e-3 * m.time / 60)
    )
    assert "oscillates at 4 Hz" in description_text(
        replace(plain, force=noise + 3e-3 * np.sin(8 * np.pi * m.time))
    )
    force = coloured(np.random.default_rng(4), SAMPLES, 0.3) * (motion().time > 40)
    match = re.search(
        r"changes for good at t = ([\d.]+) s", description_text(of("yaw_moment", force))
    )
    assert match is not None and float(match[1]) == pytest.approx(40, abs=1.5)


@pytest.mark.parametrize("seed", range(2))
def test_a_draught_is_described_as_one(seed):
    text = description_text(
        of("yaw_moment", 4e-3 * coloured(np.random.default_rng(seed), SAMPLES, 0.5), seed=seed + 5)
    )
    assert "comes from outside" in text and "No known form" in text
    for absent in ("opposes", "goes with", "offset", "drifts", "changes", "energy lies where"):
        assert absent not in text
    # Noise is called noise.
    record = of("yaw_moment", coloured(np.random.default_rng(0), SAMPLES, 0.5))
    (sentence,) = description(replace(record, sd=np.full(SAMPLES, record.force.std())))
    assert sentence.startswith("Nothing stands out of the noise at yaw_moment")


def test_short_records_and_ones_without_any_motion_are_answered():
    record = of("yaw_moment", FORCES["dry"][2])
    for samples in (1, 3, 20, 100):
        short = record.subset(np.arange(samples))
        assert len(description(short)) >= 1
        assert all(np.isfinite(value) for value in explained_shares(short).values())
    bare = replace(record, angles={}, rates={}, speeds={}, commands={})
    assert "part may be from outside" in description_text(bare)
    assert all(np.isfinite(value) for value in explained_shares(bare).values())
