"""What watches a loop: it says when the loop works with less than it should, and lands the rig.

Three modes, each declared in the log and counted in the score:

- *normal*;
- *degraded*: a channel is missing or frozen, what is measured is not what the observer expects,
  the controller's fall-back acts, or the reference is out of reach. The loop goes on with what it
  has: a frozen channel is kept from the observer, which predicts without it;
- *landing*: an angle is not known, or the controller fails, for so long that to go on is to guess.
  The command goes to that of rest at a limited rate, and the controller starts afresh when the
  cause has gone.

A frozen encoder and a rig at rest read the same. What tells them apart is the observer: a reading
that stays the same to the last bit while the innovations say that it should not (unless it is that
of a mechanical stop). A rotor's speed from a tacho has noise: where most readings were new ones, a
run of equal ones says enough.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from trms_cli.controllers.controller import Command, Status
from trms_cli.core.arrays import FloatArray
from trms_cli.core.ranges import Positive
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model
from trms_cli.plants.landing import LandingRamp

#: Takes a kind, a source and a sentence.
Tell = Callable[[str, str, str], None]


class Mode(enum.Enum):
    """How the loop works."""

    NORMAL = "normal"
    DEGRADED = "degraded"
    LANDING = "landing"


class Reason(enum.Enum):
    """Why it is not normal: its name in the log, how it begins, how it ends."""

    MISSING = ("missing", "{} is not measured; the observer predicts it", "{} is measured again")
    FROZEN = (
        "frozen",
        "{} shows the same value while it should move; it is left out",
        "{} moves again",
    )
    INCONSISTENT = (
        "inconsistent",
        "{} is not what the observer expects",
        "{} is as expected again",
    )
    ESTIMATE = ("estimate", "the estimate is not finite", "the estimate is finite again")
    CONTROLLER = ("controller", "the controller's fall-back acts", "the controller solves again")
    REFERENCE = (
        "reference",
        "the reference is out of reach; the closest steady state is the target",
        "the reference is within reach again",
    )

    def __init__(self, label: str, begins: str, ends: str) -> None:
        self.label = label
        self.begins = begins
        self.ends = ends


#: Without these the loop guesses; frozen and missing count for the controlled angles only.
_CRITICAL = (Reason.MISSING, Reason.FROZEN, Reason.ESTIMATE, Reason.CONTROLLER)

#: Readings, after which it is known how often a tacho's change.
_FEW = 50
#: rad; an angle this close to its stop may rest there.
_NEAR_STOP = 0.05


@dataclass(frozen=True)
class SupervisorSetup:
    """What a supervisor is told before a run."""

    model: Model  #: What controller and observer believe
    sample_time: float  #: s
    outputs: tuple[str, ...]  #: Measured channels, the order of y
    landing: LandingRamp  #: How the rig is brought to rest


class SupervisorRun:
    """A supervisor during one run; the loop calls it in this order at each sample.

    This one does not watch: every measurement and every command passes.
    """

    mode: Mode = Mode.NORMAL

    def screen(self, y: FloatArray) -> FloatArray:
        """The measurement (n_y,) as the observer is to see it."""
        return y

    def judge(self, estimate: Estimate, tell: Tell) -> None:
        """Look at the estimate, choose the mode, and tell what begins or ends."""

    def landed(self, u: FloatArray) -> FloatArray:
        """The command (n_u,) after ``u`` while landing, V."""
        return u

    def note_command(self, command: Command) -> None:
        """Take in the controller's own words."""

    def reasons(self) -> str:
        """Why the mode is not normal, in words for the log; empty when it is."""
        return ""


class SupervisorPlugin(Protocol):
    """An immutable configuration of a supervisor."""

    def init(self, setup: SupervisorSetup) -> SupervisorRun:
        """A fresh state; two of them never share anything."""


@dataclass(frozen=True, kw_only=True)
class Supervisor:
    """Watches measurement, estimate and controller."""

    missing_after: Positive = 0.1  #: s without a reading, after which a channel counts as missing
    frozen_after: Positive = 0.3  #: s of equal readings, after which a channel may count as frozen
    #: Root mean square of ν/σ over these equal readings, above which it does
    frozen_innovation: Positive = 5.0
    #: Root mean square of ν/σ, above which a channel counts as inconsistent
    innovation_limit: Positive = 8.0
    innovation_window: Positive = 1.0  #: s, over which that mean is taken (exponentially)
    clear_after: Positive = 0.5  #: s without the cause, after which a reason ends
    land_after: Positive = 2.0  #: s, for which an angle may be unknown or the controller may fail

    def init(self, setup: SupervisorSetup) -> WatchingRun:
        """Ready for the first sample."""
        return WatchingRun(self, setup)


class WatchingRun(SupervisorRun):
    """See :class:`SupervisorRun`."""

    def __init__(self, config: Supervisor, setup: SupervisorSetup) -> None:
        def samples(seconds: float) -> int:
            return max(1, round(seconds / setup.sample_time))

        self.mode = Mode.NORMAL
        self._outputs = setup.outputs
        self._missing_after = samples(config.missing_after)
        self._frozen_after = samples(config.frozen_after)
        self._clear_after = samples(config.clear_after)
        self._land_after = samples(config.land_after)
        self._forget = min(1.0, setup.sample_time / config.innovation_window)
        self._limit, self._frozen_limit = (config.innovation_limit**2, config.frozen_innovation**2)
        n = len(setup.outputs)
        self._last: list[float] = [math.nan] * n
        self._missing_counts, self._same = [0] * n, [0] * n
        self._frozen = [False] * n
        self._changes = [0] * n
        self._readings = [0] * n
        angles = {axis.angle for axis in setup.model.axes.values()}
        self._is_angle = [name in angles for name in setup.outputs]
        self._stops = [setup.model.stops.get(name, math.inf) for name in setup.outputs]
        model = setup.model  # beside a stop of a model of a user's: the same share of it
        self._near = [
            _NEAR_STOP * (1.0 if model.bench_sizes or stop == math.inf else stop)
            for stop in self._stops
        ]
        self._sum, self._mean = [0.0] * n, [1.0] * n
        self._angles = set(setup.model.controlled) & set(setup.outputs)
        self._landing = setup.landing
        self._failing = self._out_of_reach = False
        #: By reason and channel: samples since it began, and since its cause was last seen.
        self._active: dict[tuple[Reason, str], list[int]] = {}

    def screen(self, y: FloatArray) -> FloatArray:
        missed, same, last = self._missing_counts, self._same, self._last
        for i, value in enumerate(y.tolist()):
            if value != value:
                missed[i] += 1
                continue
            missed[i] = 0
            if value == last[i]:
                same[i] += 1
            else:
                self._changes[i] += 1
                self._readings[i] += 1 + same[i]
                same[i], self._sum[i], self._frozen[i] = 0, 0.0, False
                last[i] = value
        if any(self._frozen):
            return np.where(self._frozen, np.nan, y)
        return y

    def judge(self, estimate: Estimate, tell: Tell) -> None:
        reasons: list[tuple[Reason, str]] = []
        total, mean, frozen = self._sum, self._mean, self._frozen
        same, missed = self._same, self._missing_counts
        innovations, spreads = estimate.innovation.tolist(), estimate.innovation_sd.tolist()
        for i, (innovation, spread) in enumerate(zip(innovations, spreads, strict=True)):
            share = (innovation / spread) ** 2 if spread > 0.0 else 0.0
            if share == share:
                total[i] += share
                mean[i] += self._forget * (share - mean[i])
                if same[i] >= self._frozen_after and not frozen[i]:
                    frozen[i] = self._should_move(i)
            if missed[i] >= self._missing_after:
                reasons.append((Reason.MISSING, self._outputs[i]))
            elif frozen[i]:
                reasons.append((Reason.FROZEN, self._outputs[i]))
            elif mean[i] > self._limit:
                reasons.append((Reason.INCONSISTENT, self._outputs[i]))
        if not math.isfinite(sum(estimate.x.tolist())):
            reasons.append((Reason.ESTIMATE, ""))
        if self._failing:
            reasons.append((Reason.CONTROLLER, ""))
        if self._out_of_reach:
            reasons.append((Reason.REFERENCE, ""))
        if reasons or self._active:
            self._update(reasons, tell)

    def _should_move(self, i: int) -> bool:
        """Whether a channel whose reading has been the same for a while is frozen."""
        if not self._is_angle[i] and 2 * self._changes[i] > self._readings[i] > _FEW:
            return True
        if abs(self._last[i]) > self._stops[i] - self._near[i]:
            return False
        return self._sum[i] > self._frozen_limit * self._same[i]

    def _update(self, reasons: list[tuple[Reason, str]], tell: Tell) -> None:
        """Begin and end reasons, and choose the mode."""
        for key in reasons:
            if key not in self._active:
                self._active[key] = [0, 0]
                tell("degraded_begin", key[1] or key[0].label, key[0].begins.format(key[1]))
            self._active[key][1] = 0
        critical = False
        for key, counts in list(self._active.items()):
            counts[0] += 1
            counts[1] += 1
            if counts[1] > self._clear_after:
                del self._active[key]
                tell("degraded_end", key[1] or key[0].label, key[0].ends.format(key[1]))
            elif self._is_critical(key):
                # A landing lasts as long as any cause does that could have begun it.
                critical |= counts[0] > self._land_after or self.mode is Mode.LANDING
        before = self.mode
        if critical:
            self.mode = Mode.LANDING
            # What the controller last said is old while it is not asked.
            self._failing = self._out_of_reach = False
        else:
            self.mode = Mode.DEGRADED if self._active else Mode.NORMAL
        if (before is Mode.LANDING) != critical:
            begins = "the cause lasts: the command goes to that of rest"
            ends = "the causes have gone: the controller starts afresh"
            kind = "landing_begin" if critical else "landing_end"
            tell(kind, "supervisor", begins if critical else ends)

    def _is_critical(self, key: tuple[Reason, str]) -> bool:
        reason, channel = key
        return reason in _CRITICAL and (not channel or channel in self._angles)

    def landed(self, u: FloatArray) -> FloatArray:
        return self._landing.next(u)

    def note_command(self, command: Command) -> None:
        self._failing = command.status is Status.FAILED or bool(command.fallback)
        self._out_of_reach = command.out_of_reach

    def reasons(self) -> str:
        if not self._active:
            return ""
        return "; ".join(f"{reason.label} {channel}".strip() for reason, channel in self._active)


@dataclass(frozen=True, kw_only=True)
class Unsupervised:
    """Nobody watches: every measurement and every command passes."""

    def init(self, setup: SupervisorSetup) -> SupervisorRun:
        """Nothing to prepare."""
        return SupervisorRun()
