"""What an annotated type allows, in words; and what msgspec says of a value that it refuses."""

from __future__ import annotations

import dataclasses
import re
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Union

import msgspec

_PLAIN = {
    float: "a number",
    int: "a whole number",
    str: "a text",
    bool: "true or false",
    type(None): "null",
    Path: "a path",
}
_SIGNS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
#: A step of msgspec's path: into a mapping's value, a list's item, an object's field.
_STEP = re.compile(r"\[\.\.\.\]|\[(\d+)\]|\.(\w+)")


class Refusal(NamedTuple):
    """Why a value does not fit a type."""

    path: str  #: from the value to the part that is wrong: ``.kp``, ``[1]``
    given: Any  #: that part
    allowed: str  #: in words
    unknown: str = ""  #: a key that the type has not
    known: tuple[str, ...] = ()  #: the keys or words that could have been given instead


def words(hint: Any) -> str:
    """A type in words: "a number > 0", "auto or a mapping with the keys kp, ki, kd"."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        return words(arguments[0]) + _range(arguments[1:])
    if origin is Literal:
        return " or ".join(map(str, arguments))
    if origin in (Union, types.UnionType):
        return ", or ".join(words(member) for member in arguments)
    if hint in _PLAIN:
        return _PLAIN[hint]
    if origin is tuple and arguments == (float, float):
        return "two numbers [lower, upper]"
    if origin is tuple and arguments[-1:] != (...,):
        return f"a list of {len(arguments)}: {', '.join(map(words, arguments))}"
    if _is_a(hint, Mapping):
        return "a mapping" + (f" from names to {words(arguments[1])}" if arguments else "")
    if _is_a(hint, Sequence):
        return "a list" + (f", each item {words(arguments[0])}" if arguments else "")
    if _fields(hint):
        return f"a mapping with the keys {', '.join(_fields(hint))}"
    return "a plugin: choose one by its name, or give a mapping with _target_"


def refusal(error: msgspec.ValidationError, value: Any, hint: Any) -> Refusal:
    """What `msgspec.convert(value, hint)` found wrong, and where."""
    message, _, place = str(error).partition(" - at `$")
    path = ""
    for step in _STEP.finditer(place):
        index, name = step[1], step[2]
        if step[0] == "[...]":  # msgspec keeps to itself which one it is
            name = _refused_key(value, hint)
        if (name is not None and name not in value) or (name is None and index is None):
            break
        hint = _inside(hint, name if index is None else int(index))
        value = value[name if index is None else int(index)]
        path += f".{name}" if index is None else f"[{index}]"
    unknown = re.search(r"unknown field `(.+)`", message)
    if unknown:
        known = tuple(name for member in _members(hint) for name in _fields(member))
        return Refusal(f"{path}.{unknown[1]}", value[unknown[1]], words(hint), unknown[1], known)
    missing = re.search(r"missing required field `(.+)`", message)
    if missing:
        return Refusal(f"{path}.{missing[1]}", None, words(hint), missing[1])
    literals = tuple(
        str(word)
        for member in _members(hint)
        if typing.get_origin(member) is Literal
        for word in typing.get_args(member)
    )
    known = literals if isinstance(value, str) and len(_members(hint)) == 1 else ()
    return Refusal(path, value, words(hint), known=known)


def _refused_key(value: Mapping[str, Any], hint: Any) -> Any:
    for key, item in value.items():
        try:
            msgspec.convert({key: item}, hint, strict=True)
        except msgspec.ValidationError:
            return key
    return None


def _inside(hint: Any, step: str | int) -> Any:
    """The type of a field, an item or a mapping's value."""
    for member in _members(hint):
        arguments = typing.get_args(member)
        if isinstance(step, int):
            if typing.get_origin(member) is tuple and arguments[-1:] != (...,):
                return arguments[step]
            if arguments and _is_a(member, Sequence):
                return arguments[0]
        elif _is_a(member, Mapping):
            return arguments[1] if arguments else Any
        elif step in _fields(member):
            return typing.get_type_hints(member, include_extras=True)[step]
    return Any


def _members(hint: Any) -> list[Any]:
    """The members of a union, or the type itself; without annotations."""
    if typing.get_origin(hint) is Annotated:
        hint = typing.get_args(hint)[0]
    if typing.get_origin(hint) in (Union, types.UnionType):
        return [inner for member in typing.get_args(hint) for inner in _members(member)]
    return [hint]


def _is_a(hint: Any, kind: type) -> bool:
    origin = typing.get_origin(hint) or hint
    return isinstance(origin, type) and origin is not str and issubclass(origin, kind)


def _fields(hint: Any) -> list[str]:
    """Keys of a record: a msgspec.Struct, or a dataclass."""
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        return list(hint.__struct_fields__)
    return [f.name for f in dataclasses.fields(hint)] if dataclasses.is_dataclass(hint) else []


def _range(annotations: Sequence[Any]) -> str:
    limits = [
        f"{sign} {getattr(meta, key):g}"
        for meta in annotations
        if isinstance(meta, msgspec.Meta)
        for key, sign in _SIGNS.items()
        if getattr(meta, key) is not None
    ]
    lengths = [
        f" with at {way} {getattr(meta, key)} items"
        for meta in annotations
        if isinstance(meta, msgspec.Meta)
        for key, way in (("min_length", "least"), ("max_length", "most"))
        if getattr(meta, key) is not None
    ]
    return "".join(f" {limit}" for limit in [" and ".join(limits)] if limit) + "".join(lengths)
