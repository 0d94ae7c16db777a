"""Nuisances of rigs, drawn: no two benches have the same noise, encoders, drives and laws.

Names and units are those of :class:`.rig.Nuisances`.
"""

from __future__ import annotations

import numpy as np

Random = np.random.Generator

#: Steps of encoders, as multiples of 2π/4096: 1024 to 16384 a turn, alike on both axes.
_ALIKE = (4.0, 2.0, 1.0, 1.0, 1.0, 0.5, 0.25)
#: Steps where each axis has its own: one that is coarser than the usual *and* than the other axis'
#: is what the library calls quantisation, and would be no nuisance.
_OWN = (1.0, 1.0, 0.5, 0.25)
#: Largest standard deviation of a drive's wander: one that wanders by up to 3 %.
_DRIFT = 0.03 / np.sqrt(2)


def draw_nuisances(random: Random) -> dict[str, float]:
    """Sensors, sampling, drives and forms of laws of one rig.

    Noise is 0.5 to 3 times the usual, encoders have 1024 to 16384 steps a turn, drives wander by up
    to 3 %. The laws of the nominal model are off by less than a weak effect.
    """

    def between(low: float, high: float) -> float:
        return float(random.uniform(low, high))

    def octaves(low: float, high: float) -> float:
        return float(np.exp(random.uniform(np.log(low), np.log(high))))

    slow = bool(random.uniform() < 0.5)
    white = bool(random.uniform() < 0.5)
    pitch, yaw = random.choice(_OWN, 2)
    if random.uniform() < 0.6:
        pitch = yaw = random.choice(_ALIKE)
    nuisances = {
        "jitter": octaves(2e-5, 8e-4),
        "drift": between(0.0, _DRIFT),
        "drift_time": octaves(10.0, 100.0) if slow else 0.0,
        "flexibility": between(0.05, 0.6),
        "speed_noise": octaves(0.5, 3.0),
        "speed_quantum": octaves(0.25, 2.0),
        "angle_noise": between(0.0, 4e-4) if white else 0.0,
        "pitch_quantum": float(pitch),
        "yaw_quantum": float(yaw),
        "bend": octaves(5e-5, 1e-3),
        "stick": between(0.0, 0.12),
        "slip_spread": between(0.7, 1.3),
        "damping_exponent": between(1.85, 2.15),
        "rub_speed": octaves(0.2, 2.0),
        "viscous_exponent": between(0.97, 1.03),
        "thrust_exponent": between(-0.01, 0.01),
        "cable_hardening": between(-0.015, 0.015),
        "pitch_inertia": between(0.99, 1.01),
        "yaw_inertia": between(0.99, 1.01),
    }
    return {name: float(f"{value:.4g}") for name, value in nuisances.items()}


def imperfect_laws(random: Random, share: float = 1.0) -> dict[str, float]:
    """Laws that the nominal model does not have: what every real rig's model errs by.

    Friction and thrust follow other powers, the cable hardens, moments of inertia are 8 % off.
    ``share``: of all that.
    """

    def signed(size: float) -> float:
        return float(random.choice([-1.0, 1.0])) * size * share

    laws = {
        "viscous_exponent": 1 + signed(0.15),
        "thrust_exponent": signed(0.06),
        "cable_hardening": signed(0.05),
        "pitch_inertia": 1 + signed(0.08),
        "yaw_inertia": 1 + signed(0.08),
    }
    return {name: float(f"{value:.4g}") for name, value in laws.items()}


def curved_laws(random: Random) -> dict[str, float]:
    """Laws that no other power of the nominal ones describes, and of which it knows nothing.

    Friction, thrust, the cable and the rotors' drag are larger at rest and smaller far out, or the
    other way round.
    """
    sizes = {"viscous_curve": 0.25, "thrust_curve": 0.12, "drag_curve": 0.12, "cable_curve": 0.1}
    return {name: float(random.choice([-1.0, 1.0])) * size for name, size in sizes.items()}


def draw_duration(random: Random) -> float:
    """s: mostly one to two minutes, one in ten 20 to 40 s, one in twenty 5 to 10 minutes."""
    lot = random.uniform()
    low, high = (300, 600) if lot < 0.05 else (20, 40) if lot < 0.15 else (60, 120)
    return float(random.integers(low, high + 1))
