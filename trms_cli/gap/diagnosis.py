"""What a diagnosis says: the content of ``diagnosis.json``, as plain data between the stages.

The names of fields and their nesting are the contract with programs that read the file; what is
``None`` there could not be told. Numbers are in SI units and radians. The functions below read what
pages, screens and tasks ask of it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from trms_cli.core.arrays import FloatArray
from trms_cli.core.chart import DiagramRow
from trms_cli.core.findings import json_data

SCHEMA = "trms.diagnosis/1"
Verdict = Literal["effect", "parameters_only", "no_gap", "no_change", "none_of_these", "undecided"]
#: Causes that are no effect, as they stand among the ``causes``.
NO_EFFECT = ("no_gap", "no_change", "parameters_only", "none_of_these")
#: Probability and share below which a cause and a place are not worth a line.
LEAST = 0.01
#: A channel whose error grows by more than this factor is worse.
WORSE = 1.02
#: s; the horizon that stands for all: this, or the longest that there is below.
_HORIZON = 2.0


@dataclass(frozen=True, kw_only=True)
class DiagnosedRecording:
    """A recording that was diagnosed."""

    file: str  #: as it was named
    sha256: str  #: of its bytes, hexadecimal
    duration_s: float  #: s
    sample_time_s: float  #: s
    channels: tuple[str, ...]  #: commands, then what was measured


@dataclass(frozen=True, kw_only=True)
class LocationShare:
    """How much of the gap lies at a place of the block diagram."""

    location: str  #: see :mod:`trms_cli.effects.places`
    share: float  #: 0 to 1
    ci95: tuple[float, float]  #: of the share, over resampled blocks


@dataclass(frozen=True, kw_only=True)
class RegionShare:
    """Where in state space the missing force acts: the share of its energy under a condition."""

    location: str  #: see :mod:`trms_cli.effects.places`
    condition: str  #: in words
    share: float  #: 0 to 1


@dataclass(frozen=True, kw_only=True)
class SizeEstimate:
    """A fitted size of an effect with its standard deviation."""

    value: float  #: in its unit
    sd: float  #: of the posterior
    unit: str  #: SI
    others: tuple[float, ...] = ()  #: values far from it that fit as well: it is not resolved


@dataclass(frozen=True, kw_only=True)
class Onset:
    """When a cause begins within the recordings, or ends."""

    time_s: float  #: s, from the beginning of the recording that it begins in
    ci95: tuple[float, float]  #: s
    ends: bool = False  #: Whether it acts until then, and not from then on


@dataclass(frozen=True, kw_only=True)
class Cause:
    """One entry of the race: effects together (or one of :data:`NO_EFFECT`), calibrated."""

    effects: tuple[str, ...]  #: sorted by name
    probability: float  #: 0 to 1
    parameters: Mapping[str, SizeEstimate] = field(default_factory=dict)  #: sizes by name
    onset: Onset | None = None  #: None: it acts from the beginning to the end

    @property
    def open_sizes(self) -> dict[str, SizeEstimate]:
        """Sizes about which searches from several points disagree, by name."""
        return {name: size for name, size in self.parameters.items() if size.others}


@dataclass(frozen=True, kw_only=True)
class LawDeparture:
    """By how much a law of the model is of another form than the rig's."""

    value: float  #: what the refit found, in its unit; zero is the model's own form
    sd: float  #: of the posterior
    unit: str  #: SI
    words: str  #: as a colleague calls it


@dataclass(frozen=True, kw_only=True)
class MovedParameter:
    """A nominal parameter that may be what differs, alone."""

    parameter: str  #: its name
    probability: float  #: 0 to 1; that it moved, if no effect but other parameters are the answer
    change: float  #: in its unit, from the model's value
    sd: float  #: of the posterior
    unit: str  #: SI
    words: str  #: in physical words


@dataclass(frozen=True, kw_only=True)
class Rejected:
    """A suspect that is not the answer, and why not."""

    effect: str  #: its name
    score: float | None = None  #: held-out nats above the refitted model; None: not fitted
    size: SizeEstimate | None = None  #: of its first size, where it was fitted
    upper_bound: float | None = None  #: the first size lies below it with 95 %, in its unit
    reason: str  #: in words
    unit: str = ""  #: of the first size, SI


@dataclass(frozen=True, kw_only=True)
class ControlCommand:
    """A line that controls with the corrected model."""

    command: str
    why: str  #: which rig it drives


@dataclass(frozen=True, kw_only=True)
class LoopGain:
    """What the correction gains one controller on one reference."""

    controller: str  #: its name
    reference: str  #: ``sine``, ``square``, or ``rest``: where that square has stood still
    before: float  #: RMS tracking error over all angles with the model as it was, rad
    after: float  #: the same with the corrected model in controller and observer
    is_worse: bool  #: whether it grows by more than 2 %, and for sure where it was run repeatedly
    is_visible: bool = True  #: whether it grows by more than its sensors' noise


@dataclass(frozen=True, kw_only=True)
class Worth:
    """What the correction gains in the loop, simulated on the corrected model."""

    before: Mapping[str, float]  #: RMS tracking error by angle with the model as it was, rad
    after: Mapping[str, float]  #: the same with the corrected model in the controller
    controller: str  #: its name
    command: str  #: of the loop with it: the corrected model is controller's and rig's
    words: str  #: in a sentence
    loops: tuple[LoopGain, ...] = ()  #: by controller and reference
    warning: str = ""  #: where the correction makes a loop worse, and what to use; empty: nowhere


@dataclass(frozen=True, kw_only=True)
class NotTestable:
    """An effect on which these recordings say nothing, and why."""

    effect: str  #: its name
    reason: str  #: in words


@dataclass(frozen=True, kw_only=True)
class Detectable:
    """The smallest size of an effect that these recordings would show."""

    minimum_size: float  #: of the effect's first size
    unit: str  #: SI


@dataclass(frozen=True, kw_only=True)
class FittedParameter:
    """A nominal parameter before and after, with the cause in the model."""

    prior: float  #: as the model had it
    fitted: float  #: with the cause, if one is added
    sd: float  #: of the posterior
    unit: str  #: SI
    moved: float | None = None  #: by how many prior standard deviations; far is suspicious


@dataclass(frozen=True, kw_only=True)
class Gap:
    """Root mean square of free-run errors of one channel at one horizon, on the sealed part."""

    raw: float  #: of the model as it was
    refit: float  #: with other parameters
    corrected: float  #: with the cause added
    floor: float  #: what a right model would leave
    unit: str  #: SI

    @property
    def is_worse(self) -> bool:
        """Whether the correction makes it so."""
        return self.corrected > WORSE * self.refit


@dataclass(frozen=True, kw_only=True)
class Shrink:
    """``1 − (corrected − floor)/(refit − floor)``; None where there is no gap to shrink."""

    fraction: float | None  #: at most 1
    ci95: tuple[float, float] | None  #: of another recording of the rig


@dataclass(frozen=True, kw_only=True)
class OpenLoopExperiment:
    """Commands, what they are in words, and what to type for them."""

    words: str
    commands: FloatArray  #: (n, n_u) array; from rest, lead-in included, V
    command: str
    centre: FloatArray  #: (n_u,) array; about which the excitation is, V
    first: int  #: Sample at which the excitation begins


@dataclass(frozen=True, kw_only=True)
class PredictedExperiment:
    """The experiment that a diagnosis advises, and what it was predicted to say."""

    experiment: OpenLoopExperiment
    apart: tuple[str, ...]  #: Effects that it is to tell apart; empty where it is to show some
    nats: float  #: Between those, or by which the least visible of what is to be shown shows
    longer: bool  #: Whether as much time in the way of the present recordings says more


@dataclass(frozen=True, kw_only=True)
class NextExperiment:
    """What to record next, as a command that can be typed."""

    why: str  #: a sentence
    command: str  #: that can be typed
    prediction: PredictedExperiment | None = None  #: for an investigation alone: not in the file


@dataclass(frozen=True, kw_only=True)
class GapTest:
    """A test of the refitted model's innovations: are they larger than usual, by a margin?"""

    name: str  #: variance, whiteness, squares, inputs, bands
    channel: str  #: of the innovations
    statistic: float  #: large ones speak against the model
    p_value: float  #: by parametric bootstrap
    p_corrected: float  #: corrected for the number of tests
    rejected: bool  #: at five percent, corrected
    #: what still counts as usual: a factor on the power (variance, bands), or a correlation
    margin: float = 0.0


@dataclass(frozen=True, kw_only=True)
class RaceEntry:
    """A competitor of the race."""

    #: Empty for the refitted model without any; ``flexible`` for a residual force without a name
    effects: tuple[str, ...]
    score: float  #: held-out log predictive density, nats above the refitted model
    se: float | None = None  #: its standard error over blocks; None where none was reckoned
    #: 0 to 1; its score, over the nats that the refit owes to discrepancies or the best gains: a
    #: share of the gap in one-step errors, not of that in free runs
    explained: float
    #: Largest move of a nominal parameter, in prior standard deviations; None: all were held
    moved: float | None = None
    #: Fitted sizes.
    parameters: Mapping[str, SizeEstimate] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Traces:
    """Series for the report's pictures, thinned to what a page shows."""

    force_time: FloatArray  #: (k,) array; s
    #: dict of str to (k,) arrays; smoothed missing force or torque at each location that is named
    #: in ``where``, and its standard deviation as ``<location>.sd``
    force: Mapping[str, FloatArray]
    force_unit: Mapping[str, str]  #: by location
    #: (k,) arrays; what the best cause says that force is, by location; empty without one
    explained: Mapping[str, FloatArray]
    run_time: FloatArray  #: (n,) array; s, of a free run over the sealed part that shows most
    #: (n,) arrays; per channel: ``measured``, ``raw``, ``refit``, ``corrected``
    runs: Mapping[str, Mapping[str, FloatArray]]
    run_unit: Mapping[str, str] = field(default_factory=dict)  #: by channel
    rows: tuple[DiagramRow, ...] = ()  #: of the rig's block diagram


@dataclass(frozen=True, kw_only=True)
class DiagnosisResult:
    """The whole answer. Fields up to ``next_experiment`` are the contract's."""

    recordings: tuple[DiagnosedRecording, ...]  #: that were diagnosed
    model: str  #: as the user named it
    seed: int  #: of all that was drawn
    versions: Mapping[str, str]  #: of the program and of what it builds on
    verdict: Verdict  #: in one word
    where: tuple[LocationShare, ...]  #: descending; empty where nothing is missing
    region: tuple[RegionShare, ...]  #: in state space and time
    causes: tuple[Cause, ...]  #: descending; their probabilities sum to 1
    confusable: tuple[tuple[str, ...], ...]  #: effects that these recordings do not tell apart
    not_testable: tuple[NotTestable, ...]  #: effects on which they say nothing
    detectable: Mapping[str, Detectable]  #: by effect
    parameters: Mapping[str, FittedParameter]  #: by name, of the nominal model
    gap: Mapping[str, Mapping[str, Gap]]  #: by channel and horizon
    shrink: Mapping[str, Mapping[str, Shrink]]  #: by channel, and "all", and horizon
    next_experiment: NextExperiment | None
    #: Recordings of a known state that these are compared with; empty without
    against: tuple[DiagnosedRecording, ...] = ()
    #: Probability of each effect to be part of the answer, descending
    inclusion: Mapping[str, float] = field(default_factory=dict)
    worth: Worth | None = None  #: None where nothing is corrected
    #: Where something is corrected: on the rig that was recorded, or a clone of the model
    control: tuple[ControlCommand, ...] = ()
    moved: tuple[MovedParameter, ...] = ()  #: descending by probability
    rejected: tuple[Rejected, ...] = ()  #: every other suspect, the nearest first
    excitation: tuple[str, ...] = ()  #: what the recordings cannot tell, said first
    # Beyond the contract: what the report tells besides.
    sentence: str  #: what a colleague would say
    tests: tuple[GapTest, ...] = ()  #: of the refit's innovations
    race: tuple[RaceEntry, ...] = ()  #: best first
    description: tuple[str, ...] = ()  #: of an unnamed force: equation, region, band, memory
    warnings: tuple[str, ...] = ()  #: of the recordings and of the refit
    worse: tuple[str, ...] = ()  #: channels that the correction made worse at 2 s
    effort: str = "normal"  #: quick, normal, thorough
    seconds: Mapping[str, float] = field(default_factory=dict)  #: by stage
    #: Parameters of the nominal model refitted without any cause, for ``refit_model.yaml``.
    refit: Mapping[str, float] = field(default_factory=dict)
    #: Residuals that the corrected model has where no effect explains the gap: class and arguments
    #: by name, as ``effects`` of a model file has them
    residual: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    #: Departures of the nominal model's own laws, which both fitted models then have, by
    #: ``<effect>.<size>``; empty where its laws will do
    model_form: Mapping[str, LawDeparture] = field(default_factory=dict)
    #: What the probabilities were made of, for the calibration.
    evidence: Mapping[str, Any] = field(default_factory=dict)
    traces: Traces | None = None  #: for the report alone: not in the file


def document_of(diagnosis: DiagnosisResult) -> dict[str, Any]:
    """The content of ``diagnosis.json``.

    Keys are the fields of :class:`DiagnosisResult` in their order, after the schema; horizons are
    keys in s with a decimal (``"2.0"``); what is not finite is None.
    """
    advice = diagnosis.next_experiment and replace(diagnosis.next_experiment, prediction=None)
    content: dict[str, Any] = json_data(replace(diagnosis, traces=None, next_experiment=advice))
    del content["traces"]
    if diagnosis.next_experiment is not None:
        del content["next_experiment"]["prediction"]
    for name in ("gap", "shrink"):
        content[name] = {
            channel: {horizon_key(h): rows[h] for h in sorted(rows, key=float)}
            for channel, rows in content[name].items()
        }
    return {"schema": SCHEMA, **content}


def horizon_key(horizon: float | str) -> str:
    """A horizon as the document has it: ``2.0`` for 2 s."""
    return repr(float(horizon))


def likeliest(diagnosis: DiagnosisResult) -> Cause | None:
    """The cause with the largest probability of those that the verdict is of.

    An effect may be likelier than any other, and be told where all parameters together are more.
    """
    causes = diagnosis.causes
    if diagnosis.verdict == "effect":
        causes = tuple(c for c in causes if c.effects[0] not in NO_EFFECT) or causes
    elif diagnosis.verdict != "undecided":
        causes = tuple(c for c in causes if c.effects == (diagnosis.verdict,)) or causes
    return max(causes, key=lambda cause: cause.probability, default=None)


def confusable_with(cause: Cause, diagnosis: DiagnosisResult) -> list[Cause]:
    """Other causes, worth a line, that these recordings do not tell from this one."""
    effects = set(cause.effects)
    names = effects.union(*(group for group in diagnosis.confusable if effects & set(group)))
    return [
        other
        for other in diagnosis.causes
        if other is not cause
        and other.probability >= LEAST
        and names >= set(other.effects)
        and not effects >= set(other.effects)
    ]


def is_corrected(diagnosis: DiagnosisResult) -> bool:
    """Whether the corrected model is another one than the refitted."""
    rows = [row for rows in diagnosis.gap.values() for row in rows.values()]
    return any(row.corrected != row.refit for row in rows)


def compared_with_a_state(diagnosis: DiagnosisResult) -> bool:
    """Whether scores are log evidence above that nothing changed, and not held-out predictions."""
    return any(entry.effects == ("no_change",) for entry in diagnosis.race)


def shown_horizon(horizons: Iterable[str]) -> str:
    """The horizon that stands for all, as the document has it; empty without any."""
    sorted_horizons = sorted(horizons, key=float)
    below = [horizon for horizon in sorted_horizons if float(horizon) <= _HORIZON]
    return (below or sorted_horizons[:1] or [""])[-1]
