"""The rig's card: put your library's calls in the place of the carriage that moves by the clock.

The stand-in counts like a linear encoder and has dry friction, which the model lacks.
"""

import math
import time

_state: dict[str, float] = {}


def open() -> None:
    """Before anything else."""
    _state.update(time=time.perf_counter(), position=0.0, velocity=0.0, current=0.0)


def close() -> None:
    """After everything else, whatever went before."""
    _state.clear()


def read() -> dict[str, float]:
    """Raw readings by channel; NaN where there is none now."""
    _move()
    return {"encoder": float(round(_state["position"] / 5e-6))}


def write(values: dict[str, float]) -> None:
    """Raw commands by channel."""
    _move()
    _state["current"] = values["drive"]


def _move() -> None:
    s, step = _state, 0.001
    while s["time"] < time.perf_counter():
        s["time"] += step
        drive = s["velocity"] + step / 12.0 * (40.0 * s["current"] - 60.0 * s["velocity"])
        friction = step / 12.0 * 8.0  # of 8 N: it stops the carriage, and cannot turn it round
        s["velocity"] = math.copysign(max(abs(drive) - friction, 0.0), drive)
        s["position"] += step * s["velocity"]
