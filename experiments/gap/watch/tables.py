"""What came out, as tables in plain text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from experiments.gap.blind.truths import same_equation
from experiments.gap.watch.evaluate import BLOCK
from trms_cli.gap.watch.gap_watch import GapWatch

Row = Mapping[str, Any]
_TEN_HOURS = 36_000.0  # s
_THRESHOLDS = (30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 100.0)
_SOON = 5.0  # s


def hours_watched(rows: Iterable[Row], config: GapWatch) -> float:
    """In tens of hours, without the time in which it is learnt what is usual."""
    return math.fsum(row["duration"] - config.learning for row in rows) / _TEN_HOURS


def crossings(row: Row, threshold: float) -> int:
    """How often a threshold is passed: blocks that follow one another count once."""
    over = [begin for begin, value, _ in row["blocks"] if value > threshold]
    return sum(1 for i, begin in enumerate(over) if i == 0 or begin - over[i - 1] > 1.5 * BLOCK)


def poisson_interval(count: int) -> tuple[float, float]:
    """95 % interval of the mean of a count (Garwood 1936)."""
    from scipy.stats import chi2

    low = chi2.ppf(0.025, 2 * count) / 2 if count else 0.0
    return float(low), float(chi2.ppf(0.975, 2 * count + 2) / 2)


def calibration(rows: Sequence[Row], config: GapWatch) -> str:
    """Crossings in ten hours by threshold, and where they come from."""
    lines = [f"{'threshold':>9}  {'in ten hours':>14}  {'open loop':>9}  {'closed':>6}   by test"]
    drives = {drive: [r for r in rows if r["drive"] == drive] for drive in ("rich", "closed_loop")}
    for threshold in _THRESHOLDS:
        counts = [
            sum(crossings(r, threshold) for r in part) / hours_watched(part, config)
            for part in (rows, drives["rich"], drives["closed_loop"])
        ]
        tests: dict[str, int] = {}
        for row in rows:
            for _, value, test in row["blocks"]:
                if value > threshold:
                    tests[test] = tests.get(test, 0) + 1
        by_test = ", ".join(f"{n} {test}" for test, n in sorted(tests.items(), key=lambda i: -i[1]))
        lines.append(
            f"{threshold:9.0f}  {counts[0]:14.2f}  {counts[1]:9.2f}  {counts[2]:6.2f}   {by_test}"
        )
    maxima = np.sort([value for row in rows for _, value, _ in row["blocks"]])
    beyond = maxima[maxima > np.quantile(maxima, 0.99)]
    scale = float((beyond - beyond[0]).mean())
    lines.append(
        f"{hours_watched(rows, config) * 10:.2f} h watched; beyond {beyond[0]:.0f} the largest of "
        f"{BLOCK:g} s fall off as exp(−T/{scale:.1f})"
    )
    return "\n".join(lines)


def proof(rows: Sequence[Row], config: GapWatch) -> str:
    """False alarms, delays, onsets, places."""
    lines = [*_false_alarms(rows, config), ""]
    onsets = [row for row in rows if row["kind"] == "onset"]
    if not onsets:
        return "\n".join(lines[:-2])
    lines += [_header(), _summary("all", onsets)]
    for effect in sorted({row["effect"] for row in onsets}):
        lines.append(_summary(effect, [row for row in onsets if row["effect"] == effect]))
    return "\n".join(lines)


def _changes(row: Row) -> list[Mapping[str, Any]]:
    return [alarm for alarm in row["alarms"] if alarm["kind"] == "change"]


def _false_alarms(rows: Sequence[Row], config: GapWatch) -> Iterable[str]:
    for kind in ("steady", "offset"):
        part = [row for row in rows if row["kind"] == kind]
        if not part:
            continue
        count, tens = sum(len(_changes(row)) for row in part), hours_watched(part, config)
        low, high = (end / tens for end in poisson_interval(count))
        misfits = sum(any(a["kind"] == "misfit" for a in row["alarms"]) for row in part)
        yield (
            f"{kind}: {count} false alarms in {10 * tens:.2f} h, {count / tens:.2f} in ten hours "
            f"({low:.2f} to {high:.2f}); the model is said not to fit on {misfits} of {len(part)}"
        )
        for row in part:
            for alarm in _changes(row):
                yield (
                    f"    {row['drive']}: {alarm['location']} {alarm['form']} "
                    f"{alarm['size']:.3g} {alarm['unit']}, statistic {alarm['statistic']:.0f}"
                )
    before = [
        alarm
        for row in rows
        for alarm in _changes(row)
        if row["onset"] is not None and alarm["time"] < row["onset"]
    ]
    yield f"onset: {len(before)} alarms before it"


def _header() -> str:
    return (
        f"{'effect':26}{'rigs':>5}{'alarm':>7}{'≤ 5 s':>7}{'delay s':>9}{'onset s':>9}"
        f"{'90 %':>7}{'≤ 1 s':>7}{'equation':>10}"
    )


def _summary(name: str, rows: Sequence[Row]) -> str:
    """Of the first alarm after the onset; no alarm counts as an infinite delay."""
    delays, errors, places = [], [], []
    for row in rows:
        first = next((a for a in _changes(row) if a["time"] >= row["onset"]), None)
        delays.append(math.inf if first is None else first["time"] - row["onset"])
        if first is None:
            continue
        errors.append(abs(first["since"] - row["onset"]))
        right = {other for place in row["locations"] for other in same_equation(place)}
        places.append(first["location"] in right)
    share = np.mean(np.isfinite(delays))
    soon = np.mean(np.array(delays) <= _SOON)
    text = f"{name:26}{len(rows):5d}{share:7.0%}{soon:7.0%}{np.median(delays):9.2f}"
    if not errors:
        return text
    near = np.mean(np.array(errors) <= 1.0)
    text += f"{np.median(errors):9.2f}{np.quantile(errors, 0.9):7.2f}{near:7.0%}"
    return text + f"{np.mean(places):10.0%}"
