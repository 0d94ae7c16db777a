"""From a continuous model to a discrete step and its derivatives.

Explicit models use the classical Runge–Kutta step of order four; stiff ones (armature currents
as states) a linearly implicit step that is A-stable. Both take several equal substeps inside a
step, over which the command is constant.

The A-stable step is ROS3P (Lang & Verwer 2001, BIT 41): order three, three stages, one Jacobian
and one factorisation a substep.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ModelError
from trms_cli.models.model import Model, Signal

Method = Literal["auto", "rk4", "ros3p"]
Derivative = Callable[[ca.SX], ca.SX]


@dataclass(frozen=True)
class DiscreteModel:
    """A model over one step of fixed length: ``x⁺ = step(x, u, p, w)``, ``y = measurement(x, u, p)``.

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
        """``(x, u, p, w) → x⁺, ∂x⁺/∂x, ∂x⁺/∂u, ∂x⁺/∂p, ∂x⁺/∂w``."""
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
        full = np.zeros(self.n_x)
        full[: self.model.n_x] = x
        if self.n_x > self.model.n_x:
            step = BufferedFunction(self.step)
            p, w = self.model.parameters.values, np.zeros(self.model.n_w)
            for _ in range(self.n_x):
                full[self.model.n_x :] = step.evaluate(full, u, p, w)[0][self.model.n_x :]
                full[: self.model.n_x] = x
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
    method : {"auto", "rk4", "ros3p"}
        ``auto`` takes the A-stable step for a stiff model.

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
        method = "ros3p" if model.stiff else "rk4"
    integrate = {"rk4": _rk4, "ros3p": _ros3p}[method]
    memory_signals = model.memory(step_length)
    states = (*model.states, *memory_signals)
    _, u, p, w = model.symbols()
    full = ca.SX.sym("x", len(states))
    x, memory = full[: model.n_x], full[model.n_x :]
    h = step_length / substeps
    for k in range(substeps):
        window = (k / substeps, (k + 1) / substeps)
        arriving, memory = model.input_path(memory, u, p, window, step_length)
        x = integrate(lambda z, a=arriving: model.dynamics(z, a, p, w), x, h)  # type: ignore[misc]
        x = model.impulse(x, arriving, p, w, h)
    # The equations name the same sine or square many times over; sharing them halves the work.
    (after,) = ca.cse([ca.vertcat(x, memory)])
    step = ca.Function("step", [full, u, p, w], [after], ["x", "u", "p", "w"], ["x_next"])
    measurement = ca.Function(
        "measurement",
        [full, u, p],
        [model.measurement(full[: model.n_x], u, p)],
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


def _ros3p(f: Derivative, x: ca.SX, h: float) -> ca.SX:
    """Lang & Verwer's coefficients in the form that avoids products with the Jacobian.

    ``(1/(γh) − J) U_i = f(x + Σ a_ij U_j) + Σ c_ij/h U_j``, ``x⁺ = x + Σ m_i U_i``; a_31 = a_21 and
    a_32 = 0, so that the second and third stage share one evaluation.
    """
    gamma = 0.5 + np.sqrt(3.0) / 6.0
    a21 = 1.0 / gamma
    c21, c31, c32 = -1.0 / gamma**2, -2.0 * np.sqrt(3.0), -np.sqrt(3.0)
    m1, m2, m3 = 2.0, 1.0 / np.sqrt(3.0), 1.0 - 1.0 / np.sqrt(3.0)
    at = ca.SX.sym("at", x.shape[0])
    slope = ca.jacobian(f(at), at)
    slope = ca.substitute(slope, at, x)
    q, r = ca.qr(ca.densify(ca.SX.eye(x.shape[0]) / (gamma * h) - slope))

    def solve(b: ca.SX) -> ca.SX:
        return ca.solve(r, q.T @ b)

    stage_1 = solve(f(x))
    later = f(x + a21 * stage_1)
    stage_2 = solve(later + c21 / h * stage_1)
    stage_3 = solve(later + (c31 * stage_1 + c32 * stage_2) / h)
    return x + m1 * stage_1 + m2 * stage_2 + m3 * stage_3
