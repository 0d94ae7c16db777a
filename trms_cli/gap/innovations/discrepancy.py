"""What the equations are allowed to err by: coloured forces on them, and the filter that follows.

No model is exact, and a likelihood that takes all that is left for white noise is certain for the
wrong reason (Kennedy & O'Hagan 2001, J. R. Stat. Soc. B 63). Here the discrepancy is physical: a
coloured force on each equation (Ornstein–Uhlenbeck, as in stochastic grey-box models: Kristensen
et al. 2004, Automatica 40), of a size that is estimated, linearised along the recording.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from trms_cli.gap.innovations.kalman import Gains, LinearSystem, gains, smooth, whiten
from trms_cli.gap.innovations.trajectory import Trajectory
from trms_cli.identification.greybox.windows import Windows
from trms_cli.models.model import Model, names

FloatArray = npt.NDArray[np.float64]

#: s. Time over which a discrepancy forgets itself.
CORRELATION_TIME = 0.5
#: The gain of a drive wanders on every rig, with the temperature and the supply: by this share
#: (standard deviation), over this time in s.
GAIN_DRIFT, DRIFT_TIME = 0.015, 30.0
#: Sensors' outputs by name, and where in the block diagram they are.
SENSORS = {
    "alpha_v": "pitch_sensor",
    "alpha_h": "yaw_sensor",
    "omega_v": "main_tacho",
    "omega_h": "tail_tacho",
}


@dataclass(frozen=True)
class Channel:
    """A place where a discrepancy acts."""

    location: str
    kind: str  #: ``gain``: in proportion to a command
    index: int  #: In the model's ``w``, ``u`` or ``y``
    unit: str
    fixed: float | None = None  #: Its size, where that is not to be estimated


def equation_channels(model: Model) -> tuple[Channel, ...]:
    """One for each physical equation of a model, or for each input where it names none."""
    found = tuple(
        Channel(signal.name, "disturbance", i, signal.unit)
        for i, signal in enumerate(model.disturbances)
    )
    return found or input_channels(model)


def input_channels(model: Model) -> tuple[Channel, ...]:
    """One for each command."""
    rotors = {name: rotor for rotor, name in model.rotors.items()}
    return tuple(
        Channel(f"{rotors.get(s.name, s.name)}_actuator", "input", i, s.unit)
        for i, s in enumerate(model.inputs)
    )


def usual_channels(model: Model) -> tuple[Channel, ...]:
    """What may always err: every equation, and the gain of every drive a little."""
    gains_ = tuple(
        Channel(channel.location, "gain", channel.index, "1", GAIN_DRIFT)
        for channel in input_channels(model)
    )
    return (*equation_channels(model), *gains_)


def sensor_channels(model: Model, measured: npt.NDArray[np.bool_]) -> tuple[Channel, ...]:
    """One for each output that is measured."""
    return tuple(
        Channel(SENSORS.get(name, name), "output", i, model.outputs[i].unit)
        for i, name in enumerate(names(model.outputs))
        if measured[..., i].any()
    )


@dataclass(frozen=True)
class Discrepancy:
    """The linear system of deviations, with a coloured force in each channel."""

    windows: Windows
    trajectory: Trajectory
    channels: tuple[Channel, ...]
    #: Standard deviation of the windows' starts, as a share of their prior spread
    start_share: float = 1.0
    #: s, of every channel but a drive's gain
    correlation_time: float = field(default=CORRELATION_TIME)

    @cached_property
    def forgotten(self) -> FloatArray:
        """Factor of each force from one sample to the next, (n_d,)."""
        times = [DRIFT_TIME if c.kind == "gain" else self.correlation_time for c in self.channels]
        kept: FloatArray = np.exp(-self.windows.sample_time / np.array(times))
        return kept

    @cached_property
    def fixed(self) -> npt.NDArray[np.bool_]:
        """Channels whose size is not to be estimated, (n_d,)."""
        return np.array([channel.fixed is not None for channel in self.channels])

    def effective(self, shares: FloatArray) -> FloatArray:
        """The sizes, those that are fixed as they are fixed, (n_d,)."""
        given = [
            share if channel.fixed is None else channel.fixed
            for share, channel in zip(shares, self.channels, strict=True)
        ]
        return np.array(given, dtype=float)

    @cached_property
    def scales(self) -> FloatArray:
        """Size of what acts at each channel by the model itself, standard deviations (n_d,).

        The root of the summed variances of all contributions to that equation, so that forces
        that balance each other count: a gain that is off by a percent is a percent of this.
        """
        t, windows = self.trajectory, self.windows
        inside = windows.inside
        x, u = t.x[inside], windows.commands[inside]
        n = t.x.shape[-1]
        scales = np.ones(len(self.channels))
        for i, channel in enumerate(self.channels):
            if channel.kind == "gain":
                continue
            if channel.kind == "output":
                scales[i] = np.std(t.y[..., channel.index][inside])
                continue
            if channel.kind == "input":
                scales[i] = np.std(u[:, channel.index])
                continue
            g = t.g[..., channel.index][inside]
            size = np.maximum(np.einsum("kn,kn->k", g, g), 1e-300)
            into = np.einsum("kn,knl->kl", g, t.a[inside] - np.eye(n)) / size[:, None]
            of_u = np.einsum("kn,knl->kl", g, t.b[inside]) / size[:, None]
            parts = np.concatenate(
                [np.var(into * (x - x.mean(axis=0)), axis=0), np.var(of_u * u, axis=0)]
            )
            scales[i] = np.sqrt(parts.sum())
        return np.maximum(scales, 1e-12)

    @cached_property
    def system(self) -> LinearSystem:
        """Deviations of the states, then the forces in units of their scales."""
        t, windows = self.trajectory, self.windows
        m, c, n = t.x.shape
        d = len(self.channels)
        f = np.zeros((m, c, n + d, n + d))
        f[..., :n, :n] = t.a
        f[..., range(n, n + d), range(n, n + d)] = self.forgotten
        h = np.zeros((m, c, t.y.shape[-1], n + d))
        h[..., :n] = t.h
        for i, channel in enumerate(self.channels):
            if channel.kind == "disturbance":
                f[..., :n, n + i] = t.g[..., channel.index] * self.scales[i]
            elif channel.kind == "input":
                f[..., :n, n + i] = t.b[..., channel.index] * self.scales[i]
            elif channel.kind == "gain":
                u = windows.commands[..., channel.index, None]
                f[..., :n, n + i] = t.b[..., channel.index] * u
            else:
                h[..., channel.index, n + i] = self.scales[i]
        start = np.zeros((n + d, n + d))
        spread = np.zeros(n)
        spread[: windows.n_x] = windows.spread * self.start_share
        start[range(n), range(n)] = spread**2
        noise = np.median(windows.declared, axis=0) ** 2
        return LinearSystem(f, h, windows.measured, noise, start)

    def filter(self, shares: FloatArray, *, covariances: bool = False) -> Gains:
        """The filter for forces of some size.

        Parameters
        ----------
        shares : (n_d,) array
            Standard deviation of each force as a share of its scale.
        """
        n = self.trajectory.x.shape[-1]
        variance = np.zeros(n + len(self.channels))
        variance[n:] = self.effective(shares) ** 2
        forgotten = np.concatenate([np.zeros(n), self.forgotten])
        q = np.diag(variance * (1 - forgotten**2))
        system = LinearSystem(
            self.system.f,
            self.system.h,
            self.system.seen,
            self.system.r,
            self.system.start + np.diag(variance),
        )
        return gains(system, q, covariances=covariances)

    def whitened(self, filter_: Gains, columns: FloatArray) -> FloatArray:
        """Columns (m, c, n_y, k) as innovations."""
        return whiten(self.system, filter_, columns)

    def smoothed(self, shares: FloatArray, r: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Deviations and forces, and their variances, given measured minus predicted (m, c, n_y).

        Forces are in their own units.
        """
        x, variance = smooth(self.system, self.filter(shares, covariances=True), r)
        n = self.trajectory.x.shape[-1]
        x[..., n:] *= self.scales
        variance[..., n:] *= self.scales**2
        return x, variance
