"""The reference of a run: a signal per axis, and what shapes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from trms_cli.core.errors import ConfigurationError
from trms_cli.references.shaping import Shaping
from trms_cli.references.signal import Array, ReferenceSignal, require_signal

#: All that can have a reference, in the order of the columns: angles of a rig, speeds of a rotor
#: that is alone on a bench.
AXES = ("alpha_v", "alpha_h", "omega_v", "omega_h")


@dataclass(frozen=True, kw_only=True)
class ReferenceTrajectory:
    """What pitch and yaw, or the speeds of rotors on a bench, are to follow."""

    #: Pitch, rad. ``None`` on a rig that turns in the horizontal plane only.
    alpha_v: ReferenceSignal | None = None
    #: Yaw, rad. ``None`` on a rig that moves in the vertical plane only.
    alpha_h: ReferenceSignal | None = None
    #: ``omega_v``, ``omega_h``: speeds of the main and the tail rotor, rad/s, where they are what
    #: is controlled
    omega_v: ReferenceSignal | None = None
    omega_h: ReferenceSignal | None = None
    #: Limits on the rate, acceleration and jerk of each; ``None`` leaves the signals as they are
    shaping: Shaping | None = None

    def __post_init__(self) -> None:
        if not self.axes:
            raise ConfigurationError(
                "a reference for no axis", where="alpha_v", remedy="give alpha_v, alpha_h or both"
            )
        for axis in self.axes:
            require_signal(getattr(self, axis), axis)
        if self.shaping is not None and not isinstance(self.shaping, Shaping):
            raise ConfigurationError(
                f"{type(self.shaping).__name__} is not a shaping",
                where="shaping",
                remedy="choose one of the group shaping, or null",
            )

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes that have a reference, in the order of the columns of a sample."""
        return tuple(axis for axis in AXES if getattr(self, axis) is not None)

    @cached_property
    def _signals(self) -> tuple[ReferenceSignal, ...]:
        signals = tuple(getattr(self, axis) for axis in self.axes)
        if self.shaping is None:
            return signals
        return tuple(self.shaping.apply(signal) for signal in signals)

    def sample(self, times: Array) -> Array:
        """References of all axes; the same for a time whatever other times are asked for.

        ``times``: (n,) s, in any order, as far ahead as a preview wants. Returns (n, len(axes)),
        rad or rad/s; columns as in :attr:`axes`.
        """
        times = np.asarray(times, dtype=float)
        return np.stack([signal.sample(times) for signal in self._signals], axis=-1)

    def restricted_to(self, axes: Sequence[str]) -> ReferenceTrajectory:
        """The reference of a rig that has only these axes.

        Raises ConfigurationError if an axis of the rig has no reference.
        """
        for axis in axes:
            if axis not in self.axes:
                raise ConfigurationError(
                    f"the rig moves in {axis}, for which there is no reference",
                    where=axis,
                    remedy="choose ref=speed, which has references for speeds"
                    if axis.startswith("omega")
                    else f"choose one, e.g. signal@ref.{axis}=constant",
                )
        return replace(self, **{axis: None for axis in self.axes if axis not in axes})
