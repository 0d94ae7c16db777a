"""Newtonian model of the TRMS, 2 DOF and 1 DOF, with and without current dynamics.

The form is that of Rahideh's thesis (2009) as rebuilt from Rahideh & Shaheed 2007 and Rotondo,
Nejjari & Puig 2013. Symbols are theirs; ``_h`` is yaw and the tail rotor, ``_v`` pitch and the
main rotor::

    L i̇ = k_u u − R i − kφ ω                              or, quasi-static, i = (k_u u − kφ ω)/R
    J ω̇ = kφ i − B ω − k_t ω|ω| + w_motor                 k_t by direction
    F   = k_f ω|ω|                                         k_f by direction
    α̇_h = Ω_h = S_h + k_m ω_v cos α_v / J_h
    α̇_v = Ω_v = S_v + k_t ω_h / J_v
    J_v Ṡ_v = l_m F_v + k_g F_v Ω_h cos α_v − k_ov Ω_v + g[(A − B) cos α_v − C sin α_v]
              − ½ H Ω_h² sin 2α_v + w_pitch
    J_h Ṡ_h = l_t F_h cos α_v − k_oh Ω_h − k_ch α_h + w_yaw       k_ch by the sign of α_h
    J_h = D cos²α_v + E sin²α_v + F

With one axis locked, its rows are dropped and its rates are zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import casadi as ca
import numpy as np

from trms_cli.models.model import Axis, FloatArray, Model, Signal, names
from trms_cli.models.parameters import parameter_file

_STATES = {
    "i_h": Signal("i_h", "A", "armature current of the tail motor"),
    "omega_h": Signal("omega_h", "rad/s", "speed of the tail rotor"),
    "S_h": Signal("S_h", "rad/s", "yaw angular momentum over inertia"),
    "alpha_h": Signal("alpha_h", "rad", "yaw angle"),
    "i_v": Signal("i_v", "A", "armature current of the main motor"),
    "omega_v": Signal("omega_v", "rad/s", "speed of the main rotor"),
    "S_v": Signal("S_v", "rad/s", "pitch angular momentum over inertia"),
    "alpha_v": Signal("alpha_v", "rad", "pitch angle, 0 with the beam level"),
}
_DISTURBANCES = {
    "pitch_moment": Signal("pitch_moment", "N*m", "torque on pitch"),
    "yaw_moment": Signal("yaw_moment", "N*m", "torque on yaw"),
    "main_motor": Signal("main_motor", "N*m", "torque on the main rotor"),
    "tail_motor": Signal("tail_motor", "N*m", "torque on the tail rotor"),
}
_OF_AXIS = {
    "horizontal": (("i_h", "omega_h", "S_h", "alpha_h"), ("yaw_moment", "tail_motor")),
    "vertical": (("i_v", "omega_v", "S_v", "alpha_v"), ("pitch_moment", "main_motor")),
}
#: Free pitch of the default parameter set rests here; runs may start elsewhere.
_PITCH_AT_REST = -0.619


def by_direction(x: ca.SX, positive: ca.SX, negative: ca.SX) -> ca.SX:
    """A coefficient that depends on the sign of a quantity."""
    return ca.if_else(x >= 0, positive, negative)


class Newtonian(Model):
    """Newtonian TRMS.

    Parameters
    ----------
    freedom : {"both", "vertical", "horizontal"}
        Axes that move.
    currents : {"quasi_static", "dynamic"}
        Whether the armature currents are states (poles near −9300 1/s: stiff).
    parameter_set : str
        A built-in set (``bench``, ``rahideh``) or the path of a parameter file.
    parameters : mapping
        Other values for some parameters, in SI.

    Raises
    ------
    ConfigurationError
        For an unknown set or parameter.
    """

    def __init__(
        self,
        *,
        freedom: Literal["both", "vertical", "horizontal"] = "both",
        currents: Literal["quasi_static", "dynamic"] = "quasi_static",
        parameter_set: str = "bench",
        parameters: Mapping[str, float] | None = None,
    ) -> None:
        content = parameter_file(parameter_set)
        moves = [axis for axis in _OF_AXIS if freedom in ("both", axis)]
        states = [name for axis in moves for name in _OF_AXIS[axis][0]]
        if currents == "quasi_static":
            states = [name for name in states if not name.startswith("i_")]
        disturbances = [name for axis in moves for name in _OF_AXIS[axis][1]]
        limits = {"u_v": 2.5, "u_h": 2.5, "alpha_v": np.inf, "alpha_h": np.inf} | content.limits

        def of_axes(vertical: Any, horizontal: Any) -> tuple[Any, ...]:
            return (vertical,) * ("vertical" in moves) + (horizontal,) * ("horizontal" in moves)

        self.name = "newtonian"
        self.parameters = content.parameter_set().replaced(parameters or {})
        self.states = tuple(_STATES[name] for name in states)
        self.inputs = of_axes(
            Signal("u_v", "V", "command of the main rotor"),
            Signal("u_h", "V", "command of the tail rotor"),
        )
        measured = ("alpha_v", "alpha_h", "omega_v", "omega_h")
        self.outputs = tuple(_STATES[name] for name in measured if name in states)
        self.disturbances = tuple(_DISTURBANCES[n] for n in _DISTURBANCES if n in disturbances)
        self.controlled = of_axes("alpha_v", "alpha_h")
        self.input_limits = {name: limits[name] for name in of_axes("u_v", "u_h")}
        self.stops = {name: limits[name] for name in of_axes("alpha_v", "alpha_h")}
        self.axes = dict(
            of_axes(
                ("pitch", Axis("alpha_v", "pitch_moment")),
                ("yaw", Axis("alpha_h", "yaw_moment")),
            )
        )
        self.rotors = dict(of_axes(("main", "u_v"), ("tail", "u_h")))
        self.stiff = currents == "dynamic"

    def rest(self) -> FloatArray:
        x = np.zeros(self.n_x)
        if "alpha_v" in self.state_names:
            x[self.state_index("alpha_v")] = _PITCH_AT_REST
        return x

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        return self._equations(x, u, p, w)[0]

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        return ca.vertcat(*(x[self.state_index(name)] for name in names(self.outputs)))

    def quantities(self, x: ca.SX, u: ca.SX, p: ca.SX) -> dict[str, ca.SX]:
        return self._equations(x, u, p, ca.SX.zeros(self.n_w))[1]

    def _equations(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> tuple[ca.SX, dict[str, ca.SX]]:
        """All rows for the axes that move, and the quantities met on the way."""
        c = {name: p[i] for i, name in enumerate(self.parameters.names)}
        state = {name: x[i] for i, name in enumerate(self.state_names)}
        zero = ca.SX(0)

        def value(name: str) -> ca.SX:
            return state.get(name, zero)

        def command(name: str) -> ca.SX:
            known = names(self.inputs)
            return u[known.index(name)] if name in known else zero

        def disturbance(name: str) -> ca.SX:
            known = names(self.disturbances)
            return w[known.index(name)] if name in known else zero

        g = geometry(c)
        omega_h, omega_v = value("omega_h"), value("omega_v")
        alpha_h, alpha_v = value("alpha_h"), value("alpha_v")

        volt_h, volt_v = c["k_uh"] * command("u_h"), c["k_uv"] * command("u_v")
        i_h = state.get("i_h", (volt_h - c["kphi"] * omega_h) / c["R"])
        i_v = state.get("i_v", (volt_v - c["kphi"] * omega_v) / c["R"])
        drag_h = by_direction(omega_h, c["k_thp"], c["k_thn"]) * omega_h * ca.fabs(omega_h)
        drag_v = by_direction(omega_v, c["k_tvp"], c["k_tvn"]) * omega_v * ca.fabs(omega_v)
        thrust_h = by_direction(omega_h, c["k_fhp"], c["k_fhn"]) * omega_h * ca.fabs(omega_h)
        thrust_v = by_direction(omega_v, c["k_fvp"], c["k_fvn"]) * omega_v * ca.fabs(omega_v)

        inertia_h = g["D"] * ca.cos(alpha_v) ** 2 + g["E"] * ca.sin(alpha_v) ** 2 + g["F"]
        moves_h, moves_v = "alpha_h" in state, "alpha_v" in state
        rate_h = (
            value("S_h") + c["k_m"] * omega_v * ca.cos(alpha_v) / inertia_h if moves_h else zero
        )
        rate_v = value("S_v") + c["k_t"] * omega_h / g["J_v"] if moves_v else zero
        gravity = c["g"] * ((g["A"] - g["B"]) * ca.cos(alpha_v) - g["C"] * ca.sin(alpha_v))
        moment_v = (
            c["l_m"] * thrust_v
            + c["k_g"] * thrust_v * rate_h * ca.cos(alpha_v)
            - c["k_ov"] * rate_v
            + gravity
            - 0.5 * g["H"] * rate_h**2 * ca.sin(2 * alpha_v)
        )
        cable = by_direction(alpha_h, c["k_chp"], c["k_chn"]) * alpha_h
        moment_h = c["l_t"] * thrust_h * ca.cos(alpha_v) - c["k_oh"] * rate_h - cable

        rows = {
            "i_h": (volt_h - c["R"] * i_h - c["kphi"] * omega_h) / c["L"],
            "omega_h": (c["kphi"] * i_h - c["B_tr"] * omega_h - drag_h + disturbance("tail_motor"))
            / c["J_tr"],
            "S_h": (moment_h + disturbance("yaw_moment")) / inertia_h,
            "alpha_h": rate_h,
            "i_v": (volt_v - c["R"] * i_v - c["kphi"] * omega_v) / c["L"],
            "omega_v": (c["kphi"] * i_v - c["B_mr"] * omega_v - drag_v + disturbance("main_motor"))
            / c["J_mr"],
            "S_v": (moment_v + disturbance("pitch_moment")) / g["J_v"],
            "alpha_v": rate_v,
        }
        quantities = {
            "thrust_main": thrust_v,
            "thrust_tail": thrust_h,
            "drag_torque_main": drag_v,
            "drag_torque_tail": drag_h,
            "current_main": i_v,
            "current_tail": i_h,
            "inertia_pitch": g["J_v"],
            "inertia_yaw": inertia_h,
            "gravity_moment": gravity,
        }
        return ca.vertcat(*(rows[name] for name in self.state_names)), quantities


def geometry(c: Mapping[str, ca.SX]) -> dict[str, ca.SX]:
    """Moments and inertias of the rig from its masses and lengths (A … H and J_v; kg m, kg m²)."""
    m_t, m_tr, m_ts = c["m_t"], c["m_tr"], c["m_ts"]
    m_m, m_mr, m_ms = c["m_m"], c["m_mr"], c["m_ms"]
    m_b, m_cb, l_b, l_cb = c["m_b"], c["m_cb"], c["l_b"], c["l_cb"]
    l_t, l_m, r_ms, r_ts = c["l_t"], c["l_m"], c["r_ms"], c["r_ts"]
    a = (m_t / 2 + m_tr + m_ts) * l_t
    b = (m_m / 2 + m_mr + m_ms) * l_m
    return {
        "A": a,
        "B": b,
        "C": m_b * l_b / 2 + m_cb * l_cb,
        "D": (m_m / 3 + m_mr + m_ms) * l_m**2 + (m_t / 3 + m_tr + m_ts) * l_t**2,
        "E": m_b * l_b**2 / 3 + m_cb * l_cb**2,
        "F": m_ms * r_ms**2 + m_ts * r_ts**2 / 2,
        "H": a * l_t + b * l_m + m_b * l_b**2 / 2 + m_cb * l_cb**2,
        "J_v": m_mr * l_m**2
        + m_m * l_m**2 / 3
        + m_tr * l_t**2
        + m_t * l_t**2 / 3
        + m_cb * l_cb**2
        + m_b * l_b**2 / 3
        + m_ms * (r_ms**2 / 2 + l_m**2)
        + m_ts * (r_ts**2 / 2 + l_t**2),
    }
