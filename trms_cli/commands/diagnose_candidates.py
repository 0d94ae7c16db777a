"""The suspects of a diagnosis: every option of the group ``effect``, a user's own among them."""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trms_cli.composition.catalogue import read_groups, read_yaml
from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.core.plugins import TARGET, build, nearest
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import ExtendedModel, effect_names
from trms_cli.models.model import Model

_GROUP, _ALL = "effect", "all"


@dataclass(frozen=True)
class Suspects:
    """Effects that may be the cause."""

    effects: Mapping[str, Effect]  #: At the sizes of their options
    nodes: Mapping[str, Mapping[str, Any]]  #: What the options say: class and arguments
    #: Effects that were asked for by a pattern and that the model cannot carry, and why
    left_out: Mapping[str, str]


def suspects_of(words: Sequence[str], model: Model, config_dirs: Sequence[Path] = ()) -> Suspects:
    """The effects that ``candidates`` names, as far as the model can carry them.

    Parameters
    ----------
    words : sequence of str
        ``all``, names, patterns, and any of these after ``!`` to leave out again.
    model : Model
        The nominal one; an effect that it has already is no suspect.
    config_dirs : sequence of Path
        The user's folders; an option there hides a built-in namesake.

    Raises
    ------
    ConfigurationError
        For a name or pattern that fits nothing, an option that is no effect, or a list that
        leaves nothing.
    ModelError
        For an effect that is asked for by its name and that the model cannot carry.
    """
    library = effect_nodes(config_dirs)
    effects: dict[str, Effect] = {}
    left_out: dict[str, str] = {}
    present = effect_names(model)
    for name in _chosen(words, library):
        if name in present:
            left_out[name] = "the nominal model has it already"
            continue
        effect = build(library[name], f"{_GROUP}.{name}")
        if not isinstance(effect, Effect):
            raise ConfigurationError(
                f"{library[name][TARGET]!r} is no effect",
                where=f"{_GROUP}.{name}",
                remedy=f"derive it from trms_cli.effects.effect.Effect, or leave it out: !{name}",
            )
        try:
            ExtendedModel(model, name, effect)
        except ModelError as error:
            if name in words:
                raise
            left_out[name] = error.problem
            continue
        effects[name] = effect
    if not effects:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
        raise ConfigurationError(
            "no effect is left to be suspected" + (f" ({reasons})" if reasons else ""),
            where="candidates",
            remedy="candidates=[all], or names that `trms list effect` shows",
        )
    return Suspects(effects, {name: library[name] for name in effects}, left_out)


def effect_nodes(config_dirs: Sequence[Path] = ()) -> dict[str, dict[str, Any]]:
    """All effects in the search path, by the name under which a model gains them."""
    nodes: dict[str, dict[str, Any]] = {}
    for option in read_groups(config_dirs).get(_GROUP, {}).values():
        content = read_yaml(option.file)
        for name, node in content.items() if isinstance(content, dict) else ():
            if isinstance(node, dict) and TARGET in node:
                nodes.setdefault(str(name), node)
    return dict(sorted(nodes.items()))


def _chosen(words: Sequence[str], library: Mapping[str, Any]) -> list[str]:
    """Names in the order of the library."""
    taken: set[str] = set()
    if words and all(word.startswith("!") for word in words):
        taken = set(library)  # `all` goes without saying
    for word in words:
        if word.startswith("!"):
            taken -= _fitting(word[1:], library)
        else:
            taken |= _fitting(word, library)
    return [name for name in library if name in taken]


def _fitting(word: str, library: Mapping[str, Any]) -> set[str]:
    if word == _ALL:
        return set(library)
    found = {name for name in library if fnmatch.fnmatchcase(name, word)}
    if not found:
        raise ConfigurationError(
            f"no effect is called {word!r}",
            where="candidates",
            remedy=nearest(word, [_ALL, *library]),
        )
    return found
