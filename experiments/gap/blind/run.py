"""``trms blind run``: every recording of a sealed set diagnosed, in processes of their own.

A recording is diagnosed as ``trms diagnose`` would from a shell, in one thread, against those of a
known state where the set has some of the same rig. Its folder appears once the diagnosis is whole;
what has one is not done again. The key is nowhere opened here.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time
from typing import Annotated, Literal

from msgspec import Meta

from experiments.command_line import side_by_side
from trms_cli.composition.composer import Composition
from trms_cli.composition.overrides import default_words
from trms_cli.core.errors import EXIT_OK, ConfigurationError, RecordingError, TrmsError
from trms_cli.core.plugins import construct
from trms_cli.runs.run_folder import hold, in_use

#: In the folder of a diagnosis: what it says, what was printed on the way, how long it took.
DOCUMENT_NAME, LOG_NAME, TIMING_NAME = "diagnosis.json", "printed.txt", "blind.json"
#: Exit code of a run in which some recordings could not be diagnosed.
EXIT_SOME_FAILED = 1
#: Recordings that a process diagnoses before another takes its place.
_TASKS = 12


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """The keys of ``configs/blind_run.yaml``."""

    #: ``source``, ``out``: Folders of the set (``in``) and of the diagnoses
    source: str
    out: str
    overrides: tuple[str, ...] = ()  #: Of each diagnosis (``with``)
    effort: Literal["quick", "normal", "thorough"] = "normal"
    jobs: Annotated[int, Meta(ge=1)] = 2  #: Recordings at once
    cases: Annotated[int, Meta(ge=1)] | None = None  #: None: all


def perform(composition: Composition) -> int:
    """Diagnose what a configuration asks for, and what is not diagnosed yet."""
    keys = dict(composition.config)
    node = {"source": keys.pop("in"), "overrides": keys.pop("with"), **keys}
    options = construct(RunOptions, node)
    recordings = recordings_of(Path(options.source).expanduser())[: options.cases]
    out = Path(options.out).expanduser()
    _make_folder(out)
    own = default_words(options.overrides, "diagnose")  # in the folder of a rig
    words = [f"effort={options.effort}", *own, *options.overrides]
    for folder in composition.config_dirs:
        words += ["--config-dir", str(folder)]
    waiting = [r for r in recordings if not (out / r.stem / DOCUMENT_NAME).is_file()]
    diagnosed_count = len(recordings) - len(waiting)
    if diagnosed_count:
        print(f"{diagnosed_count} of {len(recordings)} are diagnosed already")
    failed = diagnose_all(
        waiting, out, words, options.jobs, _ProgressLines(len(waiting), options.jobs)
    )
    print(f"{len(recordings) - len(failed)} diagnoses in {out}")
    for name, why in failed.items():
        print(f"  {name}: {why}")
    return EXIT_SOME_FAILED if failed else EXIT_OK


def recordings_of(folder: Path) -> list[Path]:
    """The recordings of a set, by name.

    Raises ConfigurationError if there is none.
    """
    from experiments.gap.blind.sealing import RECORDINGS

    recordings = sorted((folder / RECORDINGS).glob("*.csv"))
    if not recordings:
        raise ConfigurationError(
            f"there are no recordings in {str(folder / RECORDINGS)!r}",
            where="in",
            remedy="in=DIR names the folder that `trms blind make` wrote",
        )
    return recordings


def diagnose_all(
    recordings: Sequence[Path],
    out: Path,
    words: Sequence[str],
    jobs: int,
    report: Callable[[str, str], None],
) -> dict[str, str]:
    """Diagnose recordings, some at once.

    Returns why, by name, for those that could not be diagnosed.
    """
    failed: dict[str, str] = {}
    tasks = {r.stem: (r, out, list(words)) for r in recordings}
    for name, future in side_by_side(_diagnose, tasks, jobs, _TASKS):
        problem = future.exception()
        message = future.result() if problem is None else _why(problem)
        if problem is not None:
            failed[name] = message
        report(name, message)
    return failed


def _diagnose(recording: Path, out: Path, words: list[str]) -> str:
    """One diagnosis; its verdict in a few words."""
    import json
    import shutil
    from contextlib import redirect_stderr, redirect_stdout

    from experiments.gap.blind.sealing import references_beside
    from trms_cli.commands import diagnose
    from trms_cli.composition.composer import compose
    from trms_cli.composition.overrides import quote_value

    draft = out / f".{recording.stem}"
    shutil.rmtree(draft, ignore_errors=True)
    overrides = [f"real={recording.resolve()}", "jobs=1", "page=false", *words]
    references = references_beside(recording.resolve())
    if references:
        overrides.append(f"against=[{','.join(quote_value(str(path)) for path in references)}]")
    composition = compose([*overrides, f"out={draft.resolve()}"], diagnose.COMPOSES)
    begin, computed = perf_counter(), process_time()
    printed = out / f".{recording.stem}.txt"
    try:
        with (
            printed.open("w", encoding="utf-8") as sink,
            redirect_stdout(sink),
            redirect_stderr(sink),
        ):
            diagnose.perform(composition)
        printed.replace(draft / LOG_NAME)
    finally:
        printed.unlink(missing_ok=True)
    document = json.loads((draft / DOCUMENT_NAME).read_text(encoding="utf-8"))
    took = {
        "seconds": round(perf_counter() - begin, 2),
        "processor_seconds": round(process_time() - computed, 2),
    }
    (draft / TIMING_NAME).write_text(json.dumps(took) + "\n", encoding="utf-8")
    draft.replace(out / recording.stem)
    return str(document["verdict"])


def _why(problem: BaseException) -> str:
    if isinstance(problem, TrmsError):
        return str(problem)
    return f"{type(problem).__name__}: {problem}"


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        if not hold(out):
            raise in_use(out)
    except OSError as error:
        raise RecordingError(
            f"cannot be made: {error.strerror or error}",
            where=str(out),
            remedy="name a folder that you can write to: out=FOLDER",
        ) from error


class _ProgressLines:
    """A line a recording: how many are done, and how long the rest will take."""

    def __init__(self, number: int, jobs: int) -> None:
        self._number, self._jobs = number, jobs
        self._count, self._begin = 0, perf_counter()

    def __call__(self, name: str, message: str) -> None:
        self._count += 1
        spent = perf_counter() - self._begin
        rest = spent / self._count * (self._number - self._count)
        sys.stderr.write(
            f"{self._count:4d} of {self._number}  {name}  {message:16}  "
            f"{spent / 60:.1f} min, {rest / 60:.0f} min to go\n"
        )
        sys.stderr.flush()
