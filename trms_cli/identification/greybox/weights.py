"""How much a residual counts: noise, what the model cannot follow, correlation, outliers.

The cost of a fit is

    ½ Σ_c 1/φ_c Σ_t ρ(r_c(t)/σ_c)  +  priors

with Huber's ρ (Annals of Mathematical Statistics 35, 1964), twice the usual scale so that it is
r² for small r. ``σ_c`` is the declared noise of channel c or the residuals' own size, whichever
is larger; ``φ_c`` ≥ 1 is the number of samples that together say as much as one would if the
residuals were white. Residuals of a model with an error of its own are correlated over seconds;
counted as white they would drown the priors and all doubt.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Weights:
    """Scales of the residuals."""

    sd: FloatArray  #: (m, n_y) array; by window and output
    samples: FloatArray  #: (n_y,) array; φ of each output
    share: float  #: Weight of each squared residual where windows overlap
    robust: float | None  #: Huber's threshold

    @property
    def trust(self) -> FloatArray:
        """Factor of each output's squared whitened residuals, shape (n_y,)."""
        trust: FloatArray = self.share / self.samples
        return trust

    def whitened(self, r: FloatArray) -> FloatArray:
        """Residuals (m, c, n_y) over their standard deviation."""
        whitened: FloatArray = r / self.sd[:, None]
        return whitened

    def cost(self, r: FloatArray) -> float:
        """The data's part of the cost, from residuals (m, c, n_y) that are not whitened."""
        return float(self.costs(r).sum())

    def costs(self, r: FloatArray) -> FloatArray:
        """The same by window, shape (m,)."""
        z = self.whitened(r)
        loss = z**2
        if self.robust is not None:
            size = np.abs(z)
            far = size > self.robust
            loss = np.where(far, 2 * self.robust * size - self.robust**2, loss)
        costs: FloatArray = 0.5 * (loss.sum(axis=1) @ self.trust)
        return costs

    def roots(self, r: FloatArray) -> FloatArray:
        """Factors (m, c, n_y) of residuals and slopes whose squares make the cost's parabola.

        Iteratively reweighted least squares: the parabola touches the cost at ``r`` and lies
        above it elsewhere.
        """
        factors = np.sqrt(self.trust) / self.sd[:, None]
        if self.robust is None:
            return np.broadcast_to(factors, r.shape)
        size = np.abs(self.whitened(r))
        roots: FloatArray = factors * np.sqrt(self.robust / np.maximum(size, self.robust))
        return roots


def sizes(r: FloatArray, measured: BoolArray, declared: FloatArray) -> FloatArray:
    """Root mean square of each output's residuals over their declared deviation, shape (n_y,).

    The largest hundredth counts as its smallest member, so that outliers do not make all else
    cheap.

    Parameters
    ----------
    r, measured : (m, c, n_y) arrays
    declared : (m, n_y) array
    """
    z = np.abs(r / declared[:, None])
    found = np.ones(r.shape[2])
    for i in range(r.shape[2]):
        here = z[..., i][measured[..., i]]
        if len(here):
            found[i] = np.sqrt(np.mean(np.minimum(here, np.quantile(here, 0.99)) ** 2))
    return found
