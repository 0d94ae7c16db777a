"""What inputs can move and sensors can see, mode by mode.

The test of Popov, Belevitch and Hautus (PBH): the eigenvalue λ is controllable by B if and only if
``[λI − A, B]`` has full rank; its smallest singular value, in scaled units, is how much of a change
of A and B takes it away (Eising 1984, Syst. Control Lett. 4). What the inputs reach is exactly the
span of the Krylov matrix ``[B, AB, …]``: where a mode is out of reach, its left eigenvector is
orthogonal to B, which is told as zero when it is below what the operating point is exact to.

Sensors are the dual: ``[λI − A; C]`` and the right eigenvector.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from trms_cli.stability.local.linear import Matrices
from trms_cli.stability.local.modes import Mode
from trms_cli.stability.local.parts import STILL
from trms_cli.stability.local.scales import Scales

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
Grade = Literal["none", "weak", "yes"]

#: Margins below this, relative to the scaled matrices' size, are rounding.
_ROUNDING = 1e-10
#: Strengths below this are none: an operating point is as exact as that.
_NOTHING = 1e-8
#: A full command that pumps a mode to less than this share of a motion worth speaking of, or a
#: motion that reads as less than this many standard deviations of the noise, is weak.
WEAK_REACH, WEAK_SIGHT = 1.0, 3.0


@dataclass(frozen=True)
class Reach:
    """What an input, or a sensor set, has to do with a mode."""

    #: Smallest singular value of the scaled PBH matrix, 1/s (1 of a model that steps). Zero: out of
    #: reach.
    margin: float
    #: Of inputs: how far a full command can pump the mode in the time given, relative to a motion
    #: worth speaking of. Of sensors: the reading of such a motion in standard deviations.
    strength: float
    grade: Grade


def controllable(
    matrices: Matrices, scales: Scales, mode: Mode, inputs: list[int], duration: float
) -> Reach:
    """How well some inputs move a mode."""
    a, b = _scaled_a(matrices.a, scales), _scaled_b(matrices.b, scales)[:, inputs]
    margin, floor = _margin(a, b, _value(mode, matrices))
    # w in scaled states, its own motion of size one.
    left, _ = _eigenvectors(mode, scales)
    driving = np.abs(left @ b)
    size = float(driving.sum()) * _pumping(mode, duration, matrices.sample_time)
    return _graded(mode, margin, floor, size, WEAK_REACH)


def observable(matrices: Matrices, scales: Scales, mode: Mode, outputs: list[int]) -> Reach:
    """How well some sensors see a mode."""
    a = _scaled_a(matrices.a, scales)
    c = (matrices.c * scales.x[None, :] / scales.y[:, None])[outputs]
    margin, floor = _margin(a.T, _normalised(c).T, _value(mode, matrices))
    _, right = _eigenvectors(mode, scales)
    return _graded(mode, margin, floor, float(np.abs(c @ right).max(initial=0.0)), WEAK_SIGHT)


def _margin(a: FloatArray, b: FloatArray, value: complex) -> tuple[float, float]:
    """Smallest singular value of [λI − A, B], and what of it would be rounding."""
    pencil = np.hstack([value * np.eye(len(a)) - a, b])
    values = np.linalg.svd(pencil, compute_uv=False)
    return float(values[-1]), _ROUNDING * float(max(1.0, values[0]))


def _graded(mode: Mode, margin: float, floor: float, strength: float, weak: float) -> Reach:
    # One eigenvector of several says nothing of the others: there the margin decides.
    none = strength <= _NOTHING or (mode.multiplicity > 1 and margin <= floor)
    if none:
        return Reach(0.0, strength if mode.multiplicity > 1 else 0.0, "none")
    return Reach(margin, strength, "weak" if strength < weak else "yes")


def _pumping(mode: Mode, duration: float, sample_time: float | None) -> float:
    """∫₀ᵀ e^{Re λ t} dt: what a command in step with the mode adds up to; per sample of a step."""
    rate = mode.eigenvalue.real
    total = duration if abs(rate) * duration < 1e-9 else float(np.expm1(rate * duration) / rate)
    return total if sample_time is None else total / sample_time


def _eigenvectors(mode: Mode, scales: Scales) -> tuple[ComplexArray, ComplexArray]:
    """Left and right in scaled states, the largest entry of the right one of size one."""
    right = mode.right / scales.x
    left = mode.left * scales.x
    size = float(np.abs(right).max())
    return left * size, right / size


def _value(mode: Mode, matrices: Matrices) -> complex:
    if matrices.sample_time is None:
        value = mode.eigenvalue
    else:
        value = complex(np.exp(mode.eigenvalue * matrices.sample_time))
    return value if abs(value.imag) > STILL else complex(value.real)


def _scaled_a(a: FloatArray, scales: Scales) -> FloatArray:
    scaled: FloatArray = a * scales.x[None, :] / scales.x[:, None]
    return scaled


def _scaled_b(b: FloatArray, scales: Scales) -> FloatArray:
    scaled: FloatArray = b * scales.u[None, :] / scales.x[:, None]
    return scaled


def _normalised(c: FloatArray) -> FloatArray:
    """Rows of size one: a margin is to tell structure, not the quality of the sensor."""
    size = np.abs(c).max(axis=1, keepdims=True, initial=0.0)
    rows: FloatArray = c / np.where(size > 0, size, 1.0)
    return rows
