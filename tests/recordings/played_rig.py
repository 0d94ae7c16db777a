"""Simulated rigs played in open loop or under a plain controller, as recordings in memory."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from trms_cli.models.model import Model, names
from trms_cli.models.newtonian import Newtonian
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.sensors import Sensors
from trms_cli.plants.simulated import SimulatedRig
from trms_cli.recordings.recording import Recording
from trms_cli.references.multilevel import Multilevel
from trms_cli.references.multisine import Multisine
from trms_cli.references.prbs import Prbs
from trms_cli.references.signal import ReferenceSignal

STEP = 0.02
QUANTUM = 2 * np.pi / 4096
BENCH = Sensors(
    noise_sd={"omega_v": 1.6, "omega_h": 1.6},
    quantum={"alpha_v": QUANTUM, "alpha_h": QUANTUM, "omega_v": 0.49, "omega_h": 0.49},
)
#: Commands of different kinds, in V: main rotor and tail rotor.
SIGNALS: Mapping[str, tuple[ReferenceSignal, ReferenceSignal]] = {
    "prbs": (Prbs(amplitude=0.3, hold=0.8, offset=0.9), Prbs(amplitude=0.4, hold=0.6, phase=0.5)),
    "multilevel": (
        Multilevel(amplitude=0.6, shortest=0.5, longest=3.0, offset=0.6, seed=1),
        Multilevel(amplitude=0.6, shortest=0.5, longest=3.0, seed=2),
    ),
    "multisine": (
        Multisine(amplitude=0.6, frequency=0.02, lowest=0.04, highest=0.9, offset=0.8),
        Multisine(amplitude=0.6, frequency=0.02, lowest=0.05, highest=0.9, phase=0.4),
    ),
}


def play(
    kind: str = "prbs",
    *,
    model: Model | None = None,
    seed: int = 0,
    duration: float = 60.0,
    step: float = STEP,
    prior_seed: int | None = None,
    scale: Sequence[float] = (1.0, 1.0),
    sensors: Sensors = BENCH,
    late: int = 0,
) -> Recording:
    """Play a kind of :data:`SIGNALS`, or ``closed``, to a simulated rig.

    Parameters
    ----------
    scale : (2,)
        Factors on the commands, for rigs with other limits.
    late : int
        Samples from a row until its command acts.
    """
    model = model or Newtonian()
    count = round(duration / step)
    rig = SimulatedRig(model=model, sensors=sensors, prior_seed=prior_seed)
    run = rig.init(PlantSetup(step, count, seed))
    time = np.arange(count) * step
    references = np.zeros((count, 2))
    if kind == "closed":
        references = np.column_stack(
            [
                0.15 * np.sign(np.sin(2 * np.pi * time / 25 + 0.3 * seed)) - 0.2,
                0.4 * np.sign(np.sin(2 * np.pi * time / 37 + 0.5 * seed)),
            ]
        )
        control = _Controller(step, np.array(scale))
    else:
        asked = np.column_stack([s.sample(time + 7.3 * seed) for s in SIGNALS[kind]]) * scale
    lower, upper = run.input_limits
    measured, commands = [], []
    for k in range(count):
        y = run.measure()
        u = control.step(references[k], y, names(run.outputs)) if kind == "closed" else asked[k]
        u = np.clip(u[: len(lower)], lower, upper)
        measured.append(y)
        commands.append(u)
        run.advance(commands[max(k - late, 0)])
    table = np.array(measured)
    channels = {s.name: np.array(commands)[:, i] for i, s in enumerate(run.inputs)}
    channels |= {s.name: table[:, i] for i, s in enumerate(run.outputs)}
    units = {s.name: s.unit for s in (*run.inputs, *run.outputs)}
    if kind == "closed":
        channels |= {"r_v": references[:, 0], "r_h": references[:, 1]}
        units |= {"r_v": "rad", "r_h": "rad"}
    return Recording(time, channels, units, {}, Path("played.csv"))


class _Controller:
    """PI with a filtered derivative on each axis."""

    def __init__(self, step: float, scale: np.ndarray) -> None:
        self.step_s, self.scale = step, scale
        self.integral = np.zeros(2)
        self.last: np.ndarray | None = None
        self.rate = np.zeros(2)

    def step(self, reference: np.ndarray, y: np.ndarray, outputs: Sequence[str]) -> np.ndarray:
        angles = np.array([y[outputs.index("alpha_v")], y[outputs.index("alpha_h")]])
        last = angles if self.last is None else self.last
        self.rate += 0.3 * ((angles - last) / self.step_s - self.rate)
        self.last = angles
        error = reference - angles
        self.integral = np.clip(self.integral + 0.3 * error * self.step_s, -1, 1)
        gains, damping = np.array([0.6, 0.8]), np.array([0.9, 1.0])
        u = np.array([0.9, 0.0]) + gains * error + self.integral - damping * self.rate
        return u * self.scale
