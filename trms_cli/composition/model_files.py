"""Files that a choice may name: ``model=fit``, the folder of a fit, stands for its model.yaml."""

from __future__ import annotations

from collections.abc import Container, Sequence
from pathlib import Path

from trms_cli.composition.catalogue import Groups, Primary
from trms_cli.core.errors import ConfigurationError

#: The model in the folder of a fit.
MODEL_NAME = "model.yaml"
_GROUP, _KEY = "model", "model="
_YAML = (".yaml", ".yml")
#: Endings of files that are no options: recordings, documents, pages, logs.
_OTHERS = (".json", ".csv", ".mat", ".html", ".mcap", ".png", ".parquet")


def with_model_files(overrides: Sequence[str], primary: Primary, groups: Groups) -> tuple[str, ...]:
    """The overrides with the model's file for a folder that holds one.

    A name that is an option stays one, whatever folders there are.

    Raises ConfigurationError for a folder without a model, and for a file that is none; it tells
    which is near.
    """
    options = groups.get(_GROUP, {})
    if _GROUP not in primary.defaults or "from_file" not in options:
        return tuple(overrides)
    return tuple(
        _with_files(text, options) if text.lstrip("+").startswith(_KEY) else text
        for text in overrides
    )


def with_parameter_sets(argv: Sequence[str], groups: Groups) -> list[str]:
    """The command line with its file for a parameter set that is no model (``tras_record``)."""
    sets, options = groups.get("parameters", {}), groups.get(_GROUP, {})

    def file_of(name: str) -> str:
        return str(sets[name].file) if name in sets and name not in options else name

    replaced = []
    for word in argv:
        head, equals, value = word.partition("=")
        if head.lstrip("+") == _GROUP and equals:
            word = f"{head}={','.join(file_of(name.strip()) for name in value.split(','))}"
        replaced.append(word)
    return replaced


def _with_files(text: str, options: Container[str]) -> str:
    head, _, value = text.partition("=")
    whole = value.strip().strip("'\"")
    if Path(whole).expanduser().exists() and whole not in options:
        return f"{head}={model_file(whole)}"
    names = value.split(",")  # the alternatives of a sweep
    files = [name if name.strip() in options else model_file(name.strip()) for name in names]
    return f"{head}={','.join(files)}"


def model_file(name: str) -> str:
    """The file that a name stands for, or the name where it is none.

    Raises ConfigurationError for a folder without a model, and for a file that is none.
    """
    path = Path(name.strip("'\"")).expanduser()
    if path.is_dir() and name:
        if (path / MODEL_NAME).is_file():
            return str(path / MODEL_NAME)
        raise ConfigurationError(
            f"there is no {MODEL_NAME} in the folder {name!r}",
            where=_GROUP,
            remedy=f"name the folder of a fit (trms identify), or a model's YAML{_near(path)}",
        )
    if path.suffix in _OTHERS or (path.is_file() and path.suffix not in _YAML):
        raise ConfigurationError(
            f"{name!r} is not a model file",
            where=_GROUP,
            remedy=_near(path.parent).removeprefix(": ")
            or "name a model's YAML, the folder of a fit, or an option (`trms list model`)",
        )
    return name


def _near(folder: Path) -> str:
    """A model's file in a folder, asked for in words."""
    if (folder / MODEL_NAME).is_file():
        return f": did you mean {_GROUP}={folder / MODEL_NAME}?"
    return ""
