"""Which experiment to make next: candidates are simulated, and judged as a recording is judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.gap.advice.experiments import Experiment, periodic
from trms_cli.gap.advice.imagined import imagined
from trms_cli.gap.advice.separation import (
    Recording,
    between,
    is_fitted,
    visibility,
    with_rows,
)
from trms_cli.gap.candidates import Suspect
from trms_cli.gap.diagnosis import NextExperiment
from trms_cli.gap.fitting.metric import Metric
from trms_cli.gap.innovations.sizes import FLOOR
from trms_cli.gap.race.nominal import Refit

FloatArray = npt.NDArray[np.float64]

#: Effects that are asked after at a time.
_AT_ONCE = 3
#: Nats that decide between two: odds of 20 to 1. Below, an experiment separates nothing.
DECIDES = 3.0
#: Nats at which an effect is visible: five standard deviations, as for what is testable.
VISIBLE = 12.5
#: Nats beyond which more does not count when several effects are to be served.
_ENOUGH = 10 * VISIBLE
#: Of names of effects that need a long load, or a beam that hangs low, to show.
_OF_LOAD = ("derating", "ground")
#: Share of the refit's discrepancy that is taken to be left once the cause is in the model.
_LEFT = 1 / 3


@dataclass(frozen=True)
class _Worth:
    """What a recording is worth: nats for each thing asked, in the order asked."""

    nats: tuple[float, ...]

    @property
    def score(self) -> float:
        return sum(min(value, _ENOUGH) for value in self.nats) + 1e-6 * sum(self.nats)


@dataclass(frozen=True)
class _Question:
    """What is to be found out."""

    suspects: tuple[Suspect, ...]  #: With the rows that are simulated
    apart: bool  #: Whether they are to be told apart, the first from each other; else to be seen
    fitted: tuple[str, ...] = ()  #: Those whose first row is their fitted size
    #: Rows of each that the present recordings do not show
    hidden: Mapping[str, tuple[int, ...]] | None = None

    def worth(self, recording: Recording) -> _Worth:
        signs = recording.signatures(self.suspects)
        names = [suspect.name for suspect in self.suspects]
        if self.apart:
            first = names[0]
            nats = [between(signs, first, other, self.fitted) for other in names[1:]]
            return _Worth((min(nats),))
        hidden = self.hidden or {}
        return _Worth(tuple(visibility(signs, name, hidden.get(name)) for name in names))


def advise(
    *,
    refit: Refit,
    suspects: Mapping[str, Suspect],
    model_name: str,
    apart: Sequence[str] = (),
    untested: Sequence[str] = (),
    values: Mapping[str, float] | None = None,
    shares: FloatArray | None = None,
) -> NextExperiment | None:
    """The best of a handful of open-loop experiments, and what it promises.

    Each is simulated with the refitted model; along that motion the traces of the effects asked
    after are projected and compared as those of the recordings are
    (:mod:`trms_cli.gap.separability`). A second or two on one core where the models of the effects
    are compiled, as they are after the race.

    Parameters
    ----------
    refit : Refit
        Of the nominal model on the recordings: its model, datasets, values, discrepancy. The
        model object is the one that the race used, so that nothing is compiled again.
    suspects : dict of str to Suspect
        All that are known, by name.
    model_name : str
        As the user named the model, for the command.
    apart : sequence of str
        Effects that cannot be told apart, the likeliest first. Used where it names two or more.
    untested : sequence of str
        Else these are to be made visible; the first three count. Where both are empty, the first
        of the suspects that the recordings hardly show are.
    values : dict of str to float or None
        Fitted sizes by name, ``<effect>.<size>``, of those that were fitted; the others are taken
        at typical sizes. Other names are ignored.
    shares : (n_d,) array or None
        Discrepancy to be reckoned with; None: a third of the refit's, for most of that goes when
        the cause is in the model.

    Returns
    -------
    NextExperiment or None
        None where no experiment can be predicted: in open loop the angles would not stay within
        their bounds at any amplitude.
    """
    values = values or {}
    step = refit.contestant.windows.sample_time
    known = [name for name in apart if name in suspects]
    if len(known) >= 2 and any(suspects[name].stochastic for name in known):
        return _repeated(known, suspects, model_name, step)
    if shares is None:
        shares = np.maximum(FLOOR, _LEFT * refit.metric.shares)
    metric = Metric(refit.metric.discrepancy, shares, refit.metric.robust)
    present = Recording(refit.contestant, refit.fit, metric, refit.centres)
    question = _asked(known, untested, suspects, values, present)
    if question is None:
        return None
    now = question.worth(present)
    found = [
        (question.worth(recording), experiment)
        for experiment, recording in imagined(refit, shares, model_name, load=_needs_load(question))
    ]
    if not found:
        return None
    best, experiment = max(found, key=lambda pair: pair[0].score)
    lasted = sum(dataset.duration for dataset in refit.contestant.problem.datasets)
    why = _why(question, now, best, experiment, lasted, step, len(found))
    return NextExperiment(why=why, command=experiment.command)


def _asked(
    apart: Sequence[str],
    untested: Sequence[str],
    suspects: Mapping[str, Suspect],
    values: Mapping[str, float],
    present: Recording,
) -> _Question | None:
    if len(apart) >= 2:
        chosen = [suspects[name] for name in apart[:_AT_ONCE]]
        rows = tuple(with_rows(suspect, values) for suspect in chosen)
        return _Question(rows, True, tuple(s.name for s in chosen if is_fitted(s, values)))
    seen = [n for n in (untested or suspects) if n in suspects and not suspects[n].stochastic]
    if not seen:
        return None
    chosen = [suspects[name] for name in seen]
    if untested:
        chosen = chosen[:_AT_ONCE]
    signs = present.signatures(chosen)
    # where nothing was asked after, those that the recordings show least
    chosen = sorted(chosen, key=lambda suspect: visibility(signs, suspect.name))[:_AT_ONCE]
    hidden = {
        s.name: tuple(np.flatnonzero(0.5 * signs.left[signs.rows(s.name)] < VISIBLE).tolist())
        for s in chosen
    }
    return _Question(
        tuple(chosen), False, (), {name: rows for name, rows in hidden.items() if rows}
    )


def _needs_load(question: _Question) -> bool:
    return any(word in s.name for s in question.suspects for word in _OF_LOAD)


def _repeated(
    apart: Sequence[str], suspects: Mapping[str, Suspect], model_name: str, step: float
) -> NextExperiment:
    noise = [name for name in apart if suspects[name].stochastic]
    rest = [name for name in apart if name not in noise]
    against = f" from {_and(rest)}" if rest else ""
    return NextExperiment(
        why=f"a signal that repeats itself four times tells {_and(noise)}{against}: what returns "
        "with every period belongs to the rig, what does not comes from outside; how clearly was "
        "not predicted",
        command=periodic(model_name, step),
    )


def _why(
    question: _Question,
    now: _Worth,
    best: _Worth,
    experiment: Experiment,
    lasted: float,
    step: float,
    tried: int,
) -> str:
    names = [suspect.name for suspect in question.suspects]
    seconds = len(experiment.commands) * step
    if question.apart:
        pair = _and(names) if len(names) > 2 else " from ".join(names)
        told = f"{_nats(best.nats[0])} in {seconds:.0f} s, against {_nats(now.nats[0])} in the "
        told += f"{lasted:.0f} s recorded"
        if best.nats[0] < DECIDES:
            return (
                f"none of {tried} open-loop experiments tells {pair}: the best, "
                f"{experiment.words}, promises {told}, and {DECIDES:g} would be odds of 20 to 1; "
                "no input of this kind tells them apart"
            )
        if best.nats[0] * lasted < now.nats[0] * seconds:
            return (
                f"none of {tried} open-loop experiments tells {pair} faster than a longer "
                f"recording like the present one; the best, {experiment.words}, promises {told}"
            )
        return f"{experiment.words}: tells {pair} by {told}"
    shown = [n for n, nats in zip(names, best.nats, strict=True) if nats >= VISIBLE]
    by = ", ".join(
        f"{name} {_nats(then)} against {_nats(before)}"
        for name, then, before in zip(names, best.nats, now.nats, strict=True)
        if name in shown or not shown
    )
    if not shown:
        return (
            f"none of {tried} open-loop experiments makes {_and(names)} visible at typical sizes "
            f"({VISIBLE:g} nats): the best, {experiment.words}, promises {by} in what is recorded"
        )
    left = [name for name in names if name not in shown]
    rest = f"; {_and(left)} would still not show" if left else ""
    return (
        f"{experiment.words}: makes visible at typical sizes, in {seconds:.0f} s: {by} in what is "
        f"recorded{rest}"
    )


def _nats(value: float) -> str:
    if value < 0.05:
        return "no nats"
    return f"{value:.2g} nats" if value < 10 else f"{value:.0f} nats"


def _and(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]
