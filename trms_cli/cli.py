"""The program ``trms``: from argv to a command, and from an error to a message and an exit code.

Nothing heavy is imported here: the module of a command is imported when it is asked for, so that
``trms`` and ``trms --help`` answer at once.
"""

import os
import sys
from collections.abc import Sequence
from types import ModuleType

from trms_cli import __version__
from trms_cli.core.deprecation import present_words, show_on
from trms_cli.core.errors import EXIT_OK, TrmsError, interrupted_code
from trms_cli.core.threads import take_one_thread

EXIT_BUG = 70  #: an error that no code of ours expected (EX_SOFTWARE of sysexits.h)

PICTURE = """\
  reference ──r──▶ controller ──u──▶ rig (the plant) ──y──▶ observer ──x̂──┐
                      ▲                                                    │
                      └────────────────────────────────────────────────────┘
  every sample of r, u, y, x, x̂ and the solver's own words ──▶ one MCAP log
  log ──▶ score · report · identify · validate · diagnose
"""

#: The commands in the order in which a newcomer meets them, each with its module's ``SUMMARY``
#: (a test holds the two equal; the copy spares importing every module for one line of it).
COMMANDS: dict[str, str] = {
    "run": "close the loop: simulate or replay, log, score, draw",
    "rig": "serve a simulated rig in real time, check a real one, drive one by exported C",
    "excite": "design an excitation: band and amplitude from the model",
    "identify": "fit a model's parameters, or a network, to recordings",
    "validate": "how well models foretell recordings: errors, residual tests, spectra",
    "stability": "equilibria, modes, phase portraits, limit cycles, Lyapunov sets, margins",
    "diagnose": "where a model and a rig differ, which effect causes it, how far the gap shrinks",
    "investigate": "experiments, each advised by the last diagnosis, until one cause is sure",
    "blind": "prove diagnoses on sealed rigs: make a set, diagnose it, open its key",
    "course": "a sealed rig for each student, and marks for what they hand in",
    "watch": "a run or a sweep as it goes on, or a finished run replayed",
    "sweep": "go on with a sweep that was interrupted, or tell how one stands",
    "score": "metrics of logs, and comparison with a baseline",
    "plot": "figures of logs for a paper, slides or a page: PNG, SVG, PDF",
    "runs": "what has been run: list, filter, sort, export",
    "compare": "many runs ranked: tracking, effort, robustness, time of a step, failures",
    "report": "one HTML page of a run, a comparison or a sweep: plots and tables, nothing fetched",
    "serve": "a page of all runs in the browser of this machine: filter, compare, watch live ones",
    "import": "turn a recording (CSV, MAT) into an MCAP log",
    "export": "turn an MCAP log into CSV, Parquet or MAT; add the 3D view for Foxglove",
    "export-controller": "a controller as C source for a rig's own computer",
    "init": "a folder for a rig of your own: model, driver, configuration, tests, CI",
    "list": "the plugins there are, with one line each",
    "allow": "let the classes of a package of yours, or of somebody else's, run",
    "doctor": "tell whether this machine is ready, and what to install",
    "completion": "print the tab completion for bash, zsh or fish",
    "help": "show the help of a command",
}

TRY = """\
  trms run controller=newton_mpc ref=square     close the loop and draw what happened
  trms list controller                          the controllers that can take its place
  trms run --help                               what can be changed, with examples
"""

OPTIONS = """\
  -h, --help     this page, or a command's own: trms COMMAND --help (--help-all: all of it)
  --version      the version
  --debug        after any command: show the traceback of an error
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command named by `argv` and return the exit code; never raises but on ``--debug``."""
    if argv is None:  # the program, not a call from Python
        show_on(sys.stderr)
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    _accept_any_terminal()
    try:
        code = _dispatch(arguments)
        sys.stdout.flush()
        return code
    except TrmsError as error:
        if debug:
            raise
        sys.stderr.write(describe_error(error, colour=_has_colour(sys.stderr)))
        return error.exit_code
    except KeyboardInterrupt as error:
        if debug:
            raise
        sys.stderr.write("\ninterrupted\n")
        return interrupted_code(error)
    except BrokenPipeError:
        return _reader_left()
    except Exception as error:
        if debug:
            raise
        sys.stderr.write(_describe_bug(error, arguments))
        return EXIT_BUG


def _dispatch(arguments: list[str]) -> int:
    if not arguments:
        sys.stdout.write(overview(try_these=True))
        return EXIT_OK
    word = arguments[0]
    if word in ("-h", "--help"):
        sys.stdout.write(overview(try_these=False))
        return EXIT_OK
    if word in ("-V", "--version"):
        sys.stdout.write(f"trms {__version__}\n")
        return EXIT_OK
    take_one_thread()
    word, *rest = present_words(arguments)
    module = load_command(word)
    if any(text.partition("=")[0] == "--allow" for text in rest):
        from trms_cli.composition.catalogue import take_allowed

        rest = take_allowed(rest)  # here alone: words that a log or a file holds allow nothing
    if any(text in rest for text in ("--help", "-h", "--help-all")):
        sys.stdout.write(help_text(module, everything="--help-all" in rest))
        return EXIT_OK
    return int(module.main(rest))


def load_command(name: str) -> ModuleType:
    """Import the module of a command.

    Raises TrmsError if there is no such command; it names the nearest.
    """
    if name not in COMMANDS:
        raise TrmsError(
            f"there is no command {name!r}", where="trms", remedy=_nearest_command(name)
        )
    import importlib
    import keyword

    clashes = keyword.iskeyword(name) or name in ("list", "help")
    module = name.replace("-", "_")
    return importlib.import_module(f"trms_cli.commands.{module}{'_' if clashes else ''}")


#: Examples of a command that composes, on the first page of its help.
_FEW_EXAMPLES = 5


def help_text(module: ModuleType, *, everything: bool = True) -> str:
    """The help page of a command; one that composes an experiment ends in what can be chosen.

    All of that fills screens: without ``everything`` a few examples and the groups' names stand for
    it, on one.
    """
    text = str(module.HELP).strip("\n") + "\n"
    primary = getattr(module, "COMPOSES", None)
    if primary is None:
        return text
    from trms_cli.commands.list_ import describe_choices, describe_groups

    if not everything:
        command = next(name for name in COMMANDS if COMMANDS[name] == module.SUMMARY)
        return f"{_shortened(text)}\n{describe_groups(primary, command)}"
    text += "\n" + describe_choices(primary)
    if "--multirun" in text:
        text += "\nsweeps (-m)\n" + describe_choices("sweep")
    return text


def _shortened(text: str) -> str:
    """Usage, purpose, a few examples and the options."""
    sections = [section.splitlines() for section in text.split("\n\n")]
    kept = [s for s in sections if not s[0].startswith("keys that")]
    for section in kept:
        if section[0].startswith("examples"):
            del section[_FEW_EXAMPLES + 1 :]
    return "\n\n".join("\n".join(section) for section in kept).rstrip("\n") + "\n"


def overview(*, try_these: bool) -> str:
    """The first page: the picture, the commands, and either what to try or the options."""
    width = max(map(len, COMMANDS)) + 2
    commands = "".join(f"  {name:{width}}{summary}\n" for name, summary in COMMANDS.items())
    ending = f"try\n{_try_lines()}" if try_these else f"options\n{OPTIONS}"
    return (
        "trms: a laboratory for the twin rotor, in one command\n\n"
        f"{PICTURE}\n"
        f"usage: trms COMMAND …\n\n{commands}\n{ending}"
    )


def _try_lines() -> str:
    from trms_cli.core.invocation import program

    return TRY.replace("  trms ", f"  {program()} ")


def describe_error(error: TrmsError, *, colour: bool) -> str:
    """One screen: what was wrong, where, what to do."""
    red, bold, plain = ("\033[31m", "\033[1m", "\033[0m") if colour else ("", "", "")
    lines = [f"{red}error{plain}  {bold}{_folded(error.problem)}{plain}"]
    if error.where:
        lines.append(f"   in  {_folded(error.where)}")
    if error.remedy:
        lines.append(f"   do  {_folded(error.remedy)}")
    return "\n".join(lines) + "\n"


def _folded(text: str, *, indent: int = 7, width: int = 92) -> str:
    """Lines of at most `width`, later ones under the first; lines that are set stay as they are."""
    import textwrap

    from trms_cli.core.printable import printable

    margin = " " * indent
    folded: list[str] = []
    for line in printable(text).splitlines() or [""]:
        if line.startswith(" "):
            folded.append(line)
            continue
        folded += textwrap.wrap(
            line, width - indent, break_long_words=False, break_on_hyphens=False
        ) or [""]
    return f"\n{margin}".join(folded)


def _describe_bug(error: Exception, arguments: Sequence[str]) -> str:
    import shlex
    import traceback

    from trms_cli.core.invocation import program

    frame = traceback.extract_tb(error.__traceback__)[-1]
    command = f"{program()} {shlex.join(['--debug', *arguments])}"
    return (
        "error  this is a bug in trms, or in a plugin that it was given\n"
        f"       {type(error).__name__}: {_folded(str(error))}\n"
        f"   in  {frame.filename}:{frame.lineno}, {frame.name}\n"
        f"   do  see the whole trace with: {command}\n"
    )


def _nearest_command(name: str) -> str:
    import difflib

    close = difflib.get_close_matches(name, COMMANDS, n=1, cutoff=0.5)
    hint = f"did you mean `trms {close[0]}`? " if close else ""
    if "=" in name:
        hint = f"an override follows a command: `trms run {name}`. "
    return f"{hint}there are: {', '.join(COMMANDS)}"


def _has_colour(stream: object) -> bool:
    isatty = getattr(stream, "isatty", None)
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return False
    return bool(isatty and isatty())


def _accept_any_terminal() -> None:
    """A terminal that cannot show α or → must not end a run: it gets a question mark."""
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors="replace")


def _reader_left() -> int:
    """The reader of a pipe (`| head`) closed it: no message, and no second one at exit."""
    devnull = os.open(os.devnull, os.O_WRONLY)
    os.dup2(devnull, sys.stdout.fileno())
    return 128 + 13  # what the shell reports for a program that SIGPIPE ended
