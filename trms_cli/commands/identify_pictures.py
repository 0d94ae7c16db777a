"""The figures and the page of a fit."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from trms_cli.commands.identify_assessment import Assessment
from trms_cli.identification.free_runs import WindowRuns
from trms_cli.models.model import names
from trms_cli.reporting.identification_picture import FreeRunTrace

PAGE_NAME = "identification.html"
#: s of a recording that the figure of the free runs shows at most.
_LONGEST = 120.0


def draw_all(fitted: Assessment, document: Mapping[str, Any], folder: Path) -> Path | None:
    """Figures as PNG and the page, into the folder; the page, or None where the disk is full."""
    from trms_cli.reporting.identification_page import identification_page
    from trms_cli.reporting.identification_picture import draw

    figures = _figures(fitted, document)
    page = folder / PAGE_NAME
    try:
        for name, (figure, _) in figures.items():
            draw(figure, folder / f"{name}.png")
        identification_page(document, figures).write(page)
    except OSError as error:  # the fit is safe in its files: this much may fail
        sys.stderr.write(f"no figures: {error.strerror or error}\n")
        return None
    return page


def _figures(fitted: Assessment, document: Mapping[str, Any]) -> dict[str, tuple[Any, str]]:
    """Figures with their captions."""
    from trms_cli.reporting import identification_picture as picture

    made: dict[str, tuple[Any, str]] = {}
    part = "held_out" if fitted.after.get("held_out") else "fit"
    words = {"held_out": "held out from the fit", "fit": "fitted"}[part]
    if fitted.after.get(part):
        name = fitted.after[part][0].dataset.name
        title = f"{name}: free runs over what was {words}"
        made["free_runs"] = (
            picture.free_run_figure(_traces(fitted, part), title),
            f"Free runs over what was {words}; at a dotted line a window starts anew.",
        )
    if document["parameters"]:
        made["parameters"] = (
            picture.parameter_figure(document["parameters"], "parameters against their priors"),
            "Fitted values; the bands are one and two prior standard deviations.",
        )
    if len(document["history"]) > 1:
        made["convergence"] = (
            picture.convergence_figure(document["history"], "the search"),
            _about_the_search([cost for _, _, cost in document["history"]]),
        )
    return made


def _about_the_search(costs: list[float | None]) -> str:
    known = [cost for cost in costs if cost is not None]
    if all(b <= a for a, b in pairwise(known)):
        return "The least cost so far, above the least of all."
    return (
        "The cost along the search, above the least of all. Where it rises, another start was "
        "begun or the residuals were weighed anew."
    )


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


def _shown(run: WindowRuns, column: int, begin: int, end: int) -> Any:
    assert column < len(names(run.dataset.outputs))
    values = run.simulated[begin:end, column]
    return np.where(np.isfinite(values), values, np.nan)
