"""What a colleague would say of a diagnosis, in a sentence or two."""

from collections.abc import Sequence

from trms_cli.core.wording import gap_share, listing, number, quantity, readable, signal, small_unit
from trms_cli.gap.diagnosis import Cause, LocationShare, MovedParameter
from trms_cli.gap.posterior import Posterior
from trms_cli.gap.shrinkage import Shrinkage
from trms_cli.gap.wording import ELSEWHERE, effects_text, probability_text, sizes

#: Probability from which a cause that is not told apart is worth its name.
LEAST_ALIKE = 0.01
#: Parameters that a sentence names.
_MOVED_TOLD = 3
#: Times the floor from which on a refitted model is said to leave something unexplained.
_MUCH = 5.0
#: The same of a corrected model over the longest free runs, which show what a cause leaves.
_STILL = 3.0
#: Times the floor up to which a model without a gap is at it.
_LITTLE = 1.2


def sentence(
    posterior: Posterior,
    causes: Sequence[Cause],
    where: Sequence[LocationShare],
    shrinkage: Shrinkage,
    moved_parameters: Sequence[MovedParameter] = (),
    law: Sequence[str] = (),
    *,
    other_form: bool = False,
) -> str:
    """What a colleague would say.

    ``law``: of a residual without a name. ``other_form``: whether the model's own laws were
    refitted, too.
    """
    top = causes[0]
    place = f"the {readable(where[0].location)}" if where else "no single place"
    if posterior.verdict == "no_gap":
        return (
            "No gap was found, with probability "
            f"{probability_text(top.probability)}: the model as it is needs neither an effect nor "
            "other parameters to explain these recordings." + _above_floor(shrinkage)
        )
    if posterior.verdict == "parameters_only":
        which = listing([item.words for item in moved_parameters[:_MOVED_TOLD]])
        return (
            "No effect is missing: other values of the parameters"
            + (" and laws of another form" if other_form else "")
            + " explain these recordings, with "
            f"probability {probability_text(top.probability)}"
            + (f"; what moved is likeliest the {which}." if which else ".")
            + _remaining_error(shrinkage)
        )
    if posterior.verdict == "none_of_these":
        return (
            f"Something is missing that is none of the effects known here, with probability "
            f"{probability_text(top.probability)}; it acts mostly on {place}."
            + "".join(f" {w}" for w in law[:1])
        )
    if posterior.verdict == "undecided":
        causes_text = ", ".join(
            f"{effects_text(c.effects)} ({probability_text(c.probability)})"
            for c in causes[:3]
            if c.probability > 0.05
        )
        size = ", or how large it is" if top.open_sizes else ""
        text = f"These recordings do not decide what causes the gap{size}: {causes_text}."
        if top.open_sizes:  # searches from several points disagree about them
            several = f"several sizes fit equally well: {sizes(top.open_sizes)}."
            text += f" Of {effects_text(top.effects)} {several}"
        return text
    sizes_text = sizes(dict(list(top.parameters.items())[:3]))
    causes_it = "causes it" if len(top.effects) == 1 else "cause it"
    text = (
        f"The gap lies in {place}, and {effects_text(top.effects)} {causes_it}, with probability "
        f"{probability_text(top.probability)}" + (f" ({sizes_text})" if sizes_text else "")
    )
    if not top.parameters:  # from outside: it can be allowed for, and nothing can be added
        return text + "; it is estimated, not explained: the corrected model is the refitted one."
    shrink = shrinkage.shrink.get("all", {}).get(shrinkage.told_at)
    if shrink is not None and shrink.fraction is not None:
        of = f"of the gap at {_seconds(shrinkage)}"
        closes = f"nothing {of}"
        if shrink.fraction > 0:
            closes = gap_share(shrink.fraction, shrink.ci95, of, ELSEWHERE)
        text += f"; on data kept aside, adding it closes {closes}"
    likely = {n for cause in causes if cause.probability >= LEAST_ALIKE for n in cause.effects}
    alike = {name for group in posterior.confusable for name in group}
    others = sorted((alike & likely) - set(top.effects))
    if others:
        text += f". These recordings do not tell it from {effects_text(others, 'or')}"
    return text + "." + _still_missing(shrinkage)


def _remaining_error(shrinkage: Shrinkage) -> str:
    """What the refitted model still lacks on the sealed part, where that is much.

    The verdict compares causes on the part that was fitted. A short recording can be fitted by
    parameters that do not hold afterwards; who reads "parameters" has to be told.
    """
    worst, ratio = _farthest(shrinkage, "refit")
    if ratio < _MUCH:
        return ""
    gap, at = shrinkage.gap[worst][shrinkage.told_at], _seconds(shrinkage)
    return (
        f" But on the part kept aside they leave {worst} off by {gap.refit:.2g} {gap.unit} at "
        f"{at}, {ratio:.0f} times what the noise explains: do not rely on this, and record longer."
    )


def _still_missing(shrinkage: Shrinkage) -> str:
    """What the corrected model still lacks on the sealed part, where that is much."""
    at = max((h for gaps in shrinkage.gap.values() for h in gaps), key=float, default="")
    worst, ratio = _farthest(shrinkage, "corrected", at)
    if ratio < _STILL:
        return ""
    gap = shrinkage.gap[worst][at]
    small, scale = small_unit(gap.unit)
    return (
        f" It is not all: over {number(float(at))} s {signal(worst)} is still off by "
        f"{quantity(scale * gap.corrected, small)}, {ratio:.0f} times what the noise explains."
    )


def _above_floor(shrinkage: Shrinkage) -> str:
    """By how much free runs of a model without a gap err beyond the noise, and why it is none.

    The verdict weighs errors of one step, and the floor knows only the sensors' noise.
    """
    worst, ratio = _farthest(shrinkage, "raw")
    if ratio < _LITTLE:
        return ""
    gap = shrinkage.gap[worst][shrinkage.told_at]
    small, scale = small_unit(gap.unit)
    errors = (
        f"{signal(worst)}, {number(scale * gap.raw)} against {quantity(scale * gap.floor, small)}"
    )
    times = f"{ratio:.1f} times what the sensors' noise alone makes"
    text = f" Over {_seconds(shrinkage)} it errs by up to {times}"
    if ratio < _MUCH:
        return f"{text} ({errors}): errors of its equations so small are usual and count as no gap."
    return f"{text} ({errors}): do not rely on this, and record longer."


def _seconds(shrinkage: Shrinkage) -> str:
    return f"{float(shrinkage.told_at):g} s"


def _farthest(shrinkage: Shrinkage, model: str, at: str = "") -> tuple[str, float]:
    """The channel whose free runs lie farthest above the floor, and how many times.

    ``at``: horizon; empty for that which stands for all.
    """
    at = at or shrinkage.told_at
    ratios = {
        channel: getattr(gaps[at], model) / gaps[at].floor
        for channel, gaps in shrinkage.gap.items()
        if at in gaps and gaps[at].floor > 0
    }
    worst = max(ratios, key=lambda channel: ratios[channel], default="")
    return worst, ratios.get(worst, 0.0)
