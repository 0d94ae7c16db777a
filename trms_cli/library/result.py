"""What every call gives back (a folder, its document, pandas frames), and takes as paths."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from trms_cli.core.errors import ConfigurationError, RecordingError, TrmsError

if TYPE_CHECKING:
    import pandas  # type: ignore[import-untyped,unused-ignore]

#: A path, or several.
Paths = str | PathLike[str] | Sequence[str | PathLike[str]]
#: A run: its log, its folder, or what :func:`trms_cli.run` gave back.
RunPath = str | PathLike[str]


def frame_of(
    columns: Mapping[Any, Any], units: Mapping[str, str], index: Any = None, name: str = ""
) -> pandas.DataFrame:
    """A pandas frame; the units of its columns go to ``frame.attrs["units"]``, `name` to its index.

    Raises TrmsError if pandas is not installed: it is no dependency of this package.
    """
    frames = load_pandas()
    frame = frames.DataFrame(dict(columns), index=index)
    if name:
        frame.index.name = name
    frame.attrs["units"] = dict(units)
    return frame


def load_pandas() -> Any:
    """The package pandas; raises TrmsError if it is not installed."""
    from importlib import import_module
    from importlib.util import find_spec

    if find_spec("pandas") is None:
        raise TrmsError(
            "a frame needs pandas, which is not installed",
            remedy="pip install 'trms-cli[notebook]', or pip install pandas",
        )
    return import_module("pandas")


@dataclass(frozen=True, repr=False, eq=False)
class Result:
    """What a command left."""

    folder: Path  #: What was written: figures, documents, pages
    text: str = field(default="", kw_only=True)  #: What the command prints

    #: The JSON twin in the folder, and the page with pictures.
    DOCUMENT: ClassVar[str] = ""
    PAGE: ClassVar[str] = ""
    #: File of the folder by the key that takes it: ``model``, ``real``.
    FILES: ClassVar[Mapping[str, str]] = {}

    @cached_property
    def document(self) -> dict[str, Any]:
        """All figures, as they stand in the folder as JSON (SI units; None for what is not)."""
        return read_document(self.folder / self.DOCUMENT)

    @property
    def report(self) -> Path | None:
        """The page with tables and pictures; None if none was asked for."""
        page = self.folder / self.PAGE
        return page if self.PAGE and page.is_file() else None

    @property
    def pictures(self) -> dict[str, Path]:
        """The pictures in the folder by their names."""
        return {file.stem: file for file in sorted(self.folder.glob("*.png"))}

    @cached_property
    def config(self) -> dict[str, Any]:
        """The resolved configuration, every key with its value."""
        from trms_cli.composition.catalogue import read_yaml

        file = self.folder / "config.yaml"
        if not file.is_file():
            raise RecordingError("this result keeps no configuration", where=str(self.folder))
        return dict(read_yaml(file))

    def file_for(self, key: str) -> Path:
        """The file that stands for this result where another call asks for a `key`.

        Raises ConfigurationError if it has none.
        """
        if key not in self.FILES:
            raise ConfigurationError(
                f"{self!r} given",
                where=key,
                remedy=f"it has {' and '.join(self.FILES)}" if self.FILES else "give a file",
            )
        file = self.folder / self.FILES[key]
        if not file.exists():
            raise ConfigurationError(f"{self!r} has no {file.name}", where=key)
        return file

    def __fspath__(self) -> str:
        return str(self.folder)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.headline}>"

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and other.folder == self.folder

    def __hash__(self) -> int:
        return hash((type(self), self.folder))

    @property
    def headline(self) -> str:
        """What it is, in one line."""
        return str(self.folder)


def read_document(file: Path) -> dict[str, Any]:
    """A JSON document of ours; raises RecordingError if it cannot be read."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RecordingError(f"cannot be read: {error}", where=str(file)) from None
    if not isinstance(content, dict):
        raise RecordingError("no document of this program", where=str(file))
    return content


def run_paths(runs: Iterable[Any]) -> Iterator[Path]:
    """Paths of runs, given one by one or in sequences.

    Raises ConfigurationError for what is neither a path nor a run.
    """
    for run in runs:
        if isinstance(run, str | PathLike):
            yield Path(run).expanduser()
        elif isinstance(run, Iterable):
            yield from run_paths(run)
        else:
            raise ConfigurationError(
                f"{run!r} given",
                where="the runs",
                remedy="give logs, folders of runs, or what run() gave back",
            )
