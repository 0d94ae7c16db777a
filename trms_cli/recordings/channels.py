"""The channels that a recording may hold: their names, roles and units.

One vocabulary for CSV headers, log topics and everything that reads a recording.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass

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
    lower = {known.lower(): known for known in ("t", *CHANNELS)}
    close = difflib.get_close_matches(name.lower(), lower, n=1, cutoff=0.5)
    return lower[close[0]] if close else None
