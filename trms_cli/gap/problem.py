"""What is to be diagnosed: a model, recordings of one rig, and effects as candidate causes.

With a candidate stands what is believed of its sizes beforehand.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.core.wording import listing, number
from trms_cli.effects.dropout import Dropout
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import ExtendedModel, effect_names, extend_model
from trms_cli.effects.places import places_of
from trms_cli.effects.quantisation import Quantisation
from trms_cli.gap.belief import Calibration
from trms_cli.gap.diagnosis import DiagnosedRecording, SizeEstimate
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.problem import FreeParameter
from trms_cli.models.model import Model, names
from trms_cli.models.parameters import Parameter
from trms_cli.models.rig_parts import TRAVELS, parts_of
from trms_cli.models.scales import longest_run, scales_of
from trms_cli.plants.sensors import noise_estimate

Effort = Literal["quick", "normal", "thorough"]

#: s. Lengths of the free runs that the gap is told at; of a model that falls over those within
#: which it still does not run away from a start that is estimated.
HORIZONS = (0.1, 0.5, 2.0, 10.0)


def horizons_of(model: Model) -> tuple[float, ...]:
    """s, those of :data:`HORIZONS` that free runs of a model last, the shortest at least."""
    longest = longest_run(model)
    return tuple(h for h in HORIZONS if h <= longest) or HORIZONS[:1]


@dataclass(frozen=True, kw_only=True)
class GapProblem:
    """A model, recordings of one rig, candidates."""

    model: Model  #: The nominal model, with the effects that it has already
    model_name: str  #: As the user named it
    #: Whole recordings with one sample time; they measure some or all of the model's outputs
    datasets: tuple[Dataset, ...]
    candidates: Mapping[str, Effect]  #: Effects that may be the cause, at their typical sizes
    #: Recordings of the rig in a known state, with which the others are compared
    against: tuple[Dataset, ...] = ()
    block: Annotated[float, Meta(gt=0)] = 10.0  #: s, of the blocks that are fitted and compared
    #: Share of the recordings that nothing is fitted to and the shrink is measured on
    sealed_share: Annotated[float, Meta(gt=0, lt=1)] = 0.25
    effort: Effort = "normal"
    seed: Annotated[int, Meta(ge=0)] = 0
    jobs: Annotated[int, Meta(ge=1)] = 2
    advise: bool = True  #: Whether the next experiment is looked for
    #: Whether the recordings are experiments each of which was made for what the ones before left
    #: open: all of them are fitted, and the end of each is sealed
    investigates: bool = False
    calibration: Calibration | None = None  #: Of the belief; None: the package's
    quanta: Mapping[str, float] = field(default_factory=dict)  #: Of outputs, as declared
    #: Sizes of what readings alone show, by name of the effect and size, see ``sensor_marks.py``
    marks: Mapping[str, tuple[str, SizeEstimate]] = field(default_factory=dict)
    warnings: tuple[str, ...] = field(default=())  #: Of the admission, to stand in the report


def diagnosed_recordings(datasets: Sequence[Dataset]) -> tuple[DiagnosedRecording, ...]:
    """Recordings as their diagnosis names them."""
    return tuple(
        DiagnosedRecording(
            file=dataset.source,
            sha256=dataset.sha256,
            duration_s=dataset.duration,
            sample_time_s=dataset.sample_time,
            channels=(*names(dataset.inputs), *names(dataset.outputs)),
        )
        for dataset in datasets
    )


#: s. Recordings that are sampled faster are thinned: no effect of the library needs more, and a
#: filter's cost goes with the number of samples.
_FINEST = 0.0095
#: So many samples a search affords where a finer step says more.
_MOST_SAMPLES = 6000
#: s. A sealed part shorter than this cannot show a free run of ten seconds.
_LEAST_SEALED = 12.0
#: From so many recordings on, whole ones are sealed.
_SEVERAL = 3
#: No sensor is believed closer than this share of its channel's motion (standard deviation).
_PRECISION = 2e-4
#: Ripple below so many times a step's own share is that share.
_RIPPLE = 1.4
#: Blocks that must be left to fit: fewer cannot be compared in pairs.
_FEWEST_BLOCKS = 4


#: rad. An axis that stays within so much for most of the time is held at one point; of another rig
#: than small benches, a share of its travel.
_ONE_POINT, _OF_TRAVEL, _MOST_OF_THE_TIME = 0.1, 0.02, 0.7


def recorded_values(datasets: Sequence[Dataset], name: str) -> FloatArray:
    """All that recordings have measured of an output, (k,), finite."""
    measuring = [d for d in datasets if name in names(d.outputs)]
    values = np.concatenate([np.zeros(0), *(d.output(name) for d in measuring)])
    return values[np.isfinite(values)]


def mean_tilt(model: Model, datasets: Sequence[Dataset]) -> float:
    """rad, angle of the beam about which recordings were made; zero where none has it."""
    parts = parts_of(model)
    angle = parts.axes[parts.beam].angle if parts.beam else ""
    tilts = [v.mean() for v in (recorded_values([d], angle) for d in datasets) if len(v)]
    return float(np.mean(tilts)) if tilts else 0.0


def poor_excitation(model: Model, datasets: Sequence[Dataset]) -> tuple[str, ...]:
    """What recordings cannot tell, by how little the axes move."""
    still_axes: dict[str, str] = {}
    parts = parts_of(model)
    for name, axis in model.axes.items():
        angle = recorded_values(datasets, axis.angle)
        if not len(angle):
            continue
        middle = float(np.median(angle))
        is_bench = model.bench_sizes or model.sample_time is not None
        reach = _ONE_POINT if is_bench else _OF_TRAVEL * scales_of(model).travels[name]
        near = float(np.mean(np.abs(angle - middle) < reach / 2))
        if near > _MOST_OF_THE_TIME:
            unit = parts.unit(name)
            still_axes[name] = f"{number(middle, 2)} {unit} for {100 * near:.0f} % of the time"
    if not still_axes:
        return ()
    are = "is held at one point" if len(still_axes) == 1 else "are each held at one point"
    moments = {s.name: s.unit for s in model.disturbances}
    are_turned = all(moments.get(model.axes[n].moment, "N*m") == "N*m" for n in still_axes)
    return (
        f"{listing(list(still_axes))} {are} ({', '.join(still_axes.values())}): a "
        f"{'torque' if are_turned else 'force'} on such an axis shows with its place, sign and "
        "size, and whether the axis sticks or slides; what makes it (a weight, a pull, a "
        "parameter) does not",
    )


@dataclass(frozen=True)
class Parts:
    """Recordings, divided."""

    fitted: tuple[Dataset, ...]  #: Everything is fitted, chosen and compared on them by blocks
    whole: tuple[Dataset, ...]  #: As they were given, thinned
    #: tuple of (recording, first, last); spans of ``whole`` that are opened once
    sealed: tuple[tuple[int, int, int], ...]
    block: float  #: s


def divide(
    datasets: Sequence[Dataset],
    block: float,
    share: float,
    stops: Mapping[str, float],
    most: float = np.inf,
    *,
    of_each: bool = False,
    finest: float = _FINEST,
) -> Parts:
    """Seal the end of each recording, or the last recordings where there are several.

    ``block``: s; shortened for short recordings. ``share``: of the time, to be sealed. ``stops``:
    mechanical range of angles, rad: from a contact with a stop to the end of its block nothing is
    compared, for no model of free motion follows there. ``most``: s, fitted of what is not sealed,
    the newest. ``of_each``: seal the end of each also of several, for the last ones say what the
    others do not. ``finest``: s, steps below which a recording is thinned. Raises
    ConfigurationError if hardly anything would be left.
    """
    whole = tuple(dataset.thinned(finest) for dataset in datasets)
    total = sum(dataset.duration for dataset in whole)
    if len(whole) >= _SEVERAL and not of_each:
        whole = tuple(with_noise(dataset) for dataset in whole)
        count = min(max(1, round(share * len(whole))), len(whole) - 1)
        fitted_count = len(whole) - count
        fitted = whole[:fitted_count]
        sealed = tuple((i, 0, len(whole[i])) for i in range(fitted_count, len(whole)))
    else:
        parts, spans = [], []
        for i, dataset in enumerate(whole):
            length = max(share * dataset.duration, min(_LEAST_SEALED, dataset.duration / 3))
            cut = round((dataset.duration - length) / dataset.sample_time)
            parts.append(with_noise(dataset.part(0, cut)))
            spans.append((i, cut, len(dataset)))
        fitted, sealed = tuple(parts), tuple(spans)
        # what is sealed has no say in the noise either
        whole = tuple(
            replace(dataset, noise_sd=part.noise_sd)
            for dataset, part in zip(whole, fitted, strict=True)
        )
    fitted = _newest(fitted, most)
    fitted_duration = sum(dataset.duration for dataset in fitted)
    block = min(block, fitted_duration / _FEWEST_BLOCKS)
    if fitted_duration / _FEWEST_BLOCKS < 2.0:
        raise ConfigurationError(
            f"{total:.3g} s of recording are too short to fit, compare and seal",
            where="real",
            remedy="record at least 20 s, better 120 s; or give several recordings of the rig",
        )
    fitted, whole = (
        tuple(dataset.without_contacts(block, stops) for dataset in datasets)
        for datasets in (fitted, whole)
    )
    return Parts(fitted, whole, sealed, block)


def _newest(datasets: Sequence[Dataset], most: float) -> tuple[Dataset, ...]:
    """The end of recordings, so many seconds in all."""
    parts: list[Dataset] = []
    for dataset in reversed(datasets):
        remaining_time = most - sum(len(other) * other.sample_time for other in parts)
        samples = min(len(dataset), remaining_time / dataset.sample_time)
        if samples < 1:
            break
        parts.insert(0, dataset.part(len(dataset) - round(samples), len(dataset)))
    return tuple(parts)


def comparable_datasets(problem: GapProblem, datasets: Sequence[Dataset]) -> list[Dataset]:
    """Recordings as they are compared with a known state."""
    stops = problem.model.stops
    return [with_noise(d).thinned(_FINEST).without_contacts(problem.block, stops) for d in datasets]


def with_noise(dataset: Dataset) -> Dataset:
    """The recording with its noise: read from its steps and its ripple, else as declared.

    A precise sensor is believed only so far as its share of the motion: nothing that is fitted to
    the whole motion follows it more closely, and a search for what does ends anywhere.
    """
    channels = zip(dataset.measurements.T, dataset.outputs, strict=True)
    quanta = np.array([quantum_of(column, signal.unit) for column, signal in channels])
    ripple, rounding = noise_estimate(dataset.measurements), quanta / np.sqrt(12)
    # what a step makes of a moving angle is not quite white, and looks like a little more of it
    estimate = np.where(ripple < _RIPPLE * rounding, rounding, np.maximum(ripple, rounding))
    motion = np.ma.masked_invalid(dataset.measurements).std(axis=0).filled(0.0)
    noise = np.where(estimate > 0, estimate, dataset.noise_sd)
    return replace(dataset, noise_sd=np.maximum(noise, np.maximum(_PRECISION * motion, 1e-9)))


#: rad. Step of a usual encoder: rounding that is finer, as of a file's digits, matters to nobody.
_USUAL_QUANTUM = 2 * np.pi / 4096
#: Steps so many times others are coarser ones.
_COARSER = 1.5


def is_coarser(quantum: float, other: float, travel: float = 1.0) -> bool:
    """Whether a sensor's steps are coarser than others, and than those of a usual encoder.

    ``travel``: of the channel, over that of a small bench's angle, 1 rad.
    """
    return quantum > _COARSER * max(_USUAL_QUANTUM * travel, other)


def quantum_of(values: FloatArray, unit: str = "rad") -> float:
    """Step of a sensor: the smallest that is common between its values; 0 if they are smooth."""
    values = values[np.isfinite(values)]
    # digits are counted from one radian, or from the power of ten of what is no angle
    size = 1.0
    if not unit.startswith("rad") and np.ptp(values):
        size = float(10.0 ** np.ceil(np.log10(np.ptp(values))))
    levels = np.unique(np.round(values / size, 9))
    steps = np.diff(levels)
    # a recording has few digits, so that a step is met a little too small or too large
    steps = steps[steps > 1e-6]
    if len(steps) < 5:
        return 0.0
    quantum = float(np.quantile(steps, 0.1))
    near = steps[steps < 1.5 * quantum]
    quantum = float(np.mean(near))
    whole = np.abs(steps / quantum - np.round(steps / quantum)) < 0.1
    return quantum * size if whole.mean() > 0.9 else 0.0


def finest_step(model: Model, datasets: Sequence[Dataset]) -> float:
    """s, sampling steps below which recordings are thinned: as fine as a search can afford.

    A rig whose dry friction is a good part of all forces sticks and slides within a few ms; on
    small benches nothing happens so fast.
    """
    if model.bench_sizes or model.sample_time is not None:
        return _FINEST
    return min(_FINEST, sum(dataset.duration for dataset in datasets) / _MOST_SAMPLES)


#: Multiples of the typical range's geometric middle at which an effect is tried.
_MULTIPLES = (0.3, 1.0, 3.0)
#: How far beyond its typical range a size may lie that gives an effect its shape, a factor.
_BEYOND = 2.0
#: A typical range that reaches to zero or to both sides is taken to span this factor.
_DECADE = 10.0
#: Where in their typical range, on a logarithmic scale, shapes are tried to which no slope leads.
_SPREAD_SHAPES = {
    "width": (0.15, 0.5, 0.85),
    "frequency": tuple(np.linspace(0.0, 1.0, 24).tolist()),
}
#: How far towards the ends of its typical range an angle off the middle is tried.
_OFF = 0.5
#: Width of a size's prior, in the largest typical size.
_WIDTH = 2.0


@dataclass(frozen=True)
class CandidateEffect:
    """An effect as a candidate cause."""

    name: str
    effect: Effect
    locations: tuple[str, ...]  #: Where in the block diagram it acts
    free: tuple[FreeParameter, ...]  #: Its sizes, named ``<effect>.<size>``, with their priors
    variants: FloatArray  #: (k, n_s) array; sizes to try it at
    stochastic: bool  #: Whether noise drives it, so that no simulation shows it

    def surprise(self, values: Mapping[str, float]) -> float:
        """How unusual its sizes are, nats below the densest of their log-normal prior.

        Of the sizes that can make the effect vanish the most usual one counts: the others may be
        zero. The prior's 68 % are the typical range; ``values``: by name, ``<effect>.<size>``.
        """
        surprises = []
        for i, parameter in enumerate(self.effect.parameters()):
            if i and not _vanishes(parameter):
                continue
            low, high = parameter.typical or (parameter.value / 3, parameter.value * 3)
            most = max(abs(low), abs(high))
            least = max(min(abs(low), abs(high)) if low * high > 0 else 0.0, most / _DECADE)
            spread = max(np.log(most / least) / 2, np.log(2))
            size = max(abs(values[f"{self.name}.{parameter.name}"]), 1e-9 * most)
            surprises.append(float(0.5 * (np.log(size / np.sqrt(least * most)) / spread) ** 2))
        return min(surprises)

    def at_sizes(
        self, values: Mapping[str, float], candidates: Mapping[str, "CandidateEffect"]
    ) -> "CandidateEffect":
        """What it is at some sizes: a candidate that is its special case there, or itself.

        ``values``: by name, ``<effect>.<size>``.
        """
        if self._is_usual(values):
            return self
        return self.special_case(candidates) or self

    def special_case(self, candidates: Mapping[str, "CandidateEffect"]) -> "CandidateEffect | None":
        """Which of the candidates it is where its sizes vanish; None: none of them."""
        if self.effect.special_case is None:
            return None
        simpler, _ = self.effect.special_case
        alike = (
            c
            for c in candidates.values()
            if type(c.effect) is simpler and c.locations == self.locations
        )
        return next(alike, None)

    def special_share(self, values: Mapping[str, float], sds: Mapping[str, float]) -> float:
        """How probable it is that its sizes are those of its special case.

        By their errors: a size just beyond a limit says as little as one just within.

        ``values``, ``sds``: fitted sizes and their standard deviations by name,
        ``<effect>.<size>``; one that lies on a bound has none.
        """
        usual = 1.0
        for size, least in self._limits.items():
            value, sd = (by_name[f"{self.name}.{size}"] for by_name in (values, sds))
            if sd > 0:
                usual *= 0.5 * math.erfc((least - value) / (math.sqrt(2) * sd))
            else:
                usual *= value >= least
        return 1.0 - usual

    def apart_from_special_case(self, values: Mapping[str, float]) -> dict[str, float]:
        """Fitted sizes; typical ones in the place of those that make it its special case.

        ``values``: by name, ``<effect>.<size>``, others among them.
        """
        sizes = dict(values)
        if any(f"{self.name}.{size}" not in values for size in self._limits):
            return sizes
        if not self._is_usual(values):
            for parameter in self.effect.parameters():
                if parameter.name in self._limits and parameter.typical:
                    low, high = parameter.typical
                    sizes[f"{self.name}.{parameter.name}"] = math.sqrt(low * high)
        return sizes

    @property
    def _limits(self) -> Mapping[str, float]:
        """Sizes below which it is its special case."""
        if self.effect.special_case is None:
            return {}
        least = {p.name: p.typical[0] for p in self.effect.parameters() if p.typical}
        return {size: share * least[size] for size, share in self.effect.special_case[1].items()}

    def _is_usual(self, values: Mapping[str, float]) -> bool:
        return all(values[f"{self.name}.{size}"] >= least for size, least in self._limits.items())

    @property
    def simulated(self) -> bool:
        """Whether a simulation with slopes shows it: noise, rounding and chance have no slope."""
        return not self.stochastic and not isinstance(self.effect, Quantisation | Dropout)


def applicable_candidates(
    model: Model, effects: Mapping[str, Effect]
) -> tuple[dict[str, CandidateEffect], dict[str, str]]:
    """Those effects that a model can carry and does not have already.

    Returns ``inapplicable``: why the others cannot be the cause here.
    """
    applicable, inapplicable = {}, {}
    for name, effect in effects.items():
        if name in effect_names(model):
            inapplicable[name] = "the nominal model has it already"
            continue
        try:
            with_effect = ExtendedModel(model, name, effect)
        except ModelError as error:
            inapplicable[name] = str(error.args[0] if error.args else error)
            continue
        effect = with_effect.effect  # with the sizes that are typical of this model
        applicable[name] = CandidateEffect(
            name,
            effect,
            places_of(with_effect),
            tuple(_free(name, i, p) for i, p in enumerate(effect.parameters())),
            variants(effect.parameters()),
            effect.overrides("noise_sd"),
        )
    return applicable, inapplicable


def joint(model: Model, candidates: Sequence[CandidateEffect]) -> Model:
    """The model with several effects."""
    return extend_model(model, {candidate.name: candidate.effect for candidate in candidates})


def variants(parameters: Sequence[Parameter]) -> FloatArray:
    """Sizes to try an effect at, one row each.

    The first size, and every other that is zero by default, can make the effect vanish: each of
    them is tried alone over its typical range, to both sides where both make sense; the others stay
    as they are, but for an arm that may point either way, a width, and a frequency: to that of a
    mode that rings long no slope leads from a tenth beside it. Its trace is in proportion to its
    amplitude, of which one size will do.
    """
    defaults = np.array([p.value for p in parameters], dtype=float)
    amplitudes = [i for i in range(len(parameters)) if is_amplitude(parameters, i)]
    shapes = [i for i in range(len(parameters)) if i not in amplitudes]
    rows = []
    for i in amplitudes:
        base = defaults.copy()
        base[amplitudes] = 0.0
        values = _trial_values(parameters[i])
        if any(p.name == "frequency" for p in parameters):
            values = values[len(values) // 2 :][:1]
        for value, shape in itertools.product(values, _shapes(parameters, shapes)):
            row = base.copy()
            row[i] = value
            row[shapes] = shape
            rows.append(row)
    return np.array(rows)


def is_amplitude(parameters: Sequence[Parameter], index: int) -> bool:
    """Whether an effect vanishes with one of its sizes."""
    return index == 0 or _vanishes(parameters[index])


def _vanishes(parameter: Parameter) -> bool:
    return parameter.value == 0.0 and parameter.unit not in TRAVELS and parameter.name != "height"


def _trial_values(parameter: Parameter) -> list[float]:
    low, high = parameter.typical or (parameter.value / 3, parameter.value * 3)
    has_both_signs = low < 0 < high
    if has_both_signs or low == 0:
        middle = max(abs(low), abs(high)) / 2
        multiples: tuple[float, ...] = (0.4, 1.5)
    else:
        middle = float(np.sqrt(low * high))
        multiples = _MULTIPLES
    values = [middle * k for k in multiples]
    if has_both_signs or parameter.lower < 0:
        values += [-v for v in values]
    return [v for v in values if parameter.lower <= v <= parameter.upper]


def _shapes(parameters: Sequence[Parameter], indices: Sequence[int]) -> list[tuple[float, ...]]:
    options = []
    for i in indices:
        p = parameters[i]
        if p.name == "arm":
            options.append([p.value, -p.value])
        elif p.value == 0.0 and p.typical and p.unit in TRAVELS and p.typical[0] < 0 < p.typical[1]:
            # where a spring hangs free: off the middle it pulls all the time
            options.append([p.value, *(_OFF * end for end in p.typical)])
        elif p.name in _SPREAD_SHAPES:
            low, high = p.typical or (p.value / 2, p.value * 2)
            options.append((low * (high / low) ** np.array(_SPREAD_SHAPES[p.name])).tolist())
        else:
            options.append([p.value])
    return list(itertools.product(*options))


def _free(effect: str, index: int, parameter: Parameter) -> FreeParameter:
    low, high = parameter.typical or (parameter.value / 3, parameter.value * 3)
    amplitude = index == 0 or _vanishes(parameter)
    if amplitude:
        mean, sd = 0.0, _WIDTH * max(abs(low), abs(high))
    elif low <= 0 <= high:
        mean, sd = parameter.value, max(abs(low), abs(high))
    else:
        mean, sd = parameter.value, high - low
    lower, upper = parameter.lower, parameter.upper
    if not amplitude and low > 0:  # what only gives an effect its shape stays near what is typical
        lower, upper = max(lower, low / _BEYOND), min(upper, high * _BEYOND)
    mean = float(np.clip(mean, lower, upper))
    return FreeParameter(
        name=f"{effect}.{parameter.name}",
        unit=parameter.unit,
        start=parameter.value,
        prior_mean=mean,
        prior_sd=sd,
        lower=lower,
        upper=upper,
    )
