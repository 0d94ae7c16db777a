"""What commands the blind rigs: excitation in open loop, or a controller that knows no model."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from experiments.gap.blind.rig import Driver

FloatArray = npt.NDArray[np.float64]

#: V. Commands of the main rotor lie around that which holds the beam a little below level.
MAIN_CENTRE = 1.25
#: Hz. Lowest and highest line of an excitation.
_BAND = (0.02, 1.2)
_LINES = 24


class OpenLoop:
    """A table of commands.

    Parameters
    ----------
    commands : (n, k, 2) array
        V, by rig and sample.
    """

    def __init__(self, commands: FloatArray) -> None:
        self._commands = commands

    def command(self, k: int, time: float, measured: FloatArray) -> FloatArray:
        """See :class:`experiments.gap.blind.rig.Driver`."""
        return self._commands[:, k]


def rich_excitation(
    seeds: list[int],
    samples: int,
    sample_time: float,
    *,
    centre: float = MAIN_CENTRE,
    amplitude: float = 1.0,
) -> FloatArray:
    """Sums of sines with random phases and held random levels; the tail rotor turns round often.

    Parameters
    ----------
    centre : float
        V, of the main rotor.
    amplitude : float
        Of both rotors; with 1 the yaw axis comes near its stops.

    Returns
    -------
    (n, samples, 2) array
    """
    time = sample_time * np.arange(samples)
    tables = []
    for seed in seeds:
        random = np.random.default_rng(seed)
        columns = []
        for middle, waves, levels in ((centre, 0.25, 0.2), (0.0, 0.45, 0.45)):
            lines = np.exp(random.uniform(np.log(_BAND[0]), np.log(_BAND[1]), _LINES))
            phases = random.uniform(0, 2 * np.pi, _LINES)
            tones = np.sin(2 * np.pi * np.outer(time, lines) + phases).sum(axis=1)
            random_levels = _levels(random, samples, sample_time)
            scale = waves / np.sqrt(_LINES / 2)
            columns.append(middle + amplitude * (scale * tones + levels * random_levels))
        tables.append(np.stack(columns, axis=1))
    return np.array(tables)


def poor_excitation(
    seeds: list[int], samples: int, sample_time: float, *, centre: float = MAIN_CENTRE
) -> FloatArray:
    """Hardly any: the main rotor near one speed, the tail rotor forward only, both slowly."""
    time = sample_time * np.arange(samples)
    tables = []
    for seed in seeds:
        random = np.random.default_rng(seed)
        phases = random.uniform(0, 2 * np.pi, 2)
        slow = [np.sin(2 * np.pi * 0.03 * time + phase) for phase in phases]
        tables.append(np.stack([centre + 0.08 * slow[0], 0.5 + 0.1 * slow[1]], axis=1))
    return np.array(tables)


def _levels(random: np.random.Generator, samples: int, sample_time: float) -> FloatArray:
    """Levels in [−1, 1], each held for 1 to 5 s."""
    values = np.empty(samples)
    at = 0
    while at < samples:
        length = round(random.uniform(1.0, 5.0) / sample_time)
        values[at : at + length] = random.uniform(-1, 1)
        at += length
    return values


class MixedDrivers:
    """Each rig by a driver of its own, so that all run at once.

    Parameters
    ----------
    parts : list of (array of int, Driver)
        Which rigs, and what commands them; each rig once.
    """

    def __init__(self, parts: list[tuple[npt.NDArray[np.int64], Driver]]) -> None:
        self._parts = parts

    def command(self, k: int, time: float, measured: FloatArray) -> FloatArray:
        """See :class:`experiments.gap.blind.rig.Driver`."""
        commands = np.empty((len(measured), 2))
        for rigs, driver in self._parts:
            commands[rigs] = driver.command(k, time, measured[rigs])
        return commands


class CascadedPid:
    """Squares followed by two PIDs with filtered rates: what a lab has before it has a model.

    Parameters
    ----------
    references : (n, k, 2) array
        Pitch and yaw, rad.
    sample_time : float
        s.
    """

    _PROPORTIONAL = np.array([0.5, 2.5])  # V/rad
    _INTEGRAL = np.array([0.35, 0.6])  # V/(rad s)
    _DERIVATIVE = np.array([1.5, 2.0])  # V s/rad
    _FILTER = 0.08  # s

    def __init__(self, references: FloatArray, sample_time: float) -> None:
        self.references = references
        self._sample_time = sample_time
        self._sum = np.zeros((len(references), 2))
        self._rate = np.zeros((len(references), 2))
        self._angle: FloatArray | None = None

    def command(self, k: int, time: float, measured: FloatArray) -> FloatArray:
        """See :class:`experiments.gap.blind.rig.Driver`."""
        angle = measured[:, :2]
        if self._angle is not None:
            share = self._sample_time / (self._FILTER + self._sample_time)
            difference = (angle - self._angle) / self._sample_time
            self._rate = self._rate + share * (difference - self._rate)
        self._angle = angle.copy()
        error = self.references[:, k] - angle
        u = self._PROPORTIONAL * error + self._INTEGRAL * self._sum - self._DERIVATIVE * self._rate
        u = u + np.array([MAIN_CENTRE, 0.0])
        inside = np.abs(u) < 2.5  # the integral waits while the drive is at its limit
        self._sum = self._sum + self._sample_time * error * inside
        return u


def square_references(seeds: list[int], samples: int, sample_time: float) -> FloatArray:
    """Random levels of pitch and yaw, held for 6 to 12 s, (n, samples, 2) rad."""
    tables = []
    for seed in seeds:
        random = np.random.default_rng(seed)
        columns = []
        for centre, span in ((-0.15, 0.3), (0.0, 0.7)):
            values = np.empty(samples)
            at = 0
            while at < samples:
                length = round(random.uniform(6.0, 12.0) / sample_time)
                values[at : at + length] = centre + span * random.uniform(-1, 1)
                at += length
            columns.append(values)
        tables.append(np.stack(columns, axis=1))
    return np.array(tables)
