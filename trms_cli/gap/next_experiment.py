"""Which experiment to make next: what the refitted model says that each would record, compared.

Each of a handful of open-loop experiments is simulated; along that motion the traces of the effects
asked after are projected and compared as those of the recordings are, in nats.
"""

import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import TrmsError
from trms_cli.core.wording import listing
from trms_cli.gap.competing_model import CandidateFit, FittedModel, Metric, ModelStructure, Refit
from trms_cli.gap.diagnosis import NextExperiment, OpenLoopExperiment, PredictedExperiment
from trms_cli.gap.discrepancy import FLOOR, Discrepancy, TrajectoryLinearisation
from trms_cli.gap.gain_drift import gain_drift
from trms_cli.gap.problem import CandidateEffect
from trms_cli.gap.signatures import Signatures, effect_traces, project_traces
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.excitation.design import band_of, lead_in, linearise_model
from trms_cli.identification.excitation.excitation import ExcitationPlugin, Plan
from trms_cli.identification.excitation.multilevel import MultilevelExcitation
from trms_cli.identification.excitation.multisine import MultisineExcitation
from trms_cli.identification.excitation.prbs import PrbsExcitation
from trms_cli.models.model import Model, names
from trms_cli.models.steady_state import SteadyState
from trms_cli.references.sawtooth import Sawtooth
from trms_cli.references.signal import ReferenceSignal
from trms_cli.references.square import Square
from trms_cli.simulation.rollout import Rollout

#: s, of the excitation, and of what leads to its operating point.
DURATION, LEAD_IN = 32.0, 8.0
#: Share of the inputs' limits that is used, and of the stops: ``trms excite`` takes 0.8 of both.
_OF_INPUTS, _OF_STOPS = 0.8, 0.72
#: rad, for an axis without a stop; ``trms excite`` takes 1.5.
_WITHOUT_STOP = 1.35
#: Shares of the largest amplitude that are tried.
_SHARES = (1.0, 0.7, 0.5, 0.35, 0.25, 0.17, 0.12, 0.08, 0.05)
#: Of an operating point's angles, the share of those at rest: as ``trms excite`` takes them.
_FROM_REST = 0.5


@dataclass(frozen=True)
class _Wave:
    """A signal of an input: the option and its keys, the offset in amplitudes."""

    option: str
    frequency: float
    phase: float = 0.0
    offset: float = 0.0
    width: float | None = None

    def keys(self, amplitude: float) -> dict[str, float]:
        """As they are typed: the phase always, for ``open_loop`` has one of its own."""
        keys = {"amplitude": amplitude, "frequency": self.frequency, "phase": self.phase}
        if self.offset:
            keys["offset"] = float(f"{self.offset * amplitude:.3g}")
        if self.width is not None:
            keys["width"] = self.width
        return keys

    def signal(self, amplitude: float) -> ReferenceSignal:
        kind: Any = {"square": Square, "sawtooth": Sawtooth}[self.option]
        return kind(**self.keys(amplitude))


#: The one that goes beyond the model's band, by this factor: a delay shows there.
_FAST, _FASTER = "prbs", 4.0
#: Share of the Nyquist frequency that it may reach.
_OF_NYQUIST = 0.5
#: About an operating point, or with rotors that reverse: designed by ``trms excite``.
_DESIGNED: tuple[tuple[str, str, ExcitationPlugin, bool], ...] = (
    ("fast switching between two levels", _FAST, PrbsExcitation(), False),
    ("sines over the model's band", "multisine", MultisineExcitation(iterations=0), False),
    ("random levels", "multilevel", MultilevelExcitation(), False),
    ("random levels with rotors that reverse", "multilevel", MultilevelExcitation(), True),
)
#: One rotor small, about the operating point or zero, while the other is steady: an axis comes to
#: rest and breaks away many times, and what acts on it beside its friction is small.
#: For which share of the band's shortest period a level holds at most: twice the shortest. After
#: longer ones the axis sticks most of the time, which it does by either law.
_SMALL_HOLD = 0.88
#: Shares of a rotor's largest amplitude that are tried for these.
_SMALL_SHARES = (0.2, 0.4)
#: Played by ``trms run controller=open_loop``; by main rotor and tail rotor.
_PLAYED: tuple[tuple[str, _Wave, _Wave], ...] = (
    (
        "steps through zero while the rotors still turn",
        _Wave("square", 0.15),
        _Wave("square", 0.22, phase=0.25),
    ),
    (
        "slow rises and falls through zero",
        _Wave("sawtooth", 0.06, width=0.5),
        _Wave("sawtooth", 0.045, width=0.5, phase=0.25),
    ),
)
_LOAD = (
    "a long load, then rest",
    _Wave("square", 0.02, offset=1.0),
    _Wave("square", 0.025, offset=1.0, phase=0.5),
)


def experiments(
    rollout: Rollout,
    parameters: Sequence[FloatArray],
    sample_time: float,
    model_name: str,
    *,
    load: bool = False,
    rest: bool = False,
    seed: int = 0,
) -> Iterator[OpenLoopExperiment]:
    """Those of the experiments that the simulated rig survives.

    ``rollout``: of the nominal model. ``parameters``, (n_p,) arrays: with each of which the angles
    have to stay within their bounds. ``sample_time``: s. ``model_name``: as a command takes it.
    ``load``: whether a long load is among them. ``rest``: whether those are in which an axis often
    comes to rest. ``seed``: of what is drawn.
    """
    trial = _Trial(rollout, parameters)
    yield from _designed_experiments(trial, sample_time, model_name, rest=rest, seed=seed)
    yield from _played_experiments(
        trial, sample_time, model_name, (*_PLAYED, _LOAD) if load else _PLAYED
    )


class _Trial:
    """Plays commands from rest to a simulated rig and tells whether it stays within its bounds."""

    def __init__(self, rollout: Rollout, parameters: Sequence[FloatArray]) -> None:
        self.rollout, self.parameters = rollout, parameters
        self.model: Model = rollout.model
        outputs = names(self.model.outputs)
        self.angles = [
            name
            for name in self.model.controlled
            if name in outputs and self.model.outputs[outputs.index(name)].unit == "rad"
        ]
        self._columns = [outputs.index(name) for name in self.angles]
        stops = np.array([float(self.model.stops.get(name, np.inf)) for name in self.angles])
        self._stops = np.where(np.isfinite(stops), stops, 4 * np.pi)
        self._bounds = np.where(np.isfinite(stops), _OF_STOPS * stops, _WITHOUT_STOP)

    def fit(self, commands: Sequence[FloatArray], first: int) -> list[bool]:
        """Which of some commands (n, n_u) keep the angles in bounds, from ``first`` on."""
        n = len(commands[0])
        start = self.rollout.initial(self.model.rest(), commands[0][0])
        starts = np.tile(start, (len(commands), 1))
        limits = np.where(np.arange(n)[:, None] < first, self._stops, self._bounds)
        fits = np.ones(len(commands), dtype=bool)
        for p in self.parameters:
            begins = np.arange(len(commands)) * n
            counts = np.full(len(commands), n)
            with np.errstate(all="ignore"):
                y = self.rollout.outputs(np.vstack(commands), begins, counts, starts, p).y
            y = y.reshape(len(commands), n, -1)
            # what is no longer a number is within no bound
            inside = (np.abs(y[..., self._columns]) <= limits).all(axis=(1, 2))
            fits &= inside & np.isfinite(y).all(axis=(1, 2))
        return fits.tolist()

    def amplitude(
        self, commands: Callable[[FloatArray], FloatArray], room: FloatArray, first: int
    ) -> FloatArray | None:
        """The largest amplitudes (n_u,) that fit: all alike first, then each beyond that."""

        def best(trials: list[FloatArray]) -> FloatArray | None:
            if not trials:
                return None
            fits = self.fit([commands(t) for t in trials], first)
            return next((t for t, fit in zip(trials, fits, strict=True) if fit), None)

        amplitudes = best([_round_amplitudes(share * room) for share in _SHARES])
        if amplitudes is None or len(room) < 2:
            return amplitudes
        for i in reversed(range(len(room))):  # the tail rotor's axis is the freer one
            larger = []
            for share in _SHARES:
                trial = amplitudes.copy()
                trial[i] = _round_amplitudes(share * room)[i]
                if trial[i] > amplitudes[i]:
                    larger.append(trial)
            better = best(larger)
            amplitudes = amplitudes if better is None else better
        return amplitudes


def _designed_experiments(
    trial: _Trial, sample_time: float, model_name: str, *, rest: bool, seed: int
) -> Iterator[OpenLoopExperiment]:
    model = trial.model
    at_rest = model.rest()
    angles = [_FROM_REST * float(at_rest[model.state_index(name)]) for name in model.controlled]
    try:
        target = SteadyState(model).solve(np.array(angles))
        if not target.exact:
            return
        points = {
            False: (np.array(target.u), np.array(target.x)),
            True: (np.zeros(model.n_u), at_rest),
        }
        bands = {
            reverses: band_of(linearise_model(model, x, u), sample_time, DURATION)
            for reverses, (u, x) in points.items()
        }
    except TrmsError:  # no equations, no rest there: what needs neither is left
        return
    upper = model.input_bounds()[1]
    samples = round(DURATION / sample_time)
    for words, option, excitation, reverses in _DESIGNED:
        centre, (lowest, highest) = points[reverses][0], bands[reverses]
        keys = [f"excitation={option}"]
        if option == _FAST:
            highest = float(f"{min(_FASTER * highest, _OF_NYQUIST * 0.5 / sample_time):.3g}")
            keys.append(f"band.highest={highest:g}")
        plan = Plan(samples, sample_time, lowest, highest, model.n_u, seed)
        try:
            about = _AboutPoint(centre, excitation.shape(plan).values, sample_time)
        except TrmsError:
            continue
        room = _OF_INPUTS * upper - np.abs(centre)
        amplitude = trial.amplitude(about.commands, room, about.first)
        if amplitude is None:
            continue
        keys += ["excitation.iterations=0"] * (option == "multisine")
        keys += ["reversals=true"] * reverses
        yield about.experiment(words, keys, amplitude, model, model_name, seed)
    for reverses in (False, True) if rest else ():
        centre, (lowest, highest) = points[reverses][0], bands[reverses]
        plan = Plan(samples, sample_time, lowest, highest, model.n_u, seed)
        longest = float(f"{_SMALL_HOLD / highest:.2g}")
        try:
            shape = MultilevelExcitation(longest=longest).shape(plan).values
        except TrmsError:
            continue
        about = _AboutPoint(centre, shape, sample_time)
        keys = ["excitation=multilevel", f"excitation.longest={longest:g}"]
        keys += ["reversals=true"] * reverses
        for i, name in enumerate(names(model.inputs)):
            room = np.where(np.arange(model.n_u) == i, _OF_INPUTS * upper - np.abs(centre), 0.0)
            trials = [_round_amplitudes(share * room) for share in _SMALL_SHARES]
            fits = trial.fit([about.commands(amplitude) for amplitude in trials], about.first)
            words = _words_of_small_levels(model, name, reverses)
            for amplitude, fit in zip(trials, fits, strict=True):
                if fit:
                    yield about.experiment(words, keys, amplitude, model, model_name, seed)


def _words_of_small_levels(model: Model, name: str, reverses: bool) -> str:
    """For levels of an input of that name."""
    rotors = {own: rotor for rotor, own in model.rotors.items()}
    words = f"small random levels of the {rotors.get(name, name)} rotor"
    if model.n_u > 1:
        words += ", the other off" if reverses else ", the other steady"
    return words


class _AboutPoint:
    """An excitation about an operating point, with the way to it from rest.

    ``centre``, (n_u,) array: V. ``shape``, (n, n_u) array: of unit peak.
    """

    def __init__(self, centre: FloatArray, shape: FloatArray, sample_time: float) -> None:
        self._centre, self._shape, self._sample_time = centre, shape, sample_time
        self._head = lead_in(centre, round(LEAD_IN / sample_time))
        self.first = len(self._head)  #: Sample at which the excitation begins

    def commands(self, amplitude: FloatArray) -> FloatArray:
        """What is played at an amplitude (n_u,), (n, n_u) V."""
        return np.vstack([self._head, self._centre + amplitude * self._shape])

    def experiment(
        self,
        words: str,
        keys: Sequence[str],
        amplitude: FloatArray,
        model: Model,
        model_name: str,
        seed: int,
    ) -> OpenLoopExperiment:
        """With the command line that makes it; ``keys``: of the excitation."""
        amplitude_text = ", ".join(
            f"{name}: {size:g}" for name, size in zip(names(model.inputs), amplitude, strict=True)
        )
        keys = [
            *keys,
            f"duration={DURATION:g}",
            f"lead_in={LEAD_IN:g}",
            f"amplitude={{{amplitude_text}}}",
            *[f"seed={seed}"] * (seed > 0),
        ]
        return OpenLoopExperiment(
            words=words,
            commands=self.commands(amplitude),
            command=_command_line("excite", model_name, keys, self._sample_time),
            centre=self._centre,
            first=self.first,
        )


def _played_experiments(
    trial: _Trial, sample_time: float, model_name: str, kinds: Sequence[tuple[str, _Wave, _Wave]]
) -> Iterator[OpenLoopExperiment]:
    model = trial.model
    inputs = names(model.inputs)
    if any(name not in ("u_v", "u_h") for name in inputs):
        return  # controller=open_loop has no key for another input
    roles = {name: rotor for rotor, name in model.rotors.items()}
    samples = round((DURATION + LEAD_IN) / sample_time)
    time = np.arange(samples, dtype=np.float64) * sample_time
    upper = model.input_bounds()[1]
    for words, main, tail in kinds:
        waves = [tail if roles.get(name) == "tail" else main for name in inputs]

        def commands(amplitude: FloatArray, waves: list[_Wave] = waves) -> FloatArray:
            columns = [w.signal(a).sample(time) for w, a in zip(waves, amplitude, strict=True)]
            return np.column_stack(columns)

        room = _OF_INPUTS * upper / np.array([1 + abs(wave.offset) for wave in waves])
        amplitude = trial.amplitude(commands, room, 0)
        if amplitude is None:
            continue
        keys = ["controller=open_loop"]
        for name, wave, size in zip(inputs, waves, amplitude.tolist(), strict=True):
            keys.append(f"signal@controller.{name}={wave.option}")
            keys += [f"controller.{name}.{key}={v:g}" for key, v in wave.keys(size).items()]
        keys += ["ref=speed"] * (not trial.angles)  # a rotor alone has no angle to refer to
        keys.append(f"sim.duration={DURATION + LEAD_IN:g}")
        yield OpenLoopExperiment(
            words=words,
            commands=commands(amplitude),
            command=_command_line("run", model_name, keys, sample_time),
            centre=np.zeros(len(inputs)),
            first=0,
        )


def _command_line(command: str, model_name: str, keys: Sequence[str], sample_time: float) -> str:
    step = "sample_time" if command == "excite" else "sim.sample_time"
    words = ["trms", command, f"model={model_name}", *keys]
    if abs(sample_time - 0.02) > 1e-9:
        words.append(f"{step}={sample_time:.9g}")
    return " ".join(shlex.quote(word) for word in words)


def _round_amplitudes(amplitude: FloatArray) -> FloatArray:
    """As they are typed."""
    return np.array([float(f"{value:.3g}") for value in amplitude])


#: Effects that are asked after at a time.
_AT_ONCE = 3
#: Nats that decide between two: odds of 20 to 1. Below, an experiment separates nothing.
DECIDES = 3.0
#: Nats at which an effect is visible: five standard deviations, as for what is testable.
VISIBLE = 12.5
#: Nats beyond which more does not count when several effects are to be served.
_ENOUGH = 10 * VISIBLE
#: Of names of effects that need a long load, or a beam that hangs low, to show.
_OF_LOAD = ("derating", "ground")
#: Of names of effects that show where an axis comes to rest and breaks away.
_OF_REST = ("coulomb_friction", "stribeck_friction", "hysteresis")
#: Share of the refit's discrepancy that is taken to be left once the cause is in the model.
_LEFT = 1 / 3


@dataclass(frozen=True)
class _Question:
    """What is to be found out."""

    candidates: tuple[CandidateEffect, ...]  #: With the rows that are simulated
    apart: bool  #: Whether they are to be told apart, the first from each other; else to be seen
    fitted_names: tuple[str, ...] = ()  #: Those whose first row is their fitted size
    #: Rows that the recordings do not show
    hidden_rows: Mapping[str, tuple[int, ...]] | None = None

    def worth(self, recording: FittedModel) -> tuple[float, ...]:
        """Nats that a recording gives for each thing asked, in the order asked."""
        signs = signatures(recording, self.candidates)
        names = [candidate.name for candidate in self.candidates]
        if self.apart:
            first = names[0]
            nats = [between(signs, first, other, self.fitted_names) for other in names[1:]]
            return (min(nats),)
        hidden_rows = self.hidden_rows or {}
        return tuple(visibility(signs, name, hidden_rows.get(name)) for name in names)


def advise(
    *,
    refit: Refit,
    candidates: Mapping[str, CandidateEffect],
    model_name: str,
    apart: Sequence[str] = (),
    untested: Sequence[str] = (),
    values: Mapping[str, float] | None = None,
    shares: FloatArray | None = None,
) -> NextExperiment | None:
    """The best of a handful of open-loop experiments, and what it promises.

    Each is simulated with the refitted model; along that motion the traces of the effects asked
    after are projected and compared as those of the recordings are
    (:mod:`trms_cli.gap.signatures`). A second or two on one core where the models of the effects
    are compiled, as they are after the race. None where no experiment can be predicted: in open
    loop the angles would not stay within their bounds at any amplitude.

    ``apart``: effects that cannot be told apart, the likeliest first; used where it names two or
    more. ``untested``: else these are to be made visible; the first three count. Where both are
    empty, the first of the candidates that the recordings hardly show are. ``values``: fitted sizes
    by name, ``<effect>.<size>``; the others are taken at typical sizes. ``shares``, (n_d,) array:
    discrepancy to be reckoned with; None: a third of the refit's, for most of that goes when the
    cause is in the model.
    """
    values = values or {}
    step = refit.structure.windows.sample_time
    apart_names = [name for name in apart if name in candidates]
    if len(apart_names) >= 2 and any(candidates[name].stochastic for name in apart_names):
        return _repetition_advice(apart_names, candidates, model_name, step)
    if shares is None:
        shares = np.maximum(FLOOR, _LEFT * refit.metric.shares)
    present = replace(refit, metric=replace(refit.metric, shares=shares))
    question = _question(apart_names, untested, candidates, values, present)
    if question is None:
        return None
    now = question.worth(present)
    load, rest = (
        any(word in s.name for s in question.candidates for word in of)
        for of in (_OF_LOAD, _OF_REST)
    )
    predictions = [
        (question.worth(recording), experiment)
        for experiment, recording in predicted_recordings(
            refit, shares, model_name, load=load, rest=rest
        )
    ]
    if not predictions:
        return None
    best, experiment = max(
        predictions, key=lambda pair: sum(min(n, _ENOUGH) for n in pair[0]) + 1e-6 * sum(pair[0])
    )
    duration = sum(dataset.duration for dataset in refit.structure.problem.datasets)
    why = _why(question, now, best, experiment, duration, step, len(predictions))
    prediction = PredictedExperiment(
        experiment=experiment,
        apart=tuple(s.name for s in question.candidates) if question.apart else (),
        nats=min(best),
        longer=question.apart and min(best) * duration < min(now) * len(experiment.commands) * step,
    )
    return NextExperiment(why=why, command=experiment.command, prediction=prediction)


def _question(
    apart: Sequence[str],
    untested: Sequence[str],
    candidates: Mapping[str, CandidateEffect],
    values: Mapping[str, float],
    present: FittedModel,
) -> _Question | None:
    if len(apart) >= 2:
        selection = [candidates[name] for name in apart[:_AT_ONCE]]
        # what a fit made of one's special case says nothing of how the two differ
        for candidate in selection:
            if candidate.special_case(candidates) is not None:
                values = candidate.apart_from_special_case(values)
        rows = tuple(with_rows(candidate, values) for candidate in selection)
        return _Question(rows, True, tuple(s.name for s in selection if is_fitted(s, values)))
    names = [
        n for n in (untested or candidates) if n in candidates and not candidates[n].stochastic
    ]
    if not names:
        return None
    selection = [candidates[name] for name in names]
    if untested:
        selection = selection[:_AT_ONCE]
    signs = signatures(present, selection)
    # where nothing was asked after, those that the recordings show least
    selection = sorted(selection, key=lambda candidate: visibility(signs, candidate.name))[
        :_AT_ONCE
    ]
    hidden_rows = {
        s.name: tuple(
            np.flatnonzero(0.5 * signs.projected_energy[signs.rows(s.name)] < VISIBLE).tolist()
        )
        for s in selection
    }
    return _Question(
        tuple(selection), False, (), {name: rows for name, rows in hidden_rows.items() if rows}
    )


def _repetition_advice(
    apart: Sequence[str], candidates: Mapping[str, CandidateEffect], model_name: str, step: float
) -> NextExperiment:
    noise = [name for name in apart if candidates[name].stochastic]
    rest = [name for name in apart if name not in noise]
    against = f" from {listing(rest)}" if rest else ""
    keys = ["excitation=multisine", "excitation.periods=4", "excitation.iterations=0"]
    return NextExperiment(
        why=f"a signal that repeats itself four times tells {listing(noise)}{against}: what "
        "returns with every period belongs to the rig, what does not comes from outside; how "
        "clearly was not predicted",
        command=_command_line("excite", model_name, keys, step),
    )


def _why(
    question: _Question,
    now: tuple[float, ...],
    best: tuple[float, ...],
    experiment: OpenLoopExperiment,
    duration: float,
    step: float,
    count: int,
) -> str:
    names = [candidate.name for candidate in question.candidates]
    seconds = len(experiment.commands) * step
    if question.apart:
        pair = listing(names) if len(names) > 2 else " from ".join(names)
        gain = f"{_nats(best[0])} in {seconds:.0f} s, against {_nats(now[0])} in the "
        gain += f"{duration:.0f} s recorded"
        of_the_best = f"the command is that of the best, {experiment.words}: {gain}"
        if best[0] < DECIDES:
            return (
                f"none of {count} open-loop experiments tells {pair}, and no input of this kind "
                f"does; {of_the_best}, where {DECIDES:g} would be odds of 20 to 1"
            )
        if best[0] * duration < now[0] * seconds:
            return (
                "record longer, in the way of the present recording: none of "
                f"{count} open-loop experiments tells {pair} faster. Only if that cannot be done, "
                f"{of_the_best}"
            )
        return f"{experiment.words}: tells {pair} by {gain}"
    visible = [n for n, nats in zip(names, best, strict=True) if nats >= VISIBLE]
    by = ", ".join(
        f"{name} {_nats(then)} against {_nats(before)}"
        for name, then, before in zip(names, best, now, strict=True)
        if name in visible or not visible
    )
    if not visible:
        return (
            f"none of {count} open-loop experiments makes {listing(names)} visible at typical "
            f"sizes ({VISIBLE:g} nats); the command is that of the best, {experiment.words}: {by} "
            "in what is recorded"
        )
    invisible = [name for name in names if name not in visible]
    rest = f"; {listing(invisible)} would still not show" if invisible else ""
    return (
        f"{experiment.words}: makes visible at typical sizes, in {seconds:.0f} s: {by} in what is "
        f"recorded{rest}"
    )


def _nats(value: float) -> str:
    if value < 0.05:
        return "no nats"
    return f"{value:.2g} nats" if value < 10 else f"{value:.0f} nats"


def predicted_recordings(
    refit: Refit,
    shares: FloatArray,
    model_name: str,
    *,
    load: bool = False,
    rest: bool = False,
) -> Iterator[tuple[OpenLoopExperiment, FittedModel]]:
    """Experiments, and what each records; angles stay in bounds before and after the refit.

    ``shares``, (n_d,) array: discrepancy to be reckoned with. ``model_name``: as a command takes
    it. ``load``: whether a long load is among them, for effects that need one. ``rest``: whether
    those are in which an axis often comes to rest.

    What is drawn is drawn anew for each recording that there is: commands that were played say the
    same again.
    """
    structure = refit.structure
    problem, rollout = structure.problem, structure.windows.rollout
    theta = refit.fit.theta
    p = problem.all_values(theta)
    linearisation: TrajectoryLinearisation | None = None
    step = structure.windows.sample_time
    both = (p, problem.model.parameters.values)
    seed = len(problem.datasets) - 1
    for experiment in experiments(rollout, both, step, model_name, load=load, rest=rest, seed=seed):
        dataset, starts = _simulate_recording(refit, rollout, p, experiment.commands)
        predicted_structure = ModelStructure(
            problem.model, problem.free, (), [dataset], problem.window_length
        )
        linearisation = linearisation or TrajectoryLinearisation(predicted_structure.windows)
        linearisation.windows = predicted_structure.windows
        discrepancy = Discrepancy(
            predicted_structure.windows,
            linearisation.along(p, starts),
            refit.metric.discrepancy.channels,
            start_share=0.0,
        )
        # it will be fitted beside the present recordings, and excused for as much as these are
        excused = shares * np.maximum(1.0, refit.metric.discrepancy.scales / discrepancy.scales)
        try:
            drift = gain_drift(predicted_structure.windows, discrepancy.trajectory)
            metric = Metric(discrepancy, excused, drift, refit.metric.drift_sizes, None)
        except FloatingPointError:  # along this motion the equations say too little
            continue
        yield (
            experiment,
            FittedModel(
                predicted_structure,
                CandidateFit(theta, starts, np.zeros(len(drift.drive))),
                metric,
                starts,
            ),
        )


def _simulate_recording(
    refit: Refit, rollout: Rollout, p: FloatArray, commands: FloatArray
) -> tuple[Dataset, FloatArray]:
    """The outputs of a rig that is as the refitted model says, and the states at block starts.

    Its noise is declared but not drawn: what traces are compared by is its size.
    """
    problem = refit.structure.problem
    model, sample = problem.model, problem.datasets[0]
    n = len(commands)
    outputs = [signal.name for signal in model.outputs]
    columns = [outputs.index(signal.name) for signal in sample.outputs]
    empty = Dataset(
        "next",
        "",
        "",
        refit.structure.windows.sample_time,
        np.arange(n, dtype=np.float64) * refit.structure.windows.sample_time,
        sample.inputs,
        sample.outputs,
        np.ascontiguousarray(commands),
        np.zeros((n, len(columns))),
        sample.noise_sd,
    )
    first, count = empty.windows(problem.window_length)
    x = rollout.initial(model.rest(), commands[0])
    starts, y = [], []
    for begin, length in zip(first, count, strict=True):
        starts.append(x[: model.n_x])
        part = rollout.outputs(commands, [begin], [length], x[None], p)
        y.append(part.y)
        x = part.ends[0]
    used = int(first[-1] + count[-1])
    measurements = np.vstack(y)[:, columns]
    # an output that is not measured now will not be measured then
    measurements[:, np.isnan(sample.measurements).all(axis=0)] = np.nan
    measurements[:, ~np.isfinite(sample.noise_sd)] = np.nan
    return replace(empty.part(0, used), measurements=np.ascontiguousarray(measurements)), np.array(
        starts
    )


#: Multiples of a fitted size at which an effect may imitate another: its trace changes its shape
#: with the size, and a fit would choose the size that imitates best.
_MULTIPLES = (1.0, 0.65, 1.5)
#: Rows of an effect whose size is not known.
_MOST_ROWS = 6
#: Squared length, in noise variances, below which a trace at a fitted size is nothing to compare.
_NOTHING = 1.0


def signatures(recording: FittedModel, candidates: Sequence[CandidateEffect]) -> Signatures:
    """Projected traces of some effects at their variants, in a recording made or predicted."""
    return project_traces(recording, effect_traces(recording, candidates))


def with_rows(candidate: CandidateEffect, values: Mapping[str, float]) -> CandidateEffect:
    """The candidate at its fitted sizes first, then about them; or at typical ones where unknown.

    ``values``: fitted values by name, ``<effect>.<size>``.
    """
    if not is_fitted(candidate, values):
        rows = candidate.variants
        indices = np.unique(np.linspace(0, len(rows) - 1, _MOST_ROWS).round().astype(int))
        return replace(candidate, variants=rows[indices])
    row = np.array([values[size.name] for size in candidate.free])
    lower = np.array([size.lower for size in candidate.free])
    upper = np.array([size.upper for size in candidate.free])
    # what vanishes at zero is scaled; a size that gives the shape stays as it was fitted
    is_scaled = np.array(
        [i == 0 or size.prior_mean == 0.0 for i, size in enumerate(candidate.free)]
    )
    every = [np.clip(np.where(is_scaled, row * by, row), lower, upper) for by in _MULTIPLES]
    return replace(candidate, variants=np.array(every))


def is_fitted(candidate: CandidateEffect, values: Mapping[str, float]) -> bool:
    """Whether a fit told all sizes of an effect."""
    return bool(candidate.free) and all(size.name in values for size in candidate.free)


def between(signs: Signatures, one: str, other: str, fitted_names: Sequence[str]) -> float:
    """Nats between two effects, the smaller of: one is true, or the other is.

    ``½ left (1 − cos²)``: what is left of the true one's trace when the other, its size free,
    imitates it as well as it can. The true one is taken at its fitted size, the first row, or at
    the median of those that are typical.
    """
    return min(
        _beyond(signs, one, other, one in fitted_names),
        _beyond(signs, other, one, other in fitted_names),
    )


def visibility(signs: Signatures, name: str, rows: Sequence[int] | None = None) -> float:
    """Nats by which an effect shows at the best of its rows (or of some of them)."""
    own_rows = signs.rows(name)
    if rows is not None:
        own_rows = own_rows[[row for row in rows if row < len(own_rows)]]
    return 0.5 * float(np.max(signs.projected_energy[own_rows])) if len(own_rows) else 0.0


def _beyond(signs: Signatures, true: str, imitator: str, at_fitted_size: bool) -> float:
    own, others = signs.rows(true), signs.rows(imitator)
    if not len(own):
        return 0.0
    # a trace cannot be turned round by its size: where it can, both signs are among the rows
    cosine = np.clip(signs.cosine[np.ix_(own, others)], 0.0, 1.0)
    alike = cosine.max(axis=1, initial=0.0)
    nats = 0.5 * signs.projected_energy[own] * (1 - alike**2)
    if at_fitted_size and signs.projected_energy[own[0]] > _NOTHING:
        return float(nats[0])
    return float(np.median(nats))
