"""The tables of ``docs/chapter2.md``, written between their marks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from experiments.chapter2.agreement import Agreement, TermStudy
from experiments.chapter2.axes import ANGLES, Comparison
from experiments.chapter2.bench_tests import BenchTestResult
from experiments.chapter2.bridge import TERMS
from experiments.chapter2.rotors import RotorStudy
from experiments.chapter2.simulation import Difference

_ROTOR_OF_AXIS = {"v": "main", "h": "tail"}


def rotor_tables(rotors: Sequence[RotorStudy]) -> dict[str, str]:
    """Steps, then sines."""
    steps = [
        [
            _ROTOR_OF_AXIS[r.axis],
            f"{size:g}",
            f"{r.steps[size].outputs[f'omega_{r.axis}'].max():.1f}",
            f"{r.rises[size]:.2f}",
            f"{r.settles[size]:.2f}",
            f"{r.falls[size]:.2f}",
        ]
        for r in rotors
        for size in r.steps
    ]
    sines = [
        [_ROTOR_OF_AXIS[r.axis], f"{f:g}", f"{r.gains[f]:.1f}", f"{r.lags[f]:.0f}"]
        for r in rotors
        for f in r.gains
    ]
    return {
        "rotor steps": _table(
            ["rotor", "step [V]", "speed [rad/s]", "rise 10–90 % [s]", "within 2 % [s]",
             "fall to 10 % [s]"],
            steps,
        ),
        "rotor sines": _table(["rotor", "[Hz]", "gain [(rad/s)/V]", "lag [°]"], sines),
    }  # fmt: skip


def one_axis_table(cases: Sequence[Comparison]) -> str:
    """Both models in the thesis's cases with one axis."""
    angle = next(name for name in cases[0].differences if name in ANGLES)
    rows = [
        [
            case.name,
            _range(case, angle),
            *_cells(case.differences[angle]),
            "yes" if case.lagrangian.stopped or case.newtonian.stopped else "",
        ]
        for case in cases
    ]
    return _table(
        ["case", "range [rad]", "RMS [mrad]", "max [mrad]", "fit [%]", "stop reached"], rows
    )


def two_axes_tables(cases: Sequence[Comparison]) -> dict[str, str]:
    """What the nine cases are, and how far the models are apart in them."""
    designs = [[case.name, case.why, *(_range(case, a) for a in ANGLES)] for case in cases]
    errors = [
        [case.name, *(cell for a in ANGLES for cell in _cells(case.differences[a]))]
        for case in cases
    ]
    return {
        "nine cases": _table(["case", "why", "pitch [rad]", "yaw [rad]"], designs),
        "nine errors": _table(
            [
                "case",
                *(f"{axis} {figure}" for axis in ("pitch", "yaw")
                  for figure in ("RMS [mrad]", "max [mrad]", "fit [%]")),
            ],
            errors,
        ),
    }  # fmt: skip


def agreement_tables(agreements: Sequence[Agreement], terms: Sequence[TermStudy]) -> dict[str, str]:
    """Where they agree; what each term does."""
    same = [[a.what, f"{a.largest:.1e}", f"{a.travel:.2f}"] for a in agreements]
    parts = [
        [t.name, _pair(t.newtonian), *(_pair(t.left_wrong[term]) for term in TERMS), _pair(t.arm)]
        for t in terms
    ]
    return {
        "agreement": _table(["what", "largest difference [rad]", "range [rad]"], same),
        "terms": _table(["case", "all four", *TERMS, "arm h"], parts),
    }


def bench_table(results: Sequence[BenchTestResult]) -> str:
    """Parameters by bench test."""
    rows = [
        [
            f"`{f.name}`",
            f.test,
            f"{f.true:.4g}",
            f.unit.replace("*", " ").replace("^2", "²"),
            f"{f.bias_percent:+.2f}",
            f"{f.sd_percent:.2f}",
        ]
        for f in results
    ]
    return _table(["parameter", "test", "true", "unit", "bias [%]", "sd of one test [%]"], rows)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cells(d: Difference) -> tuple[str, str, str]:
    fit = "–" if math.isnan(d.fit) else f"{d.fit:.1f}"
    return f"{1e3 * d.rms:.1f}", f"{1e3 * d.largest:.1f}", fit


def _pair(values: Mapping[str, float]) -> str:
    return ", ".join(f"{1e3 * values[a]:.1f}" for a in ANGLES)


def _range(case: Comparison, angle: str) -> str:
    values = case.lagrangian.outputs[angle]
    return f"{values.min():.2f} … {values.max():.2f}"
