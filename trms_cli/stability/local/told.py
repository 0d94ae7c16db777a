"""Modes in words, tables and data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from trms_cli.core.findings import Judged, Judgement, Table, Value
from trms_cli.models.model import Model
from trms_cli.stability.local.crossings import Crossing
from trms_cli.stability.local.linear import Switch
from trms_cli.stability.local.modes import Mode, Modes
from trms_cli.stability.local.parts import STILL, mode_name, parts_of, shares_of_parts
from trms_cli.stability.local.sweep import Path, Sweep
from trms_cli.stability.local.tracks import Track, cell

_JUDGED: dict[str, Judgement] = {"stable": "good", "marginal": "doubtful", "unstable": "bad"}
#: Rows of the table over a range.
_ROWS = 9


def eigenvalue_words(value: complex, digits: int = 4) -> str:
    """``−0.047 ± 1.83j``."""
    both = [value, value.conjugate()] if abs(value.imag) > STILL else [value]
    return cell(np.array(both), digits)


def mode_table(model: Model, modes: Modes, caption: str = "") -> Table:
    """Names, eigenvalues, damping, frequencies, time constants, verdicts."""
    rows = []
    for mode in modes.modes:
        damping = mode.damping_ratio
        rows.append(
            (
                mode.name + (f" (×{mode.multiplicity})" if mode.multiplicity > 1 else ""),
                eigenvalue_words(mode.eigenvalue, 3),
                _sig(damping) if mode.oscillates else None,
                _sig(mode.natural_frequency),
                _sig(mode.damped_frequency) if mode.oscillates else None,
                _sig(mode.damped_frequency / (2 * math.pi)) if mode.oscillates else None,
                _sig(mode.time_constant),
                Judged(verdict_words(mode), _JUDGED[mode.verdict]),
            )
        )
    return Table(
        (
            "mode",
            "λ [1/s]",
            "damping ζ",
            "ω_n [rad/s]",
            "ω_d [rad/s]",
            "f_d [Hz]",
            "τ [s]",
            "verdict",
        ),
        rows,
        caption,
    )


def verdict_words(mode: Mode) -> str:
    """``stable``, ``unstable``, ``marginal``, ``unstable (grows with t)``."""
    if mode.verdict == "unstable" and mode.eigenvalue.real <= STILL:
        return "unstable (grows with t)"
    return mode.verdict


def participation_table(model: Model, modes: Modes) -> Table:
    """Shares of the states in each mode, in percent."""
    rows: list[list[Value | Judged]] = [
        [mode.name, *(round(100.0 * float(share), 1) for share in mode.participation)]
        for mode in modes.modes
    ]
    return Table(
        ("mode", *(f"{name} [%]" for name in model.state_names)),
        rows,
        "Participation factors |w_i v_i| as shares of their sum.",
        on_screen=False,
    )


def range_table(path: Path, sweep: Sweep, tracks: Sequence[Track]) -> Table:
    """λ of each mode at some points of the range."""
    model = path.model
    count = len(sweep.places)
    wanted = np.linspace(sweep.values[0], sweep.values[-1], min(_ROWS, count))
    chosen = sorted({int(np.argmin(np.abs(sweep.values - value))) for value in wanted})
    slow = [track for track in tracks if not track.fast]
    rows = []
    for k in chosen:
        place = sweep.places[k]
        rows.append(
            (
                _sig(place.value),
                *(_sig(u) for u in place.point.u if path.kind != "command"),
                *(
                    Judged(cell(track.rates[k]), _of_growth(float(track.rates[k].real.max())))
                    for track in slow
                ),
            )
        )
    commands = () if path.kind == "command" else tuple(f"{s.name} [{s.unit}]" for s in model.inputs)
    hidden = [track for track in tracks if track.fast]
    note = (
        "Not shown, as too fast to matter here: "
        + ", ".join(f"{track.name} ({cell(track.rates[count // 2])} 1/s)" for track in hidden)
        + "."
        if hidden
        else ""
    )
    heads = f"{path.over} [{path.unit}]" if path.unit else path.over
    return Table((heads, *commands, *(f"{t.name} [1/s]" for t in slow)), rows, note)


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


def mode_data(model: Model, mode: Mode) -> dict[str, Any]:
    """A mode as JSON data."""
    value = mode.eigenvalue
    return {
        "name": mode.name,
        "real": finite(value.real),
        "imag": finite(value.imag) if mode.oscillates else 0.0,
        "multiplicity": mode.multiplicity,
        "defective": mode.defective,
        "alternating": mode.alternating,
        "damping_ratio": finite(mode.damping_ratio),
        "natural_frequency_rad_s": finite(mode.natural_frequency),
        "damped_frequency_rad_s": finite(mode.damped_frequency),
        "damped_frequency_hz": finite(mode.damped_frequency / (2 * math.pi)),
        "time_constant_s": finite(mode.time_constant),
        "verdict": mode.verdict,
        "participation": {
            name: float(share)
            for name, share in zip(model.state_names, mode.participation, strict=True)
        },
    }


def sweep_data(path: Path, sweep: Sweep, tracks: Sequence[Track]) -> dict[str, Any]:
    """A sweep as JSON data: values, commands, and λ of every mode."""
    model = path.model
    return {
        "over": path.over,
        "unit": path.unit,
        "side": path.side,
        "values": [float(v) for v in sweep.values],
        "commands": {
            signal.name: [float(place.point.u[i]) for place in sweep.places]
            for i, signal in enumerate(model.inputs)
        },
        "controlled": {
            name: [float(place.point.x[model.state_index(name)]) for place in sweep.places]
            for name in model.controlled
        },
        "ended_low": sweep.low or None,
        "ended_high": sweep.high or None,
        "modes": [
            {
                "name": track.name,
                "part": track.part,
                "fast": track.fast,
                "real": [[finite(v) for v in column.real] for column in track.rates.T],
                "imag": [[finite(v) for v in column.imag] for column in track.rates.T],
            }
            for track in tracks
        ],
    }


def crossing_data(crossing: Crossing, name: str) -> dict[str, Any]:
    """A crossing as JSON data."""
    return {
        "mode": name,
        "value": float(crossing.value),
        "frequency_rad_s": float(crossing.frequency),
        "frequency_hz": float(crossing.frequency / (2 * math.pi)),
        "kind": "jump" if crossing.jumps else crossing.kind,
        "unstable_above": bool(crossing.unstable_above),
    }


def amount_words(model: Model, name: str, value: float, digits: int = 6) -> str:
    """``alpha_v = 0.4 rad``: a state, an input or a parameter with its unit."""
    if name in model.parameters:
        unit = model.parameters[name].unit
    else:
        unit = next(s.unit for s in (*model.states, *model.inputs) if s.name == name)
    return f"{name} = {value:.{digits}g} {'' if unit == '1' else unit}".rstrip()


def crossing_name(model: Model, tracks: Sequence[Track], crossing: Crossing) -> str:
    """The mode that crosses, by what it is of there.

    That is the name of its track, unless the mode has become another along the range: its largest
    share is of another part, or it swings there and does not elsewhere.
    """
    track = next(track for track in tracks if crossing.track in track.members)
    shares = crossing.place.spectrum.participation(crossing.track)
    parts = parts_of(model)
    part = next(iter(shares_of_parts(parts, shares)))
    swings = crossing.frequency > 0.0
    if part == track.part and swings == ("swing" in track.name):
        return track.name
    # A real one grows on one side of the crossing: that is what it is called after.
    rate = complex(0.0, crossing.frequency) if swings else complex(1.0)
    return mode_name(parts, shares, rate)


def exchange_words(path: Path, sweep: Sweep, tracks: Sequence[Track]) -> list[str]:
    """Where a curve ceases to be of the part that it is named after, towards an end of the range.

    Eigenvalues are followed without a break, and what they are of changes along them: two modes
    that come close exchange their parts.
    """
    parts = parts_of(path.model)
    told = []
    for track in (track for track in tracks if not track.fast and track.part in path.model.axes):
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
            told.append(
                f"{side.capitalize()} {amount_words(path.model, path.over, value, 4)} the curve "
                f"named “{track.name}” is mostly of the {other}: modes that come close exchange "
                "what they are of, and a curve is named after its average."
            )
    return told


def finite(value: float | None) -> float | None:
    """The number, or None where there is none."""
    return float(value) if value is not None and math.isfinite(value) else None


def _of_growth(growth: float) -> Judgement:
    if growth > STILL:
        return "bad"
    return "doubtful" if growth >= -STILL else ""


def _sig(value: float | None) -> float | None:
    """Four significant digits."""
    if value is None or not math.isfinite(value):
        return None
    return 0.0 if abs(value) < 1e-9 else float(f"{value:.4g}")
