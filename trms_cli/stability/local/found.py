"""What a study of controllability found, before it is told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.local.access import Gramians, ModeAccess, ReachAlong
from trms_cli.stability.local.linear import Matrices
from trms_cli.stability.local.scales import Scales
from trms_cli.stability.local.sweep import Path, Sweep
from trms_cli.stability.local.torques import TorquesSeen

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Found:
    """What was found at the operating point."""

    model: Model
    point: OperatingPoint
    matrices: Matrices
    scales: Scales
    duration: float  #: s
    reading_time: float  #: s
    sets: tuple[tuple[str, ...], ...]  #: Sensors
    access: tuple[ModeAccess, ...]
    volts: FloatArray  #: (n_x, n_u) array; least rms command that moves each state by its size
    gramians: Gramians
    #: By set of sensors; the first error is that after ``duration``, the others after ``times``
    torques: Mapping[tuple[str, ...], TorquesSeen]
    times: tuple[float, ...]  #: s


@dataclass(frozen=True)
class Along:
    """What was found over the range."""

    path: Path
    sweep: Sweep
    reach: ReachAlong
