"""Lets Hydra look into the user's configuration folders before the built-in one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

import yaml
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.config_search_path import ConfigSearchPath, SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.version import VersionBase
from omegaconf import ListConfig

from trms_cli.composition.catalogue import yaml_error
from trms_cli.composition.interpolations import refuse_outward
from trms_cli.core.data_file import read_bytes
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.yaml_data import MOST_BYTES, check_yaml

HYDRA_VERSION_BASE = "1.3"  #: whose behaviour the configuration is written for


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
