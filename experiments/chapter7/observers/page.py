"""The tables of the study of observers, for a page and for the screen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from experiments.chapter7.observers.comparison import Cell, Ratio, tally
from experiments.chapter7.observers.records import STATES

HEADS = {
    "alpha_h": "yaw [mrad]",
    "alpha_v": "pitch [mrad]",
    "omega_h": "ω_h [rad/s]",
    "omega_v": "ω_v [rad/s]",
    "S_h": "S_h [mrad/s]",
    "S_v": "S_v [mrad/s]",
}
_SCALE = {"alpha_h": 1e3, "alpha_v": 1e3, "omega_h": 1.0, "omega_v": 1.0, "S_h": 1e3, "S_v": 1e3}
_ANGLES_ONLY = "angles"
_CHANNELS = ("alpha_h", "alpha_v", "omega_h", "omega_v")


def tables_of(
    cells: Sequence[Cell], observers: Sequence[str], against: str, *, times: bool
) -> dict[str, str]:
    """Markdown by mark of the page.

    ``times``: whether times are told; they are worth nothing of a machine that does something else
    too.
    """
    page_cells = [cell for cell in cells if cell.condition in _TOLD]
    return {
        "observer errors": _table(
            ["rig", "channels", "torques", "observer", *HEADS.values()],
            [
                [
                    *(_first(cell.condition, i), _first(cell.channels, i)),
                    *(_first(cell.torques, i), f"`{observer}`"),
                    *(f"{_SCALE[s] * cell.rmse[observer][s]:.3g}" for s in STATES),
                ]
                for cell in page_cells
                for i, observer in enumerate(observers)
            ],
        ),
        "state-dependent against ukf": _table(
            ["rig", "channels", "torques", *(_plain(s) for s in STATES)],
            [
                [
                    *(cell.condition, cell.channels, cell.torques),
                    *(_ratio(cell.ratios["state_dependent_ekf"][s]) for s in STATES),
                ]
                for cell in cells
            ],
        ),
        "observer tally": _table(
            [
                *("observer", f"better than `{against}`", "even", "worse"),
                *("median ratio", "least", "largest", "µs a step"),
            ],
            [
                [f"`{observer}`", *_tallied(cells, observer), _time(cells, observer, told=times)]
                for observer in observers
                if observer != against
            ]
            + [[f"`{against}`", *[""] * 6, _time(cells, against, told=times)]],
        ),
    }


_TOLD = (
    "exact model",
    "sensors ten times worse",
    "parameters off by a prior",
    "effects of the library",
)


def recordings_table(innovations: Mapping[str, Any], observers: Sequence[str]) -> str:
    """One-step prediction errors and consistency on recordings; a line where there are none."""
    if not innovations:
        return "The recordings were not there."
    rows = []
    for name, of in innovations.items():
        for i, observer in enumerate(observers):
            channels = of[observer]
            rows.append(
                [
                    _first(name, i),
                    f"`{observer}`",
                    *(_prediction(channels.get(channel)) for channel in _CHANNELS),
                ]
            )
    heads = ["recording", "observer", "yaw", "pitch", "ω_h", "ω_v"]
    return _table(heads, rows)


def free_prediction_table(
    innovations: Mapping[str, Any], observers: Sequence[str], horizons: Sequence[float]
) -> str:
    """RMSE of the free prediction at each horizon; a line where there are none."""
    if not innovations:
        return "The recordings were not there."
    rows = []
    for name, of in innovations.items():
        for i, observer in enumerate(observers):
            cells = []
            for channel in _CHANNELS:
                figures = of[observer].get(channel, {})
                errors = [figures.get("free", {}).get(f"{h:g}") for h in horizons]
                scale = 1e3 if figures.get("unit") == "rad" else 1.0
                cells.append(
                    "–"
                    if any(error is None for error in errors)
                    else ", ".join(f"{scale * error:.3g}" for error in errors)
                )
            rows.append([_first(name, i), f"`{observer}`", *cells])
    heads = ["recording", "observer", "yaw [mrad]", "pitch [mrad]", "ω_h [rad/s]", "ω_v [rad/s]"]
    return _table(heads, rows)


def _prediction(figures: Mapping[str, Any] | None) -> str:
    """RMSE of the one-step prediction (mrad or rad/s), and the mean of (ν/σ)²."""
    if figures is None:
        return "–"
    scale = 1e3 if figures["unit"] == "rad" else 1.0
    nis = figures["normalised_square"]
    return f"{scale * figures['prediction_rmse']:.3g} ({nis:.2g})"


def _tallied(cells: Sequence[Cell], observer: str) -> list[str]:
    cells_by_verdict = tally(cells, observer)
    ratios = sorted(ratio.mean for cell in cells for ratio in cell.ratios[observer].values())
    return [
        *(str(len(cells_by_verdict[verdict])) for verdict in ("better", "even", "worse")),
        *(f"{value:.3g}" for value in (ratios[len(ratios) // 2], ratios[0], ratios[-1])),
    ]


def _time(cells: Sequence[Cell], observer: str, *, told: bool) -> str:
    if not told:
        return "–"
    times = sorted(cell.microseconds[observer] for cell in cells if cell.channels != _ANGLES_ONLY)
    return f"{times[len(times) // 2]:.0f}"


def _ratio(ratio: Ratio) -> str:
    words = f"{ratio.mean:.3f} [{ratio.low:.3f}, {ratio.high:.3f}]"
    return {"better": f"**{words}**", "worse": f"_{words}_", "even": words}[ratio.verdict]


def _first(text: str, row: int) -> str:
    return text if row == 0 else ""


def _plain(state: str) -> str:
    return HEADS[state].split(" [")[0]


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
