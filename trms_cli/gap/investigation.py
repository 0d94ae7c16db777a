"""An investigation: experiment, diagnosis, the experiment that it advises, until one cause is sure.

What is decided here: which commands come next, how large they may be, and when there is no more to
be gained. Commands are as large as all rigs of an ensemble stand: the models that the recordings
leave possible, each drawn several times within its uncertainty, are simulated first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.wording import percent
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import effect_names, extend_model
from trms_cli.effects.model_form import MODEL_FORM
from trms_cli.gap.belief import simulated_part
from trms_cli.gap.diagnosis import NO_EFFECT, Cause, DiagnosisResult
from trms_cli.gap.next_experiment import DECIDES
from trms_cli.gap.wording import cause_name
from trms_cli.identification.excitation.design import ExcitationRequest, design
from trms_cli.identification.excitation.excitation import ExcitationPlugin
from trms_cli.models.model import Model, names
from trms_cli.models.scales import port_scale
from trms_cli.plants.envelope import Envelope, EnvelopeSetup
from trms_cli.simulation.rollout import Rollout

SCHEMA = "trms.investigation/1"
#: Why an investigation ended.
Ending = Literal[
    "sure", "not_told_apart", "no_experiment", "too_large", "budget", "landed", "unusable"
]

#: Probability from which a cause is part of the ensemble.
_POSSIBLE = 0.02
#: Rigs drawn for each cause, and for the nominal model before anything is recorded.
_DRAWS, _FIRST_DRAWS = 4, 8
#: Standard deviations within which they are drawn.
_FARTHEST = 2.0
#: Share of the way to a mechanical stop, and to the ends of the envelope, that is used.
_OF_STOPS, _OF_ENVELOPE = 0.9, 0.95
#: Travels of an axis without a stop, rad on small benches.
_WITHOUT_STOP = 4 * math.pi
#: Shares of the advised amplitude that are tried.
SHARES = (1.0, 0.85, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.12)
#: Likewise of the stops for the first experiment: as ``trms excite`` takes them.
_FIRST_SHARE = 0.8


@dataclass(frozen=True)
class RigLimits:
    """What a rig may do."""

    lower: FloatArray  #: (n_u,) array; of the commands, V
    upper: FloatArray  #: (n_u,) array; V
    envelope: Envelope = field(default_factory=Envelope)

    def limited(self, commands: FloatArray, model: Model, sample_time: float) -> FloatArray:
        """Commands (n, n_u) as the rig would get them, V: within limits, envelope and slew."""
        setup = EnvelopeSetup(
            sample_time, names(model.inputs), tuple(names(model.outputs)), dict(model.stops)
        )
        watch = replace(self.envelope, readings={}, rates={}).init(setup)
        applied = np.clip(commands, self.lower, self.upper)
        for k in range(1, len(applied)):
            # nobody hears the events of a rig that is only simulated
            applied[k] = watch.limited(applied[k], applied[k - 1], lambda *_: None)
        return applied

    def bounds(self, model: Model) -> dict[str, float]:
        """Largest sizes of the angles in the first experiment, rad, where the envelope has one."""
        sizes = {}
        for name in self.envelope.readings:
            if name in model.controlled and name in _axes(model):
                low, high = self.envelope.reach(name, float(model.stops.get(name, math.inf)))
                sizes[name] = _FIRST_SHARE * min(-low, high)
        return {name: size for name, size in sizes.items() if math.isfinite(size)}


def _axes(model: Model) -> dict[str, str]:
    """Axis by its angle or position."""
    return {own.angle: name for name, own in model.axes.items()}


class Ensemble:
    """Rigs that the present one may be.

    ``members``: models, and parameter values (k, n_p) of the rigs that each stands for.
    ``sample_time``: s.
    """

    def __init__(
        self, members: Sequence[tuple[Model, FloatArray]], limits: RigLimits, sample_time: float
    ) -> None:
        self._members = [(Rollout(model, sample_time), values) for model, values in members]
        self._limits, self._sample_time = limits, sample_time
        self.model = members[0][0]

    def __len__(self) -> int:
        return sum(len(values) for _, values in self._members)

    def limited(self, commands: FloatArray) -> FloatArray:
        """Commands (n, n_u) as the rig would get them, V."""
        return self._limits.limited(commands, self.model, self._sample_time)

    def ranges(self, commands: FloatArray) -> dict[str, tuple[float, float]] | None:
        """Ends of each output over all rigs, commanded (n, n_u) V; None where one leaves bounds."""
        ends: dict[str, tuple[float, float]] = {}
        for rollout, values in self._members:
            for p in values:
                own = self._ranges_of(rollout, p, commands)
                if own is None:
                    return None
                for name, (low, high) in own.items():
                    before = ends.get(name, (low, high))
                    ends[name] = (min(low, before[0]), max(high, before[1]))
        return ends

    def _ranges_of(
        self, rollout: Rollout, p: FloatArray, commands: FloatArray
    ) -> dict[str, tuple[float, float]] | None:
        model = rollout.model
        start = rollout.initial(model.rest(), commands[0])
        with np.errstate(all="ignore"):
            y = rollout.outputs(commands, [0], [len(commands)], start[None], p).y
        if not np.isfinite(y).all():
            return None
        envelope = self._limits.envelope
        ranges: dict[str, tuple[float, float]] = {}
        for column, signal in zip(y.T, model.outputs, strict=True):
            low, high = float(column.min()), float(column.max())
            if (axis := _axes(model).get(signal.name)) is not None:
                stop = float(model.stops.get(signal.name, math.inf))
                free = _WITHOUT_STOP * port_scale(model, axis=axis).travel
                stop = _OF_STOPS * stop if math.isfinite(stop) else free
                if max(-low, high) > stop:
                    return None
            rates = np.diff(column) / self._sample_time
            for bounds, ends in (
                (envelope.readings, (low, high)),
                (envelope.rates, (float(rates.min()), float(rates.max()))),
            ):
                bound = bounds.get(signal.name)
                if bound is not None and not (
                    _OF_ENVELOPE * bound.lower <= ends[0] and ends[1] <= _OF_ENVELOPE * bound.upper
                ):
                    return None
            ranges[signal.name] = (low, high)
        return ranges


def prior_ensemble(model: Model, limits: RigLimits, sample_time: float, seed: int) -> Ensemble:
    """The nominal model, and rigs drawn from the priors of its parameters."""
    draws = [model.parameters.draw(seed * 1000 + i, 1.0).values for i in range(_FIRST_DRAWS)]
    values = np.array([model.parameters.values, *draws])
    return Ensemble([(model, values)], limits, sample_time)


def posterior_ensemble(
    diagnosis: DiagnosisResult,
    model: Model,
    candidates: Mapping[str, Effect],
    limits: RigLimits,
    sample_time: float,
    seed: int,
) -> Ensemble:
    """Corrected models of all causes with a share of the probability, drawn within their errors.

    Draws are independent: where sizes and parameters compensate each other, the rigs scatter more
    than the recordings leave open, and the commands are rather too small.
    """
    random = np.random.default_rng([seed, len(diagnosis.recordings)])
    laws = dict.fromkeys(name.split(".")[0] for name in diagnosis.parameters if "." in name)
    missing = {n: MODEL_FORM[n] for n in laws if n in MODEL_FORM and n not in effect_names(model)}
    base = extend_model(model, missing)
    members: list[tuple[Model, FloatArray]] = []
    for cause in diagnosis.causes:
        if cause.probability < _POSSIBLE and members:
            continue
        effects = {n: candidates[n] for n in _fitted_effects(cause) if n in candidates}
        extended = extend_model(base, effects)
        members.append((extended, _draws(extended, cause, diagnosis, random)))
    if not members:
        members = [(base, base.parameters.values[None])]
    return Ensemble(members, limits, sample_time)


def _fitted_effects(cause: Cause) -> tuple[str, ...]:
    """Those of a cause's effects that a simulation shows and that have sizes."""
    if cause.effects[0] in NO_EFFECT:
        return ()
    return tuple(
        name
        for name in simulated_part(cause.effects)
        if any(size.startswith(f"{name}.") for size in cause.parameters)
    )


def _draws(
    model: Model, cause: Cause, diagnosis: DiagnosisResult, random: np.random.Generator
) -> FloatArray:
    """Parameter values (1 + draws, n_p): as fitted, then within the errors."""
    fitted = {n: (p.fitted, p.sd) for n, p in diagnosis.parameters.items()}
    if cause.effects[0] in NO_EFFECT:
        fitted = {n: (diagnosis.refit.get(n, value), sd) for n, (value, sd) in fitted.items()}
    fitted |= {n: (size.value, size.sd) for n, size in cause.parameters.items()}
    rows = []
    for number in range(1 + _DRAWS):
        row = []
        for parameter in model.parameters:
            value, sd = fitted.get(parameter.name, (parameter.value, 0.0))
            normal = float(np.clip(random.standard_normal(), -_FARTHEST, _FARTHEST))
            if number and sd is not None and math.isfinite(sd):
                value += sd * normal
            row.append(float(np.clip(value, parameter.lower, parameter.upper)))
        rows.append(row)
    return np.array(rows)


@dataclass(frozen=True)
class ExperimentPlan:
    """What is played next."""

    words: str  #: What the commands are
    why: str  #: What they are to tell
    commands: FloatArray  #: (n, n_u) array; V, from rest
    share: float  #: Of the advised amplitude
    rigs: int  #: Simulated rigs that stayed within bounds
    ranges: Mapping[str, tuple[float, float]]  #: Of the outputs over these rigs


def fitted_plan(
    words: str, why: str, commands: FloatArray, centre: FloatArray, first: int, ensemble: Ensemble
) -> ExperimentPlan | None:
    """Commands (n, n_u) made as small about ``centre`` (n_u,) V as all rigs of an ensemble need.

    ``first``: sample at which the excitation begins. None where no share of the amplitude will do.
    """
    for share in SHARES:
        scaled = commands.copy()
        scaled[first:] = centre + share * (commands[first:] - centre)
        applied = ensemble.limited(scaled)
        ranges = ensemble.ranges(applied)
        if ranges is not None:
            return ExperimentPlan(words, why, applied, share, len(ensemble), ranges)
    return None


def excitation_plan(
    model: Model,
    excitation: ExcitationPlugin,
    request: ExcitationRequest,
    ensemble: Ensemble,
    limits: RigLimits,
    why: str,
    progress: Callable[[str], None] = lambda words: None,
) -> ExperimentPlan | None:
    """An excitation that is designed with the model, as ``trms excite`` does, for the ensemble."""
    bounds = {**limits.bounds(model), **request.bounds}
    request = replace(request, bounds=bounds, rigs=0, share=_FIRST_SHARE)
    designed = design(model, excitation, request, progress)
    kind = type(excitation).__name__.removesuffix("Excitation").lower()
    words = f"{kind} about an operating point"
    return fitted_plan(words, why, designed.commands, designed.centre, designed.first, ensemble)


@dataclass(kw_only=True)
class ExperimentRecord:
    """An experiment that was made."""

    number: int
    words: str
    why: str
    log: str  #: The recording
    seconds: float  #: s, of rig time, landing included
    recorded: float  #: s, that the recording lasts
    share: float  #: Of the advised amplitude
    complete: bool = True  #: Whether it came to its end
    usable: bool = True  #: Whether a diagnosis takes the recording
    verdict: str = ""  #: Of all recordings up to this; empty where they were not diagnosed
    #: Of the causes after it, by their effects joined by ``+``; descending
    probabilities: dict[str, float] = field(default_factory=dict)

    def diagnosed(self, diagnosis: DiagnosisResult) -> None:
        """Keep what all recordings up to this one say."""
        self.verdict = diagnosis.verdict
        self.probabilities = {
            "+".join(cause.effects): round(cause.probability, 4) for cause in diagnosis.causes
        }


#: s. Shorter recordings, of an experiment that was broken off, are not diagnosed.
_SHORTEST = 10.0


@dataclass(kw_only=True)
class Investigation:
    """What has been done, and how it stands: the content of ``investigation.json``."""

    budget: float  #: s, of rig time
    sure: float  #: Probability at which a cause is taken for told
    experiments: list[ExperimentRecord] = field(default_factory=list)
    ending: Ending | None = None  #: None while it goes on, or where it was interrupted
    sentence: str = ""  #: The ending in words

    @property
    def spent(self) -> float:
        """Rig time, s."""
        return sum(experiment.seconds for experiment in self.experiments)

    @property
    def recordings(self) -> list[str]:
        """What is diagnosed."""
        return [e.log for e in self.experiments if e.usable and e.recorded >= _SHORTEST]

    def allows(self, duration: float) -> bool:
        """Whether the budget leaves room for an experiment of a duration, s."""
        return self.spent + duration <= self.budget + 1e-6

    def end(self, ending: Ending, sentence: str) -> None:
        """Note why no further experiment is made."""
        self.ending, self.sentence = ending, sentence


def ending_of(
    investigation: Investigation, diagnosis: DiagnosisResult
) -> tuple[Ending, str] | None:
    """Why no further experiment is worth making, and in words; None where one is.

    The budget is looked at once the experiment is known.
    """
    # one answer, an effect or none
    top = max(diagnosis.causes, key=lambda cause: cause.probability, default=None)
    if top is not None and top.probability >= investigation.sure:
        return "sure", f"{cause_name(top.effects)} has a probability of {percent(top.probability)}"
    advice = diagnosis.next_experiment
    if advice is None:
        return "no_experiment", "no experiment could be predicted that keeps the rig within bounds"
    prediction = advice.prediction
    if prediction is not None and prediction.apart and not prediction.longer:
        seconds = len(prediction.experiment.commands) * diagnosis.recordings[0].sample_time_s
        left = max(1, math.floor((investigation.budget - investigation.spent) / seconds))
        if left * prediction.nats < DECIDES:
            pair = " and ".join(cause_name((name,)) for name in prediction.apart)
            return (
                "not_told_apart",
                f"no experiment that could be advised tells {pair} apart: the best promises "
                f"{prediction.nats:.2g} nats in {seconds:.0f} s, and odds of 20 to 1 take "
                f"{DECIDES:g}",
            )
    return None


def advised_plan(diagnosis: DiagnosisResult, ensemble: Ensemble) -> ExperimentPlan | None:
    """The advised experiment, fitted to the ensemble; None where no amplitude will do.

    Raises ConfigurationError for advice without commands.
    """
    advice = diagnosis.next_experiment
    if advice is None or advice.prediction is None:
        raise ConfigurationError("the diagnosis advises no commands", where="real")
    experiment = advice.prediction.experiment
    return fitted_plan(
        experiment.words,
        advice.why,
        experiment.commands,
        experiment.centre,
        experiment.first,
        ensemble,
    )


def wants_excitation(diagnosis: DiagnosisResult) -> bool:
    """Whether another excitation like the first is advised: longer, or for what comes at random.

    Where there are others beside the first, it may be these that tell more: then what is advised
    is made.
    """
    advice = diagnosis.next_experiment
    if advice is None or advice.prediction is None:
        return advice is not None
    return advice.prediction.longer and len(diagnosis.recordings) == 1


def document_of(investigation: Investigation) -> dict[str, Any]:
    """The content of ``investigation.json``."""
    from trms_cli.core.findings import json_data

    return {"schema": SCHEMA, **json_data(investigation), "rig_time_s": investigation.spent}


def read_document(document: Mapping[str, Any]) -> Investigation:
    """An investigation that was kept.

    Raises ConfigurationError for a document of another kind.
    """
    import msgspec

    if document.get("schema") != SCHEMA:
        raise ConfigurationError(f"the schema is {document.get('schema')!r}", remedy=SCHEMA)
    known = {key: v for key, v in document.items() if key not in ("schema", "rig_time_s")}
    try:
        return msgspec.convert(known, Investigation)
    except msgspec.ValidationError as error:
        raise ConfigurationError(f"cannot be read: {error}") from error


def columns_of(investigation: Investigation, most: int = 3) -> Iterator[str]:
    """The answers that are worth a column: the likeliest of the last diagnosis, then of others."""
    seen: dict[str, float] = {}
    for experiment in reversed(investigation.experiments):
        for name, probability in experiment.probabilities.items():
            seen[name] = max(seen.get(name, 0.0), probability)
        if len(seen) >= most:
            break
    yield from sorted(seen, key=lambda name: -seen[name])[:most]
