"""The arithmetic of a sample of the gap watch, in C where there is a compiler, else in NumPy.

The formulas stand in ``filter_step.c``; both work on the same arrays, in place.
"""

import ctypes
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.core.compilation import compiled_source

#: Onsets that lie together in memory, as the compiled loop wants them.
LANES = 8
_MOST_OUTPUTS = 16
#: Innovations that the noise is learnt from, in standard deviations.
_NOISE_CLIP = 5.0


class FilterArrays:
    """The arrays of a filter with d moving states of n, and y outputs.

    ``missing``, ``gated``, ``believed`` are what a channel can be before a sample, ``used`` and
    ``held_back`` what it can be after it, with ``missing``.
    """

    missing, gated, believed = 0, 1, 2
    used, held_back = 1, -1

    def __init__(self, d: int, n: int, y: int) -> None:
        self.d, self.n, self.y = d, n, y
        self.f = np.zeros((d, n))  #: Of the moving states, from sample to sample
        self.q = np.zeros(n)  #: Variance that a sample adds to each state
        self.h = np.zeros((y, n))
        self.r = np.ones(y)  #: Variance of each channel's noise
        self.e = np.zeros(y)  #: Measured less predicted
        self.state: npt.NDArray[np.int32] = np.zeros(y, dtype=np.int32)
        self.p = np.zeros((n, n))
        self.root = np.zeros((y, y))  #: L⁻¹
        self.w = np.zeros((n, y))
        self.z = np.zeros(y)  #: Whitened innovations
        self.dx = np.zeros(n)  #: Correction of the state
        self.remainder = np.zeros(y)  #: Measured less estimated
        self.least_noise = np.zeros(y)  #: That ``r`` never falls below
        self._scratch = np.zeros(d * n + n * y + y * y)

    def update(self, *, advance: bool, gate: float, pace: float = 0.0) -> bool:
        """Predict the covariance and take a sample; False if a covariance is not positive.

        ``pace``: share of the way by which ``r`` follows what the sample says of it.
        """
        if self._compiled is None:
            return self._updated_arrays(advance, gate, pace)
        function, before, after, scratch = self._compiled
        return not function(
            int(advance), *before, ctypes.c_double(gate), *after, ctypes.c_double(pace), scratch
        )

    @cached_property
    def _compiled(self) -> tuple[Any, tuple[Any, ...], tuple[Any, ...], Any] | None:
        library = _library(self.y)
        if library is None:
            return None
        before: list[npt.NDArray[Any]] = [self.f, self.q, self.h, self.r, self.e]
        after: list[npt.NDArray[Any]] = [self.state, self.p, self.root, self.w, self.z, self.dx]
        after += [self.remainder, self.least_noise]
        places = (*(self.d, self.n, self.y), *map(_at, before))
        return library.trms_watch_update, places, tuple(map(_at, after)), _at(self._scratch)

    def _updated_arrays(self, advance: bool, gate: float, pace: float) -> bool:
        p, d = self.p, self.d
        if advance:
            t = self.f @ p
            top = t @ self.f.T
            p[:d, :d] = (top + top.T) / 2
            p[:d, d:] = t[:, d:]
            p[d:, :d] = t[:, d:].T
            p[np.diag_indices(self.n)] += self.q
        variance = np.einsum("yn,nm,ym->y", self.h, p, self.h) + self.r
        beyond = (self.state == self.gated) & (self.e**2 > gate**2 * variance)
        self.state[:] = np.where(beyond, self.held_back, np.minimum(self.state, self.used))
        unused = self.state != self.used
        self.e[unused] = 0.0
        self.h[unused] = 0.0
        c = p @ self.h.T
        s = self.h @ c + np.diag(np.where(unused, 1.0, self.r))
        try:
            lower = np.linalg.cholesky(s)
        except np.linalg.LinAlgError:
            return False
        self.root[...] = np.tril(np.linalg.inv(lower))
        self.z[:] = self.root @ self.e
        self.w[...] = c @ self.root.T
        self.dx[:] = self.w @ self.z
        p -= self.w @ self.w.T
        self.remainder[:] = self.e - self.h @ self.dx
        if pace > 0.0:
            most = _NOISE_CLIP**2 * self.r
            shown = np.clip(self.e * self.remainder, -most, most)
            follows = np.maximum(self.r + pace * (shown - self.r), self.least_noise)
            self.r[:] = np.where(unused, self.r, follows)
        return True


class SignatureArrays:
    """What changes of unit size, begun at several times, have done to a filter's estimate."""

    def __init__(self, filter_: FilterArrays, tests: int, slots: int) -> None:
        if slots % LANES:
            raise ValueError(f"{slots} slots are no multiple of {LANES}")
        self.filter, self.tests, self.slots = filter_, tests, slots
        d, n, y = filter_.d, filter_.n, filter_.y
        self.on_state = np.zeros((tests, d))  #: What a unit of each adds to the state in a sample
        self.on_outputs = np.zeros((tests, y))  #: And to the outputs
        self.live = np.zeros(slots)  #: 1 for an onset that has been, else 0
        self.signature = np.zeros((tests, slots // LANES, n, LANES))
        self.product = np.zeros((tests, slots))  #: Σ s'z
        self.energy = np.zeros((tests, slots))  #: Σ s's
        self._scratch = np.zeros((d, LANES))
        self._columns: npt.NDArray[np.int32] = np.zeros((d + y, n + 1), dtype=np.int32)

    def begin(self, slot: int) -> None:
        """Let the changes of a slot begin with the next sample."""
        self.signature[:, slot // LANES, :, slot % LANES] = 0.0
        self.product[:, slot] = self.energy[:, slot] = 0.0
        self.live[slot] = 1.0

    def clear(self) -> None:
        """Forget all onsets."""
        for array in (self.signature, self.product, self.energy, self.live):
            array[...] = 0.0

    def carry(self) -> None:
        """One sample on, after the filter's update."""
        if self._compiled is None:
            self._carried_arrays()
        else:
            function, arguments = self._compiled
            function(*arguments)

    @cached_property
    def _compiled(self) -> tuple[Any, tuple[Any, ...]] | None:
        own = self.filter
        library = _library(own.y)
        if library is None:
            return None
        arrays: list[npt.NDArray[Any]] = [own.f, own.h, own.root, own.w, own.z, own.state]
        arrays += [self.on_state, self.on_outputs, self.live, self.signature, self.product]
        arrays += [self.energy, self._scratch, self._columns]
        sizes = (own.d, own.n, own.y, self.tests, self.slots)
        return library.trms_watch_signatures, (*sizes, *map(_at, arrays))

    def _carried_arrays(self) -> None:
        own = self.filter
        live = self.live.reshape(1, -1, 1, LANES)
        before = self.signature
        moving = own.f @ before + self.on_state[:, None, :, None] * live
        before[:, :, : own.d] = moving
        reach = self.on_outputs * (own.state == own.used)
        white = own.root @ (own.h @ before + reach[:, None, :, None] * live)
        self.product += np.einsum("j,tsjk->tsk", own.z, white).reshape(self.product.shape)
        self.energy += (white**2).sum(axis=2).reshape(self.energy.shape)
        before -= own.w @ white


#: As it was when the module was read: who calls it was written for that.
_SOURCE = Path(__file__).with_name("filter_step.c").read_text(encoding="utf-8")


def _library(outputs: int) -> ctypes.CDLL | None:
    return None if outputs > _MOST_OUTPUTS else compiled_source("trms_gap_watch", _SOURCE)


def _at(array: npt.NDArray[Any]) -> ctypes.c_void_p:
    """Where an array lies; whoever keeps the address keeps the array as well."""
    return array.ctypes.data_as(ctypes.c_void_p)
