"""``trms sweep``: sweeps that were begun, gone on with or told about; and what ``-m`` does.

``trms run -m …`` (and every other command that composes) begins a sweep: :func:`sweep`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from trms_cli.commands.plain_options import as_options
from trms_cli.composition.composer import Task
from trms_cli.composition.overrides import ComposeRequest
from trms_cli.core.errors import EXIT_OK, EXIT_WORSE, ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.core.printable import print_json
from trms_cli.library.tasks.sweep import go_on, make_sweep

if TYPE_CHECKING:
    from trms_cli.sweeps.driver import SweepOutcome

SUMMARY = "go on with a sweep that was interrupted, or tell how one stands"
COMPOSES = "sweep"

HELP = """\
usage: trms run -m KEY=VALUE,VALUE… [sampler=…] [launcher=…] [retries=N] [out=FOLDER] [--json]
       trms sweep resume FOLDER [launcher=…] [retries=N] [--retry-failed] [--json]
       trms sweep status FOLDER [--json]

A sweep makes one run for each combination of values, or for values that are drawn or searched,
each in a numbered folder with its log, score.json and status.json. Whatever dies or is switched
off meanwhile, `trms sweep resume` goes on where it stopped, and makes no run twice.

examples
  trms run -m controller=pid,lqr,newton_mpc seed=1,2,3         nine runs, on all cores
  trms run -m controller=pid plant.parameters=prior sampler=latin_hypercube sampler.samples=200
  trms run -m controller=pid 'seed=range(1000)' launcher.workers=8 out=many
  trms run -m controller=pid 'seed=range(1000)' launcher=dask launcher.address=tcp://head:8786
  trms run -m controller=pid 'seed=range(1000)' launcher=slurm launcher.workers=32
  trms sweep status many                       counts, failures by their reason, the best
  trms sweep resume many                       goes on after Ctrl-C, a crash, a full disk
  trms sweep resume many --retry-failed        also those that failed or were lost
  trms sweep resume many launcher=slurm        the rest elsewhere
  trms watch many                              as it goes on

options
  --retry-failed   make again what failed or was lost
  --allow PACKAGE  let classes of this package run, as for the command that began the sweep
  --json           print the outcome as one JSON document (trms.sweep-status/1)
"""


def main(argv: Sequence[str]) -> int:
    """Go on with a sweep, or tell how it stands."""
    commands = {"resume": resume_command, "status": status_command}
    word = argv[0] if argv else ""
    if word not in commands:
        raise ConfigurationError(
            f"cannot use {word!r}" if word else "nothing to do",
            where="trms sweep",
            remedy="write trms sweep resume FOLDER or trms sweep status FOLDER; "
            "a sweep is begun by -m: trms run -m controller=pid,lqr",
        )
    return commands[word](argv[1:])


def sweep(request: ComposeRequest, primary: str, task: Task, *, as_json: bool = False) -> int:
    """Begin a sweep and drive it to its end, on the screen; 0 when every run ended well, else 1."""
    drive = partial(make_sweep, request.overrides, primary, task, config_dirs=request.config_dirs)
    return _show(drive, as_json=as_json)


def _show(drive: Callable[..., SweepOutcome], *, as_json: bool) -> int:
    from trms_cli.reporting.sweep_screen import on_screen

    return EXIT_OK if on_screen(drive, as_json=as_json).all_done else EXIT_WORSE


_OPTIONS = ("--retry-failed", "--json")


def resume_command(argv: Sequence[str]) -> int:
    """Go on where it stopped."""
    folder, settings, options = _read(argv, "resume", _OPTIONS)
    drive = partial(go_on, folder, settings=settings, retry_failed="--retry-failed" in options)
    return _show(drive, as_json="--json" in options)


def status_command(argv: Sequence[str]) -> int:
    """Tell how it stands."""
    from trms_cli.reporting.sweep_screen import say_outcome
    from trms_cli.sweeps.outcome import outcome_of

    folder, settings, options = _read(argv, "status", ("--json",))
    if settings:
        raise ConfigurationError(
            f"{settings[0]!r} given",
            where="trms sweep status",
            remedy="usage: trms sweep status FOLDER [--json]",
        )
    document = outcome_of(folder.resolve())
    if options:
        print_json(document)
    else:
        say_outcome(document)
    return EXIT_OK


def _read(
    argv: Sequence[str], word: str, allowed: Sequence[str]
) -> tuple[Path, list[str], list[str]]:
    """The folder, the overrides and the options of a command line."""
    from trms_cli.composition.catalogue import take_allowed

    argv = as_options(take_allowed(argv), {name.removeprefix("--"): False for name in allowed})
    options = [text for text in argv if text.startswith("-")]
    for option in options:
        require_known(option, allowed, f"unknown option {option!r}", f"trms sweep {word}")
    rest = [text for text in argv if not text.startswith("-")]
    folders = [text for text in rest if "=" not in text or Path(text).is_dir()]
    if len(folders) != 1:
        raise ConfigurationError(
            "no folder named" if not folders else f"{len(folders)} folders named",
            where=f"trms sweep {word}",
            remedy=f"write trms sweep {word} FOLDER, where FOLDER holds sweep.json",
        )
    folder = Path(folders[0]).expanduser()
    if folder.name == "sweep.json":
        folder = folder.parent
    if not folder.is_dir():
        raise ConfigurationError(
            f"there is no folder {str(folder)!r}",
            where=f"trms sweep {word}",
            remedy="name the folder of a sweep",
        )
    return folder, [text for text in rest if text not in folders], options
