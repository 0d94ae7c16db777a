"""A real rig behind a wire, whatever carries the frames: the computer's side of the wire."""

from __future__ import annotations

import os
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.ranges import Positive
from trms_cli.plants.hardware import HardwareRig, HardwareRun, RigLost
from trms_cli.plants.link.frames import SEQUENCE_RANGE, BadFrame, Frame, Kind, RigStatus, decode
from trms_cli.plants.link.transport import Transport
from trms_cli.plants.plant import PlantSetup

#: s between two tries of what has to be answered.
_AGAIN = 0.1


@dataclass(frozen=True, kw_only=True)
class LinkedRig(HardwareRig):
    """A rig that speaks the frames of docs/rig-frames.md."""

    connect_timeout: Positive = 3.0  #: s, for which the rig is called
    #: s, for which a reading is waited for; None: a quarter of the sample time
    reply_timeout: Positive | None = None
    watchdog: Positive = 0.1  #: s without a command, after which the rig lands by itself


class LinkedRun(HardwareRun):
    """Such a rig during one run.

    ``open_transport``: called once, on ``connect``.
    """

    rig: LinkedRig

    def __init__(self, rig: LinkedRig, setup: PlantSetup) -> None:
        super().__init__(rig, setup)
        for kind in (self._readings, self._commands):
            for name, channel in zip(kind.names, kind.channels, strict=True):
                if not (isinstance(channel, int) and 0 <= channel < 64):
                    count = len(kind.names)
                    raise ConfigurationError(
                        f"{channel!r} given",
                        where=f"plant.wiring.{name}.channel",
                        remedy=f"the number's position in a frame, from 0: 0 to {count - 1} "
                        f"for {count} of them",
                    )
        if rig.watchdog < 2 * setup.sample_time:
            raise ConfigurationError(
                f"{rig.watchdog:g} s given, and commands come every {setup.sample_time:g} s",
                where="plant.watchdog",
                remedy=f"at least two sample times: {2 * setup.sample_time:g} s",
            )
        self._patience = rig.reply_timeout or 0.25 * setup.sample_time
        self._n_u = 1 + max(int(c) for c in self._commands.channels)
        self._n_y = 1 + max(int(c) for c in self._readings.channels)
        self._session = int.from_bytes(os.urandom(4), "little")
        self._sequence = 0
        self._transport: Transport | None = None
        self._is_armed = False
        #: Frames that were no answer to what was asked: late, doubled, spoilt
        self.stray_frames = 0
        self.lost_readings = 0

    @abstractmethod
    def _open(self) -> Transport:
        """What carries the frames, from now on."""

    @abstractmethod
    def _address(self) -> tuple[str, str]:
        """What the rig is called by, and where that stands in the configuration."""

    def connect(self) -> None:
        """Call the rig until it answers.

        Raises ConfigurationError for one that is silent, speaks another version, or has other
        commands and readings than the wiring.
        """
        address, where = self._address()
        self._transport = self._open()
        numbers = (self._setup.sample_time, self.rig.watchdog, float(self._n_u), float(self._n_y))
        end = self._now() + self.rig.connect_timeout
        refusal: BadFrame | None = None
        while self._now() < end:
            try:
                answer = self._ask(Kind.HELLO, numbers, _AGAIN, (Kind.WELCOME,), strict=True)
            except BadFrame as error:
                refusal = error
                self._pause(_AGAIN)
                continue
            if answer is not None and len(answer.numbers) >= 3:
                self._check_welcome(answer, where)
                return
        if refusal is not None:
            raise ConfigurationError(
                f"{address} answers with {refusal.problem}",
                where=where,
                remedy=refusal.remedy or "is it the rig's program that listens there?",
            )
        raise ConfigurationError(
            f"no answer from {address} within {self.rig.connect_timeout:g} s",
            where=where,
            remedy="start the rig's program (a simulated one: `trms rig serve`), and look at the "
            "address, the cable and the firewall",
        )

    def _check_welcome(self, answer: Frame, where: str) -> None:
        watchdog, n_u, n_y = answer.numbers[:3]
        for own, theirs, what in (
            (self._n_u, int(n_u), "commands"),
            (self._n_y, int(n_y), "readings"),
        ):
            if own > theirs:
                raise ConfigurationError(
                    f"the rig has {theirs} {what}, the wiring uses {own}",
                    where="plant.wiring",
                    remedy="`trms rig check` shows what each channel reads",
                )
        if not 0.0 < watchdog <= 1.001 * self.rig.watchdog:
            raise ConfigurationError(
                f"the rig's watchdog takes {watchdog:g} s, {self.rig.watchdog:g} s were asked for",
                where="plant.watchdog",
                remedy=f"plant.watchdog={watchdog:g}, or a rig that lands earlier by itself",
            )

    def arm(self) -> None:
        """From now on commands act.

        Raises RigLost where the rig does not say that they do.
        """
        self._change_state(Kind.ARM, RigStatus.ARMED)
        self._is_armed = True

    def disarm(self) -> None:
        """Commands act no longer; the rig holds its safe command."""
        self._is_armed = False
        if self._transport is not None:
            self._change_state(Kind.DISARM, RigStatus(0))

    def close(self, reason: str) -> None:
        """Let go of the wire."""
        if self._transport is not None:
            self._transport.close()
            self._transport = None

    def _change_state(self, kind: Kind, wanted: RigStatus) -> None:
        end = self._now() + max(1.0, 3 * _AGAIN)
        while self._now() < end:
            answer = self._ask(kind, (), _AGAIN, (Kind.READING,))
            if answer is not None and RigStatus(answer.status) & RigStatus.ARMED == wanted:
                return
        status = "no answer" if answer is None else _status_words(RigStatus(answer.status))
        raise RigLost(
            f"the rig did not {kind.name.lower()} ({status})",
            where="plant",
            remedy="look at the emergency stop and at the rig's own display",
        )

    def _read(self) -> Mapping[int | str, float] | None:
        answer = self._ask(Kind.READ, (), self._patience, (Kind.READING,))
        if answer is None or len(answer.numbers) < self._n_y:
            self.lost_readings += 1
            return None
        status = RigStatus(answer.status)
        if status & (RigStatus.EMERGENCY | RigStatus.FAULT):
            raise RigLost(f"the rig reports: {_status_words(status)}", where="plant")
        if self._is_armed and not status & RigStatus.ARMED:
            raise RigLost(
                f"the rig is no longer armed: {_status_words(status)}",
                where="plant",
                remedy="its watchdog lands it where no command comes for "
                f"{self.rig.watchdog:g} s; `/timing` of the log shows late samples",
            )
        return dict(enumerate(answer.numbers))

    def _write(self, raw: Mapping[int | str, float]) -> None:
        numbers = [0.0] * self._n_u
        for channel, value in raw.items():
            numbers[int(channel)] = value
        self._send(Kind.COMMAND, tuple(numbers))

    def _send(self, kind: Kind, numbers: tuple[float, ...]) -> int:
        assert self._transport is not None
        self._sequence = (self._sequence + 1) % SEQUENCE_RANGE
        time_us = int(self._now() * 1e6)
        frame = Frame(kind, self._sequence, self._session, time_us, 0, 0, numbers)
        self._transport.send(frame.encode())
        return self._sequence

    def _ask(
        self,
        kind: Kind,
        numbers: tuple[float, ...],
        patience: float,
        kinds: tuple[Kind, ...],
        *,
        strict: bool = False,
    ) -> Frame | None:
        """Send, and wait for the answer; None where it did not come in time.

        Raises BadFrame, where ``strict``, for bytes that are no frame of this version.
        """
        assert self._transport is not None
        sequence = self._send(kind, numbers)
        end = self._now() + patience
        while True:
            data = self._transport.receive(end - self._now())
            if data is None:
                return None
            try:
                frame = decode(data)
            except BadFrame:
                self.stray_frames += 1
                if strict:
                    raise
                continue
            if (
                frame.session == self._session
                and frame.sequence == sequence
                and frame.kind in kinds
            ):
                return frame
            self.stray_frames += 1


def _status_words(status: RigStatus) -> str:
    words = {
        RigStatus.EMERGENCY: "emergency stop",
        RigStatus.FAULT: "fault",
        RigStatus.WATCHDOG: "watchdog",
        RigStatus.ARMED: "armed",
    }
    return ", ".join(text for flag, text in words.items() if status & flag) or "disarmed"
