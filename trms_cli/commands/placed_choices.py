"""What a choice at a place of another option takes with it: ``ref=square signal@ref.alpha_v=…``.

An option that includes another one sets some of its keys (``ref=square`` sets the amplitude of
its squares), or refers to another place (the rig's model is that of the controller, unless another
is chosen). Where a different one is chosen at that place, those keys mean nothing.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trms_cli.commands.catalogue import Primary, read_yaml, roots
from trms_cli.commands.declared_keys import included
from trms_cli.commands.overrides import parse

#: A place that an interpolation refers to: ``${model}``, ``${oc.select:model.rig,…}``.
_REFERENCE = re.compile(r"\$\{(?:oc\.select:)?([\w.]+)")


def drop_foreign_keys(
    composed: Any,
    declared: Primary,
    choices: Mapping[Any, Any],
    typed: Sequence[str],
    config_dirs: Sequence[Path],
) -> None:
    """Take off a ``DictConfig`` what an option set for another choice than the one made inside it.

    Only keys go that the chosen one's YAML does not have, with the value that the including
    option's YAML gives them; what somebody typed stays, to be refused if it is wrong.
    """
    from omegaconf import DictConfig, OmegaConf, open_dict

    keys = {parse(text, {}).key for text in typed}
    for place, foreign in _foreign(declared, choices, config_dirs):
        node = OmegaConf.select(composed, place, throw_on_missing=False)
        if not isinstance(node, DictConfig) or place in keys:
            continue
        present = OmegaConf.to_container(node, resolve=True)
        assert isinstance(present, dict)
        if isinstance(foreign, _Referred):
            foreign = _referred(composed, foreign)
        for key, value in foreign.items():
            if f"{place}.{key}" not in keys and present.get(key) == value:
                with open_dict(node):
                    del node[key]


@dataclass(frozen=True)
class _Referred:
    """The keys of another place: those of the first of ``places`` that there is, less ``own``."""

    places: tuple[str, ...]
    own: frozenset[str]


def _referred(composed: Any, foreign: _Referred) -> dict[str, Any]:
    from omegaconf import DictConfig, OmegaConf

    for place in foreign.places:
        node = OmegaConf.select(composed, place, throw_on_missing=False)
        if isinstance(node, DictConfig):
            content = OmegaConf.to_container(node, resolve=True)
            assert isinstance(content, dict)
            return {str(k): v for k, v in content.items() if k not in foreign.own}
    return {}


def _foreign(
    declared: Primary, choices: Mapping[Any, Any], config_dirs: Sequence[Path]
) -> Iterator[tuple[str, dict[str, Any] | _Referred]]:
    """Places with a choice that is not the including option's own, and the keys set for that."""
    for group in declared.defaults:
        content = _content(group, choices.get(group), config_dirs)
        for inner, place, default in included(content):
            chosen = choices.get(f"{inner}@{group}.{place}")
            if chosen in (None, default):
                continue
            body: Any = content
            for name in place.split("."):
                body = body.get(name) if isinstance(body, Mapping) else None
            own = _content(inner, chosen, config_dirs)
            if isinstance(body, Mapping):
                yield f"{group}.{place}", {k: v for k, v in body.items() if k not in own}
            elif isinstance(body, str) and _REFERENCE.search(body):
                kept = {*own, *(key.split(".")[0] for _, key, _ in included(own))}
                yield (
                    f"{group}.{place}",
                    _Referred(tuple(_REFERENCE.findall(body)), frozenset(kept)),
                )


def _content(group: str, option: Any, config_dirs: Sequence[Path]) -> dict[str, Any]:
    for root in roots(config_dirs) if isinstance(option, str) else ():
        file = root / group / f"{option}.yaml"
        if file.is_file():
            content = read_yaml(file)
            return content if isinstance(content, dict) else {}
    return {}
