"""Options of the commands that read files: argparse, with our errors instead of its exit."""

from __future__ import annotations

import argparse
import difflib
from typing import Any, NoReturn

from trms_cli.core.errors import ConfigurationError


class PlainOptions(argparse.ArgumentParser):
    """An argument parser that raises ConfigurationError and prints a given help.

    Parameters
    ----------
    command : str
        As typed, for messages: "trms import".
    help_text : str
        Printed as it stands for ``--help``.
    """

    def __init__(self, command: str, help_text: str) -> None:
        super().__init__(prog=command, allow_abbrev=False)
        self._help_text = help_text

    def format_help(self) -> str:
        """Return the help that was given."""
        return self._help_text

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; ``--help`` ends the program with 0, a wrong option raises."""
        known, unknown = self.parse_known_args(args, namespace)
        if unknown:
            options = [name for action in self._actions for name in action.option_strings]
            close = difflib.get_close_matches(unknown[0].partition("=")[0], options, n=1)
            meant = f"; did you mean {close[0]}?" if close else ""
            self.error(f"{unknown[0]!r} is not understood{meant}")
        return known

    def error(self, message: str) -> NoReturn:
        """Raise what argparse would print before it exits."""
        first_line = self._help_text.splitlines()[0].removeprefix("usage: ")
        raise ConfigurationError(
            message, where=self.prog, remedy=f"{first_line}; more by {self.prog} --help"
        )
