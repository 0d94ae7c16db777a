"""The tables of ``docs/chapter7.md`` that the cases make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from experiments.chapter7.runs import ANGLES, Outcome
from experiments.chapter7.study import Study


def tables_of(study: Study, outcomes: Sequence[Outcome]) -> dict[str, str]:
    """Markdown by mark of the page: the cases of each part, and the steady states."""
    tables = {
        part: _cases(study, part, [o for o in outcomes if o.job.part == part])
        for part in study.parts
    }
    tables["steady state"] = _steady(study, outcomes)
    return tables


def _cases(study: Study, part: str, outcomes: Sequence[Outcome]) -> str:
    rows = []
    for outcome in outcomes:
        figures = outcome.figures
        if not figures:
            rows.append([outcome.job.case, outcome.job.pair, outcome.problem, *[""] * 4])
            continue
        rows.append(
            [
                outcome.job.case,
                f"`{outcome.job.pair}`",
                _both(figures, "rmse", "{:.4f}"),
                _both(figures, "overshoot_percent", "{:.1f}"),
                _both(figures, "estimate_rmse", "{:.2f}", 1e3),
                f"{figures['u_v']['total_variation']:.0f}, {figures['u_h']['total_variation']:.0f}",
                str(figures["failures"]),
            ]
        )
    heads = [
        *("case", "pair", "RMSE pitch, yaw [rad]", "overshoot [%]"),
        *("estimate's RMSE [mrad]", "variation of u_v, u_h [V]", "failures"),
    ]
    references = [[case, text.what] for case, text in study.parts[part].cases.items()]
    return f"{_table(['case', 'reference'], references)}\n\n{_table(heads, rows)}"


def _steady(study: Study, outcomes: Sequence[Outcome]) -> str:
    """Errors at the end of the steps, in steps of the encoders."""
    rows = []
    for outcome in outcomes:
        if not outcome.figures or not _rests(study, outcome):
            continue
        cells = []
        for angle in ANGLES:
            of = outcome.figures[angle]
            mean, most = (of[f"last_{k}_error"] / study.encoder_step for k in ("mean", "largest"))
            cells += [f"{mean:+.2f}", f"{most:.2f}"]
        rows.append([outcome.job.case, f"`{outcome.job.pair}`", *cells])
    heads = ["case", "pair", "pitch, mean", "pitch, largest", "yaw, mean", "yaw, largest"]
    return _table(heads, rows)


def _rests(study: Study, outcome: Outcome) -> bool:
    """Whether the reference stands still at the case's end, and long enough before."""
    traces = outcome.traces
    late = traces["time"] >= traces["time"][-1] - 1.2 * study.last
    return all(float(abs(traces[f"r_{a}"][late] - traces[f"r_{a}"][-1]).max()) == 0 for a in ANGLES)


def _both(figures: Mapping[str, Any], name: str, form: str, scale: float = 1.0) -> str:
    values = [figures[angle][name] for angle in ANGLES]
    return ", ".join("–" if value is None else form.format(scale * value) for value in values)


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
