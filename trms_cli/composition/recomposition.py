"""Composes many experiments that differ in values: each choice of options once, values inside it.

Hydra takes a fifth of a second for a composition, which is most of a short run. What it does for
a choice of options (`controller=pid`) is kept; a value (`plant.parameters.k_g=0.19`) is then put
into a copy of the unresolved configuration, so that what refers to it follows. The result equals
a composition from the start, which a test holds for many overrides; what is not plainly a value
set at a key that is there (or in an open mapping) is composed from the start.
"""

from __future__ import annotations

import functools
import re
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from trms_cli.composition.catalogue import (
    Groups,
    Primary,
    make_importable,
    read_groups,
    read_primary,
)
from trms_cli.composition.composer import (
    Composition,
    _check_keys,
    _chosen,
    _hydra_compose,
    compose_request,
)
from trms_cli.composition.declared_keys import DeclaredKeys
from trms_cli.composition.overrides import Override, Request, _value, parse, prepare
from trms_cli.composition.placed_choices import _replaced, drop_foreign_keys
from trms_cli.core.errors import TrmsError

#: Choices of options that are kept.
_MOST_BASES = 64
_REFERENCE = re.compile(r"\$\{(\w+(?:\.\w+)*)\}")
#: ``${oc.select:KEY,DEFAULT}``: what stands at a key, or the default where nothing does.
_SELECTED = re.compile(r"\$\{oc\.select:(\w+(?:\.\w+)*),(\$\{\w+(?:\.\w+)*\}|\{\})\}")
_INTEGER = re.compile(r"-?(?:0|[1-9]\d*)")
_REAL = re.compile(r"-?(?:0|[1-9]\d*)\.\d+(?:[eE][-+]?\d+)?")
_DEEPEST = 20  # references that lead to references
_DOTTED = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*")


class _Unusual(Exception):
    """Only a composition from the start knows what this means."""


@dataclass
class _Base:
    """What a choice of options composes to, without the values that are typed."""

    config: dict[str, Any]  #: Unresolved, plain
    choices: Mapping[Any, Any]  #: Hydra's record of them
    keys: DeclaredKeys  #: Tells which mappings are open
    #: Keys that a choice sets by itself (the path of ``model=fit.yaml``)
    fixed_keys: frozenset[str]
    #: Places where another option than the usual one is chosen, with the keys of that option:
    #: whether others stay there depends on what is typed
    replaced: dict[str, set[str]]
    #: Override in Hydra's words, without its value, by the key as typed
    prepared: dict[str, str] = field(default_factory=dict)


class Recomposer:
    """Composes from one primary configuration again and again.

    Parameters
    ----------
    primary : str
        Name of the primary configuration, ``run`` for ``configs/run.yaml``.
    config_dirs : sequence of Path
        The user's folders.
    """

    def __init__(self, primary: str, config_dirs: Sequence[Path] = ()) -> None:
        self.primary, self.config_dirs = primary, tuple(config_dirs)
        self._declared: Primary = read_primary(primary, self.config_dirs)
        self._groups: Groups = read_groups(self.config_dirs)
        self._bases: OrderedDict[tuple[str, ...], _Base] = OrderedDict()
        make_importable(self.config_dirs)

    def compose(self, overrides: Sequence[str], job: int | None = None) -> Composition:
        """What ``compose([*overrides], primary)`` gives.

        Parameters
        ----------
        overrides : sequence of str
            As typed for one run.
        job : int or None
            Number of the run in a sweep.

        Raises
        ------
        ConfigurationError
            For the first key that is wrong.
        """
        request = Request(tuple(overrides), self.config_dirs, show=False, multirun=False)
        try:
            composition = self._composed(request)
        except (_Unusual, TrmsError):
            composition = compose_request(request, self.primary)
        return composition if job is None else _numbered(composition, job)

    def _composed(self, request: Request) -> Composition:
        choices: list[tuple[str, Override]] = []
        values: list[tuple[str, Override]] = []
        for text in request.overrides:
            override = parse(text, self._groups)
            (values if self._is_value(override) else choices).append((text, override))
        base = self._base(tuple(text for text, _ in choices))
        config = _copied(base.config)
        for _, override in values:
            self._set(config, override, base)
        resolved = _resolved(config, config, 0)
        for group, option in self._declared.defaults.items():
            if isinstance(option, list):
                resolved.setdefault(group, {})
        _check_keys(resolved, self._declared)
        chosen = _chosen(base.choices, self._declared, resolved)
        return Composition(resolved, request.overrides, chosen, self.config_dirs)

    def _is_value(self, override: Override) -> bool:
        return not (
            override.prefix == "~"
            or override.package
            or override.key in self._groups
            or override.key in self._declared.defaults
            or override.value is None
        )

    def _base(self, choices: tuple[str, ...]) -> _Base:
        base = self._bases.get(choices)
        if base is None:
            base = self._bases[choices] = self._made(choices)
            while len(self._bases) > _MOST_BASES:
                self._bases.popitem(last=False)
        self._bases.move_to_end(choices)
        return base

    def _made(self, choices: tuple[str, ...]) -> _Base:
        from hydra.errors import HydraException
        from omegaconf import OmegaConf, open_dict
        from omegaconf.errors import OmegaConfBaseException

        request = Request(choices, self.config_dirs, show=False, multirun=False)
        prepared = prepare(request, self._declared, self._groups)
        try:
            composed = _hydra_compose(self.primary, prepared, self.config_dirs)
            record = OmegaConf.to_container(composed.hydra.runtime.choices)
            assert isinstance(record, dict)
            with open_dict(composed):
                del composed["hydra"]
            drop_foreign_keys(composed, self._declared, record, choices, self.config_dirs)
            config = OmegaConf.to_container(composed, resolve=False)
        except (HydraException, OmegaConfBaseException) as error:
            raise _Unusual from error
        assert isinstance(config, dict)
        mine = (parse(text, self._groups) for text in prepared)
        return _Base(
            config={str(key): value for key, value in config.items()},
            choices=record,
            keys=DeclaredKeys(self._declared, self._groups, choices),
            fixed_keys=frozenset(override.key for override in mine if self._is_value(override)),
            replaced={
                place: own for place, own, _ in _replaced(self._declared, record, self.config_dirs)
            },
        )

    def _set(self, config: dict[str, Any], override: Override, base: _Base) -> None:
        """Put a value where Hydra would put it, of the type that Hydra would give it."""
        key = override.key
        if not _DOTTED.fullmatch(key) or key in base.fixed_keys or override.prefix == "+":
            raise _Unusual
        for place, own in base.replaced.items():
            inside = f"{key}.".removeprefix(f"{place}.").split(".")[0]
            if f"{key}.".startswith(f"{place}.") and inside not in own:
                raise _Unusual
        prefix = base.prepared.get(key)
        if prefix is None:
            prefix = base.prepared[key] = _value(override, base.keys, False).prefix
        *path, last = key.split(".")
        node: Any = config
        for name in path:
            node = node.get(name) if isinstance(node, dict) else None
        if not isinstance(node, dict):
            raise _Unusual
        if last in node:
            if isinstance(node[last], (dict, list)):
                raise _Unusual
        elif prefix != "++" or not path:
            raise _Unusual
        node[last] = _typed(_value(override, base.keys, False).value or "", last)


@functools.lru_cache(maxsize=4)
def recomposer(primary: str, config_dirs: tuple[Path, ...]) -> Recomposer:
    """The one of this process, which keeps what it has composed."""
    return Recomposer(primary, config_dirs)


def _numbered(composition: Composition, job: int) -> Composition:
    return Composition(
        composition.config,
        composition.overrides,
        composition.choices,
        composition.config_dirs,
        job,
    )


def _typed(text: str, name: str) -> Any:
    """A single value as Hydra's grammar types it."""
    if _INTEGER.fullmatch(text):
        return int(text)
    if _REAL.fullmatch(text):
        return float(text)
    if "$" in text or "?" in text:
        raise _Unusual
    value = _parsed(text, name)
    if isinstance(value, list):
        if not all(isinstance(item, (str, int, float, bool, type(None))) for item in value):
            raise _Unusual
        return list(value)
    return value


@functools.lru_cache(maxsize=1024)
def _parsed(text: str, name: str) -> Any:
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        override = OverridesParser.create().parse_override(f"{name}={text}")
        if override.is_sweep_override():
            raise _Unusual
        value = override.value()
    except HydraException as error:
        raise _Unusual from error
    if value is not None and not isinstance(value, (str, int, float, bool, list)):
        raise _Unusual
    return value


def _copied(node: Any) -> Any:
    if isinstance(node, dict):
        return {key: _copied(value) for key, value in node.items()}
    if isinstance(node, list):
        return [_copied(value) for value in node]
    return node


def _resolved(node: Any, root: dict[str, Any], depth: int) -> Any:
    """The node with every ``${a.b}`` replaced by what stands there, as a copy."""
    if isinstance(node, dict):
        return {key: _resolved(value, root, depth) for key, value in node.items()}
    if isinstance(node, list):
        return [_resolved(value, root, depth) for value in node]
    if not isinstance(node, str) or ("${" not in node and node != "???"):
        return node
    if depth >= _DEEPEST:
        raise _Unusual
    selected, reference = _SELECTED.fullmatch(node), _REFERENCE.fullmatch(node)
    if selected is not None:
        found = _at(selected[1], root)
        if found is _NOTHING and selected[2] == "{}":
            return {}
        if found is _NOTHING:
            found = _at(selected[2][2:-1], root)
    elif reference is not None:
        found = _at(reference[1], root)
    else:
        raise _Unusual  # a mandatory value that is missing, or another resolver
    if found is _NOTHING or found is None:
        raise _Unusual
    return _resolved(found, root, depth + 1)


_NOTHING = object()


def _at(key: str, root: dict[str, Any]) -> Any:
    """What stands at a key, unresolved."""
    found: Any = root
    for name in key.split("."):
        if isinstance(found, str) and "${" in found:
            raise _Unusual  # the key leads through a reference
        if not isinstance(found, dict) or name not in found:
            return _NOTHING
        found = found[name]
    return found
