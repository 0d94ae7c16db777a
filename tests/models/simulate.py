"""Models as numbers: rates, slopes, and motions in CasADi's virtual machine."""

from collections.abc import Callable
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model


@cache
def functions_of(model: Model) -> ca.Function:
    """f, ∂f/∂x and ∂f/∂u; of a model that only steps, of its step."""
    at = model.symbols()
    f = model.transition(*at) if model.sample_time else model.dynamics(*at)
    return ca.Function("f", list(at), [f, ca.jacobian(f, at[0]), ca.jacobian(f, at[1])])


def _at(model: Model, x: Any, u: Any, w: Any) -> tuple[np.ndarray, ...]:
    u = np.zeros(model.n_u) if u is None else np.array(u)
    w = np.zeros(model.n_w) if w is None else np.array(w)
    p = model.parameters.values
    return tuple(np.array(part) for part in functions_of(model)(np.array(x), u, p, w))


def rates(model: Model, x: Any, u: Any = None, w: Any = None) -> np.ndarray:
    """dx/dt at a point, or the state a sample later."""
    return _at(model, x, u, w)[0].ravel()


def slopes(model: Model, x: Any, u: Any = None, w: Any = None) -> tuple[np.ndarray, np.ndarray]:
    return _at(model, x, u, w)[1:]


def travel(
    model: Model,
    x: Any,
    u: Any,
    seconds: float,
    step: float = 0.01,
    substeps: int = 1,
    w: Any = None,
) -> np.ndarray:
    """States over time (n + 1, n_x) under a command, constant or a function of time."""
    advance = BufferedFunction(discretise(model, step, substeps).step, compile=False)
    command = u if callable(u) else lambda t: u
    p, w = model.parameters.values, np.zeros(model.n_w) if w is None else w
    rows = [np.array(x, dtype=float)]
    for k in range(round(seconds / step)):
        rows.append(advance.evaluate(rows[-1], command(k * step), p, w)[0].copy())
    return np.array(rows)


def square(*levels: float) -> Callable[[float], list[float]]:
    """Each input between its level and the opposite, every 4 s, one after the other."""
    return lambda t: [v * (1 if (t + i) % 8 < 4 else -1) for i, v in enumerate(levels)]


def simulate(
    model: Model,
    command: Callable[[float], list[float]],
    seconds: float,
    step: float = 0.01,
    substeps: int = 1,
    start: dict[str, float] | None = None,
) -> dict[str, np.ndarray]:
    """States by name at all times, from rest or from ``start``."""
    x = model.rest()
    for name, value in (start or {}).items():
        x[model.state_index(name)] = value
    rows = travel(model, x, command, seconds, step, substeps)
    return dict(zip(model.state_names, rows.T, strict=True))


def settle(model: Model, command: list[float], seconds: float = 250.0) -> dict[str, float]:
    """State after a long time at a constant command."""
    states = simulate(model, lambda t: command, seconds, 0.1, 10)
    return {name: float(values[-1]) for name, values in states.items()}
