"""Sentences of a diagnosis: what a colleague says of each part of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from trms_cli.gap.diagnosis import NO_EFFECT, Cause, Diagnosis, RaceEntry, SizeEstimate, horizon_key

#: Prior standard deviations from which a parameter has moved far.
FAR = 2.5
#: s; the horizon that stands for all.
_TOLD = 2.0
#: Units of sizes as prose has them, with the factor to them.
_SIZES = {"1": ("", 1.0), "N*m": ("mN m", 1e3), "s": ("ms", 1e3), "kg": ("g", 1e3)}
#: nats within which two competitors are level.
_LEVEL = 3.0
#: Probability from which an answer is called sure, and likely.
_SURE, _LIKELY = 0.9, 0.7


def percent(share: float) -> str:
    """A share in per cent, without decimals."""
    return f"{100 * share:.0f} %".replace("-", "−")


def interval_words(interval: tuple[float, float]) -> str:
    """An interval of a share."""
    return f"{percent(interval[0])} to {percent(interval[1])}"


def effect_words(name: str) -> str:
    """An effect's name as prose has it."""
    words = name.replace("_", " ")
    return words.replace("coulomb", "Coulomb").replace("stribeck", "Stribeck")


def cause_words(effects: Sequence[str]) -> str:
    """A cause as a colleague calls it."""
    named = {
        "no_gap": "no gap",
        "parameters_only": "parameters only",
        "none_of_these": "none of these",
    }
    return " with ".join(named.get(name, effect_words(name)) for name in effects)


def size_words(sizes: Mapping[str, SizeEstimate]) -> str:
    """Sizes of a cause with their deviations; one without any was held where it is."""
    words = []
    for name, size in sizes.items():
        unit, scale = _SIZES.get(size.unit, (size.unit.replace("*", " "), 1.0))
        spread = f" ± {scale * size.sd:.2g}" if size.sd > 0 else ""
        words.append(f"{name.split('.', 1)[-1]} {scale * size.value:.3g}{spread} {unit}".rstrip())
    return ", ".join(words)


def confidence_words(diagnosis: Diagnosis) -> list[str]:
    """How sure the verdict is, and what it leaves open."""
    words = []
    first = max(diagnosis.causes, key=lambda cause: cause.probability, default=None)
    if first is not None:
        alike = _not_told_from(diagnosis, first)
        together = first.probability + sum(cause.probability for cause in alike)
        how = "Sure" if together >= _SURE else "Likely" if together >= _LIKELY else "Open"
        said = f"{cause_words(first.effects)} has a probability of **{percent(first.probability)}**"
        if alike:
            names = _listed([cause_words(cause.effects) for cause in alike], "or")
            said += f", **{percent(together)}** together with {names}"
        words.append(f"**{how}**: {said}{_runner_up(diagnosis, (first, *alike))}.")
    words += [
        f"These recordings do not tell {_effects(group)} apart; the next experiment below does."
        if diagnosis.next_experiment is not None
        else f"These recordings do not tell {_effects(group)} apart."
        for group in diagnosis.confusable
        if first is not None and set(group) & set(first.effects)
    ]
    if diagnosis.worse:
        words.append(f"**The correction made {_channels(diagnosis.worse)} worse** by over 2 %.")
    return words


def _not_told_from(diagnosis: Diagnosis, first: Cause) -> list[Cause]:
    """Causes that these recordings do not tell from the first one."""
    groups = [set(g) for g in diagnosis.confusable if set(g) & set(first.effects)]
    alike = set(first.effects).union(*groups)
    return [c for c in diagnosis.causes if c is not first and set(c.effects) <= alike]


def _runner_up(diagnosis: Diagnosis, before: Sequence[Cause]) -> str:
    others = [c for c in diagnosis.causes if all(c is not b for b in before)]
    second = max(others, key=lambda cause: cause.probability, default=None)
    if second is None or second.probability < 0.01:
        return ""
    return f"; next is {cause_words(second.effects)} with {percent(second.probability)}"


def _channels(names: Iterable[str]) -> str:
    from trms_cli.reporting.style import LABELS  # with the plotting library: not for a screen

    return _listed([LABELS.get(name, name) for name in names])


def _effects(names: Sequence[str]) -> str:
    return _listed([effect_words(name) for name in names])


def _listed(names: Sequence[str], word: str = "and") -> str:
    names = list(names)
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {word} {names[-1]}"


def where_words(diagnosis: Diagnosis) -> str:
    """The place with most of the gap."""
    first = max(diagnosis.where, key=lambda place: place.share)
    low = first.ci95[0]
    name = first.location.replace("_", " ")
    if first.share < 0.05:
        return "No place stands out: a free force at any of them closes next to nothing."
    words = (
        f"**{percent(first.share)}** of the gap (95 % interval: {interval_words(first.ci95)}) "
        f"lies in the {name}."
    )
    rivals = [
        place.location.replace("_", " ")
        for place in diagnosis.where
        if place is not first and place.ci95[1] >= low
    ]
    if rivals:
        words += f" The intervals of {_listed(rivals)} reach as far: the place is not certain."
    return words


def winner(diagnosis: Diagnosis) -> RaceEntry | None:
    """The competitor that is the likeliest answer; the best score where it is no effect."""
    named = [e for e in diagnosis.race if is_suspect(e.effects)]
    first = max(diagnosis.causes, key=lambda cause: cause.probability, default=None)
    for entry in named:
        if first is not None and entry.effects == first.effects:
            return entry
    return max(named, key=lambda entry: entry.score, default=None)


def is_corrected(diagnosis: Diagnosis) -> bool:
    """Whether the corrected model is another one than the refitted."""
    rows = [row for rows in diagnosis.gap.values() for row in rows.values()]
    return any(row.corrected != row.refit for row in rows)


def is_suspect(effects: Sequence[str]) -> bool:
    """Whether a competitor of the race consists of effects."""
    return bool(effects) and not set(effects) & {"flexible", *NO_EFFECT}


def race_words(diagnosis: Diagnosis) -> str:
    """Who won, by how much, and whether a force without a name did better."""
    best = winner(diagnosis)
    if best is None:
        return "No suspect ran."
    flexible = next((e for e in diagnosis.race if tuple(e.effects) == ("flexible",)), None)
    words = (
        f"{cause_words(best.effects)} foretells held-out blocks by {best.score:.0f} ± "
        f"{best.se:.0f} nats better than the refitted model."
    )
    words = words[0].upper() + words[1:]
    others = [e for e in diagnosis.race if is_suspect(e.effects) and e is not best]
    second = max(others, key=lambda entry: entry.score, default=None)
    if second is not None:
        name, apart = cause_words(second.effects), best.score - second.score
        if abs(apart) < _LEVEL:
            words += f" Level with it is {name}."
        elif apart > 0:
            words += f" Next is {name}, {apart:.0f} nats below."
        else:
            words += f" Above it is {name} by {-apart:.0f} nats, which has more to adjust."
    if flexible is not None:
        if flexible.score > best.score + 2 * (flexible.se + best.se):
            words += " **A force without a name does clearly better**: something else is missing."
        elif flexible.score <= best.score:
            words += " A force without a name, free to be anything, does no better."
    return words


def force_words(diagnosis: Diagnosis) -> str:
    """What the picture of the force shows."""
    words = (
        "What had to act on the model, beyond its equations, for it to follow the recordings: "
        "estimated without any suspect in mind."
    )
    if diagnosis.traces is not None and diagnosis.traces.explained:
        words += " In blue, what the cause that was found says this force is."
    return words


def gap_words(diagnosis: Diagnosis) -> str:
    """How far the gap shrinks, on data that nothing was chosen on."""
    words = "On a part of the recordings that was sealed: nothing was fitted or chosen on it."
    if not is_corrected(diagnosis):
        return f"{words} No cause was added, so the refitted model is all there is to show."
    rows = diagnosis.shrink.get("all", {})
    told = next((h for h in rows if horizon_key(h) == horizon_key(_TOLD)), None)
    shrink = rows[told] if told is not None else None
    if shrink is not None and shrink.fraction is not None and told is not None:
        words += f" Over {float(told):g} s the correction closes **{percent(shrink.fraction)}**"
        if shrink.ci95 is not None:
            words += f" (95 % interval: {interval_words(shrink.ci95)})"
        words += " of what the refit left above the floor."
    return words


def tests_words(diagnosis: Diagnosis) -> str:
    """How many tests see a gap."""
    seen = [test for test in diagnosis.tests if test.rejected]
    if not seen:
        return "None of the tests on the refitted model's one-step errors sees anything in them."
    channels = dict.fromkeys(test.channel for test in seen)
    return (
        f"{len(seen)} of {len(diagnosis.tests)} tests on the refitted model's one-step errors see "
        f"something that noise does not explain, in {_channels(channels)}."
    )
