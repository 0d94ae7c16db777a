"""``trms diagnose resume=FOLDER``: a diagnosis goes on where it was stopped."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from trms_cli.commands.composition import Task, execute
from trms_cli.commands.identify_files import REQUEST_NAME
from trms_cli.core.errors import ConfigurationError

_KEY = "resume="
#: What may differ when a diagnosis goes on: anything else would be another one.
_MAY_CHANGE = ("jobs=", "page=", "--cfg", "job")


def take_folder(argv: Sequence[str]) -> tuple[Path | None, list[str]]:
    """Take ``resume=FOLDER`` off `argv`.

    Raises
    ------
    ConfigurationError
        If that folder holds nothing to go on from.
    """
    given = [word for word in argv if word.startswith(_KEY)]
    rest = [word for word in argv if not word.startswith(_KEY)]
    if not given:
        return None, rest
    text = given[-1].removeprefix(_KEY).strip("'\"")
    folder = Path(text).expanduser()
    if not text or not folder.is_dir():
        raise ConfigurationError(
            f"there is no folder {text!r}", where="resume", remedy="resume=FOLDER of a diagnosis"
        )
    if not (folder / REQUEST_NAME).is_file():
        raise ConfigurationError(
            f"{text!r} is not the folder of a diagnosis: it has no {REQUEST_NAME}",
            where="resume",
            remedy="name the folder that `trms diagnose` wrote into",
        )
    if (folder / "diagnosis.json").is_file():
        raise ConfigurationError(
            f"the diagnosis in {text!r} is finished",
            where="resume",
            remedy=f"look at {folder / 'diagnosis.json'}, or diagnose anew into another folder",
        )
    return folder, rest


def resumed(folder: Path, argv: Sequence[str], primary: str, perform: Callable[..., Any]) -> int:
    """Diagnose as the folder's request says, with the overrides of `argv` on top, into it."""
    request = _request(folder / REQUEST_NAME)
    if request["working_folder"] != str(Path.cwd()):
        raise ConfigurationError(
            f"the diagnosis was begun in {request['working_folder']}, from where its files are "
            "named",
            where="resume",
            remedy=f"cd {shlex.quote(request['working_folder'])}, and again",
        )
    for word in argv:
        if not word.lstrip("+").startswith(_MAY_CHANGE):
            raise ConfigurationError(
                f"{word} given",
                where="resume",
                remedy="a diagnosis goes on with its own recordings, model and suspects, in its "
                "own folder; only jobs and page may change: for all else diagnose anew",
            )
    places = [word for place in request["config_dirs"] for word in ("--config-dir", place)]
    task: Task = partial(perform, folder=folder)
    return execute([*places, *request["overrides"], *argv], primary, task)


def _request(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        words = {key: [str(v) for v in content[key]] for key in ("overrides", "config_dirs")}
        return words | {"working_folder": str(content["working_folder"])}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigurationError(
            f"cannot be read: {error}", where=str(file), remedy="diagnose anew into another folder"
        ) from None
