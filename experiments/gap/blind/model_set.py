"""The sealed set of a model of one's own: rigs drawn from it, driven, recorded.

Parameters are drawn from their priors, effects from the library that is generated for the model,
nuisances for each rig. A model that comes to rest by itself is driven in open loop; one that does
not (an integrator, an unstable equilibrium) by a linear-quadratic regulator with a Kalman filter of
its linearisation, with the excitation on top. How large an effect is to be *weak*, *medium* or
*strong* is measured first, as for the TRMS (:mod:`.severity`): by what a refit leaves.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import islice
from time import perf_counter

import casadi as ca
import numpy as np
import numpy.typing as npt

from experiments.gap.blind.cases import Case
from experiments.gap.blind.model_rig import (
    AXIS_LAWS,
    INPUT_LAWS,
    OUTPUT_LAWS,
    OUTSIDE,
    ModelRigs,
    growing_size,
    law_of,
)
from experiments.gap.blind.recording import Recording, Timing
from experiments.gap.blind.refit import dataset_of, refit
from experiments.gap.blind.severity import LARGEST, LEVELS, NEAR, beyond, interpolate_levels
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import ExtendedModel
from trms_cli.effects.places import places_of
from trms_cli.models.model import Model, names
from trms_cli.models.scales import scales_of

FloatArray = npt.NDArray[np.float64]
Random = np.random.Generator

#: Kinds of cases, and how many of each in the whole set.
SHARES: Mapping[str, int] = {"null": 40, "single": 40, "pair": 8, "outside": 8}
#: In this order singles come: strong and medium ones are what the measures are about.
_LEVELS = ("medium", "strong", "medium", "medium", "weak")
_SCATTER, _SCATTERING = 1 / 3, 0.7  # prior standard deviations of rigs, and the share that has any
#: Steps of the sensors, as multiples of what they are said to be; coarser ones are an effect.
_QUANTA = (1.0, 1.0, 0.5, 0.25)
_WANDER = 0.03 / np.sqrt(2)  #: largest standard deviation of a drive's gain
_LINES = 24
_NEAR_STOP, _LESS, _TRIES = 0.95, 0.5, 4  #: share of the stops; less, and how often
_AMPLITUDE = 0.5
_NULLS, _MEASURED = 24, 40.0  #: rigs whose mean is the floor; s
_OTHER = 7919  #: between the seeds of a rig's first and second commands


@dataclass(frozen=True)
class RigSource:
    """What sets of a model are drawn from."""

    model: Model
    effects: Mapping[str, Effect]  #: the library that is generated for it
    noise_sd: Mapping[str, float] = field(default_factory=dict)  #: of the outputs, as declared
    quantum: Mapping[str, float] = field(default_factory=dict)  #: likewise

    def __post_init__(self) -> None:
        for kind, signals in (("input", self.model.inputs), ("output", self.model.outputs)):
            if not signals:
                raise ConfigurationError(
                    f"model {self.model.name} has no {kind}", where="model", remedy="add one"
                )

    @property
    def cases(self) -> int:
        """Number of cases, unless another is asked for."""
        return sum(SHARES.values())

    def plan(self, seed: int, cases: int | None, sample_time: float) -> list[Case]:
        """The cases, in an order that tells nothing; the sizes that they need are measured."""
        number = self.cases if cases is None else cases
        random = np.random.default_rng([seed, 88])
        draw = _Draw(self, measured_levels(self, seed, sample_time), random)
        planned: list[Case] = []
        for kind, count in _counts(number).items():
            planned += islice(draw.kinds[kind](), count)
        seeds = random.choice(2**31, size=len(planned), replace=False).tolist()
        planned = [replace(c, excitation=own) for c, own in zip(planned, seeds, strict=True)]
        return [planned[i] for i in random.permutation(len(planned))]

    def record(
        self,
        cases: Sequence[Case],
        timing: Timing,
        seed: int,
        *,
        fresh: bool = False,
        jobs: int = 1,
    ) -> tuple[list[Case], list[Recording]]:
        """Drive all rigs, those that come near a stop again with less.

        One that falls however little it is driven makes place for another: its kind's effects, of
        a rig that holds, with nuisances and an excitation of its own.

        Raises ConfigurationError if none of a kind holds.
        """
        driven, recordings = self.attempt(cases, timing, seed, fresh=fresh)
        random = np.random.default_rng([seed, 77])
        for _ in range(0 if fresh else _TRIES):
            lost = [i for i, recording in enumerate(recordings) if recording is None]
            if not lost:
                break
            others = [self._instead(driven, recordings, driven[i].kind, random) for i in lost]
            again, of_others = self.attempt(others, timing, seed, fresh=fresh)
            for i, case, recording in zip(lost, again, of_others, strict=True):
                driven[i], recordings[i] = case, recording
        held = [recording for recording in recordings if recording]
        if len(held) < len(cases):
            raise self._falls(len(cases) - len(held), len(cases))
        return driven, held

    def _instead(
        self,
        cases: Sequence[Case],
        recordings: Sequence[Recording | None],
        kind: str,
        random: Random,
    ) -> Case:
        holds = [c for c, r in zip(cases, recordings, strict=True) if r and c.kind == kind]
        if not holds:
            alike = [c for c in cases if c.kind == kind]
            raise self._falls(len(alike), len(cases))
        return replace(
            holds[int(random.integers(len(holds)))],
            excitation=int(random.integers(2**31)),
            nuisances=draw_nuisances(self, random),
        )

    def _falls(self, number: int, cases: int) -> ConfigurationError:
        return ConfigurationError(
            f"{number} of {cases} rigs reach a stop, or fall, however little they are driven",
            where="model",
            remedy="give the model an equilibrium at rest() that a linear law holds; or "
            "another seed",
        )

    def attempt(
        self, cases: Sequence[Case], timing: Timing, seed: int, *, fresh: bool = False
    ) -> tuple[list[Case], list[Recording | None]]:
        """The same; None in place of what cannot be held."""
        cases = [replace(case, duration=timing.of(case)) for case in cases]
        driven: list[Case] = list(cases)
        recordings: list[Recording | None] = [None] * len(cases)
        waiting = list(range(len(cases)))
        for number in range(_TRIES):
            some = [driven[i] for i in waiting]
            runs = self._run(some, timing.sample_time, [seed, number, int(fresh)])
            again = []
            for i, recording in zip(waiting, runs, strict=True):
                recordings[i] = recording
                if recording is None:
                    again.append(i)
                    driven[i] = replace(driven[i], amplitude=_LESS * driven[i].amplitude)
            waiting = again
            if not waiting:
                break
        return driven, recordings

    def csv_of(self, case: Case, recording: Recording) -> str:
        """A recording as any lab would write it."""
        signals = (*self.model.inputs, *self.model.outputs)
        loop = "open" if self.stays else "closed"
        head = ",".join(["t[s]", *(f"{s.name}[{s.unit}]" for s in signals)])
        rows = np.column_stack([recording.commands, recording.measured])
        lines = [f"# rig: {self.model.name}", f"# loop: {loop}", head]
        lines += [
            ",".join([f"{t:.4f}", *(f"{value:.9g}" for value in row)])
            for t, row in zip(recording.time, rows, strict=True)
        ]
        return "\n".join(lines) + "\n"

    @property
    def stays(self) -> bool:
        """Whether the model comes to rest by itself."""
        return bool(self.poles.real.max(initial=-1.0) < -1e-3 / scales_of(self.model).time)

    @property
    def poles(self) -> npt.NDArray[np.complex128]:
        """Of the linearisation at rest, 1/s."""
        poles = np.linalg.eigvals(_linearised(self.model)[0]).astype(np.complex128)
        return poles

    @property
    def window(self) -> float:
        """s, of the free runs that a refit is judged by: short where they run away."""
        fastest = float(self.poles.real.max(initial=0.0))
        return float(np.clip(3 / fastest, 0.2, 10.0)) if fastest > 1e-3 else 10.0

    def _run(
        self, cases: Sequence[Case], sample_time: float, seed: list[int]
    ) -> list[Recording | None]:
        """Each rig's recording; None where it reached a stop or left all bounds."""
        samples = [round(case.duration / sample_time) for case in cases]
        longest = max(samples)
        rigs = ModelRigs(
            self.model,
            np.array([self.values(case) for case in cases]),
            _sizes(cases),
            _nuisances(cases),
            sample_time,
            seed,
        )
        drive = _Driver(self, cases, longest, sample_time, fresh=bool(seed[-1]))
        commands = np.empty((len(cases), longest, self.model.n_u))
        measured = np.empty((len(cases), longest, self.model.n_y))
        far = np.zeros(len(cases), dtype=int) + longest  # sample at which a rig left its bounds
        with np.errstate(all="ignore"):
            for k in range(longest):
                measured[:, k] = rigs.measure()
                commands[:, k] = drive.command(k, measured[:, k])
                rigs.advance(commands[:, k])
                outside = ~np.isfinite(rigs.x).all(axis=0)
                for name, limit in self._reaches.items():
                    row = self.model.state_index(name)
                    outside |= np.abs(rigs.x[row]) > _NEAR_STOP * limit
                far = np.minimum(far, np.where(outside, k, longest))
                rigs.x[:, far < longest] = self.model.rest()[:, None]
        time = sample_time * np.arange(longest, dtype=np.float64)
        return [
            Recording(time[:n], commands[i, :n], measured[i, :n]) if far[i] >= n else None
            for i, n in enumerate(samples)
        ]

    @property
    def _reaches(self) -> dict[str, float]:
        """What no rig may reach: its stops, and half a radian where an angle falls without one."""
        reaches = dict(self.model.stops)
        if self.poles.real.max(initial=0.0) > 1e-3:
            for state in self.model.states:
                if state.unit == "rad":
                    reaches.setdefault(state.name, 0.6)
        return reaches

    def values(self, case: Case) -> FloatArray:
        """The rig's own parameters, (n_p,)."""
        values = [
            p.value * (1 + (p.prior_sd or 0.0) * case.parameters.get(p.name, 0.0))
            for p in self.model.parameters
        ]
        lower = [p.lower for p in self.model.parameters]
        upper = [p.upper for p in self.model.parameters]
        return np.clip(values, lower, upper)

    def least_noise(self) -> dict[str, float]:
        """What each sensor adds at least, in its unit: never nothing."""
        travels = scales_of(self.model).travels
        return {
            name: float(
                np.hypot(self.noise_sd.get(name, 0.0), self.quantum.get(name, 0.0) / np.sqrt(12))
            )
            or 1e-5 * travels[name]
            for name in names(self.model.outputs)
        }

    def sized(self, effect: str, factor: float) -> dict[str, float]:
        """Sizes of an effect at a factor of what is typical."""
        grows = growing_size(effect)
        if effect not in self.effects:
            return {grows: factor * self._outside_size(effect)}
        own = self.effects[effect]
        sizes = {q.name: q.value for q in own.parameters()}
        for entry in fields(own):  # type: ignore[arg-type]
            value = getattr(own, entry.name, None)
            if entry.name != "rig_scale" and isinstance(value, int | float):
                sizes.setdefault(entry.name, float(value))
        sizes[grows] *= factor
        return {name: float(f"{value:.5g}") for name, value in sizes.items()}

    def _outside_size(self, effect: str) -> float:
        law = law_of(effect)
        port = effect.removesuffix(f"_{law}")
        scales = scales_of(self.model)
        if law == "early_limit":
            return 0.5
        if law == "eccentricity":
            return 0.01 * scales.travels[port]
        force = 0.05 * scales.forces[port]
        return force if law == "one_sided_friction" else force * scales.time / scales.travels[port]

    def either_sign(self, effect: str) -> bool:
        """Whether the size that grows may be negative as well."""
        sizes = self.effects[effect].parameters() if effect in self.effects else ()
        typical = [size.typical for size in sizes if size.name == growing_size(effect)]
        return any(ends is not None and ends[0] < 0 for ends in typical)

    def locations(self, effect: str) -> tuple[str, ...]:
        """Where a diagnosis should find it."""
        if effect not in self.effects:
            port = effect.removesuffix(f"_{law_of(effect)}")
            if port in self.model.axes:
                return (self.model.axes[port].moment,)
            return (f"{port}_actuator",) if port in names(self.model.inputs) else ()
        return places_of(ExtendedModel(self.model, effect, self.effects[effect]))

    def inside(self) -> tuple[str, ...]:
        """Effects of the library that the rigs have a law for."""
        inputs, outputs = names(self.model.inputs), names(self.model.outputs)
        own = [f"{i}_{law}" for i in inputs for law in INPUT_LAWS]
        own += [f"{a}_{law}" for a in self.model.axes for law in AXIS_LAWS]
        own += [f"{o}_{law}" for o in outputs for law in OUTPUT_LAWS]
        return tuple(effect for effect in own if effect in self.effects)

    def outside(self) -> tuple[str, ...]:
        """Effects that no library has."""
        ports = (names(self.model.inputs), tuple(self.model.axes), names(self.model.outputs))
        return tuple(
            f"{port}_{law}"
            for laws, names_of in zip(OUTSIDE, ports, strict=True)
            for law in laws
            for port in names_of
        )


def measured_levels(
    source: RigSource, seed: int, sample_time: float
) -> dict[str, dict[str, dict[str, float]]]:
    """``{effect: {level: {"factor", "ratio"}}}``, by what a refit leaves of rigs that have it."""
    begin = perf_counter()
    effects = (*source.inside(), *source.outside())
    points: dict[str, list[tuple[float, float]]] = {effect: [] for effect in effects}
    factors: dict[str, list[float]] = {effect: [0.3, 1.0, LARGEST] for effect in effects}
    for _ in range(2):
        trials = [(effect, f) for effect in effects for f in factors[effect]]
        for (effect, factor), ratio in zip(
            trials, _ratios(source, trials, seed, sample_time), strict=True
        ):
            if ratio is not None:
                points[effect].append((factor, ratio))
        levels = {e: _levels(points[e]) for e in effects if points[e]}
        largest = {e: max(f for f, _ in points[e]) for e in levels}  # that can be held
        factors = {
            e: sorted({min(lv["factor"], largest[e]) for lv in levels.get(e, {}).values()})
            for e in effects
        }
    reached = {
        effect: {
            level: values
            for level, values in by_level.items()
            if beyond(values["ratio"]) > NEAR * beyond(LEVELS[level])
            and values["factor"] <= 1.05 * largest[effect]
        }
        for effect, by_level in levels.items()
    }
    sys.stderr.write(f"sizes of {len(effects)} effects measured: {perf_counter() - begin:.0f} s\n")
    return {effect: by_level for effect, by_level in reached.items() if by_level}


def _levels(points: Sequence[tuple[float, float]]) -> dict[str, dict[str, float]]:
    return interpolate_levels(np.array([f for f, _ in points]), np.array([r for _, r in points]))


def _ratios(
    source: RigSource, trials: Sequence[tuple[str, float]], seed: int, sample_time: float
) -> list[float | None]:
    """Gap over floor of each (effect, factor); None where the rig cannot be held."""
    random = np.random.default_rng([seed, 99])
    plain = Case(kind="null", duration=_MEASURED, amplitude=_AMPLITUDE, excitation=seed)
    drawn = [draw_nuisances(source, random) for _ in range(_NULLS)]
    errors = _refitted(source, [replace(plain, nuisances=n) for n in drawn], seed, sample_time)
    nulls = [
        (rms, nuisances) for rms, nuisances in zip(errors, drawn, strict=True) if rms is not None
    ]
    if not nulls:
        raise ConfigurationError(
            f"{source.model.name} cannot be held at rest by a linear law",
            where="model",
            remedy="give it an equilibrium at rest() that can be held, or stops that are farther",
        )
    floor = np.sqrt(np.mean([rms**2 for rms, _ in nulls], axis=0))
    # an effect is measured on the rig in the middle: one that wanders much has a gap without any
    ratios = [float(np.sqrt(np.mean((rms / floor) ** 2))) for rms, _ in nulls]
    _, usual = nulls[int(np.argsort(ratios)[len(ratios) // 2])]
    cases = [replace(plain, effects={e: source.sized(e, f)}, nuisances=usual) for e, f in trials]
    gaps = _refitted(source, cases, seed, sample_time)
    return [None if r is None else float(np.sqrt(np.mean((r / floor) ** 2))) for r in gaps]


def _refitted(
    source: RigSource, cases: Sequence[Case], seed: int, sample_time: float
) -> list[FloatArray | None]:
    """What a refit leaves of each rig, by output (n_y,); None where the rig cannot be held."""
    _, recordings = source.attempt(cases, Timing(sample_time=sample_time), seed)
    noise = source.least_noise()
    rms: list[FloatArray | None] = []
    for recording in recordings:
        if recording is None:
            rms.append(None)
            continue
        data = dataset_of(
            source.model, recording.time, recording.commands, recording.measured, noise_sd=noise
        )
        rms.append(refit(source.model, data, source.window).rms)
    return rms


def draw_nuisances(source: RigSource, random: Random) -> dict[str, float]:
    """Sensors, sampling, drives and forms of laws of one rig."""

    def octaves(low: float, high: float) -> float:
        return float(np.exp(random.uniform(np.log(low), np.log(high))))

    drawn = {
        "jitter": octaves(2e-6, 8e-5),  # sampled by a card
        "drift": float(random.uniform(0.0, _WANDER)),
        "drift_time": octaves(10.0, 100.0) if random.uniform() < 0.5 else 0.0,
        "stick": float(random.uniform(0.0, 0.12)),
        "slip_spread": float(random.uniform(0.7, 1.3)),
        "exponent": float(random.uniform(1.85, 2.15)),
    }
    travels = scales_of(source.model).travels
    for name in names(source.model.outputs):
        quantum = source.quantum.get(name, 0.0)
        noise = source.noise_sd.get(name, 0.0)
        white = float(random.uniform(0, 0.3 * quantum)) if random.uniform() < 0.5 else 0.0
        drawn[f"{name}_quantum"] = quantum * float(random.choice(_QUANTA))
        drawn[f"{name}_noise"] = noise * octaves(0.5, 3.0) + white
        drawn[f"{name}_bias"] = float(random.uniform(-0.5, 0.5)) * quantum
    for axis in source.model.axes:
        drawn[f"{axis}_bend"] = travels[axis] * octaves(1e-5, 1e-4)
    return {name: float(f"{value:.4g}") for name, value in drawn.items()}


class _Draw:
    """Endless cases of each kind."""

    def __init__(
        self,
        source: RigSource,
        levels: Mapping[str, Mapping[str, Mapping[str, float]]],
        random: Random,
    ) -> None:
        self._source, self._levels, self._random = source, levels, random
        self._priors = [p.name for p in source.model.parameters if p.prior_sd]
        self.kinds: Mapping[str, Callable[[], Iterator[Case]]] = {
            "null": self._nulls,
            "single": self._singles,
            "pair": self._pairs,
            "outside": self._outsides,
        }

    def _nulls(self) -> Iterator[Case]:
        while True:
            yield self._case("null", {})

    def _singles(self) -> Iterator[Case]:
        for effect, level in self._effects(self._source.inside(), weak=True):
            yield self._case("single", {effect: level}, group=(effect,))

    def _outsides(self) -> Iterator[Case]:
        for effect, level in self._effects(self._source.outside(), weak=False):
            yield self._case("outside", {effect: level})

    def _pairs(self) -> Iterator[Case]:
        effects = self._effects(self._source.inside(), weak=False)
        while True:
            first, level = next(effects)
            for other, of_other in islice(effects, 40):
                if not {*self._source.locations(first)} & {*self._source.locations(other)}:
                    levels = {first: level, other: of_other}
                    yield self._case("pair", levels, group=tuple(levels))
                    break
            else:
                raise ConfigurationError(
                    "no two effects act at different places", where="model", remedy="cases=40"
                )

    def _effects(self, library: Sequence[str], *, weak: bool) -> Iterator[tuple[str, str]]:
        """Effects in rounds of random order, each with a level that it reaches."""
        there = [e for e in library if {"medium", "strong"} & {*self._levels.get(e, ())}]
        if not there:
            raise ConfigurationError(
                "no effect leaves a gap of twice the floor", where="model", remedy="excite it more"
            )
        turn = int(self._random.integers(len(_LEVELS)))
        while True:
            for i in self._random.permutation(len(there)):
                levels = [lv for lv in self._levels[there[i]] if weak or lv != "weak"]
                turn += 1
                wanted = _LEVELS[turn % len(_LEVELS)]
                yield there[i], wanted if wanted in levels else levels[-1]

    def _case(self, kind: str, levels: Mapping[str, str], group: tuple[str, ...] = ()) -> Case:
        random, source = self._random, self._source
        effects = {}
        for effect, level in levels.items():
            factor = self._levels[effect][level]["factor"] * random.uniform(0.9, 1.1)
            if source.either_sign(effect):
                factor *= random.choice([-1.0, 1.0])
            effects[effect] = source.sized(effect, float(factor))
        away = np.zeros(len(self._priors))
        if levels and random.uniform() < _SCATTERING:
            away = (_SCATTER * random.standard_normal(len(self._priors))).round(4)
        short = random.uniform() < 0.1
        return Case(
            kind=kind,  # type: ignore[arg-type]
            effects=effects,
            severity=dict(levels),
            parameters=dict(zip(self._priors, away.tolist(), strict=True)),
            locations=tuple(dict.fromkeys(at for e in levels for at in source.locations(e))),
            group=group,
            amplitude=_AMPLITUDE,
            duration=float(random.integers(*((20, 41) if short else (60, 121)))),
            nuisances=draw_nuisances(source, random),
        )


class _Driver:
    """Sines on the inputs, and where the model does not stay by itself a regulator beneath."""

    def __init__(
        self,
        source: RigSource,
        cases: Sequence[Case],
        samples: int,
        sample_time: float,
        *,
        fresh: bool,
    ) -> None:
        model = source.model
        self._limits = model.input_bounds()[1]
        self._law = None if source.stays else _Regulator(source, len(cases), sample_time)
        share = 0.5 if self._law is None else 0.25
        poles = np.abs(source.poles)
        poles = poles[poles > 1e-3]
        low = poles.min(initial=1.0) / (2 * np.pi) / 5
        high = min(poles.max(initial=1.0) / (2 * np.pi) * 5, 0.1 / sample_time)
        time = sample_time * np.arange(samples)
        self._dither = np.empty((len(cases), samples, model.n_u))
        self._levels = np.zeros((len(cases), samples))
        hold = np.array([1.0, 5.0]) * max(scales_of(model).time * 3, 5 * sample_time)
        for i, case in enumerate(cases):
            random = np.random.default_rng(case.excitation + _OTHER * fresh)
            for j, limit in enumerate(self._limits):
                lines = np.exp(random.uniform(np.log(low), np.log(high), _LINES))
                phases = random.uniform(0, 2 * np.pi, _LINES)
                tones = np.sin(2 * np.pi * np.outer(time, lines) + phases).sum(axis=1)
                wave = share * tones / np.sqrt(_LINES / 2)
                if self._law is None:
                    wave = wave + share * _held(random, samples, sample_time, hold)
                self._dither[i, :, j] = case.amplitude * limit * wave
            self._levels[i] = case.amplitude * _held(random, samples, sample_time, hold)

    def command(self, k: int, measured: FloatArray) -> FloatArray:
        """The commands from a sample on, (n, n_u)."""
        u = self._dither[:, k]
        if self._law is not None:
            u = u + self._law.command(measured, self._levels[:, k])
        u = np.clip(u, -self._limits, self._limits)
        if self._law is not None:
            self._law.advance(u)
        return u


class _Regulator:
    """LQR on a Kalman filter's estimate, both of the linearised model, for n rigs at once."""

    def __init__(self, source: RigSource, rigs: int, sample_time: float) -> None:
        from scipy.linalg import expm, solve_discrete_are

        model = source.model
        A, B, C = _linearised(model)
        both = np.zeros((model.n_x + model.n_u,) * 2)
        both[: model.n_x] = sample_time * np.hstack([A, B])
        step = expm(both)[: model.n_x]
        self._A, self._B, self._C = step[:, : model.n_x], step[:, model.n_x :], C
        scales = scales_of(model)
        travel = np.array([scales.travels[name] for name in names(model.outputs)])
        limits = model.input_bounds()[1]
        small = 1e-9 * np.eye(model.n_x)
        wanted = C.T @ np.diag((0.5 * travel) ** -2) @ C + small
        noise = np.array([source.least_noise()[name] for name in names(model.outputs)])
        try:
            P = solve_discrete_are(self._A, self._B, wanted, np.diag((0.2 * limits) ** -2))
            pushed = self._B @ np.diag((0.2 * limits) ** 2) @ self._B.T + 1e-9 * np.eye(model.n_x)
            S = solve_discrete_are(self._A.T, C.T, pushed, np.diag(noise**2))
        except (np.linalg.LinAlgError, ValueError) as error:
            raise ConfigurationError(
                f"no linear law holds {model.name} at rest from its outputs: {error}",
                where="model",
                remedy="measure more, or give it an equilibrium at rest() that can be held",
            ) from error
        weight = np.diag((0.2 * limits) ** -2) + self._B.T @ P @ self._B
        self._K = np.linalg.solve(weight, self._B.T @ P @ self._A)
        self._L = S @ C.T @ np.linalg.inv(C @ S @ C.T + np.diag(noise**2))
        self._rest = model.rest()
        self._y = np.array(model_reading(model, self._rest))
        self._x = np.zeros((rigs, model.n_x))
        self._goal = np.zeros(model.n_x)
        self._reach = 0.0
        if model.controlled:  # held levels of the first controlled state
            name = model.controlled[0]
            self._goal[model.state_index(name)] = 1.0
            self._reach = 0.4 * model.stops.get(name, scales.travels.get(name, 0.0))

    def command(self, measured: FloatArray, level: FloatArray) -> FloatArray:
        """About zero; ``level``: of the first controlled state, in [−1, 1]."""
        self._x = self._x + (measured - self._y - self._x @ self._C.T) @ self._L.T
        goal = self._reach * level[:, None] * self._goal
        law: FloatArray = (goal - self._x) @ self._K.T
        return law

    def advance(self, command: FloatArray) -> None:
        """What the model makes of a command until the next sample."""
        self._x = self._x @ self._A.T + command @ self._B.T


def model_reading(model: Model, x: FloatArray) -> FloatArray:
    """What the sensors read in a state without command, (n_y,)."""
    s, u, p, _ = model.symbols()
    read = ca.Function("read", [s, u, p], [model.measurement(s, u, p)])
    reading: FloatArray = np.array(read(x, np.zeros(model.n_u), model.parameters.values)).ravel()
    return reading


def _linearised(model: Model) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``A``, ``B``, ``C`` at rest without command."""
    x, u, p, w = model.symbols()
    f, y = model.dynamics(x, u, p, w), model.measurement(x, u, p)
    slopes = ca.Function(
        "slopes", [x, u, p, w], [ca.jacobian(f, x), ca.jacobian(f, u), ca.jacobian(y, x)]
    )
    at = slopes(model.rest(), np.zeros(model.n_u), model.parameters.values, np.zeros(model.n_w))
    A, B, C = (np.array(slope) for slope in at)
    return A, B, C


def _held(random: Random, samples: int, sample_time: float, hold: FloatArray) -> FloatArray:
    """Levels in [−1, 1], each held for a while."""
    values = np.empty(samples)
    at = 0
    while at < samples:
        length = max(round(random.uniform(*hold) / sample_time), 1)
        values[at : at + length] = random.uniform(-1, 1)
        at += length
    return values


def _counts(number: int) -> dict[str, int]:
    """Whole numbers that add up."""
    whole = sum(SHARES.values())
    counts = {kind: int(share * number / whole) for kind, share in SHARES.items()}
    for kind in sorted(SHARES, key=lambda k: counts[k] - SHARES[k] * number / whole):
        if sum(counts.values()) < number:
            counts[kind] += 1
    return counts


def _sizes(cases: Sequence[Case]) -> dict[str, FloatArray]:
    sizes: dict[str, FloatArray] = {}
    for i, case in enumerate(cases):
        for effect, own in case.effects.items():
            for name, value in own.items():
                sizes.setdefault(f"{effect}.{name}", np.zeros(len(cases)))[i] = value
    return sizes


def _nuisances(cases: Sequence[Case]) -> dict[str, FloatArray]:
    keys = dict.fromkeys(name for case in cases for name in case.nuisances)
    usual = {"slip_spread": 1.0, "exponent": 2.0}
    return {k: np.array([c.nuisances.get(k, usual.get(k, 0.0)) for c in cases]) for k in keys}
