"""What an observer is told of noise and of its own ignorance: tables by kind of state.

A kind (an angle, a rotor's speed, a torque on an axis) is read off the model's structure, so that
one table serves every model; see :mod:`trms_cli.models.state_kinds`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest

FloatArray = npt.NDArray[np.float64]
Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]


class ProcessNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Intensities of white noise on the states: over T seconds a state spreads by ``q·√T``."""

    angle: NotNegative = 2e-4  #: rad/√s
    momentum: NotNegative = 0.02  #: (rad/s)/√s, on angular momenta over inertia
    rotor: NotNegative = 3.0  #: (rad/s)/√s, on rotor speeds
    current: NotNegative = 0.05  #: A/√s
    other: NotNegative = 0.01  #: State's unit/√s, on states that effects add
    disturbance: NotNegative = 2e-3  #: N m/√s, the random walk of the estimated torques on the axes
    #: N m/√s, the same on the rotors, whose own torques are a tenth of the axes'
    rotor_disturbance: NotNegative = 2e-4
    #: ``acceleration``, ``rotor_acceleration``: rad/s²/√s, the same for a black box, which knows
    #: accelerations in place of torques
    acceleration: NotNegative = 0.05
    rotor_acceleration: NotNegative = 8.0
    #: (rad/s)/√s, on the rotor speeds of a black box. Its steady state shifts with the noise of
    #: what it is given, by the curvature of its surface: it is better told little of it.
    speed: NotNegative = 0.5
    #: State's unit/√s, on states that only remember an output or input; what was, stays
    past: NotNegative = 0.0
    #: Other values for single states (or disturbances), by name
    states: Mapping[str, NotNegative] = {}


class InitialSd(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Standard deviations before the first measurement; units as the states'."""

    angle: Positive = 0.1  #: rad, rad/s, rad/s, A, the state's unit
    momentum: Positive = 0.1  #: rad, rad/s, rad/s, A, the state's unit
    rotor: Positive = 20.0  #: rad, rad/s, rad/s, A, the state's unit
    current: Positive = 0.2  #: rad, rad/s, rad/s, A, the state's unit
    other: Positive = 0.1  #: rad, rad/s, rad/s, A, the state's unit
    #: ``disturbance``, ``rotor_disturbance``: N m, of the torques on the axes and on the rotors
    disturbance: Positive = 0.01
    rotor_disturbance: Positive = 0.002
    #: ``acceleration``, ``rotor_acceleration``: rad/s², of what a black box has in place of torques
    acceleration: Positive = 0.2
    rotor_acceleration: Positive = 80.0
    speed: Positive = 20.0  #: rad/s, rotor speeds of a black box
    past: Positive = 0.002  #: State's unit, on states that only remember an output or input
    #: Other values for single states (or disturbances), by name
    states: Mapping[str, Positive] = {}


def by_state(
    table: ProcessNoise | InitialSd, kinds: tuple[str, ...], augmented: tuple[str, ...], key: str
) -> FloatArray:
    """A table's value for each state: by name where given, else by kind.

    Parameters
    ----------
    kinds, augmented : tuples of str
        Kind and name of each state of the filter, disturbances included.
    key : str
        Where names are given in the observer's configuration, for messages.

    Raises
    ------
    ConfigurationError
        For a name that the filter does not have.
    """
    for name in table.states:
        if name not in augmented:
            raise ConfigurationError(
                f"the filter has no state {name!r}",
                where=f"observer.{key}",
                remedy=nearest(name, augmented),
            )
    return np.array(
        [
            table.states.get(name, getattr(table, kind))
            for name, kind in zip(augmented, kinds, strict=True)
        ]
    )
