"""The open-loop experiments that a diagnosis may advise: commands from rest, within bounds.

Each is a command that can be typed, as large as the simulated rig stays clear of its stops.
"""

import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from trms_cli.controllers.open_loop import OpenLoop
from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import TrmsError
from trms_cli.gap.diagnosis import OpenLoopExperiment
from trms_cli.identification.excitation.design import band_of, lead_in, linearise_model
from trms_cli.identification.excitation.excitation import ExcitationPlugin, Plan
from trms_cli.identification.excitation.multilevel import MultilevelExcitation
from trms_cli.identification.excitation.multisine import MultisineExcitation
from trms_cli.identification.excitation.prbs import PrbsExcitation
from trms_cli.models.beam_rig import ROTORS
from trms_cli.models.model import Model, names
from trms_cli.models.scales import longest_run, port_scale
from trms_cli.models.steady_state import SteadyState
from trms_cli.references.sawtooth import Sawtooth
from trms_cli.references.signal import ReferenceSignal
from trms_cli.references.square import Square
from trms_cli.simulation.rollout import Rollout

#: s, of the excitation, and of what leads to its operating point.
DURATION, LEAD_IN = 32.0, 8.0
#: Share of the inputs' limits that is used, and of the stops: ``trms excite`` takes 0.8 of both.
_OF_INPUTS, _OF_STOPS = 0.8, 0.72
#: Travels of an axis without a stop, rad on small benches; ``trms excite`` takes 1.5.
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
#: Played by ``trms run controller=open_loop``; by the first rotor of a beam and the other.
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
    if np.isfinite(longest_run(rollout.model)):
        return  # it falls over at any amplitude
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
        turned = {own.angle: axis for axis, own in self.model.axes.items()}
        self.angles = [name for name in self.model.controlled if name in outputs and name in turned]
        self._columns = [outputs.index(name) for name in self.angles]
        stops = np.array([float(self.model.stops.get(name, np.inf)) for name in self.angles])
        travels = np.array([port_scale(self.model, axis=turned[n]).travel for n in self.angles])
        self._stops = np.where(np.isfinite(stops), stops, 4 * np.pi * travels)
        self._bounds = np.where(np.isfinite(stops), _OF_STOPS * stops, _WITHOUT_STOP * travels)

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
        for i in reversed(range(len(room))):  # the axis of a beam's last rotor is the freer one
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
        if reverses and not model.rotors:
            continue
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
    for reverses in ((False, True) if model.rotors else (False,)) if rest else ():
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
    rotors = {own.input: rotor for rotor, own in model.rotors.items()}
    words = f"small random levels of the {f'{rotors[name]} rotor' if name in rotors else name}"
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
        """What is played at an amplitude (n_u,), (n, n_u), in the inputs' units."""
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
            command=command_line("excite", model_name, keys, self._sample_time),
            centre=self._centre,
            first=self.first,
        )


def _played_experiments(
    trial: _Trial, sample_time: float, model_name: str, kinds: Sequence[tuple[str, _Wave, _Wave]]
) -> Iterator[OpenLoopExperiment]:
    model = trial.model
    inputs = names(model.inputs)
    if not {field.name for field in fields(OpenLoop)}.issuperset(inputs):
        return  # controller=open_loop has no key for another input
    places = {own.input: i for i, own in enumerate(ROTORS.values())}
    samples = round((DURATION + LEAD_IN) / sample_time)
    time = np.arange(samples, dtype=np.float64) * sample_time
    upper = model.input_bounds()[1]
    for words, *both in kinds:
        waves = [both[places.get(name, 0)] for name in inputs]

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
            command=command_line("run", model_name, keys, sample_time),
            centre=np.zeros(len(inputs)),
            first=0,
        )


def command_line(command: str, model_name: str, keys: Sequence[str], sample_time: float) -> str:
    """What is typed; ``sample_time`` (s) where it is another than the usual one."""
    step = "sample_time" if command == "excite" else "sim.sample_time"
    words = ["trms", command, f"model={model_name}", *keys]
    if abs(sample_time - 0.02) > 1e-9:
        words.append(f"{step}={sample_time:.9g}")
    return " ".join(shlex.quote(word) for word in words)


def _round_amplitudes(amplitude: FloatArray) -> FloatArray:
    """As they are typed."""
    return np.array([float(f"{value:.3g}") for value in amplitude])
