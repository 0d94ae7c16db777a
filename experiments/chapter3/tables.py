"""The study's tables, as Markdown for the page and as plain data for the JSON file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.chapter3.structure_selection import select_candidate
from experiments.chapter3.study import Study
from experiments.chapter3.trainings import TrainingResult

#: Factor and unit of an output in the tables.
_SHOWN = {"alpha_v": (1e3, "mrad"), "alpha_h": (1e3, "mrad")}
_NAMES = {"alpha_v": "pitch", "alpha_h": "yaw"}
TITLES = {"horizontal": "1 DOF horizontal", "vertical": "1 DOF vertical", "both": "2 DOF"}
#: What the members of the study are called.
MEMBERS = {
    "nnfir": "NNFIR, a perceptron of 5 s of commands alone",
    "nnarx": "NNARX, perceptron on one-step errors",
    "nnarmax": "NNARMAX, with past residuals",
    "nnssif": "NNSSIF, state space in innovations form",
    "nnoe": "NNOE, the perceptron of NNARX on simulations",
    "rbf_kmeans": "RBF, k-means, linear weights only",
    "rbf_ols": "RBF, orthogonal least squares, linear weights only",
    "rbf_trained": "RBF, orthogonal least squares, then all weights trained",
    "wavelet": "wavelets, dyadic grid, linear weights only",
    "wavelet_trained": "wavelets, dyadic grid, then all weights trained",
}


def markdown(study: Study) -> dict[str, str]:
    """Tables by the name of their place in the page."""
    tables = {name: _trainings(results) for name, results in study.tables.items()}
    tables["members"] = "\n\n".join(
        f"{TITLES[name]}:\n\n{_members(results)}" for name, results in study.members.items()
    )
    tables["activations"] = "\n\n".join(
        f"{TITLES[name]}:\n\n{_members(results)}" for name, results in study.activations.items()
    )
    tables["excitations"] = _members(study.excitations)
    tables["structure"] = _structure(study)
    tables["times"] = _times(study)
    return tables


def plain(study: Study) -> dict[str, Any]:
    """Every training's figures, for programs (``trms.chapter3/1``)."""
    return {
        "schema": "trms.chapter3/1",
        "tables": {name: [_row(one) for one in rows] for name, rows in study.tables.items()},
        "members": {name: [_row(one) for one in rows] for name, rows in study.members.items()},
        "activations": {
            name: [_row(one) for one in rows] for name, rows in study.activations.items()
        },
        "excitations": [_row(one) for one in study.excitations],
        "structure": [
            {
                "lags": one.candidate.lags,
                "hidden": one.candidate.hidden,
                "weights": one.weights,
                "one_step": [_number(value) for value in one.one_step],
                "free_run": [_number(value) for value in one.free_run],
            }
            for one in study.structures
        ],
        "seconds": {
            name: round(sum(one.seconds for one in results), 2)
            for name, results in parts_of(study).items()
        },
    }


def group_trainings(results: Sequence[TrainingResult]) -> dict[str, list[TrainingResult]]:
    """Trainings by label, in order."""
    groups: dict[str, list[TrainingResult]] = {}
    for one in results:
        groups.setdefault(one.job.label, []).append(one)
    return groups


def angles(results: Sequence[TrainingResult]) -> list[str]:
    """The measured angles of a system."""
    return [name for name in results[0].structure["outputs"] if name in _SHOWN]


def _trainings(results: Sequence[TrainingResult]) -> str:
    angle_names = angles(results)
    heads = ["training", "epochs", "processor time [s]"]
    for name in angle_names:
        heads += [f"{_NAMES[name]}, one step, fitted [mrad]", "test"]
        heads += [f"{_NAMES[name]}, free run, fitted [mrad]", "test"]
    rows = []
    for label, group in group_trainings(results).items():
        cells = [f"`{label}`", _spread([one.epochs for one in group], 0)]
        cells.append(_spread([one.seconds for one in group], 2))
        for name in angle_names:
            for errors in ("one_step", "free_run"):
                for part in ("fitted", "test"):
                    factor = _SHOWN[name][0]
                    values = [factor * getattr(one, errors)[part][name] for one in group]
                    cells.append(_spread(values))
        rows.append(cells)
    return _table(heads, rows)


def _members(results: Sequence[TrainingResult]) -> str:
    angle_names = angles(results)
    heads = ["network", "weights", "processor time [s]"]
    for name in angle_names:
        heads += [f"{_NAMES[name]}, one step, test [mrad]", "free run, fitted", "free run, test"]
    rows = []
    for label, group in group_trainings(results).items():
        cells = [MEMBERS.get(label, label), str(group[0].weights)]
        cells.append(_spread([one.seconds for one in group], 2))
        for name in angle_names:
            factor = _SHOWN[name][0]
            for errors, part in (
                ("one_step", "test"),
                ("free_run", "fitted"),
                ("free_run", "test"),
            ):
                cells.append(_spread([factor * getattr(one, errors)[part][name] for one in group]))
        rows.append(cells)
    return _table(heads, rows)


def _structure(study: Study) -> str:
    best = min(study.structures, key=lambda one: one.level)
    selection = select_candidate(study.structures)
    rows = [
        [
            words,
            str(one.candidate.lags),
            str(one.candidate.hidden),
            str(one.weights),
            _spread([100 * value for value in one.one_step]),
            _spread([100 * value for value in one.free_run]),
        ]
        for words, one in (("best", best), ("selected", selection))
    ]
    heads = ["", "lags", "hidden units", "weights"]
    return _table([*heads, "one step [% of the spread]", "free run [% of the spread]"], rows)


def _times(study: Study) -> str:
    rows = []
    for name, results in parts_of(study).items():
        starts = len({one.job.seed for one in results})
        total = sum(one.seconds for one in results)
        rows.append([name, str(len(results)), f"{total / starts:.1f}", f"{total:.0f}"])
    return _table(
        ["part", "trainings", "each once, processor time [s]", "all starts, processor time [s]"],
        rows,
    )


def parts_of(study: Study) -> dict[str, list[TrainingResult]]:
    """The trainings of each part of the study, but for those of the structure selection."""
    parts = {f"table of `{name}`": results for name, results in study.tables.items()}
    parts |= {f"structures, `{name}`": results for name, results in study.members.items()}
    parts |= {f"hidden units, `{name}`": results for name, results in study.activations.items()}
    return parts | {"excitations": study.excitations}


def _row(one: TrainingResult) -> dict[str, Any]:
    errors = {
        key: {
            part: {name: _number(value) for name, value in by_output.items()}
            for part, by_output in getattr(one, key).items()
        }
        for key in ("one_step", "free_run")
    }
    return {
        "label": one.job.label,
        "method": one.job.method,
        "training": one.job.training,
        "seed": one.job.seed,
        "weights": one.weights,
        "epochs": one.epochs,
        "kept_epoch": one.kept_epoch,
        "seconds": round(one.seconds, 3),
        "outcome": one.outcome,
        **errors,
    }


def _number(value: float) -> float | None:
    """Six digits; None for a run that diverged."""
    return float(f"{value:.6g}") if np.isfinite(value) else None


def _spread(values: Sequence[float], digits: int | None = None) -> str:
    """Median, and smallest to largest."""
    middle, low, high = np.median(values), min(values), max(values)

    def text(value: float) -> str:
        if not np.isfinite(value):
            return "∞"
        if digits is not None:
            return f"{value:.{digits}f}"
        return f"{value:.3g}" if value < 1000 else f"{value:.0f}"

    if text(low) == text(high):
        return text(middle)
    return f"{text(middle)} ({text(low)}–{text(high)})"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])
