"""What a study of controllability found, before it is told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.models.model import Model
from trms_cli.stability.local.access import Gramians, ModeAccess, ReachAlong
from trms_cli.stability.local.linear import Matrices
from trms_cli.stability.local.scales import Scales
from trms_cli.stability.local.sweep import Path, Sweep
from trms_cli.stability.local.torques import TorquesSeen
from trms_cli.stability.operating_point import OperatingPoint

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Found:
    """What was found at the operating point.

    Attributes
    ----------
    model : Model
    point : OperatingPoint
    matrices : Matrices
    scales : Scales
    duration, reading_time : float
        s.
    sets : tuple of tuple of str
        Sensors.
    access : tuple of ModeAccess
    volts : (n_x, n_u) array
        Least rms command that moves each state by its size.
    gramians : Gramians
    torques : dict
        By set of sensors; the first error is that after ``duration``, the others after ``times``.
    times : tuple of float
        s.
    """

    model: Model
    point: OperatingPoint
    matrices: Matrices
    scales: Scales
    duration: float
    reading_time: float
    sets: tuple[tuple[str, ...], ...]
    access: tuple[ModeAccess, ...]
    volts: FloatArray
    gramians: Gramians
    torques: Mapping[tuple[str, ...], TorquesSeen]
    times: tuple[float, ...]


@dataclass(frozen=True)
class Along:
    """What was found over the range.

    Attributes
    ----------
    path : Path
    sweep : Sweep
    reach : ReachAlong
    """

    path: Path
    sweep: Sweep
    reach: ReachAlong
