"""Quanser Aero: two rotors on one beam, another maker's rig.

The equations are those that the recorders of public recordings give (master's thesis, NTNU 2025,
repository finnferdinand/orbital-stabilization-quanser-aero) with what their recordings show beyond
them: rotors that lag, their reaction on the beam, dry friction, and angles behind a filter::

    τ ω̇ = k_u sat(u) − ω + w_motor τ/J_r                     each rotor
    I_b θ̈ + I_b ψ̇² sin θ cos θ + d_x g m_e sin θ + d_1 θ̇ + F_1 sgn θ̇
        = d_t (K_mθ ω_m|ω_m| + K_tθ ω_t|ω_t|) + J_r (ω̇_t + e_m ω̇_m) + w_pitch
    (I_f + I_b cos²θ) ψ̈ − 2 I_b θ̇ ψ̇ sin θ cos θ + d_2 ψ̇ + F_2 sgn ψ̇
        = cos θ [d_t (K_tψ ω_t|ω_t| − K_mψ ω_m|ω_m|) + J_r (e_t ω̇_t − ω̇_m)] + w_yaw
    y = [θ − τ_y θ̇, ψ − τ_y ψ̇]
    I_b = 2 (m_pa + m_e) d_t² + m_e d_x² + m_rod l_t²/12      I_f = m_y r_y²/2

θ is the pitch α_v, ψ the yaw α_h; S are the angular rates. Either rotor turns both axes: its own by
thrust, the other by the drag of its blades (K_tθ, K_mψ) and by what speeds it up (J_r); e are the
small angles by which the rotors' axes stand off upright (main) and off the pitch axis (tail). Dry
friction F holds an axis at rest but for a creep below v_s. Commands beyond the amplifier's limit
act as the limit itself: recordings hold such commands. ``τ_y`` is the delay at low frequency of the
filter that the angles passed before they were recorded, and right for what is slow for it.
"""

from collections.abc import Mapping

import casadi as ca

from trms_cli.models.beam_rig import INPUTS, BeamRig
from trms_cli.models.dry_friction import apply_dry_friction
from trms_cli.models.model import Signal, Window
from trms_cli.models.parameters import parameter_file


class QuanserAero(BeamRig):
    """Quanser Aero with free pitch and yaw.

    Raises ConfigurationError for an unknown set or parameter.

    Parameters
    ----------
    parameter_set : str
        A built-in set (``quanser_aero``, ``quanser_aero_record``) or the path of a parameter file.
    parameters : mapping
        Other values for some parameters, in SI.
    rotor_speeds : bool
        Whether the speeds of the rotors are among what may be measured, besides the angles.
    """

    friction_holds = False  # it is steep at rest, and has a slope there

    def __init__(
        self,
        *,
        parameter_set: str = "quanser_aero",
        parameters: Mapping[str, float] | None = None,
        rotor_speeds: bool = True,
    ) -> None:
        content = parameter_file(parameter_set)
        self.name = "quanser_aero"
        self.parameters = content.parameter_set().replaced(parameters or {})
        self.states = (
            Signal("omega_h", "rad/s", "speed of the tail rotor"),
            Signal("S_h", "rad/s", "yaw rate"),
            Signal("alpha_h", "rad", "yaw angle"),
            Signal("omega_v", "rad/s", "speed of the main rotor"),
            Signal("S_v", "rad/s", "pitch rate"),
            Signal("alpha_v", "rad", "pitch angle, 0 with the beam level"),
        )
        self.inputs = tuple(INPUTS.values())
        measured = ("alpha_v", "alpha_h", *(("omega_v", "omega_h") if rotor_speeds else ()))
        self.outputs = tuple(self.states[self.state_index(name)] for name in measured)
        self._frame(content, input_limit=24.0)

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        lag = p[self.parameters.names.index("tau_y")]
        readings = {"alpha_v": x[5] - lag * x[4], "alpha_h": x[2] - lag * x[1]}
        return ca.vertcat(
            *(readings.get(s.name, x[self.state_index(s.name)]) for s in self.outputs)
        )

    def impulse(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX, duration: float) -> ca.SX:
        """Dry friction of both axes, ``F sat(rate/v_s)`` taken implicitly.

        Rigid friction is the limit v_s → 0. It has no slope at rest: a filter that is linearised
        there could not learn from a measurement that a torque has set the axis in motion.
        """
        c = self.parameters_by_name(p)
        inertia = self.quantities(x, u, p)
        for axis, size in (("pitch", c["F_1"]), ("yaw", c["F_2"])):
            # An axis below v_s keeps 1/(1 + r) of the rate that it would have without friction.
            rigid = inertia[f"inertia_{axis}"] * c["v_s"] / duration
            r = size / rigid
            x_rigid = apply_dry_friction(self, (x, u, p, w), axis, rigid + size, duration)
            x = x + r / (1 + r) * (x_rigid - x)
        return x

    def input_path(
        self, memory: ca.SX, u: ca.SX, p: ca.SX, window: Window, step: float
    ) -> tuple[ca.SX, ca.SX]:
        """The amplifier's limit; a delay behind it passes on what it let through."""
        return self._within_limits(u), memory

    def _within_limits(self, u: ca.SX) -> ca.SX:
        lower, upper = self.input_bounds()
        return ca.fmin(ca.fmax(u, lower), upper)

    def _equations(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> tuple[ca.SX, dict[str, ca.SX]]:
        c = self.parameters_by_name(p)
        omega_h, rate_h, omega_v, rate_v, alpha_v = x[0], x[1], x[3], x[4], x[5]
        drive = self._within_limits(u)
        square_v, square_h = omega_v * ca.fabs(omega_v), omega_h * ca.fabs(omega_h)
        cosine, sine = ca.cos(alpha_v), ca.sin(alpha_v)

        beam = (
            2 * (c["m_pa"] + c["m_e"]) * c["d_t"] ** 2
            + c["m_e"] * c["d_x"] ** 2
            + c["m_rod"] * c["l_t"] ** 2 / 12
        )
        inertia_h = c["m_y"] * c["r_y"] ** 2 / 2 + beam * cosine**2
        speeding_v = (c["k_uv"] * drive[0] - omega_v) / c["tau_v"] + w[2] / c["J_r"]
        speeding_h = (c["k_uh"] * drive[1] - omega_h) / c["tau_h"] + w[3] / c["J_r"]
        gravity = -c["d_x"] * c["g"] * c["m_e"] * sine
        moment_v = (
            c["d_t"] * (c["K_mp"] * square_v + c["K_tp"] * square_h)
            + c["J_r"] * (speeding_h + c["e_m"] * speeding_v)
            + gravity
            - beam * rate_h**2 * sine * cosine
            - c["d_1"] * rate_v
            + w[0]
        )
        moment_h = (
            cosine * c["d_t"] * (c["K_ty"] * square_h - c["K_my"] * square_v)
            + cosine * c["J_r"] * (c["e_t"] * speeding_h - speeding_v)
            + 2 * beam * rate_v * rate_h * sine * cosine
            - c["d_2"] * rate_h
            + w[1]
        )
        rows = ca.vertcat(
            speeding_h, moment_h / inertia_h, rate_h, speeding_v, moment_v / beam, rate_v
        )
        return rows, {
            "thrust_main": c["K_mp"] * square_v,
            "thrust_tail": c["K_ty"] * square_h,
            "arm_main": c["d_t"],
            "arm_tail": c["d_t"] * cosine,
            "inertia_pitch": beam,
            "inertia_yaw": inertia_h,
            "gravity_moment": gravity,
        }
