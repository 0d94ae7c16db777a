"""How well recordings show effects and tell them apart, in nats, by the traces that they leave."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from trms_cli.gap.candidates import Suspect
from trms_cli.gap.fitting.contestant import Contestant, Fit
from trms_cli.gap.fitting.metric import Metric
from trms_cli.gap.separability import Signatures, projected, traces

FloatArray = npt.NDArray[np.float64]

#: Multiples of a fitted size at which an effect may imitate another: its trace changes its shape
#: with the size, and a fit would choose the size that imitates best.
_MULTIPLES = (1.0, 0.65, 1.5)
#: Rows of an effect whose size is not known.
_MOST_ROWS = 6
#: Squared length, in noise variances, below which a trace at a fitted size is nothing to compare.
_NOTHING = 1.0


@dataclass(frozen=True)
class Recording:
    """A recording, made or imagined, with all that traces are projected in."""

    contestant: Contestant  #: Of the nominal model
    fit: Fit
    metric: Metric
    centres: FloatArray  #: (m, n_x) array

    def signatures(self, suspects: Sequence[Suspect]) -> Signatures:
        """Projected traces of some effects at their variants."""
        problem = self.contestant.problem

        def contestant_of(suspect: Suspect) -> Contestant:
            return Contestant(
                problem.model, problem.free, [suspect], problem.datasets, problem.window_length
            )

        found = traces(self.contestant, self.fit, suspects, contestant_of)
        return projected(self.contestant, self.fit, self.metric, self.centres, found)


def with_rows(suspect: Suspect, values: Mapping[str, float]) -> Suspect:
    """The suspect at its fitted sizes first, then about them; or at typical ones where unknown.

    Parameters
    ----------
    suspect : Suspect
    values : dict of str to float
        Fitted values by name, ``<effect>.<size>``.
    """
    if not is_fitted(suspect, values):
        rows = suspect.variants
        chosen = np.unique(np.linspace(0, len(rows) - 1, _MOST_ROWS).round().astype(int))
        return replace(suspect, variants=rows[chosen])
    row = np.array([values[size.name] for size in suspect.free])
    lower = np.array([size.lower for size in suspect.free])
    upper = np.array([size.upper for size in suspect.free])
    # what vanishes at zero is scaled; a size that gives the shape stays as it was fitted
    scaled = np.array([i == 0 or size.prior_mean == 0.0 for i, size in enumerate(suspect.free)])
    every = [np.clip(np.where(scaled, row * by, row), lower, upper) for by in _MULTIPLES]
    return replace(suspect, variants=np.array(every))


def is_fitted(suspect: Suspect, values: Mapping[str, float]) -> bool:
    """Whether a fit told all sizes of an effect."""
    return bool(suspect.free) and all(size.name in values for size in suspect.free)


def between(signs: Signatures, one: str, other: str, fitted: Sequence[str]) -> float:
    """Nats between two effects, the smaller of: one is true, or the other is.

    ``½ left (1 − cos²)``: what is left of the true one's trace when the other, its size free,
    imitates it as well as it can. The true one is taken at its fitted size, the first row, or at
    the median of those that are typical.
    """
    return min(
        _beyond(signs, one, other, one in fitted), _beyond(signs, other, one, other in fitted)
    )


def visibility(signs: Signatures, name: str, rows: Sequence[int] | None = None) -> float:
    """Nats by which an effect shows at the best of its rows (or of some of them)."""
    chosen = signs.rows(name)
    if rows is not None:
        chosen = chosen[[row for row in rows if row < len(chosen)]]
    return 0.5 * float(np.max(signs.left[chosen])) if len(chosen) else 0.0


def _beyond(signs: Signatures, true: str, imitator: str, fitted: bool) -> float:
    own, others = signs.rows(true), signs.rows(imitator)
    if not len(own):
        return 0.0
    # a trace cannot be turned round by its size: where it can, both signs are among the rows
    cosine = np.clip(signs.cosine[np.ix_(own, others)], 0.0, 1.0)
    alike = cosine.max(axis=1, initial=0.0)
    nats = 0.5 * signs.left[own] * (1 - alike**2)
    if fitted and signs.left[own[0]] > _NOTHING:
        return float(nats[0])
    return float(np.median(nats))
