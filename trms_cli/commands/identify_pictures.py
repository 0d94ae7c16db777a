"""The figures and the page of a fit."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from trms_cli.commands.identify_assessment import Assessment
from trms_cli.identification.judgement import Judged
from trms_cli.models.model import names
from trms_cli.reporting.identification_picture import FreeRunTrace

#: s of a recording that the figure of the free runs shows at most.
_LONGEST = 120.0


def draw_figures(fitted: Assessment, document: Mapping[str, Any], folder: Path) -> dict[str, Path]:
    """Draw into the folder; a disk that is full costs the figures, not the fit.

    Returns
    -------
    dict
        Files by caption.
    """
    from trms_cli.reporting import identification_picture as picture

    made: dict[str, Path] = {}
    part = "held_out" if fitted.after.get("held_out") else "fit"
    words = {"held_out": "held out from the fit", "fit": "fitted"}[part]
    try:
        if fitted.after.get(part):
            traces = _traces(fitted, part)
            name = fitted.after[part][0].dataset.name
            figure = picture.free_run_figure(traces, f"{name}: free runs over what was {words}")
            path = folder / "free_runs.png"
            picture.draw(figure, path)
            made[f"Free runs over what was {words}; dotted lines: a window starts anew"] = path
        if document["parameters"]:
            figure = picture.parameter_figure(
                document["parameters"], "parameters against what was known before"
            )
            path = folder / "parameters.png"
            picture.draw(figure, path)
            made["Fitted parameters against their priors; bands: one and two deviations"] = path
        if len(document["history"]) > 1:
            figure = picture.convergence_figure(document["history"], "the search")
            path = folder / "convergence.png"
            picture.draw(figure, path)
            made["The least cost so far"] = path
    except OSError as error:
        sys.stderr.write(f"no figures: {error.strerror or error}\n")
    return made


def _traces(fitted: Assessment, part: str) -> list[FreeRunTrace]:
    """Of the first recording of a part."""
    after = fitted.after[part][0]
    before = fitted.before[part][0] if fitted.before.get(part) else None
    begin = int(after.window[0])
    last = int(np.flatnonzero(~np.isnan(after.simulated).all(axis=1))[-1]) + 1
    end = min(last, begin + round(_LONGEST / after.dataset.sample_time))
    time = after.dataset.time[begin:end]
    starts = after.dataset.time[after.window[after.window < end]]
    return [
        FreeRunTrace(
            signal.name,
            signal.unit,
            time,
            after.dataset.measurements[begin:end, i],
            None if before is None else _shown(before, i, begin, end),
            _shown(after, i, begin, end),
            starts,
        )
        for i, signal in enumerate(after.dataset.outputs)
    ]


def _shown(run: Judged, column: int, begin: int, end: int) -> Any:
    assert column < len(names(run.dataset.outputs))
    values = run.simulated[begin:end, column]
    return np.where(np.isfinite(values), values, np.nan)
