"""``trms export-controller``: a controller as C source for a rig's own computer."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.commands.execution import execute, help_of_options
from trms_cli.composition.composer import Composition
from trms_cli.core.errors import EXIT_OK, ConfigurationError

if TYPE_CHECKING:
    from trms_cli.code_generation.export import Export
    from trms_cli.code_generation.measure import ExampleMeasurement
    from trms_cli.simulation.closed_loop import Experiment

SUMMARY = "a controller as C source for a rig's own computer"
COMPOSES = "export_controller"

#: Files beside the source.
DOCUMENT_NAME, README_NAME = "controller.json", "README.md"
#: Of the example: what a person waits for.
_MOST_SAMPLES = 20_000
_USABLE = re.compile(r"[a-z][a-z0-9_]{0,30}")
#: Prefixes that C has words of its own for: `double_t`, `int8_t`, `math.h`.
_TAKEN = ("mpc", "qp", "casadi", "math", "string", "float", "int", "double")

HELP = """\
usage: trms export-controller [newton_mpc|linear_mpc] [GROUP=OPTION]… [KEY=VALUE]… [--cfg job]
       [--config-dir DIR]…

Writes a controller, and the filter that observes for it, as C99 that needs nothing but libm: no
malloc, no recursion, all memory in a struct of the caller. The folder holds NAME.c and NAME.h
(these go to the rig), an example with recorded samples, a Makefile, and a README with signals,
units, memory and times. It takes what `trms run` takes, so that what ran is what is exported.
`newton_mpc` alone is short for controller=newton_mpc, and so is `linear_mpc`.

With measure=true it is compiled here and held against the Python controller, sample by sample.

examples
  trms export-controller newton_mpc                       with the UKF, default tuning
  trms export-controller newton_mpc observer=full_state   the controller alone
  trms export-controller newton_mpc model=fit.yaml out=rig_c name=rig
  trms export-controller newton_mpc controller.max_iterations=1 \\
       controller.prediction_horizon=20                   one iteration a sample, for speed
  trms export-controller newton_mpc 'controller.soft_limits={alpha_v: [-0.9, 0.6]}'
  trms export-controller newton_mpc 'controller.input_rate_limits={u_v: 20}'   V/s
  trms export-controller newton_mpc 'plant.sensors.channels=[alpha_v,alpha_h]' no rotor speeds
  trms export-controller newton_mpc measure=false         no compiler needed

then
  make -C DIR check                                       builds it, compares, takes times

options
""" + help_of_options("export")


def main(argv: Sequence[str]) -> int:
    """Compose and export."""
    return execute(_with_controller(argv), COMPOSES, perform)


def perform(composition: Composition) -> int:
    """Export one composed controller: write, measure, print."""
    from trms_cli.runs.run_folder import write_document, write_whole

    config = composition.config
    _check(config)
    export = _exported(composition)
    folder = composition.folder("export-controller")
    for name, content in export.files.items():
        write_whole(content, folder / name)
    measured, reason = _measured(export, folder, config["measure"])
    command = shlex.join(["trms", "export-controller", *composition.overrides])
    write_whole(export.readme(command, measured), folder / README_NAME)
    write_document(export.document(command, measured), folder / DOCUMENT_NAME)
    if composition.job is not None:
        print(f"{composition.job:>4}  {' '.join(composition.overrides)}  {folder}")
        return EXIT_OK
    for line in _lines(export, folder, measured, reason):
        print(line)
    return EXIT_OK


def _with_controller(argv: Sequence[str]) -> list[str]:
    """A bare first word names the controller."""
    words = list(argv)
    if words and re.fullmatch(r"\w+", words[0]):
        words[0] = f"controller={words[0]}"
    return words


def _check(config: Mapping[str, Any]) -> None:
    from trms_cli.composition.plain_values import check_files, truth
    from trms_cli.library.tasks.replay import is_replay

    check_files({**config, "picture": False})
    out = config["out"]
    if out is not None:
        folder = Path(out).expanduser()
        if folder.is_dir() and any(folder.iterdir()):
            raise ConfigurationError(
                f"the folder {str(folder)!r} is not empty, and nothing is written over",
                where="out",
                remedy="name a new folder, or remove that one",
            )
    truth(config["measure"], "measure")
    name = config["name"]
    usable = isinstance(name, str) and _USABLE.fullmatch(name)
    if name is not None and (not usable or name in _TAKEN):
        raise ConfigurationError(
            f"{name!r} given",
            where="name",
            remedy="a C identifier in small letters, such as rig_controller",
        )
    if is_replay(config):
        raise ConfigurationError(
            "a recording is no rig to make an observer for",
            where="plant",
            remedy="plant=simulated, with the rig's channels: plant.sensors.channels=[…]",
        )


def _exported(composition: Composition) -> Export:
    from trms_cli.code_generation.export import check_exportable, export
    from trms_cli.controllers.controller import ControlSetup
    from trms_cli.library.tasks.experiment import experiment_of
    from trms_cli.models.model import names
    from trms_cli.observers.observer import ObserverSetup
    from trms_cli.plants.plant import PlantSetup

    experiment = experiment_of(composition.config)
    choices = composition.choices
    check_exportable(experiment.controller, str(choices["controller"]))
    _check_observer(experiment, str(choices["observer"]))
    period = experiment.samples_per_control * experiment.sample_time
    samples = round(experiment.duration / period)
    if not 1 <= samples <= _MOST_SAMPLES:
        raise ConfigurationError(
            f"{experiment.duration:g} s are {samples} control periods",
            where="sim.duration",
            remedy=f"1 to {_MOST_SAMPLES} control periods of {period:g} s",
        )
    plant = experiment.plant.init(
        PlantSetup(experiment.sample_time, 1, experiment.seed, experiment.model)
    )
    if names(plant.inputs) != names(experiment.model.inputs):
        raise ConfigurationError(
            f"the rig takes {', '.join(names(plant.inputs))}, "
            f"the model {', '.join(names(experiment.model.inputs))}",
            where="plant.model",
            remedy="rig and model need the same inputs",
        )
    observing = ObserverSetup(
        experiment.model,
        experiment.sample_time,
        names(plant.outputs),
        plant.noise_sd,
        plant.measure(),
        plant.first_command,
    )
    return export(
        experiment.controller,
        ControlSetup(experiment.model, period, plant.first_command),
        experiment.reference,
        name=composition.config["name"] or _name_of(composition),
        samples=samples,
        observer=experiment.observer,
        observing=observing,
    )


def _name_of(composition: Composition) -> str:
    """The controller's name where C can take it."""
    name = str(composition.choices["controller"]).lower()
    return name if _USABLE.fullmatch(name) else "newton_mpc"


def _check_observer(experiment: Experiment, option: str) -> None:
    from trms_cli.observers.full_state import FullState
    from trms_cli.observers.recursive_filter import RecursiveFilter

    if not isinstance(experiment.observer, (FullState, RecursiveFilter)):
        raise ConfigurationError(
            f"observer={option} has no C source",
            where="observer",
            remedy="take a filter (ukf, ekf, …), or full_state to export the controller alone",
        )


def _measured(
    export: Export, folder: Path, is_requested: bool
) -> tuple[ExampleMeasurement | None, str]:
    """What was measured, or why nothing was."""
    from trms_cli.code_generation.measure import measure
    from trms_cli.core.compilation import compiler

    if not is_requested:
        return None, "measure=false"
    program = compiler()
    if program is None:
        return None, "no C compiler found: `trms doctor` tells what to install"
    if sys.stderr.isatty():
        sys.stderr.write("compiling …\r")
    return measure(folder, export.name, program), ""


def _lines(
    export: Export, folder: Path, measured: ExampleMeasurement | None, reason: str
) -> list[str]:
    sizes, name = export.source.sizes, export.name
    lines = [
        f"{name}: {export.source.controller} of model {export.setup.model.name}, "
        f"{sizes['N']} periods of {export.source.period:g} s, {sizes['N_Z']} unknowns"
        + (
            ""
            if export.observer is None
            else f"; observer of {', '.join(export.observer.channels)}"
        ),
    ]
    if measured is None:
        lines.append(f"  not measured: {reason}")
    else:
        lines += [
            f"  step      median {measured.median:.1f} µs, 99 % {measured.p99:.1f} µs, longest "
            f"{measured.longest:.1f} µs ({measured.samples} steps); slowest sample in the best of "
            f"its passes {measured.slowest:.1f} µs",
            *_observer_line(measured),
            f"  agrees    with the Python controller to {measured.largest_difference:.2g} V",
            f"  memory    {measured.context_bytes / 1024:.0f} KiB in the context"
            + (
                f", {measured.observer_bytes / 1024:.0f} KiB in the observer"
                if measured.observer_bytes
                else ""
            )
            + (
                f"; {measured.code_bytes / 1024:.0f} KiB of code and constants"
                if measured.code_bytes
                else ""
            ),
        ]
    return [
        *lines,
        f"  written   {folder}",
        f"  next      make -C {shlex.quote(str(folder))} check",
    ]


def _observer_line(measured: ExampleMeasurement) -> list[str]:
    if measured.observer_median is None:
        return []
    return [
        f"  observer  median {measured.observer_median:.1f} µs, 99 % {measured.observer_p99:.1f} µs"
    ]
