"""``trms sweep resume FOLDER`` and ``trms sweep status FOLDER``."""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from trms_cli.commands.plain_options import as_options
from trms_cli.composition.composer import Task
from trms_cli.composition.sweep_settings import Settings, names_of, settings_of
from trms_cli.core.errors import EXIT_OK, EXIT_WORSE, ConfigurationError, RecordingError
from trms_cli.core.plugins import nearest
from trms_cli.sweeps.record import SweepPlan

_OPTIONS = ("--retry-failed", "--json")
#: Tasks of a record are looked for here only: a record is data, and names no other code.
_COMMANDS = "trms_cli.commands."


def resume_command(argv: Sequence[str]) -> int:
    """Go on where it stopped."""
    from trms_cli.commands.sweep import go_on
    from trms_cli.commands.sweep_screen import SweepScreen

    folder, settings, options = _read(argv, "resume", _OPTIONS)
    screen = SweepScreen(as_json="--json" in options)
    with screen:
        swept = go_on(
            folder,
            settings=settings,
            retry_failed="--retry-failed" in options,
            tell=screen.tell,
            begun=screen.say_begun,
        )
    screen.say_ended(swept.folder)
    return EXIT_OK if swept.all_done else EXIT_WORSE


def status_command(argv: Sequence[str]) -> int:
    """Tell how it stands."""
    from trms_cli.commands.sweep_screen import say_outcome
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
        sys.stdout.write(json.dumps(document, ensure_ascii=False, indent=2) + "\n")
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
        if option not in allowed:
            raise ConfigurationError(
                f"unknown option {option!r}",
                where=f"trms sweep {word}",
                remedy=nearest(option, allowed),
            )
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


def resumed_settings(plan: SweepPlan, changed: Sequence[str]) -> Settings:
    """The settings of a record, some of them changed.

    Raises ConfigurationError for what cannot change: a sweep goes on with the points that its
    sampler has begun.
    """
    from trms_cli.composition.catalogue import read_primary

    config_dirs = tuple(map(Path, plan.config_dirs))
    names = names_of(read_primary("sweep", config_dirs))
    for text in changed:
        key = text.partition("=")[0].lstrip("+")
        first = key.split(".")[0]
        if first == "sampler" or first not in names:
            raise ConfigurationError(
                f"{text} given",
                where=key,
                remedy="a sweep goes on as it was asked for; only launcher=…, launcher.KEY=… and "
                "retries=N may change: for all else make it anew",
            )
    if not changed:
        return Settings(dict(plan.sampler), dict(plan.launcher), plan.retries)
    typed = [text for text in plan.settings if not text.lstrip("+").startswith("sampler")]
    if any(text.startswith("launcher=") for text in changed):
        typed = [text for text in typed if not text.startswith("launcher")]
    settings = settings_of([*typed, *changed], config_dirs)
    return settings._replace(sampler=dict(plan.sampler))


@contextmanager
def place_of(plan: SweepPlan) -> Iterator[None]:
    """In the folder that the sweep was begun in, its options importable; told what differs.

    Raises RecordingError if the folder, or one of options, is gone.
    """
    from trms_cli.composition.catalogue import make_importable
    from trms_cli.core.versions import versions

    for place in (plan.directory, *plan.config_dirs):
        if not Path(place).is_dir():
            raise RecordingError(
                f"the folder {place!r}, which the sweep was begun "
                f"{'in' if place == plan.directory else 'with'}, is gone",
                where="sweep.json",
                remedy="put it back: the runs that are left read files from there",
            )
    here = versions()
    changed = [
        f"{name} {version} → {here.get(name, 'absent')}"
        for name, version in plan.versions.items()
        if here.get(name) != version
    ]
    if changed:
        sys.stderr.write(
            f"note   not as it was when the sweep began: {', '.join(changed)}; the last digits of "
            "figures may differ between earlier and later runs\n"
        )
    before = os.getcwd()
    make_importable(map(Path, plan.config_dirs))
    os.chdir(plan.directory)
    try:
        yield
    finally:
        os.chdir(before)


def task_of(plan: SweepPlan) -> Task:
    """What a run of the sweep does.

    Raises RecordingError if the record names no command of this program.
    """
    module, _, name = plan.task.partition(":")
    found: Any = None
    if module.startswith(_COMMANDS) and name.isidentifier():
        try:
            found = getattr(importlib.import_module(module), name, None)
        except ImportError:
            found = None
    if not callable(found) or getattr(found, "__module__", "") != module:
        raise RecordingError(
            f"its runs are made by {plan.task!r}, which is no command of this program",
            where="sweep.json",
            remedy="a sweep that was begun from Python is gone on with from Python",
        )
    return found
