"""An excitation: request, design, findings, files."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

from trms_cli.composition.composer import Composition
from trms_cli.composition.plain_values import check_files, number, whole_number
from trms_cli.core import wording
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.findings import NextCommand
from trms_cli.core.invocation import program
from trms_cli.core.plugins import build, construct
from trms_cli.library.tasks.task import Done, Listener

#: Files of an excitation in its folder.
TABLE_NAME, DOCUMENT_NAME, PAGE_NAME = "excitation.csv", "excitation.json", "excitation.html"
_MOST_SAMPLES = 1_000_000


def perform(composition: Composition, listener: Listener) -> Done:
    """Design what a configuration asks for."""
    from trms_cli.identification.excitation.design import design
    from trms_cli.identification.excitation.findings import findings, spectra_of, summary
    from trms_cli.runs.run_folder import write_document, write_whole

    begin = perf_counter()
    config = composition.config
    check_files(config)
    if config["out"] is not None and Path(config["out"]).joinpath(TABLE_NAME).exists():
        raise ConfigurationError(
            f"{Path(config['out']) / TABLE_NAME} exists",
            where="out",
            remedy="name another folder",
        )
    request, noise = _request(config), _noise(config)
    model = build(config["model"], "model")
    excitation = build(config["excitation"], "excitation")
    with listener.progress() as line:
        designed = design(model, excitation, request, line.tell)
    spectra = spectra_of(designed, noise)
    document = {"schema": "trms.excitation/1", **summary(designed, spectra)}
    document["excitation"] = {
        key: value for key, value in config["excitation"].items() if key != "_target_"
    }
    document["kind"] = str(composition.choices.get("excitation"))
    folder = composition.folder("excite")
    files = {"commands": folder / TABLE_NAME, "figures": folder / DOCUMENT_NAME}
    write_whole(_csv(designed, document["kind"]), files["commands"])
    document["file"] = str(files["commands"])
    write_document(document, files["figures"])
    then = [NextCommand(_play(document, folder, composition))]
    result = findings(document, designed, spectra, then)
    if config["picture"]:
        from trms_cli.reporting.page import write_page

        page = write_page(result, folder / PAGE_NAME, interactive=False)
        files |= {"picture": folder / "excitation.png", "page": page} if page else {}
    if composition.job is not None:
        amplitudes = ", ".join(f"{n} {i['amplitude']:.3g}" for n, i in document["inputs"].items())
        result = replace(result, lead=[amplitudes])
    spent = {"time": wording.seconds(perf_counter() - begin)}
    return Done(folder, replace(result, facts=spent, files=files, measures=()))


def _request(config: Mapping[str, Any]) -> Any:
    """The keys outside the groups, checked as a plugin's are."""
    from trms_cli.identification.excitation.design import ExcitationRequest

    plain = ("lead_in", "operating_point", "reversals", "amplitude", "bounds", "share", "rigs")
    for key in ("duration", "lead_in", "sample_time", "share"):
        number(config[key], key)
    whole_number(config["rigs"], "rigs")
    for key, holds, remedy in (
        *((key, config[key] > 0, "above 0") for key in ("duration", "sample_time", "share")),
        ("lead_in", config["lead_in"] >= 0, "0 s or more"),
        ("duration", config["duration"] >= config["sample_time"], "at least one sample_time"),
        ("share", config["share"] <= 1, "at most 1"),
    ):
        if not holds:
            raise ConfigurationError(f"{config[key]!r} given", where=key, remedy=remedy)
    samples = (config["duration"] + config["lead_in"]) / config["sample_time"]
    if samples > _MOST_SAMPLES:
        raise ConfigurationError(
            f"{samples:.3g} samples", where="duration", remedy=f"at most {_MOST_SAMPLES} samples"
        )
    keys = {
        "duration": config["duration"],
        "sample_time": config["sample_time"],
        "lowest": config["band"]["lowest"],
        "highest": config["band"]["highest"],
        "seed": whole_number(config["seed"], "seed"),
        **{key: config[key] for key in plain if config[key] is not None},
    }
    return construct(ExcitationRequest, keys)


def _noise(config: Mapping[str, Any]) -> dict[str, float]:
    """Standard deviation of each output's noise, the quantum's share included."""
    from trms_cli.plants.sensors import Sensors

    sensors = construct(Sensors, {key: config[key] for key in ("noise_sd", "quantum")})
    return dict(sensors.declared_noise(tuple({*config["noise_sd"], *config["quantum"]})))


def _csv(designed: Any, kind: str) -> str:
    """Commands with the header that recordings have."""
    inputs = designed.model.inputs
    lines = [
        f"# made by: trms excite excitation={kind}",
        f"# model: {designed.model.name}",
        f"# excitation begins: {designed.first * designed.plan.sample_time:g} s",
        ",".join(["t[s]", *(f"{signal.name}[{signal.unit}]" for signal in inputs)]),
    ]
    for time, row in zip(designed.time, designed.commands, strict=True):
        lines.append(",".join([f"{time:.9g}", *(f"{value:.6g}" for value in row)]))
    return "\n".join(lines) + "\n"


def _play(document: Mapping[str, Any], folder: Path, composition: Composition) -> str:
    table = shlex.quote(str(folder / TABLE_NAME))
    whole = document["duration_s"] + document["lead_in_s"]
    model_overrides = [
        o for o in composition.overrides if o.partition("=")[0].split(".")[0] == "model"
    ]
    play = playing(list(document["inputs"]), table, has_angles=bool(document["bounds_rad"]))
    words = [program(), "run", *(shlex.quote(o) for o in model_overrides), *play]
    if document["sample_time_s"] != 0.02:
        words.append(f"sim.sample_time={document['sample_time_s']:g}")
    return " ".join([*words, f"sim.duration={whole:g}"])


def playing(inputs: Sequence[str], table: str, *, has_angles: bool) -> list[str]:
    """Overrides of a run that plays the commands of a CSV; ``table``: its path, quoted."""
    if list(inputs) == ["u_v", "u_h"]:
        play = ["controller=played", f"controller.u_v.file={table}"]
    else:
        play = ["controller=open_loop"]
        for name in inputs:
            play.append(f"signal@controller.{name}=from_csv")
            play += [f"controller.{name}.file={table}", f"controller.{name}.column={name}"]
    # a rotor alone: the references of a run are speeds
    if not has_angles and {*inputs} <= {"u_v", "u_h"}:
        play.insert(0, "ref=speed")
    return play
