"""One diagnosis held against the truth of its case, and its models against a second recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from experiments.gap.blind.cases import Case
from experiments.gap.blind.model_rig import growing_size
from experiments.gap.blind.refit import NOISE_SD, dataset_of
from experiments.gap.blind.truths import TRUTHS, same_equation
from trms_cli.effects.model_file import load_model
from trms_cli.gap.belief import simulated_part
from trms_cli.gap.diagnosis import NO_EFFECT, SCHEMA, WORSE
from trms_cli.gap.free_runs import free_run_errors
from trms_cli.gap.shrinkage import LEAST_GAP
from trms_cli.models.model import names
from trms_cli.plants.sensors import noise_estimate

#: Sizes that the rigs' laws and the library's share: the cable's memory follows another law, a
#: disturbance is drawn.
_OTHER_SIZES = ("_hysteresis", "_disturbance")
#: Competitors of a race that stand for causes without an effect.
_COMPETITORS: Mapping[str, tuple[str, ...]] = {
    "parameters_only": (),
    "none_of_these": ("flexible",),
}
#: s. The horizon that shrinks are compared at, and the key of all channels together.
HORIZON, ALL = "2.0", "all"


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What of a diagnosis is judged."""

    verdict: str
    #: tuple of (effects, probability); as told, the likeliest first
    causes: tuple[tuple[tuple[str, ...], float], ...]
    #: Of the first cause, ``<effect>.<size>``
    sizes: Mapping[str, float] = field(default_factory=dict)
    places: tuple[str, ...] = ()  #: Locations, the largest share first
    confusable: tuple[tuple[str, ...], ...] = ()
    shrink: float | None = None  #: Told fraction at :data:`HORIZON`, all channels
    shrink_ci95: tuple[float, float] | None = None  #: (low, high) or None
    #: Told noise floor by channel at :data:`HORIZON`
    floors: Mapping[str, float] = field(default_factory=dict)
    #: Told errors by channel at :data:`HORIZON` on the sealed part: (refitted, corrected)
    sealed: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    not_testable: tuple[str, ...] = ()
    seconds: float | None = None  #: That it took
    onset: float | None = None  #: s, from when the first cause is there; None: always
    #: Probability of each effect to be part of the answer; empty where that is not told
    inclusion: Mapping[str, float] = field(default_factory=dict)
    moved: tuple[str, ...] = ()  #: Parameters that may be what differs, the likeliest first
    #: Nats of each competitor of the race, by its effects (:data:`_COMPETITORS` for none)
    scores: Mapping[frozenset[str], float] = field(default_factory=dict)

    @property
    def first(self) -> tuple[tuple[str, ...], float]:
        """The likeliest cause and its probability."""
        return self.causes[0] if self.causes else ((), 0.0)

    def score(self, cause: Sequence[str]) -> float | None:
        """Nats that a cause explains, by its effects that are simulated; None: it did not race."""
        competitor = _COMPETITORS.get(cause[0], tuple(cause)) if cause else ()
        return self.scores.get(frozenset(simulated_part(competitor)))

    @property
    def effects(self) -> frozenset[str]:
        """The effects of the likeliest cause; empty where that is no effect."""
        return frozenset(self.first[0]) - frozenset(NO_EFFECT)

    @property
    def named_effects(self) -> frozenset[str]:
        """The effects that the verdict stands for; empty unless it is ``effect``."""
        if self.verdict != "effect":
            return frozenset()
        effects = (set(names) - set(NO_EFFECT) for names, _ in self.causes)
        return frozenset(next(filter(None, effects), ()))


@dataclass(frozen=True, kw_only=True)
class FreshResult:
    """How the models of a diagnosis do on the second recording of the rig."""

    #: At :data:`HORIZON`, all channels; None where the refit leaves no gap to shrink
    shrink: float | None
    #: Channels in which the corrected model errs by over 2 % more than the refitted one
    worse: tuple[str, ...]
    #: Errors by channel at :data:`HORIZON`: (refitted, corrected); without what diverged
    errors: Mapping[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class JudgedCase:
    """A case with an answer."""

    name: str
    case: Case
    answer: Answer
    fresh: FreshResult | None = None

    @property
    def exact(self) -> bool:
        """Whether the verdict names the rig's effects, all and no others."""
        return bool(self.case.effects) and self.answer.named_effects == frozenset(self.case.effects)

    @property
    def in_group(self) -> bool:
        """Exact, or after exchanging effects that the diagnosis itself declares confusable."""
        if self.exact:
            return True
        named_effects, truth = self.answer.named_effects, frozenset(self.case.effects)
        missed, wrong = truth - named_effects, named_effects - truth
        return (
            bool(missed)
            and len(missed) == len(wrong)
            and all(any(self._declared(m, w) for w in wrong) for m in missed)
        )

    def _declared(self, one: str, other: str) -> bool:
        return any(one in group and other in group for group in self.answer.confusable)

    @property
    def located(self) -> bool:
        """Whether the first place is one where the gap lies."""
        return bool(self.answer.places) and self.answer.places[0] in self.case.locations

    @property
    def equation(self) -> bool:
        """Whether the first place is in the same equation as one where the gap lies."""
        right = {place for at in self.case.locations for place in same_equation(at)}
        return bool(self.answer.places) and self.answer.places[0] in right

    @property
    def both(self) -> bool:
        """Whether all of the rig's effects are among those of the likeliest cause."""
        return bool(self.case.effects) and self.answer.effects >= frozenset(self.case.effects)

    @property
    def two_right(self) -> bool:
        """Whether two of the rig's effects at least are among those of the likeliest cause."""
        return len(self.answer.effects & frozenset(self.case.effects)) >= 2

    @property
    def onset_error(self) -> float | None:
        """s, between the onset that is told and the rig's; None where none is told."""
        if not self.case.onset or self.answer.onset is None:
            return None
        return abs(self.answer.onset - next(iter(self.case.onset.values())))

    @property
    def truth(self) -> frozenset[frozenset[str]]:
        """Causes that are right, whatever kind of cause that is."""
        return frozenset(frozenset(cause) for cause in right_causes(self.case))

    @property
    def any_right(self) -> bool:
        """Whether one of the rig's effects at least is among those of the likeliest cause."""
        return bool(self.answer.effects & frozenset(self.case.effects))

    @property
    def right(self) -> bool:
        """Whether the likeliest cause is the truth, whatever kind of cause that is."""
        return frozenset(self.answer.first[0]) in self.truth

    @property
    def lead(self) -> float | None:
        """Nats by which the rig's effects explain more than the likeliest cause.

        A torque from outside and a coarse sensor are not simulated, so that they add nothing. None
        where one of the two did not race.
        """
        if not self.case.effects:
            return None
        own, answered = map(self.answer.score, (sorted(self.case.effects), self.answer.first[0]))
        return None if own is None or answered is None else own - answered

    @property
    def size_errors(self) -> dict[str, float]:
        """Relative error of the size that makes the severity, of each effect that was found."""
        relative_errors = {}
        for effect in self.answer.named_effects & frozenset(self.case.effects):
            size = TRUTHS[effect].grows[0] if effect in TRUTHS else growing_size(effect)
            estimate = self.answer.sizes.get(f"{effect}.{size}")
            true = self.case.effects[effect][size]
            if not effect.endswith(_OTHER_SIZES) and estimate is not None and true:
                relative_errors[effect] = abs(estimate - true) / abs(true)
        return relative_errors

    @property
    def label(self) -> str:
        """The truth in a word, for a table of confusions."""
        effects = "+".join(sorted(self.case.effects))
        if self.case.kind == "against":
            changed = effects or "+".join(sorted(self.case.moved)) or "nothing"
            return f"changed: {changed}"
        return f"{effects} from some moment" if self.case.onset else effects or self.case.kind

    @property
    def answer_label(self) -> str:
        """The answer in a word: the effects that it names, else the verdict."""
        return "+".join(sorted(self.answer.named_effects)) or self.answer.verdict


def right_causes(case: Case) -> tuple[tuple[str, ...], ...]:
    """Causes that are right for a case, each sorted; several where nobody could tell them apart.

    With recordings of a known state the cause is what changed. What a rig without a cause is whose
    laws are others than the model's, is a matter of words: all that names no effect is right.
    """
    if case.effects and case.kind not in ("outside", "unexcited"):
        return (tuple(sorted(case.effects)),)
    if case.kind == "against":
        return (("parameters_only",),) if case.moved else (("no_change",),)
    if case.kind == "outside":
        return (("none_of_these",),)
    if case.kind == "unexcited":
        return ("no_gap",), ("parameters_only",), tuple(sorted(case.effects))
    if case.imperfect:
        return ("no_gap",), ("parameters_only",), ("none_of_these",)
    return (("no_gap",),) if case.kind == "null" else (("parameters_only",),)


def answer_of(document: Mapping[str, Any], seconds: float | None = None) -> Answer:
    """What of a ``diagnosis.json`` is judged; missing parts are taken as not told.

    Raises ValueError if it is no such document; the message says what is wrong.
    """
    if document.get("schema") != SCHEMA:
        raise ValueError(f"the schema is {document.get('schema')!r}, {SCHEMA!r} is wanted")
    try:
        causes = sorted(
            ((tuple(c["effects"]), float(c["probability"])) for c in document["causes"]),
            key=lambda cause: -cause[1],
        )
        first = document["causes"][0].get("parameters", {}) if document["causes"] else {}
        places = sorted(document.get("where", []), key=lambda at: -at["share"])
        shrink = document.get("shrink", {}).get(ALL, {}).get(HORIZON) or {}
        ci95 = shrink.get("ci95")
        took = document.get("seconds") or {}
        return Answer(
            verdict=str(document["verdict"]),
            causes=tuple(causes),
            sizes={n: float(v["value"]) for n, v in first.items() if v["value"] is not None},
            places=tuple(at["location"] for at in places),
            confusable=tuple(tuple(group) for group in document.get("confusable", [])),
            shrink=shrink.get("fraction"),
            shrink_ci95=None if not ci95 or None in ci95 else (float(ci95[0]), float(ci95[1])),
            floors={
                channel: float(row[HORIZON]["floor"])
                for channel, row in document.get("gap", {}).items()
                if row.get(HORIZON, {}).get("floor")
            },
            sealed={
                channel: (float(row[HORIZON]["refit"]), float(row[HORIZON]["corrected"]))
                for channel, row in document.get("gap", {}).items()
                if None not in (row.get(HORIZON, {}).get(k) for k in ("refit", "corrected"))
            },
            not_testable=tuple(entry["effect"] for entry in document.get("not_testable", [])),
            seconds=(sum(took.values()) or None) if seconds is None else seconds,
            onset=_onset(document["causes"]),
            inclusion={n: float(p) for n, p in (document.get("inclusion") or {}).items()},
            moved=tuple(entry["parameter"] for entry in document.get("moved") or []),
            scores={
                frozenset(entry["effects"]): float(entry["score"])
                for entry in document.get("race") or []
                if entry["score"] is not None
            },
        )
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error


def _onset(causes: Sequence[Mapping[str, Any]]) -> float | None:
    """Of the likeliest cause, s."""
    onset = max(causes, key=lambda cause: cause["probability"], default={}).get("onset")
    return None if onset is None else float(onset["time_s"])


#: Files of a diagnosis: the nominal model refitted, and with the cause.
CORRECTED, REFIT = "corrected_model.yaml", "refit_model.yaml"


def on_fresh(answer: Answer, folder: Path, recording: Path) -> FreshResult | None:
    """Free runs of both models over a whole recording.

    Parameters
    ----------
    answer : Answer
        Its floors are the units of the channels, as in its own shrink.
    folder : Path
        Of the diagnosis.
    recording : Path
        CSV.

    Returns
    -------
    FreshResult or None
        None where the diagnosis left no models.
    """
    files = [folder / name for name in (REFIT, CORRECTED)]
    if not all(file.is_file() for file in files):
        return None
    if _content(files[0]) == _content(files[1]):
        return FreshResult(shrink=None, worse=())  # nothing was added
    refit, corrected = (_errors(file, recording) for file in files)
    worse = tuple(c for c in refit if corrected[c] > WORSE * refit[c])
    pairs = {c: (refit[c], corrected[c]) for c in refit}
    errors = {c: pair for c, pair in pairs.items() if np.all(np.isfinite(pair))}
    channels = [c for c in refit if c in answer.floors]
    if not (channels and answer.named_effects):
        return FreshResult(shrink=None, worse=worse, errors=errors)
    floors = np.array([answer.floors[c] for c in channels])
    before, after = (
        float(np.sqrt(np.mean((np.array([e[c] for c in channels]) / floors) ** 2)))
        for e in (refit, corrected)
    )
    shrink = min(1 - (after - 1) / (before - 1), 1.0) if before > LEAST_GAP else None
    return FreshResult(shrink=shrink, worse=worse, errors=errors)


def _content(file: Path) -> list[str]:
    """Lines of a model's file but for its comments."""
    lines = file.read_text(encoding="utf-8").splitlines()
    return [line for line in lines if not line.startswith("#")]


def _errors(file: Path, recording: Path) -> dict[str, float]:
    """Root mean square by channel at the horizon."""
    model = load_model(str(file))
    with recording.open(encoding="utf-8") as lines:
        columns = next(line for line in lines if not line.startswith("#")).count(",") + 1
    table = np.loadtxt(recording, delimiter=",", comments="#", skiprows=_header(recording))
    first = 1 + model.n_u  # of the outputs
    measured = table[:, first:columns]
    outputs = names(model.outputs)[: measured.shape[1]]
    noise = NOISE_SD
    if not {*outputs} <= {*noise}:
        noise = dict(zip(outputs, noise_estimate(measured).tolist(), strict=True))
    data = dataset_of(
        model, table[:, 0], table[:, 1:first], measured, recording.name, noise_sd=noise
    )
    horizon = float(HORIZON)
    errors = free_run_errors(model, [data], [(0, 0, len(data))], horizons=[horizon])
    return {channel: of[horizon].rms for channel, of in errors.items()}


def _header(recording: Path) -> int:
    """Lines up to and with the names of the columns."""
    with recording.open(encoding="utf-8") as lines:
        for number, line in enumerate(lines, start=1):
            if not line.startswith("#"):
                return number
    return 0
