"""Which parameters the data tell apart, and which they do not.

Brun, Reichert & Künsch (2001, Water Resources Research 37) call a set of parameters collinear when
the change that one of them makes can nearly be made up for by the others: with the normalised
columns of the set's sensitivities, ``γ = 1/√λ_min`` of their Gram matrix. From γ of about 10 to 15
on a set cannot be identified together: 1/γ of the effect of one is all that the others cannot
imitate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from trms_cli.identification.greybox.information import Information

FloatArray = npt.NDArray[np.float64]

#: Brun's threshold.
COLLINEAR = 15.0
#: Share of the prior's deviation above which the data have said next to nothing.
_UNINFORMED = 0.9
#: Sets of up to so many parameters are looked at.
_LARGEST_SET = 4


@dataclass(frozen=True)
class Confounded:
    """Parameters whose effects on these data imitate each other."""

    names: tuple[str, ...]  #: A smallest set: without any one of them the others can be told apart
    index: float  #: Collinearity γ


@dataclass(frozen=True)
class Identifiability:
    """What the data alone say of each parameter."""

    #: Standard deviation after the data over that before; only where there is a prior
    prior_remaining: dict[str, float]
    #: γ of each parameter against all others: how many times its own effect is larger than what of
    #: it the others cannot imitate
    collinearity: dict[str, float]
    confounded: tuple[Confounded, ...]  #: The worst first
    silent: tuple[str, ...]  #: Parameters that these data do not depend on at all
    #: Parameters of which the data say next to nothing, so that the prior decided: those of whose
    #: prior's deviation more than nine tenths remain, and the silent ones
    uninformed: tuple[str, ...]


def identifiability(
    information: Information, names: Sequence[str], covariance: FloatArray
) -> Identifiability:
    """Judge the parameters of a fit.

    Parameters
    ----------
    information : Information
    names : sequence of str
    covariance : (n_f, n_f) array
        Of the estimate, in the parameters' units.
    """
    fisher = information.of_data
    size = np.sqrt(np.diag(fisher))
    loud = size > 1e-9 * max(float(size.max(initial=0.0)), 1e-300)
    heard = np.flatnonzero(loud).tolist()
    gram = fisher[np.ix_(heard, heard)] / np.outer(size[heard], size[heard])
    sd = np.sqrt(np.diag(covariance))
    remaining = {
        name: float(sd[i] / information.scales[i])
        for i, name in enumerate(names)
        if information.prior[i] > 0
    }
    against_all = _against_all(gram)
    silent = tuple(names[i] for i in np.flatnonzero(~loud).tolist())
    return Identifiability(
        remaining,
        {names[i]: float(against_all[k]) for k, i in enumerate(heard)},
        tuple(_confounded(gram, [names[i] for i in heard])),
        silent,
        tuple(n for n in names if remaining.get(n, 0.0) > _UNINFORMED or n in silent),
    )


def correlations(covariance: FloatArray) -> FloatArray:
    """Correlation matrix; NaN beside a parameter without variance, its own included."""
    sd = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        found: FloatArray = covariance / np.outer(sd, sd)
    return found


def _against_all(gram: FloatArray) -> FloatArray:
    """γ of each column against all the others: the root of its variance inflation."""
    inverse = np.linalg.pinv(gram, rcond=1e-14, hermitian=True)
    inflation: FloatArray = np.sqrt(np.maximum(np.diag(inverse), 1.0))
    return inflation


def _confounded(gram: FloatArray, names: Sequence[str]) -> list[Confounded]:
    found: list[tuple[tuple[int, ...], float]] = []
    for size in range(2, min(_LARGEST_SET, len(names)) + 1):
        sets = np.array(list(combinations(range(len(names)), size)))
        for known, _ in found:  # a larger set around a known one says nothing new
            inside = np.isin(sets, known).sum(axis=1) == len(known)
            sets = sets[~inside]
        if not len(sets):
            break
        least = np.linalg.eigvalsh(gram[sets[:, :, None], sets[:, None, :]])[:, 0]
        index = 1 / np.sqrt(np.maximum(least, 1e-16))
        bad = np.flatnonzero(index > COLLINEAR)
        found += [(tuple(sets[k].tolist()), float(index[k])) for k in bad]
    found.sort(key=lambda item: -item[1])
    return [Confounded(tuple(names[i] for i in rows), index) for rows, index in found]
