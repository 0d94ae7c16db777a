"""A study's YAML as a typed object."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import yaml

from trms_cli.core.errors import ConfigurationError

Kind = TypeVar("Kind")


def read_as(
    kind: type[Kind],
    path: Path,
    example: str,
    *,
    quick: bool = False,
    whole: Collection[str] = (),
) -> Kind:
    """The content of a study file.

    Parameters
    ----------
    kind : type
        A ``msgspec.Struct``.
    example : str
        A file of that kind, for the message.
    quick : bool
        Whether the values under its key ``quick``, if it has one, replace the others.
    whole : collection of str
        Keys whose mappings are replaced as a whole.

    Raises
    ------
    ConfigurationError
        If the file is not one.
    """
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
        has_mode = "quick" not in getattr(kind, "__annotations__", {"quick"})
        if has_mode and isinstance(document, dict):
            instead = document.pop("quick", {})
            document = merged(document, instead, whole) if quick else document
        return msgspec.convert(document, kind)
    except (OSError, AttributeError, yaml.YAMLError, msgspec.ValidationError) as error:
        raise ConfigurationError(
            f"this is no study: {str(error).splitlines()[0]}",
            where=str(path),
            remedy=f"compare it with {example}",
        ) from error


def merged(
    base: Mapping[str, Any], instead: Mapping[str, Any], whole: Collection[str] = ()
) -> dict[str, Any]:
    """Values replaced key by key; lists, and what is ``whole``, as a whole."""
    result = dict(base)
    for key, value in instead.items():
        current = result.get(key)
        if isinstance(current, Mapping) and isinstance(value, Mapping) and key not in whole:
            value = merged(current, value, whole)
        result[key] = value
    return result
