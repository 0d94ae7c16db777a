"""Effects generated for the model at hand: ``{port}_{law}``, a law on a place that the model names.

A law is a YAML of the group ``law``: a class of effects with its sizes, and ``???`` where the port
belongs. ``current_delay`` is the law ``delay`` at the port ``current``; whether a model has that is
seen once the effect meets it. An effect of the group ``effect`` hides a generated namesake.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from trms_cli.composition.catalogue import Groups, Option, read_yaml
from trms_cli.core.plugins import TARGET

if TYPE_CHECKING:  # a model is slow to import, and what is typed has none
    from trms_cli.effects.effect import Effect
    from trms_cli.models.model import Model

GROUP, EFFECTS = "law", "effect"
_PORT = "???"


def law_of(name: str, laws: Collection[str]) -> tuple[str, str] | None:
    """The port and the law that a name is made of; None: of none. The longest law counts."""
    fitting = [law for law in laws if name.endswith(f"_{law}") and len(name) > len(law) + 1]
    law = max(fitting, key=len, default=None)
    return None if law is None else (name.removesuffix(f"_{law}"), law)


def generated_node(name: str, groups: Groups) -> dict[str, Any] | None:
    """Class and arguments of a generated effect; None: its name is that of no law."""
    laws: Mapping[str, Option] = groups.get(GROUP, {})
    parts = law_of(name, laws)
    if parts is None or name in groups.get(EFFECTS, {}):
        return None
    node = dict(read_yaml(laws[parts[1]].file) or {})
    return {key: parts[0] if value == _PORT else value for key, value in node.items()}


def generated_nodes(model: Model, groups: Groups) -> Iterator[tuple[str, dict[str, Any]]]:
    """All laws at all ports of a model, whether they fit there or not."""
    inputs, outputs = ([s.name for s in signals] for signals in (model.inputs, model.outputs))
    ports = dict.fromkeys((*inputs, *model.axes, *outputs))
    for port in ports:
        for law in groups.get(GROUP, {}):
            name = f"{port}_{law}"
            node = generated_node(name, groups)
            if node is not None and TARGET in node:
                yield name, node


def at_own_port(name: str, effect: Effect, model: Model) -> bool:
    """Whether the port in an effect's name is where it acts; a sensor may be named by its axis."""
    return any(name.startswith(f"{port}_") for port in effect.port(model).values())


def chosen_nodes(names_chosen: Sequence[str], groups: Groups) -> dict[str, dict[str, Any]]:
    """Those of some names that are generated effects, with class and arguments."""
    nodes = ((name, generated_node(name, groups)) for name in names_chosen)
    return {name: node for name, node in nodes if node is not None}
