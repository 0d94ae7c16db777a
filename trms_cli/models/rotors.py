"""Rotors as parts of a model: what command holds a speed, and what thrust the speed gives.

A rotor by its static curve H (speed over command, in steady state) has one state::

    ω̇ = K (u − H⁻¹(ω))        F = F(ω)

K is the acceleration by a full command at rest. H⁻¹ and F come from coefficients of a
parameter set, or from the rig's own measured table. The electrical rotor (R, kφ, J, drag) of the
same rig is written out in :mod:`trms_cli.models.newtonian`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import casadi as ca

from trms_cli.core.errors import ModelError
from trms_cli.models.static_curve import RisingSpline, read_static_curve, rising_spline


class Rotor(Protocol):
    """The steady behaviour of a rotor, as expressions."""

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Parameters that it takes from the model's set."""
        ...

    def held_by(self, omega: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
        """The command H⁻¹(ω) that holds a speed, in the input's unit."""
        ...

    def thrust(self, omega: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
        """F(ω), N."""
        ...


@dataclass(frozen=True)
class ParametricRotor:
    """A rotor by coefficients, each by direction where the propeller's is.

    ``H⁻¹(ω) = h1 ω + h2 ω|ω| + h3 ω³`` and ``F(ω) = k_f ω|ω|``.
    """

    axis: str  #: Suffix of its parameters: ``v`` for the main, ``h`` for the tail rotor

    @property
    def parameter_names(self) -> tuple[str, ...]:
        a = self.axis
        return (f"h1_{a}", f"h2_{a}p", f"h2_{a}n", f"h3_{a}", f"k_f{a}p", f"k_f{a}n")

    def held_by(self, omega: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
        a = self.axis
        quadratic = ca.if_else(omega >= 0, c[f"h2_{a}p"], c[f"h2_{a}n"])
        return omega * (c[f"h1_{a}"] + quadratic * ca.fabs(omega) + c[f"h3_{a}"] * omega**2)

    def thrust(self, omega: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
        a = self.axis
        return ca.if_else(omega >= 0, c[f"k_f{a}p"], c[f"k_f{a}n"]) * omega * ca.fabs(omega)


@dataclass(frozen=True)
class MeasuredRotor:
    """A rotor by a measured table."""

    holding: RisingSpline  #: H⁻¹ and F over the speed in rad/s
    thrusting: RisingSpline  #: H⁻¹ and F over the speed in rad/s

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return ()

    def held_by(self, omega: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
        return self.holding(omega)

    def thrust(self, omega: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
        return self.thrusting(omega)


def rotor_of(axis: str, table: str | None, where: str) -> Rotor:
    """A rotor from its measured table, or from parameters if there is none.

    Parameters
    ----------
    axis : str
        Suffix of its parameters, ``v`` or ``h``.
    table : str or None
        Path of a CSV, see :func:`trms_cli.models.static_curve.read_static_curve`.
    where : str
        The configuration key, for messages.

    Raises
    ------
    ModelError
        If the table cannot be read, or no smooth curve through it rises.
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
