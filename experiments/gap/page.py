"""Tables and figures of the study: printed, as JSON, and in ``docs/closing-the-loop.md``."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from experiments.gap.closing_loop import AXES, Sizes, Tracking, Verdict, traces_of
from experiments.gap.models import DIAGNOSED, KNOWN_CAUSE, NOMINAL, REFIT, TRUE
from experiments.gap.separation import Separation
from experiments.page_tables import markdown, write_tables

ROOT = Path(__file__).resolve().parents[2]
PAGE, FIGURES = ROOT / "docs" / "closing-the-loop.md", ROOT / "docs" / "figures" / "closing_loop"
SCHEMA = "trms.closing_loop/1"
#: What models are called in tables and figures; others keep their name.
_WORDS = {KNOWN_CAUSE: "cause known"}
#: Share by which the nominal model's error has to exceed the true one's for a share to be told.
_SUFFERS = 0.2
#: Ratio of errors from which on they are drawn on a logarithmic axis.
_WIDE = 30.0


@dataclass
class Findings:
    """All that came out."""

    runs: list[Tracking]
    verdicts: list[Verdict]
    sizes: list[Sizes] = field(default_factory=list)
    separations: list[Separation] = field(default_factory=list)
    seconds: float = 0.0  #: Of the processor, without what had been done before


def tables(findings: Findings) -> dict[str, list[list[str]]]:
    """Tables by name, each with its head in the first row."""
    rows_by_name = {"sizes": _sizes(findings.sizes), "diagnoses": _diagnoses(findings.verdicts)}
    for task in dict.fromkeys(run.task for run in findings.runs):
        rows_by_name[task] = _tracking([run for run in findings.runs if run.task == task])
    rows_by_name["separation"] = _separation(findings.separations)
    return {name: rows for name, rows in rows_by_name.items() if len(rows) > 1}


def document(findings: Findings) -> dict[str, Any]:
    """``trms.closing_loop/1``; what could not be counted is null."""
    content = {
        "schema": SCHEMA,
        "seconds": round(findings.seconds, 1),
        "diagnoses": [asdict(verdict) for verdict in findings.verdicts],
        "sizes": [asdict(sizes) for sizes in findings.sizes],
        "runs": [asdict(run) for run in findings.runs],
        "separations": [asdict(separation) for separation in findings.separations],
    }
    cleaned: dict[str, Any] = _finite(content)
    return cleaned


def write_out(findings: Findings, folder: Path, runs: Path) -> None:
    """Tables as JSON and Markdown, and figures, into a folder.

    ``runs``: where the runs' traces lie.
    """
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(document(findings), indent=1, ensure_ascii=False, allow_nan=False)
    (folder / "closing_loop.json").write_text(text + "\n", encoding="utf-8")
    blocks = [f"## {name}\n\n{markdown(rows)}\n" for name, rows in tables(findings).items()]
    (folder / "closing_loop.md").write_text("\n".join(blocks), encoding="utf-8")
    draw(findings, folder, runs)


def publish(findings: Findings, runs: Path, page: Path = PAGE, figures: Path = FIGURES) -> None:
    """Rewrite the page between its marks, and its figures.

    Raises ConfigurationError if the page has no marks for a table.
    """
    blocks = {name: markdown(rows) for name, rows in tables(findings).items()}
    if "separation" in blocks:
        blocks["separation"] += "".join(
            f"\n\n`{s.rig}`: {s.why}.\n\n    {s.command}" for s in findings.separations if s.command
        )
    figures.mkdir(parents=True, exist_ok=True)
    draw(findings, figures, runs)
    write_tables(page, blocks | {"made": coverage_note(findings)})


def coverage_note(findings: Findings) -> str:
    """What the tables hold, and what they do not hold yet."""
    rigs = len({run.rig for run in findings.runs})
    models = list(dict.fromkeys(run.model for run in findings.runs))
    words = f"The tables below are of {len(findings.runs)} runs of {rigs} rigs, with the models "
    words += f"{', '.join(models)}."
    for task in dict.fromkeys(run.task for run in findings.runs):
        for model in models:
            n = sum(run.task == task and run.model == model for run in findings.runs)
            if n < rigs:
                words += f" In `{task}` {model} has {n} rigs."
    missing = [name for name in (REFIT, DIAGNOSED, KNOWN_CAUSE) if name not in models]
    if missing:
        words += f" **Not run yet: {', '.join(missing)}.**"
    if not findings.separations:
        words += " **Not run yet: the next experiment.**"
    return words


def mean_and_interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean over rigs, and half the width of its 95 % interval by Student's t; NaN for one rig."""
    n = len(values)
    if n < 2:
        return float(np.mean(values)), float("nan")
    half = stats.t.ppf(0.975, n - 1) * np.std(values, ddof=1) / np.sqrt(n)
    return float(np.mean(values)), float(half)


def errors(run: Tracking) -> Mapping[str, float]:
    """The error of a run that a model can do something about, by axis, rad.

    On a trajectory all of it; on plain squares, where most is the step itself, what is left when
    the reference has stood still for some seconds.
    """
    return run.rmse if run.task == "trajectory" else run.settled


def recovered_share(runs: Sequence[Tracking], by: str = DIAGNOSED) -> float | None:
    """Share of the squared error that a model takes away of what the true one would.

    Over both axes and all rigs of an effect. None where the nominal model's error is hardly above
    the true one's, so that there is nothing to recover.
    """

    rigs = set.intersection(
        *({run.rig for run in runs if run.model == m} for m in (NOMINAL, by, TRUE))
    )

    def squared(model: str) -> float:
        of = [run for run in runs if run.model == model and run.rig in rigs]
        return sum(errors(run)[axis] ** 2 for run in of for axis in AXES)

    nominal, corrected, true = (squared(model) for model in (NOMINAL, by, TRUE))
    if not true or not corrected or np.sqrt(nominal / true) < 1 + _SUFFERS:
        return None
    return (nominal - corrected) / (nominal - true)


def _tracking(runs: Sequence[Tracking]) -> list[list[str]]:
    models = list(dict.fromkeys(run.model for run in runs))
    heads = [f"{_WORDS.get(model, model)} [mrad]" for model in models]
    rows = [["effect", "axis", *heads, "commands move [V/s]"]]
    ways = [model for model in models if model not in (NOMINAL, TRUE)] if TRUE in models else []
    rows[0] += [f"recovered, {_WORDS.get(way, way)}" for way in ways]
    for effect in dict.fromkeys(run.effect for run in runs):
        of = [run for run in runs if run.effect == effect]
        shares = [recovered_share(of, way) for way in ways]
        for axis in AXES:
            row = ["`" + effect + "`" if axis == AXES[0] else "", axis]
            for model in models:
                row.append(_spread([1e3 * errors(run)[axis] for run in of if run.model == model]))
            moves = [np.mean([r.movement[axis] for r in of if r.model == m]) for m in models]
            row.append(" / ".join(f"{value:.2f}" for value in moves))
            share_texts = ["hardly suffers" if s is None else f"{100 * s:.0f} %" for s in shares]
            rows.append([*row, *(share_texts if axis == AXES[0] else [""] * len(share_texts))])
    return rows


def _diagnoses(verdicts: Sequence[Verdict]) -> list[list[str]]:
    rows = [["rig", "verdict", "first cause", "probability", "time [s]"]]
    for v in verdicts:
        cause = ", ".join(f"`{name}`" for name in v.effects)
        rows.append([f"`{v.rig}`", v.verdict, cause, f"{v.probability:.2f}", f"{v.seconds:.0f}"])
    return rows


def _sizes(rig_sizes: Sequence[Sizes]) -> list[list[str]]:
    models = list(dict.fromkeys(model for sizes in rig_sizes for model in sizes.fitted))
    rows = [["effect", "size", "rig", *(_WORDS.get(model, model) for model in models)]]
    for effect in dict.fromkeys(sizes.effect for sizes in rig_sizes):
        of = [sizes for sizes in rig_sizes if sizes.effect == effect]
        fitted = {name for sizes in of for values in sizes.fitted.values() for name in values}
        for name, own in ((n, v) for n, v in of[0].own.items() if n in fitted):
            row = [f"`{effect}`", name, f"{own:g}"]
            for model in models:
                values = [s.fitted.get(model, {}).get(name) for s in of]
                row.append(", ".join("–" if v is None else f"{v:.3g}" for v in values))
            rows.append(row)
    return rows if models else rows[:1]


def _separation(separations: Sequence[Separation]) -> list[list[str]]:
    rows = [
        ["rig", "recordings", "verdict", "true", "rival", "delay and lag", "declared confusable"]
    ]
    for s in separations:
        after_advice = (
            [("first and advised", s.after)] if s.command else [("nothing advised", s.after)]
        )
        for label, at in (("first", s.before), *after_advice):
            rows.append(
                [
                    f"`{s.rig}`" if at is s.before else "",
                    label,
                    at.verdict,
                    f"{at.true:.2f}",
                    f"{at.rival:.2f}",
                    f"{at.both:.2f}",
                    "yes" if at.confusable else "no",
                ]
            )
    return rows


def _spread(values: Sequence[float]) -> str:
    mean, half = mean_and_interval(values)
    return f"{mean:.1f}" if np.isnan(half) else f"{mean:.1f} ± {half:.1f}"


def _finite(content: Any) -> Any:
    """NaN as null."""
    if isinstance(content, Mapping):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_finite(value) for value in content]
    if isinstance(content, float) and not np.isfinite(content):
        return None
    return content


def draw(findings: Findings, folder: Path, runs: Path) -> None:
    """All figures, as PNG."""
    from trms_cli.reporting.style import house_style, save_png

    with house_style():
        for task in dict.fromkeys(run.task for run in findings.runs):
            of = [run for run in findings.runs if run.task == task]
            save_png(_errors(of), folder / f"{task}.png")
        if not {NOMINAL, TRUE} <= {run.model for run in findings.runs}:
            return
        worst = _worst([run for run in findings.runs if run.task == findings.runs[0].task])
        save_png(_traces(worst, findings.runs, runs), folder / "traces.png")


def _worst(runs: Sequence[Tracking]) -> Tracking:
    """The run with the true model on the rig where the nominal one loses most against it."""
    losses = {run.rig: -sum(errors(run).values()) for run in runs if run.model == TRUE}
    for run in runs:
        if run.model == NOMINAL:
            losses[run.rig] += sum(errors(run).values())
    rig = max(losses, key=lambda name: losses[name])
    return next(run for run in runs if run.rig == rig and run.model == TRUE)


def _errors(runs: Sequence[Tracking]) -> Any:
    """Root mean square errors by effect and model, a point a rig, a bar for the mean."""
    from trms_cli.reporting.style import INK, legend_above, new_figure

    figure = new_figure(9.5, 4.6)
    panels = figure.subplots(2, 1, sharex=True)
    effects = list(dict.fromkeys(run.effect for run in runs))
    models = list(dict.fromkeys(run.model for run in runs))
    for panel, axis in zip(panels, AXES, strict=True):
        for j, model in enumerate(models):
            for i, effect in enumerate(effects):
                values = [
                    1e3 * errors(r)[axis] for r in runs if r.effect == effect and r.model == model
                ]
                at = i + 0.2 * (j - (len(models) - 1) / 2)
                label = _WORDS.get(model, model) if i == 0 else None
                panel.bar(at, np.mean(values), 0.17, color=_colour(model, models), label=label)
                panel.plot([at] * len(values), values, ".", color=INK, ms=3)
        if max(errors(r)[axis] for r in runs) > _WIDE * min(errors(r)[axis] for r in runs):
            panel.set_yscale("log")
        panel.set_ylabel(f"{axis} error, RMS [mrad]")
    legend_above(panels[0])
    panels[-1].set_xticks(range(len(effects)), [effect.replace("_", "\n", 1) for effect in effects])
    return figure


def _traces(one: Tracking, all_runs: Sequence[Tracking], runs: Path) -> Any:
    """Tracking error over time of one rig with every model."""
    from trms_cli.reporting.style import GREY, legend_above, new_figure

    figure = new_figure(9.5, 4.6)
    panels = figure.subplots(3, 1, sharex=True)
    models = list(dict.fromkeys(run.model for run in all_runs))
    for model in models:
        traces = traces_of(one.rig, one.task, model, runs)
        if model == models[0]:
            for i, axis in enumerate(AXES):
                style = ("-", "--")[i]
                panels[0].plot(
                    traces["time"], traces["reference"][:, i], style, color=GREY, label=axis
                )
        error = 1e3 * (traces["angle"] - traces["reference"])
        for i in range(2):
            colour = _colour(model, models)
            label = _WORDS.get(model, model)
            panels[1 + i].plot(traces["time"], error[:, i], color=colour, lw=1.0, label=label)
    panels[0].set_ylabel("reference [rad]")
    for i, axis in enumerate(AXES):
        panels[1 + i].set_ylabel(f"{axis} error [mrad]")
        settled = [
            1e3 * np.abs(t["angle"][:, i] - t["reference"][:, i])[t["time"] >= 10].max()
            for t in (traces_of(one.rig, one.task, m, runs) for m in models)
        ]
        panels[1 + i].set_ylim(-1.1 * max(settled), 1.1 * max(settled))
    legend_above(panels[0])
    legend_above(panels[1])
    panels[-1].set_xlabel("time [s]")
    figure.suptitle(f"{one.effect}, {one.task}", x=0.01, ha="left", fontsize=10)
    return figure


def _colour(model: str, models: Sequence[str]) -> str:
    from trms_cli.reporting.style import COLOURS, GREY

    return GREY if model == NOMINAL else COLOURS[(models.index(model) - 1) % len(COLOURS)]
