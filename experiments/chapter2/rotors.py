"""Motors and propellers alone: static curves, steps, sines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.chapter2.simulation import FloatArray, OpenLoop, Response
from experiments.chapter2.study import Study, times
from trms_cli.models.single_rotor import SingleRotor

ROTORS = {"main": "v", "tail": "h"}
#: s, after which a rotor holds its speed to the last digit that is shown.
_SETTLED = 12.0


@dataclass(frozen=True)
class RotorStudy:
    """What one rotor does."""

    axis: str  #: ``v`` or ``h``
    commands: FloatArray  #: (n,) arrays; the static curve: V, rad/s, N
    speeds: FloatArray  #: (n,) arrays; the static curve: V, rad/s, N
    thrusts: FloatArray  #: (n,) arrays; the static curve: V, rad/s, N
    steps: dict[float, Response]  #: By size, V
    #: ``rises``, ``settles``, ``falls``: 10 to 90 % of the final speed, the last time outside 2 %
    #: of it, and the time from the final speed to 10 % of it with no voltage; s
    rises: dict[float, float]
    settles: dict[float, float]
    falls: dict[float, float]
    sines: dict[float, Response]  #: By frequency, Hz
    #: ``gains``, ``lags``: Of the speed's first harmonic by frequency: (rad/s)/V, degrees
    gains: dict[float, float]
    lags: dict[float, float]
    #: Largest difference in speed that the armature's inductance makes in a full step, rad/s
    current_effect: float


def study_rotor(study: Study, rotor: str) -> RotorStudy:
    """Simulate one rotor, ``main`` or ``tail``."""
    settings, T = study.rotors, study.sample_time
    axis = ROTORS[rotor]
    bench = OpenLoop(SingleRotor(rotor=rotor, load_cell=True), T, study.substeps)  # type: ignore[arg-type]
    commands = settings.commands.values
    unit_command = np.ones((len(times(_SETTLED, T)), 1))
    settled = [bench.respond(u * unit_command).outputs for u in commands]

    half = len(times(settings.step_duration / 2, T))
    pulse = np.concatenate([np.ones((half, 1)), np.zeros((half, 1))])
    steps = {size: bench.respond(size * pulse) for size in settings.steps}
    shapes = {size: _shape(r.outputs[f"omega_{axis}"], half, T) for size, r in steps.items()}

    sines, harmonics = {}, {}
    for frequency in settings.sines.frequencies:
        # Two periods to settle, four to look at.
        t = times(6 / frequency, T)
        wave = settings.sines.offset + settings.sines.amplitude * np.sin(2 * np.pi * frequency * t)
        response = bench.respond(wave[:, None])
        sines[frequency] = response
        last = t >= 2 / frequency - 1e-9
        omega = response.outputs[f"omega_{axis}"][last]
        turning = np.exp(-2j * np.pi * frequency * t[last])
        harmonics[frequency] = np.sum(omega * turning) / np.sum(wave[last] * turning)

    full = max(settings.steps)
    inductive = OpenLoop(
        SingleRotor(rotor=rotor, currents="dynamic"),  # type: ignore[arg-type]
        T,
        study.substeps,
    ).respond(full * pulse)
    gap = inductive.outputs[f"omega_{axis}"] - steps[full].outputs[f"omega_{axis}"]
    return RotorStudy(
        axis=axis,
        commands=commands,
        speeds=np.array([y[f"omega_{axis}"][-1] for y in settled]),
        thrusts=np.array([y[f"thrust_{axis}"][-1] for y in settled]),
        steps=steps,
        rises={size: shape[0] for size, shape in shapes.items()},
        settles={size: shape[1] for size, shape in shapes.items()},
        falls={size: shape[2] for size, shape in shapes.items()},
        sines=sines,
        gains={f: float(abs(h)) for f, h in harmonics.items()},
        lags={f: float(-np.degrees(np.angle(h))) for f, h in harmonics.items()},
        current_effect=float(np.abs(gap).max()),
    )


def _shape(omega: FloatArray, half: int, sample_time: float) -> tuple[float, float, float]:
    """Rise time, settling time and time to fall of a pulse's response, s."""
    up, down = omega[:half], omega[half:]
    final = up[-1]
    rise = np.interp(0.9 * final, up, np.arange(half)) - np.interp(0.1 * final, up, np.arange(half))
    outside = np.flatnonzero(np.abs(up - final) > 0.02 * abs(final))
    fall = np.interp(-0.1 * final, -down, np.arange(len(down)))
    return (
        float(rise * sample_time),
        float((outside[-1] + 1) * sample_time),
        float(fall * sample_time),
    )
