"""Sweeps: begun, checked, driven to their end, gone on with; nothing is printed.

What a sweep varies is read from the overrides, its record is written, and the driver has the runs
made (:mod:`trms_cli.library.tasks.sweep_work`). Before that one run of each value that is tried is
looked at: a key that one of the controllers lacks, or a duration that is no number, would fail
each run of its kind, so it is told at once, and nothing is written. Each value is tried with the
first of all others, so that the effort grows with the number of values and not with that of
combinations. Parts of this program are built as a run builds them; a user's own code runs in
workers only.
"""

from __future__ import annotations

import importlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.composition.composer import Composition, Task, compose
from trms_cli.composition.overrides import ComposeRequest
from trms_cli.composition.sweep_space import Settings, settings_of
from trms_cli.core.errors import ConfigurationError, RecordingError, TrmsError
from trms_cli.core.invocation import command_line, note
from trms_cli.core.plugins import TARGET
from trms_cli.core.uncollected import uncollected
from trms_cli.runs.entry import LOG_NAME
from trms_cli.sweeps.record import SweepPlan
from trms_cli.sweeps.space import Space

if TYPE_CHECKING:
    from trms_cli.sweeps.driver import SweepOutcome, SweepProgress, Tell
    from trms_cli.sweeps.space import RunResult, SweepPoint

#: Values of one key that are looked at, from the first on; the last is, too.
MOST_VALUES = 30
_OURS = "trms_cli."
#: Tasks of a record are looked for here only: a record is data, and names no other code.
_TASKS = ("trms_cli.commands.", "trms_cli.library.tasks.")


def make_sweep(
    overrides: Sequence[str],
    primary: str,
    task: Task,
    *,
    config_dirs: Sequence[Path] = (),
    tell: Tell = lambda progress, result: None,
    begun: Callable[[Path], None] = lambda folder: None,
) -> SweepOutcome:
    """Begin a sweep and drive it to its end.

    `overrides` are what would be typed after ``-m``, the sweep's own among them. `task` is a
    module's function: what a run does with its composition. `tell` is called after each run, and
    about twice a second; `begun` with the folder once the record stands.

    Raises TrmsError for what cannot be composed, before anything is written, and for workers that
    are not to be had or a full disk, after that; KeyboardInterrupt when it was interrupted: what
    ran has ended, and `go_on` goes on.
    """
    from trms_cli.composition.sweep_space import divide_overrides, sampler_and_launcher
    from trms_cli.core.versions import versions
    from trms_cli.library.tasks.git_revision import GitRevision
    from trms_cli.runs.run_folder import new_folder
    from trms_cli.sweeps.record import Record, drive_sweep

    mine = divide_overrides(overrides, primary, config_dirs)
    settings = settings_of(mine.settings, config_dirs)
    sampler, launcher = sampler_and_launcher(settings)
    space, _ = _checked(mine.runs, primary, tuple(config_dirs))
    proposals = sampler.start(space)
    check_choices(space, primary, tuple(config_dirs))
    folder = new_folder(mine.out, f"{primary}-sweep").resolve()
    record = Record(folder)
    with drive_sweep(folder):
        try:
            plan = SweepPlan(
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
                git=GitRevision.ask().answer(),
            )
            record.begin(plan)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)  # nothing has been run
            raise
        begun(folder)
        return _drive(record, plan, proposals, launcher, task, tell, [], False)


def go_on(
    folder: Path,
    *,
    task: Task | None = None,
    settings: Sequence[str] = (),
    retry_failed: bool = False,
    tell: Tell = lambda progress, result: None,
    begun: Callable[[Path], None] = lambda folder: None,
) -> SweepOutcome:
    """Go on with a sweep where it stopped.

    Without `task` a run does what the record names, if that is of this program. `settings`
    (``launcher=…``, ``launcher.workers=…``, ``retries=…``) count instead of those of the record.
    With `retry_failed`, runs that failed, or were lost, are made again. `tell` and `begun` are as
    for `make_sweep`. Raises TrmsError if there is no sweep, another process drives it, or it cannot
    go on.
    """
    from trms_cli.composition.sweep_space import sampler_and_launcher
    from trms_cli.sweeps.record import Record, drive_sweep

    folder = folder.resolve()
    record = Record(folder)
    record.document()
    with drive_sweep(folder):
        plan = record.plan()
        with uncollected():
            earlier_points = record.points(mend=True)
        with place_of(plan):
            steered = resumed_settings(plan, settings)
            sampler, launcher = sampler_and_launcher(steered)
            with uncollected():
                proposals = sampler.start(plan.space, earlier_points)
            record.note(state="running", launcher=steered.launcher, retries=steered.retries)
            begun(folder)
            plan, task = replace(plan, retries=steered.retries), task or task_of(plan)
            return _drive(
                record, plan, proposals, launcher, task, tell, earlier_points, retry_failed
            )


def first_job(request: ComposeRequest, primary: str) -> Composition:
    """The configuration of a sweep's first run, for ``-m --cfg job``."""
    from trms_cli.composition.sweep_space import divide_overrides

    mine = divide_overrides(request.overrides, primary, request.config_dirs)
    return _checked(mine.runs, primary, request.config_dirs)[1]


def _checked(
    overrides: Sequence[str], primary: str, config_dirs: tuple[Path, ...]
) -> tuple[Any, Composition]:
    """The space, and its first run composed: what is wrong with the input is told now."""
    from trms_cli.composition.sweep_space import first_of, space_of

    request = ComposeRequest(tuple(overrides), config_dirs, show=False, multirun=True)
    space = space_of(request, primary)
    return space, compose(first_of(space), primary, config_dirs=config_dirs)


def _drive(
    record: Any,
    plan: SweepPlan,
    proposals: Any,
    launcher: Any,
    task: Task,
    tell: Tell,
    earlier_points: Sequence[SweepPoint],
    retry_failed: bool,
) -> SweepOutcome:
    """Drive the sweep, and write down at the end, whatever it is, how it stands."""
    from trms_cli.core.trust import allowed_for_now
    from trms_cli.library.tasks.sweep_work import MakeRun
    from trms_cli.sweeps.driver import Driver, SweepOutcome, counts_of
    from trms_cli.sweeps.record import now

    work = MakeRun(
        str(record.folder),
        plan.primary,
        task,
        plan.config_dirs,
        plan.directory,
        plan.git,
        tuple(sorted(allowed_for_now())),
    )
    indexed = _Indexed(record.folder, tell)
    driver = Driver(
        record, proposals, work, retries=plan.retries, tell=indexed, retry_failed=retry_failed
    )
    record.note(total=proposals.total)
    with uncollected():
        driver.take_stock(earlier_points)
    indexed.is_active = plan.primary == "run"
    state = "interrupted"
    results = driver.progress.results
    try:
        driver.drive(launcher)
        state = "done"
    finally:
        indexed.take_in()
        counts = counts_of(results)
        words: dict[str, Any] = {"state": state, "end": now(), "counts": counts}
        if state == "done":
            words["summary"] = proposals.summary(results)
            words["total"] = len(results)
        try:
            record.note(**words)
        except TrmsError as error:
            note(f"note   {error.problem}")
            if state == "done":
                raise
    return SweepOutcome(
        record.folder, tuple(driver.points), dict(results), counts, words.get("summary", {})
    )


#: Logs that are read into the index at once: some tens of milliseconds.
_INDEXED_AT_ONCE = 50


class _Indexed:
    """Reads logs into this host's index as runs end, so that who lists the sweep need not wait."""

    def __init__(self, folder: Path, tell: Tell) -> None:
        self.is_active = False
        self._folder, self._tell = folder, tell
        self._logs: list[str] = []

    def __call__(self, progress: SweepProgress, result: RunResult | None) -> None:
        if self.is_active and result is not None and result.state == "done":
            self._logs.append(os.path.realpath(self._folder / str(result.number) / LOG_NAME))
            if len(self._logs) >= _INDEXED_AT_ONCE:
                self.take_in()
        self._tell(progress, result)

    def take_in(self) -> None:
        """Read those that have been written since."""
        from trms_cli.runs.query import take_in

        if self._logs:
            logs, self._logs = self._logs, []
            take_in(logs)


def resumed_settings(plan: SweepPlan, changed: Sequence[str]) -> Settings:
    """The settings of a record, some of them changed.

    Raises ConfigurationError for what cannot change: a sweep goes on with the points that its
    sampler has begun.
    """
    from trms_cli.composition.catalogue import read_primary

    config_dirs = tuple(map(Path, plan.config_dirs))
    names = read_primary("sweep", config_dirs).names
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
    from trms_cli.core.versions import changed_since

    for place in (plan.directory, *plan.config_dirs):
        if not Path(place).is_dir():
            raise RecordingError(
                f"the folder {place!r}, which the sweep was begun "
                f"{'in' if place == plan.directory else 'with'}, is gone",
                where="sweep.json",
                remedy="put it back: the runs that are left read files from there",
            )
    changed = changed_since(plan.versions)
    if changed:
        note(
            f"note   not as it was when the sweep began: {', '.join(changed)}; the last digits of "
            "figures may differ between earlier and later runs"
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
    function: Any = None
    if module.startswith(_TASKS) and name.isidentifier():
        try:
            function = getattr(importlib.import_module(module), name, None)
        except ImportError:
            function = None
    if not callable(function) or getattr(function, "__module__", "") != module:
        raise RecordingError(
            f"its runs are made by {plan.task!r}, which is no command of this program",
            where="sweep.json",
            remedy="a sweep that was begun from Python is gone on with from Python",
        )
    return function


def check_choices(space: Space, primary: str, config_dirs: tuple[Path, ...]) -> None:
    """Compose a run of each value, and build what is cheap and safe to build.

    Raises TrmsError for the first value that no run can be made with; it names the value.
    """
    from trms_cli.composition.composer import composer_of

    composer = composer_of(primary, config_dirs)
    checked_nodes: set[str] = set()
    for word, overrides in _runs(space):
        try:
            composition = composer.compose(overrides)
            if primary == "run":
                _check_run(composition.config, checked_nodes)
        except TrmsError as error:
            if word:
                error.problem = f"{error.problem} (in the runs with {word})"
                error.args = (error.problem,)
            raise


def _runs(space: Space) -> Iterator[tuple[str, tuple[str, ...]]]:
    """What a run has of its own, and its overrides."""
    from trms_cli.composition.sweep_space import first_of

    first = first_of(space)
    yield "", first
    for place, choice in enumerate(space.choices, start=len(space.fixed)):
        values = choice.values[1:]
        if len(values) > MOST_VALUES:
            values = (*values[: MOST_VALUES - 1], values[-1])
        for value in values:
            word = f"{choice.key}={value}"
            yield word, (*first[:place], word, *first[place + 1 :])


def _check_run(config: Mapping[str, Any], checked_nodes: set[str]) -> None:
    """What a run would refuse before its first step."""
    from trms_cli.composition.plain_values import check_files, number, whole_number
    from trms_cli.core.plugins import build
    from trms_cli.library.tasks import experiment as assembly
    from trms_cli.library.tasks.replay import is_replay

    if is_replay(config):
        return
    check_files(config)
    for name in ("duration", "sample_time"):
        number(config["sim"][name], f"sim.{name}")
    whole_number(config["seed"], "seed")
    whole_number(config["sim"]["prediction_every"], "sim.prediction_every")
    for key in ("model", *assembly.PARTS):
        node = json.dumps([key, config[key]], default=str)
        if node in checked_nodes or not _is_ours(config[key]):
            continue
        checked_nodes.add(node)
        try:
            build(config[key], key)
        except TrmsError:
            raise
        except Exception:  # a fault of the part itself: the run tells it, with its trace
            continue


def _is_ours(node: Any) -> bool:
    """Whether all that a part is made of belongs to this program."""
    if isinstance(node, Mapping):
        target = node.get(TARGET)
        if target is not None and not str(target).startswith(_OURS):
            return False
        return all(map(_is_ours, node.values()))
    return all(map(_is_ours, node)) if isinstance(node, (list, tuple)) else True
