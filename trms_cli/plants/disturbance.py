"""Disturbances by schedule: an external torque that acts on one equation of the rig."""

from dataclasses import dataclass

from trms_cli.references.signal import ReferenceSignal


@dataclass(frozen=True, kw_only=True)
class ScheduledDisturbance:
    """A torque over time on one physical equation."""

    equation: str  #: ``pitch_moment``, ``yaw_moment``, ``main_motor`` or ``tail_motor``
    torque: ReferenceSignal  #: N m over time; any signal of the group ``signal``
    known: bool = False  #: Whether the torque is measured: it is then logged as ``d_<equation>``
