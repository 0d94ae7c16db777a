"""The study's figures, from its results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from experiments.chapter3.structure_selection import select_candidate
from experiments.chapter3.study import Study
from experiments.chapter3.tables import MEMBERS, TITLES, angles, group_trainings
from experiments.chapter3.training_picture import (
    Correlation,
    LearningCurve,
    ResponseRow,
    Spread,
    draw_correlations,
    draw_free_runs,
    draw_learning,
    draw_responses,
    draw_spread,
    draw_structure,
)
from experiments.chapter3.trainings import TrainingResult, make_recording
from trms_cli.identification.blackbox.prediction_error import (
    predict_samples,
    sample_signals,
    simulate_network,
)
from trms_cli.identification.validation.residual_tests import (
    ResidualTest,
    ResidualTests,
    residual_tests,
)
from trms_cli.models.innovation_network import structure_from_data
from trms_cli.models.network import Network

_NAMES = {"alpha_v": "pitch", "alpha_h": "yaw"}
_STRUCTURES = ("nnfir", "nnarx", "nnarmax", "nnssif", "nnoe")


def draw_all(study: Study, folder: Path, short: float) -> None:
    """Draw every figure into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, results in study.tables.items():
        title = TITLES[name]
        first = [one for one in results if one.job.seed == results[0].job.seed]
        draw_learning(
            [LearningCurve(o.job.label, np.array(o.losses), np.array(o.times)) for o in first],
            folder / f"learning_{name}.png",
            title=f"{title}: learning from one start",
        )
        for angle in angles(results):
            suffix = f"_{_NAMES[angle]}" if len(angles(results)) > 1 else ""
            draw_spread(
                [
                    Spread(
                        label,
                        np.array([1e3 * one.free_run["test"][angle] for one in group]),
                        np.array([one.seconds for one in group]),
                    )
                    for label, group in group_trainings(results).items()
                ],
                folder / f"spread_{name}{suffix}.png",
                unit="mrad",
                what=f"{_NAMES[angle]}, RMS error of the free run over the test recording",
                title=f"{title}: a dot a start",
            )
        medians = {label: _median(group) for label, group in group_trainings(results).items()}
        _draw_page(
            medians,
            folder / f"responses_{name}.png",
            short,
            f"{title}, NNARX, the test recording, the median start of each algorithm",
        )
    for name, results in study.members.items():
        groups = group_trainings(results)
        medians = {MEMBERS[label].split(",")[0]: _median(groups[label]) for label in groups}
        _draw_runs(
            name,
            {label: medians[label] for label in ("NNARX", "NNOE")},
            folder / f"runs_{name}.png",
            short,
        )
        structures = {label: _median(groups[label]) for label in _STRUCTURES if label in groups}
        _draw_page(
            {label.upper(): one for label, one in structures.items()},
            folder / f"structures_{name}.png",
            short,
            f"{TITLES[name]}: the test recording, the median start of each structure",
        )
    draw_structures(study, folder / "structure.png")
    for label in ("nnarx", "nnoe"):
        best = min(group_trainings(study.members["vertical"])[label], key=_test_error)
        _draw_tests(best, folder / f"correlations_{label}.png", short)


def draw_structures(study: Study, path: Path) -> None:
    """The error map of the structure selection."""
    lags = sorted({one.candidate.lags for one in study.structures})
    hidden = sorted({one.candidate.hidden for one in study.structures})
    errors = np.empty((len(lags), len(hidden), len(study.structures[0].free_run)))
    for one in study.structures:
        row, column = lags.index(one.candidate.lags), hidden.index(one.candidate.hidden)
        errors[row, column] = one.free_run
    selection = select_candidate(study.structures).candidate
    draw_structure(
        lags,
        hidden,
        100 * errors,
        (selection.lags, selection.hidden),
        path,
        title="Free run over held-out data, % of the spread: median, range over starts",
    )


def _test_error(one: TrainingResult) -> float:
    return sum(one.free_run["test"][angle] for angle in angles([one]))


def _median(group: Sequence[TrainingResult]) -> TrainingResult:
    """The median start, so that no lucky one is shown."""
    return sorted(group, key=_test_error)[len(group) // 2]


def _draw_runs(system: str, networks: dict[str, TrainingResult], path: Path, short: float) -> None:
    dataset = make_recording(system, "test", short)
    runs = {}
    for label, one in networks.items():
        structure = structure_from_data(one.structure)
        samples = sample_signals(dataset, structure)
        run = simulate_network(structure, Network.from_data(one.network), samples)
        runs[label] = dict(zip(structure.outputs, run.T, strict=True))
    time = np.arange(len(samples), dtype=np.float64) * structure.sample_time
    units = dict(zip(structure.outputs, structure.output_units, strict=True))
    draw_free_runs(
        time,
        dict(zip(structure.outputs, samples.outputs.T, strict=True)),
        runs,
        dict(zip(structure.inputs, samples.inputs.T, strict=True)),
        units,
        path,
        title=f"{TITLES[system]}: free run over the test recording",
    )


def _draw_tests(one: TrainingResult, path: Path, short: float) -> None:
    """Correlation tests of the one-step residuals over the test recording."""
    angle = angles([one])[0]
    name = MEMBERS[one.job.label].split(",")[0]
    draw_correlations(
        [
            _correlation(test)
            for test in _tests_of(one, short).of(angle)
            if test.kind not in ("mean", "ljung_box") and len(test.result.lags)
        ],
        path,
        title=f"{name}, {_NAMES[angle]}: residuals one step ahead, 95 % bands over all lags",
    )


def _tests_of(one: TrainingResult, short: float) -> ResidualTests:
    structure = structure_from_data(one.structure)
    samples = sample_signals(make_recording(one.job.system, "test", short), structure)
    residual = samples.outputs - predict_samples(structure, Network.from_data(one.network), samples)
    first = structure.longest_lag
    return residual_tests(
        dict(zip(structure.outputs, residual[first:].T, strict=True)),
        dict(zip(structure.inputs, samples.inputs[first:].T, strict=True)),
        dict(zip(structure.outputs, samples.outputs[first:].T, strict=True)),
        lags=20,
    )


def _correlation(test: ResidualTest) -> Correlation:
    return Correlation(
        test.formula,
        test.result.lags.astype(np.float64),
        test.result.correlations,
        test.result.band(),
        test.failed(),
    )


def _draw_page(
    networks: Mapping[str, TrainingResult], path: Path, short: float, title: str
) -> None:
    """Responses and linear correlation tests of networks of one system, a row each."""
    rows, measured, time = [], {}, np.zeros(0)
    for label, one in networks.items():
        structure = structure_from_data(one.structure)
        samples = sample_signals(make_recording(one.job.system, "test", short), structure)
        run = simulate_network(structure, Network.from_data(one.network), samples)
        run[: structure.longest_lag] = np.nan  # those are the measured samples
        names, tests = angles([one]), _tests_of(one, short)
        time = np.arange(len(samples), dtype=np.float64) * structure.sample_time
        columns = {name: structure.outputs.index(name) for name in names}
        measured = {name: samples.outputs[:, column] for name, column in columns.items()}
        rows.append(
            ResponseRow(
                label,
                {name: run[:, column] for name, column in columns.items()},
                {name: 1e3 * one.free_run["test"][name] for name in names},
                {
                    name: [_correlation(t) for t in tests.of(name) if t.kind in ("auto", "input")]
                    for name in names
                },
            )
        )
    draw_responses(time, measured, rows, path, title=title)
