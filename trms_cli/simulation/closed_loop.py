"""The closed loop: reference → controller → rig → observer, sample by sample.

At each sample the rig is measured, the observer takes the measurement, the controller (at its own,
slower or equal rate) takes the estimate, and the command is held until the next sample. A
supervisor watches and may keep a reading from the observer, or land the rig in the controller's
place. All that passes is written to the history, once the command is out. In a simulation nothing
depends on the wall clock but the times that the controller's work took; beside a real rig samples
keep absolute deadlines, and whatever ends the loop lands the rig and closes it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from typing import Any, Literal

import numpy as np

from trms_cli.controllers.controller import Command, Controller, ControlSample, ControlSetup, Status
from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model, Signal, names
from trms_cli.models.one_step_ahead import OneStepAhead
from trms_cli.observers.observer import Observer, ObserverSetup
from trms_cli.plants.envelope import EnvelopeSetup, EnvelopeWatch, envelope_of
from trms_cli.plants.landing import landing_of
from trms_cli.plants.plant import Plant, PlantRun, PlantSetup
from trms_cli.references.trajectory import ReferenceTrajectory
from trms_cli.simulation.command_gate import CommandGate
from trms_cli.simulation.gap_watch import GapWatchPlugin, GapWatchRun, NoGapWatch
from trms_cli.simulation.history import History, Writer
from trms_cli.simulation.pace import Clock, LatePolicy, Pace, WallClock, undisturbed
from trms_cli.simulation.preparation import (
    check_finite,
    check_reach,
    farthest_command,
    reference_of,
    rehearse,
)
from trms_cli.simulation.rig_life import Confirm, RigLanded, RigLife, check_reading, check_run
from trms_cli.simulation.stop import StopRequest
from trms_cli.simulation.supervisor import (
    Mode,
    SupervisorPlugin,
    SupervisorRun,
    SupervisorSetup,
    Unsupervised,
)

#: Called once a simulated second with the time (s) and the largest present tracking error (rad).
Progress = Callable[[float, float], None]
#: A run is kept in memory until it is scored; beyond this the keys are a slip.
_MOST_SAMPLES = 100_000_000
#: Each simulated second is made safe; where they go by in less than so many s of the clock, so many
#: of them at once: a log of many small chunks takes longer to write and to read.
_FLUSH_AFTER, _SECONDS_AT_ONCE = 0.02, 5


@dataclass(frozen=True)
class Experiment:
    """Everything that a closed-loop run is a pure function of."""

    model: Model  #: What the controller and the observer believe
    plant: Plant
    observer: Observer
    controller: Controller
    reference: ReferenceTrajectory
    duration: float  #: s; the duration is rounded to whole samples
    sample_time: float  #: s; the duration is rounded to whole samples
    seed: int = 0
    #: Every how many control samples the controller's prediction is logged; 0 for never
    prediction_every: int = 10
    supervisor: SupervisorPlugin = field(default_factory=Unsupervised)
    gap_watch: GapWatchPlugin = field(default_factory=NoGapWatch)  #: What compares rig and model
    #: Whether samples wait for their time on the clock; None: as the plant wants it
    pace: Literal["real_time", "simulated"] | None = None
    late: LatePolicy = field(default_factory=LatePolicy)

    def __post_init__(self) -> None:
        if not (self.sample_time > 0 and math.isfinite(self.sample_time)):
            raise ConfigurationError(
                f"{self.sample_time!r} given", where="sim.sample_time", remedy="a time above 0 s"
            )
        if not (self.sample_time <= self.duration < math.inf):
            raise ConfigurationError(
                f"{self.duration!r} given",
                where="sim.duration",
                remedy=f"at least one sample ({self.sample_time:g} s)",
            )
        if self.samples > _MOST_SAMPLES:
            raise ConfigurationError(
                f"{self.duration:g} s are {self.samples:.3g} samples of {self.sample_time:g} s",
                where="sim.duration",
                remedy=f"at most {_MOST_SAMPLES:.0e} samples: a shorter run, or slower sampling",
            )

    @property
    def samples(self) -> int:
        return round(self.duration / self.sample_time)

    @property
    def has_delay(self) -> bool:
        """Whether a command acts one sample after it was asked for."""
        return getattr(self.controller, "delay", "none") == "one_sample"

    @property
    def in_real_time(self) -> bool:
        """Whether samples wait for their time on the clock."""
        if self.pace is None:
            return bool(getattr(self.plant, "real_time", False))
        return self.pace == "real_time"

    @property
    def samples_per_control(self) -> int:
        """Samples between two control steps.

        Raises ConfigurationError if the control period is not a whole multiple of the sample time.
        """
        # a plugin may do without the attribute: it then takes every sample
        period = getattr(self.controller, "sample_time", None) or self.sample_time
        if not math.isfinite(period):
            raise ConfigurationError(
                f"{period!r} given", where="controller.sample_time", remedy="give a time in s"
            )
        ratio = round(period / self.sample_time)
        if ratio < 1 or abs(ratio * self.sample_time - period) > 1e-9 * period:
            raise ConfigurationError(
                f"controller.sample_time={period:g} s is no whole multiple of "
                f"sim.sample_time={self.sample_time:g} s",
                where="controller.sample_time",
                remedy="change one of the two; controller.sample_time=null takes every sample",
            )
        return ratio


@dataclass
class _Answer:
    """What a sample's command comes from: written down once it is out."""

    u: FloatArray  #: As it is applied, (n_u,), V
    command: Command | None = None  #: The controller's words, where it was asked
    spent: float = math.nan  #: Time of the control step, s


@dataclass
class Loop:
    """A run under way: made by :meth:`start`, advanced by :meth:`run`."""

    experiment: Experiment
    plant: PlantRun  #: The rig in this run
    #: (samples + preview, n_r) array; rad, at every sample and as far beyond the end as the last
    #: preview reaches
    references: FloatArray
    preview: int  #: Control periods that the controller sees ahead
    history: History
    life: RigLife
    pace: Pace | None  #: None where no sample waits
    _observer_state: Any
    _controller_state: Any
    _supervisor: SupervisorRun
    _envelope: EnvelopeWatch
    _gap_watch: GapWatchRun
    _now_ns: int = 0
    completed_samples: int = 0  #: Samples that are behind
    _gate: CommandGate = field(init=False)
    _ratio: int = field(init=False)  #: Samples between two control steps
    _tell_control: Writer = field(init=False)
    _tell_prediction: Writer = field(init=False)
    _tell_landing: Writer = field(init=False)
    _u: FloatArray = field(init=False)  #: The command in force
    _was_landing: bool = False  #: Whether the controller starts afresh when it is asked again
    _ahead: OneStepAhead | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        e = self.experiment
        self._tell_control = self.history.writer("/controller")
        self._tell_prediction = self.history.writer("/prediction")
        self._tell_landing = self.history.writer("/landing")
        self._ratio = e.samples_per_control
        self._gate = CommandGate(names(self.plant.inputs), self.plant.input_limits, self._tell)
        self._u = np.array(self.plant.first_command, dtype=float)
        if e.has_delay:
            self._ahead = OneStepAhead(e.model, e.sample_time, self._u)

    @classmethod
    def start(
        cls,
        experiment: Experiment,
        make_history: Callable[[PlantRun], History],
        clock: Clock | None = None,
        confirm: Confirm | None = None,
    ) -> Loop:
        """Everything ready for the first sample.

        A real rig is opened once all that may take long or fail has been done without it.
        ``make_history``: given the plant, returns where its run is kept. Called last: a plugin that
        refuses its configuration, a rig that does not answer or rest, and a person who does not
        ``confirm`` that a real rig may move, leave no file behind. ``clock``: another than the
        machine's, in tests.
        """
        e = experiment
        ratio = e.samples_per_control
        landing = landing_of(e.plant)
        # a real rig is ramped into the run as well
        ramps = landing.samples(farthest_command(e.model, landing), e.sample_time)
        around = ramps * landing.after_run * (1 + e.in_real_time)
        plant = e.plant.init(PlantSetup(e.sample_time, e.samples + around, e.seed, e.model))
        check_run(plant)
        inputs, outputs = names(plant.inputs), names(plant.outputs)
        if inputs != names(e.model.inputs):
            raise ConfigurationError(
                f"the rig takes {', '.join(inputs)}, the model {', '.join(names(e.model.inputs))}",
                where="plant.model",
                remedy="rig and model need the same inputs",
            )
        ramp = landing.init(inputs, plant.input_limits, e.sample_time)
        control = ControlSetup(e.model, ratio * e.sample_time, plant.first_command)
        preview = e.controller.preview(control)
        # Sampled once, as far as the last preview reaches.
        length = e.samples + preview * ratio + e.has_delay
        times = np.arange(length, dtype=np.float64) * e.sample_time
        references = reference_of(e.model, e.reference).sample(times)
        check_finite(references, times, e.model.controlled)
        check_reach(e, references)
        envelope = envelope_of(e.plant).init(
            EnvelopeSetup(e.sample_time, inputs, outputs, e.model.stops, e.model.bench_sizes)
        )
        supervisor = e.supervisor.init(SupervisorSetup(e.model, e.sample_time, outputs, ramp))

        def observing(reading: FloatArray) -> ObserverSetup:
            return ObserverSetup(
                e.model, e.sample_time, outputs, plant.noise_sd, reading, plant.first_command
            )

        pace = Pace(e.sample_time, e.late, clock) if e.in_real_time else None
        if pace is not None:
            rehearse(e, control, observing, references[: preview * ratio + 1 : ratio])
        life = RigLife(plant, ramp, pace)
        try:
            life.connect()
            life.prepare(confirm)
            envelope.wait()
            reading = check_reading(plant, plant.measure())
            reading = np.where(np.isinf(reading), np.nan, reading)  # as the envelope has it later
            observer_state = e.observer.init(observing(reading))
            gap_watch = e.gap_watch.init(observing(reading))
            controller_state = e.controller.init(control)
            history = make_history(plant)
        except BaseException:
            envelope.close()
            life.close("failed")
            raise
        return cls(
            e,
            plant,
            references,
            preview,
            history,
            life,
            pace,
            observer_state,
            controller_state,
            supervisor,
            envelope,
            gap_watch,
        )

    def run(
        self,
        progress: Progress | None = None,
        stop: StopRequest | None = None,
    ) -> None:
        """Run to the end, land and close; what is done stays in the history if it ends before.

        ``stop``: read once a sample. Raises RigLanded where the rig had to be landed,
        KeyboardInterrupt (Termination) where `stop` asks for it, and what a plugin raises; the rig
        is landed and closed by then.
        """
        stop = stop or StopRequest()
        with ExitStack() as machine:
            if self.pace is not None and isinstance(self.pace.clock, WallClock):
                for words in machine.enter_context(undisturbed()):
                    self._tell("note", "machine", words)
            # a rig that is not landed has its first command in force already
            first_command = self._u if self._lands else self.life.safe_command
            try:
                self.life.start(first_command, partial(self._ramp_in, stop))
                if self.pace is not None:
                    self.pace.begin()
                self._run_samples(progress, stop)
            except BaseException as error:
                self._end(_ending(error), stop)
                raise
            self._end("completed", stop)

    @property
    def _lands(self) -> bool:
        """Whether the rig is ramped into the run, and out of it."""
        return landing_of(self.experiment.plant).after_run

    def _end(self, reason: str, stop: StopRequest) -> None:
        """Land and close the rig, whatever went before; a further signal shortens the ramp."""
        try:
            if self._lands:
                self.life.land(self._u, self._log_landing, lambda: stop.at_once)
        except KeyboardInterrupt:  # swallowed here alone: the rig comes first
            self.life.land(self._u, self._log_landing, lambda: True)
            raise
        finally:
            self._envelope.close()
            self.life.close(reason)
            self.history.flush()

    def _ramp_in(self, stop: StopRequest, u: FloatArray, y: FloatArray) -> None:
        """A sample of the ramp into the run: watched as those of the run are."""
        self._u = u
        if stop.requests:
            raise stop.error()
        self._envelope.screen(np.asarray(y, dtype=float), self._tell)
        self._check_envelope()

    def _check_envelope(self) -> None:
        if self._envelope.landing_reason:
            raise RigLanded(
                f"the rig was landed: {self._envelope.landing_reason}",
                where="plant.envelope",
                remedy="see /event of the log for what went before",
            )

    def _log_landing(self, u: FloatArray, y: FloatArray) -> None:
        """A sample of the landing, after the run's last."""
        self._u = u
        now_ns = self._now_ns + round(self.experiment.sample_time * 1e9)
        self._now_ns = now_ns if self.pace is None else max(now_ns, self._clock_ns())
        self._tell_landing(self._now_ns, [*u.tolist(), *np.asarray(y, dtype=float).tolist()])

    def _clock_ns(self) -> int:
        """The run's time on the clock, ns; later than that of the sample before."""
        assert self.pace is not None
        return max(self._now_ns + 1, round(self.pace.elapsed() * 1e9))

    def _run_samples(self, progress: Progress | None, stop: StopRequest) -> None:
        """From the first sample to the last."""
        e, plant, history, watch = self.experiment, self.plant, self.history, self._supervisor
        pace, envelope, tell, gap_watch = self.pace, self._envelope, self._tell, self._gap_watch
        per_second = max(1, round(1.0 / e.sample_time))
        controlled = [e.model.state_index(name) for name in e.model.controlled]
        state_names = names(plant.states)
        order = estimate_order(history.fields.get("/estimate", ()), len(plant.outputs))
        log_signals = history.signal_writer(
            {"/reference": 1, "/command": 1, "/measurement": 1, "/plant/state": 1}
            | {"/estimate": ESTIMATE_PARTS},
            {"/estimate": order},
        )
        log_known, log_timing = history.writer("/disturbance"), history.writer("/timing")
        measured, known_torques = self._known_torques()
        faults = getattr(plant, "faults", ())
        delayed = self._ahead is not None
        pending = self._u  # with a delay: the command that is due next
        now, written = perf_counter, 0.0
        flushed_at = now()
        k = self.completed_samples

        while k < e.samples:
            if pace is None:
                self._now_ns = round(k * e.sample_time * 1e9)
            else:
                k = self._wait(pace, k)
            if stop.requests:
                raise stop.error()
            now_ns = self._now_ns
            if faults:
                self._tell_of_faults(faults, k)
            begun_at = now()
            y = plant.measure()
            read_at = now()
            truth_state = plant.state.copy()
            before = self._u
            if delayed:
                self._apply(pending)
                sent_at = now()
            screened_y = watch.screen(envelope.screen(y, tell))
            truth = None
            if state_names:
                truth = dict(zip(state_names, truth_state.tolist(), strict=True))
            if known_torques is None:
                estimate = e.observer.step(self._observer_state, before, screened_y, truth)
            else:
                # What acted until now is what was measured at the sample before.
                known = known_torques[max(k - 1, 0)]
                estimate = e.observer.step(
                    self._observer_state, before, screened_y, truth, known=known
                )
            estimated_at = now()
            watch.judge(estimate, tell)
            if self._ahead is None:
                answer = self._decide(estimate, k)
            else:  # every sample, for what the model remembers of commands
                answer = self._decide(self._ahead(estimate, self._u), k, acts_at=k + 1)
            self._check_envelope()
            decided_at = now()
            try:
                if delayed:
                    pending = answer.u
                else:
                    self._apply(answer.u)
                    sent_at = now()
            finally:
                self._log_answer(answer)
                signals = (self.references[k], self._u, y, truth_state)
                log_signals(now_ns, (*signals, *estimate_parts(estimate)))
                if known_torques is not None:
                    log_known(now_ns, measured[k].tolist())
                if any(estimate.rejected.tolist()):
                    tell_rejected(history, now_ns, estimate, plant.outputs)
            for alarm in gap_watch.step(before, screened_y):
                tell("gap_alarm", alarm.location, alarm.words, alarm.size)
            k += 1
            self.completed_samples = k
            if pace is not None:
                parts = (sent_at - read_at, estimated_at - read_at, decided_at - estimated_at)
                due, reading = (k - 1) * e.sample_time, read_at - begun_at
                log_timing(now_ns, (due, pace.lateness, reading, *parts, written))
            if k % per_second == 0:
                is_slow = pace is not None or now() - flushed_at > _FLUSH_AFTER
                if is_slow or k % (_SECONDS_AT_ONCE * per_second) == 0:
                    history.flush()
                    flushed_at = now()
                if progress is not None:
                    error = estimate.x[controlled] - self.references[k - 1]
                    progress(k * e.sample_time, float(np.abs(error).max()))
            written = now() - sent_at
        history.flush()

    def _wait(self, pace: Pace, k: int) -> int:
        """Wait for sample k; the sample that it is then, where some had to be left out.

        Raises RigLanded where the loop cannot keep up.
        """
        pace.step()
        self._now_ns = self._clock_ns() if k else 0
        if pace.lost:
            raise RigLanded(
                f"the rig was landed: {pace.late.land_after} samples in a row came a whole period "
                f"({self.experiment.sample_time:g} s) late, the last one by "
                f"{1e3 * pace.lateness:.0f} ms",
                where="sim.late.land_after",
                remedy="a longer sim.sample_time, a faster controller, or "
                "controller.delay=one_sample; `trms doctor` measures this machine",
            )
        if not pace.is_behind:
            return k
        count = min(pace.periods_behind, self.experiment.samples - 1 - k)
        is_real = getattr(self.experiment.plant, "real_time", False)
        if pace.late.policy == "hold" or not count or not is_real:
            return k  # a simulated rig stands still meanwhile: no sample of it has passed
        self._tell("skipped", "loop", "samples were left out (value: how many)", count)
        lost = np.full(len(self.plant.outputs), np.nan)
        for _ in range(count):  # the observer predicts over them
            estimate = self.experiment.observer.step(self._observer_state, self._u, lost, None)
            if self._ahead is not None:  # what the model remembers of commands goes on
                self._ahead(estimate, self._u)
            pace.skip()
        return k + count

    def _apply(self, u: FloatArray) -> None:
        """Send a command (n_u,); from then on it is in force."""
        self._u = u
        self.plant.advance(u)

    def _decide(self, estimate: Estimate, k: int, acts_at: int | None = None) -> _Answer:
        """The command from this sample on, or from the one at which it ``acts_at``."""
        e, watch, ratio = self.experiment, self._supervisor, self._ratio
        if watch.mode is Mode.LANDING:
            self._was_landing = True
            u = self._gate.applied(Command(watch.landed(self._u)), self._u)
            if k % ratio:
                return _Answer(u)
            overridden = Status.OVERRIDDEN  # the controller is not asked
            return _Answer(u, Command(u, overridden, message=overridden.meaning))
        if k % ratio or (self.pace is not None and self.pace.is_behind):
            return _Answer(self._u)
        period = ratio * e.sample_time
        if self._was_landing:
            control = ControlSetup(e.model, period, self._u.copy())
            self._controller_state, self._was_landing = e.controller.init(control), False
        begin = k if acts_at is None else acts_at
        ahead = self.references[begin : begin + self.preview * ratio + 1 : ratio].copy()
        sample = ControlSample(begin * e.sample_time, ahead, estimate, self._u)
        return self._control(sample, k // ratio)

    def _known_torques(self) -> tuple[FloatArray, FloatArray | None]:
        """Measured torques as logged (samples, n), and on the model's equations (samples, n_w)."""
        torques = self.plant.known_disturbances
        if not torques:
            return np.zeros((self.experiment.samples, 0)), None
        equations = names(self.experiment.model.disturbances)
        model_torques = np.zeros((self.experiment.samples, len(equations)))
        for equation, torque in torques.items():
            if equation in equations:
                model_torques[:, equations.index(equation)] = torque
        return np.column_stack(list(torques.values())), model_torques

    def _control(self, sample: ControlSample, count: int) -> _Answer:
        """One control step: its command within the limits."""
        every = self.experiment.prediction_every
        want_prediction = every > 0 and count % every == 0
        begin = perf_counter()
        command = self.experiment.controller.step(
            self._controller_state, sample, want_prediction=want_prediction
        )
        spent = perf_counter() - begin
        u = self._gate.applied(command, sample.previous_command)
        u = self._envelope.limited(u, sample.previous_command, self._tell)
        if self._gate.holds:  # whatever the controller says of it, it has failed
            command = replace(command, fallback="held")
        self._supervisor.note_command(command)
        return _Answer(u, command, spent)

    def _log_answer(self, answer: _Answer) -> None:
        """The controller's row: its words, the time that it took, and the supervisor's mode."""
        command, now_ns = answer.command, self._now_ns
        if command is None:
            return
        words = (
            answer.spent,
            command.linearise_time,
            command.qp_time,
            command.iterations,
            command.status.label,
            command.objective,
            command.slack,
            command.kkt_residual,
            bool(command.fallback),
            answer.spent > self.experiment.sample_time,  # false for what took no time (NaN)
            command.message,
            self._supervisor.mode.value,
            self._supervisor.reasons(),
            command.terminal_residual,
        )
        self._tell_control(now_ns, words)
        if command.prediction is not None:
            # Copies: it is written later, and a controller may plan in the same arrays again.
            p = command.prediction
            plans = (p.time, p.states.T, p.inputs.T)
            time, states, inputs = (np.array(plan, dtype=float) for plan in plans)
            self._tell_prediction(now_ns, (time, *states, *inputs))
        if command.status is Status.FAILED:
            self.history.event(now_ns, "solver", "controller", command.message or "solve failed")

    def _tell(self, kind: str, source: str, words: str, value: float = math.nan) -> None:
        self.history.event(self._now_ns, kind, source, words, value)

    def _tell_of_faults(self, faults: Sequence[Any], k: int) -> None:
        """Faults of a simulated rig, as they begin and end."""
        for fault in faults:
            if k == fault.active.start and fault.active:
                self._tell("fault_injected", "plant", fault.words)
            elif k == fault.active.stop and fault.active:
                self._tell("fault_removed", "plant", fault.words)


def _ending(error: BaseException) -> str:
    """Why a rig is closed, in a word."""
    if isinstance(error, RigLanded):
        return "landed"
    return "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"


#: Arrays of an estimate that its log row is made of.
ESTIMATE_PARTS = 7


def estimate_parts(estimate: Estimate) -> tuple[FloatArray, ...]:
    """The arrays that a log row of an estimate is made of; see :func:`estimate_order`."""
    return (
        estimate.x,
        estimate.disturbance,
        estimate.sd,
        estimate.disturbance_sd,
        estimate.predicted,
        estimate.innovation,
        estimate.innovation_sd,
    )


def estimate_order(fields: Sequence[str], n_y: int) -> IntArray:
    """Where each of the log's fields stands in :func:`estimate_parts`, one after another.

    The log has prediction, innovation and its spread of each channel side by side.
    """
    order = np.arange(len(fields))
    beside = len(fields) - 3 * n_y
    if beside >= 0:
        order[beside:] = beside + np.arange(3 * n_y).reshape(3, n_y).T.ravel()
    return order


def tell_rejected(
    history: History, now_ns: int, estimate: Estimate, outputs: Sequence[Signal]
) -> None:
    """An event for each sample that the observer took for an outlier."""
    for i in np.flatnonzero(estimate.rejected).tolist():
        signal, innovation = outputs[i], float(estimate.innovation[i])
        message = (
            f"a sample of {signal.name} was taken for an outlier (innovation in {signal.unit})"
        )
        history.event(now_ns, "outlier", signal.name, message, innovation)
