"""The closed loop: reference → controller → rig → observer, sample by sample.

At each sample the rig is measured, the observer takes the measurement, the controller (at its own,
slower or equal rate) takes the estimate, and the command is held until the next sample. A
supervisor watches and may keep a reading from the observer, or land the rig in the controller's
place. All that passes is written to the history. Nothing in here depends on the wall clock but the
times that the controller's work took.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import numpy as np

from trms_cli.controllers.controller import Command, Controller, ControlSample, ControlSetup, Status
from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError, SimulationError
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model, Signal, names
from trms_cli.observers.observer import Observer, ObserverSetup
from trms_cli.plants.plant import Plant, PlantRun, PlantSetup
from trms_cli.references.trajectory import ReferenceTrajectory
from trms_cli.simulation.history import History, Writer
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
    def samples_per_control(self) -> int:
        """Samples between two control steps.

        Raises ConfigurationError if the control period is not a whole multiple of the sample time.
        """
        # a plugin may do without the attribute: it then takes every sample
        period = getattr(self.controller, "sample_time", None) or self.sample_time
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
class Loop:
    """A run under way: made by :meth:`start`, advanced by :meth:`run`."""

    experiment: Experiment
    plant: PlantRun  #: The rig in this run
    #: (samples + preview, n_r) array; rad, at every sample and as far beyond the end as the last
    #: preview reaches
    references: FloatArray
    preview: int  #: Control periods that the controller sees ahead
    history: History
    _observer_state: Any
    _controller_state: Any
    _supervisor: SupervisorRun
    _now_ns: int = 0
    completed_samples: int = 0  #: Samples that are behind
    _gate: CommandGate = field(init=False)
    _tell_control: Writer = field(init=False)
    _tell_prediction: Writer = field(init=False)

    def __post_init__(self) -> None:
        self._tell_control = self.history.writer("/controller")
        self._tell_prediction = self.history.writer("/prediction")
        self._gate = CommandGate(names(self.plant.inputs), self.plant.input_limits, self._tell)

    @classmethod
    def start(cls, experiment: Experiment, make_history: Callable[[PlantRun], History]) -> Loop:
        """Everything ready for the first sample.

        ``make_history``: given the plant, returns where its run is kept. Called last: a plugin that
        refuses its configuration leaves no file behind.
        """
        e = experiment
        ratio = e.samples_per_control
        plant = e.plant.init(PlantSetup(e.sample_time, e.samples, e.seed))
        if names(plant.inputs) != names(e.model.inputs):
            raise ConfigurationError(
                f"the rig takes {', '.join(names(plant.inputs))}, "
                f"the model {', '.join(names(e.model.inputs))}",
                where="plant.model",
                remedy="rig and model need the same inputs",
            )
        control = ControlSetup(e.model, ratio * e.sample_time, plant.first_command)
        preview = e.controller.preview(control)
        # Sampled once, as far as the last preview reaches.
        times = np.arange(e.samples + preview * ratio, dtype=np.float64) * e.sample_time
        references = e.reference.restricted_to(e.model.controlled).sample(times)
        _check_finite(references, times, e.model.controlled)
        observing = ObserverSetup(
            e.model,
            e.sample_time,
            names(plant.outputs),
            plant.noise_sd,
            plant.measure(),
            plant.first_command,
        )
        observer_state = e.observer.init(observing)
        controller_state = e.controller.init(control)
        supervisor = e.supervisor.init(
            SupervisorSetup(e.model, e.sample_time, names(plant.outputs))
        )
        return cls(
            e,
            plant,
            references,
            preview,
            make_history(plant),
            observer_state,
            controller_state,
            supervisor,
        )

    def run(self, progress: Progress | None = None) -> None:
        """Run to the end; what is done stays in the history if an exception ends it."""
        e, plant, history, watch = self.experiment, self.plant, self.history, self._supervisor
        ratio = e.samples_per_control
        period = ratio * e.sample_time
        per_second = max(1, round(1.0 / e.sample_time))
        seen_ahead = self.preview * ratio + 1
        controlled = [e.model.state_index(name) for name in e.model.controlled]
        state_names = names(plant.states)
        log_reference, log_command = history.writer("/reference"), history.writer("/command")
        log_measurement, log_state = history.writer("/measurement"), history.writer("/plant/state")
        log_estimate, log_known = history.writer("/estimate"), history.writer("/disturbance")
        measured, known_torques = self._known_torques()
        faults = getattr(plant, "faults", ())
        u = plant.first_command.copy()
        landing = False

        for k in range(self.completed_samples, e.samples):
            now_ns = self._now_ns = round(k * e.sample_time * 1e9)
            if faults:
                self._tell_of_faults(faults, k)
            y = plant.measure()
            screened_y = watch.screen(y)
            truth_row = plant.state.tolist()
            truth = dict(zip(state_names, truth_row, strict=True)) if state_names else None
            if known_torques is None:
                estimate = e.observer.step(self._observer_state, u, screened_y, truth)
            else:
                # What acted until now is what was measured at the sample before.
                estimate = e.observer.step(
                    self._observer_state, u, screened_y, truth, known=known_torques[max(k - 1, 0)]
                )
                log_known(now_ns, measured[k].tolist())
            watch.judge(estimate, self._tell)
            if watch.mode is Mode.LANDING:
                landing = True
                u = self._gate.applied(Command(watch.landed(u)), u)
                if k % ratio == 0:
                    overridden = Status.OVERRIDDEN  # the controller is not asked
                    self._log_control(Command(u, overridden, message=overridden.meaning))
            elif k % ratio == 0:
                if landing:
                    control = ControlSetup(e.model, period, u.copy())
                    self._controller_state, landing = e.controller.init(control), False
                ahead = self.references[k : k + seen_ahead : ratio].copy()
                sample = ControlSample(k * e.sample_time, ahead, estimate, u)
                u = self._control(sample, k // ratio, period)
            log_reference(now_ns, self.references[k].tolist())
            log_command(now_ns, u.tolist())
            log_measurement(now_ns, y.tolist())
            log_state(now_ns, truth_row)
            log_estimate(now_ns, estimate_row(estimate))
            if any(estimate.rejected.tolist()):
                tell_rejected(history, now_ns, estimate, plant.outputs)
            plant.advance(u)
            self.completed_samples = k + 1
            if self.completed_samples % per_second == 0:
                history.flush()
                if progress is not None:
                    error = estimate.x[controlled] - self.references[k]
                    progress(self.completed_samples * e.sample_time, float(np.abs(error).max()))
        history.flush()

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

    def _control(self, sample: ControlSample, count: int, deadline: float) -> FloatArray:
        """One control step: its command within the limits, its words in the log."""
        now_ns = self._now_ns
        every = self.experiment.prediction_every
        want_prediction = every > 0 and count % every == 0
        begin = perf_counter()
        command = self.experiment.controller.step(
            self._controller_state, sample, want_prediction=want_prediction
        )
        spent = perf_counter() - begin
        u = self._gate.applied(command, sample.previous_command)
        if self._gate.holds:  # whatever the controller says of it, it has failed
            command = replace(command, fallback="held")
        self._supervisor.note_command(command)
        self._log_control(command, spent, missed=spent > deadline)
        if command.prediction is not None:
            p = command.prediction
            self._tell_prediction(now_ns, (p.time, *p.states.T, *p.inputs.T))
        if command.status is Status.FAILED:
            self.history.event(now_ns, "solver", "controller", command.message or "solve failed")
        return u

    def _log_control(self, command: Command, spent: float = math.nan, missed: bool = False) -> None:
        """The controller's row: its words, the time that it took, and the supervisor's mode."""
        self._tell_control(
            self._now_ns,
            (
                spent,
                command.linearise_time,
                command.qp_time,
                command.iterations,
                command.status.label,
                command.objective,
                command.slack,
                command.kkt_residual,
                bool(command.fallback),
                missed,
                command.message,
                self._supervisor.mode.value,
                self._supervisor.reasons(),
                command.terminal_residual,
            ),
        )

    def _tell(self, kind: str, source: str, words: str, value: float = math.nan) -> None:
        self.history.event(self._now_ns, kind, source, words, value)

    def _tell_of_faults(self, faults: Sequence[Any], k: int) -> None:
        """Faults of a simulated rig, as they begin and end."""
        for fault in faults:
            if k == fault.active.start and fault.active:
                self._tell("fault_injected", "plant", fault.words)
            elif k == fault.active.stop and fault.active:
                self._tell("fault_removed", "plant", fault.words)


def _check_finite(references: FloatArray, times: FloatArray, axes: Sequence[str]) -> None:
    wrong = np.argwhere(~np.isfinite(references))
    if len(wrong):
        k, axis = wrong[0]
        raise ConfigurationError(
            f"the reference is {references[k, axis]} at {times[k]:g} s",
            where=f"ref.{axes[axis]}",
            remedy="a reference needs a finite value at every sample",
        )


def estimate_row(estimate: Estimate) -> list[float]:
    """An estimate in the order of the log's fields; see :func:`estimate_fields`."""
    row = [*estimate.x.tolist(), *estimate.disturbance.tolist()]
    row += estimate.sd.tolist()
    row += estimate.disturbance_sd.tolist()
    of_channels = [0.0] * (3 * len(estimate.predicted))
    of_channels[0::3] = estimate.predicted.tolist()
    of_channels[1::3] = estimate.innovation.tolist()
    of_channels[2::3] = estimate.innovation_sd.tolist()
    return row + of_channels


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


#: Takes kind, source, sentence and value of an event.
Tell = Callable[[str, str, str, float], None]


class CommandGate:
    """Cuts commands to the limits, holds what is not finite, and tells when either begins or ends.

    ``limits``: (n_u,) each; lower and upper, V. ``tell``: takes kind, source, sentence and value
    (V) of an event.
    """

    def __init__(
        self, inputs: tuple[str, ...], limits: tuple[FloatArray, FloatArray], tell: Tell
    ) -> None:
        self._inputs, self._tell = inputs, tell
        self._lower, self._upper = (bound.tolist() for bound in limits)
        self._saturated: set[str] = set()
        self._not_finite: set[str] = set()

    @property
    def holds(self) -> bool:
        """Whether the last command had a value that is no number, and an older one is applied."""
        return bool(self._not_finite)

    def applied(self, command: Command, previous: FloatArray) -> FloatArray:
        """The command (n_u,) as applied after ``previous``, V.

        Raises SimulationError for what is no command at all: it is a mistake in the controller's
        code.
        """
        if not isinstance(command, Command):
            raise _no_command(f"step returned {command!r}, not a Command")
        try:
            request = np.asarray(command.u, dtype=float)
        except (TypeError, ValueError):
            raise _no_command(f"command is {command.u!r}, no array of numbers") from None
        if request.shape != previous.shape:
            raise _no_command(f"command has shape {request.shape}, the rig takes {previous.shape}")
        values = request.tolist()
        if not (self._saturated or self._not_finite) and all(
            map(_between, self._lower, values, self._upper)
        ):
            return request.copy()  # as almost always: nothing to cut, nothing to tell
        applied = previous.copy()
        for i, value in enumerate(values):
            name, finite = self._inputs[i], math.isfinite(value)
            if finite:
                applied[i] = min(max(value, self._lower[i]), self._upper[i])
            saturated = finite and not self._lower[i] < value < self._upper[i]
            if saturated != (name in self._saturated):
                self._saturated ^= {name}
                words = "reached its limit" if saturated else "left its limit"
                kind = "saturation_begin" if saturated else "saturation_end"
                self._tell(kind, name, f"{name} {words} (value in V)", value)
            if finite == (name in self._not_finite):
                self._not_finite ^= {name}
                words = "is finite again" if finite else "is not finite; the last command is held"
                kind = "fault_end" if finite else "fault"
                self._tell(kind, "controller", f"{name} {words}", value)
        return applied


def _between(low: float, value: float, high: float) -> bool:
    """False for what is not a number."""
    return low < value < high


def _no_command(what: str) -> SimulationError:
    return SimulationError(
        f"the controller's {what}",
        where="controller",
        remedy="step returns Command(u): one value (V) for each of the model's inputs, in their "
        "order",
    )
