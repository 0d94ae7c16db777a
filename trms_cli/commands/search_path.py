"""Lets Hydra look into the user's configuration folders before the built-in one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

from hydra.core.config_search_path import ConfigSearchPath, SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.version import VersionBase

HYDRA_VERSION_BASE = "1.3"  #: whose behaviour the configuration is written for


class UserFolders(SearchPathPlugin):
    """The folders of ``--config-dir``, in their order: an own option hides a built-in namesake."""

    folders: ClassVar[tuple[Path, ...]] = ()

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Put the folders before the program's own (Hydra's ``main``)."""
        for folder in self.folders:
            search_path.prepend(
                provider="--config-dir",
                path=f"file://{folder}",
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
    before = UserFolders.folders
    UserFolders.folders = tuple(folders)
    try:
        yield
    finally:
        UserFolders.folders = before
        GlobalHydra.instance().hydra = hydra
        version.version_base = base
