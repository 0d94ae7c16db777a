"""The tables of ``docs/chapter2.md``, written between their marks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from experiments.chapter2.agreement import Agreement, TermStudy
from experiments.chapter2.axes import ANGLES, Comparison, pair_of_commands
from experiments.chapter2.bench_tests import BenchTestResult
from experiments.chapter2.bridge import TERMS
from experiments.chapter2.friction import PROFILES, FrictionStudy
from experiments.chapter2.interface import InterfaceStudy
from experiments.chapter2.paths import Path as SignalPath
from experiments.chapter2.rotors import RotorStudy
from experiments.chapter2.simulation import Difference, FloatArray
from experiments.chapter2.study import Study
from experiments.page_tables import number
from trms_cli.identification.validation.metrics import (
    Characteristics,
    characteristics,
    segments_of,
    spectrum,
)

_ROTOR_OF_AXIS = {"v": "main", "h": "tail"}
#: V, standard deviation below which a command stands still.
_CONSTANT = 1e-9


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


def interface_table(circuits: Sequence[InterfaceStudy]) -> str:
    """Gains and limits."""
    rows = [
        [
            c.rotor,
            f"{c.gain:g}",
            f"{2.5 * c.gain:.2f}",
            f"{c.limit:g}",
            f"{c.saturates_at:.2f}",
            f"{c.currents[-1]:.2f}",
        ]
        for c in circuits
    ]
    return _table(
        ["motor", "gain [V/V]", "voltage at 2.5 V [V]", "limit [V]", "reached at [V]",
         "steady current at the limit [A]"],
        rows,
    )  # fmt: skip


def friction_table(rigs: Sequence[FrictionStudy]) -> str:
    """What each profile does to the rigs with one axis."""
    rows = [
        [
            rig.freedom,
            {"viscous": "viscous", "Coulomb": "and Coulomb", "stiction": "and stiction"}[profile],
            f"{1e3 * abs(rig.viscous[-1] / rig.rates[-1]):.1f}",
            f"{1e3 * abs(rig.dry[profile][-1]):.2f}",
            f"{1e3 * rig.break_away[profile]:.2f}",
            "–" if math.isnan(rig.rests[profile]) else f"{rig.rests[profile]:.1f}",
            "–" if math.isnan(rig.rests[profile]) else f"{1e3 * rig.offsets[profile]:+.1f}",
        ]
        for rig in rigs
        for profile in PROFILES
    ]
    return _table(
        ["rig", "profile", "viscous [mN m s]", "Coulomb [mN m]", "break-away [mN m]",
         "free swing rests after [s]", "beside the equilibrium [mrad]"],
        rows,
    )  # fmt: skip


def signals_of(study: Study) -> dict[str, list[Characteristics]]:
    """Statistics of both commands of the nine cases.

    The spectrum is of the whole signal: no noise has to be averaged, and its lines are narrow.
    """
    return {
        name: [
            _whole_spectrum(
                characteristics(channel, "V", values, study.sample_time), values, study.sample_time
            )
            for channel, values in zip(("u_v", "u_h"), commands.T, strict=True)
        ]
        for name in study.two_axes
        for commands in [pair_of_commands(study, name)]
    }


def _whole_spectrum(c: Characteristics, values: FloatArray, sample_time: float) -> Characteristics:
    if not moves(c):
        return c
    density = spectrum(segments_of(values, sample_time, len(values)))
    share = np.cumsum(density.density) / density.density.sum()
    return replace(
        c,
        peak_frequency=float(density.frequencies[int(np.argmax(density.density))]),
        band_edge=float(density.frequencies[int(np.searchsorted(share, 0.95))]),
    )


def moves(c: Characteristics) -> bool:
    """Whether a command is no constant."""
    return c.sd > _CONSTANT


def signal_table(signals: Mapping[str, Sequence[Characteristics]]) -> str:
    """The nine pairs of commands, two rows each."""
    rows = [
        [
            name,
            c.name,
            f"{c.least:.2f} … {c.largest:.2f}",
            f"{c.mean if abs(c.mean) > 5e-4 else 0.0:.3f}",
            f"{c.sd:.3f}",
            _or_dash(_crest(c)),
            *(
                _or_dash(v if moves(c) else math.nan)
                for v in (c.correlation_time, c.peak_frequency, c.band_edge)
            ),
        ]
        for name, channels in signals.items()
        for c in channels
    ]
    return _table(
        ["case", "command", "range [V]", "mean [V]", "sd [V]", "crest factor",
         "correlation time [s]", "peak [Hz]", "95 % of the power below [Hz]"],
        rows,
    )  # fmt: skip


def _crest(c: Characteristics) -> float:
    """Largest deviation from the mean over the standard deviation."""
    return max(c.largest - c.mean, c.mean - c.least) / c.sd if moves(c) else math.nan


def _or_dash(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3g}"


_SYMBOLS = {
    "u_v": "u_v",
    "u_h": "u_h",
    "omega_v": "ω_v",
    "omega_h": "ω_h",
    "alpha_v": "α_v",
    "alpha_h": "α_h",
}


def _sign(p: SignalPath) -> str:
    """Of what a slow rise does at first: of the answer itself, or to the rate of a command."""
    value = p.response[0].imag if p.passes_band else p.static_gain
    return "+" if value > 0 else "−"


def path_table(paths: Sequence[SignalPath]) -> str:
    """Nine pairs of signals, as multisines find them."""
    rows = [
        [
            f"{_SYMBOLS[p.source]} → {_SYMBOLS[p.target]}",
            "–" if p.passes_band else number(p.static_gain),
            _sign(p),
            f"{p.peak_frequency:.2f}: {number(p.peak)}",
            _or_dash(p.resonance),
            f"{p.bandwidth:.2f}",
            _or_dash(p.delay),
            f"{p.mean_coherence(p.coherence):.4f}",
            f"{p.mean_coherence(p.coherence_large):.4f}",
        ]
        for p in paths
    ]
    return _table(
        ["pair", "static gain", "sign", "largest gain, at [Hz]", "resonance [dB]",
         "bandwidth [Hz]", "delay [s]", "coherence", "five times larger"],
        rows,
    )  # fmt: skip


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
