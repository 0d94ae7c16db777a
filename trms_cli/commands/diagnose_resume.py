"""``trms diagnose resume=FOLDER``: a diagnosis goes on where it was stopped."""

from __future__ import annotations

from pathlib import Path

from trms_cli.commands.resume import Resumption
from trms_cli.core.errors import ConfigurationError


def _unfinished(folder: Path, text: str) -> None:
    if (folder / "diagnosis.json").is_file():
        raise ConfigurationError(
            f"the diagnosis in {text!r} is finished",
            where="resume",
            remedy=f"look at {folder / 'diagnosis.json'}, or diagnose anew into another folder",
        )


RESUMPTION = Resumption(
    noun="diagnosis",
    verb="diagnose",
    command="diagnose",
    may_change=("jobs=", "page=", "--cfg", "job"),
    only="jobs and page",
    check=_unfinished,
)
