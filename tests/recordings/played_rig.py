"""Simulated rigs played in open loop or under a plain controller, as recordings in memory."""

from collections.abc import Callable, Mapping, Sequence
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
        control = _feedback(step)
        angles = [names(run.outputs).index(name) for name in ("alpha_v", "alpha_h")]
    else:
        asked = np.column_stack([s.sample(time + 7.3 * seed) for s in SIGNALS[kind]]) * scale
    lower, upper = run.input_limits
    measured, commands = [], []
    for k in range(count):
        y = run.measure()
        u = control(references[k], y[angles]) * scale if kind == "closed" else asked[k]
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


def _feedback(step: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """PI with a filtered derivative on each axis: commands for references and angles."""
    integral, rate = np.zeros(2), np.zeros(2)
    last: np.ndarray | None = None

    def command(reference: np.ndarray, angles: np.ndarray) -> np.ndarray:
        nonlocal integral, rate, last
        moved = np.zeros(2) if last is None else angles - last
        rate, last = rate + 0.3 * (moved / step - rate), angles
        error = reference - angles
        integral = np.clip(integral + 0.3 * error * step, -1, 1)
        gains, damping = np.array([0.6, 0.8]), np.array([0.9, 1.0])
        return np.array([0.9, 0.0]) + gains * error + integral - damping * rate

    return command
