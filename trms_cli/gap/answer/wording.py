"""What is said in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from trms_cli.gap.answer.belief import Believed
from trms_cli.gap.candidates import Suspect
from trms_cli.gap.diagnosis import Cause, FittedParameter, LocationShare
from trms_cli.gap.race.contest import Contest
from trms_cli.gap.shrinkage import Measured

#: s. The horizon that a sentence tells.
_TOLD_AT = "2.0"
#: Times the floor from which on a refitted model is said to leave something unexplained.
_MUCH = 5.0


def sentence(
    believed: Believed,
    causes: Sequence[Cause],
    where: Sequence[LocationShare],
    measured: Measured,
    parameters: Mapping[str, FittedParameter],
) -> str:
    """What a colleague would say."""
    top = causes[0]
    place = f"the {_readable(where[0].location)}" if where else "no single place"
    if believed.verdict == "no_gap":
        return (
            "The model as it is explains these recordings down to their noise: no gap was found, "
            f"with probability {top.probability:.2f}."
        )
    if believed.verdict == "parameters_only":
        moved = sorted(
            (name for name, p in parameters.items() if p.moved is not None),
            key=lambda name: -abs(parameters[name].moved or 0.0),
        )
        return (
            "No effect is missing: other values of the parameters explain these recordings, with "
            f"probability {top.probability:.2f}; {', '.join(moved[:3])} moved most."
            + _left_over(measured)
        )
    if believed.verdict == "none_of_these":
        return (
            f"Something is missing that is none of the effects known here, with probability "
            f"{top.probability:.2f}; it acts mostly on {place}."
        )
    if believed.verdict == "undecided":
        listed = ", ".join(
            f"{_joined(c.effects)} ({c.probability:.2f})"
            for c in causes[:3]
            if c.probability > 0.05
        )
        return f"These recordings do not decide what causes the gap: {listed}."
    sizes = ", ".join(
        f"{key.split('.', 1)[1]} {size.value:.3g} ± {size.sd:.1g} {size.unit.replace('*', ' ')}"
        for key, size in list(top.parameters.items())[:3]
    )
    text = (
        f"The gap lies in {place}, and {_joined(top.effects)} causes it, with probability "
        f"{top.probability:.2f}" + (f" ({sizes})" if sizes else "")
    )
    if not top.parameters:  # from outside: it can be allowed for, and nothing can be added
        return text + "; it is estimated, not explained: the corrected model is the refitted one."
    shrink = measured.shrink.get("all", {}).get(_TOLD_AT)
    if shrink is not None and shrink.fraction is not None:
        text += f"; adding it closes {100 * shrink.fraction:.0f} % of the gap at 2 s"
        if shrink.ci95 is not None:
            text += f" ({100 * shrink.ci95[0]:.0f} to {100 * shrink.ci95[1]:.0f} %)"
    others = sorted({n for g in believed.confusable for n in g} - set(top.effects))
    if others:
        text += f". These recordings do not tell it from {_joined(others, 'or')}"
    return text + "."


def _left_over(measured: Measured) -> str:
    """What the refitted model still lacks on the sealed part, where that is much.

    The verdict compares causes on the part that was fitted. A short recording can be fitted by
    parameters that do not hold afterwards; who reads "parameters" has to be told.
    """
    shares = {
        channel: (gaps[_TOLD_AT].refit / gaps[_TOLD_AT].floor, gaps[_TOLD_AT])
        for channel, gaps in measured.gap.items()
        if _TOLD_AT in gaps and gaps[_TOLD_AT].floor > 0
    }
    worst = max(shares, key=lambda channel: shares[channel][0], default="")
    if not worst or shares[worst][0] < _MUCH:
        return ""
    ratio, gap = shares[worst]
    return (
        f" But on the part kept aside they leave {worst} off by {gap.refit:.2g} {gap.unit} at 2 s, "
        f"{ratio:.0f} times what the noise explains: do not rely on this, and record longer."
    )


def why_not_testable(raced: Contest, suspect: Suspect) -> str:
    """Why recordings say nothing on an effect."""
    signs = raced.signatures
    rows = signs.rows(suspect.name)
    raw = float(np.sqrt(np.max(signs.energy[rows])))
    absorbed = signs.absorbed(suspect.name)
    if raw < 5.0:
        return (
            "what it does was not excited: at several times its typical size it would change the "
            f"outputs by {raw:.1f} standard deviations of the noise"
        )
    return (
        f"the nominal parameters can do {100 * absorbed:.1f} % of what it does within their "
        "priors, and the rest is below the noise"
    )


def _readable(name: str) -> str:
    words = name.replace("_", " ")
    return words.replace("coulomb", "Coulomb").replace("stribeck", "Stribeck")


def _joined(names: Sequence[str], word: str = "and") -> str:
    readable = [_readable(name) for name in names]
    if len(readable) < 2:
        return "".join(readable)
    return f"{', '.join(readable[:-1])} {word} {readable[-1]}"
