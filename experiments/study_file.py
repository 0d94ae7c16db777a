"""A study's YAML as a typed object."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import msgspec
import yaml

from trms_cli.core.errors import ConfigurationError

Kind = TypeVar("Kind")


def read_as(kind: type[Kind], path: Path, example: str) -> Kind:
    """The content of a study file.

    Parameters
    ----------
    kind : type
        A ``msgspec.Struct``.
    example : str
        A file of that kind, for the message.

    Raises
    ------
    ConfigurationError
        If the file is not one.
    """
    try:
        return msgspec.convert(yaml.safe_load(path.read_text(encoding="utf-8")), kind)
    except (OSError, yaml.YAMLError, msgspec.ValidationError) as error:
        raise ConfigurationError(
            f"this is no study: {str(error).splitlines()[0]}",
            where=str(path),
            remedy=f"compare it with {example}",
        ) from error
