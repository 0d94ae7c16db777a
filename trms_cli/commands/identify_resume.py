"""``trms identify resume=FOLDER``: a search goes on where it was stopped."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from trms_cli.commands.composition import Task, execute
from trms_cli.commands.identify_files import REQUEST_NAME
from trms_cli.commands.identify_progress import STATE_NAME
from trms_cli.core.errors import ConfigurationError

_KEY = "resume="
#: What may differ when a fit goes on: anything else would put another fit in its place.
_MAY_CHANGE = ("method.", "jobs=", "picture=", "--cfg", "job")


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
            f"there is no folder {text!r}", where="resume", remedy="resume=FOLDER of a fit"
        )
    if not (folder / REQUEST_NAME).is_file():
        raise ConfigurationError(
            f"{text!r} is not the folder of a fit: it has no {REQUEST_NAME}",
            where="resume",
            remedy="name the folder that `trms identify` wrote into",
        )
    if not (folder / STATE_NAME).is_file():
        raise ConfigurationError(
            f"{text!r} holds no state to go on from (no {STATE_NAME}): this fit was over before "
            "one was kept, or its method keeps none",
            where="resume",
            remedy="fit anew: such methods take seconds; or begin with model="
            f"{folder / 'model.yaml'}",
        )
    return folder, rest


def resumed(folder: Path, argv: Sequence[str], primary: str, perform: Callable[..., Any]) -> int:
    """Fit as the folder's request says, with the overrides of `argv` on top, into that folder."""
    request = _request(folder / REQUEST_NAME)
    if request["working_folder"] != str(Path.cwd()):
        raise ConfigurationError(
            f"the fit was begun in {request['working_folder']}, from where its files are named",
            where="resume",
            remedy=f"cd {shlex.quote(request['working_folder'])}, and again",
        )
    for word in argv:
        if not word.lstrip("+").startswith(_MAY_CHANGE):
            raise ConfigurationError(
                f"{word} given",
                where="resume",
                remedy="a search goes on with its own recordings, model and method, in its own "
                "folder; only its budget (method.…), jobs and picture may change: for all else "
                "fit anew",
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
            f"cannot be read: {error}", where=str(file), remedy="fit anew into another folder"
        ) from None
