"""The interface circuits: what voltage, and what steady current, a command gives each motor."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from experiments.chapter2.rotors import ROTORS
from experiments.chapter2.simulation import FloatArray
from experiments.chapter2.study import Study
from trms_cli.models.operating_point import at_command
from trms_cli.models.single_rotor import SingleRotor
from trms_cli.models.static_curve import interface_of


@dataclass(frozen=True)
class InterfaceStudy:
    """The circuit of one motor, by its gain and with its limit."""

    rotor: str
    commands: FloatArray  #: (n,) array; V
    linear: FloatArray  #: (n,) array; voltage by the gain alone, V
    limited: FloatArray  #: (n,) array; with the limit of a TRMS, V
    margin: FloatArray  #: (n,) array; two standard deviations of the gain's prior, V
    currents: FloatArray  #: (n,) array; of the steady rotor, with the limit, A
    gain: float  #: V/V
    limit: float  #: V
    saturates_at: float  #: V, command at which the limit is reached


def study_interface(study: Study, rotor: str) -> InterfaceStudy:
    """Curves of ``main`` or ``tail``."""
    settings, axis = study.interface, ROTORS[rotor]
    limit, commands = settings.limits[rotor], settings.commands.values
    limited_rotor = SingleRotor(rotor=rotor, voltage_limit=limit)  # type: ignore[arg-type]
    (parameter,) = (p for p in limited_rotor.parameters if p.name == f"k_u{axis}")
    u, gain = ca.SX.sym("u"), {parameter.name: parameter.value}
    volts = [
        ca.Function("v", [u], [interface_of(axis, None, bound, "").voltage(u, gain)])
        for bound in (None, limit)
    ]
    linear, limited = (np.array([float(v(command)) for command in commands]) for v in volts)
    x, inputs, p, _ = limited_rotor.symbols()
    current = ca.Function(
        "i", [x, inputs, p], [limited_rotor.quantities(x, inputs, p)[f"current_{rotor}"]]
    )
    points = [at_command(limited_rotor, np.array([command])) for command in commands]
    values = limited_rotor.parameters.values
    return InterfaceStudy(
        rotor=rotor,
        commands=commands,
        linear=linear,
        limited=limited,
        margin=2 * (parameter.prior_sd or 0.0) * np.abs(linear),
        currents=np.array([float(current(point.x, point.u, values)) for point in points]),
        gain=parameter.value,
        limit=limit,
        saturates_at=limit / parameter.value,
    )
