"""Causes, places and sizes of a diagnosis in words."""

from collections.abc import Iterable, Mapping, Sequence

from trms_cli.core import wording
from trms_cli.gap.diagnosis import LawDeparture, SizeEstimate

#: Stands for the causes that have no row of their own.
OTHERS = ("others",)
#: What the interval of a shrink is of.
ELSEWHERE = "on another recording"
#: Units of sizes besides, and the factors to them.
_SIZES = {"s": ("ms", 1e3), "kg": ("g", 1e3), "m": ("m", 1.0)}


def cause_name(effects: Sequence[str]) -> str:
    """A cause, or a competitor of the race, as a colleague calls it."""
    plain = {
        (): "parameters only",
        ("flexible",): "a force without a name",
        ("no_gap",): "no gap",
        ("no_change",): "nothing changed",
        ("none_of_these",): "none of these",
        OTHERS: "others, together",
    }
    if tuple(effects) in plain:
        return plain[tuple(effects)]
    first, *others = effects
    text = wording.readable(first)
    return f"{text} with {effects_text(others)}" if others else text


def effects_text(names: Iterable[str], word: str = "and") -> str:
    """Several effects, or places, as prose lists them."""
    return wording.listing([wording.readable(name) for name in names], word)


def probability_text(probability: float) -> str:
    """A probability that never reads as certain: ``0.87``, ``over 0.99``."""
    return "over 0.99" if probability >= 0.995 else f"{probability:.2f}"


def place_name(location: str) -> str:
    """``yaw_moment`` as yaw moment."""
    return location.replace("_", " ")


def sizes(parameters: Mapping[str, SizeEstimate]) -> str:
    """Sizes of a cause with their deviations; one without any was held where it is."""
    return ", ".join(
        f"{_size_name(name.split('.', 1)[-1], size.unit)} {size_text(size)}"
        for name, size in parameters.items()
    )


def _size_name(name: str, unit: str) -> str:
    """A size in words; on an axis that slides a torque is a force."""
    return "force" if name == "torque" and unit == "N" else name.replace("_", " ")


def size_text(size: SizeEstimate) -> str:
    """One size: ``4.12 ± 0.18 mN m``."""
    unit, scale = size_unit(size.unit, size.value)
    spread = f" ± {wording.number(scale * size.sd, 2)}" if size.sd > 0 else ""
    others = "".join(f" or {wording.number(scale * other, 2)}" for other in size.others)
    return f"{wording.number(scale * size.value)}{spread}{others} {wording.unit(unit)}".rstrip()


def size_unit(unit: str, value: float) -> tuple[str, float]:
    """A unit in which a size has few digits, and the factor to it."""
    if abs(value) >= 1:
        return unit, 1.0
    return _SIZES.get(unit) or wording.small_unit(unit)


#: Standard deviations from which a departure is worth a word, and the least size.
_SURE, _LEAST = 3.0, 0.02


def laws_in_words(laws: Mapping[str, LawDeparture]) -> list[str]:
    """Departures that are sure, the surest first."""
    sure = [law for law in laws.values() if abs(law.value) > max(_SURE * law.sd, _LEAST)]
    return [law.words for law in sorted(sure, key=lambda law: -abs(law.value) / max(law.sd, 1e-9))]
