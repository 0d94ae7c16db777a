"""A simulated rig behind a wire, in real time: what ``trms rig serve`` does."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from trms_cli.composition.composer import Composition
from trms_cli.composition.plain_values import number, whole_number
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.invocation import program
from trms_cli.core.plugins import build, construct
from trms_cli.models.model import names

#: s between two rows of the truth.
_TRUTH_STEP = 0.01


def perform(composition: Composition) -> int:
    """Serve what a configuration asks for until its time is over, or a signal comes."""
    from trms_cli.plants.landing import landing_of
    from trms_cli.plants.link.nuisances import WireNuisances
    from trms_cli.plants.link.served_rig import ServedRig
    from trms_cli.plants.link.server import PseudoTerminal, RigServer, UdpListener
    from trms_cli.plants.plant import PlantSetup
    from trms_cli.plants.replay import RecordedRig
    from trms_cli.simulation.pace import undisturbed
    from trms_cli.simulation.stop import StopRequest

    config = composition.config
    values = {key: number(config[key], key) for key in ("watchdog", "duration", "step")}
    for key, value in values.items():
        if not value > 0:
            raise ConfigurationError(f"{value:g} given", where=key, remedy="a time above 0 s")
    nuisances = construct(WireNuisances, config["wire"], "wire")
    port, seed = whole_number(config["port"], "port"), whole_number(config["seed"], "seed")
    if not 0 <= port <= 65535:
        raise ConfigurationError(f"{port} given", where="port", remedy="0 to 65535")
    plant = build(config["plant"], "plant")
    if getattr(plant, "real_time", False) or isinstance(plant, RecordedRig):
        raise ConfigurationError(
            f"plant={composition.choices.get('plant')} is no simulated rig",
            where="plant",
            remedy="plant=simulated; what is real serves itself",
        )
    samples = int(values["duration"] / values["step"]) + 2
    run = plant.init(PlantSetup(values["step"], samples, seed))
    landing = landing_of(plant).init(names(run.inputs), run.input_limits, values["step"])
    truth = _Truth(config["truth"], run, values["step"]) if config["truth"] else None
    rig = ServedRig(truth or run, values["step"], values["watchdog"], landing.safe, _say)
    listener = PseudoTerminal() if config["serial"] else UdpListener(str(config["host"]), port)
    server = RigServer(rig, listener, nuisances, seed)
    _say(
        0.0,
        f"a rig is served for {values['duration']:g} s (duration=…): "
        f"{program()} run {listener.address}",
    )
    try:
        with StopRequest() as stop, undisturbed():
            server.serve(values["duration"], values["step"], lambda: stop.requests > 0)
    finally:
        listener.close()
        if truth is not None:
            truth.close()
    if server.stood_still > 0.0:
        _say(
            rig.time,
            f"the rig stood still for {server.stood_still:.3g} s: it takes longer to simulate than "
            "to live on this machine (step=… is its integration step)",
        )
    command = ", ".join(
        f"{signal.name} {value:g} {signal.unit}"
        for signal, value in zip(run.inputs, rig.command, strict=True)
    )
    _say(
        rig.time, f"ended; {rig.commands} commands applied, {rig.refused} frames refused; {command}"
    )
    return 0


class _Truth:
    """A rig that writes down what is true of it, in a file of its own."""

    def __init__(self, file: Any, run: Any, step: float) -> None:
        self._run, self._step, self._time, self._next = run, step, 0.0, 0.0
        self.inputs, self.outputs, self.input_limits = run.inputs, run.outputs, run.input_limits
        try:
            self._stream = Path(str(file)).open("x", encoding="utf-8")  # noqa: SIM115
        except OSError as error:
            raise ConfigurationError(
                f"{file}: {error.strerror}", where="truth", remedy="a file that is not there yet"
            ) from None
        signals = [*run.inputs, *(s for s in run.states if s.name not in names(run.inputs))]
        self._stream.write(",".join(["t[s]", *(f"{s.name}[{s.unit}]" for s in signals)]) + "\n")

    def measure(self) -> Any:
        """What the rig's sensors show."""
        return self._run.measure()

    def advance(self, command: Any) -> None:
        """Hold a command for a step, and write a row now and then."""
        if self._time >= self._next - 1e-9:
            row = [self._time, *np.asarray(command).tolist(), *self._run.state.tolist()]
            self._stream.write(",".join(f"{value:.9g}" for value in row) + "\n")
            self._stream.flush()
            self._next += _TRUTH_STEP
        self._run.advance(command)
        self._time += self._step

    def close(self) -> None:
        """Finish the file."""
        self._stream.close()


def _say(time: float, words: str) -> None:
    sys.stdout.write(f"{time:9.3f} s  {words}\n")
    sys.stdout.flush()
