"""A real rig, looked at with a person: what ``trms rig check`` does."""

from __future__ import annotations

import math
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.composition.composer import Composition
from trms_cli.core import wording
from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.findings import Datum, Findings, NextCommand, Remarks, Section, Table
from trms_cli.core.invocation import program
from trms_cli.core.plugins import build, construct

if TYPE_CHECKING:
    from trms_cli.plants.hardware import HardwareRig
    from trms_cli.simulation.rig_check import Movement, RigCheck, RigCheckRequest, RigReadings

_KEYS = ("duration", "step", "every", "zero", "rest", "pulse", "pulse_time", "settle", "out")
#: What is pulsed, what of it is watched, the two ways that it may go, the positive one first.
_ROTORS = {
    "u_v": ("main rotor", "the main rotor's end of the beam", ("up", "down")),
    "u_h": ("tail rotor", "the beam, seen from above,", ("counter-clockwise", "clockwise")),
}
_LEAST_LEVEL = 1e-12


def perform(composition: Composition) -> int:
    """Look at the rig that a configuration names, and write its wiring where that is asked for."""
    from trms_cli.plants.hardware import HardwareRig
    from trms_cli.simulation.rig_check import RigCheck, RigCheckRequest

    config = composition.config
    request = construct(RigCheckRequest, {key: config[key] for key in _KEYS})
    file = _file(request.out)
    plant = build(config["plant"], "plant")
    if not isinstance(plant, HardwareRig):
        raise ConfigurationError(
            f"plant={composition.choices.get('plant')} is no rig with a wiring",
            where="plant",
            remedy="plant=udp, plant=serial or plant=callable; `trms rig serve` gives one to try",
        )
    person = _Person()
    model = build(config["model"], "model")
    own = None if model.bench_sizes else model
    if request.pulse and own is not None:
        raise ConfigurationError(
            f"{request.pulse:g} given, and pulses are for twin rotors, whose beam tells the signs",
            where="pulse",
            remedy="pulse=0 looks and takes the zero; to see which way a command moves the rig: "
            "trms run controller=open_loop signal@controller.INPUT=step",
        )
    if request.pulse and not person.is_there:
        raise ConfigurationError(
            f"{request.pulse:g} V given, and nobody is at a terminal to say which way it moves",
            where="pulse",
            remedy="pulse=0 only looks",
        )
    with RigCheck(plant, request, own) as check:
        session = _Session(check, plant, request, person)
        session.look()
        session.zero()
        if request.pulse:
            for name in check.inputs:
                session.turn(name)
    findings = session.findings(composition, file)
    from trms_cli.reporting.screen import show

    show(findings, "")
    return 0


class _Person:
    """Whoever sits at the terminal, if anybody does."""

    def __init__(self) -> None:
        self.is_there = sys.stdin.isatty() and sys.stderr.isatty()

    def answer(self, question: str) -> str:
        """What is typed, in small letters; empty where nobody is there."""
        if not self.is_there:
            return ""
        sys.stderr.write(question)
        sys.stderr.flush()
        return sys.stdin.readline().strip().lower()

    def agrees(self, question: str) -> bool:
        """Whether it is answered by yes."""
        return self.answer(f"{question} [y/N] ") in ("y", "yes")

    def angle(self, name: str, usual: float | None, unit: str) -> float | None:
        """Where an angle or position rests; None to leave it as it is."""
        hint = "leave it" if usual is None else f"{usual:g}"
        while True:
            text = self.answer(f"  {name} here, {unit} [Enter: {hint}; - leaves it]: ")
            if text in ("", "-"):
                return usual if text == "" else None
            try:
                value = float(text)
            except ValueError:
                value = math.nan
            if abs(value) <= (2 * math.pi if unit == "rad" else math.inf):
                return value
            what = "an angle" if unit == "rad" else "a position"
            sys.stderr.write(f"  {what} in {unit}, as -0.62\n")

    def direction(self, rotor: str) -> int:
        """Which way a rotor moved the beam: 1 the positive way, −1 the other, 0 neither."""
        _, what, ways = _ROTORS[rotor]
        letters = {way[: 2 if ways[0][0] == ways[1][0] else 1]: way for way in ways}
        options = ", ".join([*(f"{key} = {way}" for key, way in letters.items()), "n = not at all"])
        while True:
            text = self.answer(f"  which way did {what} go? ({options}) ")
            for sign, way in zip((1, -1), ways, strict=True):
                if text and (way == text or letters.get(text) == way):
                    return sign
            if text in ("n", "no", "not", ""):
                return 0


class _Session:
    """What has come out so far."""

    def __init__(
        self, check: RigCheck, plant: HardwareRig, request: RigCheckRequest, person: _Person
    ) -> None:
        self._check, self._plant, self._request, self._person = check, plant, request, person
        self._units = {signal.name: signal.unit for signal in check.run.outputs}
        self._rest: dict[str, float] = {}
        self._turned: list[str] = []
        self._remarks: list[str | Datum] = []
        self._readings: RigReadings

    def look(self) -> None:
        """Show readings as they come."""
        from trms_cli.simulation.stop import StopRequest

        display = _Display(self._plant, self._check.outputs, self._request)
        with StopRequest() as stop:
            self._readings = self._check.look(self._request.duration, stop, display.show)

    def zero(self) -> None:
        """Take the present angles for those at rest, where that is wanted."""
        person, wanted = self._person, self._request.zero
        angles = self._check.angles
        if wanted is None and angles:
            wanted = person.agrees("does it hang still, and should this be its zero?")
        for name in angles if wanted else ():
            value = self._request.rest.get(name)
            if self._request.zero is None:
                value = person.angle(name, value, self._units[name])
            if value is None:
                continue
            if not math.isfinite(self._readings.mean(name, "raw")):
                self._remarks.append(Datum(f"{name} was never read: no zero", "bad"))
            elif self._plant.wiring[name].table:
                self._remarks.append(
                    Datum(f"{name} has a table, which has its zero in it", "doubtful")
                )
            else:
                self._rest[name] = value
                scatter = self._readings.scatter(name)
                if 2 * scatter > self._plant.rest.motion:
                    moved = f"{2 * scatter:.2g} {self._units[name]}"
                    words = f"{name} moved by {moved} while its zero was taken"
                    self._remarks.append(Datum(words, "doubtful"))

    def turn(self, name: str) -> None:
        """Pulse a rotor, and have a person say which way the beam went."""
        from trms_cli.simulation.rig_check import remarks_on, signs_to_turn
        from trms_cli.simulation.stop import StopRequest

        rotor, request = _ROTORS[name][0], self._request
        words = f"{rotor}: {request.pulse:g} V for {request.pulse_time:g} s. Hands off; go on?"
        if not self._person.agrees(words):
            self._remarks.append(Datum(f"{name} was not tried", "doubtful"))
            return
        sys.stdout.write("  waiting until it hangs still …\n")
        sys.stdout.flush()
        with StopRequest("landing the rig (once more: stop at once)") as stop:
            movements = self._check.pulse(name, stop)
        for line in _movement_lines(movements):
            sys.stdout.write(f"  {line}\n")
        sys.stdout.flush()
        direction = self._person.direction(name)
        strange = remarks_on(name, movements)
        self._remarks += [Datum(words, "doubtful") for words in strange]
        if not direction:
            self._remarks.append(Datum(f"{name} moved nothing: its sign is left as it is", "bad"))
            return
        turned = signs_to_turn(name, direction, movements)
        self._turned += turned
        words = (
            f"{name}: the signs of {', '.join(turned)} are turned"
            if turned
            else (f"{name}: the signs of the rotor and of what it moves are right")
        )
        self._remarks.append(Datum(words, "good"))

    def findings(self, composition: Composition, file: Path | None) -> Findings:
        """What there is to tell; the wiring is written."""
        from trms_cli.simulation.rig_check import corrected_wires, wiring_yaml

        raw = {name: self._readings.mean(name, "raw") for name in self._rest}
        wires = corrected_wires(self._plant.wiring, self._turned, self._rest, raw)
        for name in self._rest:
            before, after = self._plant.wiring[name].offset, wires[name].offset
            self._remarks.append(
                Datum(
                    f"{name}: offset {before:g} → {after:.6g} (raw), {self._rest[name]:g} "
                    f"{self._units[name]} here"
                )
            )
        plant = str(composition.choices.get("plant"))
        zero = ", ".join(f"{n} {value:g} {self._units[n]}" for n, value in self._rest.items())
        head = f"wiring of plant={plant}, by trms rig check" + (f"; at rest {zero}" if zero else "")
        text = wiring_yaml(wires, head)
        of_plant = re.compile(r"plant\.(?!wiring)|\w+@plant\.(?!wiring)")
        words = [text for text in composition.overrides if of_plant.match(text)]
        typed = shlex.join([f"plant={plant}", *words])
        next_commands: list[NextCommand] = []
        files: dict[str, Path] = {}
        if file is not None:
            _write(file, text)
            files["wiring"] = file
            folders = dict.fromkeys([*map(str, composition.config_dirs), str(file.parent.parent)])
            words = ["run", *(f"--config-dir {shlex.quote(folder)}" for folder in folders), typed]
            words.append(f"wiring@plant.wiring={file.stem}")
            next_commands.append(NextCommand(" ".join([program(), *words])))
        elif self._rest or self._turned:
            sys.stdout.write(f"\n{text}\nout=FOLDER/wiring/NAME.yaml writes this wiring\n")
        if not self._request.pulse and set(self._check.inputs) <= {*_ROTORS}:
            next_commands.append(
                NextCommand(
                    f"{program()} rig check {typed} pulse=0.5",
                    "the signs: each rotor turns for a moment",
                )
            )
        answers = sorted(self._readings.answers)
        took = (
            f"{1e3 * answers[len(answers) // 2]:.2f} ms median, {1e3 * answers[-1]:.2f} ms longest"
        )
        sections = [Section("Readings", blocks=[self._table(), Remarks(self._remarks)])]
        return Findings(
            "Rig check", [], sections, facts={"answer": took}, files=files, next=next_commands
        )

    def _table(self) -> Table:
        readings = self._readings
        rows = [
            [
                signal.name,
                str(self._plant.wiring[signal.name].channel),
                _or_none(readings.mean(signal.name, "raw")),
                _or_none(readings.mean(signal.name)),
                signal.unit,
                readings.scatter(signal.name),
                readings.lost(signal.name),
            ]
            for signal in self._check.run.outputs
        ]
        heads = [
            "reading",
            "channel",
            "raw, mean",
            "value, mean",
            "unit",
            "largest departure",
            "lost",
        ]
        return Table(heads, rows)


class _Display:
    """Readings as lines; on a terminal they take each other's place."""

    def __init__(
        self, plant: HardwareRig, signals: Sequence[str], request: RigCheckRequest
    ) -> None:
        self._wiring, self._signals, self._request = plant.wiring, signals, request
        self._next = 0.0
        self._is_terminal = sys.stdout.isatty()
        self._lines = 0

    def show(self, time: float, raw: Mapping[int | str, float] | None, y: FloatArray) -> None:
        """Show a reading, where it is time for a line."""
        if time < self._next - _LEAST_LEVEL:
            return
        self._next = time + (0.1 if self._is_terminal else self._request.every)
        parts = [
            f"{name:8} {value:10.4f} (raw {_raw_text(raw, self._wiring[name].channel)})"
            for name, value in zip(self._signals, y.tolist(), strict=True)
        ]
        if not self._is_terminal:
            sys.stdout.write(f"{time:8.2f} s  {'  '.join(' '.join(p.split()) for p in parts)}\n")
        else:
            if self._lines:
                sys.stdout.write(f"\x1b[{self._lines}A")
            lines = [f"{time:8.1f} s", *(f"  {part}" for part in parts)]
            sys.stdout.write("".join(f"{line}\x1b[K\n" for line in lines))
            self._lines = len(lines)
        sys.stdout.flush()


def _raw_text(raw: Mapping[int | str, float] | None, channel: int | str) -> str:
    return "–" if raw is None else f"{raw[channel]:.6g}"


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _movement_lines(movements: Sequence[Movement]) -> list[str]:
    lines = []
    for movement in movements:
        unit: Any = "rad" if movement.name.startswith("alpha") else "rad/s"
        what = "" if movement.counts else f"  (scatters by {movement.scatter:.2g}: does not count)"
        lines.append(f"{movement.name:8} {wording.quantity(movement.change, unit)}{what}")
    return lines


def _file(out: str | None) -> Path | None:
    """The file for the wiring, looked at before the rig is.

    Raises ConfigurationError for one that is there, and for one that no option could be.
    """
    if out is None:
        return None
    file = Path(out)
    if file.suffix != ".yaml" or file.parent.name != "wiring" or not file.stem.isidentifier():
        raise ConfigurationError(
            f"{out!r} cannot be an option of the group wiring",
            where="out",
            remedy="out=FOLDER/wiring/NAME.yaml, as out=lab/configs/wiring/my_rig.yaml",
        )
    if file.exists() or file.is_symlink():
        raise ConfigurationError(
            f"{out} is there already; nothing is overwritten", where="out", remedy="another name"
        )
    return file


def _write(file: Path, text: str) -> None:
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("x", encoding="utf-8") as stream:
            stream.write(text)
    except OSError as error:
        sys.stdout.write(text)  # nobody has to walk through it once more
        raise ConfigurationError(
            f"{file}: {error.strerror}",
            where="out",
            remedy="the wiring stands above; save it by hand",
        ) from None
