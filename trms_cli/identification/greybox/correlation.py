"""How residuals hang together in time, and what that does to the parameters' covariance.

Residuals of a good fit are not white: an encoder's rounding stays the same while the beam is slow,
and what a model misses lasts for seconds. With slopes ``B̃`` of the whitened residuals in the
parameters (the windows' starts eliminated) the score ``Σ B̃ᵀ r`` then has the covariance

    M = Σ_c Σ_{s,t} B̃_c(s)ᵀ γ_c(t − s) B̃_c(t)

with γ_c the autocovariance of channel c, estimated from the residuals, tapered by Parzen's window
so that M stays positive (Newey & West 1987, Econometrica 55, with the autocovariance pooled over
all windows instead of that of the products: 15 parameters cannot be told from a dozen windows).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


def autocovariance(z: FloatArray, measured: BoolArray, lags: int) -> FloatArray:
    """Tapered autocovariance of each channel's residuals, shape (n_y, lags + 1).

    Parameters
    ----------
    z : (m, c, n_y) array
        Whitened residuals, 0 where nothing was measured.
    measured : (m, c, n_y) array of bool
    lags : int
        The longest, in samples.
    """
    size = 2 ** int(np.ceil(np.log2(z.shape[1] + lags + 1)))
    spectrum = np.fft.rfft(z, size, axis=1)
    raw = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=1)[:, : lags + 1].sum(axis=0)
    # Divided by the number of samples, not of pairs: only so is it positive at all frequencies.
    count = np.maximum(measured.sum(axis=(0, 1)), 1)
    tapered: FloatArray = (raw / count).T * parzen(lags)
    return tapered


def parzen(lags: int) -> FloatArray:
    """Parzen's lag window, 1 at lag 0 and 0 beyond the last, shape (lags + 1,)."""
    x = np.arange(lags + 1) / (lags + 1)
    return np.where(x <= 0.5, 1 - 6 * x**2 + 6 * x**3, 2 * (1 - x) ** 3)


def score_covariances(slopes: FloatArray, gamma: FloatArray) -> FloatArray:
    """Covariance of each channel's part of the score, shape (n_y, n_f, n_f).

    Parameters
    ----------
    slopes : (m, c, n_y, n_f) array
        Of the whitened residuals; 0 where nothing was measured.
    gamma : (n_y, lags + 1) array
    """
    lags = gamma.shape[1] - 1
    length = slopes.shape[1]
    size = 2 ** int(np.ceil(np.log2(length + lags)))
    kernel = np.zeros((gamma.shape[0], size))
    kernel[:, : lags + 1] = gamma
    kernel[:, size - lags :] = gamma[:, :0:-1]
    density = np.fft.rfft(kernel, axis=1).real  # (n_y, frequencies)
    found = []
    for c in range(slopes.shape[2]):
        spectrum = np.fft.rfft(slopes[:, :, c], size, axis=1)
        smooth = np.fft.irfft(spectrum * density[c][None, :, None], size, axis=1)[:, :length]
        found.append(np.einsum("mtf,mtg->fg", slopes[:, :, c], smooth))
    matrices = np.array(found)
    symmetric: FloatArray = (matrices + matrices.swapaxes(1, 2)) / 2
    return symmetric
