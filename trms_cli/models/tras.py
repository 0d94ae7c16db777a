"""INTECO's two rotor aerodynamical system (TRAS), the TRMS's sister rig.

Normalised commands u (±1 is ±24 V, PWM) turn the rotors by their static curves (sources in
``configs/parameters/tras.yaml``); the beam is one thin rigid body on two axes::

    ω̇  = K (u − H⁻¹(ω)) + w_motor/J_r
    F_v = c_fv F(ω_v),  F_h = c_fh F(ω_h)                 F: thrust measured on the bench
    J_v Ṡ_v = l_m F_v + k_hv u_h − k_ov S_v − gBA cos α_v − gC sin α_v
              − ½ (D − E) S_h² sin 2α_v + w_pitch
    J_h(α_v) Ṡ_h = (l_t F_h + k_vh u_v) cos α_v − k_oh S_h + (D − E) S_h S_v sin 2α_v + w_yaw
    α̇_v = S_v,  α̇_h = S_h
    J_h(α_v) = D cos²α_v + E sin²α_v

The maker gives the inertias J_v and J_h with the beam level. For a body in the plane of the beam
and the counterweight's rod they fix the rest: D = J_h, E = J_v − J_h. The centrifugal moment and
the change of inertia are Lagrange's for that body, so that energy is kept without friction.

The rotors act on the other axis by their command (k_hv, k_vh), as the maker's model has it, and
not by their momentum: S is the angular rate itself.

A rotor by its static curve H (speed over command, in steady state) has one state::

    ω̇ = K (u − H⁻¹(ω))        F = F(ω)

K is the acceleration by a full command at rest. H⁻¹ and F come from coefficients of a
parameter set, or from the rig's own measured table. The electrical rotor (R, kφ, J, drag) of the
same rig is written out in :mod:`trms_cli.models.newtonian`.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from trms_cli.core.errors import ModelError
from trms_cli.models.beam_rig import STATES, BeamRig
from trms_cli.models.model import Signal
from trms_cli.models.parameters import ParameterSet, parameter_file
from trms_cli.models.static_curve import RisingSpline, read_static_curve, rising_spline


@dataclass(frozen=True)
class ParametricRotor:
    """A rotor by coefficients, each by direction where the propeller's is.

    ``H⁻¹(ω) = h1 ω + h2 ω|ω| + h3 ω³`` and ``F(ω) = k_f ω|ω|``.
    """

    axis: str  #: Suffix of its parameters: ``v`` for the main, ``h`` for the tail rotor

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Parameters that it takes from the model's set."""
        a = self.axis
        return (f"h1_{a}", f"h2_{a}p", f"h2_{a}n", f"h3_{a}", f"k_f{a}p", f"k_f{a}n")

    def held_by(self, omega: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
        """The command H⁻¹(ω) that holds a speed, in the input's unit."""
        a = self.axis
        quadratic = ca.if_else(omega >= 0, c[f"h2_{a}p"], c[f"h2_{a}n"])
        return omega * (c[f"h1_{a}"] + quadratic * ca.fabs(omega) + c[f"h3_{a}"] * omega**2)

    def thrust(self, omega: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
        """F(ω), N."""
        a = self.axis
        return ca.if_else(omega >= 0, c[f"k_f{a}p"], c[f"k_f{a}n"]) * omega * ca.fabs(omega)


@dataclass(frozen=True)
class MeasuredRotor:
    """A rotor by a measured table."""

    holding: RisingSpline  #: H⁻¹ over the speed in rad/s
    thrusting: RisingSpline  #: F over the speed in rad/s

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return ()

    def held_by(self, omega: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
        return self.holding(omega)

    def thrust(self, omega: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
        return self.thrusting(omega)


#: The steady behaviour of a rotor, as expressions.
Rotor = ParametricRotor | MeasuredRotor


def rotor_of(axis: str, table: str | None, where: str) -> Rotor:
    """A rotor from its measured table, or from parameters if there is none.

    Raises ModelError if the table cannot be read, or no smooth curve through it rises.

    ``axis``: suffix of its parameters, ``v`` or ``h``. ``table``: path of a CSV, see
    :func:`trms_cli.models.static_curve.read_static_curve`. ``where``: its configuration key.
    """
    if table is None:
        return ParametricRotor(axis)
    curve = read_static_curve(table, where)
    holding = rising_spline(curve.speed, curve.command)
    thrusting = rising_spline(curve.speed, curve.thrust)
    if holding is None or thrusting is None:
        raise ModelError(
            f"the {'command' if holding is None else 'thrust'} does not rise with the speed",
            where=table,
            remedy="look at the table for rows of another run or a sign that changes",
        )
    return MeasuredRotor(holding, thrusting)


class Tras(BeamRig):
    """Two rotor aerodynamical system.

    Raises ConfigurationError for an unknown set or parameter. Raises ModelError for a curve that
    cannot be used.

    Parameters
    ----------
    parameter_set : str
        A built-in set (``tras``, ``tras_record``) or the path of a parameter file.
    parameters : mapping
        Other values for some parameters, in SI.
    main_curve, tail_curve : str or None
        Path of a rotor's measured static curve (CSV: ``u[1],omega[rpm],thrust[N]``), in place of
        the coefficients of the parameter set, which then has none for this rotor.
    """

    def __init__(
        self,
        *,
        parameter_set: str = "tras",
        parameters: Mapping[str, float] | None = None,
        main_curve: str | None = None,
        tail_curve: str | None = None,
    ) -> None:
        content = parameter_file(parameter_set)
        self._main = rotor_of("v", main_curve, "model.main_curve")
        self._tail = rotor_of("h", tail_curve, "model.tail_curve")
        unused = {name for axis in "vh" for name in ParametricRotor(axis).parameter_names}
        unused -= {*self._main.parameter_names, *self._tail.parameter_names}
        file_parameters = content.parameter_set()
        self.parameters = ParameterSet(
            (parameter for parameter in file_parameters if parameter.name not in unused),
            file_parameters.name,
        ).replaced(parameters or {})

        self.name = "tras"
        order = ("omega_h", "S_h", "alpha_h", "omega_v", "S_v", "alpha_v")
        self.states = tuple(STATES[name] for name in order)
        self.inputs = (
            Signal("u_v", "1", "command of the main rotor, 1: full"),
            Signal("u_h", "1", "command of the tail rotor, 1: full"),
        )
        measured = ("alpha_v", "alpha_h", "omega_v", "omega_h")
        self.outputs = tuple(STATES[name] for name in measured)
        self._frame(content, input_limit=1.0)

    def pitch_at_rest(self) -> float:
        gravity, swing = (self.parameters[name].value for name in ("gBA", "gC"))
        return -float(np.arctan2(gravity, swing))

    def _equations(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> tuple[ca.SX, dict[str, ca.SX]]:
        c = self.parameters_by_name(p)
        omega_h, rate_h, omega_v, rate_v, alpha_v = x[0], x[1], x[3], x[4], x[5]
        u_v, u_h = u[0], u[1]
        pitch_moment, yaw_moment, main_motor, tail_motor = w[0], w[1], w[2], w[3]

        thrust_v = c["c_fv"] * self._main.thrust(omega_v, c)
        thrust_h = c["c_fh"] * self._tail.thrust(omega_h, c)
        along, across = c["J_h"], c["J_v"] - c["J_h"]  # D and E
        inertia_h = along * ca.cos(alpha_v) ** 2 + across * ca.sin(alpha_v) ** 2
        gravity = -c["gBA"] * ca.cos(alpha_v) - c["gC"] * ca.sin(alpha_v)
        swing = (along - across) * rate_h * ca.sin(2 * alpha_v)
        moment_v = (
            c["l_m"] * thrust_v
            + c["k_hv"] * u_h
            - c["k_ov"] * rate_v
            + gravity
            - 0.5 * swing * rate_h
            + pitch_moment
        )
        moment_h = (
            (c["l_t"] * thrust_h + c["k_vh"] * u_v) * ca.cos(alpha_v)
            - c["k_oh"] * rate_h
            + swing * rate_v
            + yaw_moment
        )
        rows = ca.vertcat(
            c["K_h"] * (u_h - self._tail.held_by(omega_h, c)) + tail_motor / c["J_tr"],
            moment_h / inertia_h,
            rate_h,
            c["K_v"] * (u_v - self._main.held_by(omega_v, c)) + main_motor / c["J_mr"],
            moment_v / c["J_v"],
            rate_v,
        )
        return rows, {
            "thrust_main": thrust_v,
            "thrust_tail": thrust_h,
            "arm_main": c["l_m"],
            "arm_tail": c["l_t"] * ca.cos(alpha_v),
            "inertia_pitch": c["J_v"],
            "inertia_yaw": inertia_h,
            "gravity_moment": gravity,
        }
