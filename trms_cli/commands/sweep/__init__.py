"""``trms sweep``: sweeps that were begun, gone on with or told about; and what ``-m`` does.

``trms run -m …`` (and every other command that composes) begins a sweep: :func:`sweep`. What a
sweep varies is read from the overrides, its record is written, and the driver has the runs made.
From Python, :func:`make_sweep` and :func:`go_on` do the same without printing.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.commands.plain_options import as_options
from trms_cli.composition.composer import Composition, Task, compose
from trms_cli.composition.overrides import ComposeRequest
from trms_cli.composition.sweep_settings import Settings, names_of, settings_of
from trms_cli.core.errors import EXIT_OK, EXIT_WORSE, ConfigurationError, RecordingError, TrmsError
from trms_cli.core.plugins import nearest
from trms_cli.sweeps.record import SweepPlan

if TYPE_CHECKING:
    from trms_cli.sweeps.driver import SweepProgress
    from trms_cli.sweeps.point import RunResult, SweepPoint
    from trms_cli.sweeps.record import SweepPlan

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


@dataclass(frozen=True)
class SweepOutcome:
    """A sweep that has been driving to its end."""

    folder: Path
    points: tuple[SweepPoint, ...]  #: That were proposed
    results: dict[int, RunResult]  #: By the number of the point
    counts: dict[str, int]  #: Runs ``done``, ``failed``, ``lost``, ``interrupted``
    summary: dict[str, Any] = field(default_factory=dict)  #: What the sampler has to say

    @property
    def all_done(self) -> bool:
        """Whether every run ended well."""
        return len(self.points) == self.counts.get("done", 0)


#: Called with the progress and, after each run, with its result.
Tell = Callable[["SweepProgress", "RunResult | None"], None]


def _silent(progress: SweepProgress, result: RunResult | None) -> None:
    """Tells nobody."""


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
    """Begin a sweep and drive it to its end, on the screen.

    Returns
    -------
    int
        0 when every run ended well, 1 otherwise.
    """
    from trms_cli.commands.sweep.screen import SweepScreen

    screen = SweepScreen(as_json=as_json)
    with screen:
        swept = make_sweep(
            request.overrides,
            primary,
            task,
            config_dirs=request.config_dirs,
            tell=screen.tell,
            begun=screen.say_begun,
        )
    screen.say_ended(swept.folder)
    return EXIT_OK if swept.all_done else EXIT_WORSE


def make_sweep(
    overrides: Sequence[str],
    primary: str,
    task: Task,
    *,
    config_dirs: Sequence[Path] = (),
    tell: Tell = _silent,
    begun: Callable[[Path], None] = lambda folder: None,
) -> SweepOutcome:
    """Begin a sweep and drive it to its end.

    Parameters
    ----------
    overrides : sequence of str
        What would be typed after ``-m``, the sweep's own among them.
    primary : str
        Primary configuration of the runs, ``run`` for ``configs/run.yaml``.
    task : callable
        A module's function: what a run does with its composition.
    config_dirs : sequence of Path
        Folders of options, absolute.
    tell : callable
        Called after each run, and about twice a second.
    begun : callable
        Called with the folder once the record stands.

    Raises
    ------
    TrmsError
        For what cannot be composed, before anything is written; for workers that are not to be
        had, or a full disk, after that.
    KeyboardInterrupt
        When it was interrupted; what ran has ended, and `go_on` goes on.
    """
    import shutil

    from trms_cli.composition.sweep_settings import built, divided, settings_of
    from trms_cli.library.tasks.sweep_check import check_choices
    from trms_cli.runs.run_folder import new_folder
    from trms_cli.sweeps.record import Record, driving

    mine = divided(overrides, primary, config_dirs)
    settings = settings_of(mine.settings, config_dirs)
    sampler, launcher = built(settings)
    space, _ = _checked(mine.runs, primary, tuple(config_dirs))
    proposals = sampler.start(space)
    check_choices(space, primary, tuple(config_dirs))
    folder = new_folder(mine.out, f"{primary}-sweep").resolve()
    record = Record(folder)
    with driving(folder):
        try:
            plan = _plan(mine, settings, space, primary, task, config_dirs)
            record.begin(plan)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)  # nothing has been run
            raise
        begun(folder)
        return _driven(record, plan, proposals, launcher, task, tell, [], retry_failed=False)


def go_on(
    folder: Path,
    *,
    task: Task | None = None,
    settings: Sequence[str] = (),
    retry_failed: bool = False,
    tell: Tell = _silent,
    begun: Callable[[Path], None] = lambda folder: None,
) -> SweepOutcome:
    """Go on with a sweep where it stopped.

    Parameters
    ----------
    folder : Path
    task : callable or None
        What a run does; None: what the record names, if it is of this program.
    settings : sequence of str
        ``launcher=…``, ``launcher.workers=…``, ``retries=…``, instead of those of the record.
    retry_failed : bool
        Whether runs that failed, or were lost, are made again.
    tell, begun : callable
        As for `make_sweep`.

    Raises
    ------
    TrmsError
        If there is no sweep, another process drives it, or it cannot go on.
    """
    from trms_cli.composition.sweep_settings import built
    from trms_cli.sweeps.record import Record, driving

    folder = folder.resolve()
    record = Record(folder)
    record.document()
    with driving(folder):
        plan = record.plan()
        known = record.points(mend=True)
        with place_of(plan):
            steered = resumed_settings(plan, settings)
            sampler, launcher = built(steered)
            proposals = sampler.start(plan.space, known)
            record.note(state="running", launcher=steered.launcher, retries=steered.retries)
            begun(folder)
            return _driven(
                record,
                plan,
                proposals,
                launcher,
                task or task_of(plan),
                tell,
                known,
                retry_failed=retry_failed,
                retries=steered.retries,
            )


def first_job(request: ComposeRequest, primary: str) -> Composition:
    """The configuration of a sweep's first run, for ``-m --cfg job``."""
    from trms_cli.composition.sweep_settings import divided

    mine = divided(request.overrides, primary, request.config_dirs)
    return _checked(mine.runs, primary, request.config_dirs)[1]


def _checked(
    overrides: Sequence[str], primary: str, config_dirs: tuple[Path, ...]
) -> tuple[Any, Composition]:
    """The space, and its first run composed: what is wrong with the input is told now."""
    from trms_cli.composition.sweep_space import first_of, space_of

    request = ComposeRequest(tuple(overrides), config_dirs, show=False, multirun=True)
    space = space_of(request, primary)
    folders = [word for place in config_dirs for word in ("--config-dir", str(place))]
    return space, compose([*folders, *first_of(space)], primary)


def _plan(
    mine: Any, settings: Any, space: Any, primary: str, task: Task, config_dirs: Sequence[Path]
) -> SweepPlan:
    import os

    from trms_cli.core.invocation import command_line
    from trms_cli.core.versions import versions
    from trms_cli.library.tasks.git_revision import GitRevision
    from trms_cli.sweeps.record import SweepPlan

    revision = GitRevision.ask()
    return SweepPlan(
        primary=primary,
        task=f"{task.__module__}:{getattr(task, '__qualname__', '')}",
        overrides=mine.runs,
        settings=mine.settings,
        space=space,
        sampler=settings.sampler,
        launcher=settings.launcher,
        retries=settings.retries,
        config_dirs=tuple(str(Path(place).resolve()) for place in config_dirs),
        directory=os.getcwd(),
        command=command_line(),
        versions=versions(),
        git=revision.answer(),
    )


def _driven(
    record: Any,
    plan: SweepPlan,
    proposals: Any,
    launcher: Any,
    task: Task,
    tell: Tell,
    known: Sequence[SweepPoint],
    *,
    retry_failed: bool,
    retries: int | None = None,
) -> SweepOutcome:
    """Drive the sweep, and write down at the end, whatever it is, how it stands."""
    from trms_cli.core.allowed import allowed_for_now
    from trms_cli.library.tasks.sweep_work import MakeRun
    from trms_cli.sweeps.driver import Driver, counts_of
    from trms_cli.sweeps.status import now

    work = MakeRun(
        str(record.folder),
        plan.primary,
        task,
        plan.config_dirs,
        plan.directory,
        plan.git,
        tuple(sorted(allowed_for_now())),
    )
    driver = Driver(
        record,
        proposals,
        work,
        retries=plan.retries if retries is None else retries,
        tell=tell,
        retry_failed=retry_failed,
    )
    record.note(total=proposals.total)
    driver.take_stock(known)
    state = "interrupted"
    results = driver.progress.results
    try:
        driver.drive(launcher)
        state = "done"
    finally:
        counts = counts_of(results)
        words: dict[str, Any] = {"state": state, "end": now(), "counts": counts}
        if state == "done":
            words["summary"] = proposals.summary(results)
            words["total"] = len(results)
        try:
            record.note(**words)
        except TrmsError as error:
            sys.stderr.write(f"note   {error.problem}\n")
            if state == "done":
                raise
    return SweepOutcome(
        record.folder, tuple(record.points()), dict(results), counts, words.get("summary", {})
    )


_OPTIONS = ("--retry-failed", "--json")
#: Tasks of a record are looked for here only: a record is data, and names no other code.
_COMMANDS = "trms_cli.commands."


def resume_command(argv: Sequence[str]) -> int:
    """Go on where it stopped."""
    from trms_cli.commands.sweep.screen import SweepScreen

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
    from trms_cli.commands.sweep.screen import say_outcome
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
