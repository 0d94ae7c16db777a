"""What a student hands in: a small form, read strictly, and what it is marked by."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from experiments.gap.blind.cases import Case
from experiments.gap.blind.sets import NAMEABLE
from experiments.gap.blind.truths import LIBRARY, group_of, same_equation
from trms_cli.composition.catalogue import read_yaml
from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.core.plugins import construct, nearest

#: The answer that a rig has no effect: its parameters alone are off.
NO_EFFECT = "none"
#: Effects that the task sheet lists: those that are drawn, and what no recording tells from them.
LISTED = tuple(dict.fromkeys(effect for drawn in NAMEABLE for effect in group_of(drawn)))
#: Endings of forms.
FORMS = (".yaml", ".yml", ".json")
#: Standard deviations within which an honest uncertainty holds the truth.
_WITHIN = 2.0

Share = Annotated[float, Meta(gt=0, le=10)]
Points = Annotated[float, Meta(ge=0, le=1000)]


@dataclass(frozen=True, kw_only=True)
class Answer:
    """A form that is filled in."""

    rig: str  #: Name of the student's folder
    effect: str  #: Of :data:`LIBRARY`, or :data:`NO_EFFECT`
    place: str | None = None  #: Where it acts; None with :data:`NO_EFFECT`
    size: float | None = None  #: Of the effect's growing size, in its SI unit
    uncertainty: Annotated[float, Meta(ge=0)] | None = None  #: One standard deviation of it

    def __post_init__(self) -> None:
        places = sorted({at for truth in LIBRARY.values() for at in truth.locations})
        if self.effect not in (*LIBRARY, NO_EFFECT):
            raise ConfigurationError(
                f"there is no effect {self.effect!r}",
                where="effect",
                remedy=nearest(self.effect, (*LIBRARY, NO_EFFECT)),
            )
        if self.effect == NO_EFFECT:
            for key in ("place", "size", "uncertainty"):
                if getattr(self, key) is not None:
                    raise ConfigurationError(
                        f"a rig without an effect has no {key}",
                        where=key,
                        remedy="leave it empty, or name an effect",
                    )
            return
        if self.place not in places:
            raise ConfigurationError(
                "no place given" if self.place is None else f"there is no place {self.place!r}",
                where="place",
                remedy=nearest(self.place or "", places),
            )
        for key in ("size", "uncertainty"):
            value = getattr(self, key)
            if value is None or not math.isfinite(value):
                raise ConfigurationError(
                    f"{'nothing' if value is None else value} given",
                    where=key,
                    remedy="give a number in the unit of the task sheet",
                )


class EmptyForm(ConfigurationError):
    """A form that nobody has filled in."""


def size_of(effect: str) -> str:
    """The size that says how large an effect is."""
    return LIBRARY[effect].grows[0]


def read_answer(file: Path) -> Answer:
    """The answer in a form.

    Raises ConfigurationError if it cannot be read, a key is missing or unknown, or a value is not
    of its kind, and EmptyForm if no effect is given; it names the file.
    """
    try:
        content = read_yaml(file)
    except (OSError, RecordingError) as error:
        raise ConfigurationError(
            f"cannot be read: {error}", where=str(file), remedy="give a form of text: YAML or JSON"
        ) from error
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise ConfigurationError(
            "this is no form: it has no keys",
            where=str(file),
            remedy="fill in the answer.yaml beside the task sheet",
        )
    if content.get("effect") is None:
        raise EmptyForm(
            "no effect given: the form is not filled in",
            where=str(file),
            remedy=f"name the effect, or {NO_EFFECT} where the parameters alone are off",
        )
    try:
        return construct(Answer, content)
    except ConfigurationError as error:
        raise ConfigurationError(
            error.problem,
            where=f"{file}, {error.where}" if error.where else str(file),
            remedy=error.remedy,
        ) from error


@dataclass(frozen=True, kw_only=True)
class Worth:
    """Points of each part of an answer."""

    effect: Points = 4.0
    confusable: Points = 3.0  #: In place of ``effect``: one that no recording tells from it
    place: Points = 2.0
    size: Points = 2.0
    uncertainty: Points = 2.0

    @property
    def all(self) -> float:
        """The most that an answer can have."""
        return self.effect + self.place + self.size + self.uncertainty


@dataclass(frozen=True, kw_only=True)
class Scheme:
    """How answers are marked."""

    size_within: Share = 0.1  #: Relative error of a size that counts
    largest_uncertainty: Share = 0.25  #: Of the size: a larger one says nothing
    points: Worth = Worth()


@dataclass(frozen=True, kw_only=True)
class Marks:
    """What an answer got, and why."""

    effect: float = 0.0
    place: float = 0.0
    size: float = 0.0
    uncertainty: float = 0.0
    verdict: str = ""  #: right, confusable or wrong; of the effect
    size_error: float | None = None  #: Relative; None unless the effect is right and has a size

    @property
    def all(self) -> float:
        return self.effect + self.place + self.size + self.uncertainty


def mark(answer: Answer, case: Case, scheme: Scheme) -> Marks:
    """Mark an answer by the truth of its rig.

    Whoever says rightly that a rig has no effect has said all; a size counts of the right effect
    alone, since that of another is another quantity.
    """
    worth = scheme.points
    if not case.effects:
        if answer.effect != NO_EFFECT:
            return Marks(verdict="wrong")
        return Marks(
            effect=worth.effect,
            place=worth.place,
            size=worth.size,
            uncertainty=worth.uncertainty,
            verdict="right",
        )
    (effect, sizes), *_ = case.effects.items()
    places = {place for at in case.locations for place in same_equation(at)}
    at_place = worth.place if answer.place in places else 0.0
    if answer.effect != effect:
        if answer.effect in case.group:
            return Marks(effect=worth.confusable, place=at_place, verdict="confusable")
        return Marks(place=at_place, verdict="wrong")
    true = sizes[size_of(effect)]
    size, uncertainty = answer.size or 0.0, answer.uncertainty or 0.0
    error = abs(size - true)
    honest = error <= _WITHIN * uncertainty <= _WITHIN * scheme.largest_uncertainty * abs(size)
    return Marks(
        effect=worth.effect,
        place=at_place,
        size=worth.size if error <= scheme.size_within * abs(true) else 0.0,
        uncertainty=worth.uncertainty if honest else 0.0,
        verdict="right",
        size_error=error / abs(true),
    )


def truth_of(case: Case) -> Mapping[str, Any]:
    """The answer that has all points, as a form has it."""
    if not case.effects:
        return {"effect": NO_EFFECT, "place": None, "size": None}
    (effect, sizes), *_ = case.effects.items()
    return {"effect": effect, "place": case.locations[0], "size": sizes[size_of(effect)]}
