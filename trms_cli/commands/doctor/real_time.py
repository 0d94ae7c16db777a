"""What a machine lacks for real time, and how late its wake-ups are: ``trms doctor --jitter``.

Both are those of the loop: the wake-ups by :class:`trms_cli.simulation.pace.Pace`, with as much of
the machine as :func:`trms_cli.simulation.pace.undisturbed` is given.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trms_cli.commands.doctor.check import OK, SLOWER, Check
from trms_cli.core.wording import count, number, percent
from trms_cli.simulation.pace import IN_TIME, Clock, LatePolicy, Pace, undisturbed

RATES = (50.0, 200.0)  #: Hz; the loop's default, and what a fast rig takes
DURATIONS = (0.1, 3600.0)  #: s, of all rates together
#: For /etc/security/limits.d, and where that is not read.
_LIMITS = (
    "sudo groupadd -f realtime; sudo usermod -aG realtime $USER; write "
    "`@realtime - {item} {value}` into /etc/security/limits.d/99-realtime.conf; log in anew "
    "(container: {container})"
)


@dataclass(frozen=True)
class Jitter:
    """How late wake-ups were that were due at a rate. Times in s."""

    rate: float  #: Hz
    wake_ups: int
    median: float  #: s
    p99: float  #: s
    worst: float  #: s
    tolerance: float  #: s, from which on the loop counts a sample as late
    late_share: float  #: of the wake-ups, that were later than that


@dataclass(frozen=True)
class Measurement:
    """What came of a measurement, and what the machine gave for it."""

    jitter: tuple[Jitter, ...]
    is_first_in_line: bool  #: Whether it ran under SCHED_FIFO
    is_locked: bool  #: Whether no memory could be paged out
    refusals: tuple[str, ...]  #: What the machine did not give, in words


def measure(duration: float, clock: Clock | None = None) -> Measurement:
    """Wake up at each of :data:`RATES`, for equal parts of a time (s).

    ``clock``: another than the machine's, in tests.
    """
    with undisturbed() as refusals:
        is_first = sys.platform == "linux" and os.sched_getscheduler(0) == os.SCHED_FIFO
        is_locked = _locked_memory() > 0
        jitter = tuple(_jitter(rate, duration / len(RATES), clock) for rate in RATES)
    return Measurement(jitter, is_first, is_locked, tuple(refusals))


def _jitter(rate: float, duration: float, clock: Clock | None) -> Jitter:
    policy = LatePolicy()
    pace = Pace(1.0 / rate, policy, clock)
    lateness = np.zeros(max(2, round(rate * duration)))
    pace.begin()
    pace.step()  # due now: nothing was waited for
    for i in range(len(lateness)):
        pace.step()
        lateness[i] = pace.lateness
    return Jitter(
        rate,
        len(lateness),
        float(np.median(lateness)),
        float(np.quantile(lateness, 0.99)),
        float(lateness.max()),
        IN_TIME,
        float(np.mean(lateness > IN_TIME)),
    )


def _locked_memory() -> int:
    """kB of this process that cannot be paged out."""
    for line in _text(Path("/proc/self/status")).splitlines():
        if line.startswith("VmLck:"):
            return int(line.split()[1])
    return 0


def lines_of(jitter: tuple[Jitter, ...]) -> list[Check]:
    """The measurement as lines of the report."""
    return [
        Check(
            f"{each.rate:g} Hz",
            SLOWER if each.late_share > 0 else OK,
            f"late by {_ms(each.median)} in the median, {_ms(each.p99)} at 99 %, "
            f"{_ms(each.worst)} at worst; {percent(each.late_share, 1)} of "
            f"{count(each.wake_ups, 'wake-up')} by more than {_ms(each.tolerance)}",
        )
        for each in jitter
    ]


def document_of(jitter: tuple[Jitter, ...]) -> list[dict[str, float | int]]:
    """The measurement for programs, units in the keys."""
    return [
        {
            "rate_hz": each.rate,
            "wake_ups": each.wake_ups,
            "median_s": each.median,
            "p99_s": each.p99,
            "worst_s": each.worst,
            "tolerance_s": each.tolerance,
            "late_share": each.late_share,
        }
        for each in jitter
    ]


def _ms(seconds: float) -> str:
    return f"{number(1e3 * seconds, 2)} ms"


def machine(measurement: Measurement, root: Path = Path("/")) -> list[Check]:
    """What the machine offers for real time, and what to do about the rest.

    ``root``: the folder that ``proc`` and ``sys`` lie in.
    """
    if sys.platform != "linux":
        return [Check("real time", SLOWER, f"{sys.platform}: looked at on Linux alone")]
    return [
        _scheduling(measurement),
        _memory(measurement),
        _kernel(root),
        _isolated(root),
        *_governor(root),
        _swap(root),
        *_virtual(root),
        _load(),
    ]


def _scheduling(measurement: Measurement) -> Check:
    what = "SCHED_FIFO"
    if measurement.is_first_in_line:
        return Check(what, OK, "allowed: the loop goes before ordinary processes")
    remedy = _LIMITS.format(
        item="rtprio", value="95", container="--cap-add=sys_nice --ulimit rtprio=95"
    )
    return Check(what, SLOWER, _refusal(measurement, what, _limit("RLIMIT_RTPRIO")), remedy)


def _memory(measurement: Measurement) -> Check:
    what = "mlockall"
    if measurement.is_locked:
        return Check(what, OK, "allowed: no memory is paged out")
    remedy = _LIMITS.format(item="memlock", value="unlimited", container="--ulimit memlock=-1")
    return Check(what, SLOWER, _refusal(measurement, what, _limit("RLIMIT_MEMLOCK")), remedy)


def _refusal(measurement: Measurement, what: str, limit: str) -> str:
    words = next((words for words in measurement.refusals if what in words), "not allowed")
    return f"{words}; its limit is {limit}"


def _limit(name: str) -> str:
    import resource

    value = resource.getrlimit(getattr(resource, name))[0]
    return "none" if value == resource.RLIM_INFINITY else str(value)


def _kernel(root: Path) -> Check:
    release = _text(root / "proc/sys/kernel/osrelease").strip()
    version = _text(root / "proc/version")
    if _text(root / "sys/kernel/realtime").strip() == "1" or "PREEMPT_RT" in version:
        return Check("kernel", OK, f"{release}, PREEMPT_RT")
    return Check(
        "kernel",
        SLOWER,
        f"{release}, without PREEMPT_RT",
        "for the last tenths of a millisecond (Debian: `apt install linux-image-rt-amd64`; "
        "Ubuntu: `pro enable realtime-kernel`)",
    )


def _isolated(root: Path) -> Check:
    cores = _text(root / "sys/devices/system/cpu/isolated").strip()
    if not cores:
        return Check(
            "isolated cores",
            SLOWER,
            "none",
            "kernel parameters isolcpus=3 nohz_full=3 keep others off core 3; then start by "
            "`taskset -c 3 trms run …`",
        )
    if _numbers(cores) & os.sched_getaffinity(0):
        return Check("isolated cores", OK, f"{cores}, and this process may run there")
    remedy = f"start by `taskset -c {min(_numbers(cores))} trms run …`"
    return Check("isolated cores", SLOWER, f"{cores}, but this process does not run there", remedy)


def _numbers(cores: str) -> set[int]:
    """Of a list as the kernel writes it: ``1,3-5``."""
    numbers: set[int] = set()
    for part in cores.split(","):
        first, _, last = part.partition("-")
        numbers |= set(range(int(first), int(last or first) + 1))
    return numbers


def _governor(root: Path) -> Iterator[Check]:
    files = sorted((root / "sys/devices/system/cpu").glob("cpu*/cpufreq/scaling_governor"))
    names = sorted({_text(file).strip() for file in files})
    if names in ([], ["performance"]):
        words = "the clock of the processor is not steered here" if not names else names[0]
        yield Check("CPU governor", OK, words)
        return
    remedy = "sudo cpupower frequency-set -g performance; it is slow to wake up otherwise"
    yield Check("CPU governor", SLOWER, ", ".join(names), remedy)


def _swap(root: Path) -> Check:
    areas = [line.split()[0] for line in _text(root / "proc/swaps").splitlines()[1:] if line]
    if not areas:
        return Check("swap", OK, "none")
    remedy = "sudo swapoff -a for the run, where mlockall is not allowed"
    return Check("swap", SLOWER, ", ".join(areas), remedy)


def _virtual(root: Path) -> Iterator[Check]:
    processors = _text(root / "proc/cpuinfo")
    flags = next((line for line in processors.splitlines() if line.startswith("flags")), "")
    if "hypervisor" in flags.split():
        product = _text(root / "sys/class/dmi/id/product_name").strip()
        yield Check(
            "virtual machine",
            SLOWER,
            f"yes{f' ({product})' if product else ''}: its host may take the processor away",
            "drive a rig from a machine of its own",
        )
    elif flags:
        yield Check("virtual machine", OK, "no")


def _load() -> Check:
    load, cores = os.getloadavg()[0], len(os.sched_getaffinity(0))
    words = f"{load:.1f} processes want {count(cores, 'core')} (mean of the last minute)"
    if load > cores - 0.5:
        return Check("load", SLOWER, words, "end what else is running while a rig is driven")
    return Check("load", OK, words)


def _text(file: Path) -> str:
    """The content of a file; empty where there is none."""
    try:
        return file.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
