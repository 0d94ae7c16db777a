"""The cost of a grey-box fit in parameters and starts, and its parabola at a point.

The cost of a fit is

    ½ Σ_c 1/φ_c Σ_t ρ(r_c(t)/σ_c)  +  priors

with Huber's ρ (Annals of Mathematical Statistics 35, 1964), twice the usual scale so that it is
r² for small r. ``σ_c`` is the declared noise of channel c or the residuals' own size, whichever
is larger; ``φ_c`` ≥ 1 is the number of samples that together say as much as one would if the
residuals were white. Residuals of a model with an error of its own are correlated over seconds;
counted as white they would drown the priors and all doubt.

A Gauss–Newton step eliminates the windows' starts exactly. With δx_j the change of window j's start
and δθ that of the parameters, the linearised residuals are ``r_j + A_j δx_j + B_j δθ``. A QR
factorisation of each window's ``[A_j B_j r_j]`` leaves a small triangle that holds all of the cost,
the gradient and the curvature; a second one of the triangle with the start's prior and damping
under it splits

    [R_x  R_xθ  c_x]      δx_j = −R_x⁻¹ (c_x + R_xθ δθ)
    [ 0   R_θ   c_θ]      which δθ is left with

so that m windows of n states cost m small factorisations, and never a matrix of m·n columns.
Where windows are joined (each start near the end of the window before), the same elimination runs
along the chain, as in a square-root information filter (Bierman 1977).
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.identification.greybox.windows import Residuals, Windows


@dataclass(frozen=True)
class ResidualWeights:
    """Scales of the residuals."""

    sd: FloatArray  #: (m, n_y) array; by window and output
    samples: FloatArray  #: (n_y,) array; φ of each output
    share: float  #: Weight of each squared residual where windows overlap
    robust: float | None  #: Huber's threshold

    @property
    def trust(self) -> FloatArray:
        """Factor of each output's squared whitened residuals, shape (n_y,)."""
        return np.asarray(self.share / self.samples)

    def whitened(self, r: FloatArray) -> FloatArray:
        """Residuals (m, c, n_y) over their standard deviation."""
        return np.asarray(r / self.sd[:, None])

    def cost(self, r: FloatArray) -> float:
        """The data's part of the cost, from residuals (m, c, n_y) that are not whitened."""
        return float(self.costs(r).sum())

    def costs(self, r: FloatArray) -> FloatArray:
        """The same by window, shape (m,)."""
        loss = huber_squares(self.whitened(r), self.robust)
        return np.asarray(0.5 * (loss.sum(axis=1) @ self.trust))

    def roots(self, r: FloatArray) -> FloatArray:
        """Factors (m, c, n_y) of residuals and slopes whose squares make the cost's parabola.

        Iteratively reweighted least squares: the parabola touches the cost at ``r`` and lies
        above it elsewhere.
        """
        roots: FloatArray = np.sqrt(self.trust) / self.sd[:, None]
        return roots * huber_roots(self.whitened(r), self.robust)


def huber_squares(z: FloatArray, robust: float | None) -> FloatArray:
    """Squares of whitened residuals, linear beyond ``robust`` standard deviations (None: never)."""
    if robust is None:
        return z**2
    size = np.abs(z)
    return np.where(size > robust, 2 * robust * size - robust**2, z**2)


def huber_roots(z: FloatArray, robust: float | None) -> FloatArray:
    """Factors of whitened residuals whose squares make the parabola of :func:`huber_squares`."""
    if robust is None:
        return np.ones_like(z)
    return np.sqrt(robust / np.maximum(np.abs(z), robust))


def sizes(r: FloatArray, measured: BoolArray, declared: FloatArray) -> FloatArray:
    """Root mean square of each output's residuals over their declared deviation, shape (n_y,).

    The largest hundredth counts as its smallest member, lest outliers make all else cheap.

    ``r``, ``measured``: (m, c, n_y) arrays. ``declared``: (m, n_y) array.
    """
    z = np.abs(r / declared[:, None])
    ratios = np.ones(r.shape[2])
    for i in range(r.shape[2]):
        here = z[..., i][measured[..., i]]
        if len(here):
            ratios[i] = np.sqrt(np.mean(np.minimum(here, np.quantile(here, 0.99)) ** 2))
    return ratios


#: Entries of a matrix that is factorised in one piece.
_ENTRIES_AT_ONCE = 8000


class Joint(NamedTuple):
    """Rows that join the end of each window to the start of the next, scaled and weighted."""

    follows: BoolArray  #: (m,) array of bool; whether window j continues window j − 1
    #: (m, n, n + n_f) array; slopes of row block j in the start of window j − 1 and the parameters
    from_before: FloatArray
    weight: FloatArray  #: (n,) array; minus the slope in the start of window j
    gap: FloatArray  #: (m, n) array; end of window j − 1 less start of window j, weighted


class Quadratic(NamedTuple):
    """The cost as a parabola in changes of starts and parameters, all in scaled units."""

    triangles: FloatArray  #: (m, k, n + n_f + 1) array; of each window's data
    start_gap: FloatArray  #: (m, n) array; start less the centre of its prior, over its sd; slope 1
    prior_root: FloatArray  #: (n_f,) array; root of the precision of each prior, scaled
    prior_gap: FloatArray  #: (n_f,) array; ``prior_root·(θ − centre)``
    joint: Joint | None

    @property
    def n(self) -> int:
        """Number of states."""
        return int(self.start_gap.shape[1])

    @property
    def rows(self) -> FloatArray:
        """``triangles``, and below them those of each start's prior, (m, k + n, n + n_f + 1)."""
        m, n = self.start_gap.shape
        own = np.zeros((m, n, self.triangles.shape[-1]))
        own[:, :, :n] = np.eye(n)
        own[:, :, -1] = self.start_gap
        return np.concatenate([self.triangles, own], axis=1)

    def cost(self, dx: FloatArray, dtheta: FloatArray) -> float:
        """Its value after a change, dx (m, n) and dtheta (n_f,)."""
        move = np.hstack([dx, np.broadcast_to(dtheta, (len(dx), len(dtheta)))])
        rows = np.einsum("mkc,mc->mk", self.triangles[..., :-1], move) + self.triangles[..., -1]
        total = np.sum(rows**2) + np.sum((self.start_gap + dx) ** 2)
        total += np.sum((self.prior_gap + self.prior_root * dtheta) ** 2)
        if self.joint is not None:
            total += np.sum(_gaps(self.joint, dx, dtheta) ** 2)
        return 0.5 * float(total)


class ReducedQuadratic(NamedTuple):
    """What is left when the starts are gone, and how they come back."""

    #: (k, n_f) array; of the data, the starts' priors and the damping of the starts; ``factorᵀ
    #: factor`` is the curvature of the cost in the parameters without their own priors
    factor: FloatArray
    residual: FloatArray  #: (k,) array
    to_starts: FloatArray  #: (m, n, n_f) array; slope of each eliminated start in the parameters
    at_zero: FloatArray  #: (m, n) array; change of the starts when the parameters do not move

    def starts(self, dtheta: FloatArray) -> FloatArray:
        """Change of the starts (m, n) that belongs to a change of the parameters."""
        return np.asarray(self.at_zero + self.to_starts @ dtheta)


def triangles(rows: FloatArray) -> FloatArray:
    """Triangular factors of each window's ``[A B r]``, (m, rows, n + n_f + 1)."""
    m, _, columns = rows.shape
    block = max(2 * columns, _ENTRIES_AT_ONCE // columns)
    # A tall matrix in blocks, their triangles stacked, in blocks again (TSQR, Demmel et al. 2012,
    # SIAM J. Sci. Comput. 34): it stays in the cache, and below the size from which a BLAS starts
    # threads, which on a busy machine wait for each other twenty times as long as they work.
    while rows.shape[1] > block:
        missing = -rows.shape[1] % block
        rows = np.concatenate([rows, np.zeros((m, missing, columns))], axis=1)
        small = _triangle(rows.reshape(-1, block, columns))
        rows = small.reshape(m, -1, columns)
    return _triangle(rows)


def triangles_of_products(rows: FloatArray) -> FloatArray:
    """The same factors from the windows' products AᵀA, in a quarter of the time.

    What a column has beyond the others is lost below 1e-7 of its length: enough where all have
    priors, and where what is far below these does not matter.
    """
    products = np.swapaxes(rows, 1, 2) @ rows
    length = np.sqrt(np.einsum("mii->mi", products))
    scale = np.where(length > 0, length, 1.0)
    products /= scale[:, :, None] * scale[:, None, :]
    products += _LOST**2 * np.eye(rows.shape[2])
    try:
        factors = np.swapaxes(np.linalg.cholesky(products), 1, 2) * scale[:, None, :]
    except np.linalg.LinAlgError:
        return triangles(rows)
    return np.asarray(factors)


#: Length, as a share of a column's, below which it may be the sum of others.
_LOST = 1e-7


def eliminate_starts(quadratic: Quadratic, damping: float) -> ReducedQuadratic:
    """Eliminate the starts.

    ``damping``: λ of Levenberg and Marquardt, in the scaled units; it acts on the starts here, and
    on the parameters where the step is made.
    """
    m, n = quadratic.start_gap.shape
    columns = quadratic.triangles.shape[2]
    stacked = quadratic.rows
    if damping > 0:
        damping_rows = np.zeros((m, n, columns))
        damping_rows[:, :, :n] = np.sqrt(damping) * np.eye(n)
        stacked = np.concatenate([stacked, damping_rows], axis=1)
    if quadratic.joint is not None:
        return _along_chains(quadratic.joint, stacked, n)
    whole = _triangle(stacked)
    remainder = whole[:, n:, n:].reshape(-1, columns - n)
    back = _solved(whole[:, :n, :n], whole[:, :n, n:])
    return ReducedQuadratic(*_compact(remainder), back[..., :-1], back[..., -1])


def _along_chains(joint: Joint, stacked: FloatArray, n: int) -> ReducedQuadratic:
    m, _, columns = stacked.shape
    n_f = columns - n - 1
    remainders, carried = [], np.zeros((0, columns))
    pivots: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for j in range(m):
        last = j + 1 == m or not joint.follows[j + 1]
        here = np.vstack([carried, stacked[j]])
        # columns: this start, the next, parameters, residual
        wide = np.insert(here, [n] * n, 0.0, axis=1)
        if not last:
            row = np.zeros((n, columns + n))
            row[:, :n] = joint.from_before[j + 1][:, :n]
            row[:, n : 2 * n] = -np.diag(joint.weight)
            row[:, 2 * n : -1] = joint.from_before[j + 1][:, n:]
            row[:, -1] = joint.gap[j + 1]
            # The heaviest rows first: the factorisation stays accurate for near-equalities.
            wide = np.vstack([row, wide])
        whole = _triangle(wide)
        solved = _solved(whole[:n, :n], whole[:n, n:])
        pivots.append((solved[:, :n], solved[:, n:-1], solved[:, -1]))
        rest = whole[n:, n:]
        if last:
            remainders.append(rest[:, n:])
            carried = np.zeros((0, columns))
        else:
            carried = rest
    to_starts, at_zero = np.zeros((m, n, n_f)), np.zeros((m, n))
    for j in reversed(range(m)):
        in_next, in_theta, constant = pivots[j]
        to_starts[j], at_zero[j] = in_theta, constant
        if j + 1 < m and joint.follows[j + 1]:
            to_starts[j] += in_next @ to_starts[j + 1]
            at_zero[j] += in_next @ at_zero[j + 1]
    return ReducedQuadratic(*_compact(np.vstack(remainders)), to_starts, at_zero)


def _triangle(rows: FloatArray) -> FloatArray:
    """R of one QR factorisation, of each matrix in a stack."""
    return np.asarray(np.linalg.qr(rows, mode="r"))


def _solved(a: FloatArray, b: FloatArray) -> FloatArray:
    """``−a⁻¹ b``, of each matrix in a stack."""
    return -np.asarray(np.linalg.solve(a, b), dtype=np.float64)


def _compact(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same parabola in few rows: slopes and constants."""
    if len(rows) > rows.shape[1]:
        rows = triangles(rows[None])[0]
    return rows[:, :-1], rows[:, -1]


def _gaps(joint: Joint, dx: FloatArray, dtheta: FloatArray) -> FloatArray:
    """Weighted gaps at the joints after a change, (number of joints, n)."""
    j = np.flatnonzero(joint.follows)
    n = dx.shape[1]
    return (
        joint.gap[j]
        + np.einsum("jnk,jk->jn", joint.from_before[j][..., :n], dx[j - 1])
        + joint.from_before[j][..., n:] @ dtheta
        - joint.weight * dx[j]
    )


@dataclass
class PosteriorObjective(ABC):
    """Minus the logarithm of a posterior, nats, as a least-squares search lowers it.

    A search tries parameters with which a simulation runs away: that is a cost, not a warning.
    """

    windows: Windows  #: Of the model that is fitted

    def __post_init__(self) -> None:
        problem = self.windows.problem
        self.scales = problem.scales
        self.means, self.precisions = problem.prior_means, problem.prior_precisions
        #: Simulations of all windows so far; with slopes they count once as well
        self.evaluations = 0

    @abstractmethod
    def by_window(self, theta: FloatArray, starts: FloatArray) -> FloatArray:
        """Each window's part of the cost with its start's prior, shape (m,)."""

    @abstractmethod
    def parabola(self, theta: FloatArray, starts: FloatArray) -> tuple[float, Quadratic, Residuals]:
        """Its value, and the parabola in scaled changes.

        Starts are scaled by their spread, parameters by their scales.
        """

    def better_starts(
        self, theta: FloatArray, one: FloatArray, other: FloatArray
    ) -> tuple[float, FloatArray]:
        """The cost with the better of two starts in every window, and those starts.

        Given the parameters, windows have nothing to do with each other. Dry friction puts a kink
        into the cost wherever a beam just moves or just rests; a step that is good for most
        windows need not fail because one start fell on the wrong side.
        """
        parts = np.array([self.by_window(theta, starts) for starts in (one, other)])
        choice = np.argmin(parts, axis=0)
        total = float(parts.min(axis=0).sum()) + self.of_parameters(theta)
        return total, np.where((choice == 0)[:, None], one, other)

    def of_parameters(self, theta: FloatArray) -> float:
        """What the priors of the parameters add, nats."""
        return 0.5 * float(np.sum(self.precisions * (theta - self.means) ** 2))

    def simulated(self, theta: FloatArray, starts: FloatArray, *, slopes: bool) -> Residuals:
        """The windows' residuals."""
        self.evaluations += 1
        p = self.windows.problem.all_values(theta)
        return self.windows.residuals(p, starts, slopes=slopes)


@dataclass
class MapObjective(PosteriorObjective):
    """Maximum a posteriori: half the sum of squares of residuals and of deviations from priors."""

    weights: ResidualWeights
    centres: FloatArray  #: (m, n_x) array; of the starts' priors
    #: Standard deviation of the gaps between windows, as a share of the starts' spread; None:
    #: windows know nothing of each other
    gap_sd: float | None = None

    @np.errstate(all="ignore")
    def cost(self, theta: FloatArray, starts: FloatArray) -> float:
        """Its value; infinite where the simulation is not finite."""
        residuals = self.simulated(theta, starts, slopes=False)
        return self._cost(theta, starts, residuals)

    def better_starts(
        self, theta: FloatArray, one: FloatArray, other: FloatArray
    ) -> tuple[float, FloatArray]:
        """Joined windows are taken together: one or the other of two starts for all."""
        if self.gap_sd is None:
            return super().better_starts(theta, one, other)
        costs = [self.cost(theta, starts) for starts in (one, other)]
        best = int(np.argmin(costs))
        return costs[best], (one, other)[best]

    @np.errstate(all="ignore")
    def by_window(self, theta: FloatArray, starts: FloatArray) -> FloatArray:
        r = self.simulated(theta, starts, slopes=False).r
        parts = self.weights.costs(r)
        parts += 0.5 * np.sum(((starts - self.centres) / self.windows.spread) ** 2, axis=1)
        return np.where(np.isfinite(parts), parts, np.inf)

    def of_priors(self, theta: FloatArray, starts: FloatArray) -> float:
        """What the priors of parameters and starts add to the cost, nats."""
        gaps = (starts - self.centres) / self.windows.spread
        return self.of_parameters(theta) + 0.5 * float(np.sum(gaps**2))

    @np.errstate(all="ignore")
    def parabola(self, theta: FloatArray, starts: FloatArray) -> tuple[float, Quadratic, Residuals]:
        residuals = self.simulated(theta, starts, slopes=True)
        cost = self._cost(theta, starts, residuals)
        assert residuals.j is not None
        roots = self.weights.roots(residuals.r) * self.windows.measured
        a_b, r = self.scaled(residuals.j), residuals.r[..., None]
        rows = np.concatenate([a_b, r], axis=-1) * roots[..., None]
        quadratic = Quadratic(
            triangles(rows.reshape(len(self.windows), -1, rows.shape[-1])),
            (starts - self.centres) / self.windows.spread,
            np.sqrt(self.precisions) * self.scales,
            np.sqrt(self.precisions) * (theta - self.means),
            self._joint(starts, residuals),
        )
        return cost, quadratic, residuals

    def scaled(self, j: FloatArray) -> FloatArray:
        """Slopes per scaled unit of starts and parameters."""
        return np.asarray(j * np.concatenate([self.windows.spread, self.scales]))

    def _cost(self, theta: FloatArray, starts: FloatArray, residuals: Residuals) -> float:
        if not residuals.finite:
            return np.inf
        cost = self.weights.cost(residuals.r)
        cost += self.of_priors(theta, starts)
        if self.gap_sd is not None:
            gaps = self._gaps(starts, residuals)[self.windows.follows]
            cost += 0.5 * float(np.sum(gaps**2))
        return cost if np.isfinite(cost) else np.inf

    def _gaps(self, starts: FloatArray, residuals: Residuals) -> FloatArray:
        assert self.gap_sd is not None
        gaps = np.zeros_like(starts)
        gaps[1:] = (residuals.ends[:-1] - starts[1:]) / (self.gap_sd * self.windows.spread)
        return gaps

    def _joint(self, starts: FloatArray, residuals: Residuals) -> Joint | None:
        if self.gap_sd is None:
            return None
        assert residuals.dends is not None
        weight = np.full(len(self.windows.spread), 1.0 / self.gap_sd)
        from_before = np.zeros_like(residuals.dends)
        slopes = self.scaled(residuals.dends[:-1])
        from_before[1:] = slopes / (self.gap_sd * self.windows.spread)[None, :, None]
        return Joint(self.windows.follows, from_before, weight, self._gaps(starts, residuals))
