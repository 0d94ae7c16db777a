"""Modes and loci of eigenvalues in words, tables and data."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from trms_cli.core.findings import Cell, Column, Judged, Judgement, Table, rounded, table
from trms_cli.models.model import Model
from trms_cli.stability.local.linear import Switch
from trms_cli.stability.local.modes import STILL, EigenMode, Modes, parts_of, shares_of_parts
from trms_cli.stability.local.sweep import Locus, cell, unit_of

_JUDGED: dict[str, Judgement] = {"stable": "good", "marginal": "doubtful", "unstable": "bad"}
#: Rows of the table over a range.
_ROWS = 9


def eigenvalue_words(value: complex, digits: int = 4) -> str:
    """``−0.047 ± 1.83j``."""
    both = [value, value.conjugate()] if abs(value.imag) > STILL else [value]
    return cell(np.array(both), digits)


def mode_table(modes: Modes, caption: str = "") -> Table:
    """Names, eigenvalues, damping, frequencies, time constants, verdicts."""

    def swing(value: Callable[[EigenMode], float | None]) -> Callable[[EigenMode], Cell]:
        """A cell of what swings only."""
        return lambda mode: _sig(value(mode)) if mode.oscillates else None

    return table(
        modes.modes,
        [
            Column("mode", lambda m: m.name + f" (×{m.multiplicity})" * (m.multiplicity > 1)),
            Column("λ [1/s]", lambda m: eigenvalue_words(m.eigenvalue, 3)),
            Column("damping ζ", swing(lambda m: m.damping_ratio)),
            Column("ω_n [rad/s]", lambda m: _sig(m.natural_frequency)),
            Column("ω_d [rad/s]", swing(lambda m: m.damped_frequency)),
            Column("f_d [Hz]", swing(lambda m: m.damped_frequency / (2 * math.pi))),
            Column("τ [s]", lambda m: _sig(m.time_constant)),
            Column("verdict", lambda m: Judged(verdict_words(m), _JUDGED[m.verdict])),
        ],
        caption,
    )


def verdict_words(mode: EigenMode) -> str:
    """``stable``, ``unstable``, ``marginal``, ``unstable (grows with t)``."""
    if mode.verdict == "unstable" and mode.eigenvalue.real <= STILL:
        return "unstable (grows with t)"
    return mode.verdict


def participation_table(model: Model, modes: Modes) -> Table:
    """Shares of the states in each mode, in percent."""
    return Table(
        ("mode", *(f"{name} [%]" for name in model.state_names)),
        [
            [mode.name, *(round(100.0 * float(share), 1) for share in mode.participation)]
            for mode in modes.modes
        ],
        "Participation factors |w_i v_i| as shares of their sum.",
        on_screen=False,
    )


def range_table(locus: Locus) -> Table:
    """λ of each mode at some points of the range."""
    path, sweep = locus.path, locus.sweep
    count = len(sweep.places)
    wanted = np.linspace(sweep.values[0], sweep.values[-1], min(_ROWS, count))
    chosen = sorted({int(np.argmin(np.abs(sweep.values - value))) for value in wanted})
    slow = [track for track in locus.tracks if not track.fast]
    hidden = [track for track in locus.tracks if track.fast]
    commands = () if path.kind == "command" else path.model.inputs
    note = ", ".join(f"{track.name} ({cell(track.rates[count // 2])} 1/s)" for track in hidden)
    return Table(
        (
            path.head,
            *(f"{s.name} [{s.unit}]" for s in commands),
            *(f"{t.name} [1/s]" for t in slow),
        ),
        [
            (
                _sig(sweep.places[k].value),
                *(_sig(u) for u in sweep.places[k].point.u if commands),
                *(Judged(cell(t.rates[k]), _of_growth(float(t.rates[k].real.max()))) for t in slow),
            )
            for k in chosen
        ],
        f"Not shown, as too fast to matter here: {note}." if hidden else "",
    )


def switch_words(model: Model, switch: Switch) -> str:
    """What a point on a switch means, in a sentence."""
    state = model.states[switch.state]
    entries = "; ".join(
        f"∂(d{model.state_names[i]}/dt)/∂{model.state_names[j]} is {up:.4g} above and {down:.4g} "
        "below"
        for (i, j), up, down in zip(switch.entries, switch.upper, switch.lower, strict=True)
    )
    return (
        f"The point lies on a switch: coefficients depend on the side of {state.name} "
        f"({state.description or state.unit}). {entries}."
    )


def mode_data(model: Model, mode: EigenMode) -> dict[str, Any]:
    """A mode as JSON data."""
    return {
        "name": mode.name,
        "real": mode.eigenvalue.real,
        "imag": mode.eigenvalue.imag if mode.oscillates else 0.0,
        "multiplicity": mode.multiplicity,
        "defective": mode.defective,
        "alternating": mode.alternating,
        "damping_ratio": mode.damping_ratio,
        "natural_frequency_rad_s": mode.natural_frequency,
        "damped_frequency_rad_s": mode.damped_frequency,
        "damped_frequency_hz": mode.damped_frequency / (2 * math.pi),
        "time_constant_s": mode.time_constant,
        "verdict": mode.verdict,
        "participation": dict(zip(model.state_names, mode.participation, strict=True)),
    }


def locus_data(locus: Locus) -> dict[str, Any]:
    """A locus as JSON data: values, commands, and λ of every mode."""
    path, sweep, model = locus.path, locus.sweep, locus.path.model
    return {
        "over": path.over,
        "unit": path.unit,
        "side": path.side,
        "values": sweep.values,
        "commands": {
            signal.name: [place.point.u[i] for place in sweep.places]
            for i, signal in enumerate(model.inputs)
        },
        "controlled": {
            name: [place.point.x[model.state_index(name)] for place in sweep.places]
            for name in model.controlled
        },
        "ended_low": sweep.low or None,
        "ended_high": sweep.high or None,
        "modes": [
            {
                "name": track.name,
                "part": track.part,
                "fast": track.fast,
                "real": track.rates.T.real,
                "imag": track.rates.T.imag,
            }
            for track in locus.tracks
        ],
    }


def crossing_data(locus: Locus) -> list[dict[str, Any]]:
    """Its crossings as JSON data."""
    return [
        {
            "mode": locus.name(crossing),
            "value": crossing.value,
            "frequency_rad_s": crossing.frequency,
            "frequency_hz": crossing.frequency / (2 * math.pi),
            "kind": "jump" if crossing.jumps else crossing.kind,
            "unstable_above": crossing.unstable_above,
        }
        for crossing in locus.crossings
    ]


def amount_words(model: Model, name: str, value: float, digits: int = 6) -> str:
    """``alpha_v = 0.4 rad``: a state, an input or a parameter with its unit."""
    return f"{name} = {value:.{digits}g} {unit_of(model, name)}".rstrip()


def exchange_words(locus: Locus) -> list[str]:
    """Where a curve ceases to be of the part that it is named after, towards an end of the range.

    Eigenvalues are followed without a break, and what they are of changes along them: two modes
    that come close exchange their parts.
    """
    path, sweep = locus.path, locus.sweep
    parts = parts_of(path.model)
    sentences = []
    for track in (
        track for track in locus.tracks if not track.fast and track.part in path.model.axes
    ):
        own = []
        for place in sweep.places:
            shares = [place.spectrum.participation(i) for i in track.members]
            own.append(next(iter(shares_of_parts(parts, np.mean(shares, axis=0)))))
        for end, step, side in ((0, 1, "below"), (-1, -1, "above")):
            other = own[end]
            if other == track.part or track.part not in own:
                continue
            run = next(k for k, part in enumerate(own[::step]) if part != other)
            value = sweep.values[::step][run - 1]
            sentences.append(
                f"{side.capitalize()} {amount_words(path.model, path.over, value, 4)} the curve "
                f"named “{track.name}” is mostly of the {other}: modes that come close exchange "
                "what they are of, and a curve is named after its average."
            )
    return sentences


def _of_growth(growth: float) -> Judgement:
    if growth > STILL:
        return "bad"
    return "doubtful" if growth >= -STILL else ""


def _sig(value: float | None) -> float | None:
    return 0.0 if value is not None and abs(value) < 1e-9 else rounded(value)
