"""The channels that a recording may hold: their names, roles and units.

One vocabulary for CSV headers, log topics and everything that reads a recording.

Units as people write them are turned into SI by pint. It takes about half a second to load, so a
column already in SI never asks for it.
"""

import difflib
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from trms_cli.core.errors import RecordingError

DISTURBANCE_PREFIX = "d_"


@dataclass(frozen=True)
class Channel:
    """A signal by name."""

    name: str  #: As it stands in a CSV header, before the unit
    role: str  #: "input", "output", "reference", "current" or "disturbance"
    #: SI units that fit. The first is the usual one; an empty tuple admits any.
    units: tuple[str, ...]
    description: str  #: What it is, for schemas and tables


_COMMAND = ("V", "1")
_KNOWN = (
    Channel("u_v", "input", _COMMAND, "command to the main rotor"),
    Channel("u_h", "input", _COMMAND, "command to the tail rotor"),
    Channel("alpha_v", "output", ("rad",), "pitch angle of the beam"),
    Channel("alpha_h", "output", ("rad",), "yaw angle of the beam"),
    Channel("omega_v", "output", ("rad/s",), "speed of the main rotor"),
    Channel("omega_h", "output", ("rad/s",), "speed of the tail rotor"),
    Channel("r_v", "reference", ("rad",), "pitch reference"),
    Channel("r_h", "reference", ("rad",), "yaw reference"),
    Channel("i_v", "current", ("A",), "armature current of the main motor"),
    Channel("i_h", "current", ("A",), "armature current of the tail motor"),
)
CHANNELS = {channel.name: channel for channel in _KNOWN}

#: What else people call them.
_OTHER_NAMES = {
    "time": "t",
    "timestamp": "t",
    "pitch": "alpha_v",
    "elevation": "alpha_v",
    "yaw": "alpha_h",
    "azimuth": "alpha_h",
}

#: /reference names the controlled axis, a recording names the reference of the axis.
REFERENCE_OF_AXIS = {"alpha_v": "r_v", "alpha_h": "r_h"}
AXIS_OF_REFERENCE = {name: axis for axis, name in REFERENCE_OF_AXIS.items()}


def find_channel(name: str) -> Channel | None:
    """Return the channel of that name; any ``d_*`` is a known disturbance; else None."""
    if name in CHANNELS:
        return CHANNELS[name]
    if name.startswith(DISTURBANCE_PREFIX) and len(name) > len(DISTURBANCE_PREFIX):
        return Channel(name, "disturbance", (), "known disturbance")
    return None


def nearest_name(name: str) -> str | None:
    """Return the known name that a misspelt one most likely means, or None."""
    if name.lower() in _OTHER_NAMES:
        return _OTHER_NAMES[name.lower()]
    lower = {candidate.lower(): candidate for candidate in ("t", *CHANNELS)}
    close = difflib.get_close_matches(name.lower(), lower, n=1, cutoff=0.5)
    return lower[close[0]] if close else None


#: What pint spells in base units, in the spelling of our files.
_TIDY_UNITS = ("V", "A", "rad", "rad/s", "N", "N*m", "m", "m/s", "s", "kg", "Hz", "K", "Pa", "W")


@lru_cache(maxsize=1)
def _registry() -> Any:
    import pint

    return pint.UnitRegistry()


def _root_units(unit: str) -> Any:
    """Return pint's root units of ``unit``; they keep the radian, which has no dimension.

    So rad/s and 1/s (or Hz) stay apart, although both are "1 / [time]": a speed in Hz that
    silently became rad/s would be wrong by 2 pi.
    """
    registry = _registry()
    return registry.get_root_units(registry.parse_units("" if unit == "1" else unit))[1]


def to_si(
    values: np.ndarray, unit: str, allowed: tuple[str, ...], *, where: str, name: str
) -> tuple[np.ndarray, str]:
    """Convert a column, (n,) array, to SI; the values and their SI unit.

    ``unit``: as written between the brackets of the header. ``allowed``: SI units that fit the
    channel; any does if empty. ``where``, ``name``: file and line, and the column, for the message.
    """
    unit = unit.strip()
    if unit in allowed or (not allowed and unit in (*_TIDY_UNITS, "1")):
        return values, unit
    fits = " or ".join(f"[{u}]" for u in allowed) or "any unit that pint knows, as [N*m]"
    if not unit:
        raise RecordingError(
            f"column {name!r} has empty brackets for its unit",
            where=where,
            remedy=f"write {name}[{allowed[0] if allowed else 1}]",
        )
    try:
        root = _root_units(unit)
    except Exception as error:  # pint raises its own, tokenize's and plain ValueErrors
        raise RecordingError(
            f"column {name!r}: the unit {unit!r} is not known",
            where=where,
            remedy=f"{name} takes {fits} or a unit that converts to it",
        ) from error
    target = next((u for u in allowed or _TIDY_UNITS if _root_units(u) == root), None)
    if target is None and not allowed:
        target = "1" if not str(root) or str(root) == "dimensionless" else f"{root:~C}"
    if target is None:
        raise RecordingError(
            f"column {name!r}: the unit {unit!r} does not fit; it is {_kind(root)}",
            where=where,
            remedy=f"{name} takes {fits} or a unit that converts to it",
        )
    quantity = _registry().Quantity(values, "" if unit == "1" else unit)
    converted = quantity.to("" if target == "1" else target).magnitude
    return np.asarray(converted, dtype=float), target


def _kind(root: Any) -> str:
    text = f"{root:~C}" or "1"
    kinds = {
        "rad": "an angle",
        "rad/s": "an angular speed",
        "1/s": "a frequency (cycles or rad? write rpm or rad/s)",
        "s": "a time",
        "A": "a current",
        "1": "a plain number",
    }
    return kinds.get(text, f"a quantity in {text}")
