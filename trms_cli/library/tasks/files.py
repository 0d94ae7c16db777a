"""What a fit or a diagnosis leaves besides figures: its request, and what a model file says."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from trms_cli.composition.catalogue import config_folder, read_yaml
from trms_cli.composition.composer import Composition
from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.core.plugins import TARGET
from trms_cli.core.whole_file import replace_whole
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.model_writer import ModelOrigin
from trms_cli.models.parameters import parameter_file

#: What was typed, for `resume`.
REQUEST_NAME, CONFIG_NAME = "request.json", "config.yaml"
#: Keys of a model's node that a model file has a place for.
_OF_THE_FILE = {TARGET, "parameter_set", "parameters"}


def write_config(composition: Composition, folder: Path) -> None:
    """The resolved configuration for a person, and what was typed for `resume`."""
    request = {
        "overrides": [
            word for word in composition.overrides if word.lstrip("+").partition("=")[0] != "out"
        ],
        "config_dirs": [str(folder) for folder in composition.config_dirs],
        "working_folder": str(Path.cwd()),
    }
    try:
        replace_whole(folder / CONFIG_NAME, composition.yaml.encode())
        text = json.dumps(request, indent=2, ensure_ascii=False) + "\n"
        replace_whole(folder / REQUEST_NAME, text.encode())
    except OSError as error:
        raise RecordingError(
            f"cannot be written: {error.strerror or error}",
            where=str(folder),
            remedy="name a folder that you can write to: out=FOLDER",
        ) from error


def origin_of(composition: Composition) -> ModelOrigin | None:
    """What the fitted model's file says besides values; None where the method writes its own.

    A model that is no option of the library goes in as a plugin.

    Raises ConfigurationError if a model file has no place for something that the model was given.
    """
    node = composition.config["model"]
    effects = {name: dict(n) for name, n in (composition.config.get("effect") or {}).items()}
    own = {name: effect_arguments(name, n) for name, n in effects.items()}
    if "path" in node:  # model=FILE
        content = parameter_file(str(node["path"]))
        return ModelOrigin(
            option=content.model, limits=content.limits, effects=dict(content.effects) | own
        )
    option = str(composition.choices["model"])
    if not (config_folder() / "model" / f"{option}.yaml").is_file():
        return ModelOrigin(option=dict(node), effects=own)
    _check_places(option, node)
    name = node.get("parameter_set")
    limits = dict(parameter_file(name).limits) if isinstance(name, str) else {}
    return ModelOrigin(option=option, limits=limits, effects=own)


def names_of_files(datasets: Iterable[Dataset]) -> str:
    """The files of recordings, each once, with the beginnings of their hashes."""
    files = {dataset.source: dataset.sha256 for dataset in datasets}
    return ", ".join(f"{Path(file).name} (sha256 {sha[:16]})" for file, sha in files.items())


def effect_arguments(name: str, node: Mapping[str, Any]) -> dict[str, Any]:
    """An effect's arguments; without its class if the library has it under this name."""
    library = config_folder() / "effect" / f"{name}.yaml"
    arguments = dict(node)
    if library.is_file():
        library_node = read_yaml(library).get(name, {})
        if library_node.get(TARGET) == arguments.get(TARGET):
            del arguments[TARGET]
            arguments = {key: v for key, v in arguments.items() if library_node.get(key) != v}
    return arguments


def _check_places(option: str, node: Mapping[str, Any]) -> None:
    """Refuse what a model file could not say: `load_model` builds the option as it is."""
    library_node = read_yaml(config_folder() / "model" / f"{option}.yaml")
    for key, value in node.items():
        if key not in _OF_THE_FILE and library_node.get(key) != value:
            raise ConfigurationError(
                f"{key} is {value!r} here and {library_node.get(key)!r} in the option {option!r}, "
                "by which a model file is read",
                where=f"model.{key}",
                remedy="choose an option of `trms list model` that has it",
            )
