"""The tables of ``docs/chapter8.md``, written between their marks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from experiments.chapter8.coverage import ContainmentCheck, Gain
from experiments.chapter8.domain import Map
from experiments.chapter8.laws import LawResult, Switching
from experiments.chapter8.runs import Ran


def runs_tables(runs: Sequence[Ran]) -> dict[str, str]:
    """Each start, and the means over the starts."""
    rows = []
    for controller, observer in dict.fromkeys((r.case.controller, r.case.observer) for r in runs):
        mine = [r for r in runs if (r.case.controller, r.case.observer) == (controller, observer)]
        rows.append(
            [
                controller,
                observer,
                *(f"{np.mean([r.ise[a] for r in mine]):.2f}" for a in ("alpha_h", "alpha_v")),
                *(_worst([r.settling[a] for r in mine]) for a in ("alpha_h", "alpha_v")),
                *(f"{np.mean([r.effort[u] for r in mine]):.1f}" for u in ("u_v", "u_h")),
                f"{100 * np.mean([r.relaxed for r in mine]):.1f}",
                f"{100 * np.mean([r.failed for r in mine]):.1f}",
            ]
        )
    times = []
    for controller in dict.fromkeys(r.case.controller for r in runs):
        mine = [r for r in runs if r.case.controller == controller]
        median = float(np.median([r.median_ms for r in mine]))
        times.append([controller, f"{median:.3g}", f"{max(r.worst_ms for r in mine):.3g}"])
    single = [
        [
            f"({r.case.start[0]:g}, {r.case.start[1]:g})",
            r.case.controller,
            *(f"{r.ise[a]:.2f}" for a in ("alpha_h", "alpha_v")),
            *(_number(r.settling[a], ".1f") for a in ("alpha_h", "alpha_v")),
            f"{r.largest:.2f}",
        ]
        for r in sorted(runs, key=lambda r: r.case.start[::-1])
        if r.case.observer == "full_state"
    ]
    return {
        "runs": _table(
            ["controller", "observer", "ISE yaw [rad² s]", "ISE pitch", "settled yaw, worst [s]",
             "pitch", "changes of u_v [V]", "u_h", "relaxed [%]", "failed [%]"],
            rows,
        ),
        "starts": _table(
            ["start (yaw, pitch)", "controller", "ISE yaw [rad² s]", "ISE pitch",
             "settled yaw [s]", "pitch", "largest command [V]"],
            single,
        ),
        "times": _table(["controller", "median step [ms]", "longest step [ms]"], times),
    }  # fmt: skip


def coverage_table(checks: Sequence[ContainmentCheck]) -> str:
    """Polytopes against independent points."""
    rows = [
        [
            f"{c.size:g}",
            str(2**c.components),
            f"{c.spread:.3f}",
            f"{100 * c.inside:.2f}",
            f"{100 * c.outside_bound:.2f}",
            f"{c.median:.4f}",
            f"{c.largest:.4f}",
            f"{c.residual:.4f}",
        ]
        for c in checks
    ]
    return _table(
        ["half-width of the region", "vertices", "spread", "inside [%]", "outside at most [%]",
         "remainder, median", "largest", "residual of the form"],
        rows,
    )  # fmt: skip


def standstill_table(gains: Sequence[Gain]) -> str:
    """The treatments of the standing tail rotor."""
    rows = [
        [
            g.name,
            f"{100 * g.weakest:.1f}",
            _number(g.gamma, ".3g"),
            f"{1e3 * g.neglected:.4f}",
            f"{g.yaw:.4f}",
        ]
        for g in gains
    ]
    return _table(
        ["coordinate", "weakest gain [% of the strongest]", "γ", "neglected torque [mN m]",
         "yaw it holds off [rad]"],
        rows,
    )  # fmt: skip


def laws_tables(laws: Sequence[LawResult]) -> dict[str, str]:
    """Bounds and certificates, then switching."""
    bounds = [
        [
            f"({w.start[0]:g}, {w.start[1]:g})",
            w.region,
            str(w.vertices),
            w.kind.replace("_", " "),
            "–" if w.certificate is None else _number(w.certificate.gamma, ".3g"),
            "–" if w.certificate is None else f"{w.certificate.contraction:.4f}",
            "–" if w.certificate is None else f"{w.certificate.residuals.min():+.1e}",
            _number(w.slack, ".2f"),
            "yes" if w.covered else "no",
            _number(100 * w.decreasing, ".1f"),
        ]
        for w in laws
    ]
    switched = [
        [
            f"({w.start[0]:g}, {w.start[1]:g})",
            w.region,
            str(w.vertices),
            w.kind.replace("_", " "),
            *_switching(w.greedy),
            *_switching(w.random),
        ]
        for w in laws
        if w.greedy is not None
    ]
    kinds = [
        f"{way} {what}" for way in ("greedy:", "random:") for what in ("cost/γ", "rise", "input")
    ]
    start = ["start (yaw, pitch)", "region", "vertices", "Lyapunov"]
    return {
        "laws": _table(
            [*start, "γ", "contraction", "least eigenvalue", "slack", "within its region",
             "true coefficients with decrease [%]"],
            bounds,
        ),
        "switching": _table([*start, *kinds], switched),
    }  # fmt: skip


def domain_table(domain_map: Map) -> str:
    """Shares of the grid."""
    return _table(
        ["controller", "starts held [%]"],
        [[name, f"{100 * share:.0f}"] for name, share in domain_map.shares.items()],
    )


def _switching(s: Switching | None) -> list[str]:
    return ["–"] * 3 if s is None else [f"{s.cost:.3f}", f"{s.rise:.4f}", f"{s.inputs:.3f}"]


def _worst(values: Sequence[float]) -> str:
    return "not" if any(math.isnan(v) for v in values) else f"{max(values):.1f}"


def _number(value: float, form: str) -> str:
    return "–" if math.isnan(value) else format(value, form)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
