"""Multisines of low crest factor, the inputs on interleaved frequencies.

The phases start as Schroeder's (1970, IEEE Trans. Information Theory 16(1)) and are improved by
minimising the L_p norm for p = 4, 8, … (P. Guillaume, J. Schoukens, R. Pintelon & I. Kollár,
"Crest-factor minimization using nonlinear Chebyshev approximation methods", IEEE Trans.
Instrumentation and Measurement 40(6), 1991): the larger p, the nearer to the peak itself.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.excitation import excitation

#: Points a period of the highest harmonic at which the peak is looked for.
_POINTS = 16
#: Norms that are minimised one after the other, and iterations for each.
_NORMS = (4, 8, 16, 32, 64, 128, 256)


@dataclass(frozen=True, kw_only=True)
class MultisineExcitation:
    """Equally strong sines, no frequency shared by two inputs."""

    #: Frequencies of each input, about evenly spaced on a logarithmic scale
    lines: Annotated[int, Meta(ge=2, le=2000)] = 40
    #: How often the signal repeats within the duration: two or more tell noise from distortion
    periods: Annotated[int, Meta(ge=1)] = 1
    iterations: Annotated[int, Meta(ge=0)] = 60  #: Of each norm at most; 0: Schroeder's phases

    def shape(self, plan: excitation.Plan) -> excitation.Shape:
        """The signals; see :class:`Excitation`."""
        excitation.check_band(plan)
        period = plan.duration / self.periods
        harmonics = self._harmonics(plan, period)
        signals, before = [], []
        for own in harmonics:
            first = schroeder_phases(len(own))
            phases = low_crest_phases(own, first, self.iterations)
            before.append(excitation.crest_factor(_sum(own, first, _fine(own))))
            signals.append(_sum(own, phases, plan.time / period))
        return excitation.shape_of(
            signals,
            frequencies_hz=[(own / period).tolist() for own in harmonics],
            period_s=period,
            crest_factor_schroeder=before,
        )

    def _harmonics(self, plan: excitation.Plan, period: float) -> list[IntArray]:
        """Of each input; every one belongs to one input only."""
        first = int(np.ceil(plan.lowest * period - 1e-9))
        last = int(np.floor(plan.highest * period + 1e-9))
        if first < 1 or last - first + 1 < 2 * plan.inputs:
            raise ConfigurationError(
                f"a period of {period:g} s has {max(last - max(first, 1) + 1, 0)} harmonics from "
                f"{plan.lowest:.4g} to {plan.highest:.4g} Hz",
                where="excitation.periods",
                remedy="a longer duration, fewer periods or a wider band",
            )
        ideal_lines = np.geomspace(first, last, self.lines * plan.inputs)
        free = np.unique(np.round(ideal_lines).astype(np.int64))
        return [free[i :: plan.inputs] for i in range(plan.inputs)]


def schroeder_phases(lines: int) -> FloatArray:
    """−π k(k − 1)/K for k = 1 … K, rad."""
    k = np.arange(1, lines + 1)
    return -np.pi * k * (k - 1) / lines


def low_crest_phases(harmonics: IntArray, phases: FloatArray, iterations: int) -> FloatArray:
    """Phases with a lower peak of ``Σ cos(2π k τ + φ_k)`` than the ones given, (K,) rad.

    ``harmonics``: (K,) array. ``iterations``: for each of the norms. Never worse than the start.
    """
    if iterations == 0:
        return phases
    from scipy.optimize import minimize

    points = len(_fine(harmonics))

    def cost(trial: FloatArray, norm: int) -> tuple[float, FloatArray]:
        """log of the L_p norm, and its slopes."""
        spectrum = np.zeros(points // 2 + 1, dtype=complex)
        spectrum[harmonics] = np.exp(1j * trial)
        x = np.fft.irfft(spectrum, points) * points / 2
        largest = float(np.abs(x).max())
        share = x / largest
        powers = share**norm
        total = float(powers.sum())
        weights = np.fft.rfft(share ** (norm - 1))[harmonics] / (total * largest)
        # d x/dφ_k = −sin(2π k τ + φ_k): the imaginary part of its product with the weights.
        return np.log(largest) + np.log(total) / norm, -np.imag(np.exp(1j * trial) * weights.conj())

    best, lowest = phases, _peak(harmonics, phases)
    trial = phases
    for norm in _NORMS:
        options = {"maxiter": iterations}
        trial = minimize(cost, trial, args=(norm,), jac=True, method="L-BFGS-B", options=options).x
        peak = _peak(harmonics, trial)
        if peak < lowest:
            best, lowest = trial, peak
    return np.asarray(best)


def _fine(harmonics: IntArray) -> FloatArray:
    """Phases of a period, dense enough for the peak."""
    points = 1 << int(np.ceil(np.log2(_POINTS * int(harmonics[-1]))))
    return np.arange(points) / points


def _peak(harmonics: IntArray, phases: FloatArray) -> float:
    return float(np.abs(_sum(harmonics, phases, _fine(harmonics))).max())


def _sum(harmonics: IntArray, phases: FloatArray, cycles: FloatArray) -> FloatArray:
    total = np.zeros(len(cycles))
    for k, phase in zip(harmonics, phases, strict=True):
        total += np.cos(2 * np.pi * k * cycles + phase)
    return total
