"""What the refitted model says that an experiment would record."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from trms_cli.gap.advice.experiments import Experiment, experiments
from trms_cli.gap.advice.separation import Recording
from trms_cli.gap.fitting.contestant import Contestant, Fit
from trms_cli.gap.fitting.metric import Metric
from trms_cli.gap.innovations.discrepancy import Discrepancy
from trms_cli.gap.innovations.trajectory import Linearisation
from trms_cli.gap.race.nominal import Refit
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.method import Outcome
from trms_cli.simulation.rollout import Rollout

FloatArray = npt.NDArray[np.float64]


def imagined(
    refit: Refit, shares: FloatArray, model_name: str, *, load: bool = False
) -> Iterator[tuple[Experiment, Recording]]:
    """Experiments, and what each records; angles stay in bounds before and after the refit.

    Parameters
    ----------
    refit : Refit
    shares : (n_d,) array
        Discrepancy to be reckoned with.
    model_name : str
        As a command takes it.
    load : bool
        Whether a long load is among them, for effects that need one.
    """
    contestant = refit.contestant
    problem, rollout = contestant.problem, contestant.windows.rollout
    theta = refit.fit.theta
    p = problem.all_values(theta)
    linearisation: Linearisation | None = None
    step = contestant.windows.sample_time
    both = (p, problem.model.parameters.values)
    for experiment in experiments(rollout, both, step, model_name, load=load):
        dataset, starts = _recorded(refit, rollout, p, experiment.commands)
        made = Contestant(problem.model, problem.free, (), [dataset], problem.window_length)
        linearisation = linearisation or Linearisation(made.windows)
        linearisation.windows = made.windows
        discrepancy = Discrepancy(
            made.windows,
            linearisation.along(p, starts),
            refit.metric.discrepancy.channels,
            start_share=0.0,
        )
        fit = Fit(theta, starts, 0.0, Outcome.CONVERGED)
        try:
            metric = Metric(discrepancy, shares, None)
        except FloatingPointError:  # along this motion the equations say too little
            continue
        yield experiment, Recording(made, fit, metric, starts)


def _recorded(
    refit: Refit, rollout: Rollout, p: FloatArray, commands: FloatArray
) -> tuple[Dataset, FloatArray]:
    """The outputs of a rig that is as the refitted model says, and the states at block starts.

    Its noise is declared but not drawn: what traces are compared by is its size.
    """
    problem = refit.contestant.problem
    model, sample = problem.model, problem.datasets[0]
    n = len(commands)
    outputs = [signal.name for signal in model.outputs]
    columns = [outputs.index(signal.name) for signal in sample.outputs]
    empty = Dataset(
        "next",
        "",
        "",
        refit.contestant.windows.sample_time,
        np.arange(n, dtype=np.float64) * refit.contestant.windows.sample_time,
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
