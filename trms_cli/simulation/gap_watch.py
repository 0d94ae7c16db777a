"""What watches the gap between rig and model during a run: the contract, and what it says.

A gap watch compares each measurement with what the model predicts of it and says when the rig has
changed: since when, in which equation or sensor, by how much. It touches neither the measurement
nor the command. The loop, or a replay of a log, calls it once a sample::

    run = plugin.init(setup)                       # ObserverSetup, as an observer's
    for alarm in run.step(command, measurement):   # command: in force since the last sample
        …

:mod:`trms_cli.gap.watch` implements it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from trms_cli.core.arrays import FloatArray
from trms_cli.core.wording import number
from trms_cli.observers.observer import ObserverSetup

#: ``change``: the rig has changed; ``misfit``: the model does not fit from the beginning.
AlarmKind = Literal["change", "misfit"]


@dataclass(frozen=True, kw_only=True)
class GapAlarm:
    """The rig is not what the model says, or no longer."""

    kind: AlarmKind
    time: float  #: s, when it was raised, from the first sample on
    since: float  #: s, when the change began by the likelihood; 0 for a misfit
    location: str  #: Equation or sensor, by the names of a diagnosis: ``yaw_moment``
    #: How it acts there: ``constant``, ``against_motion`` (a force that turns round with the
    #: motion), ``bias`` (of a sensor), ``parameters`` (of a misfit)
    form: str
    size: float  #: In ``unit``; of a misfit the root mean square of what is missing
    sd: float  #: In ``unit``, standard deviation of the size; NaN for a misfit
    unit: str  #: ``N*m``, ``rad``, ``rad/s``
    statistic: float  #: Of the test, against its threshold
    threshold: float

    @property
    def words(self) -> str:
        """The alarm in a sentence."""
        unit = self.unit.replace("*", " ")
        if self.kind == "misfit":
            return (
                f"the model does not fit from the beginning: {self.location} lacks "
                f"{number(self.size)} {unit} in the root mean square"
            )
        how = {"against_motion": " against the motion", "bias": " in what it reads"}
        return (
            f"the rig has changed since {self.since:.1f} s: {self.location} by "
            f"{number(self.size)} ± {number(self.sd, 2)} {unit}{how.get(self.form, '')}"
        )


class GapWatchRun(Protocol):
    """A gap watch during one run."""

    def step(self, command: FloatArray, measurement: FloatArray) -> Sequence[GapAlarm]:
        """Take a sample; what is to be said of it, mostly nothing.

        Parameters
        ----------
        command : (n_u,) array
            What was applied since the last sample (at the first: the setup's ``first_command``).
        measurement : (n_y,) array
            Channels of the setup's ``outputs``; NaN where a sample is missing.
        """


class GapWatchPlugin(Protocol):
    """An immutable configuration of a gap watch."""

    def init(self, setup: ObserverSetup) -> GapWatchRun:
        """A fresh run; two of them never share anything."""


class _Silent:
    """See :class:`NoGapWatch`."""

    def step(self, command: FloatArray, measurement: FloatArray) -> Sequence[GapAlarm]:
        return ()


@dataclass(frozen=True, kw_only=True)
class NoGapWatch:
    """Nobody compares rig and model."""

    def init(self, setup: ObserverSetup) -> GapWatchRun:
        """Nothing to prepare."""
        return _Silent()
