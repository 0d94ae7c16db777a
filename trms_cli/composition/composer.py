"""Composes an experiment: overrides and YAML groups → one plain, resolved, checked mapping.

Hydra's compose API is used: no folder is made, no logging set up, no directory changed.

Hydra takes a fifth of a second for a composition, which is most of a short run of a sweep. So a
`Composer` keeps what a choice of options (`controller=pid`) composes to, and puts values
(`plant.parameters.k_g=0.19`) into a copy of the unresolved configuration, so that what refers to
them follows: 2 ms a run, where `OmegaConf.merge` and resolving take 70. The result equals a
composition from the start, which a test holds for many overrides; what is not plainly a value set
at a key that is there (or in an open mapping) is composed from the start.
"""

import functools
import re
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from trms_cli.composition import catalogue, checks
from trms_cli.composition.overrides import PATH_KEYS, ComposeRequest, Override, parse, read_request
from trms_cli.composition.plain_values import value_at
from trms_cli.core.data_file import RECORDINGS
from trms_cli.core.deprecation import present_override
from trms_cli.core.errors import EXIT_OK, ConfigurationError, TrmsError
from trms_cli.core.wording import choice_labels
from trms_cli.runs.run_folder import new_folder

#: Choices of options that are kept.
_MOST_BASES = 64
_REFERENCE = re.compile(r"\$\{(\w+(?:\.\w+)*)\}")
#: ``${oc.select:KEY,DEFAULT}``: what stands at a key, or the default where nothing does.
_SELECTED = re.compile(r"\$\{oc\.select:(\w+(?:\.\w+)*),(\$\{\w+(?:\.\w+)*\}|\{\})\}")
_INTEGER = re.compile(r"-?(?:0|[1-9]\d*)")
_REAL = re.compile(r"-?(?:0|[1-9]\d*)\.\d+(?:[eE][-+]?\d+)?")
_DEEPEST = 20  # references that lead to references
_DOTTED = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*")


@dataclass(frozen=True)
class Composition:
    """A composed experiment."""

    #: Plain data, interpolations resolved, every mandatory value given. Top-level keys and the keys
    #: of mappings that are no plugin are checked; a plugin's own are checked when built.
    config: dict[str, Any]
    overrides: tuple[str, ...]  #: What was typed; for a job of a sweep, the job's own
    choices: dict[str, Any]  #: The option chosen in each group (a list where several can be)
    config_dirs: tuple[Path, ...] = ()  #: The user's folders, already importable
    job: int | None = None  #: The number of the job in a sweep; None for a single run

    def folder(self, what: str) -> Path:
        """The folder to write into: a job's own in a sweep, else a new one (``out``, or dated)."""
        if self.job is not None:
            return Path(self.config["out"])
        return new_folder(self.config["out"], what)

    @property
    def choice_labels(self) -> dict[str, str]:
        """The option of each group as it is called; a model of a file by its file or fit."""
        return choice_labels(self.choices, self.config)

    @cached_property
    def yaml(self) -> str:
        """The resolved configuration as a YAML document."""
        import yaml

        # The same text, by C code where PyYAML was built with it: five times as fast.
        dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
        options = {"sort_keys": False, "allow_unicode": True, "width": 100}
        return str(yaml.dump(self.config, Dumper=dumper, **options))


@dataclass(frozen=True)
class Outcome:
    """What a task may return instead of a bare `exit_code`: also a figure to minimise."""

    exit_code: int = EXIT_OK
    objective: float | None = None  #: smaller is better; None where a sweeper does not search
    folder: Path | None = None  #: what it wrote into


Task = Callable[[Composition], "int | Outcome"]


def compose(
    overrides: Sequence[str] | Mapping[str, Any] = (),
    primary: str = "run",
    *,
    config_dirs: Sequence[Path] = (),
) -> Composition:
    """Compose one experiment from a primary configuration (``run`` for ``configs/run.yaml``).

    `overrides` is what would be typed (``["controller=pid", "sim.duration=20"]``; ``-m`` and
    ``--cfg`` are a command's and refused here), or the same as a mapping: ``{"controller": "pid",
    "sim": {"duration": 20}, "effect": ["main_input_delay"]}``. In a mapping objects may stand for
    plugins; they are built inside of :func:`trms_cli.composition.given_object.place_objects`.
    `config_dirs` are the user's folders of options, absolute; those of ``--config-dir`` in
    `overrides` come first.

    Raises ConfigurationError for the first key that is wrong.
    """
    if isinstance(overrides, Mapping):
        from trms_cli.composition.arguments import arguments_of
        from trms_cli.composition.given_object import with_objects

        arguments = arguments_of(primary, (), overrides, config_dir=config_dirs)
        return with_objects(compose(arguments.argv, primary), arguments.objects)
    request = read_request(overrides, primary)
    if request.multirun or request.show:
        raise ConfigurationError(
            "one configuration is composed here",
            where="the command line",
            remedy="leave out -m and --cfg",
        )
    return compose_request(
        request._replace(config_dirs=(*request.config_dirs, *config_dirs)), primary
    )


def compose_request(request: ComposeRequest, primary: str) -> Composition:
    """Compose what a command line asks for.

    From the start where options of the user's own or files are chosen: they may have changed since
    this process has read them, as in a notebook.
    """
    if not request.config_dirs:
        composer = composer_of(primary, ())
        if composer.chooses_options_alone(request.overrides):
            return composer.compose_as_typed(request)
    return Composer(primary, request.config_dirs).from_start(request)


class _Unusual(Exception):
    """Only a composition from the start knows what this means."""


@dataclass
class _Base:
    """What a choice of options composes to, without the values that are typed."""

    config: dict[str, Any]  #: Unresolved, plain
    choices: Mapping[Any, Any]  #: Hydra's record of them
    keys: checks.DeclaredKeys  #: Tells which mappings are open
    #: Keys that a choice sets by itself (the path of ``model=fit.yaml``)
    fixed_keys: frozenset[str]
    #: Places where another option than the usual one is chosen, with the keys of that option:
    #: whether others stay there depends on what is typed
    replaced: dict[str, set[str]]
    #: Override in Hydra's words, without its value, by the key as typed
    prepared: dict[str, str] = field(default_factory=dict)


class Composer:
    """Composes from one primary configuration, and the user's folders, again and again."""

    def __init__(self, primary: str, config_dirs: Sequence[Path] = ()) -> None:
        self.primary, self.config_dirs = primary, tuple(config_dirs)
        self._declared = catalogue.read_primary(primary, self.config_dirs)
        self._groups = catalogue.read_groups(self.config_dirs)
        self._bases: OrderedDict[tuple[str, ...], _Base] = OrderedDict()

    def compose(self, overrides: Sequence[str], job: int | None = None) -> Composition:
        """What ``compose([*overrides], primary)`` gives, for the run of number `job` of a sweep.

        Raises ConfigurationError for the first key that is wrong.
        """
        words = tuple(map(present_override, overrides))  # a sweep of an earlier version goes on
        request = ComposeRequest(words, self.config_dirs, show=False, multirun=False)
        composition = self.compose_as_typed(request)
        return composition if job is None else replace(composition, job=job)

    def compose_as_typed(self, request: ComposeRequest) -> Composition:
        """Compose with what is kept of the same choices, where that gives what Hydra would.

        Raises ConfigurationError for the first key that is wrong.
        """
        try:
            return self._varied(request)
        except (_Unusual, TrmsError):  # Hydra's way tells what is wrong, in its order
            return self.from_start(request)

    def chooses_options_alone(self, overrides: Sequence[str]) -> bool:
        """Whether every choice names options that there are, and none a file or a folder."""
        choices = (parse(text, self._groups) for text in overrides)
        return all(self._is_value(choice) or self._names_options(choice) for choice in choices)

    def _names_options(self, choice: Override) -> bool:
        names = checks.plain_names((choice.value or "").replace("[", "").replace("]", ""))
        options = self._groups.get(choice.key, {}).keys() - {"from_file"}
        return names is not None and options >= set(names)

    def from_start(self, request: ComposeRequest) -> Composition:
        """Compose by Hydra alone."""
        overrides = checks.prepare(request, self._declared, self._groups)

        from omegaconf import OmegaConf

        from trms_cli.composition.hydra_composition import compose_by_hydra, explain_errors

        def keys(fewer: Sequence[str]) -> Mapping[str, Any]:
            composed, _ = compose_by_hydra(self.primary, fewer, self.config_dirs)
            content = OmegaConf.to_container(composed)
            assert isinstance(content, dict)
            return content  # type: ignore[return-value]

        with explain_errors(overrides, self._declared, self._groups, keys):
            composed, choices = self._by_hydra(overrides, request.overrides)
            missing = sorted(OmegaConf.missing_keys(composed))
            if missing:
                raise _missing(missing)
            config = OmegaConf.to_container(composed, resolve=True)
            assert isinstance(config, dict)
            return self._checked({str(k): v for k, v in config.items()}, choices, request)

    def before_values(
        self, choices: Sequence[str]
    ) -> tuple[Mapping[str, Any], Mapping[str, Any]] | None:
        """What choices of options compose to before a value is typed, and the option in each group.

        The configuration is unresolved and to be read only. None where the choices do not go
        together. Raises ConfigurationError for an option that does not exist.
        """
        try:
            base = self._base(tuple(choices))
        except _Unusual:
            return None
        several = [group for group, o in self._declared.defaults.items() if isinstance(o, list)]
        named = {group: list(base.config.get(group) or {}) for group in several}
        return base.config, {str(key): name for key, name in base.choices.items()} | named

    def _by_hydra(
        self, prepared: Sequence[str], typed: Sequence[str]
    ) -> tuple[Any, dict[Any, Any]]:
        """The unresolved ``DictConfig`` without what is foreign to it, and Hydra's choices."""
        from trms_cli.composition.hydra_composition import compose_by_hydra

        catalogue.make_importable(self.config_dirs)
        composed, choices = compose_by_hydra(self.primary, prepared, self.config_dirs)
        _drop_foreign_keys(composed, self._declared, choices, typed, self.config_dirs)
        return composed, choices

    def _checked(
        self, config: dict[str, Any], choices: Mapping[Any, Any], request: ComposeRequest
    ) -> Composition:
        """A resolved configuration without a key that is not declared, and its choices by name."""
        several = [group for group, o in self._declared.defaults.items() if isinstance(o, list)]
        for group in several:
            config.setdefault(group, {})
        checks.check_composed(config, self._declared)
        ours = {str(k): name for k, name in choices.items() if not str(k).startswith("hydra/")}
        option_names = ours | {group: list(config[group]) for group in several}
        return Composition(config, request.overrides, option_names, self.config_dirs)

    def _varied(self, request: ComposeRequest) -> Composition:
        """Values put into what the choices among the overrides compose to."""
        choices: list[str] = []
        values: list[Override] = []
        for text in request.overrides:
            override = parse(text, self._groups)
            if self._is_value(override):
                values.append(override)
            else:
                choices.append(text)
        base = self._base(tuple(choices))
        config = _copied(base.config)
        for override in values:
            self._set(config, override, base)
        return self._checked(_resolved(config, config, 0), base.choices, request)

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
            base = self._bases[choices] = self._make_base(choices)
            while len(self._bases) > _MOST_BASES:
                self._bases.popitem(last=False)
        self._bases.move_to_end(choices)
        return base

    def _make_base(self, choices: tuple[str, ...]) -> _Base:
        from hydra.errors import HydraException
        from omegaconf import OmegaConf
        from omegaconf.errors import OmegaConfBaseException

        request = ComposeRequest(choices, self.config_dirs, show=False, multirun=False)
        prepared = checks.prepare(request, self._declared, self._groups)
        try:
            composed, record = self._by_hydra(prepared, choices)
            config = OmegaConf.to_container(composed, resolve=False)
        except (HydraException, OmegaConfBaseException) as error:
            raise _Unusual from error
        assert isinstance(config, dict)
        mine = (parse(text, self._groups) for text in prepared)
        return _Base(
            config={str(key): value for key, value in config.items()},
            choices=record,
            keys=checks.DeclaredKeys(self._declared, self._groups, choices),
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
            prefix = base.prepared[key] = checks.prepared_value(override, base.keys, False).prefix
        path, _, last = key.rpartition(".")
        node = value_at(config, path)
        if not isinstance(node, dict):
            raise _Unusual
        if last in node:
            if isinstance(node[last], (dict, list)):
                raise _Unusual
        elif prefix != "++" or not path:
            raise _Unusual
        node[last] = _typed(checks.prepared_value(override, base.keys, False).value or "", last)


def _missing(keys: Sequence[str]) -> ConfigurationError:
    """Keys that have to be given, each with an example: of a recording one that lies here."""
    here = (p.name for p in sorted(Path().iterdir()) if p.suffix in RECORDINGS)
    file = next(here, "rig.csv")
    return ConfigurationError(
        f"{', '.join(keys)} must be given",
        where=keys[0],
        remedy="add "
        + " ".join(f"{key}={file if key.split('.')[-1] in PATH_KEYS else '…'}" for key in keys),
    )


@functools.lru_cache(maxsize=32)
def composer_of(primary: str, config_dirs: tuple[Path, ...]) -> Composer:
    """The one of this process, which keeps what it has composed."""
    return Composer(primary, config_dirs)


def _typed(text: str, name: str) -> Any:
    """A single value as Hydra's grammar types it."""
    if _INTEGER.fullmatch(text):
        return int(text)
    if _REAL.fullmatch(text):
        return float(text)
    if "$" in text or "?" in text:
        raise _Unusual
    value = _parse_value(text, name)
    if isinstance(value, list):
        if not all(isinstance(item, (str, int, float, bool, type(None))) for item in value):
            raise _Unusual
        return list(value)
    return value


@functools.lru_cache(maxsize=1024)
def _parse_value(text: str, name: str) -> Any:
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
        target = _at(selected[1], root)
        if target is _NOTHING and selected[2] == "{}":
            return {}
        if target is _NOTHING:
            target = _at(selected[2][2:-1], root)
    elif reference is not None:
        target = _at(reference[1], root)
    else:
        raise _Unusual  # a mandatory value that is missing, or another resolver
    if target is _NOTHING or target is None:
        raise _Unusual
    return _resolved(target, root, depth + 1)


_NOTHING = object()


def _at(key: str, root: dict[str, Any]) -> Any:
    """What stands at a key, unresolved."""
    node: Any = root
    for name in key.split("."):
        if isinstance(node, str) and "${" in node:
            raise _Unusual  # the key leads through a reference
        if not isinstance(node, dict) or name not in node:
            return _NOTHING
        node = node[name]
    return node


def _drop_foreign_keys(
    composed: Any,
    declared: catalogue.Primary,
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
    declared: catalogue.Primary, choices: Mapping[Any, Any], config_dirs: Sequence[Path]
) -> Iterator[tuple[str, set[str], Mapping[str, Any] | str]]:
    """Places with a choice that is not the including option's own.

    With the keys of that choice, and what the including option sets there: a mapping, or the text
    of an interpolation.
    """
    for group in declared.defaults:
        content = _content(group, choices.get(group), config_dirs)
        for inner, place, default in checks.defaults_list(content):
            option = choices.get(f"{inner}@{group}.{place}")
            if option in (None, default):
                continue
            body = value_at(content, place)
            own = _content(inner, option, config_dirs)
            keys = {*own, *(key.split(".")[0] for _, key, _ in checks.defaults_list(own))}
            if isinstance(body, Mapping) or (isinstance(body, str) and "${" in body):
                yield f"{group}.{place}", keys, body


def _content(group: str, option: Any, config_dirs: Sequence[Path]) -> dict[str, Any]:
    """An option's YAML, with the options of its group that it builds on (``plant=ideal``)."""
    for root in catalogue.roots(config_dirs) if isinstance(option, str) else ():
        file = root / group / f"{option}.yaml"
        content = catalogue.read_yaml(file) if file.is_file() else None
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
