"""``trms help COMMAND``: the same page as ``trms COMMAND --help``."""

import sys
from collections.abc import Sequence

from trms_cli.core.errors import EXIT_OK

SUMMARY = "show the help of a command"

HELP = """\
usage: trms help [COMMAND]

  The help of COMMAND, the same as trms COMMAND --help; alone, the list of commands.
"""


def main(argv: Sequence[str]) -> int:
    """Print the help of the named command, or the overview."""
    from trms_cli.cli import help_text, load_command, overview

    if not argv:
        sys.stdout.write(overview(try_these=False))
    else:
        sys.stdout.write(help_text(load_command(argv[0]), everything=False))
    return EXIT_OK
