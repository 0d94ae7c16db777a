"""``trms doctor``: whether this machine is ready, and what to install."""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from trms_cli import __version__
from trms_cli.commands.doctor.check import BROKEN, OK, SLOWER, Check
from trms_cli.commands.plain_options import PlainOptions
from trms_cli.core.errors import EXIT_OK, ConfigurationError
from trms_cli.core.printable import print_json

SUMMARY = "tell whether this machine is ready, and what to install"

HELP = """\
usage: trms doctor [--jitter [SECONDS]] [--json]

  Checks Python, the packages, the C compiler, the cache folder, disk, cores and the terminal,
  and tells what to install. Exit code 0: trms works here (a missing compiler only makes it
  slower); 1: it does not.

  --jitter [SECONDS]   also whether it can drive a rig in real time: how late it wakes up at 50 and
                       200 Hz (measured for 10 s), what it lacks, and what to do about that
  --json               the same as JSON (schema trms.doctor/1)
"""

EXIT_NOT_READY = 1
USUAL_DURATION = 10.0  #: s, of a measurement of jitter
OLDEST_PYTHON = (3, 11)
LOW_DISK = 1e9  #: bytes; a run's log takes some 10 MB


def main(argv: Sequence[str]) -> int:
    """Print the findings; exit code 1 when one of them keeps trms from working."""
    options = PlainOptions("trms doctor", HELP)
    options.add_argument("--jitter", nargs="?", type=float, const=USUAL_DURATION)
    options.add_flags("--json")
    arguments = options.parse_args(argv)
    checks = [_python, _packages, _compiler, _cache, _disk, _cores, _terminal]
    findings = [finding for check in checks for finding in check()]
    usable = all(finding.state != BROKEN for finding in findings)
    wake_ups: list[Check] = []
    jitter: list[dict[str, Any]] = []
    if arguments.jitter is not None:
        more, wake_ups, jitter = _real_time(arguments.jitter)
        findings += more
    if arguments.json:
        document: dict[str, Any] = {
            "schema": "trms.doctor/1",
            "trms": __version__,
            "usable": usable,
            "findings": [finding._asdict() for finding in findings],
        }
        if jitter:
            document["jitter"] = jitter
        print_json(document)
    else:
        sys.stdout.write(_report([*findings, *wake_ups], usable))
    return EXIT_OK if usable else EXIT_NOT_READY


def _real_time(duration: float) -> tuple[list[Check], list[Check], list[dict[str, Any]]]:
    """What the machine offers, its wake-ups over a time (s) as lines, and the same as data.

    Raises ConfigurationError for a time that nothing can be measured in.
    """
    from trms_cli.commands.doctor.real_time import (
        DURATIONS,
        document_of,
        lines_of,
        machine,
        measure,
    )

    if not DURATIONS[0] <= duration <= DURATIONS[1]:
        raise ConfigurationError(
            f"{duration:g} s given",
            where="--jitter",
            remedy=f"{DURATIONS[0]:g} to {DURATIONS[1]:g} s",
        )
    if sys.stderr.isatty():
        sys.stderr.write(f"measuring for {duration:g} s …\r")
    measurement = measure(duration)
    jitter = measurement.jitter
    return machine(measurement), lines_of(jitter), document_of(jitter)


def _report(findings: Sequence[Check], usable: bool) -> str:
    lines = [f"trms {__version__}", ""]
    for finding in findings:
        lines.append(f"  {finding.state:7}{finding.what:16}{finding.found}")
        if finding.remedy:
            lines.append(f"  {'':23}→ {finding.remedy}")
    ending = "ready" if usable else "not ready: see the lines marked broken"
    return "\n".join([*lines, "", ending]) + "\n"


def _python() -> list[Check]:
    finding = f"{sys.version.split()[0]} at {sys.executable}"
    if sys.version_info < OLDEST_PYTHON:
        return [Check("Python", BROKEN, finding, "install Python 3.11 or newer")]
    return [Check("Python", OK, finding)]


def _packages() -> list[Check]:
    """Every package that trms requires, as its own metadata lists them, imported or not."""
    from importlib import metadata

    from packaging.requirements import Requirement

    try:
        required = metadata.requires("trms-cli") or []
    except metadata.PackageNotFoundError:
        return [Check("packages", BROKEN, "trms is not installed", "pip install trms-cli")]
    findings: list[Check] = []
    versions: list[str] = []
    for requirement in map(Requirement, required):
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            versions.append(f"{requirement.name} {metadata.version(requirement.name)}")
        except metadata.PackageNotFoundError:
            remedy = f"pip install '{requirement.name}{requirement.specifier}'"
            findings.append(Check(requirement.name, BROKEN, "not installed", remedy))
    rows = [", ".join(versions[i : i + 4]) for i in range(0, len(versions), 4)]
    return [
        *(Check("packages" if i == 0 else "", OK, row) for i, row in enumerate(rows)),
        *findings,
        *_working_casadi(),
    ]


def _working_casadi() -> list[Check]:
    """The one package without which nothing computes: it must load, not only be there."""
    try:
        import casadi

        x = casadi.SX.sym("x")
        assert float(casadi.Function("f", [x], [x * x])(3.0)) == 9.0
    except Exception as error:
        return [Check("casadi", BROKEN, f"does not load: {error}", "pip install casadi")]
    return []


def _compiler() -> list[Check]:
    """Build and load a generated function in the way trms does."""
    from trms_cli.core import compilation

    remedy = (
        "install a C compiler to run faster (Debian, Ubuntu: `apt install gcc libc6-dev`; "
        "macOS: `xcode-select --install`)"
    )
    program = compilation.compiler()
    if program is None:
        return [Check("C compiler", SLOWER, "none: functions are interpreted", remedy)]
    try:
        banner = subprocess.run([program, "--version"], capture_output=True, text=True, timeout=20)
        version = (banner.stdout.splitlines() or [program])[0]
    except (OSError, subprocess.TimeoutExpired) as error:
        return [Check("C compiler", SLOWER, f"{program} does not start: {error}", remedy)]
    if not _builds():
        finding = f"{version}: does not build a generated function"
        return [Check("C compiler", SLOWER, finding, remedy)]
    return [Check("C compiler", OK, f"{version}; a generated function builds and loads")]


def _builds() -> bool:
    """Whether a function comes back as machine code, from a cache that is empty."""
    import casadi

    from trms_cli.core import compilation

    x = casadi.SX.sym("x")
    function = casadi.Function("probe", [x], [casadi.sin(x)])
    before = os.environ.get("TRMS_CACHE")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["TRMS_CACHE"] = folder
        try:
            compiled_function = compilation.compile_function(function)
            return compiled_function is not function and float(compiled_function(0.0)) == 0.0
        finally:
            if before is None:
                del os.environ["TRMS_CACHE"]
            else:
                os.environ["TRMS_CACHE"] = before


def _cache() -> list[Check]:
    from trms_cli.core import compilation

    folder = compilation.cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        finding = f"{folder} cannot be written ({error.strerror}): functions are interpreted"
        remedy = "make it writable, or set TRMS_CACHE to a folder that is"
        return [Check("cache", SLOWER, finding, remedy)]
    return [Check("cache", OK, str(folder))]


def _disk() -> list[Check]:
    here = Path.cwd()
    free = shutil.disk_usage(here).free
    finding = f"{free / 1e9:.1f} GB free in {here}"
    if not os.access(here, os.W_OK):
        remedy = "change to a folder that you can write to, or give runs an out=FOLDER"
        return [Check("disk", SLOWER, f"{here} cannot be written", remedy)]
    if free < LOW_DISK:
        return [Check("disk", SLOWER, finding, "free some space: a log takes about 10 MB")]
    return [Check("disk", OK, finding)]


def _cores() -> list[Check]:
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return [Check("cores", OK, f"{available} (a sweep uses one a job, with a launcher)")]


def _terminal() -> list[Check]:
    encoding = sys.stdout.encoding or "unknown"
    kind = "a terminal" if sys.stdout.isatty() else "not a terminal: no colour, no progress bar"
    finding = f"{encoding}, {kind}, {shutil.get_terminal_size().columns} columns"
    if encoding.lower().replace("-", "") != "utf8":
        return [Check("terminal", SLOWER, finding, "export PYTHONUTF8=1 to see α, ω and arrows")]
    return [Check("terminal", OK, finding)]
