"""The other end of the wire: a simulated rig that answers frames as a real rig's computer does.

It is the reference of what such a program has to do: take commands of one session alone, only
while it is armed and only newer ones; cut them to its limits; and go to the safe command by itself
where none comes for as long as its watchdog waits.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.models.model import names
from trms_cli.plants.hardware import READINGS
from trms_cli.plants.link.frames import (
    BadFrame,
    Frame,
    Kind,
    RigStatus,
    all_finite,
    decode,
    is_newer,
)
from trms_cli.recordings.channels import CHANNELS


class ServedRig:
    """A rig's computer.

    Parameters
    ----------
    run : PlantRun
        The rig; stepped by `step_time`.
    step_time : float
        s.
    watchdog : float
        Longest time without a command (s); a computer that connects may ask for a shorter one.
    safe : (n_u,) array
        The safe command, V.
    say : callable
        Takes a time (s) and what happened.
    """

    def __init__(
        self,
        run: Any,
        step_time: float,
        watchdog: float,
        safe: FloatArray,
        say: Callable[[float, str], None],
    ) -> None:
        self._run, self._step_time, self._say = run, step_time, say
        self._longest_watchdog = self.watchdog = watchdog
        self.safe = np.array(safe, dtype=float)
        self.command = self.safe.copy()  #: In force now, V
        self.time = 0.0  #: s, up to which the rig has moved
        self.status = RigStatus(0)
        self._session: int | None = None
        self.sequence = 0  #: Of the last command that was applied
        self._command_time = 0.0
        self.commands = 0  #: Commands that were applied
        self.refused = 0  #: Frames that were none, of another session, old, or not to be obeyed
        # the order of the numbers in a frame; a rig that lacks one leaves it out
        own = names(run.outputs)
        order = [name for name in READINGS if name in own]
        order += [name for name in own if name not in CHANNELS]
        self._order = [names(run.outputs).index(name) for name in order]
        self._low, self._high = run.input_limits
        self._steps = 0

    def begin_at(self, time: float) -> None:
        """Go on with a rig that has moved up to a time (s), as after a restart of its computer."""
        self._steps = round(time / self._step_time)
        self.time = self._steps * self._step_time

    def advance_to(self, now: float) -> None:
        """Let the rig move up to a time (s); the watchdog acts when it is due."""
        while self.time + self._step_time <= now:
            silence = self.time - self._command_time
            if self.status & RigStatus.ARMED and silence > self.watchdog:
                self.status = (self.status & ~RigStatus.ARMED) | RigStatus.WATCHDOG
                self.command = self.safe.copy()
                self._say(self.time, f"watchdog: no command for {silence:.3f} s, safe command")
            self._run.advance(self.command)
            self._steps += 1
            self.time = self._steps * self._step_time

    def press_emergency_stop(self) -> None:
        """Safe command at once, and no other until the rig is started anew."""
        self.status = (self.status & ~RigStatus.ARMED) | RigStatus.EMERGENCY
        self.command = self.safe.copy()
        self._say(self.time, "emergency stop")

    def answer(self, data: bytes, now: float) -> bytes | None:
        """What is answered to a frame that arrives at a time (s), encoded."""
        try:
            frame = decode(data)
        except BadFrame as error:
            self.refused += 1
            if "version" in error.problem:
                self._say(now, error.problem)
            return None
        if frame.kind == Kind.HELLO:
            return self._welcome(frame, now)
        if frame.session != self._session:
            self.refused += 1
            return None
        if frame.kind == Kind.COMMAND:
            self._obey(frame, now)
            return None
        if frame.kind == Kind.ARM:
            if not self.status & (RigStatus.EMERGENCY | RigStatus.FAULT | RigStatus.ARMED):
                self.status = (self.status & ~RigStatus.WATCHDOG) | RigStatus.ARMED
                self._command_time = now
                self._say(now, "armed")
        elif frame.kind == Kind.DISARM:
            if self.status & RigStatus.ARMED:
                self._say(now, "disarmed")
            self.status &= ~RigStatus.ARMED
            self.command = self.safe.copy()
        elif frame.kind != Kind.READ:
            self.refused += 1
            return None
        return self._reply(frame, Kind.READING, tuple(self._run.measure()[self._order].tolist()))

    def _welcome(self, frame: Frame, now: float) -> bytes | None:
        if self.status & RigStatus.ARMED and frame.session != self._session:
            self.refused += 1  # somebody drives the rig
            return None
        if frame.session != self._session:
            self._session, self.sequence = frame.session, frame.sequence
            self._say(now, f"connected (session {frame.session:08x})")
        if len(frame.numbers) > 1 and 0.0 < frame.numbers[1] <= self._longest_watchdog:
            self.watchdog = frame.numbers[1]
        numbers = (self.watchdog, float(len(self.safe)), float(len(self._order)))
        return self._reply(frame, Kind.WELCOME, numbers)

    def _obey(self, frame: Frame, now: float) -> None:
        if (
            not self.status & RigStatus.ARMED
            or not is_newer(frame.sequence, self.sequence)
            or len(frame.numbers) < len(self.safe)
            or not all_finite(frame.numbers)
        ):
            self.refused += 1
            return
        self.sequence, self._command_time = frame.sequence, now
        self.command = np.clip(frame.numbers[: len(self.safe)], self._low, self._high)
        self.commands += 1

    def _reply(self, frame: Frame, kind: Kind, numbers: tuple[float, ...]) -> bytes:
        return Frame(
            kind,
            frame.sequence,
            frame.session,
            int(self.time * 1e6),
            self.sequence,
            int(self.status),
            numbers,
        ).encode()
