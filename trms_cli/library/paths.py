"""Paths among the arguments of a call: of runs, of folders; anything else refused in words."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from os import PathLike
from pathlib import Path
from typing import Any

from trms_cli.core.errors import ConfigurationError


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
