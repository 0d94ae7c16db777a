"""All six states, estimated by some observers and true, in the two estimator cases."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from experiments.chapter7.observers.page import HEADS
from experiments.chapter7.observers.records import STATES, estimates, make_record, observer_of
from experiments.chapter7.observers.study import Study, jobs_of
from trms_cli.core.errors import ConfigurationError

_LABELS = {"ukf": "UKF", "ekf": "EKF", "state_dependent_ekf": "state-dependent EKF"}
FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Traced:
    """A record and what observers made of it."""

    time: FloatArray  #: (n,) array; s
    truth: Mapping[str, FloatArray]  #: (n,) arrays by state
    estimated: Mapping[str, Mapping[str, FloatArray]]  #: The same by observer


def trace_all(study: Study) -> dict[str, Traced]:
    """Every record that is to be drawn, with all channels measured."""
    jobs = {(job.condition, job.seed): job for job in jobs_of(study)}
    traced = {}
    for name, of in study.traces.records.items():
        job = jobs.get((of.condition, of.seed))
        if job is None:
            raise ConfigurationError(
                f"there is no record {of.seed} of {of.condition!r}",
                where=f"traces.records.{name}",
                remedy=f"a condition of the study, and a seed from 1 to {study.seeds}",
            )
        record = make_record(job.overrides)
        rows = [record.experiment.model.state_index(state) for state in STATES]
        estimated = {}
        for observer in study.traces.observers:
            x, _ = estimates(observer_of(observer, of.torques), record, record.outputs)
            estimated[observer] = dict(zip(STATES, x[:, rows].T, strict=True))
        time = record.experiment.sample_time * np.arange(len(record.truth), dtype=np.float64)
        truth = dict(zip(STATES, record.truth[:, rows].T, strict=True))
        traced[name] = Traced(time, truth, estimated)
    return traced


def draw_traces(traced: Mapping[str, Traced], folder: Path) -> None:
    """A figure a record, ``estimates_<number>.png``: each state, and beneath it the errors."""
    from trms_cli.reporting.style import (
        COLOURS,
        INK,
        MEASURED,
        house_style,
        new_figure,
        save_png,
    )

    for number, (name, of) in enumerate(traced.items(), start=1):
        with house_style():
            figure = new_figure(10.0, 9.0)
            grid = figure.subplots(
                6, 2, sharex=True, height_ratios=[1.5, 1.0] * 3, squeeze=False
            )  # fmt: skip
            for i, state in enumerate(STATES):
                upper, lower = grid[2 * (i // 2), i % 2], grid[2 * (i // 2) + 1, i % 2]
                label, unit = HEADS[state].split(" [")
                unit = unit.rstrip("]")
                scale = 1e3 if unit.startswith("m") else 1.0
                upper.plot(of.time, of.truth[state], color=MEASURED, lw=3.0, label="true")
                widths = (2.2, 1.2, 0.5)
                for colour, width, (observer, x) in zip(
                    COLOURS, widths, of.estimated.items(), strict=False
                ):
                    upper.plot(
                        of.time,
                        x[state],
                        color=colour,
                        lw=width,
                        label=_LABELS.get(observer, observer),
                    )
                    error = scale * (x[state] - of.truth[state])
                    lower.plot(of.time, error, color=colour, lw=width)
                lower.axhline(0.0, color=INK, lw=0.6)
                reach = max(
                    float(np.quantile(np.abs(scale * (x[state] - of.truth[state])), 0.995))
                    for x in of.estimated.values()
                )
                lower.set_ylim(-1.2 * reach, 1.2 * reach)
                upper.set_title(f"{label} [{unit.removeprefix('m')}]")
                lower.set_ylabel(f"error [{unit}]", fontsize=7)
                upper.set_xlim(0.0, of.time[-1])
            for panel in grid[-1]:
                panel.set_xlabel("time [s]")
            handles, labels = grid[0, 0].get_legend_handles_labels()
            figure.legend(handles, labels, loc="outside upper right", ncols=len(labels))
            figure.suptitle(name, x=0.01, ha="left", fontsize=10)
            save_png(figure, folder / f"estimates_{number}.png")
