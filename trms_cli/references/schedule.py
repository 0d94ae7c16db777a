"""One signal after the other."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from trms_cli.core.errors import ConfigurationError
from trms_cli.references.signal import EDGE, Array, ReferenceSignal, require_signal


@dataclass(frozen=True, kw_only=True)
class Piece:
    """A signal and the time from which it holds."""

    start: float  #: s since the begin of the run
    signal: ReferenceSignal  #: What to follow until the next piece starts

    def __post_init__(self) -> None:
        require_signal(self.signal, "signal")


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Follows the piece that started last; ``offset`` before the first one."""

    pieces: Sequence[Piece]  #: By rising ``start``
    #: Whether a piece's signal sees the time since the piece started, or since the run began.
    #: "global" keeps a wave in step when another signal interrupts it.
    clock: Literal["local", "global"] = "local"
    offset: float = 0.0  #: Value before the first piece, rad

    def __post_init__(self) -> None:
        if not self.pieces:
            raise ConfigurationError(
                "a schedule of no pieces",
                where="pieces",
                remedy="give at least one piece with start and signal",
            )
        for index, piece in enumerate(self.pieces):
            if not isinstance(piece, Piece):
                raise ConfigurationError(
                    f"{piece!r} is not a piece",
                    where=f"pieces[{index}]",
                    remedy="give _target_: trms_cli.references.schedule.Piece, start (s) and "
                    "signal",
                )
        starts = [piece.start for piece in self.pieces]
        for index in range(1, len(starts)):
            if not starts[index] > starts[index - 1]:
                raise ConfigurationError(
                    f"piece {index} starts at {starts[index]:g} s, not after the one before it "
                    f"({starts[index - 1]:g} s)",
                    where=f"pieces[{index}].start",
                    remedy="order the pieces by rising start",
                )

    def sample(self, times: Array) -> Array:
        times = np.asarray(times, dtype=float)
        starts = np.array([piece.start for piece in self.pieces])
        active = np.searchsorted(starts, times + EDGE, side="right") - 1
        values = np.full(times.shape, self.offset)
        for index, piece in enumerate(self.pieces):
            mask = active == index
            if mask.any():
                shift = piece.start if self.clock == "local" else 0.0
                values[mask] = piece.signal.sample(times[mask] - shift)
        return values
