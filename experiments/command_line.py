"""What studies that are called from a shell have in common: their options, how they end."""

from __future__ import annotations

import argparse
import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar

from trms_cli.cli import describe_error
from trms_cli.core.errors import (
    EXIT_TERMINATED,
    ConfigurationError,
    TrmsError,
    interrupted_code,
)
from trms_cli.core.threads import ONE_THREAD

Result = TypeVar("Result")


def exit_code_of(work: Callable[[], int]) -> int:
    """The exit code of the work; a mistake of the user's is told on one screen."""
    try:
        return work()
    except TrmsError as error:
        sys.stderr.write(describe_error(error, colour=sys.stderr.isatty()))
        return error.exit_code
    except KeyboardInterrupt as error:
        return interrupted_code(error)


def recorded_parser(chapter: str, about: str | None, study: Path) -> argparse.ArgumentParser:
    """The options of a study whose figures are recorded: part of it, elsewhere, or anew."""
    parser = argparse.ArgumentParser(prog=f"python -m experiments.{chapter}", description=about)
    parser.add_argument("--quick", action="store_true", help="a part of it, in seconds")
    parser.add_argument("--out", type=Path, help="figures, tables and JSON go there")
    parser.add_argument(
        "--update",
        action="store_true",
        help=f"record the figures, write docs/{chapter}.md's tables",
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--study", type=Path, default=study, help="another study.yaml")
    return parser


def refuse_part(arguments: argparse.Namespace) -> None:
    """What is recorded is all of it.

    Raises ConfigurationError for ``--update`` with ``--quick`` or ``--out``.
    """
    if arguments.update and (arguments.quick or arguments.out):
        raise ConfigurationError(
            "what is recorded is the whole study, in its own place",
            where="--update",
            remedy="leave out --quick and --out",
        )


def one_thread_each() -> None:
    """Processes begun from here on compute in one thread."""
    os.environ.update(ONE_THREAD)


def progress_with_time() -> Callable[[str], None]:
    """What tells how far a study is, with the seconds since now."""
    begin = perf_counter()

    def report(what: str) -> None:
        sys.stdout.write(f"{perf_counter() - begin:6.1f} s  {what}\n")
        sys.stdout.flush()

    return report


class RunsBar:
    """A rich bar on standard error if that is a terminal: runs that are done, of so many."""

    def __init__(self, total: int) -> None:
        from rich.console import Console
        from rich.progress import Progress

        console = Console(file=sys.stderr)
        self._bar = Progress(console=console, transient=True, disable=not console.is_terminal)
        self._task = self._bar.add_task("runs", total=total)

    def __enter__(self) -> Any:
        self._bar.start()
        return lambda name: self._bar.update(self._task, advance=1, description=name)

    def __exit__(self, *error: object) -> None:
        self._bar.stop()


def side_by_side(
    work: Callable[..., Result],
    tasks: Mapping[str, tuple[Any, ...]],
    jobs: int,
    tasks_of_a_process: int,
) -> Iterator[tuple[str, Future[Result]]]:
    """Do some tasks at a time in processes of their own; yields each when it is done, by name.

    No more than ``jobs`` are handed in at once: a pool that replaces its processes, so that what
    tasks leave behind in memory does not pile up, stands still where others wait in its queue
    (CPython issue 115634). An interrupt, or whoever stops listening, cancels the rest.
    """
    # before the processes begin: they load NumPy before anything else is called in them
    one_thread_each()
    waiting = list(tasks.items())[::-1]
    running: dict[Future[Result], str] = {}
    pools = [process_pool(jobs, tasks_of_a_process)]
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                name, arguments = waiting.pop()
                try:
                    future = pools[-1].submit(work, *arguments)
                except BrokenProcessPool:  # a process was killed: what it did is told as failed
                    pools.append(process_pool(jobs, tasks_of_a_process))
                    future = pools[-1].submit(work, *arguments)
                running[future] = name
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future
    finally:
        for pool in pools:
            pool.shutdown(wait=not running, cancel_futures=True)


def process_pool(jobs: int, tasks_of_a_process: int | None = None) -> ProcessPoolExecutor:
    """Fresh processes, also where forking is usual: CasADi's threads do not survive a fork.

    ``tasks_of_a_process``: after so many tasks a process is replaced; None: never.
    """
    return ProcessPoolExecutor(
        jobs,
        mp_context=get_context("spawn"),
        initializer=_end_with_parent,
        max_tasks_per_child=tasks_of_a_process,
    )


def _end_with_parent() -> None:
    """End this process when its parent is gone, however that ended.

    The queue of tasks does not tell: the end that is written to stays open in the other processes.
    """
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(EXIT_TERMINATED)

    threading.Thread(target=watch, daemon=True).start()
