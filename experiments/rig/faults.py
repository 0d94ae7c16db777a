"""Faults at the wire, by the thousand: does every run land, and stay within its envelope?

    python -m experiments.rig.faults --runs 10000
    python -m experiments.rig.faults --runs 200 --real-time

Each run closes the loop over a rig behind a wire, with one to three faults of drawn sizes and
times, in virtual time, or in real time with rig and program in processes of their own: frames lost,
doubled, overtaking, spoilt; bytes that are no frames; readings that are infinite, none or far off;
a cable that is pulled, for a while or for good; a rig's computer that starts anew; a program that
is busy for up to half a second; a controller that raises or gives what is no number; a program that
is killed.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.command_line import exit_code_of
from experiments.rig.faulty_rig import STEP, WATCHDOG, FaultyRig, RigFaults
from experiments.rig.virtual_link import VirtualLink, VirtualRig
from trms_cli.controllers.controller import Command, ControlSample, ControlSetup
from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import TrmsError
from trms_cli.library.tasks.experiment import topics_of, units_of
from trms_cli.models.newtonian import Newtonian
from trms_cli.observers.ekf import Ekf
from trms_cli.plants.envelope import Bound, Envelope
from trms_cli.plants.hardware import RestCheck
from trms_cli.plants.landing import Landing
from trms_cli.plants.link.nuisances import WireNuisances
from trms_cli.plants.udp import UdpRig
from trms_cli.plants.wiring import Wire
from trms_cli.recordings.log_reader import read_log
from trms_cli.recordings.run_log import RunLog
from trms_cli.references.sine import Sine
from trms_cli.references.trajectory import ReferenceTrajectory
from trms_cli.simulation.closed_loop import Experiment, Loop
from trms_cli.simulation.history import History
from trms_cli.simulation.pace import Clock, WallClock
from trms_cli.simulation.supervisor import Supervisor

SAMPLE_TIME = 0.02  # s
DURATION = 1.6  # s, of a run
#: Kinds of faults; a run has one to three of them.
KINDS = (
    "loss",
    "doubling",
    "reordering",
    "corruption",
    "garbage",
    "strange",
    "pulled",
    "pulled_for_good",
    "reset",
    "stall",
    "raising",
    "no_number",
    "killed",
)
LIMIT = 2.5  # V, of the rig
BOUND = {"u_v": (-0.2, 2.0), "u_h": (-1.5, 1.5)}  # V, of the envelope
SLEW = 20.0  # V/s


@dataclass(frozen=True, kw_only=True)
class Faulty:
    """A law that chases, is busy at a time, raises, or gives what is no number."""

    clock: Any
    stall_at: float = np.inf  #: s
    stall: float = 0.0  #: s
    raise_at: float = np.inf  #: s
    no_number_at: float = np.inf  #: s
    sample_time: float | None = None

    def preview(self, setup: ControlSetup) -> int:
        """None is needed."""
        return 0

    def init(self, setup: ControlSetup) -> dict[str, Any]:
        """Which states are the angles, and what has been done."""
        model = setup.model
        return {"angles": [model.state_index(name) for name in model.controlled], "stalled": False}

    def step(
        self, state: dict[str, Any], sample: ControlSample, *, want_prediction: bool
    ) -> Command:
        """Proportional, about a command that lifts the beam."""
        if sample.time >= self.stall_at and not state["stalled"]:
            state["stalled"] = True
            self.clock.sleep_until(self.clock.now() + self.stall)
        if sample.time >= self.raise_at:
            raise ZeroDivisionError("a fault that was asked for")
        error = sample.reference[0] - sample.estimate.x[state["angles"]]
        u = np.array([1.2, 0.0]) + 3.0 * error
        return Command(u if sample.time < self.no_number_at else u * np.nan)


@dataclass(frozen=True)
class Verdict:
    """What came of a run."""

    kinds: tuple[str, ...]  #: Its faults
    ending: str  #: completed, killed, or the error that ended it
    violations: tuple[str, ...]  #: What must not be


@dataclass(frozen=True)
class Plan:
    """The faults of a run, as drawn."""

    kinds: tuple[str, ...]
    nuisances: WireNuisances
    rig: RigFaults
    law: dict[str, float]  #: Times (s) of what the law does, see :class:`Faulty`
    killed_at: float | None  #: s, after the program has begun


def plan_of(seed: int) -> Plan:
    """One to three kinds of faults, with drawn sizes and times."""
    generator = np.random.default_rng([seed, 0x46415554])
    count = 1 + int(generator.integers(3))
    kinds = tuple(generator.choice(KINDS, size=count, replace=False).tolist())

    def within(kind: str, begin: float, length: float) -> float:
        moment = begin + float(generator.uniform(0.0, length))
        return moment if kind in kinds else np.inf

    def share(kind: str, largest: float) -> float:
        value = float(generator.uniform(0.0, largest))
        return value if kind in kinds else 0.0

    pulled = min(within("pulled", 0.7, DURATION), within("pulled_for_good", 0.7, DURATION))
    reset, killed = within("reset", 0.7, DURATION), within("killed", 0.7, DURATION)
    return Plan(
        kinds,
        WireNuisances(
            latency=float(generator.uniform(0.0, 0.002)),
            jitter=share("reordering", 0.02),
            loss=share("loss", 0.5),
            doubling=share("doubling", 0.5),
            corruption=share("corruption", 0.5),
            pulled_at=None if np.isinf(pulled) else pulled,
            pulled_for=None if "pulled_for_good" in kinds else 0.02 + share("pulled", 0.6),
        ),
        RigFaults(
            garbage=share("garbage", 0.5),
            strange=share("strange", 0.5),
            reset_at=None if np.isinf(reset) else reset,
        ),
        {
            "stall_at": within("stall", 0.0, DURATION),
            "stall": float(generator.uniform(0.0, 0.5)),
            "raise_at": within("raising", 0.0, DURATION),
            "no_number_at": within("no_number", 0.0, DURATION),
        },
        None if np.isinf(killed) else killed,
    )


def run_virtual(seed: int, folder: Path) -> Verdict:
    """One run in virtual time with the faults of a seed."""
    plan = plan_of(seed)
    rig = FaultyRig(plan.rig, seed, duration=20.0)
    link = VirtualLink(plan.nuisances, rig, seed, dead_at=plan.killed_at)
    law = Faulty(clock=link.clock, **plan.law)
    path = folder / f"{seed}.mcap"
    sent: list[FloatArray] = []
    ending = _looped(_experiment(VirtualRig(link=link, **_KEYS), law), path, sent, link.clock)
    link.clock.sleep_until(link.clock.now() + 3 * WATCHDOG)
    link.move()
    violations = [*_violations(rig.summary(), sent), *_log_violations(path, died=False)]
    if link.closed != 1:
        violations.append(f"closed {link.closed} times")
    if ending.startswith("!"):
        violations.append(f"an error of our own: {ending}")
    return Verdict(plan.kinds, ending, tuple(violations))


def run_real(seed: int, folder: Path) -> Verdict:
    """The same in real time; the rig and the program are processes of their own."""
    from experiments.rig.real_link import ServedProcess, run_in_process

    plan = plan_of(seed)
    served = ServedProcess(FaultyRig(plan.rig, seed, duration=90.0), plan.nuisances, seed, STEP)
    path, word = folder / f"{seed}.mcap", folder / f"{seed}.txt"

    def program() -> None:
        clock = WallClock()
        rig = UdpRig(host="127.0.0.1", port=served.port, **_KEYS)
        ending = _looped(_experiment(rig, Faulty(clock=clock, **plan.law)), path, [], None)
        word.write_text(ending, encoding="utf-8")

    ended = run_in_process(program, plan.killed_at)
    time.sleep(3 * WATCHDOG)
    summary = served.end()
    ending = word.read_text(encoding="utf-8") if word.exists() else "killed"
    violations = [*_violations(summary, []), *_log_violations(path, died=ending == "killed")]
    if ended and ending == "killed":
        violations.append("the program ended without a word")
    if ending.startswith("!"):
        violations.append(f"an error of our own: {ending}")
    return Verdict(plan.kinds, ending, tuple(violations))


def _looped(experiment: Experiment, path: Path, sent: list[FloatArray], clock: Clock | None) -> str:
    """Close the loop; how it ended, with an exclamation mark for what should not be."""
    logs: list[RunLog] = []

    def make_history(plant: Any) -> History:
        _spy(plant, sent)
        topics = topics_of(experiment, plant)
        logs.append(RunLog(path, topics, {}))
        return History(units_of(topics), logs[-1])

    ending = "completed"
    try:
        Loop.start(experiment, make_history, clock).run()
    except (TrmsError, ZeroDivisionError) as error:
        ending = type(error).__name__
    except Exception as error:
        ending = f"!{error!r}"
    for log in logs:
        log.close("completed" if ending == "completed" else "failed")
    return ending


_CHANNELS = ("alpha_v", "alpha_h", "omega_v", "omega_h")
#: Of the rig's configuration, whatever carries the frames.
_KEYS: dict[str, Any] = {
    "wiring": {
        **{name: Wire(channel=i, sign=1) for i, name in enumerate(_CHANNELS)},
        **{name: Wire(channel=i, sign=1) for i, name in enumerate(BOUND)},
    },
    "limits": dict.fromkeys(BOUND, (-LIMIT, LIMIT)),
    "first_command": {"u_v": 0.8},
    "landing": Landing(rate=5.0, hold=0.1),
    "envelope": Envelope(
        commands={
            name: Bound(lower=low, upper=high, action="clamp")
            for name, (low, high) in BOUND.items()
        },
        slew=dict.fromkeys(BOUND, SLEW),
        readings={"alpha_v": Bound(lower=-1.2, upper=1.2, after=0.04)},
    ),
    "rest": RestCheck(duration=0.1),
    "arm": True,
}


def _experiment(rig: Any, law: Faulty) -> Experiment:
    return Experiment(
        model=Newtonian(),
        plant=rig,
        observer=Ekf(),
        controller=law,
        reference=ReferenceTrajectory(
            alpha_v=Sine(amplitude=0.3, frequency=1.0), alpha_h=Sine(amplitude=0.5, frequency=0.5)
        ),
        duration=DURATION,
        sample_time=SAMPLE_TIME,
        supervisor=Supervisor(),
        prediction_every=0,
    )


def _spy(plant: Any, sent: list[FloatArray]) -> None:
    """Take down what a plant's run is told to send."""
    send: Callable[[FloatArray], None] = plant.advance

    def advance(command: FloatArray) -> None:
        sent.append(np.array(command, dtype=float))
        send(command)

    plant.advance = advance


def _violations(summary: Mapping[str, Any], sent: Sequence[FloatArray]) -> list[str]:
    """What must not be, of the commands that were sent, in force, and left in force."""
    violations = []
    lower, upper = (np.array([BOUND[name][i] for name in ("u_v", "u_h")]) for i in (0, 1))
    for command in [*sent, *(np.array(command) for _, command in summary["applied"])]:
        if not np.all(np.isfinite(command)):
            violations.append(f"a command that is no number: {command}")
        elif np.any(command < lower - 1e-6) or np.any(command > upper + 1e-6):
            violations.append(f"a command outside the envelope: {command}")
    if len(sent) > 1:
        step = float(np.max(np.abs(np.diff(sent, axis=0)), initial=0.0))
        if step > SLEW * SAMPLE_TIME + 1e-9:
            violations.append(f"a command that changed by {step:g} V in a sample")
    if sent and sent[-1].any():
        violations.append(f"the last command that was sent is {sent[-1]} V")
    if summary["old_commands"]:
        violations.append(f"{summary['old_commands']} commands applied after newer ones")
    if not summary["safe"]:
        violations.append(f"not landed: {summary['command']} V")
    return violations


def _log_violations(path: Path, *, died: bool) -> list[str]:
    """Of the log, where there is one: it opens, and is finished unless its program died."""
    if not path.exists():
        return []
    try:
        log = read_log(path)
    except TrmsError as error:
        return [f"the log cannot be read: {error}"]
    finally:
        path.unlink()
    return [] if log.complete or died else ["the log is not complete"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run them and print what came of them; 1 where anything was violated."""
    parser = argparse.ArgumentParser(prog="python -m experiments.rig.faults", description=__doc__)
    parser.add_argument("--runs", type=int, default=10_000, help="how many (default 10000)")
    parser.add_argument("--first", type=int, default=0, help="first seed (default 0)")
    parser.add_argument("--real-time", action="store_true", help="in processes, by the clock")
    parser.add_argument("--json", action="store_true", help="print trms.rig_faults/1")
    arguments = parser.parse_args(argv)
    endings: Counter[str] = Counter()
    by_kind: Counter[str] = Counter()
    violated: list[tuple[int, Verdict]] = []
    with tempfile.TemporaryDirectory() as folder, np.errstate(all="ignore"):
        for seed in range(arguments.first, arguments.first + arguments.runs):
            verdict = (run_real if arguments.real_time else run_virtual)(seed, Path(folder))
            endings[verdict.ending] += 1
            by_kind.update(verdict.kinds)
            if verdict.violations:
                violated.append((seed, verdict))
            if sys.stderr.isatty():
                sys.stderr.write(f"\r{seed - arguments.first + 1} of {arguments.runs} runs")
    if arguments.json:
        document = {
            "schema": "trms.rig_faults/1",
            "runs": arguments.runs,
            "real_time": arguments.real_time,
            "endings": dict(endings),
            "faults": dict(by_kind),
            "violations": {str(seed): list(v.violations) for seed, v in violated},
        }
        print(json.dumps(document))
    else:
        print(f"{arguments.runs} runs; faults: {_counts(by_kind)}")
        print(f"endings: {_counts(endings)}")
        for seed, verdict in violated[:20]:
            print(f"seed {seed} ({', '.join(verdict.kinds)}; {verdict.ending}):")
            print("".join(f"  {words}\n" for words in verdict.violations[:4]), end="")
        print(f"runs with a violation: {len(violated)}")
    return 1 if violated else 0


def _counts(counts: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.most_common())


if __name__ == "__main__":
    raise SystemExit(exit_code_of(main))
