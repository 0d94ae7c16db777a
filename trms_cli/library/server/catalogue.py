"""Which runs a server of pages shows, by keys that stand in addresses in the place of paths.

A key is a digest of a log's path. It is looked up among the runs of the index that lie in the
folders that are served, so that no address can name any other file.
"""

from __future__ import annotations

import hashlib
import os
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from trms_cli.core.errors import RecordingError
from trms_cli.runs.follower import RunFollower
from trms_cli.runs.query import Inventory, Query, QueryResult, Tell, find, inventory, is_written

#: Columns of which a reader chooses a value.
CHOICES = ("controller", "ref", "model", "plant", "effects", "outcome")
_OFTEN = 1.0  # s between two looks into the folders, at least
_REST = 10.0  # times as long as such a look takes nobody looks again
_MOST_FOLLOWED = 8


def key_of(path: str) -> str:
    """The key of a log, or of a folder, by its absolute path."""
    return hashlib.sha256(os.fsencode(path)).hexdigest()[:20]


@dataclass(frozen=True)
class FolderOfRuns:
    """A folder with several runs: that of a sweep, mostly."""

    path: str
    count: int  #: Runs directly below it


class Catalogue:
    """The runs in folders, brought up to date as they are asked for.

    Parameters
    ----------
    folders : sequence of Path
        None named: the working folder.
    everywhere : bool
        Every run that this machine knows of, instead.
    """

    def __init__(self, folders: Sequence[Path], *, everywhere: bool = False) -> None:
        self.everywhere = everywhere
        self.folders: tuple[Path, ...] = () if everywhere else tuple(folders) or (Path(),)
        #: ``folders`` as the index takes them: a working folder that nobody named is looked
        #: through as far as `trms runs` does.
        self._roots = () if everywhere else tuple(folders)
        self._refreshing = threading.Lock()
        self._next_refresh = 0.0
        self._inventory: Inventory | None = None
        self._logs: dict[str, str] = {}
        self._followers: OrderedDict[str, RunFollower] = OrderedDict()
        self._following = threading.Lock()

    def find(self, question: Query, progress: Tell = lambda count, of: None) -> QueryResult:
        """Ask the index; what is in the folders is looked at first, but not too often.

        `progress` is called as that of :func:`~trms_cli.runs.query.find`.

        Raises FilterError or ConfigurationError for a question that cannot be asked.
        """
        question = replace(question, folders=self._roots, everywhere=self.everywhere)
        if time.monotonic() < self._next_refresh or not self._refreshing.acquire(blocking=False):
            return find(replace(question, refresh=False))
        try:
            begin = time.monotonic()
            result = find(question, progress)
            end = time.monotonic()
            self._next_refresh = end + max(_OFTEN, _REST * (end - begin))
            self._take(self._inventory_now())
            return result
        finally:
            self._refreshing.release()

    @property
    def inventory(self) -> Inventory:
        """All runs there are, as the index last had them."""
        if self._inventory is None:
            self._take(self._inventory_now())
        assert self._inventory is not None
        return self._inventory

    def _inventory_now(self) -> Inventory:
        return inventory(self.folders, CHOICES)

    def _take(self, runs: Inventory) -> None:
        if self._inventory is None or runs.logs != self._inventory.logs:
            self._logs = {key_of(log): log for log in runs.logs}
        self._inventory = runs

    def log(self, key: str) -> Path:
        """The log of a run, or its status where it left none.

        Raises RecordingError if no run has this key.
        """
        if key not in self._logs:
            self._take(self._inventory_now())
        log = self._logs.get(key)
        if log is None or not os.path.isfile(log):
            raise RecordingError(
                "there is no such run, or no more", remedy="choose one from the list of all runs"
            )
        return Path(log)

    @property
    def run_folders(self) -> list[FolderOfRuns]:
        """Folders with several runs, those with most of them first."""
        counts: dict[str, int] = {}
        for log in self.inventory.logs:
            place = os.path.dirname(os.path.dirname(log))
            counts[place] = counts.get(place, 0) + 1
        several = [FolderOfRuns(path, count) for path, count in counts.items() if count > 1]
        return sorted(several, key=lambda folder: (-folder.count, folder.path))

    def run_folder(self, key: str) -> Path:
        """The folder of several runs that has a key; raises RecordingError if there is none."""
        for folder in self.run_folders:
            if key_of(folder.path) == key:
                return Path(folder.path)
        raise RecordingError(
            "there is no such folder, or no more", remedy="choose one from the list of all runs"
        )

    def is_live(self, log: str) -> bool:
        """Whether a run is being written."""
        return log.endswith(".mcap") and is_written(log)

    def follower(self, log: Path) -> RunFollower:
        """Who follows a log as it grows, with all that is new; raises RecordingError."""
        with self._following:
            name = str(log)
            own = self._followers.pop(name, None) or RunFollower(log)
            self._followers[name] = own
            while len(self._followers) > _MOST_FOLLOWED:
                self._followers.popitem(last=False)[1].close()
            while own.look():
                pass
            return own

    def close(self) -> None:
        """Close the logs that were followed."""
        with self._following:
            while self._followers:
                self._followers.popitem()[1].close()
