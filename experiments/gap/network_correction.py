"""``python -m experiments.gap.network_correction``: is a network worth it beside a fit?

Each rig of the blind benchmark's code is recorded twice. To the first recording are fitted the
parameters alone, the parameters with a network of torques, and the parameters with the rig's own
effect. Free runs over the second one, of which no fit knew, and ``newton_mpc`` on the rig judge
them.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from experiments.command_line import exit_code_of, progress_with_time
from experiments.gap.blind.drivers import OpenLoop
from experiments.gap.closing_loop import AXES, RECORDING, control_with, record
from experiments.gap.driver import NOISE_SD
from experiments.gap.models import KNOWN_CAUSE, NETWORK, NETWORK_WORDS, REFIT, identify_model
from experiments.gap.rigs import Rig, drive_rigs, gentle_excitation, read_study, rig_of, write_csv
from experiments.page_tables import markdown, print_tables, write_tables
from trms_cli.core.errors import EXIT_OK
from trms_cli.core.threads import take_one_thread
from trms_cli.effects.model_file import load_model
from trms_cli.identification.data import DataOptions, load_datasets
from trms_cli.identification.free_runs import error_figures, window_runs
from trms_cli.models.model import Model

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "network-correction.md"
STUDY = Path(__file__).with_suffix(".yaml")
TEST_RECORDING = "test.csv"
#: An effect's name for a rig without any.
NONE = "none"
_ANGLES = {"pitch": "alpha_v", "yaw": "alpha_h"}
_WORDS = {REFIT: "parameters", NETWORK: "with network", KNOWN_CAUSE: "cause known", "true": "true"}


@dataclass(frozen=True)
class FreeRun:
    """Errors of a model's free runs over the second recording of a rig."""

    effect: str
    rig: str
    model: str
    length: float  #: s, of a window
    rmse: Mapping[str, float]  #: By axis, rad


def record_tests(rigs: Sequence[Rig], study: Mapping[str, Any], out: Path) -> None:
    """Second recordings, of all rigs at once; earlier ones are taken."""
    missing = [rig for rig in rigs if not (out / rig.name / TEST_RECORDING).exists()]
    if not missing:
        return
    duration, step = study["test"]["duration"], study["record"]["sample_time"]
    added = study["test"]["seed"]
    commands = {s: gentle_excitation(s + added, duration, step) for s in {r.seed for r in missing}}
    driver = OpenLoop(np.stack([commands[rig.seed] for rig in missing]))
    recorded = drive_rigs(missing, driver, duration, step, among=rigs, settling=20.0, seed=added)
    for i, rig in enumerate(missing):
        write_csv(recorded, i, out / rig.name / TEST_RECORDING)


def model_of(rig: Rig, model: str, out: Path) -> Model:
    """A model of a rig, fitted to its first recording unless it is the true one."""
    folder = out / rig.name
    if model == NETWORK:
        path = identify_model(folder / RECORDING, folder / NETWORK, words=NETWORK_WORDS)
    elif model == REFIT or (model == KNOWN_CAUSE and rig.effect == NONE):
        path = identify_model(folder / RECORDING, folder / REFIT)
    elif model == KNOWN_CAUSE:
        path = identify_model(folder / RECORDING, folder / KNOWN_CAUSE, rig.effect)
    else:
        path = rig.write_true_model(folder / "true_model.yaml")
    return load_model(str(path))


def free_runs(
    rigs: Sequence[Rig], study: Mapping[str, Any], out: Path, report: Callable[[str], None]
) -> list[FreeRun]:
    """Free runs of every model of every rig over its second recording."""
    results = []
    for rig in rigs:
        report(f"fits and free runs of {rig.name}")
        for name in study["models"]:
            model = model_of(rig, name, out)
            options = DataOptions(noise_sd=NOISE_SD)
            test = load_datasets(str(out / rig.name / TEST_RECORDING), model, options)
            for length in study["windows"]:
                figures = error_figures(window_runs(model, test, length))
                rmse = {axis: figures[angle]["rmse"] for axis, angle in _ANGLES.items()}
                results.append(FreeRun(rig.effect, rig.name, name, length, rmse))
    return results


def kept(rig: Rig, out: Path) -> bool:
    """Whether the fit kept its network."""
    file = out / rig.name / NETWORK / "identification.json"
    return bool(json.loads(file.read_text(encoding="utf-8"))["details"]["network"]["kept"])


def free_run_table(results: Sequence[FreeRun], rigs: Sequence[Rig], out: Path) -> list[list[str]]:
    """By effect: root mean squares over its rigs, of the windows of each length."""
    lengths = list(dict.fromkeys(r.length for r in results))
    models = list(dict.fromkeys(r.model for r in results))
    head = ["effect", "axis", "networks kept"]
    head += [f"{_WORDS[m]} [mrad]" for m in models]
    rows = [head]
    for effect in dict.fromkeys(r.effect for r in results):
        own = [rig for rig in rigs if rig.effect == effect]
        count = f"{sum(kept(rig, out) for rig in own)} of {len(own)}"
        for axis in AXES:
            cells = []
            for model in models:
                values = [
                    _mean([r.rmse[axis] for r in results if _is(r, effect, model, length)])
                    for length in lengths
                ]
                cells.append(", ".join(f"{1e3 * value:.1f}" for value in values))
            name = f"`{effect}`" if axis == AXES[0] else ""
            rows.append([name, axis, count if name else "", *cells])
    return rows


def tracking_table(runs: Sequence[Any], models: Sequence[str]) -> list[list[str]]:
    """By effect: tracking errors, root mean squares over its rigs."""
    rows = [["effect", "axis", *(f"{_WORDS[m]} [mrad]" for m in models)]]
    for effect in dict.fromkeys(run.effect for run in runs):
        for axis in AXES:
            cells = []
            for model in models:
                own = [r.rmse[axis] for r in runs if r.effect == effect and r.model == model]
                cells.append(f"{1e3 * _mean(own):.1f}")
            rows.append([f"`{effect}`" if axis == AXES[0] else "", axis, *cells])
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study, print its tables, write them into the documentation on request."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.gap.network_correction", description=__doc__
    )
    parser.add_argument("--quick", action="store_true", help="one rig, short recordings")
    parser.add_argument("--update", action="store_true", help="write the tables into the page")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("outputs/network_correction"),
        help="folder of recordings, fits and runs; what it holds is not made again",
    )
    arguments = parser.parse_args(argv)
    take_one_thread()
    return exit_code_of(lambda: _study(arguments))


def _study(arguments: argparse.Namespace) -> int:
    study = read_study(STUDY)
    if arguments.quick:
        study |= yaml.safe_load(
            "{seeds: [4], record: {duration: 20.0, sample_time: 0.02}, windows: [4.0], "
            "test: {duration: 10.0, seed: 1000}, run: {duration: 4.0, from: 1.0, "
            "models: [refit, network]}, "
            "effects: {yaw_cable_stiffness: {stiffness: 0.015}}, models: [refit, network]}"
        )
    report, out = progress_with_time(), arguments.out
    rigs = [
        rig_of(effect, sizes, seed, study["scatter"])
        for effect, sizes in study["effects"].items()
        for seed in study["seeds"]
    ]
    record(rigs, study, out, report)
    record_tests(rigs, study, out)
    results = free_runs(rigs, study, out, report)
    tables = {"free_runs": free_run_table(results, rigs, out)}
    runs = control_with(
        lambda rig, name: model_of(rig, name, out),
        rigs,
        study["tasks"],
        study["run"]["models"],
        study,
        out,
        report,
    )
    for task in study["tasks"]:
        own = [run for run in runs if run.task == task]
        tables[task] = tracking_table(own, study["run"]["models"])
    print_tables(tables, width=150)
    if arguments.update:
        write_tables(PAGE, {name: markdown(rows) for name, rows in tables.items()})
    return EXIT_OK


def _is(result: FreeRun, effect: str, model: str, length: float) -> bool:
    return (result.effect, result.model, result.length) == (effect, model, length)


def _mean(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    sys.exit(main())
