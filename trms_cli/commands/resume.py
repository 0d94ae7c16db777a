"""``resume=FOLDER``: a stopped search goes on, as its folder says it was asked for."""

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from trms_cli.commands.execution import execute
from trms_cli.composition.composer import Task
from trms_cli.core.data_file import read_json
from trms_cli.core.errors import ConfigurationError
from trms_cli.library.tasks.files import REQUEST_NAME
from trms_cli.runs.run_folder import hold, in_use

_KEY = "resume="


@dataclass(frozen=True)
class Resumption:
    """How one command goes on."""

    noun: str  #: What it leaves: ``fit``, ``diagnosis``
    verb: str  #: What one does instead: ``fit``, ``diagnose``
    command: str  #: ``identify``, which composes from the configuration of that name
    may_change: tuple[str, ...]  #: Beginnings of overrides that leave it the same search
    only: str  #: The same in words
    #: ``(folder, text)``: raises where there is nothing to go on from; ``text`` is the folder as it
    #: was typed
    check: Callable[[Path, str], None]

    def main(self, argv: Sequence[str], perform: Callable[..., Any]) -> int:
        """Begin anew, or go on in the folder that `argv` names."""
        folder, rest = self.take_folder(argv)
        if folder is None:
            return execute(rest, self.command, perform)
        return self.go_on(folder, rest, perform)

    def take_folder(self, argv: Sequence[str]) -> tuple[Path | None, list[str]]:
        """Take ``resume=FOLDER`` off `argv`.

        Raises ConfigurationError if that folder holds nothing to go on from.
        """
        resume_words = [word for word in argv if word.startswith(_KEY)]
        rest = [word for word in argv if not word.startswith(_KEY)]
        if not resume_words:
            return None, rest
        text = resume_words[-1].removeprefix(_KEY).strip("'\"")
        folder = Path(text).expanduser()
        if not text or not folder.is_dir():
            raise ConfigurationError(
                f"there is no folder {text!r}",
                where="resume",
                remedy=f"resume=FOLDER of a {self.noun}",
            )
        if not (folder / REQUEST_NAME).is_file():
            raise ConfigurationError(
                f"{text!r} is not the folder of a {self.noun}: it has no {REQUEST_NAME}",
                where="resume",
                remedy=f"name the folder that `trms {self.command}` wrote into",
            )
        self.check(folder, text)
        return folder, rest

    def go_on(self, folder: Path, argv: Sequence[str], perform: Callable[..., Any]) -> int:
        """Do as the folder's request says, with the overrides of `argv` on top, into that folder.

        Raises ConfigurationError from another working folder, and for overrides that would make it
        another search.
        """
        request = self._request(folder / REQUEST_NAME)
        if request["working_folder"] != str(Path.cwd()):
            raise ConfigurationError(
                f"the {self.noun} was begun in {request['working_folder']}, from where its files "
                "are named",
                where="resume",
                remedy=f"cd {shlex.quote(request['working_folder'])}, and again",
            )
        for word in argv:
            if not word.lstrip("+").startswith(self.may_change):
                raise ConfigurationError(
                    f"{word} given",
                    where="resume",
                    remedy=f"a {self.noun} goes on as it was asked for, in its own folder; only "
                    f"{self.only} may change: for all else {self.verb} anew",
                )
        if not hold(folder):
            raise in_use(folder)
        places = [f"--config-dir={place}" for place in request["config_dirs"]]
        task: Task = partial(perform, folder=folder)
        words = [*places, *request["overrides"], *argv]
        return execute(words, self.command, task, recorded=True)

    def _request(self, file: Path) -> dict[str, Any]:
        try:
            content = read_json(file)
            words = {key: [str(v) for v in content[key]] for key in ("overrides", "config_dirs")}
            if any(word.startswith("-") for word in words["overrides"]):
                raise ValueError("an option among what was typed")
            return words | {"working_folder": str(content["working_folder"])}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ConfigurationError(
                f"cannot be read: {error}",
                where=str(file),
                remedy=f"{self.verb} anew into another folder",
            ) from None
