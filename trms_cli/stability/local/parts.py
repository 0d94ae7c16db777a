"""Which part of the rig a state belongs to, and what a mode is called after the states in it.

The participation factor of state i in a mode is ``p_i = w_i v_i`` with the left and right
eigenvectors normalised to ``wᵀv = 1`` (Pérez-Arriaga, Verghese & Schweppe 1982, IEEE Trans. Power
App. Syst. 101(9)). It does not depend on the units of the states. Magnitudes are shown as shares.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.models.model import Model, names

FloatArray = npt.NDArray[np.float64]

#: From this share on, a mode is called after one part alone.
DOMINANT = 0.6
#: Parts below this share do not stand in the name of a mixed mode.
_NAMED = 0.15
#: Beyond this share of past samples a network's mode is its memory and no motion.
_PAST = 0.75
#: Rates below this (1/s) are none: a time constant of four months.
STILL = 1e-7
_LAG = re.compile(r"_lag\d+$")
_ROTOR_OF = {"v": "main", "h": "tail"}


@dataclass(frozen=True)
class Part:
    """What a state is of."""

    name: str  #: ``pitch``, ``main rotor``, an effect's name…
    #: ``angle`` or ``rate`` of an axis, ``past`` of what a network remembers; empty for any other
    role: str = ""


def parts_of(model: Model) -> tuple[Part, ...]:
    """The part of each state."""
    axis_of = {axis.angle: name for name, axis in model.axes.items()}
    of_suffix = {angle.rpartition("_")[2]: name for angle, name in axis_of.items()}
    inputs = names(model.inputs)
    return tuple(_part(name, axis_of, of_suffix, inputs) for name in model.state_names)


def _part(
    name: str, axis_of: dict[str, str], of_suffix: dict[str, str], inputs: tuple[str, ...]
) -> Part:
    if "." in name:
        return Part(name.rpartition(".")[0].replace("_", " "))
    if _LAG.search(name):
        name = _LAG.sub("", name)
        now = Part(name) if name in inputs else _part(name, axis_of, of_suffix, inputs)
        return Part(now.name, "past")
    if name in axis_of:
        return Part(axis_of[name], "angle")
    symbol, _, suffix = name.rpartition("_")
    rotor = _ROTOR_OF.get(suffix)
    if symbol == "S" and suffix in of_suffix:
        return Part(of_suffix[suffix], "rate")
    if symbol in ("omega", "tau") and rotor is not None:
        return Part(f"{rotor} rotor")
    if symbol == "i" and rotor is not None:
        return Part(f"armature current of the {rotor} motor")
    return Part(name.replace("_", " "))


def shares_of_parts(parts: tuple[Part, ...], participation: FloatArray) -> dict[str, float]:
    """Participation by part, largest first."""
    shares: dict[str, float] = {}
    for part, share in zip(parts, participation, strict=True):
        shares[part.name] = shares.get(part.name, 0.0) + float(share)
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


def mode_name(parts: tuple[Part, ...], participation: FloatArray, eigenvalue: complex) -> str:
    """What a mode is called: ``pitch swing``, ``main rotor``, ``pitch and yaw swing``."""
    shares = shares_of_parts(parts, participation)
    first, share = next(iter(shares.items()))
    swings = abs(eigenvalue.imag) > STILL
    if share < DOMINANT:
        mixed = [name for name, part in shares.items() if part >= _NAMED] or [first]
        if len(mixed) > 1:
            together = f"{', '.join(mixed[:-1])} and {mixed[-1]}"
            return f"{together} swing" if swings else f"{together} together"
    roles: dict[str, float] = {}
    for part, size in zip(parts, participation, strict=True):
        if part.name == first:
            roles[part.role] = roles.get(part.role, 0.0) + float(size)
    if roles.get("past", 0.0) > _PAST * share:
        return f"past samples of {first}"
    role = max((role for role in roles if role != "past"), key=lambda role: roles[role])
    if swings:
        return f"{first} swing"
    if not role:
        return first
    if abs(eigenvalue) <= STILL:
        return f"{first} free"
    if eigenvalue.real > STILL:
        return f"{first} divergence"
    return f"{first} rate" if role == "rate" else f"{first} settling"
