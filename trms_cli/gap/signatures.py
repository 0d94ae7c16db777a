"""What each effect would change in a recording that nothing else can: its trace, projected.

For every effect at a few sizes the change of the outputs is simulated along the recorded inputs,
made white, and freed of all that other windows' starts and nominal parameters within their priors
could do as well. What is left says how large an effect must be to be seen, and which effects leave
the same trace: before anything is fitted, and without looking at what the rig answered but for the
trajectory about which the noise is propagated.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.gap.competing_model import FittedModel, Metric
from trms_cli.gap.discrepancy import FilterGains, LinearSystem, whiten
from trms_cli.gap.problem import CandidateEffect

#: Windows whose columns are whitened at a time.
_AT_ONCE = 12
#: Standard deviations of its projected trace at which an effect counts as visible.
VISIBLE = 5.0


#: Traces nearer to each other than this cosine make no pair.
_PARALLEL = 0.98
#: Rows of each effect that are looked at in pairs.
_ROWS = 3


@dataclass(frozen=True)
class Signatures:
    """Projected traces of effects."""

    names: tuple[str, ...]  #: Of the effect of each row
    sizes: tuple[FloatArray, ...]  #: tuple of (n_s,) arrays; at which each row was simulated
    energy: FloatArray  #: (k,) array; squared length of each trace, in noise variances
    projected_energy: FloatArray  #: (k,) array; the same after projection
    #: (k,) array; inner product of each projected trace with what the nominal fit left over: the
    #: residual is best explained by ``towards/projected_energy`` times the row's change
    towards: FloatArray
    cosine: FloatArray  #: (k, k) array; between projected traces

    @property
    def gain(self) -> FloatArray:
        """Nats by which each row lowers the cost, its change taken up to three times, (k,)."""
        return projected_gain(np.maximum(self.projected_energy, 1e-12), self.towards)

    def pairs(self, least: float) -> list[tuple[float, int, int]]:
        """Pairs of rows of two effects, best first, each pair of effects once.

        Each with the nats by which both together lower the cost and their rows; only pairs that
        promise ``least`` nats more than either of them alone. Where one of the two would have to
        act backwards or beyond three times its size they are no pair.
        """
        rows = np.array([r for n in dict.fromkeys(self.names) for r in self._promising(n)])
        length = np.sqrt(self.projected_energy[rows])
        towards, cosine = self.towards[rows] / length, self.cosine[np.ix_(rows, rows)]
        with np.errstate(all="ignore"):
            inverse_determinant = 1 / (1 - cosine**2)
            # (i, j): size of i
            by = (towards[:, None] - cosine * towards[None, :]) * inverse_determinant
            together = 0.5 * (by * towards[:, None] + by.T * towards[None, :])
        multiple = by / length[:, None]
        alone = self.gain[rows]
        fine = (multiple > 0) & (multiple < 3) & (np.abs(cosine) < _PARALLEL)
        fine &= fine.T & (together > np.maximum(alone[:, None], alone[None, :]) + least)
        best_pairs: dict[frozenset[str], tuple[float, int, int]] = {}
        for i, j in np.argwhere(np.triu(fine, 1)):
            key = frozenset((self.names[rows[i]], self.names[rows[j]]))
            gain = float(together[i, j])
            if len(key) == 2 and gain > best_pairs.get(key, (0.0,))[0]:
                best_pairs[key] = (gain, int(rows[i]), int(rows[j]))
        return sorted(best_pairs.values(), reverse=True)

    def _promising(self, name: str) -> IntArray:
        """Rows of an effect that are worth a look beside another one."""
        rows = self.rows(name)
        return rows[np.argsort(-self.gain[rows] - 1e-9 * self.towards[rows])][:_ROWS]

    def rows(self, name: str) -> IntArray:
        """Rows of an effect."""
        return np.flatnonzero([other == name for other in self.names])

    def best(self, name: str) -> tuple[float, int]:
        """Largest gain of an effect, nats, and its row; (0, −1) where none could be simulated."""
        rows = self.rows(name)
        if not len(rows):
            return 0.0, -1
        row = int(rows[np.argmax(self.gain[rows])])
        return float(self.gain[row]), row

    def most_visible(self, name: str) -> tuple[float, float]:
        """Standard deviations of the noise that an effect's trace has, and has after projection.

        Each of the size at which it is largest.
        """
        rows = self.rows(name)
        energy = float(self.energy[rows].max())
        projected_energy = float(self.projected_energy[rows].max())
        return float(np.sqrt(energy)), float(np.sqrt(min(max(projected_energy, 0.0), energy)))

    def least_size(self, name: str) -> float | None:
        """Smallest value of the first size that would show, None where none of those tried does.

        Traces are not proportional to sizes (a dead zone, a friction that holds): the smallest
        tried size that is visible is scaled down by what it exceeds the threshold.
        """
        visible = []
        for row in self.rows(name):
            size, length = abs(self.sizes[row][0]), np.sqrt(max(self.projected_energy[row], 0.0))
            if size > 0 and length >= VISIBLE:
                visible.append((size, length))
        if not visible:
            return None
        size, length = min(visible)
        return float(size * VISIBLE / length)

    def alike(self, one: str, other: str) -> float:
        """Largest cosine between traces of two effects, at the sizes that they share best."""
        block = self.cosine[np.ix_(self.rows(one), self.rows(other))]
        return float(np.max(np.abs(block), initial=0.0))


@dataclass(frozen=True)
class EffectTraces:
    """What each effect changes in the outputs when it is added to a fitted model."""

    names: tuple[str, ...]  #: Of the effect of each row
    sizes: tuple[FloatArray, ...]  #: tuple of (n_s,) arrays
    changes: FloatArray  #: (k, m, c, n_y) array


def effect_traces(
    nominal: FittedModel,
    candidates: Sequence[CandidateEffect],
    *,
    watch: Callable[[int], bool] = lambda k: True,
) -> EffectTraces:
    """Simulate every effect at a few sizes, all else as fitted without it.

    ``nominal``: without any of the candidates, none of which noise drives. ``watch``: told how
    many candidates are done; False stops.
    """
    p = nominal.structure.problem.all_values(nominal.fit.theta)
    base = nominal.structure.windows.residuals(p, nominal.fit.starts).r
    theta = nominal.values
    changes: list[FloatArray] = []
    names: list[str] = []
    sizes: list[FloatArray] = []
    for k, candidate in enumerate(candidates):
        if not watch(k):
            break
        structure = nominal.structure.with_effects(candidate)
        for row in candidate.variants:
            own = {f.name: v for f, v in zip(candidate.free, row, strict=True)}
            vector, starts = structure.point({**theta, **own}, nominal.fit.starts)
            with np.errstate(all="ignore"):
                r = structure.windows.residuals(structure.problem.all_values(vector), starts).r
            if np.isfinite(r).all():
                changes.append(r - base)
                names.append(candidate.name)
                sizes.append(row)
    return EffectTraces(tuple(names), tuple(sizes), np.array(changes).reshape(-1, *base.shape))


def project_traces(fitted: FittedModel, traces: EffectTraces) -> Signatures:
    """Traces, freed of what the starts and parameters of a fitted model could do as well.

    ``fitted``: the nominal model, or one with an effect: then its sizes are among the parameters.
    """
    point, objective = fitted.fit.point, fitted.objective
    n_f, count = len(point), len(traces.names)
    total, raw = np.zeros((n_f + count + 1, n_f + count + 1)), np.zeros(count)
    for products, energies in window_products(fitted, traces):
        total += products.sum(axis=0)
        raw += energies.sum(axis=0)
    root = objective.precisions * objective.scales
    across = total[:n_f, n_f:].copy()
    across[:, -1] += root * (point - objective.means)
    inner = total[:n_f, :n_f] + np.diag(root * objective.scales)
    gram = total[n_f:, n_f:] - across.T @ np.linalg.solve(inner, across)
    energy = np.maximum(np.diag(gram)[:-1], 1e-12)
    length = np.sqrt(energy)
    return Signatures(
        traces.names,
        traces.sizes,
        raw,
        energy,
        -gram[:-1, -1],
        gram[:-1, :-1] / np.outer(length, length),
    )


def projected_gain(projected_energy: FloatArray, towards: FloatArray) -> FloatArray:
    """Nats by which traces lower the cost, their changes taken up to three times, (k,) array.

    ``projected_energy``, ``towards``, (k,) arrays: as of :class:`Signatures`.
    """
    by = np.clip(towards / projected_energy, 0.0, 3.0)
    return np.asarray(np.maximum(by * towards - 0.5 * by**2 * projected_energy, 0.0))


def window_products(
    fitted: FittedModel, traces: EffectTraces
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Inner products, of some windows at a time, freed of what the windows' starts can do.

    (m, q, q) arrays: of the whitened slopes in all that is fitted, scaled, the traces, and the
    residual; q is the number of all these. With them the squared length of each trace, (m, k).
    """
    fit, objective, windows = fitted.fit, fitted.objective, fitted.structure.windows
    residuals = objective.simulated(fit.point, fit.starts, slopes=True)
    base, slopes = residuals.r, objective.slopes(residuals)
    slopes = np.where(np.isfinite(slopes), slopes, 0.0)
    scales = np.concatenate([windows.spread, objective.scales])
    n, n_f = windows.n_x, len(fit.point)
    gaps = (fit.starts - objective.centres) / windows.spread
    for j in range(0, len(windows), _AT_ONCE):
        rows = slice(j, j + _AT_ONCE)
        changes = np.moveaxis(traces.changes[:, rows], 0, -1)
        parts = [slopes[rows] * scales, changes, base[rows][..., None]]
        white = whitened_part(fitted.metric, rows, np.concatenate(parts, axis=-1))
        flat = white.reshape(white.shape[0], -1, white.shape[-1])
        gram = np.swapaxes(flat, 1, 2) @ flat
        own = gram[:, :n, :n] + np.eye(n)
        across = gram[:, :n, n:].copy()
        across[..., -1] += gaps[rows]
        inner = gram[:, n:, n:] - np.swapaxes(across, 1, 2) @ np.linalg.solve(own, across)
        yield inner, np.einsum("mii->mi", gram[:, n + n_f : -1, n + n_f : -1])


def whitened_part(metric: Metric, rows: slice, columns: FloatArray) -> FloatArray:
    """Innovations of columns (m, c, n_y, k) of some windows."""
    system, filter_ = metric.discrepancy.system, metric.filter_
    part = LinearSystem(
        system.f[rows], system.h[rows], system.measured[rows], system.r, system.start
    )
    gains = FilterGains(
        np.ascontiguousarray(filter_.k[rows]),
        np.ascontiguousarray(filter_.root[rows]),
        filter_.logdet[rows],
        None,
    )
    return whiten(part, gains, columns)
