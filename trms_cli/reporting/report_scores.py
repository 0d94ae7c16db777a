"""A score as tables of a page: one run's figures by channel, or several runs' side by side."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from trms_cli.core.findings import Cell, Judged
from trms_cli.reporting.page import Page
from trms_cli.reporting.report_signals import label_of
from trms_cli.reporting.reported import ReportedRun

#: Figures of a channel: key, label, unit ({} is the channel's).
TRACKING = (
    ("rmse", "RMSE", "{}"),
    ("iae", "IAE", "{} s"),
    ("ise", "ISE", "{}² s"),
    ("itae", "ITAE", "{} s²"),
    ("max_abs_error", "largest error", "{}"),
    ("steady_state_error", "steady-state error", "{}"),
    ("overshoot_percent", "overshoot, worst step", "%"),
    ("overshoot_median_percent", "overshoot, median", "%"),
    ("rise_time_s", "rise time, worst step", "s"),
    ("settling_time_s", "settling time, worst step", "s"),
    ("settling_time_median_s", "settling time, median", "s"),
    ("unsettled_steps", "steps not settled", ""),
)
INPUTS = (
    ("effort", "effort ∫u²dt", "{}² s"),
    ("total_variation", "total variation Σ|Δu|", "{}"),
    ("saturation_share", "share of time at a limit", ""),
)
SOLVER = (
    ("time_ms.median", "time of a step, median", "ms"),
    ("time_ms.p99", "time of a step, 99th percentile", "ms"),
    ("time_ms.max", "time of a step, longest", "ms"),
    ("deadline_misses", "deadlines missed", ""),
    ("failures", "failures and fall-backs", ""),
    ("iterations_mean", "iterations on average", ""),
)


def figure(score: Mapping[str, Any], *path: str) -> float | None:
    """A figure of a score by its keys; None for what it does not have, or is no finite number."""
    found: Any = score
    for key in path:
        found = found.get(key) if isinstance(found, Mapping) else None
    if isinstance(found, bool) or not isinstance(found, (int, float)):
        return None
    return found if math.isfinite(found) else None


def score_tables(page: Page, run: ReportedRun) -> None:
    """The tables of one run."""
    score = run.score
    _by_name(page, "tracking", score.get("channels"), TRACKING, "Tracking, by channel.")
    _by_name(page, "inputs", score.get("inputs"), INPUTS, "What it took, by input.")
    _estimate(page, score.get("estimate"))
    rows: list[list[Cell]] = [
        [axis(label, unit), _judged(key, value)]
        for key, label, unit in SOLVER
        if (value := figure(score, "solver", *key.split("."))) is not None
    ]
    if rows:
        page.table(["solver", "value"], rows)
    _violations(page, score.get("constraint_violations"))


def compared_rows(runs: Sequence[ReportedRun]) -> list[list[Cell]]:
    """Rows of figures, a column a run, the best of each row marked."""
    rows: list[list[Cell]] = []
    for group, figures in (("channels", TRACKING), ("inputs", INPUTS)):
        for name in dict.fromkeys(n for run in runs for n in _mapping(run.score, group)):
            for key, label, unit in figures:
                own = next(
                    (
                        str(t.get("unit", ""))
                        for run in runs
                        if (t := _mapping(_mapping(run.score, group), name))
                    ),
                    "",
                )
                values = [figure(run.score, group, name, key) for run in runs]
                title = axis(f"{label_of(name)}: {label}", unit.replace("{}", own).strip())
                rows += _compared(title, values)
    for key, label, unit in SOLVER:
        values = [figure(run.score, "solver", *key.split(".")) for run in runs]
        judged = key != "iterations_mean"
        rows += _compared(axis(label, unit), values, judged=judged)
    return rows


def axis(label: str, unit: str) -> str:
    """``RMSE [rad]``."""
    return f"{label} [{unit}]" if unit else label


def _compared(
    title: str, values: Sequence[float | None], *, judged: bool = True
) -> list[list[Cell]]:
    known = [value for value in values if value is not None]
    if not known:
        return []
    # Equal to the digits that are shown is no victory.
    least, largest = min(known), max(known)
    apart = judged and len(known) > 1 and largest - least > 1e-3 * max(abs(largest), abs(least))
    best = least if apart else None
    return [[title, *(Judged(v, "best" if v is not None and v == best else "") for v in values)]]


def _by_name(
    page: Page, title: str, told: Any, figures: Sequence[tuple[str, str, str]], caption: str
) -> None:
    if not isinstance(told, Mapping) or not told:
        return
    names = list(told)
    rows: list[list[Cell]] = []
    for key, label, unit in figures:
        values = [figure(told, name, key) for name in names]
        if any(value is not None for value in values):
            own = str(_mapping(told, names[0]).get("unit", ""))
            rows.append([axis(label, unit.replace("{}", own).strip()), *values])
    page.table([title, *map(label_of, names)], rows, caption)


def _estimate(page: Page, told: Any) -> None:
    if not isinstance(told, Mapping):
        return
    columns = {"RMSE of the state": "rmse", "RMSE one step ahead": "prediction_rmse"}
    names = dict.fromkeys(n for key in columns.values() for n in _mapping(told, key))
    units = _mapping(told, "units")
    rows: list[list[Cell]] = [
        [
            axis(name, str(units.get(name, ""))),
            *(figure(told, key, name) for key in columns.values()),
        ]
        for name in names
        if any(figure(told, key, name) for key in columns.values())
    ]
    words = [
        f"{label} {value:.3g} ({expected:g} is consistent, more is overconfident)"
        for key, label in (("nees", "NEES"), ("nis", "NIS"))
        if (value := figure(told, f"{key}_mean")) is not None
        and (expected := figure(told, f"{key}_expected")) is not None
    ]
    if rows:
        page.table(["estimate", *columns], rows, "; ".join(words))


def _violations(page: Page, told: Any) -> None:
    if not isinstance(told, Mapping):
        return
    rows: list[list[Cell]] = [
        [axis(label_of(name), str(_mapping(told, name).get("unit", ""))),
         Judged(figure(told, name, "samples"), "bad"), figure(told, name, "worst")]
        for name in told
        if figure(told, name, "samples")
    ]  # fmt: skip
    if rows:
        page.table(["limits that were exceeded", "samples", "worst excess"], rows)


def _judged(key: str, value: float) -> Judged:
    bad = key in ("deadline_misses", "failures") and value > 0
    return Judged(value, "bad" if bad else "")


def _mapping(owner: Any, key: str) -> Mapping[str, Any]:
    found = owner.get(key) if isinstance(owner, Mapping) else None
    return found if isinstance(found, Mapping) else {}
