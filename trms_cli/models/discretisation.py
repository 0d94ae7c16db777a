"""From a continuous model to a discrete step and its derivatives.

Explicit models use the classical Runge–Kutta step of order four; stiff ones (armature currents
as states) a linearly implicit one. Both take several equal substeps inside a step, over which the
command is constant.

The linearly implicit step is RODAS3 (Sandu et al. 1997, Atmospheric Environment 31): order three,
L-stable, four stages, one Jacobian and one factorisation a substep. L-stability matters: a merely
A-stable step (ROS3P was tried) lets the currents ring for many steps before they follow the rotor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ModelError
from trms_cli.models.elimination import factorised
from trms_cli.models.model import Model, Signal

#: A first-order lag settles to the last bit within 40 time constants; none is that slow.
_MOST_STEPS_TO_SETTLE = 100_000

Method = Literal["auto", "rk4", "rodas3"]
Derivative = Callable[[ca.SX], ca.SX]


@dataclass(frozen=True)
class DiscreteModel:
    """A model over one step of fixed length: ``x⁺ = step(x, u, p, w)``.

    Attributes
    ----------
    model : Model
    step_length : float
        s.
    states : tuple of Signal
        The model's states followed by its memory (past inputs of a delay, for instance).
    step, measurement : casadi.Function
        ``(x, u, p, w) → x⁺`` and ``(x, u, p) → y``.
    """

    model: Model
    step_length: float
    states: tuple[Signal, ...]
    step: ca.Function
    measurement: ca.Function

    @property
    def n_x(self) -> int:
        return len(self.states)

    def linearised(self) -> ca.Function:
        """``(x, u, p, w) → x⁺, ∂x⁺/∂x, ∂x⁺/∂u, ∂x⁺/∂p, ∂x⁺/∂w``.

        Meant for one or two substeps: each one multiplies the size of the generated code.
        """
        x, u, p, w = self.symbols()
        after = self.step(x, u, p, w)
        slopes = [ca.densify(ca.jacobian(after, v)) for v in (x, u, p, w)]
        return ca.Function(
            "linearised",
            [x, u, p, w],
            ca.cse([after, *slopes]),
            ["x", "u", "p", "w"],
            ["x_next", "A", "B", "P", "G"],
        )

    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Fresh symbols (x, u, p, w), with the memory in x."""
        _, u, p, w = self.model.symbols()
        return ca.SX.sym("x", self.n_x), u, p, w

    def initial(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """A full state from the continuous one, its memory as after a long time at ``u``."""
        n = self.model.n_x
        full = np.zeros(self.n_x)
        full[:n] = x
        if self.n_x == n:
            return full
        step = BufferedFunction(self.step)
        p, w = self.model.parameters.values, np.zeros(self.model.n_w)
        for _ in range(_MOST_STEPS_TO_SETTLE):
            memory = step.evaluate(full, u, p, w)[0][n:]
            settled = np.array_equal(memory, full[n:])
            full[n:] = memory
            if settled:
                break
        return full


def discretise(
    model: Model, step_length: float, substeps: int = 1, method: Method = "auto"
) -> DiscreteModel:
    """Discretise a model with the command and the disturbances constant over the step.

    Parameters
    ----------
    step_length : float
        s.
    substeps : int
        Equal integration steps inside it.
    method : {"auto", "rk4", "rodas3"}
        ``auto`` takes the L-stable step for a stiff model.

    Raises
    ------
    ModelError
        For a step that is not positive or fewer than one substep.
    """
    if not (step_length > 0 and substeps >= 1):
        raise ModelError(
            f"cannot discretise with step {step_length!r} s and {substeps!r} substeps",
            remedy="the step is positive and there is at least one substep",
        )
    if method == "auto":
        method = "rodas3" if model.stiff else "rk4"
    integrate = {"rk4": _rk4, "rodas3": _rodas3}[method]
    memory_signals = model.memory(step_length)
    states = (*model.states, *memory_signals)
    _, u, p, w = model.symbols()
    full = ca.SX.sym("x", len(states))
    # Two indices: a slice that leaves nothing of one element would keep a row of width one.
    x, memory = full[: model.n_x, 0], full[model.n_x :, 0]
    h = step_length / substeps
    at = ca.SX.sym("at", model.n_x)
    # Stated once, and inlined at each stage: to state them again takes ten times as long.
    dynamics = ca.Function("dynamics", [at, u, p, w], [model.dynamics(at, u, p, w)])
    for k in range(substeps):
        window = (k / substeps, (k + 1) / substeps)
        arriving, memory = model.input_path(memory, u, p, window, step_length)
        x = integrate(lambda z, a=arriving: dynamics(z, a, p, w), x, h)  # type: ignore[misc]
        x = model.impulse(x, arriving, p, w, h)
    # The equations name the same sine or square many times over; sharing them halves the work.
    (after,) = ca.cse([ca.vertcat(x, memory)])
    step = ca.Function("step", [full, u, p, w], [after], ["x", "u", "p", "w"], ["x_next"])
    measurement = ca.Function(
        "measurement",
        [full, u, p],
        [model.measurement(full[: model.n_x, 0], u, p)],
        ["x", "u", "p"],
        ["y"],
    )
    return DiscreteModel(model, step_length, states, step, measurement)


def _rk4(f: Derivative, x: ca.SX, h: float) -> ca.SX:
    k1 = f(x)
    k2 = f(x + h / 2 * k1)
    k3 = f(x + h / 2 * k2)
    k4 = f(x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def _rodas3(f: Derivative, x: ca.SX, h: float) -> ca.SX:
    """Coefficients in the form that avoids products with the Jacobian.

    ``(1/(γh) − J) U_i = f(x + Σ a_ij U_j) + Σ c_ij/h U_j``, ``x⁺ = x + Σ m_i U_i``; a_21 = 0, so
    that the first two stages share one evaluation.
    """
    gamma = 0.5
    at = ca.SX.sym("at", x.shape[0])
    slope = ca.jacobian(f(at), at)
    slope = ca.substitute(slope, at, x)
    solve = factorised(ca.SX(ca.DM.eye(x.shape[0])) / (gamma * h) - slope)
    now = f(x)
    stage_1 = solve(now)
    stage_2 = solve(now + 4.0 / h * stage_1)
    stage_3 = solve(f(x + 2.0 * stage_1) + (stage_1 - stage_2) / h)
    stage_4 = solve(f(x + 2.0 * stage_1 + stage_3) + (stage_1 - stage_2 - 8.0 / 3.0 * stage_3) / h)
    return x + 2.0 * stage_1 + stage_3 + stage_4
