"""Series for the report's pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from trms_cli.gap.answer.belief import Believed
from trms_cli.gap.answer.far import Far
from trms_cli.gap.blocks import Parts
from trms_cli.gap.diagnosis import Traces
from trms_cli.gap.force.record import ForceRecord
from trms_cli.gap.free_runs import history, start_states
from trms_cli.gap.innovations.discrepancy import Discrepancy
from trms_cli.gap.location import smoothed_forces
from trms_cli.gap.problem import GapProblem
from trms_cli.gap.race.contest import Contest
from trms_cli.models.model import Model, names

FloatArray = npt.NDArray[np.float64]

#: Points of a picture's line at most.
_POINTS = 1500
#: s. Length of the free run that is shown.
_SHOWN = 10.0


def series(
    problem: GapProblem,
    parts: Parts,
    raced: Contest,
    believed: Believed,
    far: Far,
    forces: Mapping[str, ForceRecord],
    locations: Sequence[str],
) -> Traces:
    """Missing forces with what explains them, and free runs before and after."""
    shown = [name for name in locations if name in forces] or list(forces)[:1]
    explained: dict[str, FloatArray] = {}
    if believed.corrected is not None:
        refit, entry = raced.refit, believed.corrected
        # the force that the nominal equations lack beside the cause: in the nominal model's states
        following = Discrepancy(
            refit.contestant.windows,
            refit.metric.discrepancy.trajectory,
            refit.metric.discrepancy.channels,
        )
        left = smoothed_forces(entry.contestant, entry.fit, following, refit.metric.shares)
        explained = {name: forces[name].force - left[name].force for name in shown}
    first = forces[shown[0]] if shown else None
    rows = slice(None, None, 1 if first is None else max(1, len(first.time) // _POINTS))
    force: dict[str, FloatArray] = {}
    for name in shown:
        force[name] = forces[name].force[rows]
        force[f"{name}.sd"] = forces[name].sd[rows]
    time, runs = _runs(parts, far)
    return Traces(
        force_time=np.zeros(0) if first is None else first.time[rows],
        force=force,
        force_unit={name: forces[name].unit for name in shown},
        explained={name: value[rows] for name, value in explained.items()},
        run_time=time,
        runs=runs,
    )


def _runs(parts: Parts, far: Far) -> tuple[FloatArray, dict[str, dict[str, FloatArray]]]:
    """The free run over the sealed part in which most was gained."""
    number, first, last = parts.sealed[0]
    dataset = parts.whole[number]
    step = dataset.sample_time
    samples = min(round(_SHOWN / step), last - first - history(step) - 1)
    begins = np.arange(max(first, history(step)), last - samples + 1, max(1, samples // 2))
    if samples < 5 or not len(begins):
        return np.zeros(0), {}
    models: dict[str, Model] = {"raw": far.raw, "refit": far.refit, "corrected": far.corrected}
    if far.corrected is far.refit:
        del models["corrected"]
    simulated = {}
    for name, model in models.items():
        rollout = far.richer if name == "corrected" else far.plain
        starts = start_states(model, rollout, dataset, begins)
        count = np.full(len(begins), samples)
        p = model.parameters.values
        y = rollout.outputs(dataset.commands, begins, count, starts, p).y
        simulated[name] = y.reshape(len(begins), samples, -1)
    outputs = names(far.raw.outputs)
    columns = [outputs.index(s.name) for s in dataset.outputs]
    measured = dataset.measurements[begins[:, None] + np.arange(samples)]
    after = simulated.get("corrected", simulated["refit"])[..., columns]
    with np.errstate(all="ignore"):
        worse = np.nansum((simulated["refit"][..., columns] - measured) ** 2, axis=1)
        better = np.nansum((after - measured) ** 2, axis=1)
        gained = np.nansum((worse - better) / np.maximum(dataset.noise_sd**2, 1e-18), axis=1)
    best = int(np.argmax(gained)) if len(simulated) > 2 else int(np.argmax(worse.sum(axis=1)))
    time = dataset.time[begins[best] : begins[best] + samples]
    runs = {
        signal.name: {
            "measured": measured[best, :, i],
            **{name: y[best, :, columns[i]] for name, y in simulated.items()},
        }
        for i, signal in enumerate(dataset.outputs)
    }
    return np.asarray(time - time[0] + float(time[0])), runs
