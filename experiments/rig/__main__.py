"""``make rig``: a rig in a process of its own, driven over UDP, watched live, and landed.

    python -m experiments.rig                           half a minute; log and score in outputs/
    python -m experiments.rig --duration 10 controller=lqr ref=sine
    python -m experiments.rig --exported rig_c          driven by an exported controller

`trms rig serve` simulates a rig with dry friction on yaw behind a wire that is slow and loses
frames; `trms run plant=udp` (or `trms rig drive`) drives it by the clock; `trms watch` shows it, on
a terminal as a picture, elsewhere as a line a second. Exit code 0 where the rig was armed, driven
and landed; 1 where not.
"""

from __future__ import annotations

import argparse
import datetime
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from experiments.command_line import exit_code_of
from trms_cli.core.errors import EXIT_OK, EXIT_WORSE, ConfigurationError
from trms_cli.reporting.progress import termination

_TRMS = (sys.executable, "-m", "trms_cli")
#: The rig's computer: what the model does not know, and a mild wire.
_RIG = (
    "effect=yaw_coulomb_friction",
    "effect.yaw_coulomb_friction.torque=0.003",
    "wire.latency=0.0005",
    "wire.jitter=0.0003",
    "wire.loss=0.003",
)
#: The controller's computer: a step of the reference every ten seconds.
_RUN = (
    "ref=square",
    "ref.alpha_v.frequency=0.05",
    "ref.alpha_h.frequency=0.05",
    "plant.arm=true",
    "plant.reply_timeout=0.008",  # s; a quarter of a sample is little where much else is running
)
_START = 120.0  # s, in which either process has to begin; compiling takes most of it
_LANDING = 30.0  # s, in which a run that was asked to end has to land its rig


def main(argv: Sequence[str] | None = None) -> int:
    """Serve, drive, watch; say whether all went as it should."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.rig",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("words", nargs="*", metavar="KEY=VALUE", help="of `trms run`")
    parser.add_argument("--duration", type=float, default=30.0, help="s, of the run (30)")
    parser.add_argument("--out", type=Path, help="a new folder (outputs/DATE/TIME-rig)")
    parser.add_argument("--exported", type=Path, help="drive by this export in Python's place")
    parser.add_argument(
        "--watchdog", type=float, default=0.5, help="s without a command, then the rig lands (0.5)"
    )
    arguments = parser.parse_intermixed_args(argv)  # keys and options in any order
    return exit_code_of(lambda: _demonstrate(arguments))


def _demonstrate(arguments: argparse.Namespace) -> int:
    now = datetime.datetime.now()
    folder = arguments.out or Path("outputs", f"{now:%Y-%m-%d}", f"{now:%H-%M-%S}-rig")
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise ConfigurationError(
            f"{str(folder)!r} is there", where="--out", remedy="name a new folder"
        ) from None
    words = folder / "rig.txt"
    with termination(), words.open("w", encoding="utf-8") as rig_says:
        rig = subprocess.Popen(
            [
                *_TRMS,
                *("rig", "serve", "port=0", *_RIG),
                f"duration={arguments.duration + 4 * _START:g}",
                f"watchdog={arguments.watchdog:g}",
                f"truth={folder / 'truth.csv'}",
            ],
            stdout=rig_says,
            start_new_session=True,  # Ctrl-C is for the run, which lands the rig, and then for it
        )
        try:
            code = _drive(arguments, folder, _address(rig, words))
        finally:
            _end(rig)
    sys.stdout.write((folder / "run.txt").read_text(encoding="utf-8"))
    lines = words.read_text(encoding="utf-8").splitlines()
    print("\nthe rig's own words", *lines, sep="\n  ")
    problems = what_went_wrong(lines, code)
    print(f"\n{'; '.join(problems) or 'driven and landed'}: {folder}")
    return EXIT_WORSE if problems else EXIT_OK


def _address(rig: subprocess.Popen[bytes], words: Path) -> list[str]:
    """What the rig is called by, once it is there."""
    end = time.monotonic() + _START
    while time.monotonic() < end and rig.poll() is None:
        match = re.search(r"plant=udp (\S+) (\S+)\n", words.read_text(encoding="utf-8"))
        if match:
            return ["plant=udp", *match.groups()]
        time.sleep(0.05)
    raise ConfigurationError("the rig did not start", where="trms rig serve")


def _drive(arguments: argparse.Namespace, folder: Path, address: Sequence[str]) -> int:
    """Run and watch; the exit code of the run. Whatever happens here, the run ends before."""
    exported = arguments.exported
    command = ["run"] if exported is None else ["rig", "drive", "--exported", str(exported)]
    command += [*address, *_RUN, f"plant.watchdog={arguments.watchdog:g}"]
    command += [f"sim.duration={arguments.duration:g}", f"out={folder / 'run'}", *arguments.words]
    with (folder / "run.txt").open("w", encoding="utf-8") as run_says:
        run = subprocess.Popen(
            [*_TRMS, *command], stdout=run_says, stdin=subprocess.DEVNULL, start_new_session=True
        )
        try:
            _watch(run, folder / "run" / "run.mcap")
            return run.wait()
        finally:
            _end(run)


def _watch(run: subprocess.Popen[bytes], log: Path) -> None:
    """Show the run until it ends."""
    end = time.monotonic() + _START
    while not (log.is_file() and log.stat().st_size) and time.monotonic() < end:
        if run.poll() is not None:
            return
        time.sleep(0.05)
    # without a keyboard it ends with the run; where it cannot be shown, it runs all the same
    subprocess.run([*_TRMS, "watch", str(log)], stdin=subprocess.DEVNULL, check=False)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Ask a process to end, as Ctrl-C does, and wait for it."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(_LANDING)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def what_went_wrong(lines: Sequence[str], code: int) -> list[str]:
    """What a rig's own words, and the exit code of the run, say against it."""
    said = [line.partition(" s  ")[2] for line in lines]
    expected = ("connected", "armed", "disarmed", "ended")
    order = [word for line in said for word in expected if re.match(rf"{word}\b", line)]
    problems = [] if order == list(expected) else [f"the rig saw {', '.join(order) or 'nothing'}"]
    problems += [line for line in said if line.startswith(("watchdog", "emergency"))]
    if not said or not re.search(r"ended; [1-9]\d* commands .*; u_v 0 V, u_h 0 V$", said[-1]):
        problems.append("it was not driven, or not left at 0 V")
    if code:
        problems.append(f"the run ended with {code}")
    return problems


if __name__ == "__main__":
    sys.exit(main())
