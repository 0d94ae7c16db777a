"""A picture of a sweep in characters: its jobs, how fast they come, the best and the failed."""

import math
import shlex
from pathlib import Path

from rich.text import Text

from trms_cli.commands.watch.frame import between, fit_line, tail_of
from trms_cli.core.invocation import program
from trms_cli.sweeps.outcome import Job, SweepFollower, SweepState

#: Of a sweep whose process has gone; ``trms sweep status`` says the same.
STOPPED = "stopped before its end"
_SILENT = 30.0  # s without a word from a job, after which that is told
_COLUMNS = {
    "done": "green",
    "failed": "bold red",
    "lost": "bold red",
    "interrupted": "yellow",
    "gone": "bold red",
}


def sweep_frame(sweep: SweepState, width: int, height: int, *, plain: bool = False) -> list[Text]:
    """The lines of the picture: at most `height` of at most `width` columns each."""
    lines = [_title(sweep, width), _progress(sweep, width, plain), _speed(sweep), Text("")]
    if sweep.stopped:
        folder = shlex.quote(str(sweep.folder))
        lines[3:3] = [Text(f"to go on  {program()} sweep resume {folder}")]
    room = max(1, (height - len(lines) - 4) // 3)
    lines += _running(sweep, room)
    lines += _best(sweep, room)
    lines += _failures(sweep, room)
    return [fit_line(line, width, plain) for line in lines[:height]]


def sweep_line(sweep: SweepState) -> str:
    """The picture in one line, for a file or a pipe."""
    of = "" if sweep.total is None else f" of {sweep.total}"
    parts = [f"{sweep.count('done')}{of} done", *_troubles(sweep)]
    parts.append(STOPPED if sweep.stopped else f"{sweep.count('running')} running")
    if not math.isnan(sweep.rate):
        parts.append(_per_time(sweep.rate))
    if sweep.count("running") and not sweep.has_ended and not math.isnan(sweep.left_s):
        parts.append(f"{_duration(sweep.left_s)} left")
    if sweep.best:
        parts.append(f"best {sweep.best[0].objective:.4g} ({_what(sweep, sweep.best[0])})")
    return " | ".join(parts)


def _title(sweep: SweepState, width: int) -> Text:
    words, style = "running", "bold green"
    if sweep.stopped:
        words, style = STOPPED, "bold red"
    elif sweep.count("gone") and not sweep.count("running"):
        words, style = "died: the process of a running job is gone", "bold red"
    elif sweep.has_ended:
        words, style = "ended", "bold cyan"
    folder = tail_of(str(sweep.folder), max(20, width - len(words) - 8))
    return between(Text(f"sweep {folder}", "bold"), Text(words, style), width)


def _progress(sweep: SweepState, width: int, plain: bool) -> Text:
    of = "" if sweep.total is None else f" / {sweep.total}"
    begin = f"{sweep.count('done')}{of} done "
    line = Text(begin)
    remaining = 0 if sweep.total is None else sweep.total - len(sweep.jobs)
    words = [f"{sweep.count('running')} running", *_troubles(sweep)]
    words += [f"{remaining} not begun"] if sweep.stopped and remaining > 0 else []
    if sweep.total:
        cells = max(4, min(60, width - len(begin) - sum(len(each) + 2 for each in words)))
        signs = {"done": "=", "failed": "!", "running": ">"} if plain else {}
        used = 0
        for states, name, style in (
            (("done",), "done", "green"),
            (("failed", "lost", "interrupted", "gone"), "failed", "red"),
            (("running",), "running", "yellow"),
        ):
            count = sweep.count(*states)
            part = min(cells - used, max(bool(count), round(cells * count / sweep.total)))
            line.append(signs.get(name, "━") * part, style)
            used += part
        line.append(("-" if plain else "─") * (cells - used), "dim")
    for each in words:
        line.append(f"  {each}", "" if each.endswith("running") else "red")
    return line


def _troubles(sweep: SweepState) -> list[str]:
    counts = [(sweep.count(state), state) for state in ("failed", "lost", "interrupted", "gone")]
    return [f"{count} {state}" for count, state in counts if count]


def _speed(sweep: SweepState) -> Text:
    parts = [] if math.isnan(sweep.rate) else [_per_time(sweep.rate)]
    if not sweep.has_ended and not math.isnan(sweep.left_s):
        parts.append(f"{_duration(sweep.left_s)} left")
    if sweep.total is None and not sweep.has_ended:
        parts.append("how many there will be is not known")
    line = Text(" · ".join(parts))
    last = max((job.last_change for job in sweep.jobs), default=sweep.now)
    if not sweep.has_ended and sweep.now - last > _SILENT:
        line.append(f"  no word for {_duration(sweep.now - last)}", "yellow")
    return line


def _running(sweep: SweepState, room: int) -> list[Text]:
    running = [job for job in sweep.jobs if job.state == "running"]
    if not running:
        return []
    lines = [Text("running", "bold")]
    for job in running[:room]:
        since = _duration(max(0.0, sweep.now - job.last_change))
        lines.append(Text(f"  {job.name:>6}  {_what(sweep, job)}  for {since}"))
    return lines


def _best(sweep: SweepState, room: int) -> list[Text]:
    best = sweep.best[:room]
    if not best:
        return []
    lines = [Text("best so far (objective: smaller is better)", "bold")]
    return lines + [
        Text.assemble(f"  {job.name:>6}  ", (f"{job.objective:<10.4g}", "green"), _what(sweep, job))
        for job in best
    ]


def _failures(sweep: SweepState, room: int) -> list[Text]:
    failed = sweep.failures[:room]
    if not failed:
        return []
    lines = [Text("not done, the latest first", "bold")]
    for job in failed:
        problem = job.problem.splitlines()[0] if job.problem else _REASONS.get(job.state, "")
        line = Text(f"  {job.name:>6}  ").append(job.state, _COLUMNS.get(job.state, ""))
        lines.append(line.append(f"  {_what(sweep, job)}").append(f"  {problem}", "dim"))
    return lines


_REASONS = {"gone": "its process is not on this machine any more"}


def _what(sweep: SweepState, job: Job) -> str:
    """What was typed for a job, without what all jobs share."""
    shared = {word.lower() for word in sweep.overrides}  # a sweep turns `false` into `False`
    own = [word for word in job.overrides if word.lower() not in shared]
    return " ".join(own) or Path(job.name).name


def _per_time(rate: float) -> str:
    return f"{rate:.3g} jobs/s" if rate >= 1 else f"{60 * rate:.3g} jobs/min"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(max(0.0, seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


class SweepPlayer:
    """A sweep on the screen; see :class:`trms_cli.commands.watch.screen.WatchScreen`."""

    _LOOK = 0.5  # s between two looks at its folder

    def __init__(self, sweep: SweepFollower, *, plain: bool) -> None:
        self._sweep, self._plain = sweep, plain
        self.now: SweepState = sweep.now()
        self._waited = 0.0

    def advance(self, seconds: float) -> None:
        self._waited += seconds
        if self._waited >= self._LOOK:
            self.now, self._waited = self._sweep.now(), 0.0

    def press(self, key: str) -> bool:
        return key not in ("q", "Q")

    def frame(self, width: int, height: int, *, keys: bool) -> list[Text]:
        if not keys:
            return sweep_frame(self.now, width, height, plain=self._plain)
        lines = sweep_frame(self.now, width, height - 1, plain=self._plain)
        return [*lines, Text("q quit", "dim")]

    def line(self) -> str:
        return sweep_line(self.now)

    def is_over(self, *, keys: bool) -> bool:
        return self.now.has_ended
