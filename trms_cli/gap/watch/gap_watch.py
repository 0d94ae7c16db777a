"""The watch over the gap: learns what is usual, tests, and says what has changed.

    learn (20 s) ─▶ does the model fit at all? ─▶ test ─▶ beyond the threshold ─▶ confirm (2 s)
                                                   ▲                                │
                                                   └──── learn anew (10 s) ◀──── alarm

The threshold is one for all tests: :mod:`experiments.gap.watch` counts the false alarms. Between
crossing and alarm two seconds pass, in which the tests see who explains the change best: at the
first samples the jump of an encoder looks like a blow on its axis.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.gap.watch.change_tests import ChangeEstimate, ChangeTests
from trms_cli.gap.watch.filter_step import FilterArrays
from trms_cli.gap.watch.predictor import Predictor
from trms_cli.models.model import names
from trms_cli.observers.observer import ObserverSetup
from trms_cli.simulation.gap_watch import GapAlarm

#: Standard deviations by which a parameter's own must be beyond the limit of a misfit.
_SURE = 2.0
#: rad; an angle this close to its stop may rest there.
_NEAR_STOP = 0.03
#: s between two looks at the tests, and from the first sample to the first onset.
_LOOK, _SETTLING = 0.1, 2.0


@dataclass(frozen=True, kw_only=True)
class GapWatch:
    """Sequential tests of all equations and sensors."""

    #: s in which it is learnt what is usual; no alarm of a change is raised in them
    learning: Annotated[float, Meta(ge=4.0)] = 20.0
    relearning: Annotated[float, Meta(ge=4.0)] = 10.0  #: s, the same after an alarm
    #: Of the levelled statistic (chi-squared of one degree of freedom, its maximum over tests and
    #: onsets)
    threshold: Positive = 80.0
    confirmation: NotNegative = 2.0  #: s from crossing the threshold to the alarm
    #: Deviations of a parameter's prior; a model with one that surely lies further off does not fit
    misfit: Positive = 1.0
    #: s, over which usual errors of the equations forget themselves
    correlation_time: Positive = 1.0
    #: s; a rig that is sampled faster is looked at so often: what a rounding sensor errs by is no
    #: noise from sample to sample then
    period: Positive = 0.02
    #: Innovations beyond this many of their standard deviations are left out …
    spike: Positive = 8.0
    #: … for so long, s: what lasts is no spike, but a change
    longest_spike: Positive = 0.06

    def init(self, setup: ObserverSetup) -> "WatchingGap":
        """A fresh run; see :class:`trms_cli.simulation.gap_watch.GapWatchPlugin`."""
        return WatchingGap(self, setup)


class WatchingGap:
    """See :class:`trms_cli.simulation.gap_watch.GapWatchRun`."""

    def __init__(self, config: GapWatch, setup: ObserverSetup) -> None:
        #: Samples that are taken as one, of rigs that are sampled fast
        self._together = max(1, math.floor(config.period / setup.sample_time + 1e-9))
        setup = replace(setup, sample_time=self._together * setup.sample_time)
        self._config, self._sample_time = config, setup.sample_time
        self._commands, self._count = np.zeros(setup.model.n_u), 0
        self._every = self._samples_in(_LOOK)
        self._predictor = Predictor(setup, config.correlation_time)
        self.tests = ChangeTests(self._predictor, setup.outputs, self._every)
        self._patience = self._samples_in(config.longest_spike)
        self._spikes = [0] * len(setup.outputs)
        #: (n_y,) arrays; the readings before, and the least that they have changed by
        self._last = setup.first_measurement.copy()
        self._quanta = np.full(len(self._spikes), np.inf)
        angles = {axis.angle for axis in setup.model.axes.values()}
        #: (n_y,) array; steps of encoders as declared, whose deviation is a twelfth's root of them
        self._declared = np.array(
            [12**0.5 * setup.noise_sd[n] if n in angles else 0.0 for n in setup.outputs]
        )
        #: Angles with a mechanical stop: place in y, where it is near, the state that it holds
        self._stops = list(self._stops_of(setup))
        self._since_contact = self._samples_in(_SETTLING) + 1
        #: (n_y,) array; biases that have been told: what a sensor reads is put right by them
        self._offsets = np.zeros(len(self._spikes))
        self._samples = self._since_restart = 0
        self._learning = self._samples_in(config.learning)
        self._crossed: int | None = None
        self._first = True  #: Nothing has been learnt yet
        n_w = self._predictor.n_w
        self._standing, self._standing_count = np.zeros(n_w), 0
        self.latest: ChangeEstimate | None = None  #: As of the last look

    def _stops_of(self, setup: ObserverSetup) -> Iterator[tuple[int, float, int]]:
        model, equations = setup.model, names(setup.model.disturbances)
        for axis in model.axes.values():
            stop = model.stops.get(axis.angle, math.inf)
            if axis.angle in setup.outputs and axis.moment in equations and math.isfinite(stop):
                held = self._predictor.pushed[equations.index(axis.moment)]
                yield setup.outputs.index(axis.angle), stop - _NEAR_STOP, held

    def _samples_in(self, seconds: float) -> int:
        return max(1, round(seconds / self._sample_time))

    def step(self, command: FloatArray, measurement: FloatArray) -> Sequence[GapAlarm]:
        """See :class:`trms_cli.simulation.gap_watch.GapWatchRun`."""
        if self._together > 1:
            # the first sample is one by itself: nothing has acted before it
            self._commands += command
            self._count += 1
            if self._samples and self._count < self._together:
                return ()
            command = self._commands / self._count
            self._commands[:], self._count = 0.0, 0
        measurement = measurement - self._offsets
        self._take(command, measurement)
        if self._first:  # the least that a reading ever changes by is the step of its sensor
            moves = np.abs(measurement - self._last)
            np.fmin(self._quanta, np.where(moves > 0.0, moves, np.inf), out=self._quanta)
            self._last = measurement.copy()
        self._samples += 1
        if self._rests_at_a_stop(measurement):
            return ()
        self._since_restart += 1
        if not self._has_settled:
            return ()
        self.tests.step()
        if self._since_restart % self._every:
            return ()
        learning = self._since_restart <= self._learning
        self.latest = self.tests.judge(learning=learning)
        if learning:
            return self._learnt(self.latest) if self._first else ()
        return self._look(self.latest)

    def _rests_at_a_stop(self, measurement: FloatArray) -> bool:
        """Whether a stop may push: the model does not know it, and nothing is learnt of the rig."""
        touched = [held for j, near, held in self._stops if abs(measurement[j]) > near]
        if not touched:
            self._since_contact += 1
            return False
        if self._since_contact:
            self.tests.forget_onsets()
            self._crossed = None
        self._since_contact = 0
        self._predictor.loosen(touched)
        return True

    def _take(self, command: FloatArray, measurement: FloatArray) -> None:
        """Let the filter have the sample; single spikes are held back."""
        state, spikes = self._predictor.arrays.state, self._spikes
        for j, value in enumerate(measurement.tolist()):
            if not math.isfinite(value):
                state[j] = FilterArrays.missing
            elif self._samples == 0 or spikes[j] >= self._patience:
                state[j] = FilterArrays.believed
            else:
                state[j] = FilterArrays.gated
        if not self._predictor.step(command, measurement, self._config.spike):
            self._restart(self._config.relearning)
            return
        for j, taken in enumerate(state.tolist()):
            if taken == FilterArrays.held_back:
                if not any(spikes) and self._has_settled:
                    self.tests.note_jump()
                spikes[j] += 1
            elif spikes[j] and self._is_quiet(j):
                spikes[j] = 0

    def _is_quiet(self, j: int) -> bool:
        """Whether a channel that was believed in spite of its spikes has come back to normal."""
        own = self._predictor.arrays
        return own.state[j] == own.used and abs(float(own.z[j])) < self._config.spike

    def _learnt(self, change: ChangeEstimate) -> Sequence[GapAlarm]:
        """At the end of learning: whether the model fits at all."""
        if 2 * self._since_restart > self._learning:
            self._standing += self._predictor.standing_forces() ** 2
            self._standing_count += 1
        if self._since_restart + self._every <= self._learning:
            return ()
        self._first = False
        quanta = np.where(np.isfinite(self._quanta), self._quanta, 0.0)
        self.tests.take_quanta(np.maximum(quanta, self._declared))
        predictor, config = self._predictor, self._config
        if not len(predictor.free):
            return ()
        own = predictor.arrays
        sd = np.sqrt(np.diag(own.p)[own.d :])
        furthest = float((np.abs(predictor.deviations) - _SURE * sd).max())
        # what changed meanwhile is told as such
        if furthest <= config.misfit or change.statistic > config.threshold:
            return ()
        force = np.sqrt(self._standing / max(self._standing_count, 1))
        e = int((force / predictor.usual_force).argmax())
        signal = predictor.model.disturbances[e]
        return (
            GapAlarm(
                kind="misfit",
                time=self._now,
                since=0.0,
                location=signal.name,
                form="parameters",
                size=float(force[e]),
                sd=math.nan,
                unit=signal.unit,
                statistic=furthest,
                threshold=config.misfit,
            ),
        )

    @property
    def _has_settled(self) -> bool:
        """Whether the filter has come so near that tests make sense."""
        since = min(self._since_restart, self._since_contact)
        return since * self._sample_time > _SETTLING

    @property
    def _now(self) -> float:
        return (self._samples - 1) * self._sample_time

    def _look(self, change: ChangeEstimate) -> Sequence[GapAlarm]:
        """Whether there is a change that is sure and has been looked at for long enough."""
        config = self._config
        if self._crossed is None:
            if change.statistic <= config.threshold:
                return ()
            self._crossed = self._samples
            self.tests.confine_onsets(to_the_past=True)
        if (self._samples - self._crossed) * self._sample_time < config.confirmation - 1e-9:
            return ()
        self._crossed = None
        self.tests.confine_onsets(to_the_past=False)
        if change.statistic <= config.threshold:
            return ()
        test = self.tests.tests[change.test]
        alarm = GapAlarm(
            kind="change",
            time=self._now,
            since=self._now - change.since,
            location=test.location,
            form=test.form,
            size=change.size,
            sd=change.sd,
            unit=test.unit,
            statistic=change.statistic,
            threshold=config.threshold,
        )
        channel = change.test - (len(self.tests.tests) - len(self._offsets))
        if channel >= 0:
            self._offsets[channel] += change.size
        # what a sensor reads says nothing new of the rig itself, unless it was learnt from that
        began = self._since_restart - round(change.since / self._sample_time)
        if began < self._learning:
            self._predictor.forget_deviations()
        self._predictor.restart(parameters=channel < 0 or began < self._learning)
        self._restart(config.relearning)
        return (alarm,)

    def _restart(self, seconds: float) -> None:
        """Learn anew what is usual: the rig as it is now."""
        self.tests.clear()
        self._since_restart, self._crossed = 0, None
        if not self._first:
            self._learning = self._samples_in(seconds)
