"""What a wire does to frames: delays, losses, doubles and spoils them, or is pulled."""

from __future__ import annotations

import heapq
import itertools
import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.core.ranges import NotNegative

_Share = Annotated[float, Meta(ge=0, le=1)]


@dataclass(frozen=True, kw_only=True)
class WireNuisances:
    """Of a wire, in each direction."""

    latency: NotNegative = 0.0  #: s, that each frame takes
    jitter: NotNegative = 0.0  #: s, largest additional time; a frame may overtake another
    loss: _Share = 0.0  #: share of the frames that are lost
    doubling: _Share = 0.0  #: share of the frames that come twice
    corruption: _Share = 0.0  #: share of the frames with a byte that is wrong
    pulled_at: NotNegative | None = None  #: s, when the cable is pulled; None: never
    pulled_for: NotNegative | None = None  #: s, until it is back; None: it stays out

    def is_pulled(self, now: float) -> bool:
        """Whether the cable is out at a time (s)."""
        if self.pulled_at is None or now < self.pulled_at:
            return False
        return now < self.pulled_at + (math.inf if self.pulled_for is None else self.pulled_for)


class LossyWire:
    """One direction of a wire: frames in, the same frames out, later and not all of them."""

    def __init__(self, nuisances: WireNuisances, generator: np.random.Generator) -> None:
        self._nuisances, self._generator = nuisances, generator
        self._queue: list[tuple[float, int, bytes]] = []
        self._count = itertools.count()

    def put(self, data: bytes, now: float) -> None:
        """A frame is sent at a time (s)."""
        n, draw = self._nuisances, self._generator.random
        if n.is_pulled(now) or (n.loss and draw() < n.loss):
            return
        if n.corruption and data and draw() < n.corruption:
            spoilt = bytearray(data)
            spoilt[int(draw() * len(data))] ^= 1 << int(draw() * 8)
            data = bytes(spoilt)
        for _ in range(2 if n.doubling and draw() < n.doubling else 1):
            arrival = now + n.latency + (n.jitter * draw() if n.jitter else 0.0)
            heapq.heappush(self._queue, (arrival, next(self._count), data))

    def take(self, now: float) -> bytes | None:
        """The next frame that has arrived by a time (s), in the order of arrival."""
        if self._queue and self._queue[0][0] <= now:
            return heapq.heappop(self._queue)[2]
        return None

    @property
    def next_arrival(self) -> float:
        """When the next frame arrives, s; infinite for none."""
        return self._queue[0][0] if self._queue else math.inf
