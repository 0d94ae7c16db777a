"""What a worker of a sweep does with a point: it makes one run in a folder of its own."""

import contextlib
import ctypes
import errno
import gc
import io
import json
import os
import platform
import shlex
import threading
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Any

from trms_cli.composition.composer import Outcome, Task, composer_of
from trms_cli.core.errors import EXIT_OK, Termination, TrmsError
from trms_cli.core.invocation import called_as
from trms_cli.core.trust import allow_for_now
from trms_cli.library.tasks.git_revision import known_revision
from trms_cli.reporting.progress import termination
from trms_cli.runs.columns import figures_of
from trms_cli.runs.entry import STATUS_SCHEMA
from trms_cli.runs.run_folder import SCORE_NAME
from trms_cli.sweeps.driver import DISK_FULL
from trms_cli.sweeps.plugins import Attempt
from trms_cli.sweeps.record import SIGN_EVERY, STOP_NAME, RunFolder, leaving, now, result_of
from trms_cli.sweeps.space import RunResult, State

#: Lines of a run's standard error that are kept.
_MOST_NOTES = 20
_LONGEST_LINE = 400  # of what a run says of itself, beside its overrides
#: A worker with several threads makes one run after another: they share compiled functions.
_ONE_AT_A_TIME = threading.Lock()
_LOOK = 0.5  # s between two looks whether the sweep is to stop


@dataclass(frozen=True)
class MakeRun:
    """Makes the run of a point, once, whoever else is handed it."""

    folder: str  #: Of the sweep
    primary: str  #: Primary configuration of the runs
    task: Task  #: What a run does with its composition
    config_dirs: tuple[str, ...]  #: The user's folders of options
    directory: str  #: Working directory, for paths in overrides
    git: str = ""  #: Revision of the checkout, asked once for all runs
    #: Packages whose classes may be built, for workers that do not inherit it
    allowed_packages: tuple[str, ...] = ()

    def __call__(self, attempt: Attempt) -> RunResult | None:
        """Make the run; every failure is told in the result, and in the run's ``status.json``."""
        with _ONE_AT_A_TIME, _collected_after():
            return self._call(attempt)

    def _call(self, attempt: Attempt) -> RunResult | None:
        point = attempt.point
        sweep = Path(self.folder)
        if leaving.is_set() or (sweep / STOP_NAME).exists():
            return RunResult(point.number, "interrupted")
        run = RunFolder(sweep, point.number)
        try:
            if not run.claim(attempt.number):
                return run.result()  # done already, or another worker is at it
            earlier_result = run.result()
            if earlier_result is not None and earlier_result.state == "done":
                return earlier_result
            run.put_aside(attempt.number)
            status: dict[str, Any] = {
                "schema": STATUS_SCHEMA,
                "job": point.number,
                "overrides": list(point.overrides),
                "state": "running",
                "pid": os.getpid(),
                "host": platform.node(),
                "attempt": attempt.number,
                "begin": now(),
            }
            run.write(status)
            status |= self._make(attempt, run)
            status["end"] = now()
            notes = tuple(status.get("notes", ()))
            if run.last_attempt() == attempt.number:  # else this worker was taken for dead
                run.write(status)
        except OSError as error:
            # The status cannot be written: it stays as it is, and the run is made again.
            kind = "failed" if not _is_full(error) else "interrupted"
            problem = f"{DISK_FULL}: {error}" if _is_full(error) else f"{error}"
            return RunResult(point.number, kind, problem=problem)  # type: ignore[arg-type]
        result = result_of(status, point.number)
        assert result is not None
        return replace(result, notes=notes)

    def _make(self, attempt: Attempt, run: RunFolder) -> dict[str, Any]:
        """Keys of the status that the run ends with."""
        point = attempt.point
        status: dict[str, Any] = {}
        said, errors = io.StringIO(), io.StringIO()
        for package in self.allowed_packages:
            allow_for_now(package)
        try:
            if self.directory and os.getcwd() != self.directory:
                os.chdir(self.directory)  # relative paths are meant from there
            with _watched(run, attempt.number, Path(self.folder)):
                folders = tuple(map(Path, self.config_dirs))
                composition = composer_of(self.primary, folders).compose(
                    point.overrides, point.number
                )
                status["choices"] = composition.choices
                composition.config["out"] = str(run.path.resolve())
                with (
                    contextlib.redirect_stdout(said),
                    contextlib.redirect_stderr(errors),
                    known_revision(self.git),
                    called_as(shlex.join(["trms", self.primary, *point.overrides])),
                ):
                    outcome = self.task(composition)
        except KeyboardInterrupt:
            return status | {"state": "interrupted"}
        except Exception as error:
            if _is_full(error):
                return status | {
                    "state": "interrupted",
                    "error": {"problem": f"{DISK_FULL}: {error}", "where": "", "remedy": ""},
                }
            return status | {"state": "failed", "error": _described(error)} | _notes(errors)
        outcome = outcome if isinstance(outcome, Outcome) else Outcome(outcome)
        state: State = "done" if outcome.exit_code == EXIT_OK else "failed"
        status |= {"state": state, "exit_code": outcome.exit_code, "objective": outcome.objective}
        status["figures"] = _figures(run.path)
        lines = [line.strip() for line in said.getvalue().splitlines() if line.strip()]
        room = _LONGEST_LINE + len(" ".join(point.overrides))
        last = lines[-1] if lines else ""
        status["told"] = last if len(last) <= room else f"{last[: room - 1]}…"
        return status | _notes(errors)


@contextlib.contextmanager
def _collected_after() -> Iterator[None]:
    """Look for unused objects once, after the run: amid it, what is young stays in use."""
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.collect(1)
        if was:
            gc.enable()


@contextlib.contextmanager
def _watched(run: RunFolder, attempt: int, sweep: Path) -> Iterator[None]:
    """Give signs of life meanwhile, and end the run when the sweep is to stop.

    `Terminated` is raised in the thread of the run: when the sweep asks for it, when SIGTERM
    comes, or when the process that drives a local worker has died.
    """
    watch = _Watch(run.attempt_file(attempt), sweep / STOP_NAME)
    with termination():
        watch.start()
        try:
            yield
        finally:
            watch.end()


class _Watch(threading.Thread):
    """Looks twice a second whether the run is to end; touches the attempt's file now and then."""

    def __init__(self, sign: Path, stop: Path) -> None:
        super().__init__(name="watch of a run", daemon=True)
        self._sign, self._stop_file = sign, stop
        self._runner = threading.get_ident()
        self._parent = os.getppid()
        self._end_event = threading.Event()
        self._lock = threading.Lock()
        self._has_ended = False

    def run(self) -> None:
        """Until the run has ended."""
        last = monotonic()
        while not self._end_event.wait(_LOOK):
            orphaned = os.getppid() != self._parent
            if orphaned or leaving.is_set() or self._stop_file.exists():
                self._interrupt()
                return
            if monotonic() - last >= SIGN_EVERY:
                last = monotonic()
                with contextlib.suppress(OSError):
                    os.utime(self._sign)

    def end(self) -> None:
        """The run has ended: it is not to be interrupted any more."""
        with self._lock:
            self._has_ended = True
        self._end_event.set()

    def _interrupt(self) -> None:
        with self._lock:
            if not self._has_ended:
                ctypes.pythonapi.PyThreadState_SetAsyncExc(
                    ctypes.c_ulong(self._runner), ctypes.py_object(Termination)
                )


def _figures(folder: Path) -> dict[str, float]:
    """Figures of the run's score that are finite; empty where it has none."""
    try:
        score = json.loads((folder / SCORE_NAME).read_bytes())
    except (OSError, ValueError):
        return {}
    if not isinstance(score, Mapping):
        return {}
    return {name: float(value) for name, value in figures_of(score).items() if value is not None}


def _notes(errors: io.StringIO) -> dict[str, list[str]]:
    lines = [line.rstrip() for line in errors.getvalue().splitlines() if line.strip()]
    return {"notes": lines[:_MOST_NOTES]} if lines else {}


def _described(error: Exception) -> dict[str, str]:
    if isinstance(error, TrmsError):
        return {
            "problem": error.problem,
            "where": error.where,
            "remedy": error.remedy,
            "type": type(error).__name__,
        }
    return {
        "problem": f"{type(error).__name__}: {error}",
        "trace": "".join(traceback.format_exception(error)),
    }


def _is_full(error: BaseException | None) -> bool:
    """Whether a full disk, or a quota, is the reason."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return True
        error = error.__cause__ or error.__context__
    return False
