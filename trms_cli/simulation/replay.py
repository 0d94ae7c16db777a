"""The loop over a recording: predict with its command, update with its measurement.

The picture is the closed loop's without its left half: the recording stands for reference,
controller and rig, and only the observer works.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from trms_cli.models.model import Model, names
from trms_cli.observers.observer import Observer, ObserverSetup
from trms_cli.recordings.for_model import RecordedRun
from trms_cli.simulation.closed_loop import (
    ESTIMATE_PARTS,
    Progress,
    estimate_order,
    estimate_parts,
    tell_rejected,
)
from trms_cli.simulation.gap_watch import GapWatchPlugin, GapWatchRun, NoGapWatch
from trms_cli.simulation.history import History


@dataclass
class Replay:
    """A replay under way: made by :meth:`start`, advanced by :meth:`run`."""

    model: Model  #: What the observer believes
    rig: RecordedRun
    observer: Observer
    history: History  #: Gets the rows, at the rig's own times
    _observer_state: Any
    _gap_watch: GapWatchRun
    completed_samples: int = 0  #: Samples so far

    @classmethod
    def start(
        cls,
        model: Model,
        rig: RecordedRun,
        observer: Observer,
        make_history: Callable[[RecordedRun], History],
        gap_watch: GapWatchPlugin | None = None,
    ) -> Replay:
        """Everything ready for the first sample.

        ``make_history``: given the recording, returns where the run is kept. ``gap_watch``: what
        compares rig and model; None: nobody.
        """
        setup = ObserverSetup(
            model,
            rig.sample_time,
            names(rig.outputs),
            rig.noise_sd,
            rig.measurements[0],
            # What was in force before is not recorded; the first command is the best guess.
            rig.commands[0],
        )
        state = observer.init(setup)
        watch = (gap_watch or NoGapWatch()).init(setup)
        return cls(model, rig, observer, make_history(rig), state, watch)

    def run(self, progress: Progress | None = None) -> None:
        """Run to the end; what is done stays in the history if an exception ends it.

        ``progress``: called once a recorded second with the time passed (s) and the largest
        innovation of an angle (rad).
        """
        rig, history = self.rig, self.history
        per_second = max(1, round(1.0 / rig.sample_time))
        angles = [i for i, signal in enumerate(rig.outputs) if signal.unit == "rad"]
        references = np.column_stack([*rig.references.values()]) if rig.references else None
        parts = {"/command": 1, "/measurement": 1, "/estimate": ESTIMATE_PARTS}
        order = estimate_order(history.fields.get("/estimate", ()), len(rig.outputs))
        log_signals = history.signal_writer(
            parts if references is None else {"/reference": 1} | parts, {"/estimate": order}
        )
        times_ns = log_times(rig)
        happenings = list(reversed(rig.happenings))
        u = rig.commands[max(self.completed_samples - 1, 0)]

        for k in range(self.completed_samples, len(rig)):
            now_ns, y = times_ns[k], rig.measurements[k]
            while happenings and happenings[-1].sample <= k:
                event = happenings.pop()
                history.event(now_ns, event.kind, event.source, event.message, event.value)
            estimate = self.observer.step(self._observer_state, u, y, None)
            for alarm in self._gap_watch.step(u, y):
                history.event(now_ns, "gap_alarm", alarm.location, alarm.words, alarm.size)
            u = rig.commands[k]
            signals = (u, y, *estimate_parts(estimate))
            log_signals(now_ns, signals if references is None else (references[k], *signals))
            if estimate.rejected.any():
                tell_rejected(history, now_ns, estimate, rig.outputs)
            self.completed_samples = k + 1
            if self.completed_samples % per_second == 0:
                history.flush()
                if progress is not None:
                    surprise = np.abs(estimate.innovation[angles])
                    progress(
                        self.completed_samples * rig.sample_time,
                        float(np.nanmax(surprise, initial=0.0)),
                    )
        history.flush()


def time_offset(rig: RecordedRun) -> float:
    """What is added to the rig's time for the log, whose times are not negative, s."""
    return max(0.0, -float(rig.time[0]))


def log_times(rig: RecordedRun) -> list[int]:
    """Time stamps of the samples, ns."""
    times: list[int] = np.round((rig.time + time_offset(rig)) * 1e9).astype(np.int64).tolist()
    return times
