"""A recording as it was measured, and what models alone make of its commands."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model, names
from trms_cli.reporting.style import COLOURS, GREY, house_style, legend_above, new_figure, save_png
from trms_cli.simulation.rollout import Rollout

#: s before and after which nothing is to be seen.
_TIME_LIMITS = (4.0, 30.0)


def draw(path: Path, dataset: Dataset, models: Mapping[str, Model]) -> None:
    """Commands and angles of a recording that begins at rest; each model runs free from there.

    ``path``: PNG to write. ``models``: by the name in the legend.
    """
    whole = np.array([0]), np.array([len(dataset)])
    with house_style():
        figure = new_figure(9.2, 6.0)
        panels = figure.subplots(3, 1, sharex=True)
        for i, name in enumerate(names(dataset.inputs)):
            panels[0].plot(dataset.time, dataset.commands[:, i], color=COLOURS[i], label=name)
        panels[0].set_ylabel("V")
        for row, channel in enumerate(("alpha_v", "alpha_h"), start=1):
            measured = dataset.output(channel)
            panels[row].plot(dataset.time, measured, color=GREY, linewidth=2.5, label="measured")
            panels[row].set_ylabel(f"{'pitch' if row == 1 else 'yaw'} [rad]")
            panels[row].set_ylim(-0.2, 1.5 * float(np.nanmax(measured)))
        for i, (label, model) in enumerate(models.items()):
            rollout = Rollout(model, dataset.sample_time)
            start = rollout.initial(model.rest(), np.zeros(model.n_u))
            y = rollout.outputs(dataset.commands, *whole, start[None, :]).y
            for row, channel in enumerate(("alpha_v", "alpha_h"), start=1):
                column = names(model.outputs).index(channel)
                panels[row].plot(dataset.time, y[:, column], color=COLOURS[i], label=label)
        for panel in panels[:2]:
            legend_above(panel)
        panels[2].set_xlabel("time [s]")
        panels[2].set_xlim(*_TIME_LIMITS)
        save_png(figure, path)
