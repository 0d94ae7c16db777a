"""What the matrix is expected to show: the figure and the table of the README, redrawn by an
update of the baseline, so that they never tell of another one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.provenance import record_publication
from experiments.regression.comparison import BaselineFile
from experiments.regression.matrix import HERE
from experiments.regression.runs import Outcome

README, FIGURE = HERE / "README.md", HERE / "figure.png"
_BEGIN, _END = "<!-- expected figures: begin -->", "<!-- expected figures: end -->"


def write_expectation(
    outcomes: Sequence[Outcome],
    recorded: BaselineFile,
    readme: Path = README,
    figure: Path = FIGURE,
) -> None:
    """Redraw the figure and rewrite the table."""
    draw(outcomes, figure)
    before, begin, rest = readme.read_text(encoding="utf-8").partition(_BEGIN)
    _, end, after = rest.partition(_END)
    if not (begin and end):
        raise ValueError(f"{readme} has lost its marks {_BEGIN} … {_END}")
    words = f"{before}{_BEGIN}\n{_table(recorded)}\n{_END}{after}"
    readme.write_text(words, encoding="utf-8")
    record_publication(readme, ["expected figures"])


def _table(recorded: BaselineFile) -> str:
    lines = [
        f"Baseline of {recorded.date} at {recorded.git or 'no revision'}: {recorded.reason}.",
        "",
        "| run | RMSE pitch, yaw [rad] | overshoot [%] | settling [s] | steady-state error [rad] |",
        "|---|---|---|---|---|",
    ]
    for name, run in recorded.runs.items():
        channels = [run["score"]["channels"].get(axis, {}) for axis in ("alpha_v", "alpha_h")]
        cells = [
            ", ".join(_number(channel.get(key), digits) for channel in channels)
            for key, digits in (
                ("rmse", 4),
                ("overshoot_percent", 1),
                ("settling_time_s", 2),
                ("steady_state_error", 4),
            )
        ]
        cells = ["–" if set(cell) <= set("–, ") else cell for cell in cells]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def draw(outcomes: Sequence[Outcome], path: Path) -> None:
    """A panel for each axis, reference and rig, a line for each controller."""
    from trms_cli.reporting.style import house_style, save_png

    with house_style():
        save_png(_figure(outcomes), path)


def _figure(outcomes: Sequence[Outcome]) -> Any:
    from trms_cli.reporting.style import COLOURS, GREY, new_figure

    panels: dict[tuple[str, str], list[tuple[str, dict[str, Any]]]] = {}
    for outcome in outcomes:
        controller, reference, rig = outcome.case.name.split("/")
        panels.setdefault((reference, rig), []).append((controller, outcome.traces))
    references = list(dict.fromkeys(reference for reference, _ in panels))
    rigs = list(dict.fromkeys(rig for _, rig in panels))
    rows = [(reference, axis) for reference in references for axis in ("alpha_v", "alpha_h")]
    figure = new_figure(3.2 * len(rigs), 1.7 * len(rows))
    grid = figure.subplots(len(rows), len(rigs), sharex=True, sharey="row", squeeze=False)
    for i, (reference, axis) in enumerate(rows):
        for j, rig in enumerate(rigs):
            panel = grid[i][j]
            for k, (controller, traces) in enumerate(panels.get((reference, rig), [])):
                if k == 0:
                    panel.plot(traces["time"], traces[f"r_{axis}"], color=GREY, lw=0.8)
                colour = COLOURS[k % len(COLOURS)]
                style = "--" if k >= len(COLOURS) else "-"
                panel.plot(
                    traces["time"], traces[axis], style, color=colour, lw=1.0, label=controller
                )
            panel.tick_params(labelsize=8)
            if i == 0:
                panel.set_title(f"rig {rig}", fontsize=9)
            if j == 0:
                name = {"alpha_v": "pitch", "alpha_h": "yaw"}[axis]
                panel.set_ylabel(f"{reference}\n{name} [rad]", fontsize=8)
            if i == len(rows) - 1:
                panel.set_xlabel("time [s]", fontsize=8)
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), fontsize=9)
    return figure
