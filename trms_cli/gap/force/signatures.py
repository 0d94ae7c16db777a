"""How strongly a force bears the mark of each known family of laws, and the short list from it.

The score of a family is the share of the force's energy, its noise apart, that a regression on the
family's columns explains, less what as many columns explain by chance. Three readings of it are
taken and the most generous counts: of the whole energy, of the variation about the mean, and of
what is left beside the nuisance columns, since a refit has taken those out already. A short list is
meant to keep every true cause, not to name it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from trms_cli.gap.force.families import FAMILIES, Seen, nuisance
from trms_cli.gap.force.record import (
    FloatArray,
    ForceRecord,
    correlation_time,
    sample_time,
    segments,
    thinned,
)

#: Hz, of the regressions.
_RATE = 25.0
#: Hz above which lie flexible modes and quanta.
FAST = 1.5
#: Largest part of an energy that is taken for noise: of the whole, and of what a refit leaves.
_MOST_NOISE, _MOST_NOISE_LEFT = 0.8, 0.5
#: s, of kernels that the columns may be put through, as the force was.
_SMOOTHERS = (0.1, 0.25)
#: Largest share that is put down to chance: a list that is generous rather keeps.
_MOST_CHANCE = 0.4
#: Relative ridge that keeps columns that say the same from an exact tie.
_RIDGE = 1e-7
#: Of an effect none of whose places has a record: neither for it nor against it.
UNSEEN = 0.5

_ROTOR = {"pitch": "main", "yaw": "tail"}


@dataclass(frozen=True)
class _Reading:
    """Inner products of the columns of all families, of unit energy, with the force."""

    gram: FloatArray
    product: FloatArray
    energy: float
    noise: float
    chance: float  #: share that one column explains of anything

    def share(self, columns: list[int]) -> float:
        if self.energy <= 0 or not columns:
            return 0.0
        gram = self.gram[np.ix_(columns, columns)]
        product = self.product[columns]
        explained = product @ np.linalg.solve(gram + _RIDGE * np.eye(len(columns)), product)
        chance = min(self.chance * len(columns), _MOST_CHANCE)
        share = (explained / self.energy - chance) / (1 - chance)
        return float(np.clip(share / (1 - self.noise), 0.0, 1.0))


class Judge:
    """Regressions of one force on any family; the inner products are computed once."""

    def __init__(self, record: ForceRecord) -> None:
        self.record = thinned(record, _RATE)
        at = Seen(self.record)
        columns: list[FloatArray] = []
        self._of: dict[str, list[int]] = {}
        for name, family in FAMILIES.items():
            own = [c for c in family(at) if np.any(c)]
            self._of[name] = list(range(len(columns), len(columns) + len(own)))
            columns += own
        phi = np.column_stack(columns)
        force = self.record.force
        self._readings = [
            self._reading(phi, force, _MOST_NOISE),
            self._reading(phi - phi.mean(axis=0), force - force.mean(), _MOST_NOISE),
            self._beside_nuisance(phi, nuisance(at)),
        ]
        # Little may be left beside the nuisance columns; what a smoother did to them shows then.
        self._readings += [
            self._beside_nuisance(_all_smoothed(at, phi, sd), _all_smoothed(at, nuisance(at), sd))
            for sd in _SMOOTHERS
        ]

    def _beside_nuisance(self, phi: FloatArray, level: FloatArray) -> _Reading:
        level, _ = np.linalg.qr(level / (np.linalg.norm(level, axis=0) + 1e-300))
        force = self.record.force
        return self._reading(
            phi - level @ (level.T @ phi), force - level @ (level.T @ force), _MOST_NOISE_LEFT
        )

    def _reading(self, phi: FloatArray, force: FloatArray, most_noise: float) -> _Reading:
        size = np.linalg.norm(phi, axis=0)
        # What the projection took away entirely must not come back as rounding.
        unit = np.where(size > 1e-6 * size.max(), phi / np.maximum(size, 1e-300), 0.0)
        energy = float(force @ force)
        noise = float(np.sum(self.record.sd**2))
        duration = force.size * sample_time(self.record)
        memory = correlation_time(self.record, force, power=2)
        return _Reading(
            gram=unit.T @ unit,
            product=unit.T @ force,
            energy=energy,
            noise=min(noise / energy, most_noise) if energy > 0 else 0.0,
            chance=min(memory / duration, 0.2),
        )

    def share(self, *families: str) -> float:
        """Share that these families together explain, 0 to 1, in the most generous reading."""
        columns = [column for name in families for column in self._of[name]]
        return max(reading.share(columns) for reading in self._readings)

    def share_of_variation(self, *families: str) -> float:
        """The same of the variation about the mean alone."""
        columns = [column for name in families for column in self._of[name]]
        return self._readings[1].share(columns)

    def t_value(self, family: str) -> float:
        """Of a family's first column beside the nuisance ones; its sign is the coefficient's."""
        reading, own = self._readings[2], self._of[family][:1]
        if not own or reading.energy <= 0:
            return 0.0
        r = float(reading.product[own[0]] / np.sqrt(reading.energy))
        freedom = max(1 / reading.chance - 2, 1.0)
        return float(r * np.sqrt(freedom / max(1 - r**2, 1e-9)))

    def fast_share(self) -> float:
        """Share of the energy above :data:`FAST`, the noise apart."""
        force = self.record.force - self.record.force.mean()
        fast = total = 0.0
        for part in segments(self.record):
            power = np.abs(np.fft.rfft(force[part])) ** 2
            frequency = np.fft.rfftfreq(part.stop - part.start, sample_time(self.record))
            fast, total = fast + power[frequency > FAST].sum(), total + power.sum()
        noise = self._readings[1].noise
        if total <= 0:
            return 0.0
        return float(np.clip((fast / total - noise) / (1 - noise), 0.0, 1.0))

    def above_noise(self) -> float:
        """Share of the energy that is not noise."""
        return 1 - self._readings[0].noise if self._readings[0].energy > 0 else 0.0


def _all_smoothed(at: Seen, columns: FloatArray, sd: float) -> FloatArray:
    return np.column_stack([at.smoothed(column, sd) for column in columns.T])


def signatures(record: ForceRecord) -> dict[str, float]:
    """Marks of the known families on one force.

    Returns
    -------
    dict of str to float
        By family (see :mod:`trms_cli.gap.force.families`) the share of energy, 0 to 1, which may
        overlap; ``fast``: the share above :data:`FAST`; ``sign_of_rate_t``: the t-value of the
        sign of the rate beside the nuisance columns, negative for friction.
    """
    judge = Judge(record)
    found = {name: judge.share(name) for name in FAMILIES}
    found["fast"] = judge.fast_share()
    found["sign_of_rate_t"] = judge.t_value("sign_of_rate")
    return found


def shortlist(records: Mapping[str, ForceRecord]) -> dict[str, float]:
    """Score of each effect of the library on the forces at its places.

    Parameters
    ----------
    records : dict of str to ForceRecord
        By location: each as if the whole gap lay there.

    Returns
    -------
    dict of str to float
        0 to 1 by canonical name, the largest over the places at which the effect shows.
        :data:`UNSEEN` where none of them has a record, and at least that for quantisation. Under
        a force from outside scores stay below about 0.25, but for a disturbance and a flexible
        mode. They overlap; none is a probability.
    """
    judges = {place: Judge(record) for place, record in records.items()}

    def best(places: tuple[str, ...], *families: str) -> float:
        shares = [judges[place].share(*families) for place in places if place in judges]
        return max(shares, default=UNSEEN)

    def fast(places: tuple[str, ...]) -> float:
        return max((judges[p].fast_share() for p in places if p in judges), default=UNSEEN)

    found: dict[str, float] = {}
    for axis, rotor in _ROTOR.items():
        moment = (f"{axis}_moment", f"{rotor}_thrust")
        drive = (f"{rotor}_actuator", f"{rotor}_motor", f"{rotor}_thrust", f"{axis}_moment")
        sensor = (f"{axis}_sensor",)
        found |= {
            f"{axis}_coulomb_friction": best(moment, "sign_of_rate", "rest"),
            f"{axis}_stribeck_friction": best(moment, "sign_of_rate", "rest", "stribeck"),
            f"{axis}_quadratic_damping": best(moment, "quadratic_damping"),
            f"{rotor}_input_delay": best(drive, "input_change"),
            f"{rotor}_actuator_lag": best(drive, "input_change"),
            f"{rotor}_dead_zone": best(drive, "dead_zone"),
            f"{rotor}_supply_derating": best(drive, "derating"),
            f"{rotor}_rotor_friction": best(drive, "rotor_friction"),
            f"{rotor}_thrust_curve": best(moment, "thrust", "thrust_exponent", "reverse_thrust"),
            f"{rotor}_inflow": best(moment, "inflow"),
            f"{axis}_sensor_bias": best((*sensor, moment[0]), "constant", "imbalance"),
            f"{axis}_sensor_delay": best(sensor, "motion"),
            # Rounding is white; a smoothed force shows little of it.
            f"{axis}_quantisation": max(fast(sensor), UNSEEN),
            f"{rotor}_tacho_lag": best((f"{rotor}_tacho",), "spin_up"),
            # It rings, and lags behind accelerations.
            f"{axis}_flexible_mode": max(
                fast((*sensor, *moment)), best((*sensor, moment[0]), "inertia")
            ),
            f"{axis}_disturbance": max(
                (judges[place].above_noise() for place in moment if place in judges),
                default=UNSEEN,
            ),
        }
    yaw, pitch = ("yaw_moment", "tail_thrust"), ("pitch_moment", "main_thrust")
    found |= {
        "yaw_cable_stiffness": best(yaw, "constant", "stiffness", "cubic_stiffness"),
        "yaw_cable_hysteresis": best(yaw, "hysteresis"),
        "pitch_mass_imbalance": best(pitch, "imbalance", "inertia"),
        "main_reaction_on_yaw": best(yaw, "reaction"),
        "tail_reaction_on_pitch": best(pitch, "reaction"),
        "gyroscopic_coupling": best((*yaw, *pitch), "gyroscopic"),
        "ground_effect": best(pitch, "near_table"),
    }
    return found
