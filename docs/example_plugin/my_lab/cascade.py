"""A cascade for each axis: a PID law on the angle asks for thrust, an inner loop turns the rotor.

    F = F_0 + k_p (r − α) + I − k_d Ω          İ = k_i (r − α)
    ω_r = sgn(F) √(|F| / k_f)                  the rotor speed that gives this thrust
    u = k_u ω_r + k_ω (ω_r − ω)                faster than the rotor would follow by itself

Asking for thrust instead of volts takes the square of the propeller out of the outer loop: the
tail rotor, which has no slope where it stands still, gets one.
"""

from dataclasses import dataclass
from typing import Annotated

import casadi as ca
import numpy as np
from msgspec import Meta

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup
from trms_cli.core.compilation import BufferedFunction

Positive = Annotated[float, Meta(gt=0)]


@dataclass(frozen=True, kw_only=True)
class Axis:
    """The loops of one axis: k_p (N/rad), k_i (N/(rad s)), k_d (N s/rad), F_0 (N), the rotor's
    k_f (N s²/rad²), k_u and k_ω (V s/rad)."""

    proportional: Positive
    integral: Positive
    derivative: Positive
    steady_thrust: float
    thrust_coefficient: Positive
    volts_per_speed: Positive
    speed_gain: Positive


@dataclass
class CascadeState:
    """What changes during a run (integrals, N) and what was prepared for it."""

    integral: list[float]
    rates: BufferedFunction
    angles: list[int]
    rotors: list[int]
    limit: list[float]
    step: float


@dataclass(frozen=True, kw_only=True)
class Cascade:
    """Immutable gains by axis; ``sample_time`` None takes every sample."""

    pitch: Axis
    yaw: Axis
    sample_time: Positive | None = None

    def preview(self, setup: ControlSetup) -> int:
        return 0

    def init(self, setup: ControlSetup) -> CascadeState:
        model = setup.model
        angles = [model.state_index(name) for name in ("alpha_v", "alpha_h")]
        rotors = [model.state_index(name) for name in ("omega_v", "omega_h")]
        x, u, p, w = model.symbols()
        rates = ca.Function("rates", [x, u, p, w], [model.dynamics(x, u, p, w)[angles]])
        compiled = BufferedFunction(rates)
        compiled.inputs[2][:] = model.parameters.values
        limit = model.input_bounds()[1].tolist()
        return CascadeState([0.0, 0.0], compiled, angles, rotors, limit, setup.sample_time)

    def step(self, state: CascadeState, sample: ControlSample, *, want_prediction: bool) -> Command:
        x, u = sample.estimate.x, np.empty(2)
        state.rates.inputs[0][:] = x
        state.rates.inputs[1][:] = sample.previous_command
        state.rates()
        for i, axis in enumerate((self.pitch, self.yaw)):
            error = sample.reference[0, i] - x[state.angles[i]]
            rate, omega = state.rates.outputs[0][i], x[state.rotors[i]]
            thrust = axis.steady_thrust + axis.proportional * error + state.integral[i]
            thrust -= axis.derivative * rate
            speed = np.sign(thrust) * np.sqrt(abs(thrust) / axis.thrust_coefficient)
            asked = axis.volts_per_speed * speed + axis.speed_gain * (speed - omega)
            u[i] = np.clip(asked, -state.limit[i], state.limit[i])
            if u[i] == asked:  # at the limit an integral would only have to be unwound
                state.integral[i] += axis.integral * state.step * error
        return Command(u)
