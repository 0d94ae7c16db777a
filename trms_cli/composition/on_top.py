"""Overrides on top of those of an earlier run: what of that run stays.

What was typed then and what is typed now are composed together, but for two things:

- A value that was typed for an option which is no longer chosen goes with it, unless the new
  option has such a key too: commands that were played mean nothing to a PID.
- The rig stays the earlier run's. The equations of a simulated rig are those of ``model`` unless
  others are chosen (``configs/plant/simulated.yaml``); so what a ``model=`` typed now would change
  of them is chosen explicitly. ``model`` is then only what controller and observer believe.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from trms_cli.composition.arguments import text_of
from trms_cli.composition.catalogue import Primary, read_groups, read_primary, take_config_dirs
from trms_cli.composition.checks import plain_names
from trms_cli.composition.composer import Composer, Composition
from trms_cli.composition.overrides import Override, parse
from trms_cli.composition.plain_values import value_at
from trms_cli.core.errors import TrmsError
from trms_cli.core.yaml_data import load_yaml

#: Where the rig's own equations are chosen, and the place of what they are.
RIG_CHOICE, RIG = "model@plant.model", "plant.model"
#: Groups that say which equations a rig has that chooses none, with the place of each.
_OF_RIG = {"model@model.rig": "model.rig", "model": "model"}
_MULTIRUN = {"-m", "--multirun"}


@dataclass(frozen=True)
class OnTop:
    """What is typed now, with what stays of an earlier run."""

    kept: tuple[str, ...]  #: Overrides of the earlier run
    rig: tuple[str, ...]  #: Overrides that keep its rig as it was
    dropped: tuple[str, ...]  #: Overrides of the earlier run that mean nothing now
    #: Before a value is typed, of a sweep its first job's; empty where no option is chosen anew
    config: Mapping[str, Any]
    choices: Mapping[str, Any]  #: The option in each group, likewise

    @property
    def words(self) -> list[str]:
        """What is to be composed before what is typed now."""
        return [*self.kept, *self.rig]


def on_top(
    earlier: Composition, typed: Sequence[str], argv: Sequence[str], primary: str, *, played: bool
) -> OnTop:
    """What stays of an earlier run under the command line `argv`.

    ``earlier``, ``typed``: how it was composed, and from which overrides (without its folder).
    ``played``: whether its controller played commands and followed no reference: then nothing that
    was typed for it is of use to another one.

    Raises ConfigurationError for an option that does not exist.
    """
    more, rest = take_config_dirs(argv)
    folders = tuple(dict.fromkeys((*earlier.config_dirs, *more)))
    layers = _Layers(earlier, typed, rest, primary, folders)
    kept, dropped = layers.sift(typed, played) if layers.chosen_now else (list(typed), [])
    config, choices = layers.first or ({}, {})
    return OnTop(tuple(kept), tuple(layers.rig_words(kept)), tuple(dropped), config, choices)


class _Layers:
    """An earlier run's overrides and what is typed on top of them."""

    def __init__(
        self,
        earlier: Composition,
        typed: Sequence[str],
        argv: Sequence[str],
        primary: str,
        folders: tuple[Path, ...],
    ) -> None:
        self._earlier = earlier
        self._groups = read_groups(folders)
        self._declared: Primary = read_primary(primary, folders)
        self._composer = Composer(primary, folders)
        words = [word for word in argv if "=" in word and not word.startswith("-")]
        self._now = [parse(word, self._groups) for word in words]
        self._swept = bool(_MULTIRUN.intersection(argv))
        self._placed_now = [f"{o.key}{o.package}" for o in self._now if o.package]
        self.chosen_now = [str(o) for o in self._now if self._is_choice(o) or o.package]
        self._chosen_then = [w for w in typed if self._is_choice(parse(w, self._groups))]
        #: What each alternative of the options chosen now composes to.
        self._alternatives = self._composed()

    def _composed(self) -> list[tuple[Mapping[str, Any], Mapping[str, Any]] | None]:
        return [
            self._composer.before_values([*self._chosen_then, *variant])
            for variant in (self._variants() if self.chosen_now else ())
        ]

    @property
    def first(self) -> tuple[Mapping[str, Any], Mapping[str, Any]] | None:
        """What the choices compose to; None where none is made now or they do not go together."""
        return self._alternatives[0] if self._alternatives else None

    def _is_choice(self, override: Override) -> bool:
        """Of an option of a group that has its place in the primary configuration."""
        return not override.package and override.key in self._declared.defaults

    def _variants(self) -> Iterator[list[str]]:
        """The choices typed now; in a sweep each of the alternatives at least once."""
        options = [[word] for word in self.chosen_now]
        if self._swept:
            overrides = [parse(word, self._groups) for word in self.chosen_now]
            options = [
                [str(o._replace(value=v)) for v in plain_names(o.value or "") or [o.value or ""]]
                for o in overrides
            ]
        first = [words[0] for words in options]
        yield first
        for number, words in enumerate(options):
            for word in words[1:]:
                yield [*first[:number], word, *first[number + 1 :]]

    def sift(self, typed: Sequence[str], played: bool) -> tuple[list[str], list[str]]:
        """Overrides of then that still have their place, and those that have none."""
        typed = [
            w for w in typed if not w.startswith(tuple(f"{spot}=" for spot in self._placed_now))
        ]
        placed = [w for w in typed if parse(w, self._groups).package]
        staying = {w for w in placed if self._stays(w, played)}
        # values are held against the options inside that stay
        self._chosen_then += [word for word in placed if word in staying]
        self._alternatives = self._composed()
        kept = [w for w in typed if w in staying or (w not in placed and self._stays(w, played))]
        return kept, [word for word in typed if word not in kept]

    def _stays(self, word: str, played: bool) -> bool:
        override = parse(word, self._groups)
        if self._is_choice(override):
            return True
        place = override.package.removeprefix("@") or override.key
        return all(
            alternative is None
            or not self._is_replaced(place, *alternative)
            or self._fits(override, place, *alternative, played=played)
            for alternative in self._alternatives
        )

    def _is_replaced(
        self, place: str, config: Mapping[str, Any], choices: Mapping[str, Any]
    ) -> bool:
        """Whether the option that a place belongs to is another now."""
        group = place.partition(".")[0]
        if isinstance(self._declared.defaults.get(group), list):
            return any(
                name not in (config.get(group) or {}) for name in self._earlier.config[group]
            )
        if group not in self._declared.defaults:
            return False
        if self._is_replaced_inside(place, choices):
            return True
        if choices.get(group) != self._earlier.choices.get(group):
            return True
        path = f"{group}.path"  # of the model: another file is another option
        return bool(value_at(self._earlier.config, path) != value_at(config, path))

    def _is_replaced_inside(self, place: str, choices: Mapping[str, Any]) -> bool:
        """Likewise of an option at a place of its own: ``signal@controller.u_v=chirp``."""
        return any(
            f"{place}.".startswith(f"{spot.partition('@')[2]}.")
            and choices.get(spot) != self._earlier.choices.get(spot)
            for spot in self._placed_now
        )

    def _fits(
        self,
        override: Override,
        place: str,
        config: Mapping[str, Any],
        choices: Mapping[str, Any],
        *,
        played: bool,
    ) -> bool:
        """Whether the option that replaces another has a place for an override too."""
        group = place.partition(".")[0]
        is_of_rig = place.startswith(f"{RIG}.") and self._is_replaced_inside(place, choices)
        if group == "model" or is_of_rig:
            return False  # values of one model's parameters say nothing of another model's
        if group == "controller" and played and not self._is_same("controller"):
            return False
        if override.package:
            words = [*self._chosen_then, *self._first_alternative, str(override)]
            return self._composer.before_values(words) is not None
        parts = place.split(".")
        node: Any = config
        for depth, name in enumerate(parts):
            if isinstance(node, str) and "${" in node:
                return True  # what stands there is told by another key
            is_open = depth > 1 and isinstance(node, Mapping) and not node
            if is_open:
                return True
            if not isinstance(node, Mapping) or name not in node:
                return False
            node = node[name]
        return _is_alike(override.value or "", node)

    def _is_same(self, group: str) -> bool:
        """Whether every alternative has the earlier run's option."""
        earlier = self._earlier.choices.get(group)
        return all(each is None or each[1].get(group) == earlier for each in self._alternatives)

    @property
    def _first_alternative(self) -> list[str]:
        return next(self._variants(), [])

    def rig_words(self, kept: Sequence[str]) -> Iterator[str]:
        """What keeps the rig's equations as they were, where a model is typed now."""
        equations = value_at(self._earlier.config, RIG)
        spots = [f"{o.key}{o.package}" for o in self._now]
        is_other_model = any(
            spot.partition(".")[0] == "model" or o.package.startswith("@model")
            for spot, o in zip(spots, self._now, strict=True)
            if spot != RIG_CHOICE and not o.package.startswith(f"@{RIG}")
        )
        is_other_rig = any(
            spot == RIG_CHOICE or o.key.startswith(RIG) or o.package.startswith(f"@{RIG}")
            for spot, o in zip(spots, self._now, strict=True)
        )
        if not is_other_model or is_other_rig or not isinstance(equations, Mapping):
            return
        choices = self._earlier.choices
        if choices.get(RIG_CHOICE):
            return  # chosen then, and so it is still
        option = next(
            (
                choices.get(group)
                for group, place in _OF_RIG.items()
                if value_at(self._earlier.config, place) == equations
            ),
            None,
        )
        if not isinstance(option, str):
            return
        pinned = f"{RIG_CHOICE}={option}"
        base = self._composer.before_values([*self._plant_words(kept), pinned])
        if base is None:  # a plant of one's own without such a choice
            yield f"{RIG}={text_of(equations)}"
            return
        yield pinned
        yield from differing_words(RIG, value_at(base[0], RIG) or {}, equations)

    def _plant_words(self, kept: Sequence[str]) -> list[str]:
        """Choices of a plant, then and now, of a sweep the first alternative."""
        now = self._first_alternative if self.chosen_now else []
        then = [word for word in kept if self._is_choice(parse(word, self._groups))]
        return [word for word in (*then, *now) if parse(word, self._groups).key == "plant"]


def _is_alike(typed: str, node: Any) -> bool:
    """Whether a value as typed can stand where an option has ``node``: a mapping for a mapping."""
    try:
        value = load_yaml(typed)
    except (yaml.YAMLError, TrmsError):
        return True  # no YAML, but Hydra's grammar: its to judge
    if isinstance(value, Mapping) and isinstance(node, Mapping):
        return not node or all(key in node for key in value)
    return node is None or isinstance(value, Mapping) == isinstance(node, Mapping)


def differing_words(place: str, base: Any, node: Any) -> Iterator[str]:
    """Overrides that make ``base`` what ``node`` is."""
    if isinstance(base, Mapping) and isinstance(node, Mapping):
        for key, value in node.items():
            if key not in base or base[key] != value:
                yield from differing_words(f"{place}.{key}", base.get(key), value)
    elif isinstance(node, Mapping) and node:
        for key, value in node.items():
            yield from differing_words(f"{place}.{key}", None, value)
    else:
        yield f"{place}={text_of(node)}"
