"""``trms excite``: design signals that show a rig's dynamics."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

from trms_cli.commands.execution import execute
from trms_cli.commands.run_assembly import number, whole_number
from trms_cli.composition.composer import Composition, Outcome
from trms_cli.core.errors import EXIT_OK, ConfigurationError
from trms_cli.core.invocation import program

SUMMARY = "design an excitation: band and amplitude from the model"
COMPOSES = "excite"

TABLE_NAME, DOCUMENT_NAME, PICTURE_NAME = "excitation.csv", "excitation.json", "excitation.png"
_MOST_SAMPLES = 1_000_000

HELP = """\
usage: trms excite [excitation=KIND] [model=NAME] [KEY=VALUE]… [--cfg job] [--config-dir DIR]…

Designs commands that show a rig's dynamics and keep it within its bounds, and leaves a folder
with the commands (excitation.csv), the figures (excitation.json) and a picture of what they
excite (excitation.png): spectra of inputs and outputs over the noise, and where the rig goes.

The band goes from a fifth of the model's slowest pole to five times its fastest. The amplitudes
are the largest with which the simulated rig stays within a share of its stops. The inputs are
unlike one another: interleaved frequencies, shifted sequences. The picture and the ranges are
those of the model; ranges of rigs drawn from the parameters' priors stand beside them.

examples
  trms excite                                          multisine of low peak, model=newtonian
  trms excite excitation=prbs duration=300             two levels
  trms excite excitation=multilevel reversals=true     rotors that change their direction
  trms excite 'operating_point={alpha_v: 0.1}'         rad, where the excitation is centred
  trms excite 'bounds={alpha_v: 0.5, alpha_h: 1}'      rad, what the angles must not exceed
  trms excite band.lowest=0.05 band.highest=1          Hz
  trms excite excitation.periods=4                     the same period four times
  trms excite model=newtonian_vertical                 one rotor only

then
  trms run controller=played controller.u_v.file=…/excitation.csv sim.duration=140

options
  -m, --multirun     one excitation for each combination of the values that commas part
  --cfg job          print the composed configuration and stop
  --config-dir DIR   a folder with option files of your own, searched first (may be repeated)
  --allow PACKAGE    let classes of your own package run in this call (for good: trms allow)
"""


def main(argv: Sequence[str]) -> int:
    """Compose and design."""
    return execute(argv, COMPOSES, perform)


def perform(composition: Composition) -> Outcome:
    """Design one composed excitation; write, print and draw it."""
    from trms_cli.core.plugins import build
    from trms_cli.identification.excitation.design import design
    from trms_cli.identification.excitation.spectra import spectra_of, summary
    from trms_cli.runs.run_folder import write_document, write_whole

    begin = perf_counter()
    config = composition.config
    _check_files(config)
    request, noise = _request(config), _noise(config)
    model = build(config["model"], "model")
    excitation = build(config["excitation"], "excitation")
    found = design(model, excitation, request, _progress())
    spectra = spectra_of(found, noise)
    document = {"schema": "trms.excitation/1", **summary(found, spectra)}
    document["excitation"] = {
        key: value for key, value in config["excitation"].items() if key != "_target_"
    }
    document["kind"] = str(composition.choices.get("excitation"))
    folder = composition.folder("excite")
    table = folder / TABLE_NAME
    write_whole(_csv(found, document["kind"]), table)
    document["file"] = str(table)
    write_document(document, folder / DOCUMENT_NAME)
    if config["picture"]:
        from trms_cli.reporting.excitation_picture import draw_excitation

        title = f"{document['kind']} · {model.name} · {found.plan.duration:g} s"
        try:
            draw_excitation(_figures(found, spectra), folder / PICTURE_NAME, title=title)
        except OSError as error:  # the commands are safe in their file: this much may fail
            sys.stderr.write(f"no picture: {error.strerror or error}\n")
    if composition.job is not None:
        amplitudes = ", ".join(f"{n} {i['amplitude']:.3g}" for n, i in document["inputs"].items())
        print(f"{composition.job:>4}  {' '.join(composition.overrides)}  {amplitudes}")
        return Outcome(EXIT_OK, folder=folder)
    for line in _lines(document, folder, composition, perf_counter() - begin):
        print(line)
    return Outcome(EXIT_OK, folder=folder)


def _check_files(config: Mapping[str, Any]) -> None:
    from trms_cli.commands.run_assembly import check_files

    check_files(config)
    out = config["out"]
    if out is not None and Path(out).joinpath(TABLE_NAME).exists():
        raise ConfigurationError(
            f"{Path(out) / TABLE_NAME} exists", where="out", remedy="name another folder"
        )


def _request(config: Mapping[str, Any]) -> Any:
    """The keys outside the groups, checked as a plugin's are."""
    from trms_cli.core.plugins import build

    plain = ("lead_in", "operating_point", "reversals", "amplitude", "bounds", "share", "rigs")
    for key in ("duration", "lead_in", "sample_time", "share"):
        number(config[key], key)
    whole_number(config["rigs"], "rigs")
    for key, least in (("duration", 0.0), ("sample_time", 0.0), ("share", 0.0)):
        if not config[key] > least:
            raise ConfigurationError(f"{config[key]!r} given", where=key, remedy="above 0")
    if config["share"] > 1 or config["lead_in"] < 0 or config["duration"] < config["sample_time"]:
        key, remedy = {
            config["share"] > 1: ("share", "at most 1"),
            config["duration"] < config["sample_time"]: ("duration", "at least one sample_time"),
            config["lead_in"] < 0: ("lead_in", "0 s or more"),
        }[True]
        raise ConfigurationError(f"{config[key]!r} given", where=key, remedy=remedy)
    samples = (config["duration"] + config["lead_in"]) / config["sample_time"]
    if samples > _MOST_SAMPLES:
        raise ConfigurationError(
            f"{samples:.3g} samples", where="duration", remedy=f"at most {_MOST_SAMPLES} samples"
        )
    node = {
        "_target_": "trms_cli.identification.excitation.design.ExcitationRequest",
        "duration": config["duration"],
        "sample_time": config["sample_time"],
        "lowest": config["band"]["lowest"],
        "highest": config["band"]["highest"],
        "seed": whole_number(config["seed"], "seed"),
        **{key: config[key] for key in plain if config[key] is not None},
    }
    return build(node)


def _noise(config: Mapping[str, Any]) -> dict[str, float]:
    """Standard deviation of each output's noise, the quantum's share included."""
    from trms_cli.core.plugins import build

    node = {
        "_target_": "trms_cli.plants.sensors.Sensors",
        "noise_sd": config["noise_sd"],
        "quantum": config["quantum"],
    }
    sensors = build(node)
    return dict(sensors.declared_noise(tuple({*config["noise_sd"], *config["quantum"]})))


def _csv(found: Any, kind: str) -> str:
    """Commands with the header that recordings have."""
    inputs = found.model.inputs
    lines = [
        f"# made by: trms excite excitation={kind}",
        f"# model: {found.model.name}",
        f"# excitation begins: {found.first * found.plan.sample_time:g} s",
        ",".join(["t[s]", *(f"{signal.name}[{signal.unit}]" for signal in inputs)]),
    ]
    for time, row in zip(found.time, found.commands, strict=True):
        lines.append(",".join([f"{time:.9g}", *(f"{value:.6g}" for value in row)]))
    return "\n".join(lines) + "\n"


def _figures(found: Any, spectra: Any) -> Any:
    import numpy as np

    from trms_cli.models.model import names
    from trms_cli.reporting.excitation_picture import ExcitationFigures

    model = found.model
    inputs, outputs = names(model.inputs), names(model.outputs)
    signals = (*model.inputs, *model.outputs)
    tables = {name: found.outputs[:, i] for i, name in enumerate(outputs)}
    rates = {
        name: np.diff(tables[name][found.first :]) / found.plan.sample_time
        for name in outputs
        if name in found.bounds
    }
    return ExcitationFigures(
        found.time,
        found.first,
        {name: found.commands[:, i] for i, name in enumerate(inputs)},
        {signal.name: signal.unit for signal in signals},
        tables,
        found.bounds,
        rates,
        (found.plan.lowest, found.plan.highest),
        (found.poles[0] / (2 * np.pi), found.poles[1] / (2 * np.pi)),
        spectra.frequencies,
        {name: spectra.inputs[:, i] for i, name in enumerate(inputs)},
        {name: spectra.outputs[:, i] for i, name in enumerate(outputs)},
        {name: float(spectra.noise[i]) for i, name in enumerate(outputs)},
        {
            (output, name): spectra.response[:, i, j]
            for i, output in enumerate(outputs)
            for j, name in enumerate(inputs)
        },
    )


def _progress() -> Any:
    if not sys.stderr.isatty():
        return lambda words: None
    begin = perf_counter()

    def tell(words: str) -> None:
        if perf_counter() - begin > 0.5:
            sys.stderr.write(f"\r{words}…".ljust(50) + "\r")
            sys.stderr.flush()

    return tell


def _lines(
    document: Mapping[str, Any], folder: Path, composition: Composition, spent: float
) -> Iterator[str]:
    low, high = document["band_hz"]
    slow, fast = document["poles_hz"]
    yield (
        f"excitation  {document['kind']} · {document['model']} · {document['duration_s']:g} s "
        f"after {document['lead_in_s']:g} s of lead-in"
    )
    yield f"band        {low:.3g} to {high:.3g} Hz (the model's poles: {slow:.3g} to {fast:.3g} Hz)"
    yield ""
    yield f"{'inputs':<12}{'centre':>10}{'amplitude':>11}{'limit':>8}{'crest factor':>14}"
    for name, figures in document["inputs"].items():
        yield (
            f"  {name:<5}[{figures['unit']}]{_centre(figures):>11}"
            f"{figures['amplitude']:>11.3g}{figures['limit']:>8.3g}{figures['crest_factor']:>14.3f}"
        )
    if document["correlation_of_inputs"] is not None:
        # adding zero takes the sign from what rounds to it
        alike = round(document["correlation_of_inputs"], 3) + 0.0
        yield f"  correlation of the two: {alike:.3f}"
    yield ""
    yield f"{'predicted':<19}{'range':>20}{'drawn rigs':>22}{'seen up to':>14}"
    for name, figures in document["predicted"].items():
        seen = figures["seen_up_to_hz"]
        yield (
            f"  {name:<9}[{figures['unit']}]".ljust(19)
            + f"{_range(figures['range']):>20}{_range(figures['range_of_drawn_rigs']):>22}"
            + f"{'–' if seen is None else f'{seen:.3g} Hz':>14}"
        )
    lost, drawn = document["drawn_rigs_beyond_stops"], document["drawn_rigs"]
    if lost:
        yield (
            f"note        {lost} of {drawn} rigs drawn from the priors reach a stop: watch the "
            "first run, or lower share"
        )
    yield ""
    yield f"time        {spent:.1f} s"
    yield f"commands    {folder / TABLE_NAME}"
    yield f"figures     {folder / DOCUMENT_NAME}"
    if composition.config["picture"]:
        yield f"picture     {folder / PICTURE_NAME}"
    yield f"next        {_play(document, folder, composition)}"


def _centre(figures: Mapping[str, Any]) -> str:
    """What rounding of the steady state leaves is no command."""
    small = abs(figures["centre"]) < 1e-4 * figures["limit"]
    return "0" if small else f"{figures['centre']:.3g}"


def _range(ends: Sequence[float] | None) -> str:
    return "–" if not ends else f"{ends[0]:.3g} … {ends[1]:.3g}"


def _play(document: Mapping[str, Any], folder: Path, composition: Composition) -> str:
    """The command that plays it."""
    table = shlex.quote(str(folder / TABLE_NAME))
    whole = document["duration_s"] + document["lead_in_s"]
    given = [o for o in composition.overrides if o.partition("=")[0].split(".")[0] == "model"]
    inputs = list(document["inputs"])
    if len(inputs) == 2:
        play = ["controller=played", f"controller.u_v.file={table}"]
    else:
        name = inputs[0]
        play = [
            "controller=open_loop",
            f"signal@controller.{name}=from_csv",
            f"controller.{name}.file={table}",
            f"controller.{name}.column={name}",
        ]
    if not document["bounds_rad"]:  # a rotor alone: the references of a run are speeds
        play.insert(0, "ref=speed")
    words = [program(), "run", *(shlex.quote(o) for o in given), *play]
    if document["sample_time_s"] != 0.02:
        words.append(f"sim.sample_time={document['sample_time_s']:g}")
    return " ".join([*words, f"sim.duration={whole:g}"])
