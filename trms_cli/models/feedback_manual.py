"""The maker's model of the TRMS, as in Feedback's manual 33-949S.

Symbols are the manual's: index 1 is the main rotor and pitch ψ, from the hanging rest; index 2
the tail rotor and yaw φ; τ are first-order responses to the commands::

    I_1 ψ̈ = M_1 − M_g sin ψ − B_1ψ ψ̇ − B_2ψ sgn ψ̇ − K_gy M_1 φ̇ cos ψ + w_pitch
    I_2 φ̈ = M_2 − B_1φ φ̇ − B_2φ sgn φ̇ − M_R + w_yaw
    M_i   = a_i τ_i|τ_i| + b_i τ_i
    T_11 τ̇_1 = k_1 u_v − T_10 τ_1              T_21 τ̇_2 = k_2 u_h − T_20 τ_2
    M_R   = k_c (T_0 s + 1)/(T_p s + 1) τ_1

The reaction M_R of the main rotor on yaw has one state, ``T_p ζ̇ = τ_1 − ζ``, and is
``k_c [ζ + T_0/T_p (τ_1 − ζ)]``.

In this program's convention the pitch is 0 with the beam level: ``α_v = ψ − ψ_0``, ``α_h = φ``. ψ_0
is a parameter; the manual does not give it.

The terms with sgn are set-valued friction (:mod:`trms_cli.models.dry_friction`), not a smoothed
sign: a slope that is steep enough to hold yaw would add a pole near −B_2φ/(I_2 ε), beyond what
one step of a predictive controller can integrate. They are no part of the linearisation, of the
steady states or of the eigenvalues, which are the manual's.
"""

from collections.abc import Mapping

import casadi as ca

from trms_cli.models.beam_rig import INPUTS, BeamRig
from trms_cli.models.dry_friction import apply_dry_friction
from trms_cli.models.model import Signal
from trms_cli.models.parameters import parameter_file


class FeedbackManual(BeamRig):
    """The maker's model, 7 states.

    Raises ConfigurationError for an unknown set or parameter. Raises ModelError for a set of
    another model.

    Parameters
    ----------
    dry_friction : bool
        Whether the terms with sgn act.
    parameter_set : str
        The built-in set ``feedback_manual`` or the path of a parameter file.
    parameters : mapping
        Other values for some parameters, in SI.
    """

    def __init__(
        self,
        *,
        dry_friction: bool = True,
        parameter_set: str = "feedback_manual",
        parameters: Mapping[str, float] | None = None,
    ) -> None:
        content = parameter_file(parameter_set)
        content.require(["M_g"], "feedback_manual")
        self.dry_friction = dry_friction
        self.parameters = content.parameter_set().replaced(parameters or {})
        self.name = "feedback_manual"
        self.states = (
            Signal("tau_h", "V", "momentum of the tail rotor, in volts"),
            Signal("S_h", "rad/s", "yaw rate"),
            Signal("alpha_h", "rad", "yaw angle"),
            Signal("tau_v", "V", "momentum of the main rotor, in volts"),
            Signal("S_v", "rad/s", "pitch rate"),
            Signal("alpha_v", "rad", "pitch angle, 0 with the beam level"),
            Signal("reaction", "V", "lagged momentum of the main rotor in its reaction on yaw"),
        )
        self.inputs = tuple(INPUTS.values())
        self.outputs = (self.states[5], self.states[2])
        self._frame(content, input_limit=2.5)
        self.disturbances = self.disturbances[:2]  # its rotors take none

    def pitch_at_rest(self) -> float:
        return -self.parameters["psi_0"].value

    def impulse(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX, duration: float) -> ca.SX:
        if not self.dry_friction:
            return x
        c = self.parameters_by_name(p)
        for axis, torque in (("pitch", c["B_2psi"]), ("yaw", c["B_2phi"])):
            x = apply_dry_friction(self, (x, u, p, w), axis, torque, duration)
        return x

    def _equations(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> tuple[ca.SX, dict[str, ca.SX]]:
        c = self.parameters_by_name(p)
        tau_h, rate_h, tau_v, rate_v, alpha_v, lagged = x[0], x[1], x[3], x[4], x[5], x[6]
        psi = alpha_v + c["psi_0"]
        main = c["a_1"] * tau_v * ca.fabs(tau_v) + c["b_1"] * tau_v
        tail = c["a_2"] * tau_h * ca.fabs(tau_h) + c["b_2"] * tau_h
        reaction = c["k_c"] * (lagged + c["T_0"] / c["T_p"] * (tau_v - lagged))
        gravity = -c["M_g"] * ca.sin(psi)
        gyroscopic = c["K_gy"] * main * rate_h * ca.cos(psi)
        pitch = main + gravity - c["B_1psi"] * rate_v - gyroscopic + w[0]
        yaw = tail - c["B_1phi"] * rate_h - reaction + w[1]
        rows = ca.vertcat(
            (c["k_2"] * u[1] - c["T_20"] * tau_h) / c["T_21"],
            yaw / c["I_2"],
            rate_h,
            (c["k_1"] * u[0] - c["T_10"] * tau_v) / c["T_11"],
            pitch / c["I_1"],
            rate_v,
            (tau_v - lagged) / c["T_p"],
        )
        return rows, {"inertia_pitch": c["I_1"], "inertia_yaw": c["I_2"], "gravity_moment": gravity}
