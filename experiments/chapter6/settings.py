"""Table 6.1: every setting with which the six cases ran, from the configuration itself."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from experiments.chapter6.study import Cases
from experiments.page_tables import markdown

_LINE = re.compile(r"^(?P<key>\w+):[^#]*#\s*(?P<meaning>.+?)\s*$")


def settings_table(study: Cases) -> str:
    """Settings, values and meanings; where a controller of the study differs, what it has."""
    from trms_cli.composition.composer import compose
    from trms_cli.core.resources import config_folder

    configs = {
        name: compose(["experiment=chapter6", *words]).config
        for name, words in study.controllers.items()
    }
    first, *others = configs
    meanings = _meanings((config_folder() / "controller" / "newton_mpc.yaml").read_text("utf-8"))
    rows = [["setting", "value", "meaning"], *_surroundings(configs[first], study)]
    for key, value in configs[first]["controller"].items():
        if key == "_target_":
            continue
        words = _value(value)
        for other in others:
            different = configs[other]["controller"][key]
            if different != value:
                words += f"; {other.replace('_', '-')}: {_value(different)}"
        rows.append([f"`controller.{key}`", words, meanings.get(key, "")])
    return markdown(rows)


def _surroundings(config: Mapping[str, Any], study: Cases) -> list[list[str]]:
    """What is around the controller: rig, observer, time."""
    from trms_cli.core.plugins import build

    model = build(config["model"], "model")
    lower, upper = model.input_bounds()
    inputs = ", ".join(
        f"{s.name} {low:g} to {high:g} {s.unit}"
        for s, low, high in zip(model.inputs, lower, upper, strict=True)
    )
    stops = ", ".join(f"{name} ±{stop:g} rad" for name, stop in model.stops.items())
    return [
        ["`model`", f"{model.name}, {config['model']['parameter_set']}", "of controller and rig"],
        ["`plant`", "ideal", "the model itself, every state without noise and quanta"],
        ["`plant.integration_step`", f"{config['plant']['integration_step']:g}", "s, of the rig"],
        ["`observer`", "full_state", "the state is known"],
        ["`sim.sample_time`", f"{config['sim']['sample_time']:g}", "s, of the measurements"],
        ["`sim.duration`", f"{study.duration:g}", "s, of each case"],
        ["start", "hanging rest", "rotors still, yaw 0"],
        ["inputs", inputs, "hard bounds of the plan"],
        ["stops", stops, "the rig's frame; no constraint of the plan"],
    ]


def _meanings(text: str) -> dict[str, str]:
    """The comments of a YAML by key of its first level."""
    meanings: dict[str, str] = {"qp": "solver of the quadratic program of an iteration"}
    key = ""
    for line in text.splitlines():
        if match := _LINE.match(line):
            key = match["key"]
            meanings[key] = match["meaning"]
        elif key and line.lstrip().startswith("#"):  # a comment that goes on
            meanings[key] += f" {line.strip(' #')}"
        else:
            key = ""
    return {name: meaning.replace("|", "\\|") for name, meaning in meanings.items()}


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        if "_target_" in value:
            return str(value["_target_"]).rpartition(".")[2]
        return ", ".join(f"{key} {_value(of)}" for key, of in value.items()) or "none"
    if isinstance(value, list):
        return _runs(value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, int | float) else str(value)


def _runs(values: list[Any]) -> str:
    """A list with equal neighbours together: 10 × 1, 5 × 2."""
    parts: list[list[Any]] = []
    for value in values:
        if parts and parts[-1][1] == value:
            parts[-1][0] += 1
        else:
            parts.append([1, value])
    return ", ".join(f"{count} × {_value(value)}" for count, value in parts)
