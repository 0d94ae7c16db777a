"""The rig's card: put your library's calls in the place of the cart that moves by the clock.

The stand-in counts like two encoders; its rail has dry friction, which the model lacks.
"""

import math
import time

_state: dict[str, float] = {}


def open() -> None:
    """Before anything else; the pendulum is held upright until it is armed."""
    _state.update(time=time.perf_counter(), s=0.0, v=0.0, angle=0.0, rate=0.0, force=0.0)


def close() -> None:
    """After everything else, whatever went before."""
    _state.clear()


def read() -> dict[str, float]:
    """Raw readings by channel; NaN where there is none now."""
    _move()
    return {
        "rail": float(round(_state["s"] / 5e-5)),
        "joint": float(round(_state["angle"] * 4096 / (2 * math.pi))),
    }


def write(values: dict[str, float]) -> None:
    """Raw commands by channel."""
    _move()
    _state["force"] = values["drive"]


def _move() -> None:
    s, h = _state, 0.001
    M, m, l, c, b, g, dry = 0.8, 0.15, 0.3, 2.0, 0.002, 9.81, 0.3
    while s["time"] < time.perf_counter():
        s["time"] += h
        sine, cosine = math.sin(s["angle"]), math.cos(s["angle"])
        force = s["force"] - c * s["v"] - dry * math.tanh(s["v"] / 0.002)
        force += m * l * sine * s["rate"] ** 2
        torque = m * g * l * sine - b * s["rate"]
        determinant = (M + m) * m * l**2 - (m * l * cosine) ** 2
        s["v"] += h * (m * l**2 * force - m * l * cosine * torque) / determinant
        s["rate"] += h * ((M + m) * torque - m * l * cosine * force) / determinant
        s["s"] += h * s["v"]
        s["angle"] += h * s["rate"]
