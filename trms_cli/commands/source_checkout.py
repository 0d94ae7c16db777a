"""Commands whose work lies beside the package, in its source checkout: ``blind`` and ``course``.

What they need (rigs of other code, their truths) is no part of an installation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest

if TYPE_CHECKING:
    from trms_cli.composition.composer import Task


@dataclass(frozen=True, kw_only=True)
class CheckoutCommand:
    """A command with words of its own, each done by a module of the checkout."""

    name: str  #: As it is typed
    what: str  #: What it is about, for whoever has no checkout
    package: str  #: Of the modules; each has a function ``perform``
    words: tuple[str, ...]  #: What may follow the command, each the name of a module
    #: Keys whose values are paths, or hold some: quoted, so that an ``=`` in them is read as no key
    paths: tuple[str, ...]
    otherwise: str = ""  #: What else to type in a checkout, at the end of the remedy

    def main(self, argv: Sequence[str]) -> int:
        """Do what the first word asks for; returns the exit code.

        Raises ConfigurationError where there is no such word, or no checkout.
        """
        from trms_cli.commands.execution import execute

        word, *rest = argv or ["nothing"]
        if word not in self.words:
            raise ConfigurationError(
                f"{word!r} given" if argv else "nothing given",
                where=f"trms {self.name}",
                remedy=f"{nearest(word, self.words)}; more by trms {self.name} --help",
            )
        arguments = [self._quoted(text) for text in rest]
        return execute(arguments, f"{self.name}_{word}", self._task(word))

    def _task(self, word: str) -> Task:
        try:
            task: Task = import_module(f"{self.package}.{word}").perform
        except ModuleNotFoundError as error:
            if not (error.name or "").startswith("experiments"):
                raise
            raise ConfigurationError(
                f"{self.what} is part of the source checkout, which is not installed here",
                where=f"trms {self.name} {word}",
                remedy="in a clone of the repository: make setup, then "
                f".venv/bin/trms {self.name} {word} …{self.otherwise}",
            ) from error
        return task

    def _quoted(self, word: str) -> str:
        """A path, or a list of NAME=FOLDER, in Hydra's words."""
        from trms_cli.composition.overrides import quote_value

        key, equals, value = word.partition("=")
        if key not in self.paths or not equals or not value or value == "null":
            return word
        if value.startswith("[") and value.endswith("]"):
            items = [item.strip().strip("'\"") for item in value[1:-1].split(",")]
            return f"{key}=[{','.join(quote_value(item) for item in items if item)}]"
        return f"{key}={quote_value(value)}"
