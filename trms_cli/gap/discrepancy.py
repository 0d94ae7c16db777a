"""What the equations are allowed to err by: coloured forces on them, and the filter that follows.

No model is exact, and a likelihood that takes all that is left for white noise is certain for the
wrong reason (Kennedy & O'Hagan 2001, J. R. Stat. Soc. B 63). Here the discrepancy is physical: a
coloured force on each equation (Ornstein–Uhlenbeck, as in stochastic grey-box models: Kristensen
et al. 2004, Automatica 40), of a size that is estimated, linearised along the recording.

The filter gives gains, whitened columns and smoothed states over windows.

    x⁺ = F x + ω,  cov ω = Q          y = H x + ν,  cov ν = diag(r)

Whitening a residual this way is the innovations form of its likelihood (Kailath 1968, IEEE Trans.
Autom. Control 13): the whitened rows are independent with unit variance if the model's errors are
of the kind assumed, and slopes in parameters are whitened by the same linear operation. The loop
over samples is C (``kalman.c``); without a compiler NumPy runs it over all windows at once.
"""

import ctypes
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.compilation import BufferedFunction, compiled_source
from trms_cli.effects.places import actuator_place, sensor_place
from trms_cli.identification.greybox.windows import Windows
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model, names
from trms_cli.models.scales import port_scale
from trms_cli.simulation.rollout import longest_step


@dataclass(frozen=True)
class LinearSystem:
    """A linear system along a trajectory, stacked over windows of equal length m × c samples."""

    f: FloatArray  #: (m, c, n, n) array
    h: FloatArray  #: (m, c, n_y, n) array
    measured: BoolArray  #: (m, c, n_y) array of bool; where an output was measured
    r: FloatArray  #: (n_y,) array; variance of each output's noise
    start: FloatArray  #: (n, n) array; covariance of the state at each window's first sample

    def __post_init__(self) -> None:
        for name in ("f", "h", "r", "start"):  # the compiled loop reads them as they lie
            object.__setattr__(self, name, _c(getattr(self, name)))


class FilterGains(NamedTuple):
    """A filter that is ready to run."""

    k: FloatArray  #: (m, c, n, n_y) array
    root: FloatArray  #: (m, c, n_y, n_y) array; L⁻¹ with L Lᵀ the innovations' covariance
    logdet: FloatArray  #: (m,) array; of the innovations' covariances of each window
    p: FloatArray | None  #: (m, c, n, n) array or None; covariance of each prediction


def gains(system: LinearSystem, q: FloatArray, *, covariances: bool = False) -> FilterGains:
    """Riccati's recursion.

    ``q``, (n, n) array. ``covariances``: whether those of the predictions are wanted. Raises
    FloatingPointError if a covariance is no longer positive.
    """
    m, c, n_y, n = system.h.shape
    k, root, logdet = np.empty((m, c, n, n_y)), np.empty((m, c, n_y, n_y)), np.empty(m)
    p = np.empty((m, c, n, n)) if covariances else None
    library = _library()
    if library is None:
        return _gains_of_arrays(system, q, p)
    arrays = (system.r, _c(q), system.start, k, root, logdet, p)
    if _run(library.trms_gains, system, arrays):
        raise FloatingPointError("a covariance of the filter is not positive")
    return FilterGains(k, root, logdet, p)


def whiten(system: LinearSystem, filter_: FilterGains, columns: FloatArray) -> FloatArray:
    """Innovations of columns, over their standard deviation.

    ``columns``, (m, c, n_y, k) array. Returns (m, c, n_y, k) array: zero where none was measured.
    """
    columns = _c(columns)
    out = np.empty_like(columns)
    library = _library()
    if library is None:
        return _whitened_arrays(system, filter_, columns)
    _run(library.trms_whiten, system, (filter_.k, filter_.root, columns, out), columns.shape[-1])
    return out


def scores(
    system: LinearSystem, filter_: FilterGains, z: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What the likelihood's slope in the size of each state's disturbance is made of.

    ``∂ log p/∂ log q_i = ½ q_i (squares_i − variances_i)`` (Koopman & Shephard 1992): at the most
    likely sizes the two are equal.

    ``z``, (m, c, n_y) array: whitened innovations. Returns ``squares, variances``, (2, n) arrays:
    for the variance of each state at the windows' first samples, and of what disturbs it later.
    """
    n = system.h.shape[-1]
    e = np.asarray(np.linalg.solve(filter_.root, z[..., None])[..., 0], dtype=np.float64)
    library = _library()
    if library is None:
        return _scores_of_arrays(system, filter_, e)
    squares, variances = np.empty((2, n)), np.empty((2, n))
    _run(library.trms_scores, system, (filter_.k, filter_.root, _c(e), squares, variances))
    return squares, variances


def _scores_of_arrays(
    system: LinearSystem, filter_: FilterGains, e: FloatArray
) -> tuple[FloatArray, FloatArray]:
    n = system.h.shape[-1]
    squares, variances = np.zeros((2, n)), np.zeros((2, n))
    for t, back, spread in _backward(system, filter_, e):
        squares[min(t, 1)] += (back**2).sum(axis=0)
        variances[min(t, 1)] += np.einsum("mii->i", spread)
    return squares, variances


def _backward(
    system: LinearSystem, filter_: FilterGains, e: FloatArray
) -> Iterator[tuple[int, FloatArray, FloatArray]]:
    """From the last sample to the first: what all later innovations say of the state, (m, n).

    With it its precision, (m, n, n). ``e``, (m, c, n_y) array: innovations.
    """
    m, c, _, n = system.h.shape
    h = system.h * system.measured[..., None]
    precision = np.swapaxes(filter_.root, -1, -2) @ filter_.root
    back, spread = np.zeros((m, n)), np.zeros((m, n, n))
    for t in range(c - 1, -1, -1):
        h_transposed = np.swapaxes(h[:, t], 1, 2)
        carry = system.f[:, t] @ (np.eye(n) - filter_.k[:, t] @ h[:, t])
        over = np.swapaxes(carry, 1, 2)
        back = _times(h_transposed, _times(precision[:, t], e[:, t])) + _times(over, back)
        spread = h_transposed @ precision[:, t] @ h[:, t] + over @ spread @ carry
        yield t, back, spread


def smooth(
    system: LinearSystem, filter_: FilterGains, r: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """States given all of a window, by the backward recursion of Durbin and Koopman.

    (Time Series Analysis by State Space Methods, 2nd ed., section 4.4.)

    ``filter_``: with covariances. ``r``, (m, c, n_y) array: what is observed of the linear system.
    Returns ``x``, (m, c, n) array; ``variance``, (m, c, n) array: of each, smoothed.
    """
    assert filter_.p is not None
    m, c, _, n = system.h.shape
    h = system.h * system.measured[..., None]
    x, predicted = np.zeros((m, n)), np.empty((m, c, n))
    e = np.empty((m, c, h.shape[2]))
    for t in range(c):
        predicted[:, t] = x
        e[:, t] = np.where(system.measured[:, t], r[:, t], 0.0) - _times(h[:, t], x)
        x = _times(system.f[:, t], x + _times(filter_.k[:, t], e[:, t]))
    smoothed, variance = np.empty((m, c, n)), np.empty((m, c, n))
    for t, back, spread in _backward(system, filter_, e):
        p = filter_.p[:, t]
        smoothed[:, t] = predicted[:, t] + _times(p, back)
        variance[:, t] = np.einsum("mii->mi", p) - np.einsum("mij,mjk,mki->mi", p, spread, p)
    return smoothed, np.maximum(variance, 0.0)


def _gains_of_arrays(system: LinearSystem, q: FloatArray, p_out: FloatArray | None) -> FilterGains:
    m, c, n_y, n = system.h.shape
    k, root, logdet = np.empty((m, c, n, n_y)), np.empty((m, c, n_y, n_y)), np.zeros(m)
    p = np.broadcast_to(system.start, (m, n, n))
    for t in range(c):
        if p_out is not None:
            p_out[:, t] = p
        measured = system.measured[:, t]
        h = system.h[:, t] * measured[..., None]
        cross_covariance = p @ np.swapaxes(h, 1, 2)
        noise = np.where(measured, system.r, 1.0)
        s = h @ cross_covariance + noise[:, None] * np.eye(n_y)
        try:
            lower = np.linalg.cholesky(s)
        except np.linalg.LinAlgError:
            raise FloatingPointError("a covariance of the filter is not positive") from None
        root[:, t] = np.linalg.inv(lower)
        diagonal = np.einsum("mii->mi", lower)
        logdet += 2 * np.where(measured, np.log(diagonal), 0.0).sum(axis=1)
        w = cross_covariance @ np.swapaxes(root[:, t], 1, 2)
        k[:, t] = w @ root[:, t]
        filtered_covariance = p - w @ np.swapaxes(w, 1, 2)
        p = system.f[:, t] @ filtered_covariance @ np.swapaxes(system.f[:, t], 1, 2) + q
    return FilterGains(k, root, logdet, p_out)


def _whitened_arrays(system: LinearSystem, filter_: FilterGains, columns: FloatArray) -> FloatArray:
    m, c, _, count = columns.shape
    out = np.empty_like(columns)
    x = np.zeros((m, system.f.shape[-1], count))
    for t in range(c):
        measured = system.measured[:, t][..., None]
        e = np.where(measured, columns[:, t] - system.h[:, t] @ x, 0.0)
        out[:, t] = np.where(measured, filter_.root[:, t] @ e, 0.0)
        x = system.f[:, t] @ (x + filter_.k[:, t] @ e)
    return out


def _times(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    return np.einsum("mij,mj->mi", matrix, vector)


def _library() -> ctypes.CDLL | None:
    source = Path(__file__).with_name("kalman.c").read_text(encoding="utf-8")
    return compiled_source("trms_kalman", source)


def _run(function: Any, system: LinearSystem, arrays: Sequence[Any], *sizes: int) -> Any:
    """Call a compiled loop over all windows: sizes, the system's matrices, then other arrays."""
    m, c, n_y, n = system.h.shape
    counts = np.full(m, c, dtype=np.int64)
    measured = np.ascontiguousarray(system.measured, dtype=np.uint8)
    pointers = [  # each keeps its array alive
        None if array is None else array.ctypes.data_as(ctypes.c_void_p)
        for array in (counts, system.f, system.h, measured, *arrays)
    ]
    return function(ctypes.c_longlong(m), pointers[0], n, n_y, *sizes, *pointers[1:])


def _c(array: FloatArray) -> FloatArray:
    return np.ascontiguousarray(array, dtype=np.float64)


@dataclass(frozen=True)
class Trajectory:
    """States and slopes at every sample of every window."""

    #: (m, c, n) array; the model's states and its memory; kept past the end of a short window
    x: FloatArray
    y: FloatArray  #: (m, c, n_y) array; what the sensors would read
    a: FloatArray  #: (m, c, n, n) array; ∂x⁺/∂x
    b: FloatArray  #: (m, c, n, n_u) array; ∂x⁺/∂u
    g: FloatArray  #: (m, c, n, n_w) array; ∂x⁺/∂w
    h: FloatArray  #: (m, c, n_y, n) array; ∂y/∂x


class TrajectoryLinearisation:
    """Simulates and linearises the model of some windows.

    ``windows``: of the model and the recordings.
    """

    def __init__(self, windows: Windows) -> None:
        self.windows = windows
        model = windows.problem.model
        step_length = windows.sample_time
        substeps = 1
        if model.sample_time is None:
            substeps = int(np.ceil(step_length / longest_step(model) - 1e-9))
        discrete = discretise(model, step_length, substeps, sensors=True)
        x, u, p, w = discrete.symbols()
        after, y = discrete.step(x, u, p, w), discrete.measurement(x, u, p)
        slopes = [ca.densify(ca.jacobian(after, v)) for v in (x, u, w)]
        self._step = BufferedFunction(
            ca.Function("gap_step", [x, u, p, w], ca.cse([after, *slopes]))
        )
        in_x = ca.densify(ca.jacobian(y, x))
        self._measure = BufferedFunction(ca.Function("gap_measure", [x, u, p], ca.cse([y, in_x])))
        self._none = np.zeros(model.n_w)

    def along(self, p: FloatArray, starts: FloatArray) -> Trajectory:
        """Along the model's own simulation from some starts.

        ``p``, (n_p,) array. ``starts``, (m, n_x) array: of the model's states; its memory is that
        of the commands before.
        """
        full = self.windows.with_memory(p, starts)
        m, c = self.windows.measured.shape[:2]
        trajectory = self._empty(m, c)
        for j in range(m):
            x = full[j].copy()
            for k in range(c):
                x = self._at(trajectory, j, k, x, p)
        return trajectory

    def through(self, p: FloatArray, x: FloatArray) -> Trajectory:
        """Through states that are given, (m, c, n), as a smoother gives them."""
        m, c = x.shape[:2]
        trajectory = self._empty(m, c)
        for j in range(m):
            for k in range(c):
                self._at(trajectory, j, k, x[j, k], p)
        return trajectory

    def _at(
        self, trajectory: Trajectory, j: int, k: int, x: FloatArray, p: FloatArray
    ) -> FloatArray:
        """Evaluate at one sample; the state after it."""
        u = self.windows.commands[j, k]
        trajectory.x[j, k] = x
        y, h = self._measure.evaluate(x, u, p)
        after, a, b, g = self._step.evaluate(x, u, p, self._none)
        for name, value in (("y", y), ("h", h), ("a", a), ("b", b), ("g", g)):
            place = getattr(trajectory, name)[j, k]
            place[...] = np.reshape(value, place.shape)  # one input or output comes without axis
        return after.copy() if k + 1 < self.windows.count[j] else x

    def _empty(self, m: int, c: int) -> Trajectory:
        model, n = self.windows.problem.model, self.windows.rollout.n_x
        sizes = ((n,), (model.n_y,), (n, n), (n, model.n_u), (n, model.n_w), (model.n_y, n))
        return Trajectory(*(np.zeros((m, c, *size)) for size in sizes))


#: Time over which a discrepancy forgets itself, over that of the model's dynamics.
_CORRELATION_TIMES = 1.0
#: Samples that it remembers at least.
_FEWEST = 2


@dataclass(frozen=True)
class DiscrepancyChannel:
    """A place where a discrepancy acts."""

    location: str
    kind: str  #: ``disturbance``, ``input`` or ``output``
    index: int  #: In the model's ``w``, ``u`` or ``y``
    unit: str


def equation_channels(model: Model) -> tuple[DiscrepancyChannel, ...]:
    """One for each physical equation of a model, or for each input where it names none."""
    channels = tuple(
        DiscrepancyChannel(signal.name, "disturbance", i, signal.unit)
        for i, signal in enumerate(model.disturbances)
    )
    return channels or input_channels(model)


def input_channels(model: Model) -> tuple[DiscrepancyChannel, ...]:
    """One for each command."""
    return tuple(
        DiscrepancyChannel(actuator_place(model, s.name), "input", i, s.unit)
        for i, s in enumerate(model.inputs)
    )


def sensor_channels(model: Model, measured: BoolArray) -> tuple[DiscrepancyChannel, ...]:
    """One for each output that is measured."""
    return tuple(
        DiscrepancyChannel(sensor_place(model, name), "output", i, model.outputs[i].unit)
        for i, name in enumerate(names(model.outputs))
        if measured[..., i].any()
    )


@dataclass(frozen=True)
class Discrepancy:
    """The linear system of deviations, with a coloured force in each channel."""

    windows: Windows
    trajectory: Trajectory
    channels: tuple[DiscrepancyChannel, ...]
    start_share: float = 1.0  #: Standard deviation of the starts over their prior spread

    @property
    def floor(self) -> float:
        """The least share of any force."""
        bench = self.windows.problem.model.without_effects().bench_sizes
        return FLOOR if bench else _FLOOR_OF_ANY

    @cached_property
    def autocorrelation(self) -> FloatArray:
        """Factor of each force from one sample to the next, (n_d,)."""
        time = _CORRELATION_TIMES * port_scale(self.windows.problem.model.without_effects()).time
        factor = np.exp(-self.windows.sample_time / max(time, _FEWEST * self.windows.sample_time))
        return np.full(len(self.channels), factor)

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
        f[..., range(n, n + d), range(n, n + d)] = self.autocorrelation
        h = np.zeros((m, c, t.y.shape[-1], n + d))
        h[..., :n] = t.h
        for i, channel in enumerate(self.channels):
            if channel.kind == "disturbance":
                f[..., :n, n + i] = t.g[..., channel.index] * self.scales[i]
            elif channel.kind == "input":
                f[..., :n, n + i] = t.b[..., channel.index] * self.scales[i]
            else:
                h[..., channel.index, n + i] = self.scales[i]
        start = np.zeros((n + d, n + d))
        spread = np.zeros(n)
        spread[: windows.n_x] = windows.spread * self.start_share
        start[range(n), range(n)] = spread**2
        noise = np.median(windows.declared, axis=0) ** 2
        return LinearSystem(f, h, windows.measured, noise, start)

    def filter(self, shares: FloatArray, *, covariances: bool = False) -> FilterGains:
        """The filter for forces of some size.

        ``shares``, (n_d,) array: standard deviation of each force as a share of its scale.
        """
        n = self.trajectory.x.shape[-1]
        variance = np.zeros(n + len(self.channels))
        variance[n:] = shares**2
        autocorrelation = np.concatenate([np.zeros(n), self.autocorrelation])
        q = np.diag(variance * (1 - autocorrelation**2))
        system = replace(self.system, start=self.system.start + np.diag(variance))
        return gains(system, q, covariances=covariances)

    def stray(self, shares: FloatArray) -> FloatArray:
        """How far forces of some size drive a free run off over a window, by output, (n_y,) RMS."""
        t, n = self.trajectory, self.trajectory.x.shape[-1]
        m, c = t.x.shape[:2]
        variance = np.concatenate([np.zeros(n), shares**2])
        autocorrelation = np.concatenate([np.zeros(n), self.autocorrelation])
        p = np.broadcast_to(np.diag(variance), (m, n + len(shares), n + len(shares)))
        total = np.zeros(t.y.shape[-1])
        for k in range(c):
            f, h = self.system.f[:, k], self.system.h[:, k]
            total += np.einsum("myi,mij,myj->y", h, p, h)
            p = f @ p @ np.swapaxes(f, 1, 2) + np.diag(variance * (1 - autocorrelation**2))
        return np.sqrt(total / (m * c))

    def whitened(self, filter_: FilterGains, columns: FloatArray) -> FloatArray:
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


#: Share of what acts on an equation that it may always err by: integration, rounding, jitter. A
#: drive with a fine encoder is integrated as finely, and shows a bias of a thousandth.
FLOOR, _FLOOR_OF_ANY = 0.004, 0.001
#: No discrepancy is larger than what acts there, several times over.
_MOST = 10.0
_TOLERANCE = 0.05


def likely_shares(
    discrepancy: Discrepancy,
    r: FloatArray,
    shares: FloatArray,
    *,
    moving: BoolArray | None = None,
    iterations: int = 8,
    least: FloatArray | float | None = None,
) -> FloatArray:
    """Most likely sizes of the forces.

    Each iteration multiplies the variances by the ratio of the two parts of the likelihood's
    slope, which are equal where it is greatest.

    ``r``, (m, c, n_y) array: measured less predicted. ``shares``, (n_d,) array: where to begin.
    ``moving``, (n_d,) array of bool: those that are to be found; None: all. ``least``, (n_d,)
    array: no size is smaller; None: than the floor.
    """
    least = discrepancy.floor if least is None else least
    shares = np.maximum(np.asarray(shares, dtype=float), least)
    n = discrepancy.trajectory.x.shape[-1]
    is_free = np.ones(len(shares), dtype=bool) if moving is None else moving
    later = 1 - discrepancy.autocorrelation**2
    for _ in range(iterations):
        try:
            filter_ = discrepancy.filter(shares)
        except FloatingPointError:  # so large that numbers no longer hold it
            return np.maximum(shares / 4, least)
        z = discrepancy.whitened(filter_, r[..., None])[..., 0]
        slopes = [  # in the logarithm of each size
            shares**2 * (part[0, n:] + later * part[1, n:])
            for part in scores(discrepancy.system, filter_, z)
        ]
        ratio = slopes[0] / np.maximum(slopes[1], 1e-300)
        # the size is the root of the variance; half of the rest of the way is taken at a time
        after = np.clip(shares * np.clip(np.sqrt(ratio), 0.3, 4.0), least, _MOST)
        after = np.where(is_free, after, shares)
        has_converged = np.max(np.abs(np.log(after / shares))) < _TOLERANCE
        shares = after
        if has_converged:
            break
    return shares


def log_likelihood(discrepancy: Discrepancy, r: FloatArray, shares: FloatArray) -> FloatArray:
    """Log likelihood of what a fit left over, by window, up to a constant, (m,) nats."""
    filter_ = discrepancy.filter(shares)
    z = discrepancy.whitened(filter_, r[..., None])[..., 0]
    return np.asarray(-0.5 * (z**2).sum(axis=(1, 2)) - 0.5 * filter_.logdet)
