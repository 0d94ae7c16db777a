"""Errors that a user can mend, and the exit codes they end in.

A domain room raises these; only :mod:`trms_cli.cli` turns them into text and an exit code.
"""

EXIT_OK = 0
EXIT_WORSE = 1  #: a comparison with a baseline failed
EXIT_BAD_INPUT = 2  #: what was typed, or a file that was given, cannot be used
EXIT_INTERRUPTED = 130  #: Ctrl-C, as the shell has it
EXIT_TERMINATED = 143  #: SIGTERM, as the shell has it


class Termination(KeyboardInterrupt):
    """SIGTERM: what a scheduler sends ends a run as Ctrl-C does, its log closed and marked."""


def interrupted_code(error: KeyboardInterrupt) -> int:
    """The exit code of a program that was interrupted."""
    return EXIT_TERMINATED if isinstance(error, Termination) else EXIT_INTERRUPTED


def first_line(error: object, otherwise: str = "no reason given") -> str:
    """The first line of what an error says."""
    return next((line.strip() for line in str(error or "").splitlines() if line.strip()), otherwise)


class TrmsError(Exception):
    """A failure that is explained to the user instead of shown as a traceback.

    Parameters
    ----------
    problem : str
        What was wrong, in one sentence, with the value that was given.
    where : str
        The configuration key, or the file and its line.
    remedy : str
        What to do: what is allowed, or the line to type.
    """

    exit_code = EXIT_BAD_INPUT

    def __init__(self, problem: str, *, where: str = "", remedy: str = "") -> None:
        super().__init__(problem)
        self.problem = problem
        self.where = where
        self.remedy = remedy

    def __str__(self) -> str:
        parts = [self.problem]
        if self.where:
            parts.insert(0, f"{self.where}:")
        if self.remedy:
            parts.append(f"({self.remedy})")
        return " ".join(parts)

    def _render_traceback_(self) -> list[str]:
        """What a notebook shows instead of a traceback: as a terminal does, in three lines.

        A plugin that failed is shown with its own trace: there the mistake is.
        """
        import traceback

        cause = self.__cause__
        trace = [] if cause is None else traceback.format_exception(cause)
        lines = [f"{type(self).__name__}: {self.problem}"]
        lines += [f"   in  {self.where}"] if self.where else []
        lines += ["   do  " + self.remedy.replace("\n", "\n       ")] if self.remedy else []
        return [line.rstrip("\n") for line in trace] + lines


class ConfigurationError(TrmsError, ValueError):
    """A key of the configuration is misspelt, of the wrong type, out of range or missing."""


class RecordingError(TrmsError, ValueError):
    """A recording, log or table of numbers cannot be read or written."""


class ModelError(TrmsError, ValueError):
    """A model, effect or parameter set does not fit what is asked of it."""


class SimulationError(TrmsError, RuntimeError):
    """A run could not go on: non-finite state, no equilibrium, a plugin that failed."""

    exit_code = 1
