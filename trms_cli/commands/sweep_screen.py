"""What a person sees of a sweep: one line while it goes on, then the counts and what to do next."""

from __future__ import annotations

import json
import math
import shlex
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from time import monotonic
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from trms_cli.commands.progress_line import ProgressLine
from trms_cli.core.errors import TrmsError
from trms_cli.core.invocation import program

if TYPE_CHECKING:
    from trms_cli.sweeps.driver import Progress
    from trms_cli.sweeps.point import Result

_MOST_NOTES = 10
_MOST_REASONS = 5
_MOST_NUMBERS = 6
_EVERY = 0.2  # s between two lines


class SweepScreen:
    """Progress on standard error if that is a terminal; the outcome on standard output.

    Parameters
    ----------
    as_json : bool
        Print the outcome as one JSON document.
    """

    def __init__(self, *, as_json: bool = False) -> None:
        self._as_json = as_json
        self._line = ProgressLine()
        self._stack = ExitStack()
        self._last = -math.inf
        self._notes: set[str] = set()
        self._folder: Path | None = None

    def __enter__(self) -> Self:
        from trms_cli.commands.sweep_work import termination

        self._stack.enter_context(termination())
        self._stack.enter_context(self._line)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.close()
        if self._folder is None or error is None:
            return
        if isinstance(error, (KeyboardInterrupt, TrmsError)):
            words = "interrupted" if isinstance(error, KeyboardInterrupt) else "not completed"
            folder = shlex.quote(str(self._folder))
            sys.stderr.write(
                f"\n{words}; nothing that is done is lost\n"
                f"  how it stands  {program()} sweep status {folder}\n"
            )
            # What is asked of the sampler stands; going on would end with the same error.
            if not getattr(error, "where", "").startswith("sampler"):
                sys.stderr.write(f"  to go on       {program()} sweep resume {folder}\n")

    def say_begun(self, folder: Path) -> None:
        """The record stands; from here on the sweep can be resumed."""
        self._folder = folder

    def tell(self, progress: Progress, result: Result | None) -> None:
        """How far it is; what runs would have told, each line once."""
        for note in result.notes if result is not None else ():
            if note not in self._notes and len(self._notes) < _MOST_NOTES:
                self._notes.add(note)
                sys.stderr.write(f"\r{note}\n")
        here = monotonic()
        if here - self._last >= _EVERY:
            self._last = here
            self._line.tell(line_of(progress))

    def say_ended(self, folder: Path) -> None:
        """The outcome, from the folder."""
        from trms_cli.commands.sweep_outcome import outcome_of

        document = outcome_of(folder)
        if document["summary"]:
            from trms_cli.commands import sweep_summary

            sweep_summary.draw(folder, document["summary"])
        if self._as_json:
            sys.stdout.write(json.dumps(document, ensure_ascii=False, indent=2) + "\n")
        else:
            say_outcome(document)


def line_of(progress: Progress) -> str:
    """``37 of 1000 done · 2 failed · 6.3 runs/s · 2 min 33 s left``."""
    counts = progress.counts
    of = "" if progress.total is None else f" of {progress.total}"
    parts = [f"{counts.get('done', 0)}{of} done"]
    parts += [f"{counts[state]} {state}" for state in ("failed", "lost") if counts.get(state)]
    if progress.retried:
        parts.append(f"{progress.retried} tried again")
    if progress.total is not None:
        parts.append(f"{max(0, progress.total - progress.ended)} left")
    if progress.rate > 0 and progress.ended > progress.before + 1:
        parts.append(rate_words(progress.rate))
        if progress.total is not None:
            parts.append(f"{duration_words((progress.total - progress.ended) / progress.rate)}")
    parts.append(f"{progress.workers} worker{'s' if progress.workers != 1 else ''}")
    return " · ".join(parts)


def rate_words(rate: float) -> str:
    """``6.3 runs/s``, ``12 runs/min``."""
    return f"{rate:.3g} runs/s" if rate >= 1 else f"{60 * rate:.3g} runs/min"


def duration_words(seconds: float) -> str:
    """``45 s``, ``2 min 33 s``, ``3 h 20 min``."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def say_outcome(document: Mapping[str, Any]) -> None:
    """Print how a sweep stands (`trms.sweep-status/1`)."""
    folder, counts, total = document["folder"], document["counts"], document["total"]
    of = "" if total is None else f" of {total}"
    troubles = [
        f"{counts[state]} {state}"
        for state in ("failed", "lost", "interrupted", "running", "left")
        if counts.get(state)
    ]
    print(f"sweep      {', '.join([str(counts['done']) + of + ' runs done', *troubles])}")
    for line in document["told"]:
        print(f"  {line}")
    if document["state"] != "done":
        words = "going on" if document["driven"] else "stopped before its end"
        print(f"           {words}")
    if document["rate"]:
        retried = f", {document['retried']} tried again" if document["retried"] else ""
        print(f"rate       {rate_words(document['rate'])}{retried}")
    for failure in document["failures"][:_MOST_REASONS]:
        numbers = ", ".join(map(str, failure["runs"][:_MOST_NUMBERS]))
        more = ", …" if failure["count"] > _MOST_NUMBERS else ""
        where = f"{failure['where']}: " if failure["where"] else ""
        print(f"{failure['state']:10} {failure['count']}×  {where}{failure['problem']}")
        if failure["remedy"]:
            for line in failure["remedy"].splitlines():
                print(f"           {line}")
        print(f"           run {numbers}{more}")
    if len(document["failures"]) > _MOST_REASONS:
        print(f"           and {len(document['failures']) - _MOST_REASONS} other reasons (--json)")
    if not document["summary"]:
        _say_best(document)
    _say_summary(document)
    print(f"folder     {folder}")
    print()
    quoted, trms = shlex.quote(str(folder)), program()
    going_on = counts.get("left") or counts.get("interrupted") or document["state"] != "done"
    if going_on and not document["driven"]:
        print(f"next       {trms} sweep resume {quoted}")
    elif document["driven"]:
        print(f"next       {trms} watch {quoted}")
    elif any(not failure.get("bad_input") for failure in document["failures"]):
        print(f"next       {trms} sweep resume {quoted} --retry-failed")
    elif document["failures"]:
        print(
            "next       mend what was typed and make the sweep anew: each of these runs would fail"
        )
        print("           again of the same")
    elif document["primary"] == "run":
        print(f"next       {trms} compare {quoted}")
        print(f"           {trms} runs --in {quoted} --sort rmse")


def _say_best(document: Mapping[str, Any]) -> None:
    from trms_cli.commands.sweep_outcome import few

    best = document["best"]
    if best is not None and document["counts"]["done"] > 1:
        words = few(best["overrides"])
        print(f"best       run {best['run']}  {best['objective']:.4g}  {words}")


def _say_summary(document: Mapping[str, Any]) -> None:
    """What the sampler found, in the words of its own screen."""
    if document["summary"]:
        from trms_cli.commands import sweep_summary

        sweep_summary.say(document)
