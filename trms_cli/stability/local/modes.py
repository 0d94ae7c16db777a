"""Modes of a linear model: eigenvalues with what they are of, how fast and how well damped.

Multiple eigenvalues are taken together: their eigenvectors are arbitrary, or there are too few of
them, and only the spectral projector onto their common subspace is well defined. Its diagonal is
the sum of their participation factors. It follows from the ordered Schur form and one Sylvester
equation (Golub & Van Loan, Matrix Computations, 4th ed., sec. 7.6).

A model that steps has modes ``z``; ``λ = ln z / T``. What is gone within a sample (|z| below
1e-3) is memory, as the delayed samples that a network keeps, and no mode.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy.linalg

from trms_cli.models.model import Model
from trms_cli.stability.local.linear import Matrices
from trms_cli.stability.local.parts import STILL, Part, mode_name, parts_of

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
Verdict = Literal["stable", "marginal", "unstable"]

#: Eigenvalues closer than this, relative to 1 + |λ|, are one multiple eigenvalue: a defective
#: pair computed in double precision parts by about 1e-8.
_TOGETHER = 1e-6
#: |z| below this is memory.
_FORGOTTEN = 1e-3


@dataclass(frozen=True)
class Mode:
    """An eigenvalue, or a conjugate pair by that of positive frequency."""

    name: str  #: After the states that take part
    eigenvalue: complex  #: λ, 1/s
    participation: FloatArray  #: (n_x,) array; shares of the states; they add up to 1
    right: ComplexArray  #: (n_x,) arrays; Eigenvectors with ``leftᵀ right = 1``
    left: ComplexArray  #: (n_x,) arrays; of a defective one, any of its own
    multiplicity: int = 1  #: How many equal eigenvalues it stands for
    #: Whether they have fewer eigenvectors than that: motions grow as t e^{λt}
    defective: bool = False
    alternating: bool = False  #: Whether it changes sign at each sample of a model that steps

    @property
    def oscillates(self) -> bool:
        return self.eigenvalue.imag > STILL

    @property
    def natural_frequency(self) -> float:
        """|λ|, rad/s."""
        return abs(self.eigenvalue)

    @property
    def damped_frequency(self) -> float:
        """Im λ, rad/s; 0 for one that does not swing."""
        return self.eigenvalue.imag if self.oscillates else 0.0

    @property
    def damping_ratio(self) -> float | None:
        """−Re λ/|λ|; None where nothing moves."""
        size = abs(self.eigenvalue)
        return None if size <= STILL else -self.eigenvalue.real / size

    @property
    def time_constant(self) -> float | None:
        """1/|Re λ|, s: to decay, or grow, by a factor e; None where it does neither."""
        rate = abs(self.eigenvalue.real)
        return None if rate <= STILL else 1.0 / rate

    @property
    def verdict(self) -> Verdict:
        if self.eigenvalue.real > STILL:
            return "unstable"
        if self.eigenvalue.real < -STILL:
            return "stable"
        return "unstable" if self.defective else "marginal"


@dataclass(frozen=True)
class Modes:
    """All modes of a linear model."""

    modes: tuple[Mode, ...]  #: The slowest last
    forgotten: int = 0  #: States that are memory and gone within a sample

    @property
    def verdict(self) -> Verdict:
        """Of the whole."""
        found = {mode.verdict for mode in self.modes}
        if "unstable" in found:
            return "unstable"
        return "marginal" if "marginal" in found else "stable"


def rate_of(value: complex, sample_time: float | None) -> complex:
    """λ in 1/s from an eigenvalue of A; −∞ for a z of zero."""
    if sample_time is None:
        return complex(value)
    if abs(value) < 1e-300:
        return complex(-math.inf, 0.0)
    return complex(np.log(complex(value)) / sample_time)


def modes_of(model: Model, matrices: Matrices) -> Modes:
    """The modes of a linear model of ``model``."""
    return modes_of_matrix(matrices.a, parts_of(model), matrices.sample_time)


def modes_of_matrix(
    a: FloatArray, parts: tuple[Part, ...], sample_time: float | None = None
) -> Modes:
    """The modes of a matrix.

    Parameters
    ----------
    a : (n, n) array
    parts : tuple of Part
        What each state is of.
    sample_time : float or None
        s, of a step; None for a derivative.
    """
    values, left, right = spectrum(a)
    found, forgotten = [], 0
    for group in _together(values):
        value = complex(values[group].mean())
        if sample_time is not None and abs(value) < _FORGOTTEN:
            forgotten += len(group) * (2 if value.imag > STILL else 1)
            continue
        if abs(value.imag) <= _TOGETHER * (1.0 + abs(value)) and len(group) > 1:
            value = complex(value.real, 0.0)
        i = group[0]
        if len(group) == 1:
            share, defective = np.abs(left[:, i] * right[:, i]), False
        else:
            share, defective = _joint(a, values[group], value)
        participation = share / share.sum()
        rate = rate_of(value, sample_time)
        found.append(
            Mode(
                mode_name(parts, participation, rate),
                rate,
                participation,
                right[:, i],
                left[:, i],
                len(group),
                defective,
                sample_time is not None and value.real < 0 and abs(value.imag) <= STILL,
            )
        )
    found.sort(key=lambda mode: (-abs(mode.eigenvalue), mode.name))
    return Modes(tuple(_told_apart(found)), forgotten)


def spectrum(a: FloatArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Eigenvalues and the left and right eigenvectors as columns, ``leftᵢᵀ rightᵢ = 1``.

    Where a defective eigenvalue makes that impossible the product is kept off zero.
    """
    values, left, right = scipy.linalg.eig(a, left=True, right=True)
    left = left.conj()  # scipy's are of vᴴA = λvᴴ
    product = np.sum(left * right, axis=0)
    small = np.abs(product) < 1e-14
    product = np.where(small, 1e-14, product)
    return values.astype(complex), (left / product).astype(complex), right.astype(complex)


def _together(values: ComplexArray) -> list[list[int]]:
    """Positions of equal eigenvalues, of those with positive frequency or none."""
    rounding = 1e-12 * (1.0 + float(np.abs(values).max(initial=0.0)))
    groups: list[list[int]] = []
    for i in np.argsort(-np.abs(values), kind="stable"):
        value = values[i]
        near = _TOGETHER * (1.0 + abs(value))
        # A multiple real eigenvalue may have parted into a conjugate pair by rounding.
        if value.imag < -max(near, rounding):
            continue
        for group in groups:
            if min(abs(values[j] - value) for j in group) <= near:
                group.append(int(i))
                break
        else:
            groups.append([int(i)])
    # What rounding put just below the axis stays only beside its partner.
    return [group for group in groups if values[group].mean().imag >= -rounding]


def _joint(a: FloatArray, values: ComplexArray, value: complex) -> tuple[FloatArray, bool]:
    """Participation of a multiple eigenvalue, and whether it lacks eigenvectors."""
    balanced, scales = scipy.linalg.matrix_balance(a, permute=False, separate=False)[:2]
    reach = 2.0 * max(float(np.abs(values - value).max()), _TOGETHER * (1.0 + abs(value)))
    form, basis, count = scipy.linalg.schur(
        balanced, output="complex", sort=lambda z: abs(z - value) <= reach
    )
    own, rest, cross = form[:count, :count], form[count:, count:], form[:count, count:]
    projector = np.zeros_like(form)
    projector[:count, :count] = np.eye(count)
    if count < len(form):
        projector[:count, count:] = scipy.linalg.solve_sylvester(own, -rest, cross)
    projector = basis @ projector @ basis.conj().T
    # The diagonal of a projector does not depend on the balancing's scales.
    del scales
    chained = np.abs(own - np.diag(np.diag(own))).max(initial=0.0)
    return np.abs(np.diag(projector)), bool(chained > 1e-5 * (1.0 + abs(value)))


def _told_apart(modes: Sequence[Mode]) -> list[Mode]:
    """Equal names with a word of what differs."""
    found = list(modes)
    for name in {mode.name for mode in modes}:
        same = [i for i, mode in enumerate(found) if mode.name == name]
        if len(same) < 2:
            continue
        words = ("faster", "slower") if len(same) == 2 else [str(k + 1) for k in range(len(same))]
        for i, word in zip(same, words, strict=True):
            found[i] = replace(found[i], name=f"{name} ({word})")
    return found
