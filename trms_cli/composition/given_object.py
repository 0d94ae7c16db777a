"""Objects that a caller in Python gives where a configuration has a plugin.

In the configuration such an object is a plugin too: its arguments say what it was, and building it
takes the object itself from those of the call. So a log tells the class and how it was made; to
build it once the call is over is refused, since a log holds no objects.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from copy import deepcopy
from dataclasses import fields, is_dataclass, replace
from hashlib import sha256
from typing import TYPE_CHECKING, Any

from trms_cli.composition.plain_values import value_at
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import TARGET

if TYPE_CHECKING:
    from trms_cli.composition.composer import Composition

_TARGET = f"{__name__}.object_stand_in"
#: Its name in logs of former versions.
_FORMER = "trms_cli.commands.given_object.taken"
#: Letters of an object's own words that a log keeps.
_LONGEST = 400
#: Letters of an object's label in tables and titles.
_LONGEST_LABEL = 48
#: Where an object goes besides the place that it is given to.
_ALSO = {"effect": "plant.effects", "fault": "plant.faults"}
_ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")
_objects: ContextVar[Sequence[Any]] = ContextVar("objects", default=())


@contextmanager
def place_objects(objects: Sequence[Any]) -> Iterator[None]:
    """Inside, :func:`node_of` their places in `objects` builds to them."""
    before = _objects.set(tuple(objects))
    try:
        yield
    finally:
        _objects.reset(before)


def node_of(number: int, plugin: Any) -> dict[str, Any]:
    """The configuration that stands for an object, by its place among those of the call."""
    return {TARGET: _TARGET, "number": number, "kind": kind_of(plugin), "words": words_of(plugin)}


def object_stand_in(*, number: int, kind: str, words: str) -> Any:
    """The object that a node stands for.

    Raises ConfigurationError once the call that it was given to is over.
    """
    objects = _objects.get()
    if number < len(objects) and kind_of(objects[number]) == kind:
        return objects[number]
    raise ConfigurationError(
        f"{words} was an object in a Python session, which no file holds", remedy=_REMEDY
    )


_REMEDY = (
    "call it from Python again with such an object; or give the class a YAML with its _target_ "
    "(docs/writing-a-plugin.md), which can be repeated by anyone"
)


def refuse_objects(config: Any, where: str, source: str) -> None:
    """Refuse a configuration of `source`, at the place `where` of the whole, that had an object.

    Raises ConfigurationError: it names the place and what stood there.
    """
    if not isinstance(config, Mapping):
        return
    if config.get(TARGET) in (_TARGET, _FORMER):
        raise ConfigurationError(
            f"its {where} was {config.get('words')}, an object in a Python session, which a log "
            "cannot hold: the run cannot be repeated from it",
            where=source,
            remedy=_REMEDY,
        )
    for key, value in config.items():
        refuse_objects(value, f"{where}.{key}" if where else str(key), source)


def kind_of(plugin: Any) -> str:
    """The dotted name of an object's class."""
    kind = type(plugin)
    return f"{kind.__module__}.{kind.__qualname__}"


def words_of(plugin: Any) -> str:
    """What an object says of itself, on one line, without its place in memory."""
    words = _ADDRESS.sub("", " ".join(repr(plugin).split()))
    return words if len(words) <= _LONGEST else f"{words[:_LONGEST]}…"


def with_objects(composition: Composition, objects: Mapping[str, Any]) -> Composition:
    """The composition with objects at their places, in its choices by what they are.

    Raises ConfigurationError if there is no such place.
    """
    if not objects:
        return composition
    config, choices = deepcopy(composition.config), dict(composition.choices)
    for number, (place, plugin) in enumerate(objects.items()):
        node = node_of(number, plugin)
        for spot in _places(place, composition):
            _put(config, spot, node)
        group, *inside = place.split(".")
        if not inside:
            choices[group] = label_of(plugin)
        elif isinstance(choices.get(group), list):
            choices[group] = [*choices[group], ".".join(inside)]
    return replace(composition, config=config, choices=choices)


def _places(place: str, composition: Composition) -> Iterator[str]:
    """A place, and those that follow it: the rig's model is that of the controller."""
    yield place
    config, (group, _, rest) = composition.config, place.partition(".")
    plant = config.get("plant")
    if not isinstance(plant, Mapping):
        return
    if place == "model" and not composition.choices.get("model@plant.model"):
        yield "plant.model"
    if group in _ALSO and rest and _ALSO[group].partition(".")[2] in plant:
        yield f"{_ALSO[group]}.{rest}"


def _put(config: dict[str, Any], place: str, node: Any) -> None:
    path, _, last = place.rpartition(".")
    inner = value_at(config, path)
    if not isinstance(inner, dict):
        raise ConfigurationError(
            "an object is given, and there is no such place",
            where=place,
            remedy=f"top-level places: {', '.join(config)}",
        )
    inner[last] = node


def label_of(plugin: Any) -> str:
    """What tells an object from others of its class: its fields that are not as by default."""
    name = type(plugin).__name__
    if not is_dataclass(plugin):
        whole = words_of(plugin)
        return whole if len(whole) <= _LONGEST_LABEL and not whole.startswith("<") else name
    changed = [
        f"{f.name}={value!r}"
        for f in fields(plugin)
        if f.repr and not _same(value := getattr(plugin, f.name), f.default)
    ]
    label = f"{name}({', '.join(changed)})" if changed else name
    if len(label) <= _LONGEST_LABEL and "\n" not in label:
        return label
    return f"{name} #{sha256(words_of(plugin).encode()).hexdigest()[:6]}"


def _same(one: Any, other: Any) -> bool:
    try:
        return bool(one == other)
    except (TypeError, ValueError):  # arrays
        return False
