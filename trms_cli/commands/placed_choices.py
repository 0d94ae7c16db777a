"""What a choice at a place of another option takes with it: ``ref=square signal@ref.alpha_v=…``.

An option that includes another one sets some of its keys (``ref=square`` sets the amplitude of
its squares). Where a different one is chosen at that place, those keys mean nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from trms_cli.commands.catalogue import Primary, read_yaml, roots
from trms_cli.commands.declared_keys import included
from trms_cli.commands.overrides import parse


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
        present = OmegaConf.to_container(node)
        assert isinstance(present, dict)
        for key, value in foreign.items():
            if f"{place}.{key}" not in keys and present.get(key) == value:
                with open_dict(node):
                    del node[key]


def _foreign(
    declared: Primary, choices: Mapping[Any, Any], config_dirs: Sequence[Path]
) -> Iterator[tuple[str, dict[str, Any]]]:
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
            if isinstance(body, Mapping):
                own = _content(inner, chosen, config_dirs)
                yield f"{group}.{place}", {k: v for k, v in body.items() if k not in own}


def _content(group: str, option: Any, config_dirs: Sequence[Path]) -> dict[str, Any]:
    for root in roots(config_dirs) if isinstance(option, str) else ():
        file = root / group / f"{option}.yaml"
        if file.is_file():
            content = read_yaml(file)
            return content if isinstance(content, dict) else {}
    return {}
