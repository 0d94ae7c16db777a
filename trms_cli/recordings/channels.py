"""What the columns of a recording mean: names with their roles and units.

The standard vocabulary is that of twin rotors, for CSV headers, log topics and everything that
reads a recording. A model of other names brings its own. A file of other names that is read without
a model tells their roles itself: a log by its topics, a CSV or MAT file by ``inputs`` and
``outputs``.

Units as people write them are turned into SI by pint. It takes about half a second to load, so a
column already in SI never asks for it.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.core.plugins import require_known

if TYPE_CHECKING:  # a model is slow to import, and most readers have none
    from trms_cli.models.model import Model

DISTURBANCE_PREFIX, REFERENCE_PREFIX = "d_", "r_"


@dataclass(frozen=True)
class Channel:
    """A signal by name."""

    name: str  #: As it stands in a CSV header, before the unit
    role: str  #: "input", "output", "reference", "current" or "disturbance"
    #: SI units that fit. The first is the usual one; an empty tuple admits any.
    units: tuple[str, ...] = ()
    description: str = ""  #: What it is, for schemas and tables


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

#: References whose column is not called ``r_`` and the signal that they are for.
_REFERENCES = {"alpha_v": "r_v", "alpha_h": "r_h"}
_REFERENCED = {name: signal for signal, name in _REFERENCES.items()}
#: By what a file tells roles itself: names with commas between them.
_ROLE_KEYS = {"inputs": "input", "outputs": "output"}
#: How like a needed name one must be that is left out, to be a slip of the pen.
_ALIKE = 0.6


def reference_of(signal: str) -> str:
    """Name of the reference for a signal in a recording; /reference has the signal's own name."""
    return _REFERENCES.get(signal, REFERENCE_PREFIX + signal)


def signal_of(reference: str) -> str:
    """The signal that a reference is for."""
    return _REFERENCED.get(reference, reference.removeprefix(REFERENCE_PREFIX))


@dataclass(frozen=True)
class Vocabulary:
    """The names that columns may have, and what they mean."""

    channels: Mapping[str, Channel]
    #: Names that the standard one, or a file that tells roles, does not know are errors; those that
    #: a model of other names does not know are left out
    origin: Literal["standard", "file", "model"]
    #: Name of a signal's column, where the file has another one (``data.names``)
    columns: Mapping[str, str] = field(default_factory=dict)
    needed: tuple[str, ...] = ()  #: Signals that a model takes

    @classmethod
    def of(
        cls, model: Model, columns: Mapping[str, str] | None = None, outputs: Iterable[str] = ()
    ) -> Vocabulary:
        """The names of a model: the standard ones where it has no others.

        ``columns``: column by signal, as the field. ``outputs``: those that are taken; all if
        empty. Raises ConfigurationError for a signal that the model does not have, and for a column
        that is two.
        """
        columns = columns or {}
        inputs = [signal.name for signal in model.inputs]
        outputs = [*(outputs or (signal.name for signal in model.outputs))]
        vocabulary = STANDARD
        if any(s.name not in CHANNELS for s in (*model.inputs, *model.outputs)):
            measurable = (*model.states, *model.outputs)
            channels = [Channel(s.name, "output", (s.unit,), s.description) for s in measurable]
            for s in model.inputs:  # recorded as a share, or as the amplifier's volts, it is scaled
                units = tuple(dict.fromkeys((s.unit, *_COMMAND)))
                channels.append(Channel(s.name, "input", units, s.description))
            vocabulary = cls({channel.name: channel for channel in channels}, "model")
        for name, column in columns.items():
            if name != "t" and vocabulary.find(name) is None:
                problem = f"the model has no signal {name!r}; names are {{SIGNAL: COLUMN}}"
                require_known(name, ("t", *vocabulary.channels), problem, f"plant.names.{name}")
            if list(columns.values()).count(column) > 1:
                raise ConfigurationError(
                    f"the column {column!r} is given twice",
                    where=f"plant.names.{name}",
                    remedy="each signal has a column of its own",
                )
        return replace(vocabulary, columns=columns, needed=(*inputs, *outputs))

    @classmethod
    def of_roles(cls, roles: Mapping[str, str]) -> Vocabulary:
        """The standard names and others, by their roles."""
        others = {n: Channel(n, role) for n, role in roles.items() if STANDARD.find(n) is None}
        return cls({**others, **CHANNELS}, "file") if others else STANDARD

    @classmethod
    def declared(
        cls, metadata: Mapping[str, str], columns: Sequence[str], where: str
    ) -> Vocabulary:
        """That of a file, by what it says of its inputs and outputs if it has other names.

        Raises RecordingError if it names what is no column.
        """
        if STANDARD.knows(columns):
            return STANDARD
        roles = {
            name.strip(): role
            for key, role in _ROLE_KEYS.items()
            for name in metadata.get(key, "").split(",")
            if name.strip()
        }
        for name in roles:
            problem = f"there is no column {name!r}, which its inputs or outputs name"
            require_known(name, columns, problem, where, RecordingError)
        return cls.of_roles(roles)

    def declarations(self, columns: Iterable[str]) -> dict[str, str]:
        """What a file with these columns says, to be read without a model."""
        columns = list(columns)
        roles = {} if STANDARD.knows(columns) else _ROLE_KEYS
        return {key: ", ".join(self.of_role(columns, role)) for key, role in roles.items()}

    def knows(self, columns: Iterable[str]) -> bool:
        """Whether it knows all of some names."""
        return all(name == "t" or self.find(name) for name in columns)

    def find(self, name: str) -> Channel | None:
        """The channel of that name, else None.

        Any ``d_*`` is a known disturbance; beside other names than the standard ones, ``r_*`` is a
        reference.
        """
        if name in self.channels:
            return self.channels[name]
        if name.startswith(DISTURBANCE_PREFIX) and len(name) > len(DISTURBANCE_PREFIX):
            return Channel(name, "disturbance", (), "known disturbance")
        own = signal_of(name)
        if self.origin != "standard" and own and name == reference_of(own):
            units = self.channels.get(own, Channel("", "")).units
            return Channel(name, "reference", units, f"reference of {own}")
        return None

    def of_role(self, columns: Iterable[str], role: str) -> list[str]:
        """Those of some names that have a role."""
        return [n for n in columns if (c := self.find(n)) is not None and c.role == role]

    def name_of(self, column: str) -> str | None:
        """The name (``t``: the time) of what a file's column is; None if it is left out."""
        for name, its_column in self.columns.items():
            if its_column == column:
                return name
        return column if column not in self.columns and self.knows([column]) else None

    def left_out(self, columns: Sequence[str], where: str) -> list[str]:
        """Columns of a file that are none of these channels.

        Raises RecordingError if there is no column of a name that was given, or, of a model of
        other names, if one that is left out is called nearly as one that is missing.
        """
        for name, column in self.columns.items():
            problem = f"there is no column {column!r}, which is to be {name}"
            require_known(column, columns, problem, where, RecordingError)
        there = {column: self.name_of(column) for column in columns}
        others = [column for column, name in there.items() if name is None]
        missing = [name for name in ("t", *self.needed) if name not in there.values()]
        for column in others if self.origin == "model" else ():
            meant = self.nearest(column, missing, _ALIKE)
            if meant in missing:
                raise RecordingError(
                    f"the name {column!r} is not known, and {meant!r} is missing; did you mean it?",
                    where=where,
                    remedy=f"call the column so, or give 'plant.names={{{meant}: {column}}}'",
                )
        return others

    def nearest(self, name: str, among: Iterable[str] = (), cutoff: float = 0.5) -> str | None:
        """The name, of some or all, that a misspelt one most likely means, or None."""
        lower = {candidate.lower(): candidate for candidate in among or ("t", *self.channels)}
        if _OTHER_NAMES.get(name.lower()) in lower:
            return _OTHER_NAMES[name.lower()]
        close = difflib.get_close_matches(name.lower(), lower, n=1, cutoff=cutoff)
        return lower[close[0]] if close else None


STANDARD = Vocabulary(CHANNELS, "standard")


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


_GRAD = re.compile(r"grad(?![a-z])", re.IGNORECASE)


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
    if _GRAD.match(unit):  # of a German degree, a gradian or a gigaradian
        either = [re.sub(_GRAD, of, unit) for of in ("deg", "gon")]
        raise RecordingError(
            f"column {name!r}: the unit {unit!r} means degrees to some, 1/400 of a turn to others",
            where=where,
            remedy=f"write {name}[{either[0]}] for degrees, {name}[{either[1]}] for 400 a turn",
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
