"""Compiles an exported folder and runs its example: sizes, agreement and times of this machine."""

import os
import platform
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from trms_cli.core.errors import TrmsError

FLAGS = ("-std=c99", "-O3")
WARNINGS = ("-Wall", "-Wextra", "-pedantic")
PASSES = 5
_TIMEOUT = 600.0  # s


@dataclass(frozen=True)
class ExampleMeasurement:
    """What the example said."""

    compiler: str
    processor: str
    samples: int  #: Steps
    failed: int  #: Those that ended in a fall-back
    largest_difference: float  #: V, to the Python controller's commands
    median: float  #: Of the times of a step, µs
    p99: float  #: µs
    longest: float  #: µs
    slowest: float  #: µs, of the sample that takes longest, in the least disturbed of its passes
    #: ``observer_median``, ``observer_p99``, ``observer_longest``: µs, of a sample of the observer;
    #: None without one
    observer_median: float | None
    observer_p99: float | None
    observer_longest: float | None
    context_bytes: int  #: Of the structs
    observer_bytes: int  #: 0 without an observer
    #: Of the object file: instructions and constants, and what is written to
    code_bytes: int | None
    data_bytes: int | None  #: None where ``size`` is missing
    #: Sum of all stack frames: no call needs more. None where the compiler does not say.
    stack_bytes: int | None


def measure(folder: Path, name: str, compiler: str, passes: int = PASSES) -> ExampleMeasurement:
    """Build in a folder of its own and run, so many times through the samples.

    Raises TrmsError if the source does not compile here or the example fails.
    """
    build = folder / "build"
    build.mkdir()
    try:
        return _measured(folder, build, name, compiler, passes)
    finally:
        shutil.rmtree(build, ignore_errors=True)


def _measured(
    folder: Path, build: Path, name: str, compiler: str, passes: int
) -> ExampleMeasurement:
    source, include = folder.resolve(), f"-I{folder.resolve()}"
    stack = ["-fstack-usage"] if _knows(compiler, "-fstack-usage", build) else []
    compile_ = [compiler, *FLAGS, *WARNINGS, include, "-c"]
    _run([*compile_, *stack, str(source / f"{name}.c")], build)
    _run([*compile_, str(source / f"{name}_example.c")], build)
    program = f"{name}_example"
    _run([compiler, "-o", program, f"{name}.o", f"{name}_example.o", "-lm"], build)
    output = _run([f"./{program}", str(source / "example.csv"), str(passes)], build)
    figures = dict(line.split() for line in output.splitlines())
    code, data = _sizes(build.resolve() / f"{name}.o", build)
    return ExampleMeasurement(
        compiler=_run([compiler, "--version"], build).splitlines()[0],
        processor=_processor(),
        samples=int(figures["samples"]),
        failed=int(figures["failed"]),
        largest_difference=float(figures["largest_difference_V"]),
        median=float(figures["median_us"]),
        p99=float(figures["p99_us"]),
        longest=float(figures["max_us"]),
        slowest=float(figures["slowest_us"]),
        observer_median=_number(figures.get("observer_median_us")),
        observer_p99=_number(figures.get("observer_p99_us")),
        observer_longest=_number(figures.get("observer_max_us")),
        context_bytes=int(figures["context_bytes"]),
        observer_bytes=int(figures.get("observer_bytes", 0)),
        code_bytes=code,
        data_bytes=data,
        stack_bytes=_stack(build / f"{name}.su"),
    )


def _number(word: str | None) -> float | None:
    return None if word is None else float(word)


def _run(command: list[str], folder: Path) -> str:
    try:
        result = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, timeout=_TIMEOUT, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise TrmsError(
            f"{Path(command[0]).name} could not be run: {error}",
            where="measure",
            remedy="measure=false writes the source alone",
        ) from error
    if result.returncode:
        raise TrmsError(
            f"{Path(command[0]).name} ended with {result.returncode}: "
            f"{result.stderr.strip()[:600]}",
            where="measure",
            remedy="measure=false writes the source alone",
        )
    return result.stdout


def _knows(compiler: str, flag: str, folder: Path) -> bool:
    command = [compiler, flag, "-Werror", "-x", "c", "-c", os.devnull, "-o", "probe.o"]
    try:
        result = subprocess.run(command, cwd=folder, capture_output=True, timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return result.returncode == 0


def _sizes(file: Path, folder: Path) -> tuple[int | None, int | None]:
    program = shutil.which("size")
    if program is None:
        return None, None
    lines = _run([program, str(file)], folder).splitlines()
    try:
        text, data, bss = (int(word) for word in lines[1].split()[:3])
    except (IndexError, ValueError):
        return None, None
    return text, data + bss


def _stack(file: Path) -> int | None:
    if not file.is_file():
        return None
    return sum(int(line.split("\t")[1]) for line in file.read_text().splitlines() if line)


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
