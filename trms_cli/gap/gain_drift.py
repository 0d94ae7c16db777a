"""How the gain of a drive wanders over a recording, with its temperature and its supply.

It wanders on every rig, slowly: what a block tells of it holds in the next one, too. So the gain is
a function of time over all blocks, linear between knots; what it does to the outputs is linearised
along the recording::

    y = ŷ + Σ_k c_k Y_k          c_k ~ N(0, σ²)          σ of each drive estimated

Were each block given a gain of its own, an effect that falls with time would be paid for once and
credited in every block.

The zero of a sensor is a nuisance of the same kind: it is set to within half a step, and nothing
else that a rig has is blamed for so little of a spring's rest or of gravity.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.gap.discrepancy import Trajectory
from trms_cli.gap.problem import quantum_of
from trms_cli.identification.greybox.windows import Windows

#: s between two knots, and most knots of one recording: longer ones get wider spaces.
_KNOT_SPACING, _MOST_KNOTS = 15.0, 14
#: Centre of the log-normal prior of the drift's size (standard deviation, a share of the gain), and
#: how many knots that prior is worth.
USUAL_DRIFT, _WORTH = 0.01, 4.0
#: No drive is steadier than this.
LEAST_DRIFT = 0.001


@dataclass(frozen=True)
class WanderingGains:
    """What wandering gains do to the outputs of some windows."""

    columns: FloatArray  #: (m, c, n_y, k) array; change of the outputs for a gain that is one more
    drive: IntArray  #: (k,) array; drive that each column belongs to, −1 for the zero of a sensor
    #: (k,) array; weight of each coefficient in the mean gain of its drive over all windows
    weight: FloatArray
    #: (n_z,) array; standard deviation of the sensors' zeros, the last of the coefficients
    zeros: FloatArray = field(default_factory=lambda: np.zeros(0))

    @property
    def reach(self) -> FloatArray:
        """How far each coefficient may be from none, (k,): a zero by a step, a gain by anything."""
        gains = np.full(np.count_nonzero(self.drive >= 0), np.inf)
        return np.append(gains, self.zeros * np.sqrt(12))

    @cached_property
    def near(self) -> IntArray:
        """Numbers of the columns that are not zero in each window, (m, a); −1 where there are less.

        A knot reaches no further than the next ones.
        """
        there = (self.columns != 0).any(axis=(1, 2))
        most = int(there.sum(axis=1).max(initial=0))
        order = np.argsort(~there, axis=1, kind="stable")[:, :most]
        return np.where(np.take_along_axis(there, order, axis=1), order, -1)

    @property
    def drives(self) -> int:
        """How many drives there are."""
        return int(self.drive.max(initial=-1)) + 1

    @cached_property
    def averages(self) -> FloatArray:
        """Rows that make each drive's mean gain of the coefficients, (n_u, k)."""
        return np.where(self.drive == np.arange(self.drives)[:, None], self.weight, 0.0)

    def sd(self, sizes: FloatArray) -> FloatArray:
        """Standard deviation of each coefficient (k,) for sizes by drive (n_u,)."""
        return np.concatenate([sizes[self.drive[self.drive >= 0]], self.zeros])

    def stray(self, sizes: FloatArray) -> FloatArray:
        """How far such gains drive free runs off over a window, by output, (n_y,) RMS."""
        squares = np.mean(self.columns**2, axis=(0, 1)) @ (self.sd(sizes) * (self.drive >= 0)) ** 2
        return np.asarray(np.sqrt(squares))

    def likely_sizes(self, gains: FloatArray, variance: FloatArray) -> FloatArray:
        """Most likely size by drive (n_u,), from coefficients and their variances, each (k,)."""
        sizes = []
        for i in range(self.drives):
            own = self.drive == i
            total = np.sum(gains[own] ** 2 + variance[own]) + _WORTH * USUAL_DRIFT**2
            sizes.append(np.sqrt(total / (np.count_nonzero(own) + _WORTH)))
        return np.maximum(sizes, LEAST_DRIFT)

    def excess(self, gains: FloatArray, sizes: FloatArray, usual: FloatArray) -> float:
        """Nats that coefficients owe to sizes beyond the usual, by drive (n_u,)."""
        one, other = self.sd(sizes), self.sd(np.minimum(sizes, usual))
        return float(np.sum(0.5 * gains**2 * (other**-2 - one**-2) - np.log(one / other)))


def gain_drift(
    windows: Windows, trajectory: Trajectory, quanta: Mapping[str, float] | None = None
) -> WanderingGains:
    """Columns along a trajectory: a set of knots for every recording and drive, then zeros.

    ``quanta``: steps of sensors as declared, by output; a finer one may have been read.
    """
    m, c, n_y, n = trajectory.h.shape
    basis = _hats(windows)
    drives, knots = windows.commands.shape[2], basis.shape[2]
    x = np.zeros((m, n, drives * knots))
    columns = np.empty((m, c, n_y, drives * knots))
    input_terms = trajectory.b * windows.commands[:, :, None]
    for t in range(c):
        columns[:, t] = trajectory.h[:, t] @ x
        forcing = input_terms[:, t, :, :, None] * basis[:, t, None, None]
        x = trajectory.a[:, t] @ x + forcing.reshape(m, n, drives * knots)
    zeros = _zeros(windows, trajectory, quanta or {})
    at = np.flatnonzero(zeros)
    ones = np.broadcast_to(np.eye(n_y)[:, at], (m, c, n_y, len(at)))
    columns = np.concatenate([columns, ones], axis=-1)
    columns = np.where(windows.measured[..., None], columns, 0.0)
    drive = np.append(np.repeat(np.arange(drives), knots), np.full(len(at), -1))
    means = np.tile(basis[windows.inside].mean(axis=0), drives)
    return WanderingGains(columns, drive, np.append(means, np.zeros(len(at))), zeros[at])


def _zeros(windows: Windows, trajectory: Trajectory, quanta: Mapping[str, float]) -> FloatArray:
    """Standard deviation of each sensor's zero, uniform over a step, (n_y,).

    None where the motion does not hang on what it reads, nor on benches, whose zeros are set.
    """
    model, eye = windows.problem.model, np.eye(trajectory.a.shape[-1])
    zeros = np.zeros(model.n_y)
    for i, signal in enumerate(() if model.bench_sizes else model.outputs):
        state = model.state_names.index(signal.name) if signal.name in model.state_names else None
        if state is None or not np.allclose(trajectory.a[..., state], eye[state], atol=1e-9):
            step = quantum_of(windows.target[..., i], signal.unit)
            zeros[i] = max(step, quanta.get(signal.name, 0.0)) / np.sqrt(12)
    return zeros


def _hats(windows: Windows) -> FloatArray:
    """Hat functions over each recording at the samples of all windows, (m, c, k)."""
    m, c = windows.inside.shape
    sample, parts = windows.first_in_recording[:, None] + np.arange(c), []
    for number, dataset in enumerate(windows.datasets):
        count = min(max(2, round(dataset.duration / _KNOT_SPACING) + 1), _MOST_KNOTS)
        place = np.clip(sample / max(len(dataset) - 1, 1), 0.0, 1.0) * (count - 1)
        hats = np.maximum(1 - np.abs(place[..., None] - np.arange(count)), 0.0)
        parts.append(np.where((windows.recording == number)[:, None, None], hats, 0.0))
    return np.concatenate(parts, axis=2).reshape(m, c, -1)
