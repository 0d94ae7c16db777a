"""Which experiment to make next: what each would record and tell, compared.

Each of a handful of open-loop experiments is simulated with the refitted model; along that motion
the traces of the effects asked after are projected and compared as those of the recordings are, in
nats.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.wording import listing
from trms_cli.gap.competing_model import CandidateFit, FittedModel, Metric, ModelStructure, Refit
from trms_cli.gap.diagnosis import NextExperiment, OpenLoopExperiment, PredictedExperiment
from trms_cli.gap.discrepancy import Discrepancy, TrajectoryLinearisation
from trms_cli.gap.experiments import command_line, experiments
from trms_cli.gap.gain_drift import gain_drift
from trms_cli.gap.problem import CandidateEffect
from trms_cli.gap.signatures import Signatures, effect_traces, project_traces
from trms_cli.identification.dataset import Dataset
from trms_cli.simulation.rollout import Rollout


def predicted_recordings(
    refit: Refit, shares: FloatArray, model_name: str, *, load: bool = False, rest: bool = False
) -> Iterator[tuple[OpenLoopExperiment, FittedModel]]:
    """Experiments, and what each records; angles stay in bounds before and after the refit.

    ``shares``, (n_d,) array: discrepancy to be reckoned with. ``model_name``: as a command takes
    it. ``load``: whether a long load is among them, for effects that need one. ``rest``: whether
    those are in which an axis often comes to rest.

    What is drawn is drawn anew for each recording that there is: commands that were played say the
    same again.
    """
    structure = refit.structure
    problem, rollout = structure.problem, structure.windows.rollout
    theta = refit.fit.theta
    p = problem.all_values(theta)
    linearisation: TrajectoryLinearisation | None = None
    step = structure.windows.sample_time
    both = (p, problem.model.parameters.values)
    seed = len(problem.datasets) - 1
    for experiment in experiments(rollout, both, step, model_name, load=load, rest=rest, seed=seed):
        dataset, starts = _simulate_recording(refit, rollout, p, experiment.commands)
        predicted_structure = ModelStructure(
            problem.model, problem.free, (), [dataset], problem.window_length
        )
        linearisation = linearisation or TrajectoryLinearisation(predicted_structure.windows)
        linearisation.windows = predicted_structure.windows
        discrepancy = Discrepancy(
            predicted_structure.windows,
            linearisation.along(p, starts),
            refit.metric.discrepancy.channels,
            start_share=0.0,
        )
        # it will be fitted beside the present recordings, and excused for as much as these are
        excused = shares * np.maximum(1.0, refit.metric.discrepancy.scales / discrepancy.scales)
        try:
            drift = gain_drift(predicted_structure.windows, discrepancy.trajectory)
            metric = Metric(discrepancy, excused, drift, refit.metric.drift_sizes, None)
        except FloatingPointError:  # along this motion the equations say too little
            continue
        fit = CandidateFit(theta, starts, np.zeros(len(drift.drive)))
        yield experiment, FittedModel(predicted_structure, fit, metric, starts)


def _simulate_recording(
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
    measurements = np.vstack(y)[:, columns]
    # an output that is not measured now will not be measured then
    measurements[:, np.isnan(sample.measurements).all(axis=0)] = np.nan
    measurements[:, ~np.isfinite(sample.noise_sd)] = np.nan
    dataset = replace(empty.part(0, used), measurements=np.ascontiguousarray(measurements))
    return dataset, np.array(starts)


#: Multiples of a fitted size at which an effect may imitate another: its trace changes its shape
#: with the size, and a fit would choose the size that imitates best.
_MULTIPLES = (1.0, 0.65, 1.5)
#: Rows of an effect whose size is not known.
_MOST_ROWS = 6
#: Squared length, in noise variances, below which a trace at a fitted size is nothing to compare.
_NOTHING = 1.0


def signatures(recording: FittedModel, candidates: Sequence[CandidateEffect]) -> Signatures:
    """Projected traces of some effects at their variants, in a recording made or predicted."""
    return project_traces(recording, effect_traces(recording, candidates))


def with_rows(candidate: CandidateEffect, values: Mapping[str, float]) -> CandidateEffect:
    """The candidate at its fitted sizes first, then about them; or at typical ones where unknown.

    ``values``: fitted values by name, ``<effect>.<size>``.
    """
    if not is_fitted(candidate, values):
        rows = candidate.variants
        indices = np.unique(np.linspace(0, len(rows) - 1, _MOST_ROWS).round().astype(int))
        return replace(candidate, variants=rows[indices])
    row = np.array([values[size.name] for size in candidate.free])
    lower = np.array([size.lower for size in candidate.free])
    upper = np.array([size.upper for size in candidate.free])
    # what vanishes at zero is scaled; a size that gives the shape stays as it was fitted
    is_scaled = np.array(
        [i == 0 or size.prior_mean == 0.0 for i, size in enumerate(candidate.free)]
    )
    every = [np.clip(np.where(is_scaled, row * by, row), lower, upper) for by in _MULTIPLES]
    return replace(candidate, variants=np.array(every))


def is_fitted(candidate: CandidateEffect, values: Mapping[str, float]) -> bool:
    """Whether a fit told all sizes of an effect."""
    return bool(candidate.free) and all(size.name in values for size in candidate.free)


def between(signs: Signatures, one: str, other: str, fitted_names: Sequence[str]) -> float:
    """Nats between two effects, the smaller of: one is true, or the other is.

    ``½ left (1 − cos²)``: what is left of the true one's trace when the other, its size free,
    imitates it as well as it can. The true one is taken at its fitted size, the first row, or at
    the median of those that are typical.
    """
    return min(
        _beyond(signs, one, other, one in fitted_names),
        _beyond(signs, other, one, other in fitted_names),
    )


def visibility(signs: Signatures, name: str, rows: Sequence[int] | None = None) -> float:
    """Nats by which an effect shows at the best of its rows (or of some of them)."""
    own_rows = signs.rows(name)
    if rows is not None:
        own_rows = own_rows[[row for row in rows if row < len(own_rows)]]
    return 0.5 * float(np.max(signs.projected_energy[own_rows])) if len(own_rows) else 0.0


def _beyond(signs: Signatures, true: str, imitator: str, at_fitted_size: bool) -> float:
    own, others = signs.rows(true), signs.rows(imitator)
    if not len(own):
        return 0.0
    # a trace cannot be turned round by its size: where it can, both signs are among the rows
    cosine = np.clip(signs.cosine[np.ix_(own, others)], 0.0, 1.0)
    alike = cosine.max(axis=1, initial=0.0)
    nats = 0.5 * signs.projected_energy[own] * (1 - alike**2)
    if at_fitted_size and signs.projected_energy[own[0]] > _NOTHING:
        return float(nats[0])
    return float(np.median(nats))


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
#: Of names of effects that show where an axis comes to rest and breaks away.
_OF_REST = ("coulomb_friction", "stribeck_friction", "hysteresis")
#: Share of the refit's discrepancy that is taken to be left once the cause is in the model.
_LEFT = 1 / 3


@dataclass(frozen=True)
class _Question:
    """What is to be found out."""

    candidates: tuple[CandidateEffect, ...]  #: With the rows that are simulated
    apart: bool  #: Whether they are to be told apart, the first from each other; else to be seen
    fitted_names: tuple[str, ...] = ()  #: Those whose first row is their fitted size
    #: Rows that the recordings do not show
    hidden_rows: Mapping[str, tuple[int, ...]] | None = None

    def worth(self, recording: FittedModel) -> tuple[float, ...]:
        """Nats that a recording gives for each thing asked, in the order asked."""
        signs = signatures(recording, self.candidates)
        names = [candidate.name for candidate in self.candidates]
        if self.apart:
            first = names[0]
            nats = [between(signs, first, other, self.fitted_names) for other in names[1:]]
            return (min(nats),)
        hidden_rows = self.hidden_rows or {}
        return tuple(visibility(signs, name, hidden_rows.get(name)) for name in names)


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
    (:mod:`trms_cli.gap.signatures`). A second or two on one core where the models of the effects
    are compiled, as they are after the race. None where no experiment can be predicted: in open
    loop the angles would not stay within their bounds at any amplitude.

    ``apart``: effects that cannot be told apart, the likeliest first; used where it names two or
    more. ``untested``: else these are to be made visible; the first three count. Where both are
    empty, the first of the candidates that the recordings hardly show are. ``values``: fitted sizes
    by name, ``<effect>.<size>``; the others are taken at typical sizes. ``shares``, (n_d,) array:
    discrepancy to be reckoned with; None: a third of the refit's, for most of that goes when the
    cause is in the model.
    """
    values = values or {}
    step = refit.structure.windows.sample_time
    apart_names = [name for name in apart if name in candidates]
    if len(apart_names) >= 2 and any(candidates[name].stochastic for name in apart_names):
        return _repetition_advice(apart_names, candidates, model_name, step)
    if shares is None:
        shares = np.maximum(refit.metric.discrepancy.floor, _LEFT * refit.metric.shares)
    present = replace(refit, metric=replace(refit.metric, shares=shares))
    question = _question(apart_names, untested, candidates, values, present)
    if question is None:
        return None
    now = question.worth(present)
    load, rest = (
        any(word in s.name for s in question.candidates for word in of)
        for of in (_OF_LOAD, _OF_REST)
    )
    predictions = [
        (question.worth(recording), experiment)
        for experiment, recording in predicted_recordings(
            refit, shares, model_name, load=load, rest=rest
        )
    ]
    if not predictions:
        return None
    best, experiment = max(
        predictions, key=lambda pair: sum(min(n, _ENOUGH) for n in pair[0]) + 1e-6 * sum(pair[0])
    )
    duration = sum(dataset.duration for dataset in refit.structure.problem.datasets)
    why = _why(question, now, best, experiment, duration, step, len(predictions))
    prediction = PredictedExperiment(
        experiment=experiment,
        apart=tuple(s.name for s in question.candidates) if question.apart else (),
        nats=min(best),
        longer=question.apart and min(best) * duration < min(now) * len(experiment.commands) * step,
    )
    return NextExperiment(why=why, command=experiment.command, prediction=prediction)


def _question(
    apart: Sequence[str],
    untested: Sequence[str],
    candidates: Mapping[str, CandidateEffect],
    values: Mapping[str, float],
    present: FittedModel,
) -> _Question | None:
    if len(apart) >= 2:
        selection = [candidates[name] for name in apart[:_AT_ONCE]]
        # what a fit made of one's special case says nothing of how the two differ
        for candidate in selection:
            if candidate.special_case(candidates) is not None:
                values = candidate.apart_from_special_case(values)
        rows = tuple(with_rows(candidate, values) for candidate in selection)
        return _Question(rows, True, tuple(s.name for s in selection if is_fitted(s, values)))
    names = [n for n in untested or candidates if n in candidates and not candidates[n].stochastic]
    if not names:
        return None
    selection = [candidates[name] for name in names]
    if untested:
        selection = selection[:_AT_ONCE]
    signs = signatures(present, selection)
    # where nothing was asked after, those that the recordings show least
    selection = sorted(selection, key=lambda candidate: visibility(signs, candidate.name))
    selection, hidden_rows = selection[:_AT_ONCE], {}
    for name in (s.name for s in selection):
        is_hidden = 0.5 * signs.projected_energy[signs.rows(name)] < VISIBLE
        if is_hidden.any():
            hidden_rows[name] = tuple(np.flatnonzero(is_hidden).tolist())
    return _Question(tuple(selection), False, (), hidden_rows)


def _repetition_advice(
    apart: Sequence[str], candidates: Mapping[str, CandidateEffect], model_name: str, step: float
) -> NextExperiment:
    noise = [name for name in apart if candidates[name].stochastic]
    rest = [name for name in apart if name not in noise]
    against = f" from {listing(rest)}" if rest else ""
    keys = ["excitation=multisine", "excitation.periods=4", "excitation.iterations=0"]
    return NextExperiment(
        why=f"a signal that repeats itself four times tells {listing(noise)}{against}: what "
        "returns with every period belongs to the rig, what does not comes from outside; how "
        "clearly was not predicted",
        command=command_line("excite", model_name, keys, step),
    )


def _why(
    question: _Question,
    now: tuple[float, ...],
    best: tuple[float, ...],
    experiment: OpenLoopExperiment,
    duration: float,
    step: float,
    count: int,
) -> str:
    names = [candidate.name for candidate in question.candidates]
    seconds = len(experiment.commands) * step
    if question.apart:
        pair = listing(names) if len(names) > 2 else " from ".join(names)
        gain = f"{_nats(best[0])} in {seconds:.0f} s, against {_nats(now[0])} in the "
        gain += f"{duration:.0f} s recorded"
        of_the_best = f"the command is that of the best, {experiment.words}: {gain}"
        if best[0] < DECIDES:
            return (
                f"none of {count} open-loop experiments tells {pair}, and no input of this kind "
                f"does; {of_the_best}, where {DECIDES:g} would be odds of 20 to 1"
            )
        if best[0] * duration < now[0] * seconds:
            return (
                "record longer, in the way of the present recording: none of "
                f"{count} open-loop experiments tells {pair} faster. Only if that cannot be done, "
                f"{of_the_best}"
            )
        return f"{experiment.words}: tells {pair} by {gain}"
    visible = [n for n, nats in zip(names, best, strict=True) if nats >= VISIBLE]
    by = ", ".join(
        f"{name} {_nats(then)} against {_nats(before)}"
        for name, then, before in zip(names, best, now, strict=True)
        if name in visible or not visible
    )
    if not visible:
        return (
            f"none of {count} open-loop experiments makes {listing(names)} visible at typical "
            f"sizes ({VISIBLE:g} nats); the command is that of the best, {experiment.words}: {by} "
            "in what is recorded"
        )
    invisible = [name for name in names if name not in visible]
    rest = f"; {listing(invisible)} would still not show" if invisible else ""
    return (
        f"{experiment.words}: makes visible at typical sizes, in {seconds:.0f} s: {by} in what is "
        f"recorded{rest}"
    )


def _nats(value: float) -> str:
    if value < 0.05:
        return "no nats"
    return f"{value:.2g} nats" if value < 10 else f"{value:.0f} nats"
