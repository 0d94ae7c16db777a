"""What makes each table and picture of the pages: ``sources.yaml``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from pathlib import Path

import msgspec

from experiments.study_file import read_as

SOURCES = Path(__file__).with_name("sources.yaml")


class Source(msgspec.Struct, forbid_unknown_fields=True):
    """A command and what of the pages it makes; ``sources.yaml`` explains the keys."""

    command: str
    tables: dict[str, list[str]]
    pictures: list[str]
    target: str = ""
    seconds: float = 0.0
    cheap: bool = False
    tolerance: float = 0.0
    digits: float = 1.0
    tolerances: dict[str, float] = {}
    times: list[str] = []
    timed: list[str] = []
    picture: float = 0.005
    copies: dict[str, str] = {}  #: Pictures that the command leaves elsewhere, and their places
    by_hand: str = ""

    def makes(self, key: str) -> bool:
        """Whether ``docs/page.md#table`` or a picture is its own."""
        page, _, table = key.partition("#")
        if table:
            return any(fnmatchcase(table, pattern) for pattern in self.tables.get(page, ()))
        return any(fnmatchcase(key, pattern) for pattern in self.pictures)

    def is_time(self, picture: str) -> bool:
        """Whether a picture shows times, which are another machine's elsewhere."""
        return any(fnmatchcase(picture, pattern) for pattern in self.timed)

    def tolerance_of(self, table: str) -> float:
        """Share of a number of a table by which it may move."""
        for pattern, share in self.tolerances.items():
            if fnmatchcase(table, pattern):
                return share
        return self.tolerance


def read_sources(file: Path = SOURCES) -> dict[str, Source]:
    """All sources by name.

    Raises ConfigurationError if the file is none.
    """
    return read_as(dict[str, Source], file, str(SOURCES))


def source_of(key: str, sources: Mapping[str, Source]) -> str | None:
    """The name of the source of a table or picture; None: nobody knows."""
    return next((name for name, source in sources.items() if source.makes(key)), None)


def made_by(name: str, sources: Mapping[str, Source], keys: Iterable[str]) -> list[str]:
    """Of tables and pictures those that a source makes."""
    return [key for key in keys if source_of(key, sources) == name]
