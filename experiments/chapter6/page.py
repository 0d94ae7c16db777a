"""The tables of ``docs/chapter6.md``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from experiments.chapter6.cases import ANGLES, Run
from experiments.chapter6.decrease import Claim
from experiments.chapter6.domain import Arrivals, FeasibleStates
from experiments.chapter6.iterations import Economy
from experiments.chapter6.study import Case, Domain

_NAMES = {
    "equality": "equality",
    "quasi_infinite": "quasi-infinite",
    "none": "none",
    "preview": "equality, preview",
}


def case_tables(cases: Mapping[str, Case], runs: Sequence[Run]) -> dict[str, str]:
    """What the cases are, and their scores."""
    designs = [
        [name.replace("_", " "), case.why, *(_signal(case, angle) for angle in ANGLES)]
        for name, case in cases.items()
        if any(run.case == name for run in runs)
    ]
    scores = []
    for run in runs:
        pitch, yaw = (run.score["channels"][angle] for angle in ANGLES)
        total = sum(run.statuses.values())
        scores.append(
            [
                run.case.replace("_", " "),
                _NAMES.get(run.controller, run.controller),
                _pair(pitch, yaw, "rmse", "{:.4f}"),
                _pair(pitch, yaw, "overshoot_percent", "{:.1f}"),
                _pair(pitch, yaw, "settling_time_s", "{:.2f}"),
                f"{100 * run.statuses.get('relaxed', 0) / total:.1f}",
                f"{100 * run.statuses.get('budget', 0) / total:.1f}",
                str(run.statuses.get("failed", 0)),
            ]
        )
    return {
        "six cases": _table(["case", "why", "pitch", "yaw"], designs),
        "six scores": _table(
            [
                *("case", "terminal", "RMSE pitch, yaw [rad]", "overshoot [%]", "settling [s]"),
                *("relaxed [%]", "not converged [%]", "failed"),
            ],
            scores,
        ),
    }


def decrease_table(claims: Sequence[Claim]) -> str:
    """The claim, mode by mode."""
    rows = [
        [
            c.mode,
            str(c.samples),
            f"{100 * c.held:.1f}",
            f"{100 * c.kept:.2f}",
            f"{100 * c.kept_with_move:.2f}" if c.mode.startswith("equality") else "–",
            f"{c.worst:.1e}",
            f"{c.shifted:.1e}" if not c.mode.startswith("none") else "–",
            f"{100 * c.converged:.1f}",
            f"{c.arrived:.4f}",
        ]
        for c in claims
    ]
    header = [
        *(
            "mode",
            "samples",
            "constraint met [%]",
            "J falls by ℓ [%]",
            "by ℓ less the last move [%]",
        ),
        *("worst, of J", "shifted plan misses by", "converged [%]", "largest error at 5 s [rad]"),
    ]
    return _table(header, rows)


def domain_tables(
    study: Domain,
    box: FeasibleStates,
    slices: Mapping[str, FeasibleStates],
    arrivals: Sequence[Arrivals],
) -> dict[str, str]:
    """Feasible shares by horizon, and the loops."""
    shares = [
        [
            str(horizon),
            *(
                f"{100 * feasible_states.feasible[terminal, horizon].mean():.1f}"
                for feasible_states in (box, *slices.values())
                for terminal in study.terminals
            ),
        ]
        for horizon in study.horizons
    ]
    short = {"equality": "eq.", "quasi_infinite": "q.-i."}
    header = ["N"]
    for what in ("box", *slices):
        header += [f"{what}, {short.get(t, t)} [%]" for t in study.terminals]
    loops = [
        [
            str(row.horizon),
            _NAMES[row.terminal],
            "–" if math.isnan(row.feasible) else f"{100 * row.feasible:.0f}",
            f"{100 * row.arrived:.0f}",
            f"{row.cost:.2f}",
        ]
        for row in sorted(arrivals, key=lambda row: row.horizon)
    ]
    return {
        "feasible": _table(header, shares),
        "loops": _table(
            ["N", "terminal", "met at the first sample [%]", "arrived [%]", "mean cost"], loops
        ),
    }


def iteration_table(rows: Sequence[Economy]) -> str:
    """Cost and time by the number of iterations."""
    unit = {(r.reference, r.horizon): r for r in rows if r.count == 1}
    best = {key: min(r.cost for r in rows if (r.reference, r.horizon) == key) for key in unit}
    lines = [
        [
            r.horizon,
            r.reference,
            str(r.count),
            f"{r.mean_iterations:.2f}",
            f"{100 * (r.cost / best[r.reference, r.horizon] - 1):.2f}",
            f"{r.seconds / unit[r.reference, r.horizon].seconds:.2f}",
        ]
        for r in rows
    ]
    header = ["horizon", "reference", "iterations at most", "mean", "cost above the best [%]"]
    return _table([*header, "time a sample, of one iteration"], lines)


def _signal(case: Case, angle: str) -> str:
    reference = getattr(case, angle)
    offset = f" + {reference['offset']:g}" if reference.get("offset") else ""
    return f"±{reference['amplitude']:g}{offset} rad, {reference['frequency']:.3g} Hz".replace(
        "+ -", "− "
    )


def _pair(pitch: Mapping[str, float], yaw: Mapping[str, float], key: str, form: str) -> str:
    values = [channel.get(key) for channel in (pitch, yaw)]
    if all(value is None for value in values):
        return "–"
    return ", ".join("–" if value is None else form.format(value) for value in values)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
