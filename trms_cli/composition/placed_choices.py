"""What a choice at a place of another option takes with it: ``ref=square signal@ref.alpha_v=…``.

An option that includes another one sets some of its keys (``ref=square`` sets the amplitude of
its squares), or refers to another place (the rig's model is that of the controller, unless another
is chosen). Where a different one is chosen at that place, those keys mean nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from trms_cli.composition.catalogue import Primary, read_yaml, roots
from trms_cli.composition.declared_keys import included
from trms_cli.composition.overrides import parse


def drop_foreign_keys(
    composed: Any,
    declared: Primary,
    choices: Mapping[Any, Any],
    typed: Sequence[str],
    config_dirs: Sequence[Path],
) -> None:
    """Take off a ``DictConfig`` what an option set for another choice than the one made inside it.

    Only keys go that the chosen one's YAML does not have: those with the value that the including
    option's YAML gives them, or all where it refers to another place. What somebody typed stays, to
    be refused if it is wrong.
    """
    from omegaconf import DictConfig, OmegaConf, open_dict

    keys = {parse(text, {}).key for text in typed}
    for place, own, setting in _replaced(declared, choices, config_dirs):
        node = OmegaConf.select(composed, place, throw_on_missing=False)
        if not isinstance(node, DictConfig) or place in keys:
            continue
        # A plain view: an interpolation that does not resolve is not this function's to judge.
        present = OmegaConf.to_container(node)
        assert isinstance(present, dict)
        for key, value in ((str(k), v) for k, v in present.items()):
            foreign = isinstance(setting, str) or (key in setting and setting[key] == value)
            typed_here = any(k == f"{place}.{key}" or k.startswith(f"{place}.{key}.") for k in keys)
            if key not in own and foreign and not typed_here:
                with open_dict(node):
                    del node[key]


def _replaced(
    declared: Primary, choices: Mapping[Any, Any], config_dirs: Sequence[Path]
) -> Iterator[tuple[str, set[str], Mapping[str, Any] | str]]:
    """Places with a choice that is not the including option's own.

    With the keys of that choice, and what the including option sets there: a mapping, or the text
    of an interpolation.
    """
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
            kept = {*own, *(key.split(".")[0] for _, key, _ in included(own))}
            if isinstance(body, Mapping) or (isinstance(body, str) and "${" in body):
                yield f"{group}.{place}", kept, body


def _content(group: str, option: Any, config_dirs: Sequence[Path]) -> dict[str, Any]:
    """An option's YAML, with the options of its group that it builds on (``plant=ideal``)."""
    for root in roots(config_dirs) if isinstance(option, str) else ():
        file = root / group / f"{option}.yaml"
        content = read_yaml(file) if file.is_file() else None
        if isinstance(content, dict):
            merged: dict[str, Any] = {"defaults": []}
            entries = content.get("defaults") or []
            for base in (entry for entry in entries if isinstance(entry, str)):
                beneath = (
                    _content(group, base, config_dirs) if base not in ("_self_", option) else {}
                )
                entries = [*beneath.get("defaults", []), *entries]
                merged |= beneath
            return {**merged, **content, "defaults": entries}
    return {}
