"""Which experiment to make next: what the refitted model says that each would record, compared.

Each of a handful of open-loop experiments is simulated; along that motion the traces of the effects
asked after are projected and compared as those of the recordings are, in nats.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.wording import listing
from trms_cli.gap.candidates import CandidateEffect
from trms_cli.gap.diagnosis import NextExperiment
from trms_cli.gap.discrepancy import FLOOR, Discrepancy, TrajectoryLinearisation
from trms_cli.gap.experiments import OpenLoopExperiment, experiments, periodic
from trms_cli.gap.fitting import CandidateFit, Metric, ModelStructure
from trms_cli.gap.refit import Refit
from trms_cli.gap.separability import Signatures, effect_traces, projected
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.method import FitOutcome
from trms_cli.simulation.rollout import Rollout

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
class _Question:
    """What is to be found out."""

    candidates: tuple[CandidateEffect, ...]  #: With the rows that are simulated
    apart: bool  #: Whether they are to be told apart, the first from each other; else to be seen
    fitted: tuple[str, ...] = ()  #: Those whose first row is their fitted size
    #: Rows of each that the present recordings do not show
    hidden: Mapping[str, tuple[int, ...]] | None = None

    def worth(self, recording: ProjectedRecording) -> tuple[float, ...]:
        """Nats that a recording gives for each thing asked, in the order asked."""
        signs = recording.signatures(self.candidates)
        names = [candidate.name for candidate in self.candidates]
        if self.apart:
            first = names[0]
            nats = [between(signs, first, other, self.fitted) for other in names[1:]]
            return (min(nats),)
        hidden = self.hidden or {}
        return tuple(visibility(signs, name, hidden.get(name)) for name in names)


def advise(
    *,
    refit: Refit,
    candidates: Mapping[str, CandidateEffect],
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
    candidates : dict of str to CandidateEffect
        All that are known, by name.
    model_name : str
        As the user named the model, for the command.
    apart : sequence of str
        Effects that cannot be told apart, the likeliest first. Used where it names two or more.
    untested : sequence of str
        Else these are to be made visible; the first three count. Where both are empty, the first
        of the candidates that the recordings hardly show are.
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
    step = refit.structure.windows.sample_time
    known = [name for name in apart if name in candidates]
    if len(known) >= 2 and any(candidates[name].stochastic for name in known):
        return _repeated(known, candidates, model_name, step)
    if shares is None:
        shares = np.maximum(FLOOR, _LEFT * refit.metric.shares)
    metric = Metric(refit.metric.discrepancy, shares, refit.metric.robust)
    present = ProjectedRecording(refit.structure, refit.fit, metric, refit.centres)
    question = _question(known, untested, candidates, values, present)
    if question is None:
        return None
    now = question.worth(present)
    found = [
        (question.worth(recording), experiment)
        for experiment, recording in predicted_recordings(
            refit, shares, model_name, load=_needs_load(question)
        )
    ]
    if not found:
        return None
    best, experiment = max(
        found, key=lambda pair: sum(min(n, _ENOUGH) for n in pair[0]) + 1e-6 * sum(pair[0])
    )
    lasted = sum(dataset.duration for dataset in refit.structure.problem.datasets)
    why = _why(question, now, best, experiment, lasted, step, len(found))
    return NextExperiment(why=why, command=experiment.command)


def _question(
    apart: Sequence[str],
    untested: Sequence[str],
    candidates: Mapping[str, CandidateEffect],
    values: Mapping[str, float],
    present: ProjectedRecording,
) -> _Question | None:
    if len(apart) >= 2:
        chosen = [candidates[name] for name in apart[:_AT_ONCE]]
        rows = tuple(with_rows(candidate, values) for candidate in chosen)
        return _Question(rows, True, tuple(s.name for s in chosen if is_fitted(s, values)))
    seen = [n for n in (untested or candidates) if n in candidates and not candidates[n].stochastic]
    if not seen:
        return None
    chosen = [candidates[name] for name in seen]
    if untested:
        chosen = chosen[:_AT_ONCE]
    signs = present.signatures(chosen)
    # where nothing was asked after, those that the recordings show least
    chosen = sorted(chosen, key=lambda candidate: visibility(signs, candidate.name))[:_AT_ONCE]
    hidden = {
        s.name: tuple(np.flatnonzero(0.5 * signs.left[signs.rows(s.name)] < VISIBLE).tolist())
        for s in chosen
    }
    return _Question(
        tuple(chosen), False, (), {name: rows for name, rows in hidden.items() if rows}
    )


def _needs_load(question: _Question) -> bool:
    return any(word in s.name for s in question.candidates for word in _OF_LOAD)


def _repeated(
    apart: Sequence[str], candidates: Mapping[str, CandidateEffect], model_name: str, step: float
) -> NextExperiment:
    noise = [name for name in apart if candidates[name].stochastic]
    rest = [name for name in apart if name not in noise]
    against = f" from {listing(rest)}" if rest else ""
    return NextExperiment(
        why=f"a signal that repeats itself four times tells {listing(noise)}{against}: what "
        "returns with every period belongs to the rig, what does not comes from outside; how "
        "clearly was not predicted",
        command=periodic(model_name, step),
    )


def _why(
    question: _Question,
    now: tuple[float, ...],
    best: tuple[float, ...],
    experiment: OpenLoopExperiment,
    lasted: float,
    step: float,
    tried: int,
) -> str:
    names = [candidate.name for candidate in question.candidates]
    seconds = len(experiment.commands) * step
    if question.apart:
        pair = listing(names) if len(names) > 2 else " from ".join(names)
        told = f"{_nats(best[0])} in {seconds:.0f} s, against {_nats(now[0])} in the "
        told += f"{lasted:.0f} s recorded"
        if best[0] < DECIDES:
            return (
                f"none of {tried} open-loop experiments tells {pair}: the best, "
                f"{experiment.words}, promises {told}, and {DECIDES:g} would be odds of 20 to 1; "
                "no input of this kind tells them apart"
            )
        if best[0] * lasted < now[0] * seconds:
            return (
                f"none of {tried} open-loop experiments tells {pair} faster than a longer "
                f"recording like the present one; the best, {experiment.words}, promises {told}"
            )
        return f"{experiment.words}: tells {pair} by {told}"
    shown = [n for n, nats in zip(names, best, strict=True) if nats >= VISIBLE]
    by = ", ".join(
        f"{name} {_nats(then)} against {_nats(before)}"
        for name, then, before in zip(names, best, now, strict=True)
        if name in shown or not shown
    )
    if not shown:
        return (
            f"none of {tried} open-loop experiments makes {listing(names)} visible at typical "
            f"sizes ({VISIBLE:g} nats): the best, {experiment.words}, promises {by} in what is "
            "recorded"
        )
    left = [name for name in names if name not in shown]
    rest = f"; {listing(left)} would still not show" if left else ""
    return (
        f"{experiment.words}: makes visible at typical sizes, in {seconds:.0f} s: {by} in what is "
        f"recorded{rest}"
    )


def _nats(value: float) -> str:
    if value < 0.05:
        return "no nats"
    return f"{value:.2g} nats" if value < 10 else f"{value:.0f} nats"


def predicted_recordings(
    refit: Refit, shares: FloatArray, model_name: str, *, load: bool = False
) -> Iterator[tuple[OpenLoopExperiment, ProjectedRecording]]:
    """Experiments, and what each records; angles stay in bounds before and after the refit.

    ``shares``, (n_d,) array: discrepancy to be reckoned with. ``model_name``: as a command takes
    it. ``load``: whether a long load is among them, for effects that need one.
    """
    structure = refit.structure
    problem, rollout = structure.problem, structure.windows.rollout
    theta = refit.fit.theta
    p = problem.all_values(theta)
    linearisation: TrajectoryLinearisation | None = None
    step = structure.windows.sample_time
    both = (p, problem.model.parameters.values)
    for experiment in experiments(rollout, both, step, model_name, load=load):
        dataset, starts = _recorded(refit, rollout, p, experiment.commands)
        made = ModelStructure(problem.model, problem.free, (), [dataset], problem.window_length)
        linearisation = linearisation or TrajectoryLinearisation(made.windows)
        linearisation.windows = made.windows
        discrepancy = Discrepancy(
            made.windows,
            linearisation.along(p, starts),
            refit.metric.discrepancy.channels,
            start_share=0.0,
        )
        fit = CandidateFit(theta, starts, 0.0, FitOutcome.CONVERGED)
        try:
            metric = Metric(discrepancy, shares, None)
        except FloatingPointError:  # along this motion the equations say too little
            continue
        yield experiment, ProjectedRecording(made, fit, metric, starts)


def _recorded(
    refit: Refit, rollout: Rollout, p: FloatArray, commands: FloatArray
) -> tuple[Dataset, FloatArray]:
    """The outputs of a rig that is as the refitted model says, and the states at block starts.

    Its noise is declared but not drawn: what traces are compared by is its size.
    """
    problem = refit.structure.problem
    model, sample = problem.model, problem.datasets[0]
    n = len(commands)
    outputs = [signal.name for signal in model.outputs]
    columns = [outputs.index(signal.name) for signal in sample.outputs]
    empty = Dataset(
        "next",
        "",
        "",
        refit.structure.windows.sample_time,
        np.arange(n, dtype=np.float64) * refit.structure.windows.sample_time,
        sample.inputs,
        sample.outputs,
        np.ascontiguousarray(commands),
        np.zeros((n, len(columns))),
        sample.noise_sd,
    )
    first, count = empty.windows(problem.window_length)
    x = rollout.initial(model.rest(), commands[0])
    starts, y = [], []
    for begin, length in zip(first, count, strict=True):
        starts.append(x[: model.n_x])
        part = rollout.outputs(commands, [begin], [length], x[None], p)
        y.append(part.y)
        x = part.ends[0]
    used = int(first[-1] + count[-1])
    measured = np.vstack(y)[:, columns]
    # an output that is not measured now will not be measured then
    measured[:, np.isnan(sample.measurements).all(axis=0)] = np.nan
    measured[:, ~np.isfinite(sample.noise_sd)] = np.nan
    return replace(empty.part(0, used), measurements=np.ascontiguousarray(measured)), np.array(
        starts
    )


#: Multiples of a fitted size at which an effect may imitate another: its trace changes its shape
#: with the size, and a fit would choose the size that imitates best.
_MULTIPLES = (1.0, 0.65, 1.5)
#: Rows of an effect whose size is not known.
_MOST_ROWS = 6
#: Squared length, in noise variances, below which a trace at a fitted size is nothing to compare.
_NOTHING = 1.0


@dataclass(frozen=True)
class ProjectedRecording:
    """A recording, made or predicted, with all that traces are projected in."""

    structure: ModelStructure  #: Of the nominal model
    fit: CandidateFit
    metric: Metric
    centres: FloatArray  #: (m, n_x) array

    def signatures(self, candidates: Sequence[CandidateEffect]) -> Signatures:
        """Projected traces of some effects at their variants."""
        problem = self.structure.problem

        def structure_of(candidate: CandidateEffect) -> ModelStructure:
            return ModelStructure(
                problem.model, problem.free, [candidate], problem.datasets, problem.window_length
            )

        traced = effect_traces(self.structure, self.fit, candidates, structure_of)
        return projected(self.structure, self.fit, self.metric, self.centres, traced)


def with_rows(candidate: CandidateEffect, values: Mapping[str, float]) -> CandidateEffect:
    """The candidate at its fitted sizes first, then about them; or at typical ones where unknown.

    ``values``: fitted values by name, ``<effect>.<size>``.
    """
    if not is_fitted(candidate, values):
        rows = candidate.variants
        chosen = np.unique(np.linspace(0, len(rows) - 1, _MOST_ROWS).round().astype(int))
        return replace(candidate, variants=rows[chosen])
    row = np.array([values[size.name] for size in candidate.free])
    lower = np.array([size.lower for size in candidate.free])
    upper = np.array([size.upper for size in candidate.free])
    # what vanishes at zero is scaled; a size that gives the shape stays as it was fitted
    scaled = np.array([i == 0 or size.prior_mean == 0.0 for i, size in enumerate(candidate.free)])
    every = [np.clip(np.where(scaled, row * by, row), lower, upper) for by in _MULTIPLES]
    return replace(candidate, variants=np.array(every))


def is_fitted(candidate: CandidateEffect, values: Mapping[str, float]) -> bool:
    """Whether a fit told all sizes of an effect."""
    return bool(candidate.free) and all(size.name in values for size in candidate.free)


def between(signs: Signatures, one: str, other: str, fitted: Sequence[str]) -> float:
    """Nats between two effects, the smaller of: one is true, or the other is.

    ``½ left (1 − cos²)``: what is left of the true one's trace when the other, its size free,
    imitates it as well as it can. The true one is taken at its fitted size, the first row, or at
    the median of those that are typical.
    """
    return min(
        _beyond(signs, one, other, one in fitted), _beyond(signs, other, one, other in fitted)
    )


def visibility(signs: Signatures, name: str, rows: Sequence[int] | None = None) -> float:
    """Nats by which an effect shows at the best of its rows (or of some of them)."""
    chosen = signs.rows(name)
    if rows is not None:
        chosen = chosen[[row for row in rows if row < len(chosen)]]
    return 0.5 * float(np.max(signs.left[chosen])) if len(chosen) else 0.0


def _beyond(signs: Signatures, true: str, imitator: str, fitted: bool) -> float:
    own, others = signs.rows(true), signs.rows(imitator)
    if not len(own):
        return 0.0
    # a trace cannot be turned round by its size: where it can, both signs are among the rows
    cosine = np.clip(signs.cosine[np.ix_(own, others)], 0.0, 1.0)
    alike = cosine.max(axis=1, initial=0.0)
    nats = 0.5 * signs.left[own] * (1 - alike**2)
    if fitted and signs.left[own[0]] > _NOTHING:
        return float(nats[0])
    return float(np.median(nats))
