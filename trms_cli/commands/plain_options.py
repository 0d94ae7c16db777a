"""Options of the commands that read files: argparse, with our errors instead of its exit.

They are also taken as experiments have their keys: ``out=DIR`` for ``--out DIR``.
"""

import argparse
import difflib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from trms_cli.core.errors import ConfigurationError

#: What argparse says of a value that it cannot convert.
_NO_NUMBER = re.compile(r"argument (\S+): invalid (int|float) value: (.*)")


def as_options(argv: Sequence[str], takes: Mapping[str, bool]) -> list[str]:
    """The words with each ``KEY=VALUE`` of an option as ``--KEY=VALUE``, as experiments have it.

    A file of that name stays one, and so does the value of the option before. ``out=`` is one for
    every command: a command without ``--out`` says so. `takes` has the options without their
    dashes, and whether each takes a value.
    """
    words: list[str] = []
    is_value = False
    for word in argv:
        key, equals, value = word.partition("=")
        if not is_value and equals and (key in takes or key == "out") and not Path(word).exists():
            if takes.get(key, True):
                word = f"--{key}={value}"
            elif value.lower() in ("true", "false"):
                if value.lower() == "false":
                    continue
                word = f"--{key}"
        words.append(word)
        is_value = word.startswith("--") and "=" not in word and takes.get(word[2:], False)
    return words


class PlainOptions(argparse.ArgumentParser):
    """A parser that raises ConfigurationError; ``--help`` prints `help_text` as it stands."""

    def __init__(self, command: str, help_text: str) -> None:
        super().__init__(prog=command, allow_abbrev=False)
        self._help_text = help_text

    def add_flags(self, *names: str) -> None:
        """Options without a value."""
        for name in names:
            self.add_argument(name, action="store_true")

    def format_help(self) -> str:
        """Return the help that was given."""
        return self._help_text

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; ``--help`` ends the program with 0, a wrong option raises."""
        takes = {
            name.removeprefix("--"): action.nargs != 0
            for action in self._actions
            for name in action.option_strings
        }
        arguments, unknown = self.parse_known_args(as_options(args or (), takes), namespace)
        if unknown:
            options = [name for action in self._actions for name in action.option_strings]
            close = difflib.get_close_matches(unknown[0].partition("=")[0], options, n=1)
            hint = f"; did you mean {close[0]}?" if close else ""
            self.error(f"{unknown[0]!r} is not understood{hint}")
        return arguments

    def error(self, message: str) -> NoReturn:
        """Raise what argparse would print before it exits."""
        if match := _NO_NUMBER.fullmatch(message):
            raise ConfigurationError(
                f"{match[3]} is no number",
                where=match[1],
                remedy="give a whole number" if match[2] == "int" else "give a number",
            )
        first_line = self._help_text.splitlines()[0].removeprefix("usage: ")
        raise ConfigurationError(
            message, where=self.prog, remedy=f"{first_line}; more by {self.prog} --help"
        )
