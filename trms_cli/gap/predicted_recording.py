"""What an experiment would record, as the refitted model says, and what that tells of effects.

Along the simulated motion the traces of effects are projected and compared as those of the
recordings are, in nats.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.gap.competing_model import CandidateFit, FittedModel, Metric, ModelStructure, Refit
from trms_cli.gap.diagnosis import OpenLoopExperiment
from trms_cli.gap.discrepancy import Discrepancy, TrajectoryLinearisation
from trms_cli.gap.experiments import experiments
from trms_cli.gap.gain_drift import gain_drift
from trms_cli.gap.problem import CandidateEffect
from trms_cli.gap.signatures import Signatures, effect_traces, project_traces
from trms_cli.identification.dataset import Dataset
from trms_cli.simulation.rollout import Rollout


def predicted_recordings(
    refit: Refit,
    shares: FloatArray,
    model_name: str,
    *,
    load: bool = False,
    rest: bool = False,
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
        yield (
            experiment,
            FittedModel(
                predicted_structure,
                CandidateFit(theta, starts, np.zeros(len(drift.drive))),
                metric,
                starts,
            ),
        )


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
    return replace(empty.part(0, used), measurements=np.ascontiguousarray(measurements)), np.array(
        starts
    )


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
