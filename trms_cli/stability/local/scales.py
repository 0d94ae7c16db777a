"""Sizes that make numbers of different units comparable: states, inputs, sensors, disturbances.

An angle counts as 0.1 rad and its rate as 0.1 rad/s, an input as its limit. Any other state
counts as a tenth of what a full command moves it by in the end (``−A⁺B u_max``): a rotor's speed,
a current.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.models.model import Model
from trms_cli.stability.local.linear import Matrices
from trms_cli.stability.local.parts import parts_of

FloatArray = npt.NDArray[np.float64]

#: rad, rad/s: a motion of an axis worth speaking of.
MOTION = 0.1
_SHARE = 0.1


@dataclass(frozen=True)
class Scales:
    """Sizes, each in its own unit."""

    x: FloatArray  #: (n_x,) array
    u: FloatArray  #: (n_u,) array; limits
    y: FloatArray  #: (n_y,) array; standard deviation of one reading of each output


def scales_of(model: Model, matrices: Matrices, angle_noise: float, other_noise: float) -> Scales:
    """The usual sizes of a model.

    Parameters
    ----------
    matrices : Matrices
        At an operating point where inputs act.
    angle_noise : float
        rad, of an angle's reading.
    other_noise : float
        Of any other reading, in its unit (rad/s of a tachometer).
    """
    limit = np.array([model.input_limits[signal.name] for signal in model.inputs])
    limit = np.where(np.isfinite(limit), limit, 1.0)
    a = matrices.a if matrices.sample_time is None else matrices.a - np.eye(len(matrices.a))
    moved = np.abs(np.linalg.pinv(a, rcond=1e-9) @ matrices.b) @ limit
    x = np.empty(model.n_x)
    for i, part in enumerate(parts_of(model)):
        motion = part.name in model.axes or model.states[i].unit == "rad"
        x[i] = MOTION if motion else (_SHARE * moved[i] if moved[i] > 1e-9 else 1.0)
    y = np.array([angle_noise if s.unit == "rad" else other_noise for s in model.outputs])
    return Scales(x, limit, y)
