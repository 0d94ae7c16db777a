"""How a study that was called from a shell ends."""

from __future__ import annotations

import sys
from collections.abc import Callable

from trms_cli.cli import describe_error
from trms_cli.core.errors import EXIT_INTERRUPTED, TrmsError


def ended(work: Callable[[], int]) -> int:
    """The exit code of the work; a mistake of the user's is told on one screen."""
    try:
        return work()
    except TrmsError as error:
        sys.stderr.write(describe_error(error, colour=sys.stderr.isatty()))
        return error.exit_code
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
