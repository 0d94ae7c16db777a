"""Tables and figures of the study: printed, as JSON, in ``docs/chapter4.md``."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.chapter4.fits import CaseOutcome, GreyboxFit
from experiments.page_tables import markdown, write_tables
from trms_cli.core.findings import json_data

ROOT = Path(__file__).resolve().parents[2]
PAGE, FIGURES = ROOT / "docs" / "chapter4.md", ROOT / "docs" / "figures" / "chapter4"
SCHEMA = "trms.chapter4/1"
_METHODS = {
    "genetic": "genetic algorithm",
    "cma_es": "CMA-ES",
    "multiple_shooting": "multiple shooting",
}
_ANGLES = {"alpha_v": "pitch", "alpha_h": "yaw"}


@dataclass
class Findings:
    """All that came out."""

    cases: list[CaseOutcome]  #: White against grey
    compared: list[CaseOutcome]  #: Every method with every seed
    seconds: float  #: Of the whole study, s


def tables(findings: Findings) -> dict[str, list[list[str]]]:
    """Tables by name, each with its head in the first row."""
    return {"white-against-grey": _white_grey(findings), "comparison": _comparison(findings)}


def write_out(findings: Findings, folder: Path) -> None:
    """Tables as JSON and figures into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    content = json_data(document(findings))
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "chapter4.json").write_text(text + "\n", encoding="utf-8")
    draw(findings, folder)


def publish(findings: Findings, page: Path = PAGE, figures: Path = FIGURES) -> None:
    """Rewrite the page between its marks, and its figures.

    Raises ConfigurationError if the page has no marks for a table.
    """
    blocks = {name: markdown(rows) for name, rows in tables(findings).items() if len(rows) > 1}
    fits = [f for o in findings.cases for f in o.fits]
    blocks["time"] = (
        f"The {len(fits)} fits of white against grey took {sum(f.seconds for f in fits):.0f} s of "
        "processor time together, a thread each."
    )
    figures.mkdir(parents=True, exist_ok=True)
    draw(findings, figures)
    write_tables(page, blocks)


def document(findings: Findings) -> dict[str, Any]:
    """``trms.chapter4/1``."""

    def fit(f: GreyboxFit) -> dict[str, Any]:
        return {
            "method": f.method,
            "errors": f.errors,
            "cost": f.cost,
            "seconds": f.seconds,
            "simulations": f.simulations,
            "values": f.values,
            "history": f.history,
        }

    def case(o: CaseOutcome) -> dict[str, Any]:
        return {
            "number": o.case.number,
            "name": o.case.name,
            "fit": list(o.case.fit),
            "held_out": list(o.case.held_out),
            "identify": list(o.case.identify),
            "free": o.free,
            "white": o.white,
            "grey": [fit(f) for f in o.fits],
        }

    return {
        "schema": SCHEMA,
        "seconds": findings.seconds,
        "cases": [case(o) for o in findings.cases],
        "comparison": [case(o) for o in findings.compared],
    }


def draw(findings: Findings, folder: Path) -> None:
    """All figures, as PNG."""
    from trms_cli.reporting.style import house_style, save_png

    with house_style():
        if findings.cases:
            save_png(_bars(findings.cases), folder / "white_against_grey.png")
            save_png(_overview(findings.cases), folder / "cases.png")
            for outcome in findings.cases:
                save_png(_traces(outcome), folder / f"case_{outcome.case.number}.png")
        if findings.compared:
            save_png(_searches(findings.compared), folder / "comparison.png")


def _white_grey(findings: Findings) -> list[list[str]]:
    methods = list(dict.fromkeys(f.method for o in findings.cases for f in o.fits))
    head = ["", "case", "free", "output", "white"]
    head += [_METHODS[m] for m in methods] + [f"{_METHODS[m]} [s]" for m in methods]
    rows = [head]
    for outcome in findings.cases:
        first = True
        for name, label in _ANGLES.items():
            if name not in outcome.white:
                continue
            grey = [f.errors[name]["rmse"] for f in outcome.fits]
            rows.append(
                [
                    str(outcome.case.number) if first else "",
                    outcome.case.name if first else "",
                    str(outcome.free) if first else "",
                    label,
                    _milli(outcome.white[name]["rmse"]),
                    *map(_milli, grey),
                    *((f"{f.seconds:.1f}" if first else "") for f in outcome.fits),
                ]
            )
            first = False
    return rows


def _comparison(findings: Findings) -> list[list[str]]:
    rows = [
        [
            "case",
            "method",
            "simulations",
            "time [s]",
            "cost above the least [nats]",
            "pitch [mrad]",
            "yaw [mrad]",
        ]
    ]
    for outcome in findings.compared:
        least = min(f.cost for f in outcome.fits)
        for i, method in enumerate(dict.fromkeys(f.method for f in outcome.fits)):
            fits = [f for f in outcome.fits if f.method == method]
            angles = [
                _spread([1e3 * (f.errors[a]["rmse"] or math.inf) for f in fits])
                if a in outcome.white
                else ""
                for a in _ANGLES
            ]
            rows.append(
                [
                    outcome.case.name if i == 0 else "",
                    _METHODS[method],
                    _spread([f.simulations for f in fits]),
                    _spread([f.seconds for f in fits]),
                    _spread([f.cost - least for f in fits]),
                    *angles,
                ]
            )
    return rows


def _spread(values: Sequence[float]) -> str:
    """Median, and smallest to largest where they differ."""
    low, middle, high = (_short(v) for v in (min(values), float(np.median(values)), max(values)))
    return middle if low == high else f"{middle} ({low} to {high})"


def _short(value: float) -> str:
    if not math.isfinite(value):
        return "–"
    if abs(value) >= 1000 or value == round(value):
        return f"{value:.0f}"
    return f"{value:.3g}"


def _milli(value: float | None) -> str:
    return "–" if value is None else f"{1e3 * value:.3g}"


def _bars(outcomes: Sequence[CaseOutcome]) -> Any:
    """RMSE of the angles on what was held out, white and grey, on a logarithmic axis."""
    from trms_cli.reporting.style import COLOURS, GREY, legend_above, new_figure

    figure = new_figure(9.5, 5.2)
    panels = figure.subplots(2, 1, sharex=True)
    methods = list(dict.fromkeys(f.method for o in outcomes for f in o.fits))
    for panel, (name, label) in zip(panels, _ANGLES.items(), strict=True):
        for o in outcomes:
            if name not in o.white:
                continue
            series: list[Mapping[str, Any]] = [o.white, *(f.errors for f in o.fits)]
            for i, errors in enumerate(series):
                at = o.case.number + 0.25 * (i - len(methods) / 2)
                colour = GREY if i == 0 else COLOURS[i - 1]
                value = errors[name]["rmse"]
                if value is not None:
                    panel.bar(at, 1e3 * value, 0.23, color=colour)
        panel.set_yscale("log")
        panel.set_ylabel(f"{label} RMSE [mrad]")
        panel.bar(0, 0, color=GREY, label="white")
        for i, method in enumerate(methods):
            panel.bar(0, 0, color=COLOURS[i], label=f"grey, {_METHODS[method]}")
    legend_above(panels[0])
    panels[-1].set_xticks([o.case.number for o in outcomes])
    panels[-1].set_xlim(0.4, max(o.case.number for o in outcomes) + 0.6)
    panels[-1].set_xlabel("case")
    return figure


def _overview(outcomes: Sequence[CaseOutcome]) -> Any:
    """Held out, a row a case: both angles measured, white and grey."""
    from trms_cli.reporting.style import new_figure

    figure = new_figure(9.5, 0.8 + 1.15 * len(outcomes))
    panels = figure.subplots(len(outcomes), len(_ANGLES), sharex="col", squeeze=False)
    for row, outcome in zip(panels, outcomes, strict=True):
        for panel, name in zip(row, _ANGLES, strict=True):
            if name not in outcome.white:
                panel.set_axis_off()
                continue
            _draw_angle(panel, outcome, name)
        row[0].set_title(f"{outcome.case.number}: {outcome.case.name}", fontsize=8, pad=2)
    for panel, label in zip(panels[0], _ANGLES.values(), strict=True):
        panel.set_title(f"{label} [rad]", loc="right", fontsize=8, pad=2)
    for panel in panels[-1]:
        panel.set_xlabel("time [s]")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=len(labels))
    return figure


def _traces(outcome: CaseOutcome) -> Any:
    """Held out: the angles measured and simulated, and beneath each the model's error."""
    from trms_cli.reporting.style import COLOURS, GREY, INK, new_figure

    angles = [name for name in _ANGLES if name in outcome.white]
    figure = new_figure(9.5, 0.9 + 2.3 * len(angles))
    panels = figure.subplots(
        2 * len(angles), 1, sharex=True, height_ratios=[1.7, 1.0] * len(angles)
    )
    time = outcome.measured["time"]
    for (upper, lower), name in zip(panels.reshape(-1, 2), angles, strict=True):
        _draw_angle(upper, outcome, name)
        upper.set_ylabel(f"{_ANGLES[name]} [rad]")
        errors = [(GREY, outcome.white_trace[name])]
        for colour, fit in zip(COLOURS, outcome.fits, strict=False):
            errors.append((colour, fit.trace[name]))
        for colour, simulated in errors:
            size = np.maximum(1e3 * np.abs(simulated - outcome.measured[name]), 0.1)
            lower.plot(time, size, color=colour, lw=0.8)
        lower.axhline(0.77, color=INK, lw=0.6, ls=":")  # half a step of the encoders
        lower.set_yscale("log")
        lower.set_yticks([1.0, 10.0, 100.0], ["1", "10", "100"])
        lower.set_ylabel("|error| [mrad]")
    panels[-1].set_xlabel("time [s]")
    figure.align_ylabels(panels)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=len(labels))
    figure.suptitle(f"{outcome.case.number}: {outcome.case.name}", x=0.01, ha="left", fontsize=10)
    return figure


def _draw_angle(panel: Any, outcome: CaseOutcome, name: str) -> None:
    from trms_cli.reporting.style import COLOURS, GREY, MEASURED

    time = outcome.measured["time"]
    panel.plot(time, outcome.measured[name], color=MEASURED, lw=2.4, label="measured")
    panel.plot(time, outcome.white_trace[name], color=GREY, lw=0.9, ls="--", label="white")
    for colour, fit in zip(COLOURS, outcome.fits, strict=False):
        label = f"grey, {_METHODS[fit.method]}"
        panel.plot(time, fit.trace[name], color=colour, lw=0.9, label=label)
    panel.set_xlim(0.0, time[-1])


def _searches(outcomes: Sequence[CaseOutcome]) -> Any:
    """The common cost over processor time, a line a seed; multiple shooting as a point."""
    from trms_cli.reporting.style import COLOURS, new_figure

    figure = new_figure(9.5, 3.2)
    panels = figure.subplots(1, len(outcomes), squeeze=False)[0]
    for panel, outcome in zip(panels, outcomes, strict=True):
        least = min(f.cost for f in outcome.fits)
        methods = list(dict.fromkeys(f.method for f in outcome.fits))
        for fit in outcome.fits:
            colour = COLOURS[methods.index(fit.method)]
            if fit.method == "multiple_shooting":
                panel.plot([fit.seconds], [max(fit.cost - least, 0.5)], "o", color=colour, ms=5)
                continue
            history = np.array(fit.history)
            # The history has the clock's time, which other work on the machine stretches.
            time = history[:, 1] * fit.seconds / history[-1, 1]
            panel.plot(time, history[:, 2] - least, color=colour, lw=0.9)
        for i, method in enumerate(methods):
            mark = {"marker": "o", "lw": 0.0} if method == "multiple_shooting" else {}
            panel.plot([], [], color=COLOURS[i], label=_METHODS[method], **mark)
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.set_xlabel("processor time [s]")
        panel.set_title(f"{outcome.case.name}, {outcome.free} parameters", fontsize=9)
        panel.legend(loc="lower right", fontsize=8)
    panels[0].set_ylabel("cost above the least [nats]")
    return figure
