"""Composes by Hydra: the user's folders first, and nothing from outside of the configuration.

``${sim.duration}`` and ``${oc.select:KEY,DEFAULT}`` are taken in a configuration. Other references
reach out of the experiment: ``${oc.env:NAME}`` would write a secret of the environment into every
log. References also multiply: thirty lines that each name the line above twice stand for a text of
a gigabyte. So what they stand for is measured before anything is resolved.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import hydra
import yaml
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.config_search_path import ConfigSearchPath, SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.version import VersionBase
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict

from trms_cli.composition.catalogue import config_folder, yaml_error
from trms_cli.core.data_file import read_bytes
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.yaml_data import MOST_BYTES, check_yaml

HYDRA_VERSION_BASE = "1.3"  #: whose behaviour the configuration is written for

_KEY = r"\.*[\w@]+(?:\.[\w@]+|\[\w+\])*"
_PLAIN = re.compile(rf"\$\{{\s*({_KEY})\s*\}}")
_SELECT = re.compile(
    rf"\$\{{\s*oc\.select\s*:\s*({_KEY})\s*"
    rf"(?:,\s*(?:\$\{{\s*({_KEY})\s*\}}|\{{\}}|\[\]|[^${{}}\[\],]*))?\s*\}}"
)
#: Letters and values that a configuration may stand for; those of an experiment are some 5000.
_MOST = 20_000_000
#: References that lead to references.
_DEEPEST = 30


class UserFolder(FileConfigSource):
    """A folder of ``--config-dir``: its YAML is anybody's, and none of it steers Hydra."""

    @staticmethod
    def scheme() -> str:
        """How its path begins."""
        return "config-dir"

    def load_config(self, config_path: str) -> ConfigResult:
        """Read an option, once it is known to be plain and not too large.

        Raises ConfigurationError for a document that is no YAML, or larger or deeper than is read;
        for keys of Hydra's own, a path out of the folder, and a choice that is made by something
        outside of the configuration.
        """
        name = self._normalize_file_name(config_path)
        where = str(Path(self.path, name))
        if ".." in Path(name).parts:
            raise ConfigurationError(
                f"{config_path!r} leads out of the folder",
                where=self.path,
                remedy="an option lies in the folder of its group",
            )
        if Path(name).parts[0] == "hydra":
            raise _steers_hydra(where)
        try:
            check_yaml(read_bytes(Path(where), MOST_BYTES))
        except yaml.YAMLError as error:
            raise yaml_error(error, Path(where)) from None
        try:
            found = super().load_config(config_path)
        except ValueError as error:  # a header that is none, a value that is no plain data
            raise ConfigurationError(
                f"it cannot be read ({str(error).splitlines()[0][:200]})",
                where=where,
                remedy="a header is a line of its own: # @package _global_",
            ) from error
        package = str(found.header.get("package") or "")
        if package.split(".")[0] == "hydra" or "hydra" in found.config:
            raise _steers_hydra(where)
        defaults = found.config._get_node("defaults") if "defaults" in found.config else None
        if defaults is not None and not isinstance(defaults, ListConfig):
            raise ConfigurationError(
                "defaults is no list",
                where=where,
                remedy="write each choice on a line of its own: - override /ref: sine",
            )
        refuse_outward(str(defaults), f"{where}, defaults")
        return found


def _steers_hydra(where: str) -> ConfigurationError:
    return ConfigurationError(
        "keys of Hydra's own are not taken from a file",
        where=where,
        remedy="remove what begins with hydra; a sweep has sampler=… and launcher=…",
    )


class UserFolders(SearchPathPlugin):
    """The folders of ``--config-dir``, in their order: an own option hides a built-in namesake."""

    folders: ClassVar[tuple[Path, ...]] = ()

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Put the folders before the program's own (Hydra's ``main``)."""
        for folder in self.folders:
            search_path.prepend(
                provider="--config-dir",
                path=f"{UserFolder.scheme()}://{folder}",
                anchor=SearchPathQuery(provider="main"),
            )


@contextmanager
def user_folders(folders: Sequence[Path]) -> Iterator[None]:
    """Hydra is started inside; it is left as it was found, also where a notebook has started it."""
    state, version = GlobalHydra.instance(), VersionBase.instance()
    hydra, base = state.hydra, version.getbase()
    state.clear()
    if UserFolders not in Plugins.instance().discover(SearchPathPlugin):
        Plugins.instance().register(UserFolders)
        Plugins.instance().register(UserFolder)
    before = UserFolders.folders
    UserFolders.folders = tuple(folders)
    try:
        yield
    finally:
        UserFolders.folders = before
        GlobalHydra.instance().hydra = hydra
        version.version_base = base


def compose_by_hydra(
    primary: str, overrides: Sequence[str], config_dirs: Sequence[Path]
) -> tuple[DictConfig, dict[Any, Any]]:
    """Compose by Hydra: the ``DictConfig``, unresolved, and the option chosen in each group.

    What the configuration refers to has been looked at; Hydra's own groups are among the choices.
    """
    with user_folders(config_dirs):
        hydra.initialize_config_dir(
            str(config_folder()), job_name=primary, version_base=HYDRA_VERSION_BASE
        )
        try:
            composed = hydra.compose(primary, overrides=list(overrides), return_hydra_config=True)
        except (TypeError, AttributeError, KeyError, IndexError, AssertionError) as error:
            # Hydra's own surprise at a YAML of an unexpected form
            raise ConfigurationError(
                f"the configuration cannot be composed ({type(error).__name__}: {error})",
                where="the configuration",
                remedy="`trms list` shows what options look like",
            ) from error
    choices = OmegaConf.to_container(composed.hydra.runtime.choices)
    assert isinstance(choices, dict)
    with open_dict(composed):
        del composed["hydra"]
    content = OmegaConf.to_container(composed)
    assert isinstance(content, dict)
    check_interpolations({str(key): value for key, value in content.items()})
    return composed, choices


def check_interpolations(config: Mapping[str, Any]) -> None:
    """Refuse references out of the configuration, in a circle, or to more than there is room for.

    ``config``: plain and unresolved. Raises ConfigurationError: it names the key.
    """
    measure = _Measure(config)
    for key, text in _references(config, ()):
        measure.text(text, key, 0)
    measure.node(config, (), 0)


def refuse_outward(text: str, where: str) -> None:
    """Refuse a text with a reference that is no key of the configuration.

    Raises ConfigurationError with what may stand there.
    """
    rest = _PLAIN.sub("", _SELECT.sub("", text))
    if "${" in rest:
        raise ConfigurationError(
            f"{text[:200]!r} refers to something outside of the configuration",
            where=where,
            remedy="write ${KEY} for another key, or ${oc.select:KEY,DEFAULT}; what stands in the "
            "environment is given on the command line: KEY=$NAME",
        )


class _Measure:
    """How much each key stands for, counted once."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        self._config = config
        self._known: dict[tuple[str, ...], int] = {}

    def node(self, node: Any, key: tuple[str, ...], depth: int) -> int:
        if key in self._known:
            return self._known[key]
        if isinstance(node, str):
            size = self.text(node, key, depth) if "${" in node else 1 + len(node)
        elif isinstance(node, Mapping):
            inside = (self.node(item, (*key, str(k)), depth) for k, item in node.items())
            size = 1 + sum(inside)
        elif isinstance(node, (list, tuple)):
            size = 1 + sum(self.node(item, (*key, str(i)), depth) for i, item in enumerate(node))
        else:
            size = 1
        if size > _MOST:
            raise ConfigurationError(
                "its references stand for more than there is room for",
                where=".".join(key) or "the configuration",
                remedy="refer to each key once",
            )
        self._known[key] = size
        return size

    def text(self, text: str, key: tuple[str, ...], depth: int) -> int:
        where = ".".join(key)
        refuse_outward(text, where)
        if depth > _DEEPEST:
            raise ConfigurationError(
                f"{text[:200]!r} leads in a circle, or through more than {_DEEPEST} references",
                where=where,
                remedy="give the value where it is used",
            )
        size = len(text)
        for match in (*_SELECT.finditer(text), *_PLAIN.finditer(text)):
            for name in filter(None, match.groups()):
                target = _absolute(name, key)
                size += self.node(_at(self._config, target), target, depth + 1)
        return size


def _references(node: Any, key: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], str]]:
    if isinstance(node, str):
        if "${" in node:
            yield key, node
    elif isinstance(node, Mapping):
        for name, item in node.items():
            yield from _references(item, (*key, str(name)))
    elif isinstance(node, (list, tuple)):
        for index, item in enumerate(node):
            yield from _references(item, (*key, str(index)))


def _absolute(name: str, key: tuple[str, ...]) -> tuple[str, ...]:
    """The key that a reference names; a leading dot is the mapping that it stands in."""
    path = name.lstrip(".")
    parts = tuple(part for part in re.split(r"[.\[\]]+", path) if part)
    dots = len(name) - len(path)
    return (*key[: max(0, len(key) - dots)], *parts) if dots else parts


def _at(config: Any, key: tuple[str, ...]) -> Any:
    for part in key:
        if isinstance(config, Mapping):
            config = config.get(part)
        elif isinstance(config, (list, tuple)) and part.isdigit() and int(part) < len(config):
            config = config[int(part)]
        else:
            return None
    return config
